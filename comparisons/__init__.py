"""Comparisons of any methods, per initial state."""

from nocl.comparisons.compare import Report, compare

__all__ = ["Report", "compare"]
