"""Global optima by the batch: cold starts, neighbours re-solved from each other, a bank of solutions to start from."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import KDTree

from nocl import checks
from nocl.checks import Array
from nocl.sampling import Seed
from nocl.solvers.ddp import DDP, DDPSolution

Report = Callable[[str], None]  # told what is being done
IMPROVED = 1e-6  # a cost lower by this share counts as an improvement
SAME = 1e-3  # costs within this share count as the same optimum
TINY = 1e-10  # ... and costs below it are equal


@dataclass(frozen=True, eq=False)
class SolutionBank:
    """Solutions on [0, T], one a row, as guesses for other problems (x0, t0)."""

    solution: DDPSolution
    scale: Array  # [nx], one unit of distance in each state

    def __len__(self) -> int:
        return len(self.solution)

    @staticmethod
    def of(ddp: DDP, solution: DDPSolution) -> SolutionBank:
        """A bank of the solutions that succeeded; states are compared in units of their spread along them."""
        if (solution.t[:, 0] != 0).any():
            raise ValueError(f"a bank holds solutions from t0 = 0; got t0 up to {solution.t[:, 0].max():g}: solve them "
                             "from t0 = 0")
        kept = solution[solution.success]
        if not len(solution):
            raise ValueError(f"a bank of {ddp.ocp.system.name} got no solutions; expected at least one")
        if not len(kept):
            raise ValueError(f"no problem of {ddp.ocp.system.name} was solved ({solution.message[0]}): check the "
                             "horizon, the bounds and the costs, or give guesses of your own to DDP.solve(x0, u=...)")
        box = np.asarray(ddp.ocp.system.ubx) - ddp.ocp.system.lbx
        return SolutionBank(kept, np.maximum(kept.x.std(axis=(0, 1)), 0.05 * box))

    @staticmethod
    def from_arrays(ddp: DDP, arrays: dict[str, Any]) -> SolutionBank:
        """The bank of a solution's arrays, as a checkpoint keeps them."""
        message = np.full(len(arrays["cost"]), "converged")
        return SolutionBank.of(ddp, DDPSolution(**arrays, V_xx=None, message=message))

    def nearest(self, x: Array, t: ArrayLike = 0.0, count: int = 1) -> NDArray[np.int64]:
        """The `count` rows whose states at t (at the last node before it) are nearest to x [B, nx], the nearest first.

        t: a number or [B]. Returns [B, count], fewer columns where the bank has fewer rows.
        """
        columns = list(range(1, min(count, len(self)) + 1))
        found = np.empty((len(x), len(columns)), dtype=np.int64)
        interval = np.broadcast_to(self._interval(t), len(x))
        for k in np.unique(interval):
            here = interval == k
            tree = KDTree(self.solution.x[:, k] / self.scale)
            found[here] = tree.query(x[here] / self.scale, columns)[1]
        return found

    def guess(self, rows: NDArray[np.int64], t0: ArrayLike = 0.0) -> dict[str, Array]:
        """What DDP.solve starts from: solutions `rows` [B] resampled onto their own [t0, T], as u, x and gain."""
        s, K = self.solution, self.solution.u.shape[1]
        start = np.broadcast_to(np.asarray(t0, dtype=np.float64), rows.shape)
        times = start[:, None] + (self._horizon - start)[:, None] * np.arange(K + 1) / K
        k = self._interval(times[:, :-1] + np.diff(times) / 2)
        row = rows[:, None]
        return {"u": s.u[row, k], "x": self.states(rows, times), "gain": s.gain[row, k]}

    def states(self, rows: NDArray[np.int64], t: Array) -> Array:
        """x of solutions rows [B] at times t [B, n], linear between nodes: [B, n, nx]."""
        k, row = self._interval(t), rows[:, None]
        part = (t * self.solution.u.shape[1] / self._horizon - k)[..., None]
        return (1 - part) * self.solution.x[row, k] + part * self.solution.x[row, k + 1]

    @property
    def _horizon(self) -> float:
        return float(self.solution.t[0, -1])

    def _interval(self, t: ArrayLike) -> NDArray[np.int64]:
        K = self.solution.u.shape[1]
        return np.clip((np.asarray(t) * K / self._horizon).astype(np.int64), 0, K - 1)


