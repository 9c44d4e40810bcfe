"""Problems without a goal: what is about one refuses by name or is left out, and the rest works."""

import pickle
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

import nocl
from nocl.comparisons import compare
from nocl.comparisons.diagnosis import doctor
from nocl.definition.ocp import OCP
from nocl.solvers import DDP, LQR, NMPC
from nocl.solvers.cnd.settings import TrainSettings
from nocl.solvers.ddp.global_search import GlobalDDP, solve_globally
from nocl.solvers.starts import levels

STOCK, CATCH = ca.SX.sym("stock"), ca.SX.sym("catch")


def fishery(**options):
    """Harvest of a stock that grows by itself: max of int catch - catch^2 / 4, and half of what is left."""
    system = nocl.System("fishery", x=STOCK, u=CATCH, xdot=STOCK * (1 - STOCK) - CATCH, lbu=[0], ubu=[1], lbx=[0],
                         ubx=[2])
    return nocl.OCP(system, **{"horizon": 4.0, "running": CATCH**2 / 4 - CATCH, "terminal": -STOCK / 2,
                               "initial_states": nocl.Uniform([0.6], [1.0]), **options})


def test_a_point_of_reference_stands_where_the_goal_would():
    ocp = fishery()
    assert not ocp.has_goal
    np.testing.assert_array_equal(ocp.x_goal, [0.8])
    np.testing.assert_array_equal(ocp.u_goal, [0.5])
    assert "goal: none" in repr(ocp)


def test_it_stays_none_on_every_way():
    ocp = fishery()
    moved = replace(ocp, initial_states=nocl.Uniform([0.2], [0.4]))
    assert not moved.has_goal
    np.testing.assert_allclose(moved.x_goal, [0.3])
    for other in (OCP.from_data(ocp.to_data()), pickle.loads(pickle.dumps(ocp)), ocp.unconstrained):
        assert not other.has_goal
    price = nocl.parameter("price", nominal=1.0)
    varies = fishery(running=CATCH**2 / 4 - price * CATCH, p=price, parameters=nocl.Uniform([0.8], [1.2]))
    assert not varies.at(p=[1.1]).has_goal
    assert fishery(x_goal=[0.5], u_goal=[0.25]).has_goal
    half = fishery(x_goal=[0.5])
    assert not half.has_goal
    np.testing.assert_array_equal(OCP.from_data(half.to_data()).x_goal, [0.5])


def test_what_is_about_a_goal_refuses_by_name():
    with pytest.raises(ValueError, match=r"LQR needs a goal pair.*'fishery' has no x_goal and u_goal.*NMPC or DDP"):
        LQR(fishery())
    with pytest.raises(ValueError, match=r"has no u_goal: give it one"):
        LQR(fishery(x_goal=[0.5]))


def test_ddp_and_nmpc_agree_without_one():
    ocp = fishery()
    x0 = ocp.initial_states.sample(3, 0)
    theirs = NMPC(ocp, 20, starts=3, passes=0).solve(x0, workers=1)
    ours = solve_globally(DDP(ocp, intervals=20), x0, starts=6, rounds=1, seed=0)
    assert ours.success.all()
    np.testing.assert_allclose(ours.cost, theirs.cost, rtol=1e-7)


def test_a_comparison_without_one(tmp_path):
    ocp = fishery()
    methods = {"DDP": GlobalDDP(DDP(ocp, intervals=20), starts=4), "NMPC": NMPC(ocp, 20, starts=2)}
    report = compare(ocp, methods, n=2, progress=False)
    assert np.isnan(report.rows()[0]["terminal_error"])
    assert report.rows()[0]["gap"] == pytest.approx(0, abs=1e-6)
    assert report.save(tmp_path / "report").exists()


def test_the_doctor_leaves_out_what_is_about_one():
    by = {finding.about: finding for finding in doctor(fishery(), intervals=20).findings}
    assert by["goal"].text.startswith("none")
    assert "controllability" not in by
    assert by["solutions"].text.startswith("8 of 8")


def test_levels_are_held_and_reach_the_bounds():
    system = fishery().system
    u = levels(system, 20, 200, np.random.default_rng(0), 5)
    assert u.shape == (200, 20, 1)
    assert (u == np.repeat(u[:, ::4], 4, axis=1)).all()
    assert u.min() == 0
    assert u.max() == 1
    at_bound = ((u == 0) | (u == 1)).mean()
    assert 0.4 < at_bound < 0.6
    assert (levels(system, 7, 3, np.random.default_rng(0), 1).std(axis=1) == 0).all()


@pytest.mark.slow
def test_training_without_one_asks_for_a_second_opinion():
    settings = TrainSettings(intervals=20, seeds=3, starts=4, states=20, tails=100, visits=50, rounds=0, iterations=200,
                             hidden=(16, 16), value=False, held_out=8)
    card = nocl.train(fishery(), settings=settings, seed=0, progress=False).card
    assert card["second_opinion"]["states"] == 2
    assert card["second_opinion"]["text"] == ""  # both methods agree, and no term was added
    assert card["gap_median"] < 0.02
