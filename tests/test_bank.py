"""Global optima by batches: what cold starts, neighbours and a bank add to a single straight start."""

from dataclasses import replace
from functools import lru_cache

import casadi as ca
import numpy as np
import pytest

import nocl
from nocl.data import Solution
from nocl.solvers.ddp.bank import SolutionBank, better, extend
from nocl.solvers.ddp.global_search import GlobalDDP, clean, equilibria, solve_globally
from nocl.solvers.ddp.solver import DDP
from nocl.solvers.starts import random_controls

N = 24


@lru_cache
def cartpole() -> DDP:
    return DDP(nocl.load_ocp("cartpole"), intervals=40, threads=1)


@lru_cache
def states() -> np.ndarray:
    """From wide round the pole's circle, where rival swings exist."""
    return np.random.default_rng(7).uniform([-1, -2, -np.pi, -3], [1, 2, np.pi, 3], (N, 4))


@lru_cache
def straight() -> Solution:
    return cartpole().solve(states())


@lru_cache
def found() -> Solution:
    return solve_globally(cartpole(), states(), starts=6, neighbours=3, seed=1)


@lru_cache
def best_known() -> np.ndarray:
    """The least cost of 10 other cold starts a state, and of all that `found` tried."""
    ddp, best = cartpole(), found().cost
    controls = random_controls(ddp.ocp, ddp.intervals, N * 10, 99).reshape(10, N, ddp.intervals, -1)
    for u in controls:
        best = np.minimum(best, ddp.solve(states(), u=u).cost)
    return best


@lru_cache
def bank() -> SolutionBank:
    return SolutionBank.of(cartpole(), found())


@pytest.mark.slow
def test_the_best_known_optimum_is_found_where_a_straight_start_misses():
    missed = straight().cost > 1.01 * best_known()
    assert missed.mean() > 0.1
    assert found().success.all()
    assert (found().cost > 1.001 * best_known()).sum() <= missed.sum() / 4  # none of 24, but basins are chaotic


def test_neighbours_improve_what_one_start_found():
    alone = solve_globally(cartpole(), states(), starts=1, neighbours=0, rounds=0)
    assert np.array_equal(alone.cost, straight().cost)
    helped = solve_globally(cartpole(), states(), starts=1, neighbours=3)
    assert (helped.cost <= alone.cost).all()
    assert (helped.cost < 0.99 * alone.cost).sum() >= 1
    assert (helped.cost < 1.001 * best_known()).mean() > (alone.cost < 1.001 * best_known()).mean()


def test_a_mirror_image_has_the_mirrored_answer():
    x0 = states()[:6]
    both = solve_globally(cartpole(), np.vstack([x0, -x0]), starts=3, neighbours=3, seed=4)
    assert np.allclose(both.cost[:6], both.cost[6:], rtol=1e-6)
    same = np.abs(both.u[:6] + both.u[6:]).max(axis=(1, 2)) < 1e-4
    assert same.mean() > 0.8  # others have two optima of the same cost


def test_a_pole_that_can_be_caught_is():
    """Random controls, in open loop, rarely stumble on the catch that the held goal starts from."""
    x0 = [[1.04, -0.03, -1.39, 3.44]]
    assert solve_globally(cartpole(), x0, starts=2, rounds=0).cost[0] < 0.01
    blind = cartpole().solve(np.repeat(x0, 20, axis=0), u=random_controls(cartpole().ocp, 40, 20, 0))
    assert (blind.cost < 0.01).mean() < 0.2


def test_equilibria_are_rest_points_in_the_box_the_goal_first():
    for name in ("cartpole", "acrobot", "quadrotor"):
        ocp = nocl.load_ocp(name)
        s, z = ocp.system, equilibria(ocp, 16, np.random.default_rng(0))
        x, u = np.split(z, [s.nx], axis=1)
        assert len(z) > 4
        assert np.array_equal(z[0], np.r_[ocp.x_goal, ocp.u_goal])
        assert np.abs(s.f(x.T, u.T).full()).max() < 1e-8
        assert ((x >= s.lbx) & (x <= s.ubx)).all()
        assert ((u >= s.lbu) & (u <= s.ubu)).all()


def test_counts_of_starts_hits_and_optima():
    r = found()
    assert (r.starts > 6).all()
    assert ((r.hits >= 1) & (r.hits <= r.starts)).all()
    for i, optima in enumerate(r.optima):
        assert optima[0, 0] == r.cost[i]
        assert optima[0, 1] <= r.hits[i]
        assert optima[:, 1].sum() <= r.starts[i]
        assert (np.diff(optima[:, 0]) > 1e-3 * optima[1:, 0]).all()
    assert max(map(len, r.optima)) > 1


