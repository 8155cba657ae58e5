"""Files are written whole or not at all, and every refusal is a sentence with the file in it."""

import errno
import os

import pytest
from matplotlib.figure import Figure

from apu_casadi.core import files
from apu_casadi.core.errors import DataError


def test_a_failed_write_leaves_the_former_file_and_nothing_else(tmp_path):
    path = tmp_path / "page.md"
    files.write_text(path, "former")

    def full():
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with (
        pytest.raises(
            DataError, match=r"page\.md: cannot be written: No space .*; free some space"
        ),
        files.whole(path) as target,
    ):
        target.write_text("half")
        full()
    assert path.read_text() == "former" and [p.name for p in tmp_path.iterdir()] == ["page.md"]
    with pytest.raises(KeyboardInterrupt), files.whole(path) as target:
        target.write_text("half")
        raise KeyboardInterrupt
    assert path.read_text() == "former" and [p.name for p in tmp_path.iterdir()] == ["page.md"]
    assert not files.PARTIAL


def test_the_error_of_the_block_is_not_hidden_by_the_clearing_away(tmp_path):
    """A folder that vanished while it was written to."""
    folder = tmp_path / "gone"
    with (
        pytest.raises(DataError, match=r"x\.txt: cannot be written: No such file"),
        files.whole(folder / "x.txt") as target,
    ):
        folder.rmdir()
        target.write_text("x")


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("a" * 300, "File name too long; choose a shorter name"),
        ("file/x", "File exists; a file stands where a folder is needed"),
        ("folder", "Is a directory; name a file in it"),
        ("loop", "links"),
        ("zero\0byte", "no possible file name"),
    ],
)
def test_names_that_cannot_be_written(tmp_path, name, words):
    (tmp_path / "file").write_text("x")
    (tmp_path / "folder").mkdir()
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    with pytest.raises(DataError, match=words):
        files.write_text(tmp_path / name, "x")


def test_names_as_long_as_names_can_be(tmp_path):
    """The temporary name is short: 255 bytes are the limit of common file systems."""
    path = tmp_path / ("a" * 255)
    assert files.write_text(path, "x").read_text() == "x"


def test_links_devices_and_rights_stay(tmp_path):
    """A link's target is replaced, not the link; a device is written, not replaced by a file."""
    target, link = tmp_path / "target", tmp_path / "link"
    files.write_text(target, "a")
    target.chmod(0o600)
    link.symlink_to(target)
    files.write_text(link, "b")
    assert link.is_symlink() and target.read_text() == "b"
    assert target.stat().st_mode & 0o777 == 0o600
    files.write_text("/dev/null", "x")
    assert not os.path.isfile("/dev/null")
    if os.path.exists("/dev/full"):
        with pytest.raises(DataError, match="/dev/full: cannot be written: No space"):
            files.write_text("/dev/full", "x")


def test_figures(tmp_path):
    figure = Figure()
    assert files.save_figure(figure, tmp_path / "new" / "x.png").read_bytes()[1:4] == b"PNG"
    with pytest.raises(DataError, match=r"x\.bmpx: cannot be drawn as \.bmpx; .*\.png"):
        files.save_figure(figure, tmp_path / "x.bmpx")


def test_reading_only_regular_files_in_utf_8(tmp_path):
    path = tmp_path / "x.toml"
    with pytest.raises(DataError, match=r"x\.toml: scenario cannot be read: No such file"):
        files.read_text(path, "scenario")
    path.write_bytes(b"a = 1\r\nb = '\xe9'\n")
    with pytest.raises(DataError, match=r"not UTF-8 text \(byte 0xe9 in line 2\)"):
        files.read_text(path)
    path.write_bytes(b"\xef\xbb\xbfa = 1\r\n")
    assert files.read_text(path) == "a = 1\n"
    with pytest.raises(DataError, match=r"\d+ bytes, 5 at most"):
        files.read_bytes(path, limit=5)
    with pytest.raises(DataError, match=r"cannot be read: Is a directory"):
        files.read_bytes(tmp_path)
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(DataError, match="no regular file"):  # it would wait for a writer
        files.read_bytes(tmp_path / "pipe")
    with pytest.raises(DataError, match="no regular file"):  # it never ends
        files.read_bytes("/dev/zero")
