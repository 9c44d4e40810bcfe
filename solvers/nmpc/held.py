"""Which constraints stand at which node of the program, in what units, and the slacks of those that are soft.

At node 0 the rows that hold the control, since x_0 is given; at nodes 1 ... N-1 all rows along the trajectory; at node
N those of x alone, and those of the end. A soft row has a slack s >= 0 in units of its scale, c + scale s >= 0, an
equation two of both signs; each costs SOFT times the usual cost: the exact penalty, by which what can be held is held.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from nocl.definition.constraints import PATH, Rows
from nocl.definition.ocp import OCP
from nocl.definition.scales import steps, usual_sizes
from nocl.support.checks import Array

SOFT = 1e3  # usual costs that a violation by its scale costs at a node


@dataclass(frozen=True, eq=False)
class Block:
    """Rows that stand together at a node."""

    rows: Rows
    scales: Array  # [m]
    slack: Array  # [m, all slacks of a node], what each adds to each row, in the row's unit

    def __len__(self) -> int:
        return len(self.rows)

    @property
    def unit(self) -> Array:
        """What the solver sees as 1 of each row: the scale; of path constraints it in steps of about a thousand."""
        paths = np.array([one.kind == PATH for one in self.rows.of], dtype=bool)
        return np.where(paths, steps(self.scales), self.scales) if len(self.rows) else np.zeros(0)

    @property
    def upper(self) -> Array:
        """Upper bounds of the rows [m]; the lower ones are 0."""
        return np.where(self.rows.equal, 0.0, np.inf)

    def inward(self, margin: Array) -> Array:
        """The lower bounds of the rows with margins [m], in scales, as the solver sees them."""
        held = ~self.rows.equal & ~self.slack.any(axis=1)
        return np.asarray(np.where(held, margin * self.scales / self.unit, 0.0))

    def excess(self, c: Array) -> Array:
        """How far values c [m, n] exceed the rows, as shares of their scales."""
        return np.asarray(np.maximum(-self.rows.signed(c), 0.0) / self.scales[:, None])


@dataclass(frozen=True, eq=False)
class Layout:
    """The rows of x alone, of the control, and of the end; `soft` names the constraints that have slacks."""

    x: Block
    u: Block
    end: Block
    slacks: int  # of a node
    weight: float  # of each
    hard: tuple[str, ...]  # the constraints that have none, in words

    def at(self, node: int, N: int) -> list[Block]:
        """The blocks of a node."""
        if node == N:
            return [self.x, self.end]
        return [self.u] if node == 0 else [self.x, self.u]

    def size(self, node: int, N: int) -> int:
        return sum(map(len, self.at(node, N)))


def layout(ocp: OCP, soft: tuple[str, ...] = (), held: bool = True) -> Layout:
    """The blocks of a problem; held: False leaves them all out."""
    of = ocp.functions
    rows, end = (of.rows, of.end_rows) if held else (of.rows[:0], of.end_rows[:0])
    scales = (of.scales, of.end_scales) if len(rows) + len(end) else (np.zeros(0), np.zeros(0))
    slack = _slacks(rows, end, np.concatenate(scales), soft)
    n, m = rows.n_x, len(rows)
    weight = SOFT * usual_sizes(ocp).cost if slack.shape[1] else 0.0
    every = [one for some in (rows, end) for one in some.of]
    return Layout(Block(rows[:n], scales[0][:n], slack[:n]), Block(rows[n:], scales[0][n:], slack[n:m]),
                  Block(end, scales[1], slack[m:]), slack.shape[1], weight,
                  tuple(dict.fromkeys(one.name for one in every if one.name not in soft)))


def _slacks(rows: Rows, end: Rows, scales: Array, soft: tuple[str, ...]) -> Array:
    """What each slack adds to each row [m, slacks]."""
    columns = list(_columns(rows, end, scales, soft))
    return np.array(columns).T if columns else np.zeros((len(scales), 0))


def _columns(rows: Rows, end: Rows, scales: Array, soft: tuple[str, ...]) -> Iterator[Array]:
    names, sides = rows.names + end.names, rows.sides + end.sides
    for i, (name, side) in enumerate(zip(names, sides, strict=True)):
        if name in soft:
            yield scales[i] * np.eye(len(scales))[i]
            if side == "equal":
                yield -scales[i] * np.eye(len(scales))[i]
