"""Compiled code: the same numbers as the virtual machine, compiled once, and no surprise without.

Each test has a cache folder of its own.  What needs a compiler is skipped where there is none.
"""

import gc
import hashlib
import logging
import os
import subprocess
import sys
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

from apu_casadi.core import backend, cachefolder
from apu_casadi.core.errors import BackendError

needs_compiler = pytest.mark.skipif(
    backend.find_compiler() is None, reason="no C compiler ($CC, cc, gcc, clang) found"
)


def pendulum(g=9.81, name="pendulum"):
    """Return a function with everything that matters: MX call of SX, two inputs, two outputs."""
    x, p = ca.SX.sym("x", 2), ca.SX.sym("p")
    inner = ca.Function("inner", [x, p], [ca.vertcat(x[1], -g * ca.sin(x[0]) - p * x[1])])
    X, P = ca.MX.sym("x", 2), ca.MX.sym("p")
    f = inner(X, P)
    return ca.Function(name, [X, P], [f, ca.densify(ca.jacobian(f, X))], ["x", "p"], ["f", "J"])


@pytest.fixture(autouse=True)
def fresh(monkeypatch, tmp_path):
    """Give every test an empty cache folder and forget what the process has compiled."""
    monkeypatch.setenv("APU_CACHE_DIR", str(tmp_path / "cache"))
    monkeypatch.setenv("APU_BACKEND", "auto")
    for store in (backend._compiled, backend._loaded, backend._failed):
        monkeypatch.setattr(backend, _name_of(store), type(store)())
    monkeypatch.setattr(cachefolder, "_said", set())
    monkeypatch.setattr(backend, "_chosen", [None])
    return tmp_path / "cache"


def _name_of(store):
    return next(k for k, v in vars(backend).items() if v is store)


@pytest.fixture
def no_compiler(monkeypatch, tmp_path):
    """A PATH without a compiler."""
    monkeypatch.delenv("CC", raising=False)
    monkeypatch.setenv("PATH", str(tmp_path))


def count_compilations(monkeypatch):
    """Return a list that grows by one with every run of the compiler."""
    runs, real = [], subprocess.run

    def run(*args, **kwargs):
        runs.append(args)
        return real(*args, **kwargs)

    monkeypatch.setattr(backend.subprocess, "run", run)
    return runs


def forget():
    """Forget what is loaded, as a new process would."""
    backend._compiled.clear()
    backend._loaded.clear()


X, P = np.array([0.3, -1.2]), 0.4


@needs_compiler
def test_c_and_vm_agree_to_rounding():
    """Two routes through the same expressions: they differ by the order of roundings only."""
    f = pendulum()
    c = backend.compiled(f)
    assert c is not f and c.class_name() == "External"
    for a, b in zip(backend.Caller(f)(X, P), backend.Caller(c)(X, P), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-14)


@needs_compiler
def test_a_second_call_and_a_second_process_do_not_compile(monkeypatch):
    """The same object comes back at once; a new process finds the library."""
    runs = count_compilations(monkeypatch)
    f = pendulum()
    c = backend.compiled(f)
    assert backend.compiled(f) is c and len(runs) == 1
    forget()
    again = backend.compiled(pendulum())
    assert len(runs) == 1
    assert again.class_name() == "External"


@needs_compiler
def test_content_invalidates(monkeypatch, fresh):
    """Another constant, or another name, is another library."""
    runs = count_compilations(monkeypatch)
    a, b = backend.compiled(pendulum(9.81)), backend.compiled(pendulum(1.62))
    backend.compiled(pendulum(9.81, name="other"))
    assert len(runs) == 3
    assert len(list(fresh.glob("apu-*.so")) + list(fresh.glob("apu-*.dylib"))) == 3
    assert backend.Caller(a)(X, P)[0][1] != backend.Caller(b)(X, P)[0][1]


