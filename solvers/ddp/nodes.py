"""Solutions of a problem without a clock: what is left of one from any of its nodes is a solution from there."""

from __future__ import annotations

from functools import cached_property, reduce
from typing import Self

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from nocl.data import Solution
from nocl.definition.ocp import OCP
from nocl.solvers.ddp.bank import better
from nocl.solvers.ddp.solver import DDP
from nocl.support.checks import Array

Rows = NDArray[np.int64]


class NodeBank:
    """Solutions with horizons of their own, found by the nearest of all their nodes.

    solution : those of it that were solved are kept, the nodes t [B, K+1] counting from 0
    """

    def __init__(self, ocp: OCP, solution: Solution) -> None:
        self.ocp, self.solution = ocp, solution[solution.success]
        if not len(self.solution):
            raise ValueError(f"no solution of {ocp.system.name!r} was found: {solution.message[0]}")
        self.scale = self.solution.x.std(axis=(0, 1)) + 1e-9 * (ocp.system.ubx - ocp.system.lbx)

    def add(self, solution: Solution) -> Self:
        """With further solutions."""
        return self.holding(type(solution).join([self.solution, solution]))

    def holding(self, solution: Solution) -> Self:
        """The same of other solutions."""
        return type(self)(self.ocp, solution)

    @cached_property
    def _tree(self) -> KDTree:
        s = self.solution
        x, p = s.x[:, :-1].reshape(-1, s.x.shape[2]), np.repeat(s.parameters, s.u.shape[1], axis=0)
        return KDTree(self._places(x, p))

    def _places(self, x: Array, p: Array) -> Array:
        """States in units of their spread, periodic ones on circles, with parameters."""
        z, low, high = x / self.scale, *self.ocp.parameter_box
        turning = list(self.ocp.periodic)
        for i in turning:
            z[:, i] = np.sin(x[:, i]) / self.scale[i]
        circles = [np.cos(x[:, i]) / self.scale[i] for i in turning]
        return np.column_stack([z, *circles, p / np.maximum(high - low, 1e-300)])

    def tails(self, rows: Rows, nodes: Rows, intervals: int) -> dict[str, Array]:
        """What DDP.solve starts from: what is left of solutions `rows` [n] from their nodes `nodes` [n] on, on as many
        intervals."""
        s, K = self.solution, self.solution.u.shape[1]
        part = np.arange(intervals + 1) / intervals
        place = nodes[:, None] + (K - nodes)[:, None] * part  # in nodes
        k = np.minimum(((place[:, :-1] + place[:, 1:]) / 2).astype(np.int64), K - 1)
        node, row = np.minimum(place.astype(np.int64), K - 1), rows[:, None]
        share = (place - node)[..., None]
        x = (1 - share) * s.x[row, node] + share * s.x[row, node + 1]
        left = np.maximum(s.t[rows, -1] - s.t[rows, nodes], self.ocp.horizon.low * (1 + 1e-6))
        return {"u": s.u[row, k], "x": x, "gain": s.gain[row, k], "t": left[:, None] * part}

    def guesses(self, x: Array, p: Array, count: int, intervals: int) -> list[dict[str, Array]]:
        """Starts from x [n, nx], p [n, np]: the tails of the `count` nearest nodes."""
        K = self.solution.u.shape[1]
        found = self._tree.query(self._places(x, p), list(range(1, count + 1)))[1]
        made = []
        for near in found.T:
            guess = self.tails(near // K, near % K, intervals)
            for i in self.ocp.periodic:
                turns = np.round((x[:, i] - guess["x"][:, 0, i]) / (2 * np.pi))
                guess["x"][:, :, i] += 2 * np.pi * turns[:, None]
            made.append(guess)
        return made

    def solve(self, ddp: DDP, x: Array, p: Array, count: int = 2) -> Solution:
        """The best of descents from the nearest tails."""
        given, guesses = p if p.shape[1] else None, self.guesses(x, p, count, ddp.intervals)
        return reduce(better, [ddp.solve(x, p=given, **guess) for guess in guesses])

    def around(self, n: int, width: float, rng: np.random.Generator) -> tuple[Array, Array]:
        """States [n, nx] and parameters [n, np] near the solutions' own.

        They are apart by `width` of the states' spread at most, and by no more than they are from where it ends: all
        distances from there are alike.
        """
        s = self.solution
        rows, nodes = rng.integers(0, len(s), n), rng.integers(0, s.u.shape[1], n)
        x, end = s.x[rows, nodes], s.x[rows, -1]
        away = np.minimum(np.linalg.norm((x - end) / self.scale, axis=1, keepdims=True), 1.0)
        size = width * np.exp(rng.uniform(-1.5, 0, (n, 1))) * away * self.scale
        return x + size * rng.standard_normal(x.shape), s.parameters[rows]
