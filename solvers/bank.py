"""Global optima by the batch: cold starts, neighbours re-solved from each other, a bank of solutions to start from."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from nocl import checks
from nocl.checks import Array
from nocl.sampling import Seed
from nocl.solvers.ddp import DDP, DDPSolution

Report = Callable[[str], None]  # told what is being done
IMPROVED = 1e-6  # a cost lower by this share counts as an improvement
SAME = 1e-3  # costs within this share count as the same optimum


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
        kept = solution[solution.success]
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
        """The `count` rows whose states at t are nearest to x [B, nx]: [B, count]."""
        nodes = self.solution.x[:, self._interval(np.broadcast_to(t, len(x))), :]  # [rows, B, nx]
        distance = (((nodes - x) / self.scale) ** 2).sum(axis=2).T
        count = min(count, len(self))
        return np.argpartition(distance, count - 1, axis=1)[:, :count]

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

    Parameters
    ----------
    x0 : [nx] or [B, nx], at t0 = 0
    starts : cold starts for each state, u held at u* the first of them
    neighbours, rounds : solutions of that many neighbours are tried, at most that many times over
    """
    rows, _ = checks.states(x0, ddp.ocp.system.nx, ddp.ocp.system.name)
    rng, B = np.random.default_rng(seed), len(rows)
    controls = cold_controls(ddp, B * starts, rng).reshape(B, starts, ddp.intervals, -1)
    controls[:, 0] = ddp.ocp.u_goal
    tried, costs = None, np.empty((B, 0))
    for start in range(starts):
        report(f"cold start {start + 1} of {starts}")
        solution = ddp.solve(rows, u=np.ascontiguousarray(controls[:, start]))
        costs = np.column_stack([costs, solution.cost])
        tried = solution if tried is None else better(tried, solution)
    assert tried is not None
    for round_ in range(rounds):
        report(f"neighbours, round {round_ + 1}")
        former = tried.cost
        tried, found = _from_neighbours(ddp, tried, rows, neighbours)
        costs = np.column_stack([costs, found])
        if not (tried.cost < former - IMPROVED * np.abs(former)).any():
            break
    return GlobalSolution(tried, np.full(B, costs.shape[1]), _hits(costs, tried.cost), _distinct(costs))


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


def _from_neighbours(ddp: DDP, best: DDPSolution, x0: Array, neighbours: int) -> tuple[DDPSolution, Array]:
    bank, costs = SolutionBank.of(ddp, best), []
    for rows in bank.nearest(x0, count=neighbours + 1).T:
        solution = ddp.solve(x0, **bank.guess(rows))
        costs.append(solution.cost)
        best = better(best, solution)
    return best, np.column_stack(costs)


def _hits(costs: Array, best: Array) -> NDArray[np.int64]:
    return (costs <= best[:, None] + SAME * np.abs(best[:, None])).sum(axis=1)


def _distinct(costs: Array) -> NDArray[np.int64]:
    ordered = np.sort(np.where(np.isfinite(costs), costs, np.nan), axis=1)  # NaN last, never apart from anything
    apart = np.diff(ordered, axis=1) > SAME * np.abs(ordered[:, 1:])
    return np.isfinite(ordered[:, 0]).astype(np.int64) + apart.sum(axis=1)
