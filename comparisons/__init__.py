"""Comparisons of any methods, per initial state."""

from nocl.comparisons.compare import compare
from nocl.comparisons.report import Report

__all__ = ["Report", "compare"]