def test_same_seed_same_answer_however_many_threads():
    few = [solve_globally(cartpole(), states()[:4], starts=3, rounds=1, seed=3, workers=w).u for w in ("auto", 2)]
    assert np.array_equal(*few)


def test_one_state_alone_and_as_a_solver():
    r = solve_globally(cartpole(), states()[0], starts=4, seed=0)
    assert r.cost.shape == (1,)
    assert r.cost[0] <= straight().cost[0] * (1 + 1e-9)
    assert np.array_equal(GlobalDDP(cartpole(), 4, 0).solve(states()[0]).cost, r.cost)


def test_progress_is_told():
    told: list[str] = []
    solve_globally(cartpole(), states()[:2], starts=2, rounds=1, report=told.append)
    assert told == ["cold start 1 of 2", "cold start 2 of 2", "neighbours, round 1"]


def test_an_interrupted_search_goes_on_where_it_was(tmp_path, monkeypatch):
    """Whole stages and pieces of a stage are read, not done again; the answer is that of one go."""
    x0, options = states()[:8], {"starts": 4, "rounds": 3, "neighbours": 2, "seed": 5}
    whole, solved, descend = solve_globally(cartpole(), x0, **options), [], DDP.descend

    def interrupted(self, batch):
        if len(solved) == 6:
            raise KeyboardInterrupt
        solved.append(batch.size)
        return descend(self, batch)

    with monkeypatch.context() as m:
        m.setattr(DDP, "descend", interrupted)
        with pytest.raises(KeyboardInterrupt):
            solve_globally(cartpole(), x0, **options, out=tmp_path / "s")
    before = sum(solved)
    solved.clear()
    monkeypatch.setattr(DDP, "descend", lambda self, batch: solved.append(batch.size) or descend(self, batch))
    again = solve_globally(cartpole(), x0, **options, out=tmp_path / "s")
    assert np.array_equal(again.u, whole.u)
    assert np.array_equal(again.starts, whole.starts)
    assert before + sum(solved) == whole.starts.sum()
    solved.clear()
    third = solve_globally(cartpole(), x0, **options, out=tmp_path / "s")
    assert not solved
    assert np.array_equal(third.hits, whole.hits)
    assert [p.name for p in (tmp_path / "s").iterdir()] == ["search.safetensors"]
    with pytest.raises(ValueError, match="another search"):
        solve_globally(cartpole(), x0[:3], **options, out=tmp_path / "s")
    with pytest.raises(ValueError, match="another search"):
        solve_globally(cartpole(), x0, **options | {"starts": 6}, out=tmp_path / "s")
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "thesis.tex").write_text("mine")
    with pytest.raises(ValueError, match="not empty"):
        solve_globally(cartpole(), x0, **options, out=tmp_path / "full")


def test_extend_is_the_best_descent_from_its_neighbours():
    near = bank().solution.x[:10, 0] + 0.02 * np.random.default_rng(50).standard_normal((10, 4))
    answer, rows = extend(cartpole(), bank(), near, neighbours=3), bank().nearest(near, count=3)
    each = [cartpole().solve(near, **bank().guess(column)).cost for column in rows.T]
    assert answer.success.all()
    assert np.array_equal(answer.cost, np.min(each, axis=0))
    late = extend(cartpole(), bank(), bank().solution.x[:10, 20], t0=2.0)
    assert (late.t[:, 0] == 2.0).all()
    assert (late.cost <= bank().solution.V[:10, 20] * (1 + 1e-4)).all()
    with pytest.raises(ValueError, match="neighbours is 0"):
        extend(cartpole(), bank(), near, neighbours=0)


def test_of_many_neighbours_those_are_followed_that_are_cheapest_after_one_iteration():
    x0, b = states()[:10] + 0.1, bank()
    rows = b.nearest(x0, count=6)
    first = np.array([cartpole().attempt(x0, **b.guess(column, 0.0, x0))[0] for column in rows.T])
    each = np.array([cartpole().solve(x0, **b.guess(column, 0.0, x0)).cost for column in rows.T])
    promising = np.argsort(first, axis=0)[:2]
    two, all_six = (extend(cartpole(), b, x0, neighbours=6, kept=kept) for kept in (2, None))
    np.testing.assert_allclose(two.cost, np.take_along_axis(each, promising, axis=0).min(axis=0), rtol=1e-9)
    assert (all_six.cost <= two.cost * (1 + 1e-9)).all()
    assert two.iterations.sum() < all_six.iterations.sum() / 2


