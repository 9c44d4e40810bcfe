"""The search over states, with a solver of toys whose basins are known."""

from dataclasses import replace

import numpy as np
import pytest

import nocl
from nocl.data import Solution
from nocl.solvers import DDP, NMPC
from nocl.solvers.mirrors import mirrors
from nocl.solvers.search import Moves, Search
from nocl.solvers.starts import near, random_controls, smooth

K = 4
T = np.array([0.0, 0.1, 0.3, 0.6, 1.0])  # nodes at unequal distances


class Toy:
    """From the controls `good` (or their mirror image) a state costs 1, from others 2; cold starts of `lucky` are good.

    States beyond 9 are never solved.
    """

    good = np.array([1.0, -2.0, 3.0, -4.0])[:, None]

    def __init__(self, x0, lucky=(0,)):
        self.x0, self.lucky, self.told, self.count = x0, lucky, [], 0

    def begin(self, stage, what):
        self.told.append((stage, what))

    def found(self, rows, u):
        x0 = self.x0[rows]
        cost = np.where((np.abs(u) == np.abs(self.good)).all(axis=(1, 2)), 1.0, 2.0)
        cost[x0[:, 0] > 9] = np.inf
        self.count += len(rows)
        blank = Solution.blank(np.tile(T, (len(rows), 1)), 2, 1)
        ok = np.isfinite(cost)
        return rows, replace(blank, x=np.repeat(x0[:, None], K + 1, axis=1), u=u, gain=np.ones((len(rows), K, 1, 2)),
                             cost=cost, success=ok, message=np.where(ok, "converged", "too far"),
                             seconds=np.full(len(rows), 0.5), iterations=np.full(len(rows), 3))

    def cold(self, rows, first, count):
        for _ in range(count):
            yield self.found(rows, np.where(np.isin(rows, self.lucky)[:, None, None], self.good, 0.0))

    def follow(self, moves, guess):
        for part in (slice(0, 2), slice(2, None)):
            yield self.found(moves.row[part], guess(moves[part])["u"])


def problem():
    return nocl.load_ocp("double_integrator")


def search(x0, lucky=(0,), rounds=6, neighbours=2, known=None):
    toy = Toy(x0, lucky)
    made = Search(toy, problem(), mirrors(problem()), x0, T, neighbours=neighbours, rounds=rounds, seed=0, known=known)
    made.stage("cold", made.cold, np.arange(len(x0)), 0, 2)
    made.improve(2)
    return toy, made.solution()


def line(n):
    return np.c_[np.linspace(0.1, 1, n), np.zeros(n)]


def test_what_one_state_found_goes_to_all_and_the_search_ends():
    toy, found = search(line(12))
    assert (found.cost == 1).all()
    assert found.starts.sum() == toy.count
    assert (found.seconds == 0.5 * found.starts).all()
    assert (found.iterations == 3 * found.starts).all()
    assert (found.hits >= 1).all()
    assert max(len(o) for o in found.optima) == 2
    assert toy.told[0] == (1, "cold")
    assert toy.told[1] == (2, "neighbours, round 1")
    assert len(toy.told) <= 7


def test_nothing_to_improve_ends_after_one_round():
    toy, found = search(line(12), lucky=range(12))
    assert [what for _, what in toy.told] == ["cold", "neighbours, round 1"]
    assert (found.cost == 1).all()


def test_a_mirror_image_is_a_neighbour():
    """Two states far apart, one the image of the other: the image's solution is mirrored, and its gain kept."""
    x0 = np.array([[1.0, 0.5], [-1.0, -0.5]])
    _, found = search(x0, rounds=1, neighbours=1)
    assert (found.cost == 1).all()
    assert np.array_equal(found.u[1], -found.u[0])


def test_states_without_a_solution_stay_so_and_disturb_nobody():
    x0 = np.vstack([line(4), [[20.0, 0.0]]])
    _, found = search(x0)
    assert found.success.tolist() == [True] * 4 + [False]
    assert (found.cost[:4] == 1).all()
    assert found.hits[4] == 0
    assert found.message[4] == "too far"
    toy, none = search(np.array([[20.0, 0.0], [30.0, 0.0]]))
    assert not none.success.any()
    assert none.starts.tolist() == [2, 2]
    assert [what for _, what in toy.told] == ["cold", "neighbours, round 1"]


