"""Vector lanes: every operation gives the bits of scalar C, and no lane sees another."""

import importlib.util
import re
import subprocess
import sys

import casadi as ca
import numpy as np
import pytest

from apu_casadi.core import backend
from apu_casadi.core.backend import compiled
from apu_casadi.core.errors import BackendError
from apu_casadi.core.lanes import lanelibrary
from apu_casadi.core.lanes.lanelibrary import batch, in_lanes, lanes_in_use, unsupported

pytestmark = [
    pytest.mark.compiled,
    pytest.mark.skipif(backend.find_compiler() is None, reason="no C compiler found"),
]
ONE = """-x|exp(x)|log(x)|sqrt(x)|x*x|2*x|sin(x)|cos(x)|tan(x)|asin(x)|acos(x)|atan(x)|not_(x)
floor(x)|ceil(x)|fabs(x)|sign(x)|erf(x)|1/x|sinh(x)|cosh(x)|tanh(x)|asinh(x)|acosh(x)|atanh(x)
log1p(x)|expm1(x)|0*x+3"""
TWO = """x+y|x-y|x*y|x/y|x**y|x**2.5|x<y|x<=y|x==y|x!=y|and_(x,y)|or_(x,y)|fmod(x,y)|copysign(x,y)
if_else(x,y,0)|if_else(x<y,x,y)|fmin(x,y)|fmax(x,y)|atan2(x,y)|hypot(x,y)|remainder(x,y)"""
SPECIAL = [0.0, -0.0, 1.0, -1.0, np.nan, np.inf, -np.inf, 5e-324, 1e300, -2.5, 0.5, 1e-9]
SOLVER = {"abstol": 0.0, "abstolStep": 1e-9, "max_iter": 9, "error_on_fail": False}


def bits(a):
    """What must be equal: all bits, but those of a NaN."""
    a = np.asarray(a)
    return np.where(np.isnan(a), np.nan, a).tobytes()


def expressions(text, x, y=None):
    names = {k: getattr(ca, k) for k in dir(ca) if not k.startswith("_")}
    names |= {"not_": ca.logic_not, "and_": ca.logic_and, "or_": ca.logic_or, "x": x, "y": y}
    return [eval(e, names) for line in text.split("\n") for e in line.split("|")]


@pytest.fixture(scope="module")
def operations():
    """A function of all operations of SX, and arguments for it, special values among them."""
    x, y = ca.SX.sym("x"), ca.SX.sym("y")
    values = [*expressions(ONE, x), *expressions(TWO, x, y)]
    f = ca.Function("operations", [x, y], [ca.vertcat(*values)])
    rng = np.random.default_rng(0)
    a = np.array([*np.repeat(SPECIAL, len(SPECIAL)), *rng.normal(size=60), *rng.uniform(0, 1, 60)])
    b = np.array([*np.tile(SPECIAL, len(SPECIAL)), *rng.normal(size=120)])
    return f, a[None], b[None]


def graph():
    """An MX function of all that has a form in lanes, with a table in it."""
    x, M, p = ca.MX.sym("x", 6), ca.MX.sym("M", 3, 3), ca.MX.sym("p")
    placed = ca.MX(x)
    placed[[0, 3, 1]] = ca.vertcat(p, p * 2, p)
    other = ca.MX(x)
    other[::2] += x[[0, 1, 0]]
    s, q = ca.SX.sym("s", 2), ca.SX.sym("q")
    inner = ca.Function("inner", [s, q], [ca.exp(-s * q), ca.sum1(s)])
    table = ca.MX(ca.DM(np.arange(12.0).reshape(3, 4) ** 1.5))
    tall = ca.MX(ca.DM(np.arange(152.0).reshape(19, 8) ** 1.5))
    k = ca.low([0.0, 0.3, 0.7, 1.0, 2.0], p)
    k2 = ca.low(list(np.linspace(-3, 3, 9)), p, {"lookup_mode": "binary"})
    lower = ca.DM(ca.Sparsity.lower(3), 1)
    many = inner.map("many", "serial", 3, [1], [])(ca.reshape(x, 2, 3), p)
    a, b = inner(x[:2], p), inner(x[2:4], 3.0)[1]
    outs = [
        *(x[[3, 1, 1, 5]], placed, other, ca.mmax(x), ca.mmin(x), ca.norm_1(x), ca.norm_2(x)),
        *(ca.norm_inf(x), ca.dot(x, x), M[:2, 1:], ca.sum2(M), ca.repmat(x, 1, 3), M @ M.T),
        *(ca.if_else(p > 0, x, 2 * x), ca.diagcat(M, p), ca.triu(M), (lower * M) @ M),
        *(ca.vertsplit(x, 2)[1], ca.horzsplit(M)[2], table[:, k], k2, *a, b, *many),
        *(tall[:, k2], ca.reshape(x, 3, 2) @ ca.reshape(ca.vertcat(x, x)[:10], 2, 5)),
        *(M + p, ca.densify(lower) * p, ca.project(M, ca.Sparsity.lower(3)).T),
    ]
    return ca.Function("graph", [x, M, p], outs)


