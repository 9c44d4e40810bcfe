"""A bank of solutions from t = 0: what lies near (x, t) is a guess for problems there, a feedback and a value."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from functools import reduce
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import KDTree

from nocl.data import Solution
from nocl.solvers.ddp.solver import DDP
from nocl.solvers.search import spread
from nocl.support import checks
from nocl.support.checks import Array

Rows = NDArray[np.int64]
FILE = "bank.safetensors"
KIND = "solution bank"
EQUAL = 1e-9  # of the scale: states closer than this are the same


@dataclass(frozen=True, eq=False)
class SolutionBank:
    """Solutions on [0, T], one a row, as guesses for other problems (x0, t0)."""

    solution: Solution
    scale: Array  # [nx + np], one unit of distance in each state, then in each parameter
    periodic: tuple[int, ...] = ()  # states that are the same 2 pi further (OCP.periodic): distances are to images
    several: int = 1  # how many of the nearest solutions are worth a look
    in_steps: bool = False  # whether time is discrete: what starts later has fewer steps, of the same length

    def __len__(self) -> int:
        return len(self.solution)

    @staticmethod
    def of(ddp: DDP, solution: Solution) -> SolutionBank:
        """A bank of the solutions that succeeded; states are compared in units of their spread along them."""
        ddp.ocp.refuse_free("SolutionBank")
        if (solution.t[:, 0] != 0).any():
            raise ValueError(f"a bank holds solutions from t0 = 0; got t0 up to {solution.t[:, 0].max():g}: solve them "
                             "from t0 = 0")
        kept = solution[solution.success]
        if not len(solution):
            raise ValueError(f"a bank of {ddp.ocp.system.name} got no solutions; expected at least one")
        if not len(kept):
            raise ValueError(f"no problem of {ddp.ocp.system.name} was solved ({solution.message[0]}): check the "
                             "horizon, the bounds and the costs, or give guesses of your own to DDP.solve(x0, u=...)")
        if np.isnan(kept.gain).any():
            raise ValueError(f"a bank follows its solutions of {ddp.ocp.system.name} by their gain, which is NaN: "
                             "take those of DDP, or of NMPC.solve(x0, gains=True)")
        return SolutionBank(replace(kept, tried=None, dense=None), spread(ddp.ocp, kept.x, kept.p), ddp.ocp.periodic,
                            in_steps=ddp.ocp.system.is_discrete)

    @staticmethod
    def from_arrays(ddp: DDP, arrays: dict[str, Any]) -> SolutionBank:
        """The bank of a solution's arrays, as a checkpoint keeps them."""
        return SolutionBank.of(ddp, _solution(arrays))

    def add(self, solution: Solution) -> SolutionBank:
        """A bank with these solutions too, those that succeeded; of two from the same state and p the cheaper stays."""
        grid = self.solution.u.shape[1:]
        if solution.u.shape[1:] != grid or (solution.t != self.solution.t[0]).any():
            raise ValueError(f"the bank's solutions have controls {grid} on [0, {self.horizon:g}]; got controls "
                             f"{solution.u.shape[1:]} from t0 up to {solution.t[:, :1].max(initial=0):g}: solve them "
                             "by the same DDP, from t0 = 0")
        joined = Solution.join([self.solution, solution[solution.success]])
        order = np.argsort(joined.cost, kind="stable")
        state = np.round(_places(joined.x[:, 0], joined.p)[order] / (EQUAL * self.scale))
        kept = order[np.sort(np.unique(state, axis=0, return_index=True)[1])]
        return replace(self, solution=joined[np.sort(kept)])

    def save(self, folder: str | os.PathLike[str]) -> Path:
        """Write folder/bank.safetensors, data only, atomically."""
        from nocl.support import store  # torch

        arrays = {name: value for name, value in self.solution.arrays().items() if name != "message"}
        return store.save_checkpoint(Path(folder) / FILE, {"solution": arrays, "scale": self.scale},
                                     {"kind": KIND, "periodic": list(self.periodic), "in_steps": self.in_steps})

    @staticmethod
    def load(folder: str | os.PathLike[str]) -> SolutionBank:
        """The bank that `save` wrote, bit by bit; ValueError for a missing, truncated, altered or foreign file."""
        from nocl.support import store  # torch

        path = Path(folder) / FILE
        if not path.is_file():
            raise ValueError(f"{path} does not exist; expected a folder that SolutionBank.save wrote: check the path")
        state, meta = store.load_checkpoint(path)
        if meta.get("kind") != KIND:
            raise ValueError(f"{path} is no solution bank; expected a file of SolutionBank.save: name the right folder")
        return SolutionBank(_solution(state["solution"]), state["scale"], tuple(meta.get("periodic", ())),
                            in_steps=bool(meta.get("in_steps", False)))

    def interpolate(self, x: ArrayLike, t: ArrayLike = 0.0, p: Array | None = None) -> tuple[Array, Array, Array]:
        """(u, V, V_x) at states x [B, nx] and times t [B]: the nearest solution's, with u and V to first order in the
        distance to it, u not clipped; V to second order where the bank has V_xx. Of parameters p [B, np], where the
        problem has some, it takes the nearest solution's."""
        rows = np.atleast_2d(np.asarray(x, dtype=np.float64))
        times = np.broadcast_to(np.asarray(t, dtype=np.float64), len(rows))
        near, s = self.nearest(rows, times, p=p)[:, 0], self.solution
        k = self._interval(times)
        there = self.states(near, times[:, None])[:, 0]
        away = rows - there - self._turns(rows, there)
        part = times * s.u.shape[1] / self.horizon - k

        def between(value: Array) -> Array:
            share = part.reshape(-1, *[1] * (value.ndim - 2))
            return (1 - share) * value[near, k] + share * value[near, k + 1]

        V, V_x = between(s.V), between(s.V_x)
        u = s.u[near, k] + np.einsum("bij,bj->bi", s.gain[near, k], away)
        V = V + np.einsum("bi,bi->b", V_x, away)
        if s.V_xx is not None:
            bend = np.einsum("bij,bj->bi", between(s.V_xx), away)
            V, V_x = V + np.einsum("bi,bi->b", bend, away) / 2, V_x + bend
        return u, V, V_x

    def nearest(self, x: Array, t: ArrayLike = 0.0, count: int = 1, p: Array | None = None) -> Rows:
        """The `count` rows whose states at t (at the last node before it), and parameters, are nearest to x [B, nx] and
        p [B, np], the nearest first.

        t: a number or [B]. Returns [B, count], fewer columns where the bank has fewer rows.
        """
        if (p is None) != (self.solution.p is None):
            has = "no parameters" if self.solution.p is None else f"{self.solution.p.shape[1]} parameter(s)"
            raise ValueError(f"a bank of a problem with {has} got p = {checks.shown(p)}; expected those of its problem")
        columns = list(range(1, min(count, len(self)) + 1))
        found = np.empty((len(x), len(columns)), dtype=np.int64)
        interval = np.broadcast_to(self._interval(t), len(x))
        for k in np.unique(interval):
            here = interval == k
            there = _places(self.solution.x[:, k], self.solution.p)
            tree = KDTree(self._on_circles(there), boxsize=self._circles)
            found[here] = tree.query(self._on_circles(_places(x, p)[here]), columns)[1]
        return found

    def guess(self, rows: Rows, t0: ArrayLike = 0.0, x: Array | None = None) -> dict[str, Array]:
        """What DDP.solve starts from: solutions `rows` [B] resampled onto their own [t0, T], as u, x and gain.

        x : the states [B, nx] that are to be solved: of periodic states it is then the image near them
        """
        start = np.broadcast_to(np.asarray(t0, dtype=np.float64), rows.shape)
        part = np.arange(self.solution.u.shape[1] + 1) / self.solution.u.shape[1]
        dt = np.diff(self.solution.t[0, :2])
        times = start[:, None] + (self.horizon - start)[:, None] * part if not self.in_steps else \
            np.minimum(start[:, None] + dt * np.arange(len(part)), self.horizon)
        made = self._along(rows, times)
        if x is not None and self.periodic:
            made["x"] += self._turns(x, made["x"][:, 0])[:, None]
        return made

    def _turns(self, x: Array, there: Array) -> Array:
        """The multiples of 2 pi [B, nx] by which x is further than `there` [B, nx], in periodic states."""
        turns = np.zeros_like(x)
        for i in self.periodic:
            turns[:, i] = 2 * np.pi * np.round((x[:, i] - there[:, i]) / (2 * np.pi))
        return turns

    @property
    def _circles(self) -> Array | None:
        """The length of each scaled state's circle, 0 for none; None where there is no circle at all."""
        if not self.periodic:
            return None
        size = np.zeros(len(self.scale))
        size[list(self.periodic)] = 2 * np.pi / self.scale[list(self.periodic)]
        return size

    def _on_circles(self, x: Array) -> Array:
        """Scaled states, the periodic ones on their circles."""
        z, size = x / self.scale, self._circles
        if size is not None:
            for i in self.periodic:
                z[:, i] %= size[i]
                z[z[:, i] >= size[i], i] = 0.0  # the remainder of a tiny negative number rounds to the size
        return z

    def _along(self, rows: Rows, times: Array) -> dict[str, Array]:
        k, row = self._interval(times[:, :-1] + np.diff(times) / 2), rows[:, None]
        return {"u": self.solution.u[row, k], "x": self.states(rows, times), "gain": self.solution.gain[row, k]}

    def states(self, rows: Rows, t: Array) -> Array:
        """x of solutions rows [B] at times t [B, n], linear between nodes: [B, n, nx]."""
        k, row = self._interval(t), rows[:, None]
        part = (t * self.solution.u.shape[1] / self.horizon - k)[..., None]
        return (1 - part) * self.solution.x[row, k] + part * self.solution.x[row, k + 1]

    @property
    def horizon(self) -> float:
        """T."""
        return float(self.solution.t[0, -1])

    def _interval(self, t: ArrayLike) -> Rows:
        K = self.solution.u.shape[1]
        return np.clip((np.asarray(t) * K / self.horizon).astype(np.int64), 0, K - 1)


