"""nocl: neural optimal control. A system is written once, in CasADi; everything else comes from it."""

from __future__ import annotations

from typing import TYPE_CHECKING

from nocl.definition.constraints import INFINITE, Free, limit_rates
from nocl.definition.ocp import OCP
from nocl.definition.parameters import parameter, spline, time
from nocl.definition.sampling import Gaussian, Uniform
from nocl.definition.smoothness import smooth_abs, smooth_max, split_controls
from nocl.definition.system import System
from nocl.support.lazy import hand_on

if TYPE_CHECKING:
    from nocl.data import Dataset, Solution, Trajectory
    from nocl.exports.casadi_forms import to_casadi
    from nocl.exports.interop import held_inputs, to_acados, to_control, to_do_mpc, to_gymnasium
    from nocl.judge.simulation import simulate
    from nocl.solvers.cnd.controller import CND, pretrained
    from nocl.solvers.cnd.training import train
    from nocl.sysid.ensemble import Ensemble
    from nocl.sysid.identification import LearnedDynamics, identify
    from nocl.sysid.logs.log import Log
    from nocl.systems import load_ocp
    from nocl.translate.torch_functions import to_torch

__version__ = "0.1.0"
__all__ = ["CND", "INFINITE", "OCP", "Dataset", "Ensemble", "Free", "Gaussian", "LearnedDynamics", "Log", "Solution",
           "System", "Trajectory", "Uniform", "comparisons", "held_inputs", "identify", "limit_rates", "load_ocp",
           "parameter", "pretrained", "simulate", "smooth_abs", "smooth_max", "solvers", "spline", "split_controls",
           "systems", "time", "to_acados", "to_casadi", "to_control", "to_do_mpc", "to_gymnasium", "to_torch", "train"]

_LAZY = {  # public name -> module: torch and the solvers are imported when first used
    "CND": "nocl.solvers.cnd.controller", "train": "nocl.solvers.cnd.training",
    "pretrained": "nocl.solvers.cnd.controller",
    "identify": "nocl.sysid.identification", "LearnedDynamics": "nocl.sysid.identification",
    "Ensemble": "nocl.sysid.ensemble", "Log": "nocl.sysid.logs.log",
    "Dataset": "nocl.data", "Solution": "nocl.data", "Trajectory": "nocl.data",
    "load_ocp": "nocl.systems", "simulate": "nocl.judge.simulation",
    "to_torch": "nocl.translate.torch_functions", "to_casadi": "nocl.exports.casadi_forms",
    "to_acados": "nocl.exports.interop", "to_control": "nocl.exports.interop", "to_do_mpc": "nocl.exports.interop",
    "to_gymnasium": "nocl.exports.interop", "held_inputs": "nocl.exports.interop",
}
__getattr__, __dir__ = hand_on(__name__, _LAZY)
