"""Where a problem is 2 pi periodic in an angle, images of a state are one state, for every law and for every score."""

import casadi as ca
import numpy as np
import pytest
import torch

import nocl
from nocl.solvers.cnd.regression.features import _least_passed, features, policy_net, without_clock
from nocl.solvers.cnd.regression.labels import Labels
from nocl.solvers.cnd.regression.regress import fit_net, policy_loss
from nocl.solvers.ddp.bank import SolutionBank, extend
from nocl.solvers.ddp.solver import DDP
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


@pytest.mark.parametrize("law", [features, without_clock])
def test_one_angle_alone_has_features(law):
    """All of its state is an angle, so that no state stands in the features as it is."""
    theta, tau = ca.SX.sym("theta"), ca.SX.sym("tau")
    s = nocl.System("turntable", x=theta, u=tau, xdot=tau + 0.3 * ca.sin(theta), lbu=[-2], ubu=[2], lbx=[-4], ubx=[4],
                    angles=["theta"])
    ocp = nocl.OCP(s, horizon=2.0, running=1 - ca.cos(theta) + 0.1 * tau**2, terminal=2 * (1 - ca.cos(theta)),
                   x_goal=[0], u_goal=[0], initial_states=nocl.Uniform([-2], [2]))
    assert ocp.periodic == (0,)
    rng = np.random.default_rng(0)
    x, t, u = rng.uniform(-2, 2, (50, 1)), rng.uniform(0, 2, 50), rng.uniform(-2, 2, (50, 1))
    phi = law(ocp, Labels(x, t, np.zeros((50, 0)), u, np.ones(50), np.zeros(50)))
    values = phi(*ocp.functions.feedback().columns(x=x, t=t)).full()
    assert np.ptp(values, axis=1).min() > 0.1  # each tells states or times apart


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
    assert run.terminal_error.max() < 0.05


def test_where_the_cost_is_not_periodic_nothing_changes():
    ocp = pendulum(lambda theta, omega: theta**2 + omega**2)
    x = np.array([[3.0, 0.1], [7.0, 0.0]])
    np.testing.assert_array_equal(ocp.from_goal(x), x)
    assert not np.allclose(LQR(ocp)(x), LQR(ocp)(x - TURN))


def test_features_do_not_tell_images_apart():
    rng = np.random.default_rng(0)
    x, t = rng.uniform(-3, 3, (500, 2)), rng.uniform(0, 3, 500)
    labels = Labels(x, t, np.zeros((500, 0)), np.zeros((500, 1)), np.ones(500), np.zeros(500))
    for plain in (False, True):
        phi = features(pendulum(), labels, plain=plain)
        at = phi(x[:9].T, t[None, :9]).full()
        np.testing.assert_allclose(phi((x[:9] + TURN).T, t[None, :9]).full(), at, atol=1e-9)
        raw = features(pendulum(lambda theta, omega: theta**2 + omega**2), labels, plain=plain)
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


def test_a_bank_finds_the_nearest_image_and_answers_as_it_does_without_turns():
    """From a state and from the same state some turns away: the same solution, control and value."""
    ocp = pendulum()
    ddp, x0 = DDP(ocp, intervals=30), ocp.initial_states.sample(40, 0)
    bank = SolutionBank.of(ddp, ddp.solve(x0))
    assert bank.periodic == (0,)
    x = ocp.initial_states.sample(12, 1)
    turned = x + 2 * np.pi * np.random.default_rng(0).integers(-3, 4, (12, 1)) * [1, 0]
    np.testing.assert_array_equal(bank.nearest(turned), bank.nearest(x))
    for a, b in zip(bank.interpolate(turned), bank.interpolate(x), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-9)
    here, there = extend(ddp, bank, x), extend(ddp, bank, turned)
    assert here.success.all()
    np.testing.assert_allclose(there.cost, here.cost, rtol=1e-9)
    np.testing.assert_allclose(there.u, here.u, atol=1e-5)


def test_a_bank_knows_its_circles_after_a_save(tmp_path):
    ocp = pendulum()
    ddp = DDP(ocp, intervals=30)
    bank = SolutionBank.of(ddp, ddp.solve(ocp.initial_states.sample(5, 0)))
    bank.save(tmp_path)
    assert SolutionBank.load(tmp_path).periodic == (0,)
    assert bank.add(ddp.solve(ocp.initial_states.sample(5, 1))).periodic == (0,)


