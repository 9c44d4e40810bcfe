"""Angles in, from any sensor: followed against the last state, for controllers of problems that tell turns apart."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from nocl.definition.ocp import OCP
from nocl.support import checks
from nocl.support.checks import Array


class Unwrapped:
    """A controller u(x, t) whose angles may come wrapped, as sensors give them: each is taken as the image that is
    nearest to the last one, so it must turn by less than half a turn between two calls.

    The first call, an earlier time than the last, and another number of states begin anew: then angles are taken as
    they are. `reset()` does so at will.
    """

    def __init__(self, controller: Callable[..., Array], ocp: OCP) -> None:
        self.controller, self.ocp = controller, ocp
        self.angles = [i for i in ocp.system.angle_indices if i not in ocp.periodic]
        self.reset()

    def reset(self) -> None:
        """The next state is taken as it is."""
        self.last: Array | None = None
        self.time = -np.inf

    def __call__(self, x: ArrayLike, t: float = 0.0, *p: Any) -> Any:
        """u [nu] or [B, nu] at states x [nx] or [B, nx], and parameters where the controller takes some."""
        rows, single = checks.states(x, self.ocp.system.nx, self.ocp.system.name, "x")
        if self.last is not None and (t < self.time or self.last.shape != rows.shape):
            self.reset()
        rows = rows.copy()
        if self.last is not None:
            turns = np.round((self.last[:, self.angles] - rows[:, self.angles]) / (2 * np.pi))
            rows[:, self.angles] += 2 * np.pi * turns
        self.last, self.time = rows, t
        u = self.controller(rows, t, *p)
        return u[0] if single else u
