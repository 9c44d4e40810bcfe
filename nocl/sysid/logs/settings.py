"""Budgets and sizes of identification from logs, checked on construction."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

from nocl.support.fields import Scaled, count, flag, nonnegative


@dataclass(frozen=True)
class LogSettings(Scaled):
    """Of identification from logged trajectories."""

    EFFORT: ClassVar[Mapping[str, Mapping[str, Any]]] = {
        "quick": {"width": 12, "iterations": 60, "steps": 3, "window": 20},
        "best": {"iterations": 600, "steps": 60, "windows": 3000}}

    width: int = count(32, "of the two hidden layers")
    iterations: int = count(300, "of L-BFGS on derivatives", least=0)
    steps: int = count(20, "Gauss-Newton steps on simulation error, at most, for each length of windows; 0: "
                       "derivatives alone", least=0)
    window: int = count(40, "steps that are simulated in one go in the end: windows start with 2, and grow")
    windows: int = count(1000, "of that length, at most, drawn at random beyond")
    substeps: int = count(1, "RK4 steps between two samples")
    ridge: float | None = nonnegative(None, "times the sum of squared weights, beside the mean of squared residuals",
                                      none="one over the number of residuals, the most probable weights where those of "
                                      "a standard normal distribution are expected")
    angles: bool = flag(True, "networks see angles as sin and cos")
