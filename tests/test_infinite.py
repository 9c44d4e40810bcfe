"""Problems without an end: what they are, who takes them, LQR on them, the law at its goal."""

from __future__ import annotations

import json
import pickle

import casadi as ca
import numpy as np
import pytest

import nocl
from nocl.comparisons import compare
from nocl.solvers import DDP, LQR, NMPC
from nocl.solvers.cnd.settings import TrainSettings
from nocl.solvers.cnd.stationary import accurate_level
from nocl.solvers.ddp.stationary_bank import pruned
from nocl.solvers.lqr import ended

p, v, u, t = ca.SX.sym("p"), ca.SX.sym("v"), ca.SX.sym("u"), nocl.time()
BOX = {"lbu": [-6], "ubu": [6], "lbx": [-3, -3], "ubx": [3, 3]}
SYSTEM = nocl.System("mass", x=ca.vertcat(p, v), u=u, xdot=ca.vertcat(v, u - 0.1 * v), units={"p": "m"}, **BOX)
STATES = nocl.Gaussian([1.0, 0.0], [0.2, 0.2])
COST = p**2 + 0.1 * v**2 + 0.5 * u**2


def problem(system=SYSTEM, **options):
    given = {"horizon": nocl.INFINITE, "running": COST, "x_goal": [0, 0], "u_goal": [0], "initial_states": STATES}
    return nocl.OCP(system, **{**given, **options})


def pendulum(running=None, **options):
    swing = nocl.System("pendulum", x=ca.vertcat(p, v), u=u, xdot=ca.vertcat(v, 9.81 * ca.sin(p) + u), lbu=[-5],
                        ubu=[5], lbx=[-7, -8], ubx=[7, 8], angles=["p"])
    return problem(swing, running=2 * (1 - ca.cos(p)) + 0.1 * v**2 + 0.1 * u**2 if running is None else running,
                   initial_states=nocl.Gaussian([np.pi, 0], [0.3, 0.5]), **options)


def test_it_is_data_and_text_like_any_other():
    ocp = problem()
    assert ocp.is_infinite
    assert "horizon infinite" in repr(ocp)
    for again in (nocl.OCP.from_data(json.loads(json.dumps(ocp.to_data()))), pickle.loads(pickle.dumps(ocp))):
        assert again.is_infinite
        assert again.to_data() == ocp.to_data()
    assert ocp.lasting(3.0).horizon == 3.0


@pytest.mark.parametrize(("options", "words"), [
    ({"terminal": p**2}, "nothing ends"), ({"running": COST + 1}, "costs 1 a unit of time"),
    ({"x_goal": [0, 1]}, "p moves by 1 a unit of time"), ({"running": COST + ca.sin(t) * p**2}, "holds the time"),
    ({"x_goal": None}, "no goal pair"), ({"terminal_constraints": {"end": (0, p, 0)}}, "terminal_constraints are end"),
    ({"horizon": 2.0}, "terminal is missing")])
def test_what_cannot_go_on_for_ever_is_refused(options, words):
    with pytest.raises(ValueError, match=words):
        problem(**options)


@pytest.mark.parametrize("take", [lambda o: NMPC(o, 10), DDP, lambda o: compare(o, {"LQR": LQR(o)})])
def test_who_needs_an_end_says_how_to_get_one(take):
    with pytest.raises(ValueError, match=r"takes a horizon that ends.*nocl\.train\(ocp\).*ocp\.lasting\(10\)"):
        take(problem())


def test_runs_last_as_long_as_they_are_told():
    ocp, x0 = problem(), np.array([[0.2, 0.0], [-0.1, 0.1]])
    run = nocl.simulate(ocp, LQR(ocp), x0, duration=40.0)
    assert run.t[-1] == 40.0
    np.testing.assert_allclose(run.cost, LQR(ocp).value(x0), rtol=1e-7)  # x' P x / 2, Riccati
    with pytest.raises(ValueError, match="duration is None"):
        nocl.simulate(ocp, LQR(ocp), x0)
    with pytest.raises(ValueError, match="duration is 3"):
        nocl.simulate(ocp.lasting(1.0), LQR(ocp), x0, duration=3.0)


