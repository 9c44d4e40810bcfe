"""Gains, Hessians and sol(t) of NMPC against Riccati, problems solved again, and an accurate integrator."""

import casadi as ca
import numpy as np
import pytest
from lq import rk4_lq
from test_nmpc import walled

import nocl
from nocl.solvers import NMPC

STEP = 1e-4


def changes(nmpc, x0):
    """(du_0/dx0, d2J*/dx0^2) by central differences of problems solved again from their neighbour's solution."""
    best, n = nmpc.solve(x0), len(x0)
    around = np.array(x0) + STEP * np.vstack([np.eye(n), -np.eye(n)])
    guess = tuple(np.repeat(v, 2 * n, axis=0) for v in (best.x, best.u))
    moved = nmpc.solve(around, guess)
    assert moved.success.all()
    assert moved.cost == pytest.approx(np.full(2 * n, best.cost[0]), rel=0.1)
    derivative = [(v[:n] - v[n:]) / (2 * STEP) for v in (moved.u[:, 0], moved.costate[:, 0])]
    return derivative[0].T, derivative[1].T


def test_linear_quadratic_equals_riccati():
    ocp, N = nocl.load_ocp("double_integrator"), 20
    nmpc = NMPC(ocp, N, starts=1)
    solution = nmpc.solve(ocp.initial_states.sample(2, 0), gains=True)
    _, _, gains, P = rk4_lq(ocp.horizon / N, N)
    for row in range(2):
        assert solution.gain[row] == pytest.approx(-np.array(gains), abs=1e-8)
        assert solution.V_xx[row] == pytest.approx(np.array(P), abs=1e-8)
    assert solution.V_x[:, 0] == pytest.approx(solution.x[:, 0] @ P[0], abs=1e-8)


@pytest.mark.parametrize("name", ["cartpole", "acrobot", "quadrotor"])
def test_gain_and_V_xx_by_differences(name):
    """Acrobot has controls at their bounds on the way."""
    ocp = nocl.load_ocp(name)
    nmpc, x0 = NMPC(ocp, 20, starts=2, solver="ipopt"), ocp.initial_states.sample(1, 1)[0]
    solution = nmpc.solve(x0, gains=True)
    du, ddJ = changes(nmpc, x0)
    assert solution.gain[0, 0] == pytest.approx(du, abs=1e-4 * np.abs(du).max())
    assert solution.V_xx[0, 0] == pytest.approx(ddJ, abs=1e-4 * np.abs(ddJ).max())
    if name == "acrobot":
        assert (np.abs(solution.u) > 4.999).any()


@pytest.mark.parametrize("solver", ["fatrop", "ipopt"])
def test_gains_on_active_bounds_and_an_active_wall(solver):
    """A bound that holds u_0 makes its gain zero; an active wall changes the gains before it."""
    nmpc, x0 = NMPC(walled(-0.1), 30, starts=1, solver=solver), [1.0, -2.6]
    solution = nmpc.solve(x0, gains=True)
    assert (solution.x[0, 1:, 0] < -0.1 + 1e-5).any()
    du, ddJ = changes(nmpc, x0)
    assert solution.gain[0, 0] == pytest.approx(du, rel=1e-3, abs=1e-3)
    assert solution.V_xx[0, 0] == pytest.approx(ddJ, rel=1e-3, abs=1e-3)
    free = NMPC(walled(-3.0), 30, starts=1, solver=solver).solve(x0, gains=True)
    assert np.abs(free.gain[0, 0] - solution.gain[0, 0]).max() > 0.1

    bounded = NMPC(walled(-3.0, u_max=0.3), 30, starts=1, solver=solver)
    held = bounded.solve([1.0, -0.5], gains=True)
    assert (held.gain[0][np.abs(held.u[0]) > 0.3 - 1e-6] == 0).all()
    du, ddJ = changes(bounded, [1.0, -0.5])
    assert np.abs(held.u[0, 0]) > 0.3 - 1e-6
    assert held.gain[0, 0] == pytest.approx(du, abs=1e-5)
    assert held.V_xx[0, 0] == pytest.approx(ddJ, rel=1e-3, abs=1e-4)


