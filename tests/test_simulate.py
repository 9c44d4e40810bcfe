"""The judge against closed forms, matrix exponentials and scipy; failures stay in their own row."""

import subprocess
import sys
from itertools import pairwise

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm

import nocl
from nocl.judge import simulate
from nocl.solvers import LQR
from nocl.systems import double_integrator, dubins


def scalar(xdot=lambda x, u: u, running=lambda x, u: x**2 + u**2, horizon=2.0, u_max=1.0):
    """One state, one control."""
    x, u = ca.SX.sym("x"), ca.SX.sym("u")
    system = nocl.System("scalar", x=x, u=u, xdot=xdot(x, u), lbu=[-u_max], ubu=[u_max], lbx=[-3.0], ubx=[3.0])
    return nocl.OCP(system, horizon=horizon, running=running(x, u), terminal=5 * x**2, x_goal=[0.0], u_goal=[0.0],
                    initial_states=nocl.Gaussian([0.0], [1.0]))


def policy(expression, nx=1):
    x, t = ca.MX.sym("x", nx), ca.MX.sym("t")
    return ca.Function("policy", [x, t], [expression(x, t)])


DECAY = policy(lambda x, t: -x)
X0 = np.array([[0.5], [-0.9], [0.2]])


def test_linear_feedback_is_exact():
    """u = -x on xdot = u: x = x0 e^-t, L = 2 x^2, ||u|| = |x|."""
    result = simulate(scalar(), DECAY, X0, nodes=21)
    x0, decay = X0[:, 0], np.exp(-result.t)
    assert result.success.all()
    assert result.x[:, :, 0] == pytest.approx(x0[:, None] * decay, abs=1e-8)
    assert result.u == pytest.approx(-result.x, abs=1e-12)
    assert result.running_cost == pytest.approx(x0**2 * (1 - np.exp(-4)), abs=1e-8)
    assert result.terminal_cost == pytest.approx(5 * x0**2 * np.exp(-4), abs=1e-8)
    assert result.cost == pytest.approx(result.running_cost + result.terminal_cost)
    assert result.terminal_error == pytest.approx(np.abs(x0) / 3 * np.exp(-2), abs=1e-8)
    assert result.control_magnitude == pytest.approx(np.abs(x0) * (1 - np.exp(-2)) / 2, abs=1e-6)
    assert (result.saturation == 0).all()
    assert (result.clearance == np.inf).all()


def test_kicks_restart_the_feedback():
    """x jumps by dx at t = 0.5, between two nodes, and at node t = 1."""
    dx = np.array([[0.1], [0.2], [-0.3]])
    result = simulate(scalar(), DECAY, X0, nodes=4 * 2 + 2, kicks=[(1.0, [0.05]), (0.5, dx)])
    end = ((X0 * np.exp(-0.5) + dx) * np.exp(-0.5) + 0.05) * np.exp(-1)
    assert result.x[:, -1] == pytest.approx(end, abs=1e-8)
    held = simulate(scalar(), DECAY, X0, hold=4, kicks=[(0.6, dx), (1.0, [0.05])])
    x = X0 * 0.5  # t = 0.5, under u = -x held
    x = x - 0.5 * x + dx  # the kick comes within the interval: its control is held on
    x = (x + 0.05) * 0.5 * 0.5
    assert held.x[:, -1] == pytest.approx(x, abs=1e-8)


def test_a_kick_at_a_node_is_in_the_record():
    result = simulate(scalar(), DECAY, X0, nodes=5, kicks=[(0.0, [0.1]), (1.0, [0.2]), (2.0, [0.3])])
    assert result.x[:, 0] == pytest.approx(X0 + 0.1)
    middle = (X0 + 0.1) * np.exp(-1) + 0.2
    assert result.x[:, 2] == pytest.approx(middle, abs=1e-8)
    assert result.x[:, -1] == pytest.approx(middle * np.exp(-1) + 0.3, abs=1e-8)


def test_a_tail_costs_what_the_whole_has_left():
    ocp = nocl.load_ocp("pendulum")
    u = policy(lambda x, t: -2 * x[0] - ca.sin(t), 2)
    whole = simulate(ocp, u, [0.3, 0.1], nodes=31)
    tail = simulate(ocp, u, whole.x[:, 10], t0=float(whole.t[10]), nodes=21)
    assert tail.t == pytest.approx(whole.t[10:])
    assert tail.x == pytest.approx(whole.x[:, 10:], abs=2e-6)
    assert tail.terminal_cost == pytest.approx(whole.terminal_cost, rel=2e-6)


