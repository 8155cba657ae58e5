"""Compiled code: the same numbers as the virtual machine, compiled once, and no surprise without.

Each test has a cache folder of its own.  What needs a compiler is skipped where there is none.
"""

import logging
import os
import subprocess
import sys

import casadi as ca
import numpy as np
import pytest

from apu_casadi import backend, cachefolder
from apu_casadi.errors import BackendError

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
from apu_casadi import backend, cachefolder
c = backend.compiled(pendulum())
assert c.class_name() == "External"
print(repr(backend.Caller(c)(X, P)[0].tolist()))
"""


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
    assert backend.clear_cache() == 1
    assert not list(fresh.iterdir())
    assert np.isfinite(backend.Caller(c)(X, P)[0]).all()


@needs_compiler
def test_level_is_part_of_the_name(monkeypatch):
    """A function compiled at another level is another library; results are the same."""
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
