"""Where a problem is 2 pi periodic in an angle, images of a state are one state, for every law and for every score."""

import casadi as ca
import numpy as np
import pytest

import nocl
from nocl.solvers.cnd.features import features
from nocl.solvers.lqr import LQR
from nocl.solvers.nmpc.solver import NMPC

TURN = np.array([2 * np.pi, 0.0])


def pendulum(terminal=None, goal=0.0, **options):
    theta, omega, tau = ca.SX.sym("theta"), ca.SX.sym("omega"), ca.SX.sym("tau")
    s = nocl.System("pendulum", x=ca.vertcat(theta, omega), u=tau,
                    xdot=ca.vertcat(omega, 9.81 * ca.sin(theta - goal) + tau), lbu=[-5], ubu=[5], lbx=[-6.3, -8],
                    ubx=[6.3, 8], angles=["theta"])
    G = 10 * (1 - ca.cos(theta - goal)) + omega**2 if terminal is None else terminal(theta, omega)
    options = {name: make(theta) for name, make in options.items()}
    return nocl.OCP(s, horizon=3.0, running=0.01 * tau**2, terminal=G, x_goal=[goal, 0], u_goal=[0],
                    initial_states=nocl.Gaussian([goal + 3.14, 0], [0.1, 0.1]), **options)


def test_periodicity_is_found_out():
    assert pendulum().periodic == (0,)
    assert pendulum(lambda theta, omega: theta**2 + omega**2).periodic == ()
    assert pendulum(path_constraints=lambda theta: {"gate": 2 - theta**2 / 40}).periodic == ()
    assert pendulum(path_constraints=lambda theta: {"gate": 1.5 + ca.sin(theta)}).periodic == (0,)
    assert nocl.load_ocp("cartpole").periodic == ()  # the paper's cost is the square of the angle
    assert pendulum(lambda theta, omega: 1 - ca.cos(theta / 2)).periodic == ()  # 4 pi


@pytest.mark.parametrize("goal", [0.0, 3.1, -3.1])
@pytest.mark.parametrize("turns", [-2, 1, 3])
def test_lqr_is_the_same_for_images(goal, turns):
    ocp = pendulum(goal=goal)
    for law in (LQR(ocp), LQR(pendulum(goal=goal))):
        x = np.array([goal + 0.05, -0.1])
        np.testing.assert_allclose(law(x + turns * TURN), law(x), atol=1e-9)
        assert law.value(x + turns * TURN) == pytest.approx(law.value(x), rel=1e-9)
        np.testing.assert_allclose(law.to_casadi()(x + turns * TURN, 0.5).full().ravel(), law(x, 0.5), atol=1e-6)


def test_a_run_to_an_image_of_the_goal_has_arrived():
    ocp = pendulum(goal=3.1)
    x0 = np.array([[-3.1, 0.0], [-3.1 + 2 * np.pi, 0.0]])
    run = nocl.simulate(ocp, LQR(ocp), x0)
    np.testing.assert_allclose(run.cost, run.cost[0], rtol=1e-6)
    np.testing.assert_allclose(run.terminal_error, run.terminal_error[0], rtol=1e-4)
    assert run.terminal_error.max() < 0.1


def test_where_the_cost_is_not_periodic_nothing_changes():
    ocp = pendulum(lambda theta, omega: theta**2 + omega**2)
    x = np.array([[3.0, 0.1], [7.0, 0.0]])
    np.testing.assert_array_equal(ocp.from_goal(x), x)
    assert not np.allclose(LQR(ocp)(x), LQR(ocp)(x - TURN))


def test_features_do_not_tell_images_apart():
    rng = np.random.default_rng(0)
    x, t = rng.uniform(-3, 3, (500, 2)), rng.uniform(0, 3, 500)
    for plain in (False, True):
        phi = features(pendulum(), x, t, plain=plain)
        at = phi(x[:9].T, t[None, :9]).full()
        np.testing.assert_allclose(phi((x[:9] + TURN).T, t[None, :9]).full(), at, atol=1e-9)
        raw = features(pendulum(lambda theta, omega: theta**2 + omega**2), x, t, plain=plain)
        assert raw.numel_out(0) > phi.numel_out(0)


def test_nmpc_is_the_same_from_images():
    """Starts go to the nearest image of the goal."""
    nmpc = NMPC(pendulum(goal=3.1), 30, starts=3, passes=0)
    x0 = np.array([-2.9, 0.3])
    here, there = (nmpc.solve(x, progress=False) for x in (x0, x0 + TURN))
    assert here.success.all()
    np.testing.assert_allclose(here.cost, there.cost, rtol=1e-6)
    np.testing.assert_allclose(here.u, there.u, atol=1e-4)
    assert here.cost[0] < 0.2  # the short way


@pytest.mark.slow
def test_a_trained_controller_answers_alike_to_images():
    ocp = pendulum()
    cnd = nocl.train(ocp, seed=0, progress=False)
    x0 = ocp.initial_states.sample(20, 5)
    wrapped = x0 - TURN * (x0[:, :1] > np.pi)
    np.testing.assert_allclose(cnd(wrapped), cnd(x0), atol=1e-9)
    np.testing.assert_allclose(cnd.value(wrapped), cnd.value(x0), rtol=1e-9)
    np.testing.assert_allclose(nocl.simulate(ocp, cnd, wrapped).cost, nocl.simulate(ocp, cnd, x0).cost, rtol=1e-6)
