"""Solvers: an OCP in, a controller or solutions out."""

from __future__ import annotations

from importlib import import_module
from typing import Any

_LAZY = {"LQR": "nocl.solvers.lqr", "NMPC": "nocl.solvers.nmpc", "DDP": "nocl.solvers.ddp", "CND": "nocl.solvers.cnd",
         "SolutionBank": "nocl.solvers.bank", "solve_globally": "nocl.solvers.global_search",
         "NeuralOC": "nocl.solvers.neural_oc", "train_neural_oc": "nocl.solvers.neural_oc"}
__all__ = list(_LAZY)


def __getattr__(name: str) -> Any:
    if name not in _LAZY:
        raise AttributeError(f"module 'nocl.solvers' has no attribute {name!r}")
    return getattr(import_module(_LAZY[name]), name)