@needs_compiler
def test_flags_and_compiler_are_part_of_the_name(monkeypatch):
    """A library made otherwise is not taken for this one."""
    runs = count_compilations(monkeypatch)
    backend.compiled(pendulum())
    monkeypatch.setattr(backend, "FLAGS", (*backend.FLAGS, "-O0"))
    forget()
    backend.compiled(pendulum())
    assert len(runs) == 2


@needs_compiler
def test_without_building_only_what_exists_is_loaded(monkeypatch):
    """``build=False`` never waits for a compiler."""
    runs = count_compilations(monkeypatch)
    f = pendulum()
    assert backend.compiled(f, build=False) is f and not runs
    backend.compiled(f)
    forget()
    assert backend.compiled(pendulum(), build=False).class_name() == "External" and len(runs) == 1


@needs_compiler
def test_a_recipe_saves_building_the_expressions(monkeypatch):
    """A known recipe goes to the library without asking for the function; another one asks."""
    backend.load_or_build(backend.recipe("pendulum", 9.81), pendulum)
    forget()

    def never():
        raise AssertionError("built although known")

    assert backend.load_or_build(backend.recipe("pendulum", 9.81), never).class_name() == "External"
    with pytest.raises(AssertionError, match="built"):
        backend.load_or_build(backend.recipe("pendulum", 1.62), never)


@pytest.mark.usefixtures("no_compiler")
def test_without_a_compiler_the_function_itself_comes_back_with_one_line(caplog):
    """The fallback works, and says so once however often it happens."""
    caplog.set_level(logging.INFO, "apu_casadi")
    f, g = pendulum(), pendulum(1.62)
    assert backend.compiled(f) is f and backend.compiled(g) is g
    assert backend.backend_in_use() == "vm"
    assert [r.levelname for r in caplog.records] == ["INFO"]
    assert "no C compiler found" in caplog.text


@pytest.mark.usefixtures("no_compiler")
def test_demanding_c_without_a_compiler_is_refused():
    """The message says what was looked for and what to do."""
    with pytest.raises(BackendError, match=r"no C compiler found .*install one, set CC"):
        backend.compiled(pendulum(), backend="c")
    with backend.use_backend("c"), pytest.raises(BackendError, match="cc, gcc, clang"):
        backend.compiled(pendulum())


def test_a_compiler_that_fails_gives_one_warning(monkeypatch, tmp_path, caplog):
    """The virtual machine serves; nothing is tried a second time."""
    bad = tmp_path / "bad-cc"
    bad.write_text("#!/bin/sh\necho no space left >&2\nexit 3\n")
    bad.chmod(0o755)
    monkeypatch.setenv("CC", str(bad))
    runs = count_compilations(monkeypatch)
    f = pendulum()
    assert backend.compiled(f) is f and backend.compiled(f) is f
    assert len(runs) == 1
    assert [r.levelname for r in caplog.records] == ["WARNING"]
    assert "status 3: no space left" in caplog.text
    with pytest.raises(BackendError, match="no space left"):
        backend.compiled(f, backend="c")


@pytest.mark.long
@needs_compiler
@pytest.mark.parametrize("damage", ["truncated", "changed", "empty", "no sum"])
def test_a_damaged_library_is_compiled_again(monkeypatch, fresh, damage):
    """Loading a truncated library would crash the process; it is not even tried."""
    backend.compiled(pendulum())
    forget()
    (library,) = [p for p in fresh.glob("apu-*") if p.suffix in (".so", ".dylib")]
    content = library.read_bytes()
    # a file of its own, since the one written to is mapped into this process
    library.unlink()
    if damage == "no sum":
        library.write_bytes(content)
        library.with_suffix(".sum").unlink()
    else:
        changed = content[:-1] + bytes([content[-1] ^ 1])
        library.write_bytes({"truncated": content[:3000], "changed": changed, "empty": b""}[damage])
    runs = count_compilations(monkeypatch)
    c = backend.compiled(pendulum())
    assert c.class_name() == "External" and len(runs) == 1
    assert np.all(np.isfinite(backend.Caller(c)(X, P)[0]))