def test_angles_of_a_sensor_are_followed():
    """cartpole's cost tells turns apart: wrapped states give what continuous ones do, in Python and in CasADi."""
    cnd = nocl.pretrained("cartpole")
    assert cnd.continuous_angles == ("theta",)
    t = np.linspace(0, 2, 41)
    path = np.stack([0.3 * np.sin(t), np.cos(t), 3 + 2.5 * t, 2.5 + 0 * t], axis=1)  # theta passes pi and 2 pi
    wrapped = path.copy()
    wrapped[:, 2] = np.angle(np.exp(1j * path[:, 2]))
    follow, f, last = cnd.unwrapped(), cnd.unwrapped_to_casadi(), path[0]
    for x, seen, time in zip(path, wrapped, t, strict=True):
        np.testing.assert_allclose(follow(seen, time), cnd(x, time), atol=1e-12)
        u, last = f(seen, time, last)
        np.testing.assert_allclose(u.full().ravel(), cnd(x, time), atol=1e-9)
        np.testing.assert_allclose(last.full().ravel(), x, atol=1e-12)
    np.testing.assert_allclose(follow(wrapped[0], 0.0), cnd(path[0], 0.0))  # an earlier time begins anew
    rows = np.stack([path, path + np.array([0, 0, 2 * np.pi, 0])], axis=1)
    follow.reset()
    np.testing.assert_allclose(follow(rows[0], 0.0), cnd(rows[0], 0.0))
    np.testing.assert_allclose(follow(wrapped[[20, 20]], 1.0)[0],
                               cnd(wrapped[20] + [0, 0, 2 * np.pi * np.round((path[0, 2] - wrapped[20, 2]) /
                                                                            (2 * np.pi)), 0], 1.0))


def boat(high=2 * np.pi, drag=0.0):
    """A point at unit speed, the direction its control: one that U has images of; with drag turns differ."""
    x, y, phi = ca.SX.sym("x"), ca.SX.sym("y"), ca.SX.sym("phi")
    s = nocl.System("boat", x=ca.vertcat(x, y), u=phi, xdot=ca.vertcat(ca.cos(phi), ca.sin(phi)), lbu=[-np.pi],
                    ubu=[high], lbx=[-5, -5], ubx=[5, 5])
    return nocl.OCP(s, horizon=1.0, running=drag * phi**2, terminal=x, initial_states=nocl.Uniform([-1, -1], [1, 1]))


def test_controls_that_are_directions_are_found_out():
    assert boat().periodic_controls == (0,)
    assert boat(np.pi).periodic_controls == ()  # each direction has one image
    assert boat(drag=1.0).periodic_controls == ()


@pytest.mark.parametrize("middle", [np.pi, 0.5, -2.0])
def test_images_of_a_direction_have_no_mean(middle):
    """Labels that say one direction or the other image of it by chance are fitted as if they said one."""
    ocp, rng = boat(), np.random.default_rng(0)
    x, t = rng.uniform(-1, 1, (2000, 2)), rng.uniform(0, 1, 2000)
    true = middle + 0.8 * x[:, :1]
    images = [true, np.where(true - 2 * np.pi >= -np.pi, true - 2 * np.pi, true + 2 * np.pi)]
    u = np.where((rng.random((2000, 1)) < 0.5) & (images[1] <= 2 * np.pi), images[1], images[0])
    u = np.where(u < -np.pi, u + 2 * np.pi, u)
    labels = Labels(x, t, np.zeros((2000, 0)), u, np.ones(2000), np.zeros(2000))
    torch.manual_seed(0)
    net, inverse = policy_net(ocp, labels, (16, 16))
    fit_net(net, policy_loss(ocp, net, inverse, labels), 2000, iterations=300, batch=256, lr=4e-3, seed=0)
    off = nocl.CND(ocp, net)(x, t) - true
    assert np.abs(np.angle(np.exp(1j * off))).max() < 0.4  # the mean of two images is off by 3


def test_a_turn_begins_where_no_solution_turns_through():
    """From 1 fast through pi to 5, and back slowly: few labels are at pi, but every solution passes there."""
    way = np.r_[np.full(30, 1.0), 2.0, 3.0, 4.0, np.full(30, 5.0)]
    angle = np.tile(way, 20) - 2 * np.pi * np.repeat(np.arange(20) % 2, len(way)) * np.tile(way > 3.5, 20)
    begin = _least_passed(angle, np.tile(np.linspace(0, 1, len(way)), 20), np.linspace(-np.pi, 0, 64))
    assert -0.9 < begin <= 0.0
