"""nocl: neural optimal control. A system is written once, in CasADi; everything else comes from it."""

from __future__ import annotations

import sys
from importlib import import_module
from types import ModuleType
from typing import TYPE_CHECKING, Any

from nocl.ocp import OCP
from nocl.sampling import Gaussian, Uniform
from nocl.system import System

if TYPE_CHECKING:
    from nocl.data import Dataset, Solution, Trajectory
    from nocl.ensemble import Ensemble
    from nocl.logs import Log
    from nocl.simulate import simulate
    from nocl.solvers.cnd import CND, pretrained, train
    from nocl.sysid import LearnedDynamics, identify
    from nocl.systems import load_ocp
    from nocl.to_casadi import to_casadi
    from nocl.to_torch import to_torch

__version__ = "0.1.0"
__all__ = ["CND", "OCP", "Dataset", "Ensemble", "Gaussian", "LearnedDynamics", "Log", "Solution", "System",
           "Trajectory", "Uniform", "identify", "load_ocp", "pretrained", "simulate", "to_casadi", "to_torch", "train"]

_LAZY = {  # public name -> module: torch and the solvers are imported when first used
    "CND": "nocl.solvers.cnd", "train": "nocl.solvers.cnd", "pretrained": "nocl.solvers.cnd",
    "identify": "nocl.sysid", "LearnedDynamics": "nocl.sysid",
    "Ensemble": "nocl.ensemble", "Log": "nocl.logs",
    "Dataset": "nocl.data", "Solution": "nocl.data", "Trajectory": "nocl.data",
    "load_ocp": "nocl.systems", "simulate": "nocl.simulate",
    "to_torch": "nocl.to_torch", "to_casadi": "nocl.to_casadi",
}


class _Package(ModuleType):
    """nocl.to_torch and its like are the functions, whether or not the modules of the same name are imported."""

    def __setattr__(self, name: str, value: Any) -> None:
        if not (name in _LAZY and isinstance(value, ModuleType)):
            super().__setattr__(name, value)


sys.modules[__name__].__class__ = _Package


def __getattr__(name: str) -> Any:
    if name not in _LAZY:
        raise AttributeError(f"module 'nocl' has no attribute {name!r}")
    return getattr(import_module(_LAZY[name]), name)


def __dir__() -> list[str]:
    return sorted(__all__)