PROCESS = """
import sys
sys.path.insert(0, sys.argv[1])
from test_backend import X, P, pendulum
from apu_casadi.core import backend, cachefolder
c = backend.compiled(pendulum())
assert c.class_name() == "External"
print(repr(backend.Caller(c)(X, P)[0].tolist()))
"""


@pytest.mark.long
@needs_compiler
def test_processes_that_compile_at_once_all_succeed(fresh):
    """Each writes a file of its own and puts it in place in one step."""
    here = os.path.dirname(__file__)
    started = [
        subprocess.Popen(
            [sys.executable, "-c", PROCESS, here], stdout=subprocess.PIPE, stderr=subprocess.PIPE,
            text=True,
        )
        for _ in range(3)
    ]  # fmt: skip
    results = [p.communicate(timeout=120) for p in started]
    assert [p.returncode for p in started] == [0, 0, 0], results
    assert len({out for out, _ in results}) == 1
    assert not [p.name for p in fresh.iterdir() if p.name.startswith("tmp-")]


@needs_compiler
def test_no_folder_to_write_to_falls_back(monkeypatch, tmp_path, caplog):
    """First to a private folder for temporary files, then to the virtual machine."""
    caplog.set_level(logging.INFO, "apu_casadi")
    blocked = tmp_path / "file"
    blocked.write_text("not a folder")
    monkeypatch.setenv("APU_CACHE_DIR", str(blocked / "x"))
    (tmp_path / "tmp").mkdir()
    monkeypatch.setattr(cachefolder.tempfile, "gettempdir", lambda: str(tmp_path / "tmp"))
    assert backend.compiled(pendulum()).class_name() == "External"
    assert backend.cache_folder().parent == tmp_path / "tmp"
    monkeypatch.setattr(cachefolder.tempfile, "gettempdir", lambda: str(blocked))
    f = pendulum(1.62)
    assert backend.compiled(f) is f
    with pytest.raises(BackendError, match="set APU_CACHE_DIR"):
        backend.compiled(f, backend="c")


def test_the_switch(monkeypatch):
    """A call or a block; the environment decides else; a wrong name is refused."""
    f = pendulum()
    with backend.use_backend("vm"):
        assert backend.backend_in_use() == "vm"
        assert backend.compiled(f) is f
    monkeypatch.setenv("APU_BACKEND", "vm")
    assert backend.compiled(f) is f
    assert backend.compiled(f, backend="vm") is f
    with pytest.raises(BackendError, match="unknown backend 'clang'"):
        backend.use_backend("clang")
    monkeypatch.setenv("APU_BACKEND", "cc")
    with pytest.raises(BackendError, match="APU_BACKEND: unknown backend 'cc'"):
        backend.compiled(f)


@needs_compiler
def test_nan_survives():
    """No -ffast-math: what is not a number comes out as such, never as something else."""
    for f in (pendulum(), backend.compiled(pendulum())):
        assert np.isnan(backend.Caller(f)(X, np.nan)[0][1])
        x, p = ca.MX.sym("x", 2), ca.MX.sym("p")
        first = ca.Function("first", [x, p], [f(x, p)[0]])
        (out,) = backend.mapped(first, 1)(np.array([[0.1, np.nan], [0.0, 0.0]]), np.array([1.0]))
        assert not np.isnan(out[1, 0]) and np.isnan(out[1, 1])


def test_caller_checks_sizes_and_spreads_nothing():
    """CasADi spreads scalars over vectors silently; the caller does not."""
    call = backend.Caller(pendulum())
    with pytest.raises(BackendError, match="x has shape \\(2,\\), got \\(\\)"):
        call(1.0, 2.0)
    with pytest.raises(BackendError, match=r"takes 2 arguments \(x, p\), got 1"):
        call(X)
    f, J = call(X.reshape(2, 1), [P])
    assert f.shape == (2,) and J.shape == (2, 2)
    assert J[0, 1] == 1.0 and J[1, 0] == pytest.approx(-9.81 * np.cos(0.3))
    x = ca.MX.sym("x", 2)
    with pytest.raises(BackendError, match="is sparse"):
        backend.Caller(ca.Function("s", [x], [ca.diag(x)]))


