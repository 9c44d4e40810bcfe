"""Random constraints in DDP, of states and controls, in balls and cones: IPOPT's optimum on the same nodes; units."""

from functools import lru_cache

import casadi as ca
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

import nocl
from nocl.solvers import DDP, NMPC

K = 12
UNITS = (1.0, 1e-3, 1e4)  # that the rows are written in


@lru_cache
def linear(unit: float = 1.0) -> nocl.OCP:
    """x' = A x + B u with a half plane of (x, u), an ellipse of x, a ball and a cone of u, all of it parameters."""
    x, u = ca.SX.sym("x", 2), ca.SX.sym("u", 2)
    p = [nocl.parameter(f"p{i}", nominal=0.5) for i in range(16)]
    A, B = ca.reshape(ca.vertcat(*p[:4]), 2, 2), ca.SX.eye(2) + ca.reshape(ca.vertcat(*p[4:8]), 2, 2)
    system = nocl.System("linear", x=ca.vertcat(x[0], x[1]), u=ca.vertcat(u[0], u[1]), xdot=A @ x + B @ u,
                         p=ca.vertcat(*p[:8]), lbu=[-2, -2], ubu=[2, 2], lbx=[-3, -3], ubx=[3, 3])
    plane, offset, axes, radius, slope = p[8:12], p[12], p[13], p[14], p[15]
    rows = {"plane": ca.dot(ca.vertcat(*plane), ca.vertcat(x, u)) + offset,
            "ellipse": 4 - x[0]**2 - (0.5 + axes**2) * x[1]**2,
            "ball": (0.7 + radius)**2 - ca.sumsqr(u),
            "cone": u[0] + 1.2 - ca.sqrt((0.3 + slope)**2 * u[1]**2 + 1e-2)}
    return nocl.OCP(system, horizon=1.5, running=ca.sumsqr(x) + 0.1 * ca.sumsqr(u), terminal=2 * ca.sumsqr(x - 0.3),
                    x_goal=[0, 0], u_goal=[0, 0], initial_states=nocl.Uniform([-1, -1], [1, 1]),
                    p=ca.vertcat(*p[8:]), parameters=nocl.Uniform([-1] * 12 + [0] * 4, [1] * 16),
                    constraints={name: unit * c for name, c in rows.items()})


def drawn(seed: int, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Initial states [n, 2], and parameters [n, 16] at which they, with u = 0, hold all rows."""
    rng, ocp = np.random.default_rng(seed), linear()
    x0, p = rng.uniform(-1, 1, (n, 2)), rng.uniform(*ocp.parameter_box, (n, 16))
    p[:, 12] = np.clip(0.1 - (p[:, 8:10] * x0).sum(axis=1), 0.0, 1.0)
    return x0, p


@lru_cache
def solver(unit: float = 1.0) -> DDP:
    ddp = DDP(linear(unit), intervals=K, substeps=1, threads=1)
    ddp.checked = True
    return ddp


def values(ocp: nocl.OCP, s) -> np.ndarray:
    """The rows at each node under its control [B, K, rows], as shares of their scales; those of x at node 0 are given.
    """
    n, of = len(s) * K, ocp.functions
    at = of.arguments.columns(x=s.x[:, :-1].reshape(n, -1), u=s.u.reshape(n, -1), p=np.repeat(s.p, K, axis=0))
    c = of.c(*at).full().T.reshape(len(s), K, -1)
    c[:, 0, ~of.rows.of_u] = np.inf
    return c


@settings(max_examples=6, deadline=None, derandomize=True)
@given(st.integers(0, 2**31))
def test_the_optimum_is_ipopts(seed):
    x0, p = drawn(seed, 12)
    s = solver().solve(x0, p=p)
    assert s.success.mean() >= 0.5  # of these twelve some can hold no plane
    c = values(linear(), s)[s.success]
    assert c.min() >= -1e-9
    row = int(np.flatnonzero(s.success)[(c < 1e-6).sum(axis=(1, 2)).argmax()])  # that with most active rows
    exact = {"ipopt.tol": 1e-12, "ipopt.bound_relax_factor": 0.0}  # by default bounds give way, worth 2e-7 of the cost
    nmpc = NMPC(linear(), K, substeps=1, solver="ipopt", passes=0, options=exact)
    other = nmpc.solve(x0[row], s[row], p=p[row], workers=1)
    assert other.success[0]
    np.testing.assert_allclose(s.cost[row], other.cost[0], rtol=1e-7)
    np.testing.assert_allclose(s.V_x[row], other.V_x[0], rtol=0, atol=1e-5 * np.abs(other.V_x).max())


def test_each_kind_of_row_is_active_somewhere():
    x0, p = drawn(0, 60)
    s = solver().solve(x0, p=p)
    c = values(linear(), s[s.success])
    active = dict(zip(linear().functions.rows.names, (np.abs(c) < 1e-9).any(axis=1).sum(axis=0), strict=True))
    assert min(active[name] for name in ("plane", "ball", "cone")) > 3, active


@settings(max_examples=3, deadline=None)
@given(st.integers(0, 2**31))
def test_units_of_the_rows_change_nothing(seed):
    x0, p = drawn(seed, 6)
    first, *others = (solver(unit).solve(x0, p=p) for unit in UNITS)
    for s in others:
        assert np.array_equal(s.success, first.success)
        kept = s.success
        np.testing.assert_allclose(s.cost[kept], first.cost[kept], rtol=1e-8)
        np.testing.assert_allclose(s.V_x[kept], first.V_x[kept], rtol=0, atol=1e-6 * np.abs(first.V_x[kept]).max())
