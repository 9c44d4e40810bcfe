"""What constraints dip by between the nodes of a plan: the margins that make up for it there.

An interval's dip is how far a row's least value inside it, the control held, lies below the lesser of its ends. A
node's margin is the larger dip of the two intervals beside it. Plans that are solved again with these margins hold the
constraints between nodes to second order in what the margins changed: two exchanges are worth it, a third is not.
"""

from __future__ import annotations

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from nocl.functions import Functions
from nocl.support.checks import Array

INSIDE = 8  # parts of an interval, at whose ends rows are looked at
EXCHANGES = 2
CUTS = "; between nodes it may cut corners, margins there could not be held"  # what is said of a plan


class Dips:
    """Those of the rows c [n] >= 0, in units of their scales, in a problem's own symbols; equations have none."""

    def __init__(self, functions: Functions, c: ca.SX, equal: NDArray[np.bool_]) -> None:
        self.at, self.step, self.equal = functions.arguments, functions.step(), equal
        self.c = self.at.function("c", {"c": c})

    def margins(self, t: Array, x: Array, u: Array, p: Array) -> Array:
        """[B, K+1, n], of each node, for t [B, K+1], x [B, K+1, nx], u [B, K, nu] and p [B, np]."""
        values = self._values(t, x, u, p)
        ends, (B, K, _) = np.minimum(values[0], values[-1]), u.shape
        dip = np.maximum(ends - np.min(values, axis=0), 0.0).reshape(B, K, len(self.equal))
        nothing = np.zeros((B, 1, len(self.equal)))
        larger = np.maximum(np.concatenate([nothing, dip], axis=1), np.concatenate([dip, nothing], axis=1))
        return np.where(self.equal, 0.0, larger)

    def left(self, t: Array, x: Array, u: Array, p: Array) -> Array:
        """[B], by how much of its scale a plan violates the worst inequality, between nodes too."""
        least = np.where(self.equal, 0.0, np.min(self._values(t, x, u, p), axis=0))
        over: Array = np.maximum(-least, 0.0).reshape(len(u), -1).max(axis=1, initial=0.0)
        return over

    def _values(self, t: Array, x: Array, u: Array, p: Array) -> list[Array]:
        """The rows [B K, n] at the ends of all parts of intervals."""
        B, K, nu = u.shape
        part, now = np.diff(t).ravel() / INSIDE, t[:, :-1].ravel()
        states, controls, data = x[:, :-1].reshape(B * K, x.shape[2]), u.reshape(B * K, nu), np.repeat(p, K, axis=0)
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
