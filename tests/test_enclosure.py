"""Enclosures of SX functions over boxes, and what is proven by them."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

from nocl.solvers.safeguard.proof import Positive, radius_of
from nocl.translate.enclosure import enclosure

x = ca.SX.sym("x", 3)
COLUMN = ca.vertcat(
    ca.sin(x[0]) * ca.cos(3 * x[1]) + x[2]**3, ca.exp(x[0]) / (2 + x[1]**2), ca.sqrt(x[0] + 5) - ca.fabs(x[1]) * x[2],
    ca.tan(x[0] / 4) + ca.tanh(x[1]), (x[0] + 4)**2.5 + (x[1] + 9)**-3 + ca.cosh(x[2]), ca.fmin(x[0], x[1] * x[2]),
    ca.log(x[0] + 4) * ca.atan(x[1]) - ca.sinh(x[2]) / (5 + ca.sin(x[0])), x[1]**4 - x[2]**-2)


def test_no_value_in_a_box_is_outside():
    rng, f = np.random.default_rng(0), ca.Function("f", [x], [COLUMN])
    low = rng.uniform(-3, 2, (3, 300))
    high = low + rng.uniform(0, 2, (3, 300))
    least, most = enclosure(f, low, high)
    for share in (*rng.uniform(size=(200, 3, 300)), np.zeros(1), np.ones(1)):
        values = f(low + share * (high - low)).full()
        assert (least <= values).all()
        assert (values <= most).all()
    assert np.isfinite(least[:-1]).all()


@pytest.mark.parametrize(("e", "low", "high"), [
    (ca.sin(x[0]), np.sin(0.5), np.sin(1.0)), (ca.sin(2 * x[0]), np.sin(1.0), 1.0),
    (ca.cos(x[0] * 7), np.cos(3.5), 1.0),
    (x[0]**2 - 2 * x[0], 0.25 - 2, 1 - 1.0), (ca.exp(x[0]), np.exp(0.5), np.e), (1 / x[0], 1.0, 2.0)])
def test_bounds_are_those_of_the_operations(e, low, high):
    """Over [0.5, 1]: where x stands once they are the function's own."""
    found = enclosure(ca.Function("f", [x[0]], [e]), np.array([[0.5]]), np.array([[1.0]]))
    np.testing.assert_allclose(np.ravel(found), (low, high), rtol=1e-13, atol=1e-14)
    assert found[0] <= low
    assert found[1] >= high


@pytest.mark.parametrize("e", [1 / x[0], ca.log(x[0]), ca.sqrt(x[0]), ca.tan(2 * x[0]), x[0]**0.5, ca.erf(x[0])])
def test_what_is_not_defined_on_all_of_a_box_or_not_known_may_be_anything(e):
    low, high = enclosure(ca.Function("f", [x[0]], [e]), np.array([[-1.0]]), np.array([[1.0]]))
    assert low == -np.inf
    assert high == np.inf


@pytest.mark.parametrize("n", [1, 2])
def test_a_function_is_proven_positive_as_far_as_it_is(n):
    """|z|^2 - |z|^4 is >= 0 up to |z| = 1, and convex up to |z|^2 = 1 / 6 only."""
    z = ca.SX.sym("z", n)
    e = Positive(ca.sumsqr(z) - ca.sumsqr(z)**2, z)
    assert e.convex(0.3)
    assert not e.convex(0.42)
    assert e.up_to(0.99)
    assert not e.up_to(1.01)


def test_a_saddle_is_not_proven_positive():
    z = ca.SX.sym("z", 2)
    assert not Positive(z[0]**2 - 1e-3 * z[1]**2, z).up_to(0.1)
    assert Positive(z[0]**2 + 1e-3 * z[1]**2, z).up_to(10.0)


def test_rows_are_held_up_to_a_radius():
    z = ca.SX.sym("z", 2)
    assert radius_of(ca.vertcat(1 - 3 * z[0] + 4 * z[1], 2 - z[0]), z, 5.0) == pytest.approx(0.2)
    assert radius_of(ca.vertcat(z[0] - 0.1), z, 1.0) == 0.0
    curved = radius_of(1 - z[0] - z[0]**2, z, 0.7)  # 0 at 0.618
    assert 0.4 < curved <= 0.618
    assert radius_of(ca.SX(0, 1), z, 1.0) == 1.0
