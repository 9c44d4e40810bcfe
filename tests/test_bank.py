"""Global optima by batches: what cold starts, neighbours and a bank add to a single straight start."""

from dataclasses import replace
from functools import lru_cache

import casadi as ca
import numpy as np
import pytest

import nocl
from nocl.solvers.bank import GlobalSolution, SolutionBank, better, cold_controls, extend, solve_globally
from nocl.solvers.ddp import DDP, DDPSolution

N = 24


@lru_cache
def cartpole() -> DDP:
    return DDP(nocl.load_ocp("cartpole"), intervals=40, threads=1)


@lru_cache
def states() -> np.ndarray:
    """From wide round the pole's circle, where rival swings exist."""
    return np.random.default_rng(7).uniform([-1, -2, -np.pi, -3], [1, 2, np.pi, 3], (N, 4))


@lru_cache
def straight() -> DDPSolution:
    return cartpole().solve(states())


@lru_cache
def found() -> GlobalSolution:
    return solve_globally(cartpole(), states(), starts=6, neighbours=3, seed=1)


@lru_cache
def best_known() -> np.ndarray:
    """The least cost of 10 other cold starts a state, and of all that `found` tried."""
    ddp, best = cartpole(), found().best.cost
    controls = cold_controls(ddp, N * 10, 99).reshape(10, N, ddp.intervals, -1)
    for u in controls:
        best = np.minimum(best, ddp.solve(states(), u=u).cost)
    return best


@lru_cache
def bank() -> SolutionBank:
    return SolutionBank.of(cartpole(), found().best)


def test_the_best_known_optimum_is_found_where_a_straight_start_misses():
    missed = straight().cost > 1.01 * best_known()
    assert missed.mean() > 0.1
    assert found().best.success.all()
    assert (found().best.cost < 1.001 * best_known()).mean() > 0.95


def test_neighbours_improve_what_one_start_found():
    alone = solve_globally(cartpole(), states(), starts=1, neighbours=0, rounds=0)
    assert np.array_equal(alone.best.cost, straight().cost)
    helped = solve_globally(cartpole(), states(), starts=1, neighbours=3)
    assert (helped.best.cost <= alone.best.cost).all()
    gained = helped.best.cost < 0.99 * alone.best.cost
    assert gained.sum() >= 1
    assert (helped.best.cost < 1.001 * best_known()).mean() > (alone.best.cost < 1.001 * best_known()).mean()


def test_counts_of_starts_hits_and_optima():
    r = found()
    assert (r.starts > 6).all()
    assert ((r.hits >= 1) & (r.hits <= r.starts)).all()
    assert (r.optima >= 1).all()
    assert (r.optima + r.hits <= r.starts + 1).all()
    assert (r.optima > 1).any()


def test_same_seed_same_answer():
    few = [solve_globally(cartpole(), states()[:4], starts=2, rounds=1, seed=s).best.u for s in (3, 3)]
    assert np.array_equal(*few)


def test_one_state_alone():
    r = solve_globally(cartpole(), states()[0], starts=4, seed=0)
    assert r.best.cost.shape == (1,)
    assert r.best.cost[0] <= straight().cost[0] * (1 + 1e-9)


def test_progress_is_told():
    told: list[str] = []
    solve_globally(cartpole(), states()[:2], starts=2, rounds=1, report=told.append)
    assert told[:2] == ["cold start 1 of 2", "cold start 2 of 2"]
    assert told[2].startswith("neighbours")


def test_cold_controls_are_smooth_in_the_box_and_around_both_centres():
    ddp = DDP(nocl.load_ocp("quadrotor"), intervals=20, threads=1)
    u = cold_controls(ddp, 200, 0)
    s = ddp.ocp.system
    assert u.shape == (200, 20, 4)
    assert ((u >= s.lbu) & (u <= s.ubu)).all()
    assert np.array_equal(u, cold_controls(ddp, 200, 0))
    assert np.abs(np.diff(u, axis=1)).mean() < 0.3 * u.std()
    thrust = u[:, :, 0].mean(axis=1)
    assert (np.abs(thrust - 9.81) < np.abs(thrust)).mean() > 0.4
    assert (np.abs(thrust) < np.abs(thrust - 9.81)).mean() > 0.3


def test_extend_solves_new_states_as_well_as_many_starts():
    new = bank().solution.x[:10, 0] + 0.02 * np.random.default_rng(50).standard_normal((10, 4))
    answer = extend(cartpole(), bank(), new, neighbours=3)
    assert answer.success.all()
    globally = solve_globally(cartpole(), new, starts=6, seed=2).best.cost
    assert (answer.cost < 1.001 * globally).mean() >= 0.9


