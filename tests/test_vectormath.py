"""Vector exponentials and the like: the C library's bits, and shared reciprocals."""

import math

import casadi as ca
import numpy as np
import pytest

from apu_casadi.core import backend
from apu_casadi.core.lanes.lanelibrary import batch
from apu_casadi.core.lanes.vectormath import vector_math
from apu_casadi.core.reciprocals import by_reciprocals

SPECIAL = [0.0, -0.0, 1.0, -1.0, np.nan, np.inf, -np.inf, 5e-324, -1e300, 709.5, -745.2, 5e4, 1e5]


@pytest.mark.compiled
@pytest.mark.skipif(backend.find_compiler() is None, reason="no C compiler found")
def test_results_are_the_c_librarys_to_the_last_bit():
    """Ranges of physics, all patterns of bits, next to 1 and to multiples of pi; Python asks libm.

    Where rounding is a close call the lanes ask it too: a hundred thousand arguments meet that
    some thousand times.
    """
    x, y = ca.SX.sym("x"), ca.SX.sym("y")
    names = "exp log sin cos"
    values = [getattr(ca, n)(x) for n in names.split()]
    f = ca.Function("transcendental", [x, y], [ca.vertcat(*values, x**y)])
    rng, n = np.random.default_rng(0), 8000
    a = [rng.uniform(-30, 30, n), 1 + rng.uniform(-0.1, 0.1, n), 10 ** rng.uniform(-9, 9, n)]
    a += [rng.integers(0, 2**64, n, dtype=np.uint64).view(float), rng.uniform(-1e5, 1e5, n)]
    a += [math.pi / 64 * rng.integers(-9999, 9999, n) * (1 + 1e-15 * rng.normal(size=n))]
    a = np.concatenate([*a, np.repeat(SPECIAL, len(SPECIAL))])
    b = np.concatenate([rng.uniform(-3, 3, a.size - 169), np.tile(SPECIAL, len(SPECIAL))])
    got = batch(f, 1)(a[None], b[None])[0]
    right = backend.mapped(backend.compiled(f, backend="c"), 1)(a[None], b[None])[0]
    for name, mine, his in zip([*names.split(), "pow"], got, right, strict=True):
        same = (mine.view(np.int64) == his.view(np.int64)) | (np.isnan(mine) & np.isnan(his))
        assert same.all(), (name, a[~same][:3], b[~same][:3])
    np.testing.assert_array_equal(right[0, :n], [math.exp(v) for v in a[:n]])


def test_tables_are_sums_of_two_doubles():
    """sin^2 + cos^2 = 1 and 2^(j/16)^16 = 2^j, to twice the digits of a double."""
    text = vector_math(4)

    def table(name):
        row = text.split(f"{name}[]={{")[1].split("}")[0].split(",")
        return [int(float.fromhex(v) * 2.0**200) for v in row]

    def both(name):
        pairs = zip(table(f"{name}_hi"), table(f"{name}_lo"), strict=True)
        return [hi + lo for hi, lo in pairs]

    one = 1 << 200
    for s, c in zip(both("sin"), both("cos"), strict=True):
        assert abs(s * s + c * c - one * one) < one * one >> 100
    for j, v in enumerate(both("exp")):
        assert abs(v**16 - (one**16 << j)) < (one**16 << j) >> 98


def test_one_division_for_all_quotients_by_a_number():
    x = ca.SX.sym("x", 4)
    d = ca.exp(x[3])
    f = ca.Function("f", [x], [ca.vertcat(x[0] / d, x[1] / d, ca.sqrt(x[2]) / d, x[0] / x[1], 3)])
    g = by_reciprocals(f)
    count = [h.instruction_id(k) for h in (f, g) for k in range(h.n_instructions())]
    assert count.count(ca.OP_DIV) == 4 + 2
    v = np.array([1.5, 2.5, 3.5, 0.3])
    np.testing.assert_allclose(np.array(g(v)), np.array(f(v)), rtol=1e-15)
    assert ca.GlobalOptions.getSimplificationOnTheFly()
