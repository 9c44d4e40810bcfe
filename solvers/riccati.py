"""Riccati's recursion: linear-quadratic problems of systems in discrete time, about a goal pair.

With d = x - x*, v = u - u*, d+ = A d + B v and a step's cost (d'Q d + 2 d'S v + v'R v) / 2 it is V_k = d' P_k d / 2,
K = (R + B' P B)^-1 (B' P A + S'), P_k = Q + A' P A - K' (R + B' P B) K, P = P_{k+1}; for ever P_k = P (Anderson, Moore
(1990), "Optimal Control: Linear Quadratic Methods", ch. 2).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import LinAlgError, solve_discrete_are

from nocl.support.checks import Array


@dataclass(frozen=True, eq=False)
class Stages:
    """The steps of a linear-quadratic problem, all the same."""

    A: Array  # [nx, nx]
    B: Array  # [nx, nu]
    Q: Array  # [nx, nx]
    R: Array  # [nu, nu]
    S: Array  # [nx, nu]

    def curvature(self, P: Array) -> Array:
        """Of a step's cost and P after it, in u [nu, nu]."""
        return np.asarray(self.R + self.B.T @ P @ self.B)

    def gain(self, P: Array) -> Array:
        """K [nu, nx] of a step that P follows."""
        return np.asarray(np.linalg.solve(self.curvature(P), self.B.T @ P @ self.A + self.S.T))

    def before(self, P: Array) -> Array:
        """P before a step, from that after it; NaN where no control is best."""
        H = self.curvature(P)
        if not np.isfinite(H).all() or np.linalg.eigvalsh(H).min() <= 0:
            return np.full_like(P, np.nan)
        K = self.gain(P)
        found = self.Q + self.A.T @ P @ self.A - K.T @ H @ K
        return np.asarray((found + found.T) / 2)

    def backward(self, P: Array, steps: int) -> Array:
        """P [steps + 1, nx, nx] at all samples, from that at the end; NaN from where there is none."""
        found = [P]
        for _ in range(steps):
            found.append(self.before(found[-1]))
        return np.array(found[::-1])

    def for_ever(self) -> Array | None:
        """P of the stabilising solution; None where there is none."""
        try:
            P = solve_discrete_are(self.A, self.B, self.Q, self.R, s=self.S)
        except (LinAlgError, ValueError):
            return None
        if not np.isfinite(P).all() or np.linalg.eigvalsh(self.curvature(P)).min() <= 0:  # a saddle, or a maximum
            return None
        stable = np.abs(np.linalg.eigvals(self.A - self.B @ self.gain(P))).max() < 1
        return np.asarray(P) if stable else None
