"""The terminal set {V <= level}: an ellipsoid of LQR for held controls, in which LQR is allowed and pays off.

With d = x - x*, V = d' P d / 2 and u = u* - K d in discrete time, from one held control to the next. In the set u lies
in U, all constraints hold on the way, and factor (V - V after it) >= cost of it >= 0: so LQR stays in the set, goes to
the goal, and costs no more than factor V (Chen, Allgower (1998), "A quasi-infinite horizon nonlinear model predictive
control scheme with guaranteed stability").
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np
from scipy.linalg import LinAlgError

from nocl.definition.ocp import OCP
from nocl.definition.scales import units
from nocl.solvers.lqr import check_equilibrium
from nocl.solvers.riccati import Stages
from nocl.solvers.safeguard.motion import Motion
from nocl.solvers.safeguard.proof import FEW, Positive, radius_of
from nocl.support.checks import Array
from nocl.translate.enclosure import is_smooth

FACTOR = 2.0  # times V, the terminal cost
SHRINK = 0.7  # of the level, where it is not well
PROOFS = 12  # levels that are tried to be proven, where states are few: less than a hundredth is not worth it
TRIES = 40  # ... and by samples
DRAWN = 10_000  # states of the set that are tried where nothing is proven
CONFIDENCE = 0.99
NEAR = math.pi / 2  # from the goal, in angles that the problem is periodic in: no other image is nearer
ROUNDING = 1e-9  # of the level, given away


@dataclass(frozen=True, eq=False)
class TerminalSet:
    """An ellipsoid about the goal, and what is known of it."""

    ocp: OCP
    P: Array  # [nx, nx]
    K: Array  # [nu, nx]
    level: float
    proven: bool  # by enclosures; else tried at DRAWN states of it, all of which were well
    share: float  # at most so much of the set is not as it should be, with CONFIDENCE; 0 where it is proven

    def value(self, x: Any) -> Any:
        """factor V, of a CasADi column."""
        d = self.ocp.from_goal(x)
        return FACTOR / 2 * ca.bilin(ca.DM(self.P), d, d)

    @property
    def most(self) -> float:
        """factor V at its edge."""
        return FACTOR * self.level

    def control(self, x: Any) -> Any:
        """LQR's, in U, of a CasADi column."""
        s = self.ocp.system
        return ca.fmin(ca.fmax(self.ocp.u_goal - ca.mtimes(ca.DM(self.K), self.ocp.from_goal(x)), s.lbu), s.ubu)


def terminal_set(motion: Motion, margin: float) -> TerminalSet:
    """The largest set that is proven; where none is, as where L or a constraint has kinks, the largest in which all was
    well that was tried.

    margin : of the constraints, in scales
    """
    ocp = motion.ocp
    P, K = _riccati(motion)
    loop = _Loop(motion, P, K, margin)
    proofs = 0 if not loop.smooth else PROOFS if ocp.system.nx <= FEW else 1
    for proven, bound, times in ((True, loop.proven, proofs), (False, loop.tried, TRIES)):
        for level in loop.widest * SHRINK ** np.arange(times):
            found = bound(level)
            if found > 0:
                share = 0.0 if proven else 1 - ((1 - CONFIDENCE) / TRIES) ** (1 / DRAWN)  # of the levels any
                return TerminalSet(ocp, P, K, float(found) * (1 - ROUNDING), proven, share)
    raise ValueError(f"safeguarded: about the goal of {ocp.system.name!r} there is no ellipsoid in which LQR, its "
                     f"controls held for {motion.dt:g}, stays within U and the constraints and costs what it says; "
                     "expected a goal pair inside of them, f and L smooth there, and L convex: move it, or hold "
                     "controls for a shorter time dt")


def check_goal(ocp: OCP, room: float) -> None:
    """ValueError where the goal pair is not stationary for L, or does not hold a constraint by `room` of its scale."""
    check_equilibrium(ocp)
    rows = ocp.functions.rows
    c = ocp.functions.c(ocp.x_goal, ocp.u_goal).full().ravel() if len(rows) else np.zeros(0)
    for i in np.flatnonzero(c <= room):
        raise ValueError(f"safeguarded: at the goal pair of {ocp.system.name!r} the {rows.title(int(i))} holds by "
                         f"{c[i]:.3g} of its scale; expected more than {room:.3g}, twice the margin and what is left "
                         "out between samples, so that LQR has room about it: move the goal or the constraint, or take "
                         "a smaller margin, or a shorter dt")