def test_a_part_that_ends_in_lqr_costs_what_lqr_does():
    ocp, x0 = problem(), np.array([[0.2, 0.0], [-0.1, 0.1]])
    found = DDP(ended(ocp, 3.0), intervals=120).solve(x0)
    np.testing.assert_allclose(found.cost, LQR(ocp).value(x0), rtol=1e-4)  # held controls cost a little
    turned = ended(pendulum(), 1.0).functions
    x = np.array([[0.1, 0.2], [0.1 + 2 * np.pi, 0.2], [np.pi, 0.0]])
    V = turned.G(*turned.end.columns(x=x)).full().ravel()
    assert V[0] == pytest.approx(V[1])
    assert V[0] == pytest.approx(LQR(pendulum()).value(x[0]), rel=1e-2)
    assert V[2] > 4 * np.diag(LQR(pendulum()).P())[0] / 2 * 0.99  # hanging is far away


@pytest.mark.parametrize(("ocp", "names"), [
    (problem(running=u**2 + v**2), "p stays as it is"), (pendulum(running=u**2), "does not see a motion of p, v")])
def test_a_cost_that_lets_it_wait_for_ever_is_refused_by_the_names_of_states(ocp, names):
    with pytest.raises(ValueError, match=names):
        ended(ocp, 2.0)


def test_the_level_is_where_lqr_is_right():
    """Of a linear system all of where LQR stays in U: max |K x| over V <= level is the room."""
    ocp = problem()
    lqr, level = LQR(ocp), accurate_level(ocp, LQR(ocp))
    K, P = lqr.K(), lqr.P()
    assert np.sqrt(2 * level * (K @ np.linalg.inv(P) @ K.T)).item() == pytest.approx(6.0)
    assert accurate_level(pendulum(), LQR(pendulum())) < 2.0


def test_plans_that_wait_at_the_goal_are_pruned():
    """A plan that arrives, and leaves again, is worth less than one that stays."""
    ocp = pendulum()
    posed, lqr = ended(ocp, 6.0), LQR(ocp)
    ddp = DDP(posed, intervals=60)
    ways = ddp.solve(np.tile([[0.1, 0.0]], (3, 1)), u=np.stack([np.full((60, 1), level) for level in (0.0, 4.0, -4.0)]))
    better = pruned(ddp, ways, lqr, accurate_level(ocp, lqr))
    assert (ways.cost > 2 * lqr.value([0.1, 0.0])).any()  # some go astray
    assert (better.cost <= ways.cost * (1 + 1e-9)).all()
    np.testing.assert_allclose(better.cost[ways.success], lqr.value([0.1, 0.0]), rtol=0.02)


@pytest.fixture(scope="module")
def law():
    small = TrainSettings(intervals=40, seeds=4, starts=2, states=20, tails=60, visits=40, rounds=1, iterations=300,
                          hidden=(24, 24), held_out=8)
    return nocl.train(problem(), settings=small, progress=False)


def test_the_law_is_lqr_at_the_goal_and_stays_there(law):
    ocp = problem()
    assert law(np.zeros(2)) == pytest.approx(0.0, abs=1e-12)
    pi = law.to_casadi()
    x = ca.MX.sym("x", 2)
    slope = ca.Function("slope", [x], [ca.jacobian(pi(x, 0.0), x)])(0).full()
    np.testing.assert_allclose(slope, -LQR(ocp).K(), rtol=1e-6)
    run = nocl.simulate(ocp, law, STATES.sample(5, 3), duration=60.0)
    assert run.success.all()
    assert np.abs(run.x[:, -1]).max() < 1e-6
    assert law.card["arrived"] == 1.0
    safe = law.safeguarded(steps=30)
    assert 30 * safe.control_dt == pytest.approx(law.card["arrives_in"])
    guarded = nocl.simulate(ocp, safe, STATES.sample(5, 3), duration=60 * safe.control_dt)
    assert guarded.lost.max() == 0
    assert np.abs(guarded.x[:, -1]).max() < 1e-2
    assert np.median(run.cost / LQR(ocp).value(run.x[:, 0])) < 1.01


def test_the_law_is_saved_and_comes_back(law, tmp_path):
    law.save(tmp_path / "law")
    again = nocl.CND.load(tmp_path / "law")
    x = STATES.sample(5, 1)
    np.testing.assert_array_equal(again(x), law(x))
    assert again.ocp.is_infinite


@pytest.mark.parametrize(("options", "words"), [
    ({"settings": TrainSettings(control_dt=True)}, "control_dt"), ({"minutes": 1.0}, "minutes"),
    ({"method": "paper"}, "takes a horizon that ends")])
def test_what_a_law_is_not_trained_by(options, words):
    with pytest.raises(ValueError, match=words):
        nocl.train(problem(), **options)