def test_nearest_is_nearest_at_that_time_and_sorted():
    b, s = bank(), bank().solution
    rng = np.random.default_rng(0)
    rows, t = rng.integers(0, len(b), 30), rng.uniform(0, 4, 30)
    k = (t * 40 / 4).astype(int)
    x = s.x[rows, k] + 1e-6
    found_rows = b.nearest(x, t, count=5)
    assert (found_rows[:, 0] == rows).all()
    distance = np.linalg.norm((s.x[found_rows, k[:, None]] - x[:, None]) / b.scale, axis=2)
    assert (np.diff(distance, axis=1) >= 0).all()
    every = np.linalg.norm((s.x[:, k] - x) / b.scale, axis=2).T
    assert np.allclose(np.sort(every, axis=1)[:, :5], distance)
    assert b.nearest(x, t, count=500).shape == (30, len(b))
    assert b.nearest(np.zeros((0, 4))).shape == (0, 1)


def test_a_guess_lies_on_its_parents_trajectory_and_solves_at_once():
    b, s = bank(), bank().solution
    rows, t0 = np.arange(6), np.array([0.0, 0.1, 0.75, 1.2345, 2.0, 3.9])
    guess = b.guess(rows, t0)
    for i, (row, t) in enumerate(zip(rows, t0, strict=True)):
        times = t + (4 - t) * np.arange(41) / 40
        path = np.stack([np.interp(times, s.t[row], s.x[row, :, j]) for j in range(4)], axis=1)
        assert np.abs(guess["x"][i] - path).max() < 1e-12
        held = s.u[row, np.minimum((times[:-1] + (4 - t) / 80) / 0.1, 39).astype(int)]
        assert np.array_equal(guess["u"][i], held)
    tails = cartpole().solve(guess["x"][:, 0], t0, **guess)
    assert tails.success.all()
    node = np.flatnonzero(np.isclose(t0, [0, 0.1, 0, 0, 2.0, 3.9]))
    k = np.round(t0[node] / 0.1).astype(int)
    # a tail from a node costs what is left of its parent, up to a finer grid of controls
    assert (tails.cost[node] <= s.V[rows[node], k] * (1 + 1e-4) + 1e-9).all()
    whole = cartpole().solve(s.x[:, 0], **b.guess(np.arange(len(b))))
    assert (whole.iterations <= 2).all()
    assert np.abs(whole.cost / s.cost - 1).max() < 1e-9


def test_a_bank_keeps_what_succeeded_and_comes_back_from_arrays():
    s = found().best
    failed = replace(s, success=np.arange(N) % 2 == 0)
    kept = SolutionBank.of(cartpole(), failed)
    assert len(kept) == N // 2
    arrays = {name: value for name, value in vars(s).items() if name not in ("V_xx", "message")}
    again = SolutionBank.from_arrays(cartpole(), arrays)
    assert np.array_equal(again.solution.u, s.u)
    assert np.array_equal(again.scale, bank().scale)
    with pytest.raises(ValueError, match="no problem of cartpole was solved"):
        SolutionBank.of(cartpole(), replace(s, success=np.zeros(N, dtype=bool)))
    with pytest.raises(ValueError, match="from t0 = 0; got t0 up to 0"):
        SolutionBank.of(cartpole(), replace(s, t=s.t + 0.5))
    with pytest.raises(ValueError, match="got no solutions"):
        SolutionBank.of(cartpole(), s[:0])


def test_better_takes_each_row_from_the_cheaper():
    a, b = straight(), found().best
    worse = replace(a, cost=np.where(np.arange(N) % 3 == 0, np.inf, a.cost))
    for first, second in ((worse, b), (b, worse)):
        merged = better(first, second)
        assert np.array_equal(merged.cost, np.minimum(worse.cost, b.cost))
        for i in range(N):
            parent = b if b.cost[i] < worse.cost[i] else worse
            if b.cost[i] != worse.cost[i]:
                assert np.array_equal(merged.u[i], parent.u[i])
                assert np.array_equal(merged.V_x[i], parent.V_x[i])
                assert merged.message[i] == parent.message[i]


def unsolvable() -> DDP:
    """dx/dt = x^3 + u: from far away every start blows up."""
    x, u = ca.SX.sym("x"), ca.SX.sym("u")
    system = nocl.System("escape", x=x, u=u, xdot=x**3 + u, lbu=[-1.0], ubu=[1.0], lbx=[-1.0], ubx=[1.0])
    return DDP(nocl.OCP(system, horizon=2.0, running=u**2, terminal=x**2, x_goal=[0.0], u_goal=[0.0],
                        initial_states=nocl.Uniform(lb=[-0.5], ub=[0.5])), intervals=20, threads=1)


def test_states_without_a_solution_are_told_and_do_not_disturb_others():
    ddp = unsolvable()
    r = solve_globally(ddp, [[0.2], [50.0], [-0.3]], starts=3)
    assert r.best.success.tolist() == [True, False, True]
    assert r.hits[1] == 0
    assert r.optima[1] == 0
    assert np.isinf(r.best.cost[1])
    hopeless = solve_globally(ddp, [[50.0], [-60.0]], starts=2)
    assert not hopeless.best.success.any()
    assert hopeless.starts.tolist() == [2, 2]


def test_settings_are_checked():
    for options in ({"starts": 0}, {"neighbours": -1}, {"rounds": -1}):
        with pytest.raises(ValueError, match="expected starts >= 1"):
            solve_globally(cartpole(), states(), **options)
