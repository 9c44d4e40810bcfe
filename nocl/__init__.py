"""nocl: neural optimal control. A system is written once, in CasADi; everything else comes from it."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from nocl.ocp import OCP
from nocl.sampling import Gaussian, Uniform
from nocl.system import System

__version__ = "0.1.0"

_LAZY = {  # public name -> module: torch and the solvers are imported when first used
    "CND": "nocl.solvers.cnd", "train": "nocl.solvers.cnd", "pretrained": "nocl.solvers.cnd",
    "identify": "nocl.sysid", "LearnedDynamics": "nocl.sysid", "load_dynamics": "nocl.sysid",
    "Dataset": "nocl.data", "Solution": "nocl.data", "Trajectory": "nocl.data",
    "load_ocp": "nocl.systems", "simulate": "nocl.simulate",
    "to_torch": "nocl.to_torch", "to_casadi": "nocl.to_casadi",
}
__all__ = ["OCP", "Gaussian", "System", "Uniform", *_LAZY]


def __getattr__(name: str) -> Any:
    if name not in _LAZY:
        raise AttributeError(f"module 'nocl' has no attribute {name!r}")
    return getattr(import_module(_LAZY[name]), name)


def __dir__() -> list[str]:
    return sorted(__all__)