def newton(name="root"):
    """Newton's method for v^2 = q and v w = 1 as a loop around its step."""
    v, q = ca.SX.sym("v", 2), ca.SX.sym("q")
    r = ca.vertcat(v[0] ** 2 - q, v[0] * v[1] - 1)
    step = ca.Function("step", [v, q], [ca.solve(ca.jacobian(r, v), r)])
    V, Q = step.mx_in()
    loop = ca.Function("loop", [V, Q], [ca.DM.eye(2), step(V, Q)])
    return ca.rootfinder(name, "fast_newton", step, SOLVER | {"jacobian_function": loop})


def side_by_side(f, n, rng):
    return [rng.normal(size=(f.size1_in(i), n * f.size2_in(i))) for i in range(f.n_in())]


def assert_equal_bits(f, made, given):
    """Compare with scalar C, column by column."""
    scalar, n = compiled(f, backend="c"), made.size2_out(0) // f.size2_out(0)
    got = made.call([ca.DM(a) for a in given])
    right = scalar.map(n).call([ca.DM(a) for a in given])
    for a, b, name in zip(got, right, f.name_out(), strict=True):
        assert bits(a.full()) == bits(b.full()), name


@pytest.mark.parametrize("lanes", [2, 4, 8])
def test_every_operation_has_the_bits_of_scalar_c(operations, monkeypatch, lanes):
    monkeypatch.setenv("APU_LANES", str(lanes))
    if lanes_in_use() < lanes:
        pytest.skip("not of this processor")
    f, a, b = operations
    got = batch(f, 1)(a, b)[0]
    right = backend.mapped(compiled(f, backend="c"), 1)(a, b)[0]
    for row, (mine, his) in enumerate(zip(got, right, strict=True)):
        assert bits(mine) == bits(his), f"row {row}: {mine[mine != his]} {his[mine != his]}"


def test_a_graph_has_the_bits_of_scalar_c():
    f, rng = graph(), np.random.default_rng(1)
    assert not unsupported(f)
    n = max(2, lanes_in_use())
    given = side_by_side(f, n, rng)
    given[2][0, 1] = np.nan  # also in a table each lane finds a place
    assert_equal_bits(f, in_lanes(f, lanes=n), given)
    common = in_lanes(f, lanes=n, common=(1,))
    assert common.size_in(1) == f.size_in(1)
    whole = [*given[:1], np.tile(given[1][:, :3], (1, n)), given[2]]
    for a, b in zip(
        common(*given[:1], given[1][:, :3], given[2]), in_lanes(f, lanes=n)(*whole), strict=True
    ):
        assert bits(a.full()) == bits(b.full())


