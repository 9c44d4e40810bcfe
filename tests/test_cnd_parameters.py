"""One controller u(x, t, p) and one value V(x, t, p) for every goal and mass, against Riccati's at each."""

import dataclasses
import itertools
from types import SimpleNamespace

import casadi as ca
import lq
import numpy as np
import pytest
import torch
from lq import lq_value
from movers import mover

import nocl
from nocl.solvers import DDP, NMPC, solve_globally
from nocl.solvers.cnd import CND, TrainSettings
from nocl.solvers.cnd.regression.features import features
from nocl.solvers.cnd.regression.in_torch import InTorch
from nocl.solvers.cnd.regression.labels import Labels, Problems, kicked_states, near, rivals
from nocl.solvers.cnd.training import Training
from nocl.solvers.ddp.bank import SolutionBank

QUICK = TrainSettings(intervals=40, seeds=8, starts=2, states=100, tails=800, visits=300, rounds=0, iterations=1000,
                      batch=512, hidden=(32, 32), value_initial=200, value_tails=1000, value_visits=200,
                      value_iterations=1000, value_rounds=1, held_out=16, gap_median=1e-9)
P = np.array([[1.0, 0.0], [0.8, 1.0], [1.2, -1.0], [1.1, 0.4]])  # (mass, goal)


@pytest.fixture(scope="module")
def trained():
    return nocl.train(mover(), settings=QUICK, seed=0, progress=False)


def exact(x, t, p):
    """(u, V, V_x, V_p) at rows, Riccati's: with d = x - x*, V = d'S(t; mass) d."""
    rows = []
    for z, time, (mass, goal) in zip(x, t, p, strict=True):
        d = z - [goal, 0.0]
        (S,), (K,) = lq_value([time], mass=mass)
        more, less = (lq_value([time], mass=mass * (1 + e))[0][0] for e in (1e-5, -1e-5))
        by_mass = d @ (more - less) @ d / (2e-5 * mass)
        rows.append((-K @ d, d @ S @ d, 2 * S @ d, np.array([by_mass, -2 * (S @ d)[0]])))
    return tuple(np.array(column) for column in zip(*rows, strict=True))


def states(cnd, n=400):
    rng = np.random.default_rng(5)
    at = Problems.initial(cnd.ocp, n, rng)
    return at.x, rng.uniform(0, 1.2, n), at.p


def share(error, true):
    return np.median(np.abs(error)) / np.median(np.abs(true))


def test_it_is_riccatis_at_every_mass_and_goal(trained):
    x, t, p = states(trained)
    u, V, V_x, V_p = exact(x, t, p)
    assert share(trained(x, t, p) - u, u) < 0.04
    assert share(trained.value(x, t, p) - V, V) < 0.02
    assert share(trained.value_gradient(x, t, p) - V_x, V_x) < 0.04
    by_p = trained.value_gradient_by_p(x, t, p)
    assert share(by_p[:, 0] - V_p[:, 0], V_p[:, 0]) < 0.12
    assert share(by_p[:, 1] - V_p[:, 1], V_p[:, 1]) < 0.04
    assert trained.card["gap_median"] < 3e-3


def test_solvers_gradients_by_p_are_riccatis():
    ocp, (x, t, p) = mover(), (np.tile([0.3, -0.2], (4, 1)), np.zeros(4), P)
    V_p = exact(x, t, p)[3]
    for s in (DDP(ocp, intervals=200).solve(x, p=p), NMPC(ocp, 200, starts=1, passes=0).solve(x, p=p, workers=1)):
        np.testing.assert_allclose(s.V_p, V_p, rtol=1e-3, atol=1e-3)


def test_value_gradients_are_those_of_differences(trained):
    x, t, p = (rows[:20] for rows in states(trained))
    h = 1e-5
    for gradient, at in ((trained.value_gradient(x, t, p), 0), (trained.value_gradient_by_p(x, t, p), 2)):
        for i in range(2):
            up, down = ([z + s * h * np.eye(2)[i] if k == at else z for k, z in enumerate((x, t, p))] for s in (1, -1))
            difference = (trained.value(*up) - trained.value(*down)) / (2 * h)
            np.testing.assert_allclose(gradient[:, i], difference, rtol=1e-5, atol=1e-6 * np.abs(gradient).max())


