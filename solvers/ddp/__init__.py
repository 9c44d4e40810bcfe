"""Differential dynamic programming over a batch: thousands of optimal control problems at once."""

from __future__ import annotations

from nocl.support.lazy import hand_on

_LAZY = {"DDP": "nocl.solvers.ddp.solver", "SolutionBank": "nocl.solvers.ddp.bank",
         "GlobalDDP": "nocl.solvers.ddp.global_search", "solve_globally": "nocl.solvers.ddp.global_search"}
__all__ = list(_LAZY)
__getattr__, __dir__ = hand_on(__name__, _LAZY)