def test_caller_returns_copies_unless_told_otherwise():
    """Views are overwritten by the next call, and the docstring says so."""
    safe, quick = backend.Caller(pendulum()), backend.Caller(pendulum(), copy=False)
    a, b = safe(X, P)[0], quick(X, P)[0]
    safe(2 * X, P)
    quick(2 * X, P)
    assert a[0] == X[1] and b[0] == 2 * X[1]


@needs_compiler
def test_what_is_called_a_few_times_needs_no_compiler(monkeypatch):
    """The compiler runs once, when calls are many; a library that is there is loaded at once."""
    runs, f = count_compilations(monkeypatch), pendulum()
    call = backend.Gradual(f)
    made = [call(X, P)[0].tolist() for _ in range(backend.OFTEN - 1)]
    assert not runs and backend.loaded_functions() == []
    made += [call(X, P)[0].tolist() for _ in range(backend.OFTEN)]
    assert len(runs) == 1 and backend.loaded_functions() == ["pendulum"]
    np.testing.assert_allclose(made, np.broadcast_to(made[0], (len(made), 2)), rtol=1e-15)
    again = backend.Gradual(pendulum())
    assert again(X, P)[0].tolist() == made[-1] and len(runs) == 1
    assert again._call.fun.class_name() == "External"


@needs_compiler
def test_what_is_done_rarely_uses_what_is_there_and_compiles_when_it_is_done_often(monkeypatch):
    runs, f = count_compilations(monkeypatch), pendulum()
    monkeypatch.setattr(backend, "_uses", type(backend._uses)())
    monkeypatch.setattr(backend, "RARELY", 3)
    hows = [backend.rarely("one thing") for _ in range(4)]
    assert hows == [backend.READY, backend.READY, None, None]
    assert backend.rarely("another") == backend.READY
    assert backend.compiled(f, backend=hows[0]) is f and not runs
    assert backend.compiled(f, backend=hows[2]).class_name() == "External" and len(runs) == 1
    assert backend.compiled(pendulum(), backend=hows[0]).class_name() == "External"
    with backend.use_backend("vm"):
        assert backend.compiled(f, backend=backend.READY) is f
    assert len(runs) == 1


@pytest.mark.parametrize("n_threads", [1, 2, 3])
@pytest.mark.parametrize("n", [1, 5, 16, 17, 300])
def test_mapped_is_the_function_column_by_column(n, n_threads):
    """Whatever remains after full chunks; a single column is used for all."""
    x, p = ca.MX.sym("x", 2), ca.MX.sym("p", 3)
    f = ca.Function("f", [x, p], [x[0] * p, ca.sum1(x) + p[2]])
    rng = np.random.default_rng(n)
    xs, ps = rng.normal(size=(2, n)), rng.normal(size=3)
    a, b = backend.mapped(f, n_threads, chunk=64)(xs, ps)
    np.testing.assert_allclose(a, np.outer(ps, xs[0]), rtol=1e-15)
    np.testing.assert_allclose(b[0], xs.sum(axis=0) + ps[2], rtol=1e-14)


@needs_compiler
def test_mapped_runs_compiled_code_on_threads():
    """CasADi's thread map with an external function gives what the serial one gives."""
    x = ca.MX.sym("x", 3)
    f = ca.Function("g", [x], [ca.sin(x) / (1 + x**2)])
    c = backend.compiled(f)
    xs = np.random.default_rng(0).normal(size=(3, 2500))
    np.testing.assert_array_equal(backend.mapped(c, 2)(xs)[0], backend.mapped(c, 1)(xs)[0])
    np.testing.assert_allclose(backend.mapped(c, 2)(xs)[0], np.sin(xs) / (1 + xs**2), rtol=1e-14)