def test_at_given_parameters_it_is_the_same(trained, tmp_path):
    x, t, _ = (rows[:10] for rows in states(trained))
    for p in P:
        own = trained.at(p)
        assert own.ocp.np == 0
        np.testing.assert_array_equal(own.ocp.x_goal, [p[1], 0])
        np.testing.assert_allclose(own(x, t), trained(x, t, p), rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(own.value(x, t), trained.value(x, t, p), rtol=1e-12)
    by_name = trained.at({"goal": 0.4, "mass": 1.1})
    np.testing.assert_array_equal(by_name(x, t), trained.at(P[3])(x, t))
    np.testing.assert_array_equal(CND.load(by_name.save(tmp_path).parent)(x, t), by_name(x, t))


def test_a_file_keeps_it(trained, tmp_path):
    x, t, p = (rows[:10] for rows in states(trained))
    again = CND.load(trained.save(tmp_path).parent)
    np.testing.assert_array_equal(again(x, t, p), trained(x, t, p))
    np.testing.assert_array_equal(again.value_gradient_by_p(x, t, p), trained.value_gradient_by_p(x, t, p))
    assert again.ocp.parameter_names == ("mass", "goal")


def test_in_casadi_it_is_a_function_of_x_t_p(trained):
    x, t, p = (rows[:10] for rows in states(trained))
    policy, V, slope = trained.to_casadi(), trained.value_to_casadi(), trained.value_gradient_to_casadi()
    assert policy.name_in() == V.name_in() == ["x", "t", "p"]
    np.testing.assert_allclose(policy(x.T, t[None], p.T).full().T, trained(x, t, p), rtol=0, atol=1e-12)
    for i in range(10):
        at = (x[i], t[i], p[i])
        assert float(V(*at)) == pytest.approx(trained.value(*at), rel=1e-12)
        np.testing.assert_allclose(slope(*at).full().ravel(), trained.value_gradient(*at), rtol=1e-9)


def test_the_judge_gives_each_state_its_own_parameters(trained):
    run = nocl.simulate(trained.ocp, trained, np.zeros((4, 2)), p=P)
    best = exact(np.zeros((4, 2)), np.zeros(4), P)[1]
    assert run.success.all()
    assert (run.cost >= best * (1 - 1e-6)).all()
    np.testing.assert_allclose(run.cost, best, rtol=0.02, atol=2e-3)
    np.testing.assert_allclose(run.x[:, -1, 0], P[:, 1], rtol=0, atol=0.1)


@pytest.mark.parametrize(("p", "match"), [
    (None, "p is missing; expected values of mass, goal"), ([1.0], "p has shape"),
    ({"mass": 1.0}, "lacks goal"), ([np.nan, 0.0], "mass = nan")])
def test_wrong_parameters_are_refused_by_name(trained, p, match):
    with pytest.raises(ValueError, match=match):
        trained(np.zeros(2), 0.0, p)
    with pytest.raises(ValueError, match=match):
        trained.value(np.zeros(2), 0.0, p)


def test_parameters_outside_are_told(trained):
    with pytest.warns(UserWarning, match="extrapolation: mass = 2 is outside"):
        trained(np.zeros(2), 0.0, [2.0, 0.0])


def test_features_see_the_goal_and_obstacles():
    """A state moved with its goal and obstacle looks the same but for p and for where it is itself."""
    walled = mover_with_wall(nocl.parameter("goal"))
    rng, n = np.random.default_rng(0), 300
    at = Problems.initial(walled, n, rng)
    labels = Labels(at.x, rng.uniform(0, 2, n), at.p, np.zeros((n, 1)), np.ones(n), np.zeros(n))
    phi = features(walled, labels)
    values = phi(labels.x.T, labels.t[None], labels.p.T).full()
    np.testing.assert_allclose(values.mean(axis=1), 0, atol=1e-6)
    np.testing.assert_allclose(values.std(axis=1), 1, rtol=1e-4)
    moved = phi(np.array([1.2, 0.3]), 0.7, [1.0, 0.9]).full() - phi(np.array([0.7, 0.3]), 0.7, [1.0, 0.4]).full()
    changed = np.flatnonzero(np.abs(moved.ravel()) > 1e-9)
    assert len(changed) == 2  # where it is, and the goal


def mover_with_wall(goal):
    """The mover with a wall that stands 0.5 behind its goal."""
    x, u = ca.vertcat(ca.SX.sym("pos"), ca.SX.sym("v")), ca.SX.sym("u")
    mass = nocl.parameter("mass", nominal=1.0)
    s = nocl.System("walled", x=x, u=u, p=mass, xdot=ca.vertcat(x[1], u / mass), lbu=[-20], ubu=[20], lbx=[-4, -4],
                    ubx=[4, 4])
    return nocl.OCP.quadratic(s, p=goal, horizon=2.0, x_goal=[goal, 0], u_goal=[0],
                              initial_states=nocl.Gaussian([0, 0], [0.5, 0.5]),
                              parameters=nocl.Uniform([0.8, -1], [1.2, 1]),
                              path_constraints={"wall": goal + 0.5 - x[0]})


def test_kicks_push_states_and_never_parameters():
    ocp = mover()
    here = InTorch(ocp)

    class Bank:
        scale = np.array([0.3, 0.3, 0.1, 0.3])
        solution = SimpleNamespace(x=np.array([[[-9.0, -9.0], [9.0, 9.0]]]))  # that leaves X

    found = kicked_states(Bank(), lambda x, t, p: -x[:, :1] + p[:, 1:], here, 64, 1.0, np.random.default_rng(0))
    low, high = ocp.parameter_box
    assert ((found.p >= low) & (found.p <= high)).all()
    assert len(np.unique(found.p, axis=0)) > 16


def test_more_are_drawn_near_the_problems_that_the_controller_is_worst_at():
    """A policy that is right but where the goal is above 0.6: half of the starts lie there, all inside the box."""
    ocp = mover()
    training = Training(ocp, None, QUICK, 0, None, False)
    training._first_labels()

    def policy(x, t, p):
        K = torch.from_numpy(lq_value([0.0])[1][0].reshape(1, 2))
        right = -((x - torch.cat([p[:, 1:], 0 * t], dim=1)) * K).sum(dim=1, keepdim=True)
        return torch.where(p[:, 1:] > 0.6, 0.0 * right, right)

    training.policy, before = policy, len(training.labels)
    hard = training._hardest(np.random.default_rng(1))
    low, high = ocp.parameter_box
    assert len(hard) == QUICK.held_out // 2
    assert (hard.p[:, 1] > 0.6).mean() > 0.8
    assert len(training.labels) == before + QUICK.visits * QUICK.intervals
    assert len(training.bank) > QUICK.visits
    more = near(ocp, hard, 500, np.random.default_rng(2))
    assert ((more.p >= low) & (more.p <= high)).all()
    assert (more.p[:, 1] > 0.4).mean() > 0.8
    found = kicked_states(training.bank, policy, training.in_torch, 2000, 0.01, np.random.default_rng(3), around=hard)
    assert (found.p[:, 1] > 0.5).mean() > 0.45


def test_several_neighbours_are_looked_at_where_optima_of_other_kinds_are_near():
    """A linear-quadratic problem has one optimum; a pendulum may swing up on either side."""
    def found(ocp):
        ddp, first = DDP(ocp, intervals=40, substeps=1), Problems.initial(ocp, 60, np.random.default_rng(0))
        bank = SolutionBank.of(ddp, solve_globally(ddp, first.x, p=first.p, starts=4, progress=False))
        return rivals(ddp, bank, np.random.default_rng(1))

    mass = nocl.parameter("mass", 1.0)
    pendulum = nocl.OCP.quadratic(nocl.systems.pendulum.system(mass=mass, parameters=mass), horizon=3.0, x_goal=[0, 0],
                                  u_goal=[0], initial_states=nocl.Gaussian([np.pi, 0], [0.1, 0.1]),
                                  parameters=nocl.Uniform([0.7], [1.3]))
    assert not found(mover())
    assert found(pendulum)


def test_states_that_lie_in_a_box_stay_in_it():
    ocp = dataclasses.replace(mover(), initial_states=nocl.Uniform([-1, -0.5], [1, 0.5]))
    at = Problems(np.array([[1.0, 0.5]]), np.zeros(1), np.array([[1.0, 0.0]]))
    found = near(ocp, at, 200, np.random.default_rng(0))
    assert (np.abs(found.x) <= [1, 0.5]).all()
    assert (found.x > [0.5, 0.25]).all()
    assert found.x.std(axis=0).min() > 0.01


def test_effort_grows_with_the_number_of_parameters():
    sizes = [TrainSettings.of("normal", parameters=n) for n in (0, 2, 4, 8, 30)]
    assert sizes[0] == TrainSettings()
    for fewer, more in itertools.pairwise(sizes[:-1]):
        assert all(getattr(more, name) > getattr(fewer, name) for name in TrainSettings.MORE)
    assert sizes[-1] == sizes[-2]
    assert TrainSettings.of("quick", parameters=3, tails=7).tails == 7
    with pytest.raises(ValueError, match="parameters is -1"):
        TrainSettings.of("normal", parameters=-1)


def test_the_same_in_torch(trained):
    x, t, p = (torch.from_numpy(rows[:5]) for rows in states(trained))
    got = trained.policy(x, t[:, None], p).numpy()
    np.testing.assert_array_equal(got, trained(x.numpy(), t.numpy(), p.numpy()))


def test_the_value_of_one_mass_is_riccatis_by_steps():
    """The tests' own exact answer: V by steps of the discrete Riccati equation tends to it."""
    S, *_ = lq.riccati(lq.A, lq.B / 0.8, 0.01 * np.eye(1), np.eye(2), 2.0, 2000)
    V = exact(np.array([[0.3, -0.2]]), [0.0], np.array([[0.8, 1.0]]))[1]
    d = np.array([-0.7, -0.2])
    assert V[0] == pytest.approx(d @ S[0] @ d, rel=1e-4)
