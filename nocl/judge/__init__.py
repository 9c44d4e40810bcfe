"""The judge: any controller, any plan, on the exact f under CVODES."""

from __future__ import annotations

from nocl.support.lazy import hand_on

_LAZY = {"simulate": "nocl.judge.simulation", "Simulation": "nocl.judge.runs",
         "response": "nocl.judge.settling", "Response": "nocl.judge.settling"}
__all__ = list(_LAZY)
__getattr__, __dir__ = hand_on(__name__, _LAZY)
