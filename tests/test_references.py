"""References in time: splines through samples, and tracking them with one policy of (x, t, p)."""

import casadi as ca
import numpy as np
import pytest
import torch
from scipy.interpolate import CubicSpline, RectBivariateSpline

import nocl
from nocl.solvers import DDP, NMPC


@pytest.mark.parametrize("n", [2, 3, 4, 5, 12, 40])
def test_the_spline_is_scipys_and_linear_in_its_values(n):
    rng = np.random.default_rng(n)
    times, values = np.cumsum(rng.uniform(0.1, 1.0, n)) + 3.0, rng.standard_normal(n)
    t, p = nocl.time(), ca.vertcat(*(nocl.parameter(f"r{i}") for i in range(n)))
    e = nocl.spline(t, times, p)
    at = np.linspace(times[0] - 0.1, times[-1] + 0.1, 200)
    f = ca.Function("r", [t, p], [e, ca.gradient(e, t), ca.jacobian(e, p)])
    r, slope, by_p = (v.full() for v in f(at[None], np.tile(values[:, None], (1, 200))))
    truth = CubicSpline(times, values)
    np.testing.assert_allclose(r[0], truth(at), rtol=1e-8, atol=1e-9)
    np.testing.assert_allclose(slope[0], truth(at, 1), rtol=1e-7, atol=1e-8)
    np.testing.assert_allclose(by_p.reshape(200, n) @ values, r[0], rtol=1e-8, atol=1e-8)
    numbers = ca.Function("r", [t], [nocl.spline(t, times, values)])(at[None]).full()
    np.testing.assert_allclose(numbers, r, rtol=1e-9, atol=1e-10)


@pytest.mark.parametrize(("times", "values", "words"), [
    ([0.0], [1.0], "times is"), ([0.0, 0.0], [1, 2], "rise"), ([0, 1, np.nan], [1, 2, 3], "times is"),
    ([0, 1, 2], [1, 2], "values"), ([[0, 1]], [1, 2], "times is"), ("ab", [1, 2], "times")])
def test_what_a_spline_refuses(times, values, words):
    with pytest.raises(ValueError, match=words):
        nocl.spline(nocl.time(), times, values)


def test_tables_of_one_and_two_variables_are_splines_that_all_layers_take():
    """A grid of values as a spline of splines is scipy's bicubic one; f, torch and a solution have its values."""
    a, b, grid = ca.SX.sym("a"), ca.SX.sym("b"), np.linspace(-1, 1, 9)
    values = np.sin(2 * grid[:, None]) * np.cos(grid[None])
    rows = [nocl.spline(b, grid, row) for row in values]
    table = nocl.spline(a, grid, ca.vertcat(*rows))
    at = np.random.default_rng(0).uniform(-1, 1, (50, 2))
    f = ca.Function("f", [ca.vertcat(a, b)], [table, ca.gradient(table, ca.vertcat(a, b))])
    truth, found = RectBivariateSpline(grid, grid, values), [v.full() for v in f(at.T)]
    np.testing.assert_allclose(found[0][0], truth(*at.T, grid=False), atol=1e-9)
    np.testing.assert_allclose(found[1][0], truth(*at.T, dx=1, grid=False), atol=1e-8)
    np.testing.assert_allclose(found[1][1], truth(*at.T, dy=1, grid=False), atol=1e-8)
    u = ca.SX.sym("u")
    s = nocl.System("table", x=ca.vertcat(a, b), u=u, xdot=ca.vertcat(b, u - table), lbu=[-1], ubu=[1], lbx=[-1, -1],
                    ubx=[1, 1])
    torch_f = nocl.to_torch(s.f)(torch.from_numpy(at), torch.zeros(50, 1, dtype=torch.float64))
    np.testing.assert_allclose(torch_f[:, 1].numpy(), -truth(*at.T, grid=False), atol=1e-9)
    ocp = nocl.OCP.quadratic(s, horizon=2.0, x_goal=[0, 0], u_goal=[0],
                             initial_states=nocl.Gaussian([0.5, 0.2], [0.1, 0.1]))
    x0 = ocp.initial_states.sample(2, 0)
    plan, other = DDP(ocp, intervals=20, substeps=1).solve(x0), NMPC(ocp, 20, substeps=1).solve(x0, progress=False)
    assert plan.success.all()
    np.testing.assert_allclose(plan.cost, other.cost, rtol=1e-7)


def test_a_reference_of_samples_is_tracked_and_its_slope_by_each_sample_is_right():
    """With next to no cost of control the cart is at r(t), and dJ*/dp are finite differences."""
    x, u, t = ca.vertcat(ca.SX.sym("pos"), ca.SX.sym("v")), ca.SX.sym("force"), nocl.time()
    nodes = np.linspace(0, 2, 5)
    samples = ca.vertcat(*(nocl.parameter(f"r{i}", unit="m") for i in range(5)))
    r = nocl.spline(t, nodes, samples)
    s = nocl.System("cart", x=x, u=u, xdot=ca.vertcat(x[1], u), lbu=[-50], ubu=[50], lbx=[-5, -50], ubx=[5, 50])
    ocp = nocl.OCP(s, p=samples, horizon=2.0, running=(x[0] - r) ** 2 + 1e-6 * u**2, terminal=0 * x[0],
                   x_goal=[0, 0], u_goal=[0], initial_states=nocl.Gaussian([0, 0], [0.1, 0.1]),
                   parameters=nocl.Uniform([-1] * 5, [1] * 5))
    p = np.array([[0.0, 0.8, -0.5, 0.3, 0.9], [0.1, -0.9, 0.2, 0.6, 0.0]])
    truth = CubicSpline(nodes, p.T)
    x0 = np.stack([truth(0.0), truth(0.0, 1)], axis=1)
    found = DDP(ocp, intervals=80).solve(x0, p=p)
    assert found.success.all()
    np.testing.assert_allclose(found.x[:, :, 0], truth(found.t[0]).T, atol=2e-2)
    for i in range(5):
        step = 1e-4 * np.eye(5)[i]
        up, down = (DDP(ocp, intervals=80).solve(x0, p=p + sign * step, u=found.u).cost for sign in (1, -1))
        np.testing.assert_allclose(found.V_p[:, i], (up - down) / 2e-4, rtol=2e-3, atol=2e-6)