def test_mapped_checks_shapes():
    """Unequal lengths and wrong heights are named."""
    x, p = ca.MX.sym("x", 2), ca.MX.sym("p")
    f = backend.mapped(ca.Function("f", [x, p], [x * p], ["x", "p"], ["y"]), 1)
    with pytest.raises(BackendError, match=r"unequal numbers of columns: \[3, 4\]"):
        f(np.ones((2, 3)), np.ones((1, 4)))
    with pytest.raises(BackendError, match=r"x must have shape \(2, N\)"):
        f(np.ones((3, 4)), np.ones(1))
    with pytest.raises(BackendError, match="J must be columns"):
        backend.mapped(pendulum())


@needs_compiler
def test_clear_cache_counts_libraries(fresh):
    """What is loaded stays usable."""
    c = backend.compiled(pendulum())
    assert cachefolder.clear_cache() == 1
    assert not list(fresh.iterdir())
    assert np.isfinite(backend.Caller(c)(X, P)[0]).all()


@needs_compiler
def test_level_is_part_of_the_name(monkeypatch):
    """A function compiled at another level is another library; results are the same."""
    monkeypatch.delenv("APU_OPTIMISE", raising=False)
    runs = count_compilations(monkeypatch)
    f = pendulum()
    first, again, hard = (backend.compiled(f, level=k) for k in (1, 1, 3))
    assert len(runs) == 2 and first is again
    assert "-O1" in runs[0][0] and "-O3" in runs[1][0]
    # -O3 may order sums otherwise
    np.testing.assert_allclose(
        backend.Caller(first)(X, P)[0], backend.Caller(hard)(X, P)[0], rtol=1e-14
    )
    with pytest.raises(BackendError, match=r"level must be one of \(1, 2, 3\), got 4"):
        backend.compiled(f, level=4)
    monkeypatch.setenv("APU_OPTIMISE", "1")
    assert backend.compiled(f, level=3) is first
    monkeypatch.setenv("APU_OPTIMISE", "0")
    with pytest.raises(BackendError, match=r"APU_OPTIMISE = '0': one of \(1, 2, 3\)"):
        backend.compiled(f)


def test_an_input_buffer_filled_in_place_is_taken_as_it_is():
    """The same values as an argument that is copied; other arguments are still checked."""
    f = pendulum()
    call = backend.Caller(f)
    want = backend.Caller(f)(X, P)[0]
    buffer = call.inputs[0]
    buffer[:] = X
    np.testing.assert_array_equal(call(buffer, P)[0], want)
    with pytest.raises(BackendError, match="p has shape"):
        call(buffer, np.zeros(2))


# ------------------------------------------------------------------------------ whose folder

needs_owners = pytest.mark.skipif(not hasattr(os, "getuid"), reason="no owners of files here")

#: A library whose mere loading leaves a mark.
PLANTED = """
#include <stdio.h>
__attribute__((constructor)) static void ran(void) {
    FILE *f = fopen("MARK", "w");
    if (f) fclose(f);
}
"""


@pytest.fixture
def planted(fresh, tmp_path, tmp_path_factory, monkeypatch):
    """A known function's library replaced by one that leaves a mark, with a right sum."""
    other = str(tmp_path_factory.mktemp("other"))
    monkeypatch.setattr(cachefolder.tempfile, "gettempdir", lambda: other)
    backend.compiled(pendulum())
    forget()
    mark, source = tmp_path / "ran", tmp_path / "planted.c"
    source.write_text(PLANTED.replace("MARK", str(mark)))
    (library,) = [p for p in fresh.glob("apu-*") if p.suffix in (".so", ".dylib")]
    library.unlink()
    command = [*backend.find_compiler(), "-shared", "-fPIC", "-o", str(library), str(source)]
    subprocess.run(command, check=True)
    library.chmod(0o700)
    content = library.read_bytes()
    digest = hashlib.sha256(content).hexdigest()
    library.with_suffix(".sum").write_text(f"{len(content)} {digest}\n")
    return mark


