"""The Hamilton-Jacobi-Bellman equation on a grid (extra `levelset`)."""

from __future__ import annotations

from nocl.support.lazy import hand_on

_LAZY = {"LevelSet": "nocl.solvers.levelset.solver", "LevelSetSolution": "nocl.solvers.levelset.solver",
         "refine": "nocl.solvers.levelset.solver"}
__all__ = list(_LAZY)
__getattr__, __dir__ = hand_on(__name__, _LAZY)