def test_an_attempt_goes_as_far_as_it_is_told():
    x0, solved = states()[:8], straight()[:8].success
    begin, two = (cartpole().attempt(x0, iterations=n) for n in (1, 20))
    whole, u = cartpole().attempt(x0, iterations=200)
    assert two[1].shape == u.shape == (8, 40, 1)
    assert (two[0] < begin[0]).all()
    assert (whole <= two[0]).all()
    np.testing.assert_allclose(whole[solved], straight().cost[:8][solved], rtol=1e-9)
    assert (cartpole().attempt(x0, u=two[1])[0] <= two[0]).all()


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


def test_interpolation_is_the_local_model_of_the_nearest_solution():
    ddp = cartpole()
    full = ddp.solve(bank().solution.x[:, 0], **bank().guess(np.arange(len(bank()))), curvature=True)
    b, s = SolutionBank.of(ddp, full), full
    u, V, V_x = b.interpolate(s.x[:, 7], 0.7)
    assert np.abs(u - s.u[:, 7]).max() < 1e-9
    assert np.abs(V - s.V[:, 7]).max() < 1e-9
    assert np.abs(V_x - s.V_x[:, 7]).max() < 1e-9
    x = s.x[:4, 0] + 0.003
    true = ddp.solve(x, u=s.u[:4], x=s.x[:4], gain=s.gain[:4])
    for candidate, order in ((b, 3), (SolutionBank.of(ddp, replace(full, V_xx=None)), 2)):
        u, V, V_x = candidate.interpolate(x)
        assert np.abs(V - true.cost).max() < 10.0 ** -(2 * order) * (1 + order)
        assert np.abs(u - true.u[:, 0]).max() < 0.02
    assert np.abs(b.interpolate(x)[2] - true.V_x[:, 0]).max() < 1e-3


def test_a_bank_keeps_what_succeeded_and_comes_back_from_arrays():
    s = found()
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
    with pytest.raises(ValueError, match=r"by their gain, which is NaN: .*gains=True"):
        SolutionBank.of(cartpole(), replace(s, gain=np.full_like(s.gain, np.nan)))


def test_a_bank_grows_and_keeps_the_cheaper_of_two():
    good, poor = found(), straight()
    small = SolutionBank.of(cartpole(), poor[:10])
    grown = small.add(good)
    assert len(grown) == N
    rows = grown.nearest(states())[:, 0]
    assert np.array_equal(grown.solution.x[rows, 0], states())
    assert np.array_equal(grown.solution.cost[rows],
                          np.minimum(good.cost, np.where(np.arange(N) < 10, poor.cost, np.inf)))
    assert len(grown.add(poor)) == N
    with pytest.raises(ValueError, match="solve them by the same DDP"):
        small.add(replace(good, u=good.u[:, ::2]))


def test_a_clean_bank_costs_less():
    dirty = SolutionBank.of(cartpole(), straight())
    cleaned = clean(cartpole(), dirty, neighbours=3, rounds=2)
    assert (cleaned.solution.cost <= dirty.solution.cost).all()
    assert (cleaned.solution.cost < 0.99 * dirty.solution.cost).sum() >= 2


def test_a_saved_bank_is_the_same_and_others_are_refused(tmp_path):
    path = bank().save(tmp_path / "b")
    again = SolutionBank.load(tmp_path / "b")
    assert np.array_equal(again.scale, bank().scale)
    for name, value in bank().solution.arrays().items():
        assert np.array_equal(getattr(again.solution, name), value), name
    assert [p.name for p in path.parent.iterdir()] == ["bank.safetensors"]
    with pytest.raises(ValueError, match="does not exist"):
        SolutionBank.load(tmp_path)
    nocl.support.store.save_checkpoint(tmp_path / "bank.safetensors", {})
    with pytest.raises(ValueError, match="no solution bank"):
        SolutionBank.load(tmp_path)
    content = bytearray(path.read_bytes())
    content[-5] ^= 1
    path.write_bytes(content)
    with pytest.raises(ValueError, match="altered"):
        SolutionBank.load(tmp_path / "b")


def test_better_takes_each_row_from_the_cheaper():
    a, b = straight(), found()
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
    assert r.success.tolist() == [True, False, True]
    assert r.hits[1] == 0
    assert len(r.optima[1]) == 0
    assert np.isinf(r.cost[1])
    assert "blows up" in r.message[1]
    hopeless = solve_globally(ddp, [[50.0], [-60.0]], starts=2)
    assert not hopeless.success.any()
    assert hopeless.starts.tolist() == [2, 2]


def test_settings_are_checked():
    for options in ({"starts": 0}, {"neighbours": -1}, {"rounds": -1}):
        with pytest.raises(ValueError, match="expected starts >= 1"):
            solve_globally(cartpole(), states(), **options)
