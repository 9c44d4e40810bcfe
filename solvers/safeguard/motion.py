"""What happens under a control that is held: where it leads, what it costs, and what the constraints are on the way.

Between the ends of two steps a constraint is the cubic through its values and slopes there, which lies above the least
of its Bernstein coefficients (Farouki (2012), "The Bernstein polynomial basis: a centennial retrospective"). What that
leaves out, of fourth order in the step, is measured, twice of it being kept as a margin.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import casadi as ca
import numpy as np

from nocl.definition.ocp import OCP
from nocl.support.checks import Array

EXACT = 1e-6  # of half the width of X: a step is that exact
TRIED = (2, 4, 8, 16, 32)  # steps in a held control, in this order
PLACES = 256  # of X x U, that steps and constraints are tried at
INSIDE = 8  # parts of a step, at whose ends constraints are looked at to measure what the cubics leave out


@dataclass(frozen=True, eq=False)
class Motion:
    """Under a control that is held for dt, by `substeps` Runge-Kutta steps."""

    ocp: OCP
    dt: float
    substeps: int

    @staticmethod
    def of(ocp: OCP, dt: float) -> Motion:
        """With as many steps as make it exact; ValueError where that is too many."""
        x, u = _places(ocp)
        tried = [Motion(ocp, dt, n).function(x.T, u.T)[0].full() for n in (*TRIED, 2 * TRIED[-1])]
        half = (ocp.system.ubx - ocp.system.lbx)[:, None] / 2
        known = np.isfinite(tried[-1]).all(axis=0)
        errors = [float((np.abs(a - b) / half)[:, known].max()) for a, b in pairwise(tried)]
        for n, error in zip(TRIED, errors, strict=True):
            if error <= EXACT:
                return Motion(ocp, dt, n)
        raise ValueError(f"safeguarded: under controls that are held for {dt:g} the states of {ocp.system.name!r} are "
                         f"off by {errors[-1]:.2g} of X after {TRIED[-1]} Runge-Kutta steps; expected {EXACT:g} at "
                         "most: hold them for a shorter time dt")

    @cached_property
    def function(self) -> ca.Function:
        """(x, u) -> (end, cost, held, start): the state after it, the integral of L, what has to be >= 0 for the
        constraints to hold, in scales, and those of x alone where it begins."""
        of, h = self.ocp.functions, self.dt / self.substeps
        at, step, c = of.arguments, of.step(soft=False), self._with_slopes
        x, u = at["x"], at["u"]
        now, slope = c(x, u)
        start, cost, held = now, ca.SX(0), [now[self.rows_of_u, :]]
        for _ in range(self.substeps):
            x, more = step(x, u, h)
            after, slope_after = c(x, u)
            held += [now + h / 3 * slope, after - h / 3 * slope_after, after]
            now, slope, cost = after, slope_after, cost + more
        out = {"end": x, "cost": cost, "held": ca.vertcat(*held), "start": start[self.rows_of_x, :]}
        return at.function("motion", {name: ca.densify(e) for name, e in out.items()})

    @property
    def rows_of_u(self) -> list[int]:
        return np.flatnonzero(self.ocp.functions.rows.of_u).tolist()

    @property
    def rows_of_x(self) -> list[int]:
        return np.flatnonzero(~self.ocp.functions.rows.of_u).tolist()

    @cached_property
    def _with_slopes(self) -> ca.Function:
        """(x, u) -> (all rows, their slopes along the motion)."""
        of = self.ocp.functions
        at, f = of.arguments, of.f
        c = at.call(of.c) if len(of.rows) else ca.SX(0, 1)
        return at.function("c", {"c": c, "slope": ca.jtimes(c, at["x"], at.call(f)) if len(of.rows) else c})

    @cached_property
    def between(self) -> float:
        """By how much of its scale a row may be less than `held` says, twice what was found."""
        if not len(self.ocp.functions.rows):
            return 0.0
        x, u = (a.T for a in _places(self.ocp))
        fine = Motion(self.ocp, self.dt, INSIDE * self.substeps)
        said, true = (m._least(x, u) for m in (self, fine))
        known = np.isfinite(said) & np.isfinite(true)
        return 2 * float(np.max(said - true, where=known, initial=0.0))

    def _least(self, x: Array, u: Array) -> Array:
        """[rows, B]: of each row the least coefficient, where it begins included."""
        *_, held, start = (part.full() for part in self.function(x, u))
        n_u, rows = len(self.rows_of_u), len(self.ocp.functions.rows)
        first = np.empty((rows, x.shape[1]))
        first[self.rows_of_u], first[self.rows_of_x] = held[:n_u], start
        return np.minimum(first, held[n_u:].reshape(-1, rows, x.shape[1]).min(axis=0))


def _places(ocp: OCP) -> tuple[Array, Array]:
    """x [n, nx] and u [n, nu] in X x U, the first half of the states initial ones."""
    s, rng = ocp.system, np.random.default_rng(0)
    x = rng.uniform(s.lbx, s.ubx, (PLACES, s.nx))
    x[::2] = np.clip(ocp.initial_states.sample(PLACES // 2, 0), s.lbx, s.ubx)
    return x, rng.uniform(s.lbu, s.ubu, (PLACES, s.nu))