@pytest.mark.parametrize("hold", [None, 40])
def test_cartpole_equals_scipy(hold):
    """States, running cost and mean ||u|| of a nonlinear, time-varying, saturating feedback."""
    ocp = nocl.load_ocp("cartpole")
    s, x0 = ocp.system, ocp.initial_states.sample(3, 0)
    feedback = policy(lambda x, t: 2 * ca.sin(3 * x[2]) - x[1] + t, 4)
    result = simulate(ocp, feedback, x0, hold=hold)

    def rhs(t, z, u=None):
        v = np.clip(feedback(z[:4], t).full().ravel() if u is None else u, s.lbu, s.ubu)
        return np.r_[s.f(z[:4], v).full().ravel(), 0.01 * v @ v, np.abs(v).sum()]

    for i, x in enumerate(x0):
        z, edges = np.r_[x, 0, 0], np.linspace(0, 4, (hold or 1) + 1)
        for a, b in pairwise(edges):
            u = None if hold is None else feedback(z[:4], a).full().ravel()
            z = solve_ivp(rhs, (a, b), z, args=(u,), rtol=1e-11, atol=1e-12, method="DOP853").y[:, -1]
        assert result.x[i, -1] == pytest.approx(z[:4], abs=2e-6)
        assert result.running_cost[i] == pytest.approx(z[4], abs=1e-7)
        assert result.control_magnitude[i] * 4 == pytest.approx(z[5], abs=1e-4)


def test_a_short_pulse_is_not_stepped_over():
    """x' = u and u = 1 from 2.0 to 2.15 alone: all derivatives are 0 before, and steps would grow across it."""
    x, u, t = ca.SX.sym("x"), ca.SX.sym("u"), ca.SX.sym("t")
    system = nocl.System("hold", x=x, u=u, xdot=u, lbu=[-1], ubu=[1], lbx=[-1], ubx=[1])
    ocp = nocl.OCP(system, horizon=4.0, running=u**2, terminal=x**2, x_goal=[0], u_goal=[0],
                   initial_states=nocl.Gaussian([0], [0.1]))
    law = ca.Function("law", [x, t], [ca.if_else(ca.fabs(t - 2.075) < 0.075, 1.0, 0.0)], ["x", "t"], ["u"])
    assert nocl.simulate(ocp, law, [[0.0]], nodes=41).x[0, -1, 0] == pytest.approx(0.15, abs=1e-6)


def test_sampled_feedback_is_the_exact_discretisation():
    """Double integrator, u = -k x held: x+ = (Ad - Bd k) x with the matrix exponential."""
    ocp = nocl.load_ocp("double_integrator")
    A, B = ocp.system.linearize(ocp.x_goal, ocp.u_goal)
    k, K = np.array([[1.0, 1.5]]), 10
    x0 = ocp.initial_states.sample(4, 0)
    E = expm(np.block([[A, B], [np.zeros((1, 3))]]) * ocp.horizon / K)
    x = x0
    for _ in range(K):
        x = x @ (E[:2, :2] - E[:2, 2:] @ k).T
    asked = []

    def controller(x, t):
        asked.append((x.shape, t))
        return -x @ k.T

    result = simulate(ocp, controller, x0, hold=K)
    assert result.x[:, -1] == pytest.approx(x, abs=1e-8)
    assert asked == [((4, 2), pytest.approx(ocp.horizon * i / K)) for i in range(K)]
    same = simulate(ocp, policy(lambda x, t: -k @ x, 2), x0, hold=K)
    assert same.cost == pytest.approx(result.cost, rel=1e-12)
    again = simulate(ocp, result.u[:, :-1], x0)
    assert again.cost == pytest.approx(result.cost, rel=1e-12)
    assert (again.u == result.u).all()
    assert (result.u[:, -1] == result.u[:, -2]).all()


