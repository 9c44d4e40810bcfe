"""DDP's batches as tasks: cut into pieces that fit the memory, done here or on a Dask cluster."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from nocl.data import Solution
from nocl.definition.ocp import OCP
from nocl.support.checks import Array

Rows = NDArray[np.int64]  # problem numbers
MOST = 1024  # problems in a piece: fills many threads, and shows progress
AT_NODES = ("t", "x", "V", "V_x", "V_xx")  # of a Solution
BYTES = 2**28  # ... and what its trajectories, gains and curvatures take at most


class Descent(Protocol):
    """What solves a piece of a batch."""

    ocp: OCP
    posed: OCP  # what the kernel solves
    intervals: int
    held: int

    def descend(self, batch: Piece) -> Solution: ...


@dataclass(frozen=True, eq=False)
class Piece:
    """A piece of a batch: problems first, first + 1, ... of it; a task of solvers/pool.py."""

    name: str
    first: int
    x0: Array  # [n, nx]
    t0: Array  # [n]
    guess: dict[str, Array]  # of u, x and gain, those that are given
    curvature: bool
    p: Array | None = None  # [n, np]

    @property
    def size(self) -> int:
        return len(self.x0)

    def outcome(self, arrays: dict[str, Any]) -> Solved:
        """What came of this task, from its `arrays()`."""
        return Solved(self.name, self.first, Solution.of_arrays(arrays))


@dataclass(frozen=True, eq=False)
class Solved:
    """A piece's solution."""

    name: str
    first: int
    solution: Solution

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

    def __call__(self, task: Piece) -> Solved:
        return Solved(task.name, task.first, self.ddp.descend(task))


def bytes_each(ddp: Descent, curvature: bool) -> int:
    """What one problem takes while it is solved."""
    bends = curvature or ddp.ocp.is_free  # a free horizon is found by V_xx
    K, nx, nu = ddp.intervals, ddp.posed.system.nx, ddp.posed.system.nu
    return 8 * (K + 1) * (4 * nx + 4 * nu + 2 * nu * nx + 3 + (nx * nx if bends else 0)) + 8 * 6 * ddp.held


def pieces(ddp: Descent, x0: Array, t0: Array, guess: dict[str, Array], curvature: bool,
           p: Array | None = None) -> list[Piece]:
    """Pieces of MOST problems, fewer where these would take more than BYTES; the same for any workers."""
    n = max(1, min(MOST, BYTES // bytes_each(ddp, curvature)))
    parts = (slice(i, i + n) for i in range(0, max(len(x0), 1), n))
    return [Piece(f"piece-{at.start:09d}", at.start, x0[at], t0[at], {k: v[at] for k, v in guess.items()}, curvature,
                  None if p is None else p[at]) for at in parts]


def of_lengths(batch: Piece, left: Rows) -> Iterator[tuple[int, Rows, Piece]]:
    """The problems of a piece by their numbers of intervals, left [n]: (that number, their rows, a piece of them)."""
    for n in map(int, np.unique(left)):
        rows = np.flatnonzero(left == n)
        guess = {name: np.ascontiguousarray(value[rows, :n + (name == "x")]) for name, value in batch.guess.items()}
        yield n, rows, replace(batch, x0=batch.x0[rows], t0=batch.t0[rows], guess=guess,
                               p=None if batch.p is None else batch.p[rows])


def by_length(batch: Piece, most: int, left: Rows, solve: Callable[[int, Piece], Solution]) -> Solution:
    """A piece whose problems have left [n] intervals, solved by solve(intervals, part), as one of `most` intervals."""
    parts = [(rows, lengthened(solve(n, part), most)) for n, rows, part in of_lengths(batch, left)]
    if len(parts) == 1:
        return parts[0][1]
    whole = Solution.join([part for _, part in parts])
    return whole[np.argsort(np.concatenate([rows for rows, _ in parts]))]


def lengthened(s: Solution, most: int) -> Solution:
    """A solution whose end stands still until there are `most` intervals, under the last control."""
    K = s.u.shape[1]
    if most == K:
        return s
    nodes: dict[str, Any] = {name: stretched(value, most + 1) for name, value in s.arrays().items() if name in AT_NODES}
    gain = np.concatenate([s.gain, np.zeros((len(s), most - K, *s.gain.shape[2:]))], axis=1)
    return replace(s, **nodes, u=stretched(s.u, most), gain=gain)


def stretched(values: Array, n: int) -> Array:
    """values [B, m, ...] as [B, n, ...], the last one again and again."""
    return np.concatenate([values, np.repeat(values[:, -1:], n - values.shape[1], axis=1)], axis=1)


def assembled(n: int, parts: Iterable[Solved]) -> Solution:
    """One solution of n rows from the pieces, in any order."""
    whole: Solution | None = None
    for part in parts:
        if part.size == n:
            return part.solution
        if whole is None:
            whole = Solution.of_arrays({name: np.empty((n, *value.shape[1:]), value.dtype)
                                           for name, value in part.solution.arrays().items()})
        whole.put(slice(part.first, part.first + part.size), part.solution)
    assert whole is not None
    return whole