def extend(ddp: DDP, bank: SolutionBank, x0: ArrayLike, neighbours: int = 3, t0: ArrayLike = 0.0,
           p: Any = None, kept: int | None = None) -> Solution:
    """Solve new problems (x0 [B, nx], t0, p) from the nearest solutions of a bank: the best of `neighbours` starts.

    kept : of these starts as many are followed to their ends, those that are cheapest after one iteration; default: all
    """
    if neighbours < 1:
        raise ValueError(f"neighbours is {neighbours}; expected at least 1")
    rows, _ = checks.states(x0, ddp.ocp.system.nx, ddp.ocp.system.name)
    values = ddp.ocp.parameters_of(p, len(rows), "extend") if ddp.ocp.np else None
    guesses = [bank.guess(near, t0, rows) for near in bank.nearest(rows, t0, count=neighbours, p=values).T]
    if kept is not None and kept < len(guesses):
        guesses = _cheapest(ddp, rows, t0, values, guesses, kept)
    found = [ddp.solve(rows, t0, p=values, **guess) for guess in guesses]
    return reduce(better, found)


def _cheapest(ddp: DDP, x0: Array, t0: ArrayLike, p: Array | None, guesses: list[dict[str, Array]],
              kept: int) -> list[dict[str, Array]]:
    """Of the guesses those that are cheapest after one iteration, for each problem: `kept` of them, the best first."""
    tried = [ddp.attempt(x0, t0, p=p, **guess) for guess in guesses]
    cost = np.nan_to_num(np.stack([J for J, _ in tried]), nan=np.inf)
    controls, problems = np.stack([u for _, u in tried]), np.arange(len(x0))
    return [{"u": controls[row, problems]} for row in np.argsort(cost, axis=0, kind="stable")[:kept]]


def better(a: Solution, b: Solution) -> Solution:
    """The cheaper of two solutions of each problem, with the seconds and iterations of both; of two of which one cuts
    corners between nodes the other, even if it costs more."""
    both, swap = b.arrays(), (b.rank < a.rank) | (b.rank == a.rank) & (b.cost < a.cost)
    best = Solution(**{name: value.copy() for name, value in a.arrays().items() if name in both})
    best.put(swap, b[swap])
    tried = None if a.tried is None or b.tried is None else np.c_[a.tried, b.tried]
    return replace(best, seconds=a.seconds + b.seconds, iterations=a.iterations + b.iterations, tried=tried)


def _places(x: Array, p: Array | None) -> Array:
    """States [B, nx] with their parameters [B, np], where there are some."""
    return x if p is None else np.c_[x, p]


def _solution(arrays: dict[str, Any]) -> Solution:
    """A bank's solutions from their arrays without the messages."""
    return Solution.of_arrays({**arrays, "message": np.full(len(arrays["cost"]), "converged")})