def test_controls_are_clipped_and_saturation_counted():
    ocp = scalar(u_max=0.5)
    for controller in (policy(lambda x, t: 7.0), lambda x, t: np.full((len(x), 1), 7.0), np.full((3, 5, 1), 7.0)):
        result = simulate(ocp, controller, X0)
        assert result.x[:, -1] == pytest.approx(X0 + 1.0, abs=1e-8)
        assert result.control_magnitude == pytest.approx(0.5)
        assert result.saturation == pytest.approx(1.0)
        assert (result.u == 0.5).all()
    half = simulate(ocp, policy(lambda x, t: ca.if_else(t < 1, 7.0, 0.0)), X0, hold=10)
    assert half.saturation == pytest.approx(0.5)


def test_a_blow_up_fails_alone_and_says_when():
    """xdot = x^2 from 1 ends at t = 1; its neighbours go on."""
    ocp = scalar(xdot=lambda x, u: x**2 + u)
    x0 = np.array([[0.1], [1.0], [-1.0]])
    for controller, hold in ((policy(lambda x, t: 0), None), (policy(lambda x, t: 0), 20), (np.zeros((3, 8, 1)), None)):
        result = simulate(ocp, controller, x0, hold=hold)
        assert result.success.tolist() == [True, False, True]
        assert "blows up" in result.message[1]
        assert " and 1," in result.message[1]  # the time
        assert result.cost[1] == np.inf
        assert np.isnan(result.x[1, -1]).all()
        assert np.isfinite(result.x[1, 0]).all()
        alone = simulate(ocp, controller[:1] if isinstance(controller, np.ndarray) else controller, x0[0], hold=hold)
        assert result.cost[0] == alone.cost[0]


def test_a_nan_control_fails_alone():
    ocp = scalar()
    held = simulate(ocp, lambda x, t: np.where((t > 0.9) & (x > 0.3), np.nan, 0 * x), X0, hold=10)
    assert held.success.tolist() == [False, True, True]
    assert "NaN at t = 1," in held.message[0]
    inside = simulate(ocp, policy(lambda x, t: -0.1 * ca.sqrt(0.3 - x)), X0)
    assert inside.success.tolist() == [False, True, True]
    assert "NaN" in inside.message[0]
    u = np.zeros((3, 4, 1))
    u[2, 1] = np.nan
    assert simulate(ocp, u, X0).success.tolist() == [True, True, False]


def test_stiff_feedback():
    """u = -3000 x: Adams would need 6000 steps; the answer is x0 e^(-3000 t) all the same."""
    ocp = scalar(u_max=1e4)
    result = simulate(ocp, policy(lambda x, t: -3000 * x), X0)
    assert result.success.all()
    assert result.running_cost == pytest.approx(X0[:, 0] ** 2 * (1 + 3000**2) / 6000, rel=1e-6)


def test_clearance_and_cost_without_penalty():
    """Dubins' car straight through the obstacle's centre: clearance -radius at best, and L has no penalty."""
    ocp = nocl.load_ocp("dubins")
    u = np.tile([1.0, 0.0], (2, 40, 1))
    result = simulate(ocp, u, [[-3.0, 0.0, 0.0], [-3.0, 2.0, 0.0]])
    assert result.clearance == pytest.approx([-0.5, 1.5], abs=2e-3)
    assert result.running_cost == pytest.approx(0.01 * 8.0)


def test_another_plant():
    x, u = ca.MX.sym("x"), ca.MX.sym("u")
    plant = ca.Function("f", [x, u], [2 * u])

    class Learned:
        def to_casadi(self):
            return plant

    for f in (plant, Learned()):
        for hold in (None, 400):
            result = simulate(scalar(), DECAY, X0, f=f, hold=hold)
            assert result.x[:, -1] == pytest.approx(X0 * np.exp(-4), abs=1e-8 if hold is None else 1e-3)


@pytest.mark.parametrize(("kwargs", "words"), [
    ({"x0": np.zeros((2, 3))}, "nx = 1"),
    ({"x0": [[np.nan]]}, "finite"),
    ({"controller": np.zeros((2, 4, 1))}, r"\[B, K, nu\]"),
    ({"controller": np.zeros((3, 4, 1)), "hold": 5}, "K = 4"),
    ({"controller": 3.0}, "callable"),
    ({"controller": lambda x, t: np.zeros(3)}, "answered with shape"),
    ({"controller": ca.Function("p", [ca.MX.sym("x", 2), ca.MX.sym("t")], [ca.MX(1)])}, "the policy p"),
    ({"hold": 0}, "hold is 0"),
    ({"nodes": 1}, "nodes is 1"),
    ({"t0": 2.0}, "t0 is 2.0"),
    ({"kicks": [(0.5, np.zeros(2))]}, "kick at t = 0.5"),
    ({"kicks": [(3.0, np.zeros(1))]}, "kick at t = 3"),
    ({"f": "exact"}, "the dynamics are a str"),
])
def test_bad_input(kwargs, words):
    given = {"controller": DECAY, "x0": X0, **kwargs}
    with pytest.raises(ValueError, match=words):
        simulate(scalar(), given.pop("controller"), given.pop("x0"), **given)


