"""What constraints dip by between the nodes of a plan: the margins that make up for it there.

An interval's dip is how far a row's least value inside it, the control held, lies below the lesser of its ends. A
node's margin is the larger dip of the two intervals beside it. Plans that are solved again with these margins hold the
constraints between nodes to second order in what the margins changed: two exchanges are worth it, a third is not.
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from nocl.functions import Functions
from nocl.solvers.ddp.constraints import ConstraintRows
from nocl.support.checks import Array

INSIDE = 8  # parts of an interval, at whose ends rows are looked at
EXCHANGES = 2


class Dips:
    """The margins of a problem's plans."""

    def __init__(self, functions: Functions, rows: ConstraintRows) -> None:
        at, self.rows, self.step = functions.arguments, rows, functions.step()
        self.at, self.c = at, at.function("c", {"c": rows.stage.c})
        self.kept = rows.of_x(at["u"])

    def margins(self, t: Array, x: Array, u: Array, p: Array) -> Array:
        """[B, rows of a plan], for t [B, K+1], x [B, K+1, nx], u [B, K, nu] and p [B, np]."""
        dip = np.where(self.rows.stage.equal, 0.0, self._dips(t, x, u, p))
        B, K, n = dip.shape
        nothing = np.zeros((B, 1, n))
        margin = np.maximum(np.concatenate([nothing, dip], axis=1), np.concatenate([dip, nothing], axis=1))
        end = np.zeros((B, len(self.rows.end)))
        of_x = margin[:, K][:, self.kept]
        count = min(of_x.shape[1], end.shape[1])
        end[:, :count] = np.where(self.rows.end.equal[:count], 0.0, of_x[:, :count])
        return np.ascontiguousarray(np.concatenate([margin[:, :K].reshape(B, K * n), end], axis=1))

    def left(self, t: Array, x: Array, u: Array, p: Array) -> Array:
        """[B], by how much of its scale a plan violates the worst inequality of its stages, between nodes too."""
        least = np.where(self.rows.stage.equal, 0.0, np.min(self._values(t, x, u, p), axis=0))
        over: Array = np.maximum(-least, 0.0).reshape(len(u), -1).max(axis=1, initial=0.0)
        return over

    def _dips(self, t: Array, x: Array, u: Array, p: Array) -> Array:
        """[B, K, rows of a stage], >= 0."""
        values = self._values(t, x, u, p)
        ends = np.minimum(values[0], values[-1])
        return np.maximum(ends - np.min(values, axis=0), 0.0).reshape(*u.shape[:2], -1)

    def _values(self, t: Array, x: Array, u: Array, p: Array) -> list[Array]:
        """The rows [B K, rows of a stage] at the ends of all parts of intervals."""
        B, K, nu = u.shape
        part = np.repeat((t[:, 1] - t[:, 0]) / INSIDE, K)
        now, states, controls = t[:, :-1].ravel(), x[:, :-1].reshape(B * K, x.shape[2]), u.reshape(B * K, nu)
        data = np.repeat(p, K, axis=0)
        values = []
        for j in range(INSIDE + 1):
            here = self.at.columns(x=states, u=controls, t=now + j * part, p=data)
            values.append(_at_once(self.c, here))
            if j < INSIDE:
                states = _at_once(self.step, [*here, part[None]])
        return values


def _at_once(function: ca.Function, columns: list[Array]) -> Array:
    """A function's first output for many columns, as rows."""
    out: Array = function.map(columns[0].shape[1]).call(columns)[0].full()
    return out.T
