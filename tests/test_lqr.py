"""LQR against the Hamiltonian's matrix exponential, the algebraic Riccati equation, and the judge."""

import casadi as ca
import numpy as np
import pytest
from scipy.linalg import expm

import nocl
from nocl.judge import simulate
from nocl.solvers.lqr import LQR


def linear(A, B, running, terminal, horizon=2.0, u_max=100.0, x_goal=None, u_goal=None):
    """xdot = A x + B u with costs given as functions of (x, u) and x."""
    nx, nu = np.shape(B)
    x, u = ca.SX.sym("x", nx), ca.SX.sym("u", nu)
    system = nocl.System("linear", x=x, u=u, xdot=ca.DM(A) @ x + ca.DM(B) @ u, lbu=[-u_max] * nu, ubu=[u_max] * nu,
                         lbx=[-5.0] * nx, ubx=[5.0] * nx)
    return nocl.OCP(system, horizon=horizon, running=running(x, u), terminal=terminal(x), x_goal=x_goal or [0.0] * nx,
                    u_goal=u_goal or [0.0] * nu, initial_states=nocl.Gaussian([0.0] * nx, [1.0] * nx))


A = np.array([[0.1, 1.0, 0.0], [0.3, -0.2, 1.0], [0.0, 0.5, 0.2]])
B = np.array([[0.0, 0.1], [1.0, 0.0], [0.2, 1.0]])
Q, G = np.diag([1.0, 0.5, 0.2]), np.diag([1.0, 2.0, 3.0])
R, S = np.array([[0.3, 0.05], [0.05, 0.2]]), 0.1 * np.ones((3, 2))


def coupled(**kwargs):
    """Costs with a cross term and a constant: V is the quadratic form with P, plus 0.7 (T - t) + 0.4."""
    return linear(A, B, lambda x, u: (x.T @ Q @ x + u.T @ R @ u) / 2 + x.T @ S @ u + 0.7,
                  lambda x: x.T @ G @ x / 2 + 0.4, **kwargs)


def hamiltonian_P(tau):
    """P at tau before the end: the flow of the Hamiltonian system, linear in (x, lambda)."""
    Ri = np.linalg.inv(R)
    F, D = A - B @ Ri @ S.T, Q - S @ Ri @ S.T
    E = expm(-tau * np.block([[F, -B @ Ri @ B.T], [-D, -F.T]]))
    X = E @ np.vstack([np.eye(3), G])
    return X[3:] @ np.linalg.inv(X[:3])


def test_P_is_the_hamiltonian_flow():
    lqr = LQR(coupled())
    for t in (0.0, 0.013, 0.9, 1.77, 1.999, 2.0):
        P = hamiltonian_P(2.0 - t)
        assert lqr.P(t) == pytest.approx(P, abs=1e-8)
        assert lqr.K(t) == pytest.approx(np.linalg.solve(R, B.T @ P + S.T), abs=1e-7)


def test_value_is_what_the_judge_measures():
    ocp = coupled()
    lqr, x0 = LQR(ocp), ocp.initial_states.sample(5, 0)
    for t0 in (0.0, 1.3):
        result = simulate(ocp, lqr, x0, t0=t0)
        assert (result.saturation == 0).all()
        assert result.cost == pytest.approx(lqr.value(x0, t0), rel=1e-7)
    assert lqr.value(x0[0]) == pytest.approx(lqr.value(x0)[0])


@pytest.mark.parametrize("infinite", [False, True])
def test_casadi_policy_is_the_same_and_clipped(infinite):
    ocp = coupled(u_max=0.5)
    lqr = LQR(ocp, infinite=infinite)
    policy, x = lqr.to_casadi(), ocp.initial_states.sample(20, 0)
    for t in (0.0, 0.37, 1.93, 2.0):
        u = lqr(x, t)
        same = policy(x.T, t).full().T
        assert same == pytest.approx(u, abs=1e-10)
        assert np.abs(u).max() == 0.5
        assert lqr(x[3], t) == pytest.approx(u[3])