def _riccati(motion: Motion) -> tuple[Array, Array]:
    """(P, K) of LQR with held controls, from the derivatives of the motion at the goal."""
    ocp, m = motion.ocp, motion.function
    at, one, n = ocp.functions.arguments, units(ocp), ocp.system.nx
    z, (end, cost, *_) = ca.vertcat(at["x"], at["u"]), at.call(m)
    parts = at.function("parts", {"AB": ca.jacobian(end, z), "H": ca.hessian(cost, z)[0]})
    AB, H = (part.full() for part in parts(ocp.x_goal, ocp.u_goal))
    unit = np.r_[one.x, one.u]
    AB, H = AB / one.x[:, None] * unit, H * unit[:, None] * unit / one.cost
    stages = Stages(AB[:, :n], AB[:, n:], H[:n, :n], H[n:, n:], H[:n, n:])
    P = stages.for_ever()
    if P is None or np.linalg.eigvalsh(P / np.sqrt(np.outer(np.diag(P), np.diag(P)).clip(1e-300))).min() < 1e-9:
        raise ValueError(f"safeguarded: LQR of {ocp.system.name!r} with controls that are held for {motion.dt:g} has "
                         "no stabilising gain, or a cost that does not see a state; expected (A, B) stabilisable at "
                         "the goal and a cost on the states in L: LQR(ocp) says which, or take a shorter dt")
    return P * one.cost / (one.x[:, None] * one.x), stages.gain(P) * one.u[:, None] / one.x


class _Loop:
    """One held control of LQR from x* + S z, S S' = P^-1, where V = z'z / 2: a set is a ball of radius r."""

    def __init__(self, motion: Motion, P: Array, K: Array, margin: float) -> None:
        self.ocp, self.motion, self.P, self.K, self.margin = motion.ocp, motion, P, K, margin
        try:
            self.S = np.linalg.cholesky(np.linalg.inv(P))
        except LinAlgError:
            raise ValueError(f"safeguarded: the cost to go of LQR of {self.ocp.system.name!r} is not positive in all "
                             "directions; expected a cost on the states in L") from None

    @property
    def widest(self) -> float:
        """The level at which LQR leaves U, comes near another image of the goal, or is as wide as X: exactly, by the
        ellipsoid."""
        s, ocp = self.ocp.system, self.ocp
        room = np.minimum(s.ubu - ocp.u_goal, ocp.u_goal - s.lbu)
        reach = np.linalg.norm(self.K @ self.S, axis=1)
        wide = np.linalg.norm(self.S, axis=1)
        radii = np.r_[room / reach.clip(1e-300), NEAR / wide[list(ocp.periodic)], (s.ubx - s.lbx) / wide]
        return float(radii.min() ** 2 / 2)

    @cached_property
    def _parts(self) -> dict[str, ca.SX]:
        z = ca.SX.sym("z", self.ocp.system.nx)
        d = ca.mtimes(ca.DM(self.S), z)
        end, cost, held, start = self.motion.function(self.ocp.x_goal + d, self.ocp.u_goal - ca.mtimes(self.K, d))
        after = end - ca.DM(self.ocp.x_goal)
        less = FACTOR * (ca.sumsqr(z) - ca.bilin(ca.DM(self.P), after, after)) / 2 - cost
        return {"z": z, "pays": less, "cost": cost, "rows": ca.vertcat(held, start) - self.margin}

    @cached_property
    def _positive(self) -> list[Positive]:
        return [Positive(self._parts[name], self._parts["z"]) for name in ("pays", "cost")]

    @cached_property
    def _values(self) -> ca.Function:
        return ca.Function("values", [self._parts["z"]], [self._parts[name] for name in ("pays", "cost", "rows")])

    @property
    def smooth(self) -> bool:
        """Whether anything can be proven by derivatives."""
        return is_smooth(self._values)

    def proven(self, level: float) -> float:
        """A level that is well for certain, at most `level`; 0 where there is none that this proves."""
        radius = radius_of(self._parts["rows"], self._parts["z"], math.sqrt(2 * level))
        return radius**2 / 2 if radius > 0 and all(e.up_to(radius) for e in self._positive) else 0.0

    def tried(self, level: float) -> float:
        """`level` where everything is well at DRAWN states of its set; else 0."""
        rng, n = np.random.default_rng(0), self.ocp.system.nx
        way = rng.standard_normal((n, DRAWN))
        z = way / np.linalg.norm(way, axis=0) * math.sqrt(2 * level) * rng.uniform(size=DRAWN) ** (1 / n)
        pays, cost, rows = (part.full() for part in self._values(z))
        return level if (pays >= 0).all() and (cost >= 0).all() and (rows >= 0).all() else 0.0