@needs_compiler
@needs_owners
def test_the_planted_library_runs_where_the_folder_is_trusted(planted):
    """The trap works: what follows is not refused for another reason."""
    backend.compiled(pendulum())
    assert planted.exists()


def open_folder(folder):
    folder.chmod(0o777)


def open_to_group(folder):
    folder.chmod(0o775)


def sticky(folder):
    folder.chmod(0o1777)


def open_parent(folder):
    folder.parent.chmod(0o777)


def open_link(folder):
    """The folder is reached by a link that stands in a folder open to all."""
    real = folder.with_name("real")
    folder.rename(real)
    (folder.parent / "open").mkdir()
    (folder.parent / "open").chmod(0o777)
    link = folder.parent / "open" / "link"
    link.symlink_to(real)
    folder.symlink_to(link)


def of_another(folder):
    os.chown(folder, 65534, 65534)


def link_of_another(folder):
    real = folder.with_name("real")
    folder.rename(real)
    folder.symlink_to(real)
    os.chown(folder, 65534, 65534, follow_symlinks=False)


def files_of_another(folder):
    for path in folder.iterdir():
        os.chown(path, 65534, 65534)


def open_files(folder):
    for path in folder.iterdir():
        path.chmod(0o666)


NEEDS_ROOT = (of_another, link_of_another, files_of_another)


@pytest.mark.long
@needs_compiler
@needs_owners
@pytest.mark.parametrize(
    "act",
    [open_folder, open_to_group, sticky, open_parent, open_link, open_files, *NEEDS_ROOT],
    ids=lambda f: f.__name__,
)
def test_no_library_runs_that_another_user_could_have_put_there(planted, fresh, caplog, act):
    """Refused with one line, once; a private folder, or compiling again, serves instead."""
    if act in NEEDS_ROOT and os.getuid() != 0:
        pytest.skip("only root gives files away")
    caplog.set_level(logging.INFO, "apu_casadi")
    act(fresh)
    for _ in range(2):
        f = pendulum()
        made = backend.compiled(f)
        assert made.class_name() == "External"
        np.testing.assert_allclose(
            backend.Caller(made)(X, P)[0], backend.Caller(f)(X, P)[0], rtol=1e-14
        )
    assert not planted.exists()
    assert len(caplog.records) == 1, caplog.text
    if act in (open_files, files_of_another):
        assert "compiled again" in caplog.text
    else:
        assert "is refused" in caplog.text and caplog.records[0].levelname == "WARNING"
        assert backend.cache_folder().parent.name.startswith("other")


@needs_compiler
@needs_owners
def test_a_folder_opened_while_the_process_runs_is_refused_from_then_on(planted, fresh):
    """Trust is not remembered."""
    assert backend.cache_folder() == fresh
    fresh.chmod(0o777)
    assert backend.cache_folder() != fresh
    backend.compiled(pendulum())
    assert not planted.exists()


@needs_owners
@pytest.mark.parametrize("variable", ["APU_CACHE_DIR", "XDG_CACHE_HOME"])
def test_each_variable_is_examined(monkeypatch, tmp_path, variable):
    """An open place named by either; new folders are made private, their parents too."""
    monkeypatch.delenv("APU_CACHE_DIR")
    place = tmp_path / "a" / "b"
    monkeypatch.setenv(variable, str(place))
    folder = backend.cache_folder()
    assert folder.is_relative_to(place)
    for p in (folder, place, place.parent):
        assert p.stat().st_mode & 0o077 == 0
    place.chmod(0o777)
    reason = "others can"
    assert reason in cachefolder.unsafe(folder)
    assert not backend.cache_folder().is_relative_to(place)


@needs_owners
def test_loops_and_strange_folders_have_a_reason(tmp_path):
    """No exception, whatever stands there."""
    loop = tmp_path / "loop"
    loop.symlink_to(loop)
    assert "loop of links" in cachefolder.unsafe(loop / "x")
    assert "cannot be examined" in cachefolder.unsafe(tmp_path / "absent" / "x")
    inside = tmp_path / "inside"
    inside.mkdir(mode=0o700)
    (tmp_path / "link").symlink_to("inside")
    assert cachefolder.unsafe(tmp_path / "link" / ".." / "inside") is None