def test_infinite_horizon_solves_the_algebraic_equation():
    ocp = coupled(horizon=60.0)
    P, K = LQR(ocp, infinite=True).P(), LQR(ocp, infinite=True).K()
    residual = Q + A.T @ P + P @ A - K.T @ R @ K
    assert residual == pytest.approx(np.zeros((3, 3)), abs=1e-10)
    assert np.linalg.eigvals(A - B @ K).real.max() < 0
    assert LQR(ocp).P(0.0) == pytest.approx(P, abs=1e-8)


def test_double_integrator_gain_in_closed_form():
    """L = x1^2 + u^2: K = [1, sqrt 2] (Anderson, Moore, with Hessians twice those coefficients)."""
    ocp = linear([[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]], lambda x, u: x[0] ** 2 + u[0] ** 2, lambda x: x[0] ** 2)
    assert LQR(ocp, infinite=True).K() == pytest.approx(np.array([[1.0, np.sqrt(2)]]), abs=1e-10)


def test_goal_away_from_zero():
    ocp = nocl.load_ocp("quadrotor")
    lqr = LQR(ocp)
    assert lqr(ocp.x_goal) == pytest.approx(ocp.u_goal)
    near = ocp.x_goal + 1e-3
    assert simulate(ocp, lqr, near).cost[0] == pytest.approx(lqr.value(near), rel=1e-2)


@pytest.mark.parametrize(("build", "words"), [
    (lambda: LQR(linear([[1.0]], [[1.0]], lambda x, u: u**2, lambda x: x**2, x_goal=[1.0])), "f is 1 in x"),
    (lambda: LQR(linear([[0.0]], [[1.0]], lambda x, u: (u - 0.1) ** 2, lambda x: x**2)), "gradient of L"),
    (lambda: LQR(linear([[0.0]], [[1.0]], lambda x, u: u**2, lambda x: (x - 1) ** 2)), "gradient of G"),
    (lambda: LQR(linear([[0.0]], [[1.0]], lambda x, u: x**2, lambda x: x**2)), "cost on each control"),
    (lambda: LQR(linear([[1.0]], [[0.0]], lambda x, u: x**2 + u**2, lambda x: x**2), infinite=True), "stabilis"),
    (lambda: LQR(linear([[0.0]], [[1.0]], lambda x, u: u**2, lambda x: x**2), infinite=True), "infinite horizon"),
])
def test_no_lqr(build, words):
    with pytest.raises(ValueError, match=words):
        build()


def test_a_finite_escape_is_told():
    """L = -10 x^2 + u^2: the Riccati solution leaves every bound before t = 0."""
    ocp = linear([[0.0]], [[1.0]], lambda x, u: u**2 - 10 * x**2, lambda x: x**2)
    with pytest.raises(ValueError, match="Riccati"):
        LQR(ocp).P(0.0)


@pytest.mark.parametrize("rate", [1e6, 1e12])
def test_a_plant_that_settles_at_once_has_a_gain(rate):
    """x' = rate (u - x) on a long horizon: the scalar Riccati equation by hand."""
    x, u = ca.SX.sym("x"), ca.SX.sym("u")
    system = nocl.System("fast", x=x, u=u, xdot=rate * (u - x), lbu=[-1], ubu=[1], lbx=[-10], ubx=[10])
    ocp = nocl.OCP(system, horizon=5.0, running=0.1 * u**2 + x**2, terminal=x**2, x_goal=[0], u_goal=[0],
                   initial_states=nocl.Gaussian(mean=[1], std=[0.1]))
    P = 0.2 * (np.sqrt(1 + 10) - 1) / rate
    for lqr in (LQR(ocp), LQR(ocp, infinite=True)):
        assert lqr.P(0.0)[0, 0] == pytest.approx(P, rel=1e-6)
        assert lqr.K(0.0)[0, 0] == pytest.approx(np.sqrt(11) - 1, rel=1e-6)
