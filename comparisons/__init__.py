"""Comparisons of any methods, per initial state."""

from nocl.comparisons.compare import compare
from nocl.comparisons.report import Report
from nocl.comparisons.robustness import robustness
from nocl.comparisons.study import study

__all__ = ["Report", "compare", "robustness", "study"]