def test_known_solutions_are_where_it_begins():
    x0 = line(3)
    _, known = Toy(x0, ()).found(np.arange(3), np.tile(Toy.good, (3, 1, 1)))
    toy, found = search(x0, lucky=(), known=known)
    assert (found.cost == 1).all()
    assert found.starts.sum() == toy.count + 3


def test_a_start_from_another_state_is_as_it_is_stretched_or_held():
    x0 = line(2)
    made = Search(Toy(x0), problem(), mirrors(problem()), x0, T, neighbours=1, rounds=1, seed=0)
    made.stage("cold", made.cold, np.arange(2), 0, 1)
    made.best.x[0, :, 0], made.best.x[0, :, 1] = T, 2 * T  # x(t) = (t, 2 t)
    zero, two = np.zeros(4, dtype=int), np.array([0, 0, 0, 1])
    moves = Moves(zero + 1, zero, two, np.array([0.0, 0.3, 0.3, 0.0]), np.array([False, False, True, False]))
    guess = made.guess(moves)
    at = np.array([T, 0.3 + 0.7 * T, np.minimum(0.3 + T, 1.0), -T])
    assert guess["x"] == pytest.approx(np.stack([at, 2 * at], axis=2))
    u = Toy.good[:, 0]
    assert guess["u"][0, :, 0].tolist() == u.tolist()
    assert guess["u"][1, :, 0].tolist() == [u[2], u[2], u[3], u[3]]  # middles 0.335, 0.44, 0.615, 0.86
    assert guess["u"][2, :, 0].tolist() == [u[2], u[2], u[3], u[3]]  # middles 0.35, 0.5, 0.75, 0.95
    assert guess["u"][3, :, 0].tolist() == (-u).tolist()
    assert (guess["gain"] == 1).all()  # du and dx change their signs together


def test_random_controls_are_smooth_in_the_box_and_around_both_centres():
    ocp = nocl.load_ocp("quadrotor")
    s, u = ocp.system, random_controls(ocp, 20, 200, 0)
    assert u.shape == (200, 20, 4)
    assert ((u >= s.lbu) & (u <= s.ubu)).all()
    assert np.array_equal(u, random_controls(ocp, 20, 200, 0))
    assert np.abs(np.diff(u, axis=1)).mean() < 0.3 * u.std()
    thrust = u[:, :, 0].mean(axis=1)
    assert (np.abs(thrust - 9.81) < np.abs(thrust)).mean() > 0.4
    assert (np.abs(thrust) < np.abs(thrust - 9.81)).mean() > 0.3
    assert smooth(s, 20, 3, np.random.default_rng(0)).shape == (3, 20, 4)


def test_rollouts_near_the_box_and_wild_ones():
    s = problem().system
    width, middle = s.ubx - s.lbx, (s.ubx + s.lbx) / 2
    steps = np.linspace(0, 1, 5)[:, None]
    inside, out, began_outside = middle + steps * width, middle + 3 * steps * width, middle + (3 - steps) * width
    lost = np.where(steps > 0.5, np.nan, inside)
    assert near(s, np.stack([inside, out, began_outside, lost])).tolist() == [True, False, True, False]


@pytest.mark.parametrize("solver", ["NMPC", "DDP"])
def test_both_solvers_find_the_cheaper_side_by_the_same_search(solver):
    """States whose only cold start falls into the dear valley are told by the others."""
    from test_nmpc import two_valleys

    from nocl.solvers import solve_globally

    ocp = two_valleys()
    x0 = np.c_[np.r_[np.linspace(0.3, 0.5, 6), -0.5, -0.3], np.full(8, -1.0)]
    if solver == "NMPC":
        alone, found = (NMPC(ocp, 20, starts=1, passes=p).solve(x0, workers=1) for p in (0, 4))
    else:
        ddp = DDP(ocp, intervals=20, threads=1)
        alone, found = (solve_globally(ddp, x0, starts=1, rounds=r) for r in (0, 8))
    assert (alone.cost[:6] > 1.5 * found.cost[:6]).sum() >= 3  # which, the one random start decides
    assert (found.cost[:6] < 0.45).all()
