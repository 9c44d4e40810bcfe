"""DDP's answers, and its batches as tasks: cut into pieces that fit the memory, done here or on a Dask cluster."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from nocl.ocp import OCP
from nocl.support.checks import Array

Rows = NDArray[np.int64]  # problem numbers
MOST = 1024  # problems in a piece: fills many threads, and shows progress
BYTES = 2**28  # ... and what its trajectories, gains and curvatures take at most


@dataclass(frozen=True, eq=False)
class DDPSolution:
    """Optimal trajectories from (x0, t0), with feedback and value derivatives at each node; rows [B, ...]."""

    t: Array  # [B, K+1]
    x: Array  # [B, K+1, nx]
    u: Array  # [B, K, nu]
    gain: Array  # [B, K, nu, nx], du/dx of the optimal feedback, 0 where a bound is active
    V: Array  # [B, K+1]
    V_x: Array  # [B, K+1, nx], the costate
    V_xx: Array | None  # [B, K+1, nx, nx], where asked for
    cost: Array  # [B], inf where the problem failed
    success: NDArray[np.bool_]  # [B]
    message: NDArray[np.str_]  # [B]
    iterations: Rows  # [B]

    def __len__(self) -> int:
        return len(self.cost)

    def __getitem__(self, rows: Any) -> DDPSolution:
        """The solutions of some rows (a slice, a mask or indices)."""
        picked: dict[str, Any] = {name: None if value is None else value[rows] for name, value in vars(self).items()}
        return DDPSolution(**picked)

    @staticmethod
    def join(parts: Iterable[DDPSolution]) -> DDPSolution:
        """Several batches as one."""
        batches = [vars(p) for p in parts]
        joined: dict[str, Any] = {name: None if first is None else np.concatenate([b[name] for b in batches])
                                  for name, first in batches[0].items()}
        return DDPSolution(**joined)

    def put(self, rows: Any, other: DDPSolution) -> None:
        """Overwrite some rows with another batch, in place."""
        for name, value in vars(self).items():
            if value is not None:
                value[rows] = getattr(other, name)

    def arrays(self) -> dict[str, Array]:
        """Its fields as plain arrays, for a file."""
        return {name: value for name, value in vars(self).items() if value is not None}

    @staticmethod
    def of_arrays(arrays: dict[str, Any]) -> DDPSolution:
        """The solution of `arrays()`."""
        return DDPSolution(**{"V_xx": None, **arrays})


class Descent(Protocol):
    """What solves a piece of a batch."""

    ocp: OCP
    intervals: int

    def descend(self, batch: Batch) -> DDPSolution: ...


@dataclass(frozen=True, eq=False)
class Batch:
    """A piece of a batch: problems first, first + 1, ... of it; a task of solvers/pool.py."""

    name: str
    first: int
    x0: Array  # [n, nx]
    t0: Array  # [n]
    guess: dict[str, Array]  # of u, x and gain, those that are given
    curvature: bool

    @property
    def size(self) -> int:
        return len(self.x0)

    def outcome(self, arrays: dict[str, Any]) -> Solved:
        """What came of this task, from its `arrays()`."""
        return Solved(self.name, self.first, DDPSolution.of_arrays(arrays))


@dataclass(frozen=True, eq=False)
class Solved:
    """A piece's solution."""

    name: str
    first: int
    solution: DDPSolution

    @property
    def size(self) -> int:
        return len(self.solution)

    def arrays(self) -> dict[str, Array]:
        return self.solution.arrays()


@dataclass(frozen=True)
class Job:
    """What a worker does with a piece."""

    ddp: Descent

    def build(self) -> None:
        """The kernel is built with the DDP, on unpickling."""

    def __call__(self, task: Batch) -> Solved:
        return Solved(task.name, task.first, self.ddp.descend(task))


def bytes_each(ddp: Descent, curvature: bool) -> int:
    """What one problem takes while it is solved."""
    K, nx, nu = ddp.intervals, ddp.ocp.system.nx, ddp.ocp.system.nu
    return 8 * (K + 1) * (4 * nx + 4 * nu + 2 * nu * nx + 3 + (nx * nx if curvature else 0))


def pieces(ddp: Descent, x0: Array, t0: Array, guess: dict[str, Array], curvature: bool) -> list[Batch]:
    """Pieces of MOST problems, fewer where these would take more than BYTES; the same for any workers."""
    n = max(1, min(MOST, BYTES // bytes_each(ddp, curvature)))
    return [Batch(f"piece-{i:09d}", i, x0[i:i + n], t0[i:i + n], {k: v[i:i + n] for k, v in guess.items()}, curvature)
            for i in range(0, max(len(x0), 1), n)]


def assembled(n: int, parts: Iterable[Solved]) -> DDPSolution:
    """One solution of n rows from the pieces, in any order."""
    whole: DDPSolution | None = None
    for part in parts:
        if part.size == n:
            return part.solution
        if whole is None:
            whole = DDPSolution.of_arrays({name: np.empty((n, *value.shape[1:]), value.dtype)
                                           for name, value in part.solution.arrays().items()})
        whole.put(slice(part.first, part.first + part.size), part.solution)
    assert whole is not None
    return whole