def test_gains_round_an_obstacle_by_differences():
    """Dubins: a curved active constraint."""
    ocp = nocl.load_ocp("dubins")
    nmpc, x0 = NMPC(ocp, 40, starts=4), [-3.0, 0.3, -0.2]
    solution = nmpc.solve(x0, gains=True)
    assert (ocp.h(solution.x[0].T).full() < 1e-6).any()
    du, ddJ = changes(nmpc, x0)
    assert solution.gain[0, 0] == pytest.approx(du, abs=2e-3 * np.abs(du).max())
    assert solution.V_xx[0, 0] == pytest.approx(ddJ, abs=2e-3 * np.abs(ddJ).max())


def test_feedback_by_gains_follows_problems_solved_again():
    """u_k + gain_k dx_k is the control of the tail solved again from x_k + dx to second order in dx."""
    ocp, N, k = nocl.load_ocp("cartpole"), 30, 12
    nmpc = NMPC(ocp, N, starts=2)
    best = nmpc.solve(ocp.initial_states.sample(1, 0), gains=True)
    tail, errors = NMPC(ocp, N - k, starts=1), []
    for size in (2e-2, 1e-2):
        dx = size * np.array([1.0, -1.0, 1.0, 1.0])
        u = tail.solve(best.x[:, k] + dx, (best.x[:, k:], best.u[:, k:]), nodes=best.t[0, k:]).u[0, 0]
        errors.append(float(np.abs(u - (best.u[0, k] + best.gain[0, k] @ dx)).max()))
    assert errors[0] / errors[1] == pytest.approx(4.0, rel=0.3)


@pytest.mark.parametrize("name", ["cartpole", "dubins"])
def test_solution_of_time(name):
    """sol(t): nodes exactly; between them x and lambda as an accurate integrator has them."""
    ocp = nocl.load_ocp(name)
    nmpc = NMPC(ocp, 80, starts=2)
    solution = nmpc.solve(ocp.initial_states.sample(2, 3))
    x, u, costate = solution(solution.t[0, :-1])
    assert x == pytest.approx(solution.x[:, :-1], abs=1e-9)
    assert (u == solution.u).all()
    free = np.ones(80, dtype=bool)
    if name == "dubins":  # at an active obstacle the costate jumps, and solution(t) is what holds after the node
        free = (ocp.h(solution.x[:, :-1].reshape(-1, 3).T).full().reshape(2, -1) > 1e-4).all(axis=0)
    assert costate[:, free] == pytest.approx(solution.costate[:, :-1][:, free], abs=1e-6)
    s = ocp.system
    lam = ca.SX.sym("lam", s.nx)
    H = ocp.L(s.x, s.u) + ca.dot(lam, s.xdot)
    flow = ca.integrator("flow", "cvodes", {"x": ca.vertcat(s.x, lam), "p": s.u,
                                            "ode": ca.vertcat(s.xdot, -ca.gradient(H, s.x))},
                         0.0, 0.03, {"reltol": 1e-11, "abstol": 1e-12})
    for k in (0, 30, 55):
        end = flow(x0=np.r_[x[0, k], costate[0, k]], p=u[0, k])["xf"].full().ravel()
        between = solution(solution.t[0, k] + 0.03)
        assert np.r_[between[0][0], between[2][0]] == pytest.approx(end, abs=1e-4)
    assert solution(0.3)[0].shape == (2, s.nx)
    assert solution([0.3, 0.4])[2].shape == (2, 2, s.nx)
    for bad in (-0.1, ocp.horizon + 0.1, [[0.1]]):
        with pytest.raises(ValueError, match="expected a time"):
            solution(bad)


def test_no_strict_optimum_is_nan():
    """A control that costs nothing and does nothing has no gain."""
    x, u = ca.SX.sym("x"), ca.SX.sym("u", 2)
    system = nocl.System("idle", x=x, u=u, xdot=u[0], lbu=[-1, -1], ubu=[1, 1], lbx=[-2], ubx=[2])
    ocp = nocl.OCP(system, horizon=1.0, running=u[0] ** 2, terminal=x**2, x_goal=[0.0], u_goal=[0.0, 0.0],
                   initial_states=nocl.Gaussian([1.0], [0.1]))
    solution = NMPC(ocp, 5, starts=1, solver="ipopt").solve([1.0], gains=True)
    assert solution.success[0]
    assert np.isnan(solution.gain).all()
    assert not np.isnan(solution.V_xx[0, -1]).any()


def test_a_solution_of_another_nmpc_is_refused():
    ocp = nocl.load_ocp("double_integrator")
    with pytest.raises(ValueError, match="of this NMPC"):
        NMPC(ocp, 8).with_gains(NMPC(ocp, 5).solve([1.0, 0.0]))