@dataclass(frozen=True, eq=False)
class GlobalSolution:
    """The best solution found of each problem, and how sure that is."""

    best: DDPSolution
    starts: NDArray[np.int64]  # [B], starts tried in all
    hits: NDArray[np.int64]  # [B], how many of them ended at the best cost
    optima: NDArray[np.int64]  # [B], how many different costs (SAME apart) the starts ended at


def cold_controls(ddp: DDP, n: int, seed: Seed) -> Array:
    """n smooth random control histories [n, K, nu] in U, about u* or the middle of U, small to full amplitude."""
    rng, system, K = np.random.default_rng(seed), ddp.ocp.system, ddp.intervals
    lb, ub = np.asarray(system.lbu), np.asarray(system.ubu)
    order = np.arange(8)
    waves = np.cos(np.pi * order[:, None] * (np.arange(K) + 0.5) / K) / (1 + order)[:, None]
    shape = np.einsum("bmk,kt->btm", rng.standard_normal((n, system.nu, 8)), waves)
    amplitude = np.exp(rng.uniform(np.log(0.003), 0.0, (n, 1, 1))) * (ub - lb) / 2
    base = np.where(rng.random((n, 1, 1)) < 0.5, np.asarray(ddp.ocp.u_goal), (lb + ub) / 2)
    return np.ascontiguousarray(np.clip(base + amplitude * shape, lb, ub))


def solve_globally(ddp: DDP, x0: ArrayLike, *, starts: int = 16, neighbours: int = 4, rounds: int = 6, seed: Seed = 0,
                   report: Report = lambda _: None) -> GlobalSolution:
    """Solve each problem from u* and cold starts, then from its neighbours' solutions until nothing improves.

    Neighbours alone come to rest where a whole region shares a wrong basin: a random half of the states gets one more
    cold start in each round, and so does each state whose best was found less than twice.

    Parameters
    ----------
    x0 : [nx] or [B, nx], at t0 = 0
    starts : cold starts for each state, u held at u* the first of them
    neighbours, rounds : solutions of that many neighbours are tried, at most that many times over

    Raises ValueError for wrong input; a state for which nothing converged has success False in `best`.
    """
    rows, _ = checks.states(x0, ddp.ocp.system.nx, ddp.ocp.system.name)
    if min(starts, neighbours + 1, rounds + 1) < 1:
        raise ValueError(f"starts is {starts}, neighbours {neighbours}, rounds {rounds}; expected starts >= 1, the "
                         "others >= 0")
    search = _Search(ddp, rows, np.random.default_rng(seed))
    for start in range(starts):
        report(f"cold start {start + 1} of {starts}")
        search.cold(np.arange(len(rows)), straight=start == 0)
    for round_ in range(rounds):
        if not search.best.success.any():
            break
        report(f"neighbours, round {round_ + 1}")
        former = search.best.cost
        search.exchange(neighbours)
        search.cold(search.doubtful())
        if not _improved(former, search.best.cost).any():
            break
    return GlobalSolution(search.best, *search.counts())


