"""Proofs about functions on balls, by enclosures over boxes: that one is >= 0 that is 0 and flat in the middle, and how
far rows stay >= 0.

Where a function's Hessian is positive semidefinite in all boxes of a small ball it is convex there, hence >= 0. From
there to a larger ball boxes are halved until the Taylor polynomial about the middle of each, less what its second-order
term can be over the box, is > 0 (branch and bound).
"""

from __future__ import annotations

from itertools import product

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from nocl.support.checks import Array
from nocl.translate.enclosure import Interval, enclosure

CELLS = 512  # that a ball is cut into, about
MOST = 100_000  # boxes that are looked at
FEW = 3  # dimensions, in which that is enough
BISECTIONS, SAME = 12, 1e-2  # of a radius, until it is found to a share
SMALLER = 2.0 ** np.arange(-1, -11, -1)  # times a radius, the small balls that are tried


class Positive:
    """A function e(z) [1] with e(0) = 0 and no slope there."""

    def __init__(self, e: ca.SX, z: ca.SX) -> None:
        H, g = ca.hessian(e, z)
        self.n = z.numel()
        self.at = ca.Function("at", [z], [ca.densify(ca.vertcat(e, g))])
        self.hessian = ca.Function("hessian", [z], [ca.vec(ca.densify(H))])

    def up_to(self, radius: float) -> bool:
        """Whether it is proven to be >= 0 in a ball."""
        if self.convex(radius):
            return True
        if self.n > FEW:
            return False
        inner = next((part for part in radius * SMALLER if self.convex(part)), 0.0)
        return inner > 0 and self._positive(inner, radius)

    def convex(self, radius: float) -> bool:
        """Whether it is proven to be convex in a ball: the Hessian of each box's middle outweighs what is left."""
        least, most = self._hessians(*cells(self.n, radius))
        if not (np.isfinite(least).all() and np.isfinite(most).all()):
            return False
        middle, rest = (least + most) / 2, (most - least) / 2
        middle, rest = (middle + middle.transpose(0, 2, 1)) / 2, np.maximum(rest, rest.transpose(0, 2, 1))
        return bool((np.linalg.eigvalsh(middle)[:, 0] >= np.linalg.eigvalsh(rest)[:, -1]).all())

    def _positive(self, inner: float, outer: float) -> bool:
        """Whether it is > 0 between two balls."""
        low, high = cells(self.n, outer)
        seen = 0
        while low.shape[1]:
            seen += low.shape[1]
            if seen > MOST:
                return False
            left = ~self._above(low, high) & touches(low, high, outer) & ~within(low, high, inner)
            low, high = _halved(low[:, left], high[:, left])
        return True

    def _above(self, low: Array, high: Array) -> NDArray[np.bool_]:
        """[B], whether it is > 0 in boxes [n, B]."""
        middle, half = (low + high) / 2, (high - low) / 2
        (value, *below), (_, *above) = enclosure(self.at, middle, middle)
        slope = np.maximum(np.abs(below), np.abs(above))
        least, most = self._hessians(low, high)
        bend = np.maximum(np.abs(least), np.abs(most))
        with np.errstate(invalid="ignore"):
            worst = value - (slope * half).sum(axis=0) - np.einsum("ib,bij,jb->b", half, bend, half) / 2
        return np.asarray(worst > 0)

    def _hessians(self, low: Array, high: Array) -> Interval:
        least, most = enclosure(self.hessian, low, high)
        return least.T.reshape(-1, self.n, self.n), most.T.reshape(-1, self.n, self.n)


def radius_of(rows: ca.SX, z: ca.SX, radius: float) -> float:
    """Up to which all rows, > 0 at 0, are >= 0 in a ball of at most `radius`, by their slopes in it; exact where they
    are linear, 0 where one is not > 0."""
    if not rows.numel():
        return radius
    n = z.numel()
    here = ca.Function("rows", [z], [ca.densify(rows)])(np.zeros(n)).full().ravel()
    slopes = ca.Function("slopes", [z], [ca.vec(ca.densify(ca.jacobian(rows, z)))])

    def reach(most: float) -> float:
        """The radius that slopes in a ball allow, at most that of the ball."""
        steep = np.maximum(*(np.abs(side) for side in enclosure(slopes, *cells(n, most))))
        steepest = np.sqrt((steep.reshape(n, len(here), -1) ** 2).sum(axis=0)).max(axis=1)
        with np.errstate(divide="ignore", invalid="ignore"):
            return float(np.min(np.where(here > 0, here / steepest, 0.0), initial=most))

    low, high = reach(radius), radius
    for _ in range(BISECTIONS):
        if not 0 < low < high * (1 - SAME):
            break
        middle = (low + high) / 2
        found = reach(middle)
        low, high = max(low, found), high if found == middle else middle
    return low


def cells(n: int, radius: float) -> tuple[Array, Array]:
    """(low, high), each [n, B]: boxes that cover a ball."""
    each = max(1, int(CELLS ** (1 / n) + 1e-9)) if n <= FEW else 1
    edges = np.linspace(-radius, radius, each + 1)
    low, high = (np.array(list(product(side, repeat=n))).T for side in (edges[:-1], edges[1:]))
    some = touches(low, high, radius)
    return low[:, some], high[:, some]


def touches(low: Array, high: Array, radius: float) -> NDArray[np.bool_]:
    """[B], whether boxes reach into a ball."""
    return np.asarray((np.clip(0.0, low, high) ** 2).sum(axis=0) <= radius**2)


def within(low: Array, high: Array, radius: float) -> NDArray[np.bool_]:
    """[B], whether boxes lie in a ball."""
    return np.asarray((np.maximum(np.abs(low), np.abs(high)) ** 2).sum(axis=0) <= radius**2)


def _halved(low: Array, high: Array) -> tuple[Array, Array]:
    """Boxes halved in all directions."""
    n, middle = len(low), (low + high) / 2
    upper = np.array(list(product((False, True), repeat=n))).T[:, :, None]  # [n, 2^n, 1]
    found = (np.where(upper, a[:, None], b[:, None]).reshape(n, -1) for a, b in ((middle, low), (high, middle)))
    return tuple(found)  # type: ignore[return-value]
