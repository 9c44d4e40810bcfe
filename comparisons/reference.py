"""The yardstick of a comparison: the optimum on a fine grid, reached from what the methods themselves found."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from nocl.checks import Array
from nocl.comparisons import report
from nocl.ocp import OCP
from nocl.solvers.bank import better
from nocl.solvers.ddp import DDP, DDPSolution

NAME = report.REFERENCE


class Reference:
    """The best of DDP's descents on `intervals` held controls, from each of `guesses` and from u*.

    A method's gap to the best known cost says little where that method found it: with this row beside it, no method is
    measured against itself alone. Path constraints enter by the OCP's penalty; a row that violates one does not count.

    Parameters
    ----------
    guesses : sequence of controls [B, K, nu]
        Held on K equal intervals, K a divisor of `intervals`; NaN stands for u*.
    """

    def __init__(self, ocp: OCP, intervals: int, guesses: Sequence[Array] = ()) -> None:
        self.ocp, self.intervals, self.guesses = ocp, intervals, list(guesses)

    def solve(self, x0: Array) -> DDPSolution:
        """The best solution of each state x0 [B, nx]; guesses are of the same states."""
        ddp = DDP(self.ocp, intervals=self.intervals)
        best = ddp.solve(x0)
        goal = np.asarray(self.ocp.u_goal)
        for guess in self.guesses:
            u = np.repeat(guess, self.intervals // guess.shape[1], axis=1)
            best = better(best, ddp.solve(x0, u=np.where(np.isfinite(u), u, goal)))
        return best
