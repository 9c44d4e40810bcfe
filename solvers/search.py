"""The search for global optima of many states at once, by any solver.

1. Cold starts of each state: the solver has its own (what it holds, follows or draws is for it to say).
2. Rounds, until one improves nothing. In a round each state is solved from the solutions of the nearest states that it
   was not solved from before, and their mirror images where the problem has a symmetry; from one that passes near it at
   a later time; from that of any other state, since neighbours alone come to rest where a whole region shares a wrong
   basin; and states whose best is in doubt get fresh cold starts.

How many of each are the constants below, for every solver. benchmarks/search.py compares sets of them on four problems:
of eight, none finds the best known optimum of more states, of 200 by DDP and of 8 by NMPC. Fresh starts of states in
doubt alone find as many with 3 to 17 % fewer iterations; the random share of the others stays, for a region whose
neighbours agree on a wrong optimum (benchmarks/results/search.json).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, fields, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from nocl.data import TINY, Solution, hits
from nocl.definition import measured
from nocl.definition.ocp import OCP
from nocl.definition.sampling import box
from nocl.definition.scales import usual_sizes
from nocl.solvers.mirrors import Mirror, mirrored
from nocl.support.checks import Array

Rows = NDArray[np.int64]
Found = Iterable[tuple[Rows, Solution]]  # solutions of states `rows`; a state may stand there more than once

MORE = 1  # neighbours more in each round
PASSING = 1  # solutions that pass by, in each round
AFAR = 0  # solutions of any other states, in each round
FRESH = 1  # cold starts in each round, of states in doubt:
TWICE, SURE = 2, 0.0  # those whose best was found less often than that, or by a smaller share of their starts
SHARE = 0.5  # ... and a random share of the others
IMPROVED = 1e-6  # a cost lower by this share counts as an improvement
LATEST = 0.7  # of the horizon: until when a solution that passes by is of use
NODES = 200_000  # of solutions, at most, that are looked at for passing by
NEAR = 8  # ... of which that many, the nearest, are drawn from


@dataclass(frozen=True, eq=False)
class Moves:
    """Starts of states from other states' solutions, one a row."""

    row: Rows  # the state
    parent: Rows  # whose solution it starts from
    image: Rows  # 0: as it is; i: its mirror image i - 1
    begin: Array  # the time from which on the parent's solution is taken
    held: NDArray[np.bool_]  # as fast, and held at its last node; else stretched to the whole time

    def __len__(self) -> int:
        return len(self.row)

    def __getitem__(self, rows: Any) -> Moves:
        return Moves(*(getattr(self, f.name)[rows] for f in fields(self)))

    @staticmethod
    def join(parts: Iterable[Moves]) -> Moves:
        moves = list(parts)
        return Moves(*(np.concatenate([getattr(m, f.name) for m in moves]) for f in fields(Moves)))


Guess = dict[str, Array]  # x [n, K+1, nx], u [n, K, nu], gain [n, K, nu, nx] of n moves; t [n, K+1] of free horizons


class Solver(Protocol):
    """What a search asks of a solver, for the states that both were made for."""

    def begin(self, stage: int, what: str) -> None:
        """A stage begins: the number and the words that its tasks, files and bars go by."""

    def cold(self, rows: Rows, first: int, count: int) -> Found:
        """The states solved from their cold starts number first, first + 1, ..., `count` of them."""

    def follow(self, moves: Moves, guess: Callable[[Moves], Guess]) -> Found:
        """The states solved from guess(moves), as many moves at a time as fit."""


