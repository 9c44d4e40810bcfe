"""How constraints stand in pictures of runs: as lines where they bound one state or control, else by their own values.

B is the batch. Channels are the states, then the controls.
"""

from __future__ import annotations

from typing import NamedTuple

import casadi as ca
import numpy as np

from nocl.definition.constraints import END, Constraint
from nocl.definition.ocp import OCP
from nocl.judge.runs import Simulation
from nocl.support.checks import Array


class Line(NamedTuple):
    """What bounds one channel."""

    channel: int
    value: float
    at_end: bool  # holds at the end alone


def lines(ocp: OCP) -> list[Line]:
    """The bounds of constraints that are linear in one state or control, and of nothing else."""
    found = []
    for one in (*ocp.held, *ocp.held_at_end):
        if (linear := _linear(ocp, one)) is not None:
            k, slope, rest = linear
            bounds = {b for b in (one.low, one.high) if np.isfinite(b)}
            found += [Line(k, (b - rest) / slope, one.kind == END) for b in sorted(bounds)]
    return found


def others(ocp: OCP) -> list[Constraint]:
    """The other ones, along the way, whose values are drawn over time."""
    return [one for one in ocp.held if _linear(ocp, one) is None]


def values(ocp: OCP, s: Simulation, p: Array) -> Array:
    """[B, K+1, others], the values of these along runs, in their own units; p [B, np]."""
    drawn, (B, nodes) = others(ocp), s.x.shape[:2]
    if not drawn:
        return np.zeros((B, nodes, 0))
    at = ocp.functions.arguments
    function = at.function("values", {"e": ca.vertcat(*(one.expression for one in drawn))})
    given = at.columns(x=s.x.reshape(B * nodes, -1), u=s.u.reshape(B * nodes, -1), t=s.times.ravel(),
                       p=np.repeat(p, nodes, axis=0))
    return np.asarray(function(*given).full().T.reshape(B, nodes, -1))


def _linear(ocp: OCP, one: Constraint) -> tuple[int, float, float] | None:
    """(k, a, b) of an expression a z_k + b with numbers a, b; None for any other."""
    at = ocp.functions.arguments
    z, more = ca.vertcat(at["x"], at["u"]), [at[name] for name in at.names if name not in ("x", "u")]
    slopes = ca.jacobian(one.expression, z)
    if slopes.nnz() != 1 or not slopes.is_constant() or ca.depends_on(one.expression, ca.vertcat(ca.SX(0, 1), *more)):
        return None
    rest = ca.Function("rest", [z], [one.expression])(0)
    return int(slopes.sparsity().get_triplet()[1][0]), float(slopes.nz[0]), float(rest)
