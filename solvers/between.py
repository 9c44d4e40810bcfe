"""What constraints dip by between the nodes of a plan: the margins that make up for it there.

An interval's dip is how far a row's least value inside it, the control held, lies below the lesser of its ends, or for
a row of the control below its start, since another control acts from the end on. A node's margin is the larger dip of
the two intervals beside it, or that of the interval that its control acts on. Plans that are solved again with these
margins hold the constraints between nodes to second order in what the margins changed: two exchanges are worth it, more
only while constraints are violated by more than is tolerated. A row of state and control that its node's control does
not move, a power at rest, has no margin that helps: such plans are told.
"""

from __future__ import annotations

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from nocl.definition.constraints import TOLERANCE
from nocl.definition.functions import Functions
from nocl.definition.substeps import RK4
from nocl.support.checks import Array

INSIDE = 8  # parts of an interval, at whose ends rows are looked at
EXCHANGES, MOST = 2, 6  # of margins, and where more are needed at most
SAME = 0.01  # of what is left: an exchange that changes it by less is the last
CUTS = "; between nodes it may cut corners, margins there could not be held"  # what is said of a plan


class Dips:
    """Those of the rows c [n] >= 0, in units of their scales, in a problem's own symbols; `without` [n] have none.

    substeps, integrator : of an interval, in the plans
    """

    def __init__(self, functions: Functions, c: ca.SX, without: NDArray[np.bool_], substeps: int,
                 integrator: str = RK4) -> None:
        self.at, self.without = functions.arguments, without
        self.step = functions.step(substeps=-(-substeps // INSIDE), integrator=integrator)
        self.c = self.at.function("c", {"c": c})
        self.of_u = np.isin(np.arange(len(without)), ca.jacobian_sparsity(c, self.at["u"]).get_triplet()[0])

    def margins(self, t: Array, x: Array, u: Array, p: Array) -> Array:
        """[B, K+1, n], of each node, for t [B, K+1], x [B, K+1, nx], u [B, K, nu] and p [B, np]."""
        (B, K, _), n = u.shape, len(self.without)
        values = self._values(t, x, u, p)
        top = np.where(self.of_u, values[0], np.minimum(values[0], values[-1]))
        dip = np.nan_to_num(np.maximum(top - values.min(axis=0), 0.0), posinf=0.0).reshape(B, K, n)
        nothing = np.zeros((B, 1, n))
        after, before = np.concatenate([dip, nothing], axis=1), np.concatenate([nothing, dip], axis=1)
        return np.where(self.without, 0.0, np.where(self.of_u, after, np.maximum(after, before)))

    def cut(self, t: Array, x: Array, u: Array, p: Array) -> NDArray[np.bool_]:
        """[B], whether a plan violates one of the rows by more than TOLERANCE, at nodes or between them."""
        return np.asarray(~(self.left(t, x, u, p) <= TOLERANCE))

    def left(self, t: Array, x: Array, u: Array, p: Array) -> Array:
        """[B], by how much of its scale a plan violates the worst row, between nodes too; what x0 alone decides does
        not count."""
        values = self._values(t, x, u, p).reshape(INSIDE + 1, *u.shape[:2], len(self.without))
        values[0, :, 0][:, ~self.of_u] = 0.0
        least = np.where(self.without, 0.0, values.min(axis=0))
        over: Array = np.maximum(-least, 0.0).max(axis=(1, 2), initial=0.0)
        return over

    def _values(self, t: Array, x: Array, u: Array, p: Array) -> Array:
        """The rows [INSIDE + 1, B K, n] at the ends of all parts of intervals."""
        B, K, nu = u.shape
        if not B * K:
            return np.zeros((INSIDE + 1, 0, len(self.without)))
        part, now = np.diff(t).ravel() / INSIDE, t[:, :-1].ravel()
        states, controls, data = x[:, :-1].reshape(B * K, x.shape[2]), u.reshape(B * K, nu), np.repeat(p, K, axis=0)
        values = []
        for j in range(INSIDE + 1):
            here = self.at.columns(x=states, u=controls, t=now + j * part, p=data)
            values.append(_at_once(self.c, here))
            if j < INSIDE:
                states = _at_once(self.step, [*here, part[None]])
        return np.array(values)


def _at_once(function: ca.Function, columns: list[Array]) -> Array:
    """A function's first output for many columns, as rows."""
    out: Array = function.map(columns[0].shape[1]).call(columns)[0].full()
    return out.T