class Search:
    """The best of all that was tried from each state x0 [B, nx] on the nodes t [K+1].

    p : the parameters of each state's problem [B, np], where there are some: they count in distances as states do
    known : solutions of the same states to begin with; neighbours, rounds : at most, 0 for none
    """

    def __init__(self, solver: Solver, ocp: OCP, mirrors: list[Mirror], x0: Array, t: Array, *, neighbours: int,
                 rounds: int, seed: int, known: Solution | None = None, p: Array | None = None) -> None:
        self.solver, self.ocp, self.mirrors, self.x0, self.t = solver, ocp, mirrors, x0, t
        self.neighbours, self.rounds, self.seed = neighbours, rounds, seed
        self.unit = usual_sizes(ocp).cost
        self.p = np.zeros((len(x0), 0)) if p is None else p
        self.best = Solution.blank(np.tile(t, (len(x0), 1)), x0.shape[1], ocp.system.nu, self.p)
        self.seconds, self.iterations = np.zeros(len(x0)), np.zeros(len(x0), dtype=np.int64)
        self.owners, self.costs = [np.zeros(0, dtype=np.int64)], [np.zeros(0)]  # of each start: its state, how it ended
        self.near: tuple[Rows, Rows, Array] | None = None  # each state's neighbours: state, image, cost when tried
        self.stages = 0
        self.improving = True  # whether the last stage found anything
        self._take([] if known is None else [(np.arange(len(x0)), known)])

    def stage(self, what: str, run: Callable[..., None], *args: Any) -> None:
        """A part of the search, with random numbers of its own."""
        self.stages += 1
        self.rng = np.random.default_rng([self.seed, self.stages])
        self.solver.begin(self.stages, what)
        former, rank = self.best.cost.copy(), self.best.rank
        run(*args)
        now, cost = self.best.rank, self.best.cost
        self.improving = bool(((now < rank) | (now == rank) & _improved(former, cost, self.unit)).any())

    def improve(self, starts: int) -> None:
        """Rounds until one improves nothing; fresh cold starts are numbered from `starts` on."""
        for number in range(self.rounds):
            self.stage(f"neighbours, round {number + 1}", self._round, number, starts)
            if not self.improving:
                return

    def cold(self, rows: Rows, first: int, count: int) -> None:
        self._take(self.solver.cold(rows, first, count))

    def _round(self, number: int, starts: int) -> None:
        solved = np.flatnonzero(self.best.success)
        if not len(solved):
            return
        if self.neighbours:
            scale = spread(self.ocp, self.best.x[solved], self.p)
            moves = [*self._near(scale, self.neighbours + MORE * number),
                     *(self._passing(solved, scale) for _ in range(PASSING)),
                     *(self._afar(solved) for _ in range(AFAR))]
            self._take(self.solver.follow(Moves.join(moves), self.guess) if moves else [])
        self.cold(self._doubtful(), starts + FRESH * number, FRESH)

    def _near(self, scale: Array, count: int) -> Iterator[Moves]:
        """The `count` nearest others and mirror images, whose solution is new to the state."""
        if self.near is None:
            self.near = self._neighbours(scale, self.neighbours + MORE * self.rounds)
        others, images, tried = self.near
        for column in range(min(count, others.shape[1])):
            cost = self.best.cost[others[:, column]]
            rows = np.flatnonzero(np.isfinite(cost) & (cost != tried[:, column]))
            tried[rows, column] = cost[rows]
            yield self._from_start(rows, others[rows, column], images[rows, column])

    def _passing(self, solved: Rows, scale: Array) -> Moves:
        """One of the NEAR solutions that pass nearest to the state at a later time."""
        K, B = len(self.t) - 1, len(self.x0)
        last = max(int(LATEST * K), 1)
        chosen = np.arange(len(solved) * last)
        if len(chosen) > NODES:
            chosen = self.rng.choice(len(chosen), NODES, replace=False)
        parent, node = solved[chosen // last], 1 + chosen % last
        there = np.c_[self.best.x[parent, node], self.p[parent]]
        place, image = _nearest(there, scale, self._images(), NEAR)
        weight = self.rng.random(place.shape) * (parent[place] != np.arange(B)[:, None])
        pick = (np.arange(B), weight.argmax(axis=1))
        held, rows = self.rng.random(B) < 0.5, np.flatnonzero(weight.max(axis=1) > 0)
        return Moves(np.arange(B), parent[place[pick]], image[pick], self.t[node[place[pick]]], held)[rows]

    def _afar(self, solved: Rows) -> Moves:
        """That of any other state."""
        parent = self.rng.choice(solved, len(self.x0))
        rows = np.flatnonzero(parent != np.arange(len(self.x0)))
        return self._from_start(rows, parent[rows], np.zeros(len(rows), dtype=np.int64))

    def _from_start(self, rows: Rows, parent: Rows, image: Rows) -> Moves:
        return Moves(rows, parent, image, np.full(len(rows), self.t[0]), np.zeros(len(rows), dtype=bool))

    def _doubtful(self) -> Rows:
        """States whose best was found seldom, and a random SHARE of the others."""
        tried = self._tried()
        seldom = hits(tried, self.best.cost, self.unit) < np.maximum(TWICE, SURE * (~np.isnan(tried)).sum(axis=1))
        return np.flatnonzero((self.rng.random(len(self.x0)) < SHARE) | seldom)

    def guess(self, moves: Moves) -> Guess:
        """What the moves start from, on the search's own nodes, or where the horizon is free on what is left of the
        parent's."""
        t, start, begin = self.t, self.t[0], moves.begin[:, None]
        part, held = (t - start) / (t[-1] - start), moves.held[:, None] & (not self.ocp.is_free)
        times = np.where(held, np.minimum(begin + t - start, t[-1]), begin + (t[-1] - begin) * part)
        row, s = moves.parent[:, None], self.best
        k, between = self._interval(times[:, :-1] + np.diff(times) / 2), self._interval(times)
        share = ((times - t[between]) / np.diff(t)[between])[..., None]
        x, u, gain = (1 - share) * s.x[row, between] + share * s.x[row, between + 1], s.u[row, k], s.gain[row, k]
        for i, mirror in enumerate(self.mirrors, 1):
            at = moves.image == i
            x[at], u[at] = mirrored(self.ocp, mirror, x[at], u[at], self.p[moves.parent[at]])
            gain[at] *= mirror[1][:, None] * mirror[0]
        if not self.ocp.is_free:
            return {"x": x, "u": u, "gain": gain}
        left = s.t[moves.parent, -1:] * (1 - (begin - start) / (t[-1] - start))
        return {"x": x, "u": u, "gain": gain, "t": np.clip(left, self.ocp.horizon.low, self.ocp.horizon.high) * part}

    def _interval(self, times: Array) -> Rows:
        return np.clip(np.searchsorted(self.t, times, side="right") - 1, 0, len(self.t) - 2)

    def _neighbours(self, scale: Array, count: int) -> tuple[Rows, Rows, Array]:
        state, image = _nearest(np.c_[self.x0, self.p], scale, self._images(), count + 1)
        own = (state == np.arange(len(self.x0))[:, None]) & (image == 0)
        order = np.argsort(own, axis=1, kind="stable")[:, :-1]  # itself, the nearest, goes last and away
        state, image = (np.take_along_axis(a, order, axis=1) for a in (state, image))
        return state, image, np.full(state.shape, np.nan)

    def _images(self) -> list[Array]:
        """The states with their parameters, and their mirror images."""
        u = self.ocp.goals(self.p)[1]
        images = (mirrored(self.ocp, mirror, self.x0, u, self.p)[0] for mirror in self.mirrors)
        return [np.c_[x, self.p] for x in (self.x0, *images)]

    def _take(self, found: Found) -> None:
        """Count all that was tried, and keep what is better."""
        for rows, s in found:
            own = s.cost if s.cut is None else np.where(s.cut, np.inf, s.cost)  # what cuts corners is no such optimum
            tried = own[:, None] if s.tried is None else s.tried
            known = ~np.isnan(tried)
            self.owners.append(np.repeat(rows, known.sum(axis=1)))
            self.costs.append(tried[known])
            np.add.at(self.seconds, rows, s.seconds)
            np.add.at(self.iterations, rows, s.iterations)
            order = np.lexsort((s.cost, s.rank, rows))
            state, first = np.unique(rows[order], return_index=True)
            self._take_better(state, s[order[first]])

    def _take_better(self, state: Rows, s: Solution) -> None:
        """What is better than the best so far of these states, or follows a failure."""
        if s.cut is not None and self.best.cut is None:
            self.best = replace(self.best, cut=np.zeros(len(self.x0), dtype=bool))
        former = self.best[state]
        cheaper = (s.rank == former.rank) & (s.cost < former.cost)
        won = (s.rank < former.rank) | cheaper | ~former.success
        self.best.put(state[won], s[won])

    def _tried(self) -> Array:
        """The cost that each start ended at [B, most], NaN where there were fewer."""
        owners, costs = np.concatenate(self.owners), np.concatenate(self.costs)
        starts = np.bincount(owners, minlength=len(self.x0))
        table = np.full((len(self.x0), max(starts, default=0)), np.nan)
        order = np.argsort(owners, kind="stable")
        column = np.arange(len(owners)) - np.repeat(np.cumsum(starts) - starts, starts)
        table[owners[order], column] = costs[order]
        return table

    def solution(self) -> Solution:
        """The best of each state; seconds, iterations and `tried` are of all starts."""
        best = self.best
        clearance = measured.clearance(self.ocp, best.x, best.u, best.t, self.p)
        return replace(best, clearance=clearance, seconds=self.seconds, iterations=self.iterations,
                       tried=self._tried(), unit=np.full(len(self.x0), self.unit))


def spread(ocp: OCP, x: Array, p: Array | None = None) -> Array:
    """The states' standard deviations along solutions x [B, K+1, nx], at least 5 % of X, then those of the parameters
    p [B, np], at least 5 % of their box: one unit of distance [nx + np].
    """
    states = np.maximum(x.std(axis=(0, 1)), 0.05 * (ocp.system.ubx - ocp.system.lbx))
    if p is None or ocp.parameters is None:
        return np.asarray(states)
    low, high = box(ocp.parameters)
    least = np.where(high > low, 0.05 * (high - low), 1.0)
    return np.r_[states, np.maximum(p.std(axis=0), least)]


def _nearest(points: Array, scale: Array, images: list[Array], count: int) -> tuple[Rows, Rows]:
    """For each row of the images [B, nx] of some states, the `count` points nearest to any: (point, image) [B, count].
    """
    tree, count = KDTree(points / scale), min(count, len(points))
    found = [tree.query(image / scale, list(range(1, count + 1))) for image in images]
    distance, place = (np.concatenate([f[i] for f in found], axis=1) for i in (0, 1))
    order = np.argsort(distance, axis=1, kind="stable")[:, :count]
    return np.take_along_axis(place, order, axis=1), order // count


def _improved(former: Array, now: Array, unit: float) -> NDArray[np.bool_]:
    finite = np.where(np.isfinite(former), former, 0.0)
    least = np.maximum(IMPROVED * np.abs(finite), TINY * unit)
    return np.where(np.isfinite(former), now < finite - least, np.isfinite(now))