def test_the_judge_needs_no_torch():
    code = "import sys, nocl.judge; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_control_magnitude_does_not_depend_on_the_nodes():
    """It is integrated under the same error control as the states."""
    from nocl.solvers import LQR

    ocp = nocl.load_ocp("double_integrator")
    x0, controller = ocp.initial_states.sample(4, 2), LQR(ocp)
    fine = simulate(ocp, controller, x0, nodes=4001)
    trapezoid = np.trapezoid(np.linalg.norm(fine.u, axis=2), fine.t, axis=1) / ocp.horizon
    for nodes in (5, 81):
        np.testing.assert_allclose(simulate(ocp, controller, x0, nodes=nodes).control_magnitude, trapezoid, rtol=1e-5)


def test_constraints_are_judged_between_nodes():
    """Dubins' car drives from (-2, 0) straight through the obstacle at (-1, 0): at both nodes it is well outside."""
    ocp = dubins.ocp(horizon=2.0)
    straight = np.array([[[1.0, 0.0]]])
    assert simulate(ocp, straight, [-2.0, 0.0, 0.0]).clearance == pytest.approx([-0.5], abs=2e-3)
    x, t = ca.MX.sym("x", 3), ca.MX.sym("t")
    policy = ca.Function("policy", [x, t], [ca.MX([1.0, 0.0])])
    result = simulate(ocp, policy, [-2.0, 0.0, 0.0], nodes=2)
    assert result.clearance == pytest.approx([-0.5], abs=2e-3)
    assert result.x.shape == (1, 2, 3)


def test_a_delayed_control_acts_late():
    """x' = v, v' = u: u = 0, 1, 2, 3 in turn on [0, 2], each but the first a quarter of an interval late."""
    ocp, h, delay = double_integrator.ocp(), 0.5, 0.125
    late = simulate(ocp, lambda x, t: np.full((len(x), 1), round(t / h)), [[0.0, 0.0]], hold=4, delay=delay)
    switches = np.r_[0.0, h * np.arange(1, 4) + delay, 2.0]
    v = np.sum(np.diff(switches) * np.arange(4))
    assert late.x[0, -1, 1] == pytest.approx(v, rel=1e-8)
    whole = simulate(ocp, lambda x, t: np.full((len(x), 1), round(t / h)), [[0.0, 0.0]], hold=4, delay=h)
    assert whole.x[0, -1, 1] == pytest.approx(h * (0 + 0 + 1 + 2), rel=1e-8)


def test_a_delay_that_cannot_be_is_refused():
    ocp = double_integrator.ocp()
    with pytest.raises(ValueError, match="delay is"):
        simulate(ocp, lambda x, t: np.zeros((len(x), 1)), [0.0, 0.0], hold=4, delay=0.6)
    with pytest.raises(ValueError, match="give `hold`"):
        simulate(ocp, LQR(ocp), [0.0, 0.0], delay=0.1)


@pytest.mark.parametrize("control", [np.zeros((1, 4, 1)), lambda x, t: 0 * x])
def test_chattering_is_no_blow_up(control):
    """x' = -sign(x) + u reaches 0 at t = 1 and stays: CVODES gives up there, and the state is where it should be."""
    s, u = ca.SX.sym("s"), ca.SX.sym("u")
    system = nocl.System("sliding", x=s, u=u, xdot=-ca.sign(s) + u, lbu=[-0.5], ubu=[0.5], lbx=[-2], ubx=[2])
    ocp = nocl.OCP(system, horizon=2.0, running=u**2 + s**2, terminal=s**2, x_goal=[0], u_goal=[0],
                   initial_states=nocl.Gaussian(mean=[1.0], std=[0.1]))
    run = nocl.simulate(ocp, control, [1.0])
    assert not run.success[0]
    assert "the integrator gave up, chattering where f jumps (s = 0;" in run.message[0]
    assert "blows up" not in run.message[0]
