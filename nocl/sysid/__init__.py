"""System identification: f_theta from labels of f and its Jacobians, or from logs."""

from __future__ import annotations

from nocl.support.lazy import hand_on

_LAZY = {"identify": "nocl.sysid.identification", "LearnedDynamics": "nocl.sysid.identification",
         "Score": "nocl.sysid.score", "Settings": "nocl.sysid.settings", "PaperSettings": "nocl.sysid.settings",
         "LogSettings": "nocl.sysid.settings", "Ensemble": "nocl.sysid.ensemble", "Log": "nocl.sysid.logs.log"}
__all__ = list(_LAZY)
__getattr__, __dir__ = hand_on(__name__, _LAZY)