def random_graph(rng, operations=40, n=5):
    """An MX function that reads what it made long ago, in place and by parts, at random."""
    x, y = ca.MX.sym("x", n), ca.MX.sym("y", n)
    inner = ca.SX.sym("a", n), ca.SX.sym("b", n)
    g = ca.Function("g", [*inner], [ca.sin(inner[0]) * inner[1], inner[0] - inner[1]])
    some = [x, y]

    def drawn():
        return some[int(rng.integers(max(0, len(some) - 12), len(some)))]

    for _ in range(operations):
        a, b = drawn(), drawn()
        placed = ca.MX(a)
        placed[[0, n - 1]] = b[:2]
        kinds = [[a + b], [a * 0.5], [placed], g(a, b), [ca.mtimes(ca.diag(a), b)]]
        kinds += [ca.vertsplit(ca.vertcat(a, b), n), [ca.sum1(a) * b], [a[::-1] / (2 + b * b)]]
        kinds += [[ca.sum2(ca.reshape(g.map(2)(ca.repmat(a, 1, 2), ca.horzcat(a, b))[0], n, 2))]]
        some += kinds[int(rng.integers(len(kinds)))]
    return ca.Function("random", [x, y], [some[-1], ca.vertcat(*some[-6:])])


@pytest.mark.parametrize("seed", range(6))
def test_work_that_is_still_read_is_never_written_over(seed):
    """Work vectors share places; one that goes too early would change bits, not shapes."""
    rng = np.random.default_rng(seed)
    f = random_graph(rng)
    x, y = rng.normal(size=(2, 5, 16))
    for a, b in zip(batch(f, 1)(x, y), f.map(16)(x, y), strict=True):
        assert bits(a) == bits(b)


def test_work_does_not_grow_with_the_length_of_a_chain():
    def work(steps):
        x = v = ca.MX.sym("x", 50)
        for k in range(steps):
            v = ca.vertcat(v[10:], ca.sin(v[:10])) * (1 + k)
        text = lanelibrary.source(ca.Function("chain", [x], [v]), 4)
        return int(re.search(r"\*sz_w=(\d+)", text)[1])

    assert work(80) <= 1.5 * work(4)  # gaps between places may stay


def test_newton_lanes_converge_each_in_its_own_time():
    """Starts near and far, one that finds nothing, and one that is not a number."""
    root, n = newton(), 12
    v = ca.MX.sym("v", 2)
    q = ca.MX.sym("q")
    f = ca.Function("found", [v, q], [root(v, q)])
    start = np.array([[1.4, 1.0, 50.0, 1e8, np.nan, 3.0, 0.0, 1.0, 1.0, 2.0, 9.0, 1.0], [1.0] * n])
    asked = np.array([2.0, 2, 2, 2, 2, 9, 2, -1, np.inf, 4, 4, 4])[None]
    got, right = batch(f, 1)(start, asked)[0], backend.mapped(compiled(f, backend="c"), 1)
    assert bits(got) == bits(right(start, asked)[0])
    np.testing.assert_allclose(got[0, [0, 1, 2, 5, 9]], [2**0.5, 2**0.5, 2**0.5, 3, 2])


def test_every_number_of_columns_and_no_lane_sees_another(operations):
    """Remainders; results do not depend on who else is there, NaN neither."""
    f, a, b = operations
    many = batch(f, 1)
    whole, L = many(a, b)[0], max(2, lanes_in_use())
    for n in range(1, 2 * L + 2):
        assert bits(many(a[:, :n], b[:, :n])[0]) == bits(whole[:, :n]), n
    lost = a.copy()
    lost[0, ::3] = np.nan
    kept = np.arange(a.size) % 3 > 0
    assert bits(many(lost, b)[0][:, kept]) == bits(whole[:, kept])
    assert bits(batch(f, 2, chunk=32)(a, b)[0]) == bits(whole)


def test_shapes_are_checked_as_those_of_a_map(operations):
    f, a, b = operations
    common = batch(f, 1, common=(1,))
    assert common(a, b[:, 0])[0].shape == (f.size1_out(0), a.size)
    with pytest.raises(BackendError, match="i1 is common to all columns"):
        common(a, b)
    with pytest.raises(BackendError, match="unequal numbers"):
        batch(f, 1)(a, b[:, :3])