# ------------------------------------------------------------------------------ compilers


@needs_compiler
@pytest.mark.parametrize(
    ("folder", "given"),
    [("my tools", "{}"), ("my tools", "'{}' -O0"), ("it's", "{}"), ("plain", "{} -O0 -DX=1")],
)
def test_a_compiler_with_blanks_or_quotes_in_its_path(monkeypatch, tmp_path, folder, given):
    """The whole of $CC may be one path; else it is words, quoted as in a shell."""
    place = tmp_path / folder
    place.mkdir()
    tool = place / "cc"
    tool.symlink_to(backend.find_compiler()[0])
    monkeypatch.setenv("CC", given.format(tool))
    found = backend.find_compiler()
    assert found[0] == str(tool)
    assert list(found[1:]) == given.split()[1:]
    assert backend.compiled(pendulum()).class_name() == "External"


@pytest.mark.parametrize("text", ["'gcc", '"', "gcc 'x", "  ", "\\\\"])
def test_quotes_that_are_not_closed_are_no_traceback(monkeypatch, text):
    """Nothing is found, or the words are taken as they are."""
    monkeypatch.setenv("CC", text)
    assert backend.compiled(pendulum()) is not None


def test_a_compilers_message_that_is_no_text(monkeypatch, tmp_path, caplog):
    """Bytes that are not UTF-8 stand in the warning as replacements."""
    bad = tmp_path / "bad-cc"
    bad.write_bytes(b'#!/bin/sh\nprintf "\\377\\376 broken" >&2\nexit 1\n')
    bad.chmod(0o755)
    monkeypatch.setenv("CC", str(bad))
    f = pendulum()
    assert backend.compiled(f) is f
    assert "broken" in caplog.text


# ------------------------------------------------------------------------------ what is kept


@needs_compiler
def test_a_library_is_closed_when_nothing_uses_it(fresh):
    """Function, caller, and what was compiled from it; then it is gone from the process."""
    f = pendulum()
    call = backend.Caller(backend.compiled(f))
    batch = backend.mapped(ca.Function("one", f.mx_in(), [backend.compiled(f)(*f.mx_in())[0]]), 1)
    assert len(backend._loaded) == 1 and "pendulum" in backend.loaded_functions()
    call(X, P)
    del f, call
    batch(X, np.array([P]))
    if sys.platform == "linux":
        assert str(fresh) in Path("/proc/self/maps").read_text()
    del batch
    assert not backend._loaded and not backend._compiled
    if sys.platform == "linux":
        assert str(fresh) not in Path("/proc/self/maps").read_text()


def test_units_that_are_gone_keep_nothing_but_the_last_few():
    """However many are made; those in use keep what they have."""
    from apu_casadi import Generator
    from apu_casadi.core import sharing
    from apu_casadi.machine.machinedata import MachineParameters

    held = Generator(MachineParameters(r_s=0.0049))
    space = held.state_space()
    gc.collect()
    before = len(sharing._stores)
    for k in range(3 * sharing.MODELS):
        Generator(MachineParameters(r_s=0.005 + 1e-5 * k)).state_space()
    # without the garbage collector: nothing holds a circle
    assert len(sharing._stores) <= before + sharing.MODELS + 1
    assert len(sharing._recent[Generator]) == sharing.MODELS
    assert held.state_space() is space
    again = Generator(MachineParameters(r_s=0.0049))
    assert again.state_space() is space


def test_results_of_one_model_are_bounded():
    """The longest unused goes first."""
    from apu_casadi.core import sharing

    class Owner:
        pass

    owner, made = Owner(), []
    for k in [0, 1, 2, 0, 3, 0, 1]:
        sharing.keep(owner, "square", k, lambda k=k: made.append(k) or k * k, limit=3)
    assert made == [0, 1, 2, 3, 1]
