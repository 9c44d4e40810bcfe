"""Constraints as the DDP kernel has them: rows c >= 0 or c = 0 at stages and at the end, each in units of its scale.

`rows_of(ocp)` is the only joint between a problem's own constraints and what the kernel holds.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from nocl.definition.ocp import OCP
from nocl.definition.parameters import time
from nocl.support.checks import Array
from nocl.translate.arguments import Arguments
from nocl.translate.kernels import emit

Mask = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Block:
    """Rows that hold at the same places, each c >= 0, or c = 0 where it is an equality."""

    c: ca.SX  # [n], in the problem's own symbols, divided by the scales
    equal: Mask  # [n]
    names: tuple[str, ...]  # n of them: whose row it is
    scales: Array  # [n], what 1 of c is in the user's unit

    def __post_init__(self) -> None:
        n = self.c.numel()
        sizes = (len(self.equal), len(self.names), len(self.scales))
        if sizes != (n, n, n):
            raise ValueError(f"a block of {n} rows has {sizes} masks, names and scales; expected one of each for a row")

    def __len__(self) -> int:
        return int(self.c.numel())

    @staticmethod
    def of(c: ca.SX, equal: list[bool], names: list[str], scales: Array | list[float]) -> Block:
        """From expressions in the user's units."""
        sizes = np.asarray(scales, dtype=np.float64)
        return Block(ca.densify(ca.SX(c) / ca.DM(sizes)), np.array(equal, dtype=bool), tuple(names), sizes)

    @staticmethod
    def none() -> Block:
        return Block.of(ca.SX(0, 1), [], [], np.zeros(0))


@dataclass(frozen=True, eq=False)
class ConstraintRows:
    """What must hold along a plan: rows c(x, u, t, p) at every stage, c(x, p) at the end.

    The end's first rows are the stage's rows of x alone, as they stand there.
    """

    stage: Block = field(default_factory=Block.none)
    end: Block = field(default_factory=Block.none)

    def count(self, intervals: int) -> int:
        """How many rows a plan has: those of stage k stand at k len(stage), those of the end behind them."""
        return intervals * len(self.stage) + len(self.end)

    def names(self, row: int, intervals: int) -> tuple[str, int, float]:
        """(name, node, scale) of a row of a plan."""
        n = len(self.stage)
        node = min(row // n, intervals) if n else intervals
        block, i = (self.stage, row - node * n) if node < intervals else (self.end, row - intervals * n)
        return block.names[i], node, float(block.scales[i])

    def margins(self, at_nodes: Array, u: ca.SX) -> Array:
        """[B, rows of a plan], from those of a stage's rows at all nodes [B, K+1, rows of a stage]."""
        B, nodes, n = at_nodes.shape
        of_x, end = at_nodes[:, -1][:, self.of_x(u)], np.zeros((B, len(self.end)))
        count = min(of_x.shape[1], end.shape[1])
        end[:, :count] = np.where(self.end.equal[:count], 0.0, of_x[:, :count])
        return np.ascontiguousarray(np.concatenate([at_nodes[:, :-1].reshape(B, (nodes - 1) * n), end], axis=1))

    def end_own(self, u: ca.SX) -> Mask:
        """The end's rows that are no stage's [n]."""
        return np.arange(len(self.end)) >= self.of_x(u).sum()

    def of_x(self, u: ca.SX) -> Mask:
        """The stage's rows that hold no control [n]: at node 0 nothing can be done about them."""
        pattern = ca.jacobian_sparsity(self.stage.c, u).get_triplet()[0]
        return ~np.isin(np.arange(len(self.stage)), pattern)


def rows_of(ocp: OCP) -> ConstraintRows:
    """A problem's own constraints: along the way, and at the end those of x alone with the terminal ones."""
    of, rows, end = ocp.functions, ocp.functions.rows, ocp.functions.end_rows
    if not len(rows) + len(end):
        return ConstraintRows()
    last = rows[:rows.n_x]
    there = ca.vertcat(ca.substitute(last.column, time(), ocp.horizon), end.column)
    return ConstraintRows(
        Block.of(rows.column, rows.equal.tolist(), list(rows.names), of.scales),
        Block.of(there, [*last.equal, *end.equal], [*last.names, *end.names],
                 np.concatenate([of.scales[:rows.n_x], of.end_scales])))


class RowModel:
    """Rows of a block at one place, what they add to the quadratic model there, and to dV/dp, as expressions."""

    def __init__(self, block: Block, z: ca.SX, p: ca.SX) -> None:
        n = len(block)
        self.c = block.c
        self.a, self.w, self.bent = (ca.SX.sym(name, n) for name in ("a", "w", "bent"))
        C = ca.jacobian(block.c, z)
        self.slope = ca.densify(-C.T @ self.a)
        self.curve = ca.densify(C.T @ ca.diag(self.w) @ C - ca.hessian(ca.dot(self.bent, block.c), z)[0])
        self.by_p = ca.densify(-ca.jacobian(block.c, p).T @ self.a)

    @property
    def weights(self) -> list[ca.SX]:
        return [self.a, self.w, self.bent]


def rows_source(ocp: OCP, rows: ConstraintRows, stage: dict[str, ca.SX]) -> list[str]:
    """What csrc/rows.h lists, for the kernel of a problem whose stage has these inputs."""
    end = {name: value for name, value in stage.items() if name != "u"}
    of_x = rows.of_x(stage["u"])
    lines = [f"#define NC {len(rows.stage)}", f"#define NT {len(rows.end)}", _flags("EQUAL", rows.stage.equal),
             _flags("OF_X", of_x), _flags("END_EQUAL", rows.end.equal), _flags("END_OWN", rows.end_own(stage["u"]))]
    for name, block, given, z in (("stage", rows.stage, stage, ca.vertcat(stage["x"], stage["u"])),
                                  ("end", rows.end, end, stage["x"])):
        p = parameters(ocp)
        model, inputs = RowModel(block, z, p), list(given.values())
        lines += [emit(f"{name}_rows", inputs, [model.c]),
                  emit(f"{name}_rows_model", [*inputs, *model.weights], [model.slope, model.curve])]
        if ocp.np:
            lines.append(emit(f"{name}_rows_parameters", [*inputs, model.a], [model.by_p]))
    return lines


def parameters(ocp: OCP) -> ca.SX:
    """All of a problem's parameters, a column."""
    at: Arguments = ocp.functions.arguments
    return at["p"] if ocp.np else ca.SX(0, 1)


def _flags(name: str, mask: Mask) -> str:
    values = ", ".join(str(int(m)) for m in mask) or "0"
    return f"static const int {name}[] = {{{values}}};"
