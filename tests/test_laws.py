"""Laws u(x) of problems whose horizon is free: the bank of nodes, training, files, what is refused."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import casadi as ca
import numpy as np
import pytest
import torch

import nocl
from nocl.solvers import DDP
from nocl.solvers.cnd.laws import LawTraining, Switches, law_advice
from nocl.solvers.cnd.regression.in_torch import InTorch
from nocl.solvers.cnd.regression.labels import Labels
from nocl.solvers.cnd.settings import TrainSettings
from nocl.solvers.cnd.validate import over
from nocl.solvers.ddp.global_search import solve_globally
from nocl.solvers.ddp.nodes import NodeBank

p, v, u = (ca.SX.sym(name) for name in "pvu")
SYSTEM = nocl.System("integrator", x=ca.vertcat(p, v), u=u, xdot=ca.vertcat(v, u), lbu=[-1], ubu=[1], lbx=[-5, -5],
                     ubx=[5, 5])
STATES = nocl.Uniform([-2, -1], [2, 1])


def problem(**options):
    given = {"horizon": nocl.Free(0.05, 10), "running": 1.0, "terminal": 0.0, "x_goal": [0, 0], "u_goal": [0],
             "initial_states": STATES, "terminal_constraints": {"at p": (0, p, 0), "at v": (0, v, 0)},
             "scales": {"at p": 1.0, "at v": 1.0}, **options}
    return nocl.OCP(SYSTEM, **given)


def least_time(x):
    side = np.sign(x[:, 0] + x[:, 1] * np.abs(x[:, 1]) / 2)
    p, v = side * x[:, 0], side * x[:, 1]
    return v + 2 * np.sqrt(p + v**2 / 2)


@pytest.fixture(scope="module")
def bank():
    ocp = problem()
    return NodeBank(ocp, solve_globally(DDP(ocp), STATES.sample(12, 0), starts=4, seed=0, progress=False))


def test_a_law_brakes_at_a_limit_whatever_its_network_says():
    run, rng = LawTraining.__new__(LawTraining), np.random.default_rng(0)
    run.ocp, run.seed, run.own = problem(state_bounds={"v": (-1.2, 1.2)}, scales={"v": 1.0}), 0, None
    run.settings = TrainSettings(hidden=(8,))
    run.bank = SimpleNamespace(solution=SimpleNamespace(t=np.full((3, 41), 3.0)))
    x, zero = rng.uniform(-2, 2, (200, 2)), np.zeros(200)
    run.labels = Labels(x, zero, np.zeros((200, 0)), rng.uniform(-1, 1, (200, 1)), np.ones(200), zero)
    run._network()
    with torch.no_grad():
        run.net.double().nets[0].body[-1].bias += 100.0  # it says u = 1
        u = run.net(torch.tensor([[0.0, 0.0], [0.0, 1.2]], dtype=torch.float64), torch.zeros(2, 1).double())[:, 0]
    assert u[0] == 1.0
    assert abs(float(u[1])) < 0.1


@pytest.mark.slow
def test_what_is_left_of_a_solution_is_one(bank):
    rows, nodes = np.array([0, 3, 7]), np.array([10, 40, 60])
    guess, s = bank.tails(rows, nodes, 80), bank.solution
    np.testing.assert_allclose(guess["x"][:, 0], s.x[rows, nodes], atol=1e-12)
    np.testing.assert_allclose(guess["t"][:, -1], s.t[rows, -1] - s.t[rows, nodes], rtol=1e-9)
    again = DDP(bank.ocp).solve(s.x[rows, nodes], **guess)
    assert again.success.all()
    np.testing.assert_allclose(again.cost, least_time(s.x[rows, nodes]), rtol=5e-3)
    np.testing.assert_allclose(again.cost, guess["t"][:, -1], rtol=5e-3)


def test_tails_keep_their_controls_on_any_grid(bank):
    rows, nodes = np.array([1, 2]), np.array([0, 0])
    fine = bank.tails(rows, nodes, 320)
    np.testing.assert_array_equal(fine["u"], np.repeat(bank.solution.u[rows], 4, axis=1))
    np.testing.assert_allclose(fine["x"][:, ::4], bank.solution.x[rows], atol=1e-12)


def test_the_nearest_node_is_a_start(bank):
    fresh = STATES.sample(20, 5)
    found = bank.solve(DDP(bank.ocp), fresh, np.zeros((20, 0)), 3)
    assert found.success.mean() >= 0.95
    np.testing.assert_allclose(found.cost[found.success], least_time(fresh[found.success]), rtol=5e-3)


def test_a_loosened_end_is_reached_sooner():
    x0 = STATES.sample(3, 1)
    loose = DDP(problem().loosened(1e-2)).solve(x0)
    assert loose.success.all()
    ends = loose.x[:, -1]
    assert (np.abs(ends) <= 1e-2 * (1 + 1e-6)).all()
    assert (loose.cost < least_time(x0)).all()
    assert (loose.cost + least_time(ends) >= least_time(x0)).all()  # the triangle inequality


def test_labels_stand_on_their_side_of_the_switch(bank):
    """Of the analytic law, u = -sign(p + v |v| / 2): the switch falls within an interval, where a control between the
    bounds is held."""
    s, ocp = bank.solution, bank.ocp
    where, held = Switches.of(s, ocp), Labels.held(s, 1.0)
    assert where.blurred.sum() >= 0.8 * len(s)
    assert len(where.rows) == where.blurred.sum()  # there is one control
    assert (np.abs(held.u[where.blurred]) < 1 - 1e-3).all()
    found = where.labels(held, InTorch(ocp))
    side = found.x[:, 0] + found.x[:, 1] * np.abs(found.x[:, 1]) / 2
    clear = np.abs(side) > 1e-4
    assert clear[:len(where.rows)].all()  # those after the switch go down the curve itself
    np.testing.assert_array_equal(found.u[clear, 0], -np.sign(side[clear]))
    np.testing.assert_allclose(found.weight.sum(), held.weight[where.rows].sum())


def test_parts_of_an_interval_add_up_to_what_was_held(bank):
    where, held = Switches.of(bank.solution, bank.ocp), Labels.held(bank.solution, 1.0)
    mean = where.share[:, None] * where.before + (1 - where.share[:, None]) * where.after
    np.testing.assert_allclose(mean, held.u[where.rows], atol=1e-9)


@pytest.mark.slow
def test_a_minimum_time_law_takes_nearly_the_least_time(tmp_path):
    ocp = problem()
    settings = TrainSettings.of("quick", iterations=1000, rounds=2, states=100, tails=200)
    cnd = nocl.train(ocp, settings=settings, seed=0, progress=False)
    fresh = STATES.sample(20, 9)
    run = nocl.simulate(ocp, cnd, fresh)
    assert run.success.mean() >= 0.9  # one that circles about the end may not arrive
    over = run.cost / least_time(fresh) - 1
    assert np.median(over) < 0.01
    assert cnd.card["arrived"] >= 0.9
    cnd.save(tmp_path)
    again = nocl.CND.load(tmp_path)
    np.testing.assert_array_equal(again(fresh), cnd(fresh))
    np.testing.assert_allclose(cnd.to_casadi()(fresh.T, 0.0).full().T, cnd(fresh), atol=1e-12)


def test_who_gains_less_is_above_the_optimum_and_who_fails_is_worst(bank):
    """J* may be a gain: a law that gains half of it costs half of |J*| more, and one that is lost all."""
    best = replace(bank.solution[:3], cost=np.array([-4.0, 4.0, np.inf]), success=np.array([True, True, False]))
    np.testing.assert_allclose(over(np.array([-2.0, 5.0, 1.0]), best), [0.5, 0.25])
    assert (over(np.full(3, np.inf), best) == np.inf).all()


def test_what_is_missing_of_a_law_is_said():
    well = {"unsolved": 0, "arrived": 1.0, "gap_median": 1e-3, "gap_p95": 0.01}
    assert law_advice(well, 32) is None
    assert "4 of 32 held-out initial states" in law_advice(well | {"unsolved": 4}, 32)
    assert "25 % of runs" in law_advice(well | {"arrived": 0.75}, 32)
    assert "costs 2 % more" in law_advice(well | {"gap_median": 0.02}, 32)


def test_what_no_law_can_be_had_of_is_refused():
    with pytest.raises(ValueError, match=r"holds the time, so that no u\(x\)"):
        nocl.train(problem(running=1 + 0.1 * nocl.time() * u**2))
    with pytest.raises(ValueError, match="no terminal constraints"):
        nocl.train(problem(terminal_constraints={}, scales={}))
    with pytest.raises(ValueError, match="minutes are for problems whose horizon is a number"):
        nocl.train(problem(), minutes=2)
    with pytest.raises(ValueError, match="control_dt"):
        nocl.train(problem(), settings=TrainSettings.of("quick", control_dt=True))
