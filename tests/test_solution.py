"""One Solution for all solvers: its sign as feedback, its rows, and what it knows of a search."""

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest

import nocl
from nocl.data import Solution, distinct
from nocl.judge import simulate
from nocl.solvers import DDP, LQR, NMPC, solve_globally

K = 40


@lru_cache
def problem() -> nocl.OCP:
    return nocl.load_ocp("cartpole")


@lru_cache
def solved(solver: str) -> Solution:
    """Two cart-poles, by either solver, with its feedback."""
    ocp = problem()
    x0 = ocp.initial_states.sample(2, 0)
    nlp = NMPC(ocp, K, starts=2, passes=0).solve(x0, gains=True, workers=1)
    return nlp if solver == "NMPC" else DDP(ocp, intervals=K, threads=1).solve(x0, u=nlp.u, curvature=True)


def test_the_same_feedback_whoever_solved():
    """u_k + gain_k (x - x_k) after two kicks, on the exact plant: far below the plan's own cost in open loop."""
    ocp, x0 = problem(), solved("NMPC").x[:, 0]
    kicks = [(0.5, [0.0, 0.0, 0.05, 0.0]), (2.0, [0.05, 0.0, 0.1, 0.0])]
    open_loop = simulate(ocp, solved("NMPC").u, x0, kicks=kicks).cost
    costs = [simulate(ocp, solved(name).feedback, x0, hold=K, kicks=kicks).cost for name in ("NMPC", "DDP")]
    assert costs[0] == pytest.approx(costs[1], rel=1e-3)
    assert (costs[0] < 0.2 * open_loop).all()
    wrong = replace(solved("NMPC"), gain=-solved("NMPC").gain)
    assert (simulate(ocp, wrong.feedback, x0, hold=K, kicks=kicks).cost > open_loop).all()


def test_the_same_names_mean_the_same():
    nlp, ddp = solved("NMPC"), solved("DDP")
    assert vars(nlp).keys() == vars(ddp).keys()
    for name in ("t", "x", "u", "V", "V_x", "cost", "gain", "V_xx"):
        a, b = getattr(nlp, name), getattr(ddp, name)
        assert a == pytest.approx(b, rel=1e-4, abs=1e-4 * np.abs(b).max()), name
    assert nlp.V[:, 0] == pytest.approx(nlp.cost, rel=1e-9)
    assert nlp.costate is nlp.V_x


def test_gain_is_minus_the_gain_of_lqr():
    """On a linear-quadratic problem, with many intervals, by all three."""
    ocp = nocl.load_ocp("double_integrator")
    x0, K_lqr = [0.1, 0.05], LQR(ocp).K(0.0)
    for found in (NMPC(ocp, 400, starts=1).solve(x0, gains=True), DDP(ocp, intervals=400, threads=1).solve(x0)):
        assert found.gain[0, 0] == pytest.approx(-K_lqr, rel=0.02)


def test_feedback_takes_the_interval_of_its_time_for_each_row():
    t = np.array([[0.0, 0.3, 0.6, 0.9], [0.6, 0.7, 0.8, 0.9]])  # 3 * 0.3 is not 0.9 in floating point
    blank = Solution.blank(t, 1, 1)
    s = replace(blank, x=np.zeros((2, 4, 1)), u=np.arange(6.0).reshape(2, 3, 1), gain=np.full((2, 3, 1, 1), -2.0))
    x = np.array([[0.0], [1.0]])
    assert s.feedback(x, 0.6).ravel().tolist() == [2.0, 1.0]
    assert s.feedback(x, 0.1 + 0.2 + 0.3).ravel().tolist() == [2.0, 1.0]
    assert s.feedback(x, 0.75).ravel().tolist() == [2.0, 2.0]
    assert s.feedback(x, 0.9).ravel().tolist() == [2.0, 3.0]
    with pytest.raises(ValueError, match=r"no `gain`: take that of NMPC.solve\(x0, gains=True\), or DDP's"):
        blank.feedback(x)


def test_rows_are_picked_joined_and_put():
    nlp, ddp = solved("NMPC"), solved("DDP")
    assert len(nlp[0]) == len(nlp[[1]]) == len(nlp[nlp.cost < np.inf][:1]) == 1
    assert np.array_equal(nlp[1].x, nlp.x[1:])
    both = Solution.join([nlp, ddp])
    assert len(both) == 4
    assert both.dense is None  # DDP has none
    assert np.array_equal(both.V_xx[2:], ddp.V_xx)
    blank = Solution.blank(nlp.t.copy(), 4, 1)
    assert not blank.success.any()
    blank.put([1], replace(nlp[:1], message=np.array(["a longer message than the one before"])))
    assert blank.message.tolist() == ["not tried", "a longer message than the one before"]
    assert blank.cost.tolist() == [np.inf, nlp.cost[0]]
    assert np.array_equal(blank.u[1], nlp.u[0])
    known = ddp[:]
    known = replace(known, V_xx=known.V_xx.copy())
    known.put([0], replace(ddp[:1], V_xx=None))
    assert np.isnan(known.V_xx[0]).all()
    assert np.array_equal(Solution.of_arrays(nlp.arrays()).x, nlp.x)
    with pytest.raises(ValueError, match="not the arrays of a Solution"):
        Solution.of_arrays({"x": nlp.x})


def test_starts_hits_and_optima_are_read_from_what_was_tried():
    tried = np.array([[2.0, 1.0, 1.0005, np.inf], [np.inf, np.inf, np.nan, np.nan], [3.0, 3.0, np.nan, np.nan]])
    s = replace(Solution.blank(np.zeros((3, 2)), 1, 1), cost=np.array([1.0, np.inf, 3.0]), tried=tried)
    assert s.starts.tolist() == [4, 2, 2]
    assert s.hits.tolist() == [2, 0, 2]
    assert [o.tolist() for o in s.optima] == [[[1.0, 2.0], [2.0, 1.0]], [], [[3.0, 2.0]]]
    wide = Solution.join([s[2], s[0]])
    assert wide.starts.tolist() == [2, 4]
    narrow = replace(s[2], tried=s.tried[2:, :2].copy())
    narrow.put([0], s[0])
    assert narrow.starts.tolist() == [4]
    alone = DDP(problem(), intervals=10, threads=1).solve(problem().initial_states.sample(2, 0))
    assert alone.starts.tolist() == [1, 1]
    assert alone.hits.tolist() == [1, 1]
    assert distinct(np.array([np.nan, np.inf]), 1.0).shape == (0, 2)


def test_seconds_and_iterations_are_of_all_that_was_tried():
    ddp = DDP(problem(), intervals=10, threads=1)
    x0 = problem().initial_states.sample(3, 0)
    one, many = ddp.solve(x0), solve_globally(ddp, x0, starts=3, rounds=0)
    assert (one.seconds > 0).all()
    assert (many.iterations > one.iterations).all()
    assert (many.seconds > 0).all()


def test_time_outside_and_solutions_without_slopes_are_refused():
    nlp = solved("NMPC")
    assert nlp[0](0.3)[0].shape == (1, 4)
    with pytest.raises(ValueError, match=r"expected a time or a list of times in \[0, 4\]"):
        nlp(4.1)
    with pytest.raises(ValueError, match="no `dense`"):
        solved("DDP")(0.1)
