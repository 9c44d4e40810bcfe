"""The pair (x*, u*) that a problem goes to: numbers, expressions of its parameters, or none."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from nocl.definition.sampling import short
from nocl.support import checks
from nocl.support.checks import Array


class Goal(np.ndarray[Any, np.dtype[np.float64]]):
    """A goal that depends on p: its numbers at the nominal p, and its expression, which dataclasses.replace keeps."""

    expression: ca.SX

    @staticmethod
    def at(expression: ca.SX, p: ca.SX, nominal: Array) -> Goal:
        values = ca.Function("goal", [p], [expression])(nominal).full().ravel()
        goal = values.view(Goal)
        goal.expression = expression
        goal.setflags(write=False)
        return goal


class Reference(np.ndarray[Any, np.dtype[np.float64]]):
    """A point that stands where a goal would, of a problem without one; dataclasses.replace keeps it as none."""

    @staticmethod
    def at(point: Array) -> Reference:
        reference = np.array(point, dtype=np.float64).view(Reference)
        reference.setflags(write=False)
        return reference


def text(goal: Array) -> str:
    """A goal as text: numbers, or expressions of p."""
    expression = getattr(goal, "expression", None)
    return short(goal) if expression is None else str(expression)


def column(goal: Any, n: int, name: str, owner: str) -> Any:
    """A user's goal as a CasADi column: numbers, or expressions of p."""
    goal = joined(goal)
    if not isinstance(goal, ca.SX):
        return ca.DM(checks.vector(goal, n, name, owner))
    if goal.shape != (n, 1):
        raise ValueError(f"{owner}: {name} has shape {list(goal.shape)}; expected [{n}], numbers or expressions of p")
    return goal


def joined(goal: Any) -> Any:
    """A list with expressions of p in it as one SX column, other things as they are."""
    mixed = isinstance(goal, (list, tuple)) and any(isinstance(g, ca.SX) for g in goal)
    return checks.column(goal) if mixed else goal


def beside(rows: Array, axes: int) -> Array:
    """Rows [B, n] as they broadcast with an array [B, ..., n] of that many axes."""
    return np.expand_dims(rows, tuple(range(1, axes - 1)))