class _Search:
    """The best of all that was tried from each state, and the costs at which each start ended."""

    def __init__(self, ddp: DDP, x0: Array, rng: np.random.Generator) -> None:
        self.ddp, self.x0, self.rng = ddp, x0, rng
        self.best: DDPSolution
        self.owners: list[NDArray[np.int64]] = []  # of each start, its state
        self.costs: list[Array] = []
        self.tried: set[tuple[int, int, float]] = set()  # (state, neighbour, the neighbour's cost)

    def cold(self, rows: NDArray[np.int64], straight: bool = False) -> None:
        """One cold start for each of these states, u held at u* or random."""
        if straight:
            self.best = self.ddp.solve(self.x0[rows])
            self._count(rows, self.best)
        elif rows.size:
            self._merge(rows, self.ddp.solve(self.x0[rows], u=cold_controls(self.ddp, len(rows), self.rng)))

    def exchange(self, neighbours: int) -> None:
        """Solve each state from the nearest others' solutions, if they are new to it."""
        solved = np.flatnonzero(self.best.success)
        bank = SolutionBank.of(self.ddp, self.best)
        near = bank.nearest(self.x0, count=neighbours + 1)
        for column in near.T:
            pairs = [(i, k) for i, k in enumerate(column) if solved[k] != i and self._new(i, int(solved[k]))]
            if pairs:
                rows, parents = np.array(pairs).T
                self._merge(rows, self.ddp.solve(self.x0[rows], **bank.guess(parents)))

    def _new(self, state: int, other: int) -> bool:
        key = (state, other, float(self.best.cost[other]))
        fresh = key not in self.tried
        self.tried.add(key)
        return fresh

    def doubtful(self) -> NDArray[np.int64]:
        """A random half of the states, and those whose best was found less than twice."""
        _, hits, _ = self.counts()
        return np.flatnonzero((self.rng.random(len(self.x0)) < 0.5) | (hits < 2))

    def _merge(self, rows: NDArray[np.int64], found: DDPSolution) -> None:
        self._count(rows, found)
        whole = better(self.best[rows], found)
        order = np.arange(len(self.x0))
        order[rows] = len(self.x0) + np.arange(len(rows))
        self.best = DDPSolution.join([self.best, whole])[order]

    def _count(self, rows: NDArray[np.int64], found: DDPSolution) -> None:
        self.owners.append(rows)
        self.costs.append(found.cost)

    def counts(self) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
        """(starts, those that ended at the best cost, different costs) of each state."""
        owners, costs = np.concatenate(self.owners), np.concatenate(self.costs)
        starts = np.bincount(owners, minlength=len(self.x0))
        table = np.full((len(self.x0), max(starts, default=0)), np.inf)
        order = np.argsort(owners, kind="stable")
        column = np.arange(len(owners)) - np.repeat(np.cumsum(starts) - starts, starts)
        table[owners[order], column] = costs[order]
        return starts, _hits(table, self.best.cost), _distinct(table)


def extend(ddp: DDP, bank: SolutionBank, x0: Array, neighbours: int = 3) -> DDPSolution:
    """Solve new states x0 [B, nx] from the nearest solutions of a bank: the best of `neighbours` starts each."""
    best: DDPSolution | None = None
    for rows in bank.nearest(x0, count=neighbours).T:
        solution = ddp.solve(x0, **bank.guess(rows))
        best = solution if best is None else better(best, solution)
    assert best is not None
    return best


def better(a: DDPSolution, b: DDPSolution) -> DDPSolution:
    """The cheaper of two solutions of each problem."""
    swap = b.cost < a.cost
    merged: dict[str, Any] = {}
    for name, value in vars(a).items():
        other = getattr(b, name)
        merged[name] = None if value is None or other is None else np.where(
            swap.reshape(-1, *[1] * (value.ndim - 1)), other, value)
    return DDPSolution(**merged)


def _improved(former: Array, now: Array) -> NDArray[np.bool_]:
    finite = np.where(np.isfinite(former), former, 0.0)
    return np.where(np.isfinite(former), now < finite - IMPROVED * np.abs(finite), np.isfinite(now))


def _hits(costs: Array, best: Array) -> NDArray[np.int64]:
    near = costs <= (best + np.maximum(SAME * np.abs(best), TINY))[:, None]
    return (near & np.isfinite(costs)).sum(axis=1)


def _distinct(costs: Array) -> NDArray[np.int64]:
    ordered = np.sort(np.where(np.isfinite(costs), costs, np.nan), axis=1)  # NaN last, never apart from anything
    apart = np.diff(ordered, axis=1) > np.maximum(SAME * np.abs(ordered[:, 1:]), TINY)
    return np.isfinite(ordered[:, 0]).astype(np.int64) + apart.sum(axis=1)
