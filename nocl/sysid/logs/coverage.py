"""Where a log has been: a warning for states that it says nothing about."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import KDTree

from nocl.definition.system import System
from nocl.support import checks
from nocl.support.checks import Array
from nocl.sysid.logs.log import Log

POINTS = 2000  # of the log that are kept
LEAST = 1e-9  # radius, where recordings repeat each other
USUAL = 0.95  # share of a recording's states that lie within `radius` of the other recordings


@dataclass(frozen=True, eq=False)
class Coverage:
    """Logged states, as points whose coordinates are in units of their spread; angles as sin and cos.

    A state is outside where the nearest logged one is farther than `radius`: as far as a state of one recording
    usually is (95 %) from the nearest of all others; with one recording, from the nearest of its other half in time.
    """

    points: Array  # [n, d]
    centre: Array  # [nx]
    scale: Array  # [nx]
    angles: tuple[int, ...]
    radius: float
    names: tuple[str, ...]

    @staticmethod
    def of(log: Log, system: System, seed: int = 0) -> Coverage:
        """Of all whole states of a log, at most POINTS at random."""
        rows = [r.x[np.isfinite(r.x).all(axis=1)] for r in log]
        x = np.concatenate(rows)
        if len({r.run for r in log}) > 1:
            names = sorted({r.run for r in log})
            label = np.repeat([names.index(r.run) for r in log], [len(r) for r in rows])
        else:
            label = (np.arange(len(x)) * 2 // len(x)).astype(int)
        order = np.random.default_rng(seed).permutation(len(x))[:POINTS]
        scale = x.std(axis=0)
        whole = Coverage(np.zeros((0, 0)), x.mean(axis=0), np.where(scale > 0, scale, 1.0), system.angle_indices, 0.0,
                         system.state_names)
        points, label = whole.features(x[order]), label[order]
        apart = [KDTree(points[label != k]).query(points[label == k])[0] for k in np.unique(label)]
        return Coverage(points, whole.centre, whole.scale, whole.angles,
                        max(float(np.quantile(np.concatenate(apart), USUAL)), LEAST), whole.names)

    def features(self, x: Array) -> Array:
        """States [N, nx] as points [N, d]."""
        others = [i for i in range(x.shape[1]) if i not in self.angles]
        turned = x[:, list(self.angles)]
        return np.hstack([((x - self.centre) / self.scale)[:, others], np.sin(turned), np.cos(turned)])

    @cached_property
    def _tree(self) -> KDTree:
        return KDTree(self.points)

    def distance(self, x: ArrayLike) -> Array:
        """From states [N, nx] (or one, [nx]) to the nearest logged one, in radii: above 1 is outside. [N]"""
        rows, _ = checks.states(x, len(self.names), "coverage", "x")
        return self._tree.query(self.features(rows))[0] / self.radius

    def outside(self, x: ArrayLike) -> Any:
        """Which of the states [N, nx] the log says nothing about, [N] bool."""
        return self.distance(x) > 1

    def warn(self, x: ArrayLike, what: str = "states") -> Any:
        """`outside`, and a UserWarning that says how many of `what` are, and the farthest."""
        rows, _ = checks.states(x, len(self.names), "coverage", "x")
        distance = self.distance(rows)
        outside = distance > 1
        if outside.any():
            far = rows[int(distance.argmax())]
            at = ", ".join(f"{n} = {v:.3g}" for n, v in zip(self.names, far, strict=True))
            warnings.warn(f"{outside.sum()} of {len(rows)} {what} lie outside the logged data, the farthest "
                          f"({distance.max():.1f} times the usual distance) at {at}: the model guesses there; log more "
                          "runs that go there", UserWarning, stacklevel=2)
        return outside

    def to_data(self) -> dict[str, Any]:
        return {"points": np.round(self.points, 6).tolist(), "centre": self.centre.tolist(),
                "scale": self.scale.tolist(), "angles": list(self.angles), "radius": self.radius,
                "names": list(self.names)}

    @staticmethod
    def from_data(data: Mapping[str, Any]) -> Coverage:
        return Coverage(np.array(data["points"]), np.array(data["centre"]), np.array(data["scale"]),
                        tuple(data["angles"]), data["radius"], tuple(data["names"]))


def share_of_nodes(marks: Callable[[Array, Array], Any], x: ArrayLike, u: ArrayLike) -> Array:
    """The share of each trajectory's nodes x [B, K+1, nx], u [B, K or K+1, nu] that `marks` (rows -> [n] bool): [B].

    NaN where a trajectory has no finite node.
    """
    u = np.asarray(u)
    x = np.asarray(x)[:, : u.shape[1]]
    there = np.isfinite(x).all(axis=2) & np.isfinite(u).all(axis=2)
    marked = np.zeros(there.shape)
    if there.any():
        marked[there] = marks(x[there], u[there])
    count = there.sum(axis=1)
    return np.where(count > 0, marked.sum(axis=1) / np.maximum(count, 1), np.nan)