def cross_compiler():
    """Clang for every processor, of the package ziglang."""
    if importlib.util.find_spec("ziglang") is None:
        return None
    return [sys.executable, "-m", "ziglang", "cc"]


@pytest.mark.ci  # seconds each
@pytest.mark.skipif(cross_compiler() is None, reason="no ziglang (pip install ziglang)")
@pytest.mark.parametrize(
    ("target", "lanes", "flags", "products", "words"),
    [
        ("x86_64-linux-gnu", 2, (), r"\tmulpd\t", "%xmm"),
        ("x86_64-linux-gnu", 4, ("-mavx2",), r"\tvmulpd\t.*%ymm", "%ymm"),
        ("x86_64-linux-gnu", 8, lanelibrary.FLAGS[8], r"\tvmulpd\t.*%zmm", "%zmm"),
        ("aarch64-linux-gnu", 2, (), r"\tfmul\tv.*\.2d", ".2d"),
    ],
)
def test_clang_makes_vector_code_for_every_processor(
    operations, tmp_path, target, lanes, flags, products, words
):
    """Compiled to assembly, not run: products are those of vectors, and none is fused."""
    for f in (operations[0], graph(), newton()):
        path = tmp_path / f"{f.name()}.c"
        path.write_text(lanelibrary.source(f, lanes))
        command = [*cross_compiler(), "-target", target, *flags, *lanelibrary.COMMON_FLAGS]
        done = subprocess.run(
            [*command, "-O1", "-fno-math-errno", "-S", "-o", "code.s", path.name],
            cwd=tmp_path,
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 0, done.stderr
        code = (tmp_path / "code.s").read_text(errors="replace")
        assert re.search(products, code) and words in code
        assert lanes == 8 or not re.search(r"\t(vfn?madd|vfn?msub|fmla|fmls)", code)


X2 = ca.MX.sym("x", 2)


@pytest.mark.parametrize(
    ("f", "words"),
    [
        (ca.Function("e", [X2], [ca.erfinv(X2)]).expand(), "e: the operation ERFINV"),
        (ca.Function("s", [X2], [ca.solve(X2 @ X2.T, X2)]), "s: the operation SOLVE"),
        (ca.integrator("i", "cvodes", {"x": X2, "ode": -X2}, 0, 1), "kind CvodesInterface"),
        (ca.Function("m", [X2], [X2[X2[0] * X2]]), "GETNONZEROS_PARAM has a form in lanes only"),
        (ca.rootfinder("n", "newton", {"x": X2, "g": X2**2 - 2}), "kind Newton"),
        (ca.rootfinder("n", "fast_newton", {"x": X2, "g": X2**2 - 2}), "Jacobian is the identity"),
    ],
)
def test_what_has_no_form_is_named(f, words):
    assert words in unsupported(f)


def test_what_has_no_form_is_evaluated_by_map():
    f = ca.Function("f", [X2], [ca.solve(X2 @ X2.T + ca.DM.eye(2), X2)])
    given = np.random.default_rng(0).normal(size=(2, 5))
    right = np.array(compiled(f).map(5)(given))
    assert bits(batch(f, 1)(given)[0]) == bits(right)


@pytest.fixture
def fresh(monkeypatch, tmp_path):
    """An empty cache folder, nothing loaded."""
    monkeypatch.setenv("APU_CACHE_DIR", str(tmp_path / "cache"))
    for name in ("_compiled", "_loaded", "_failed"):
        store = getattr(backend, name)
        monkeypatch.setattr(backend, name, type(store)())
    return tmp_path / "cache"


def small(name):
    x = ca.SX.sym("x", 2)
    return ca.Function(name, [x], [x[0] * x[1]])


def test_without_a_compiler_it_is_a_map(monkeypatch, fresh, tmp_path):
    monkeypatch.delenv("CC", raising=False)
    monkeypatch.setenv("PATH", str(tmp_path))
    assert lanes_in_use() == 1
    assert batch(small("alone"), 1)(np.arange(6.0).reshape(2, 3))[0].tolist() == [[0, 4, 10]]
    assert in_lanes(small("four"), lanes=4).size_in(0) == (2, 4)


def test_a_compiler_that_fails_is_told_once(monkeypatch, fresh, caplog):
    monkeypatch.setenv("APU_LANES", "2")
    monkeypatch.setattr(lanelibrary, "COMMON_FLAGS", ("--no-such-option",))
    made = in_lanes(small("failing"))
    assert made.size_in(0) == (2, 2) and made.class_name() == "Map"
    assert "failing_x2 could not be compiled" in caplog.text
    with backend.use_backend("c"), pytest.raises(BackendError, match="no-such-option"):
        in_lanes(small("failing_too"))


def test_a_damaged_library_is_compiled_again(monkeypatch, fresh, caplog):
    caplog.set_level("INFO")
    monkeypatch.setenv("APU_LANES", "2")
    in_lanes(small("damaged"))
    (path,) = fresh.glob("apu-*.so")
    path.write_bytes(path.read_bytes()[:-100])
    backend._loaded.clear()
    made = in_lanes(small("damaged"))
    assert made.class_name() == "External" and "is damaged" in caplog.text
    assert np.array(made(np.array([[1.0, 2.0], [3.0, 4.0]]))).tolist() == [[3, 8]]


def test_nothing_is_compiled_where_only_loading_is_wanted(monkeypatch, fresh):
    monkeypatch.setenv("APU_LANES", "2")
    f = small("not_built")
    assert in_lanes(f, build=False).class_name() == "Map"
    assert in_lanes(f).class_name() == "External"
    assert in_lanes(f, build=False).class_name() == "External"


def test_the_number_of_lanes_is_checked(monkeypatch):
    monkeypatch.setenv("APU_LANES", "3")
    with pytest.raises(BackendError, match=r"\$APU_LANES = '3': one of \(1, 2, 4, 8\)"):
        lanes_in_use()


@pytest.mark.ci
@pytest.mark.parametrize("what", ["root", "step"])
def test_models_have_the_bits_of_scalar_c(what):
    """The gas generator's Newton iteration with map cells, and a step of the electrical EKF."""
    from apu_casadi.gaspath.gasgenerator import GasGenerator
    from estimators.apu.electrical.electricalfilter import electrical_filter
    from estimators.filters.ekf import ekf_step

    rng, n = np.random.default_rng(0), 2 * max(2, lanes_in_use()) + 1
    if what == "step":
        filt = electrical_filter()
        f = ekf_step(filt.model).function.expand()
        model = filt.model
        m, u = (
            s.nominals[:, None] * (1 + 0.1 * rng.normal(size=(len(s), n)))
            for s in (model.x, model.u)
        )
        P = 1e-2 * np.diag(model.x.nominals**2).reshape(-1, 1)
        p = np.ones((len(model.p), 1))
        given = [m, P, u, p, rng.normal(size=(4, n)), np.ones((4, 1)), np.array([[1e-4]])]
        flat = [ca.SX.sym("q", k) for k in map(f.numel_in, range(f.n_in()))]
        args = [ca.reshape(q, *f.size_in(i)) for i, q in enumerate(flat)]
        f = ca.Function("ekf", flat, [ca.vec(ca.densify(o)) for o in f.call(args)])
    else:
        gg = GasGenerator()
        f = gg.family.solve
        d = gg.design
        z = np.array([*d.z.values(), *(m.beta_des for m in gg.maps)])
        u = gg.U.pack(Wf=d.values["Wf"], PW=d.values["PW"], altitude=0, Mach=0, dT_isa=0, war=0)
        u = u[:, None] * rng.uniform(0.9, 1.1, (u.size, n))
        x = gg.parameters.N * rng.uniform(0.8, 1.05, (1, n))
        given = [z[:, None] * np.ones(n), x, u, gg.full(np.ones(len(gg.THETA)))[:, None]]
    got = batch(f, 1)(*given)
    right = backend.mapped(compiled(f, backend="c"), 1)(*given)
    for a, b in zip(got, right, strict=True):
        assert bits(a) == bits(b) and np.isfinite(a).all()
