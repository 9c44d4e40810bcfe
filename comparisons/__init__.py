"""Comparisons of any methods, per initial state."""

from __future__ import annotations

from nocl.support.lazy import hand_on

_LAZY = {"at_each": "nocl.comparisons.each", "compare": "nocl.comparisons.comparison",
         "doctor": "nocl.comparisons.diagnosis",
         "Report": "nocl.comparisons.report.report",
         "robustness": "nocl.comparisons.disturbances", "study": "nocl.comparisons.studies"}
__all__ = list(_LAZY)
__getattr__, __dir__ = hand_on(__name__, _LAZY)
