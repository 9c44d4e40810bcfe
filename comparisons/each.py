"""Methods that know no parameters, on a problem that has some: made anew at each p, for the problem at that p.

LQR about each goal, or a planner for each obstacle: `at_each(ocp, LQR)` is a method that compare runs beside those that
take p themselves.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np

from nocl.data import Solution
from nocl.definition.ocp import OCP
from nocl.judge.laws import answer_of, policy_function
from nocl.support import checks
from nocl.support.checks import Array

Make = Callable[[OCP], Any]  # a problem without parameters -> feedback or a solver


def at_each(ocp: OCP, make: Make) -> Any:
    """The method that is make(ocp.at(p)) at each p; make(ocp) itself where the problem has no parameters.

    make : like LQR, or lambda one: RRTStar(one, seed=0); what it returns is kept, one for each p that is met

    Raises ValueError for what is no function, and whatever `make` raises at the nominal parameters.
    """
    checks.problem(ocp, "at_each", discrete=True)
    if not callable(make):
        raise ValueError(f"at_each: make is {checks.shown(make)}; expected a function of a problem without parameters, "
                         "like nocl.solvers.LQR")
    if not ocp.np:
        return make(ocp)
    first = make(ocp.folded(ocp.nominal))
    if isinstance(first, Solution) or not (callable(first) or hasattr(first, "solve") or hasattr(first, "to_casadi")):
        raise ValueError(f"at_each: make returned a {type(first).__name__}; expected feedback, or a solver, like "
                         "lambda one: DDP(one)")
    if is_plan(first):
        return Plans(ocp, make, getattr(first, "settled", first))
    return Laws(ocp, make, policy_function(ocp.folded(ocp.nominal), first) is not None, getattr(first, "hold", None))


def is_plan(method: Any) -> bool:
    """Whether it is run open loop."""
    return isinstance(method, Solution) or \
        (hasattr(method, "solve") and not hasattr(method, "to_casadi") and not isinstance(method, ca.Function))


class _Each:
    """What is made at each p, once."""

    def __init__(self, ocp: OCP, make: Make) -> None:
        self.ocp, self.make = ocp, make
        self.made: dict[bytes, tuple[OCP, Any, Any] | Exception] = {}  # by p's bytes

    def at(self, p: Array) -> tuple[OCP, Any, Any]:
        """(the problem at parameters p [np], the method for it, its policy in CasADi or else itself).

        Raises whatever making it raised.
        """
        key = np.ascontiguousarray(p).tobytes()
        if key not in self.made:
            try:
                self.made[key] = self._new(p)
            except Exception as error:  # it would be raised again: once is enough
                self.made[key] = error
        found = self.made[key]
        if isinstance(found, Exception):
            raise found
        return found

    def _new(self, p: Array) -> tuple[OCP, Any, Any]:
        one = self.ocp.folded(p)
        method = self.make(one)
        policy = policy_function(one, method)
        return one, method, method if policy is None else policy


class Laws(_Each):
    """Feedback of each p: rows x [B, nx], p [B, np] -> u [B, nu]. The judge runs each as what it is, continuous too."""

    def __init__(self, ocp: OCP, make: Make, continuous: bool, hold: int | None = None) -> None:
        super().__init__(ocp, make)
        self.continuous, self.hold = continuous, hold

    @property
    def identity(self) -> list[Any]:
        """What its outcomes depend on: what is made at the nominal parameters and at the corners of their box."""
        low, high = self.ocp.parameter_box
        return [getattr(self.make, "__qualname__", type(self.make).__qualname__),
                *(self._identity(p) for p in (self.ocp.nominal, low, high))]

    def _identity(self, p: Array) -> Any:
        try:
            controller = self.at(p)[2]
        except Exception as error:  # no law there
            return str(error)
        return controller if isinstance(controller, ca.Function) else type(controller).__qualname__

    def __call__(self, x: Array, t: float, p: Array) -> Array:
        return np.vstack([self._answer(one, x[i], t) for i, one in enumerate(p)])

    def _answer(self, p: Array, x: Array, t: float) -> Array:
        """u as a row [1, nu], NaN where there is no law at p: what was raised stands in the judge's row."""
        try:
            controller = self.at(p)[2]
        except Exception:  # the other rows have answers
            return np.full((1, self.ocp.system.nu), np.nan)
        if isinstance(controller, ca.Function):
            return np.asarray(controller(x, t).full().T)
        return np.atleast_2d(answer_of(controller, x[None], t))

    def __reduce__(self) -> tuple[Any, ...]:
        return Laws, (self.ocp, self.make, self.continuous, self.hold)  # what was made is made again


class Plans(_Each):
    """A solver of each p."""

    def __init__(self, ocp: OCP, make: Make, settled: Any) -> None:
        super().__init__(ocp, make)
        self.settled = settled  # the solver at the nominal parameters: what is told of all of them

    def solve(self, x0: Array, p: Any = None) -> Solution:
        """The solutions from x0 [B, nx], each at its own row of p."""
        rows = self.ocp.parameters_of(p, len(x0), "at_each")
        parts = [self.at(one)[1].solve(x0[i:i + 1]) for i, one in enumerate(rows)]
        return Solution.join(parts)
