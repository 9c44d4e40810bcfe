"""CND, control with neural dynamics: a neural feedback controller and value function for a whole region of states."""

from __future__ import annotations

from nocl.support.lazy import hand_on

_LAZY = {"CND": "nocl.solvers.cnd.controller", "pretrained": "nocl.solvers.cnd.controller",
         "TrainSettings": "nocl.solvers.cnd.settings", "train": "nocl.solvers.cnd.training"}
__all__ = list(_LAZY)
__getattr__, __dir__ = hand_on(__name__, _LAZY)
