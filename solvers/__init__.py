"""Solvers: an OCP in, a controller or solutions out."""

from __future__ import annotations

from nocl.support.lazy import hand_on

_LAZY = {"LQR": "nocl.solvers.lqr", "NMPC": "nocl.solvers.nmpc.solver", "DDP": "nocl.solvers.ddp.solver",
         "CND": "nocl.solvers.cnd.controller", "SolutionBank": "nocl.solvers.ddp.bank",
         "solve_globally": "nocl.solvers.ddp.global_search", "NeuralOC": "nocl.solvers.neural_oc",
         "train_neural_oc": "nocl.solvers.neural_oc", "Safeguard": "nocl.solvers.safeguard.guarded"}
__all__ = list(_LAZY)
__getattr__, __dir__ = hand_on(__name__, _LAZY)
