"""A free horizon in DDP: T is one more state, the last one, that stands still, and the time s is a share of it.

    x' = T f(x, u, T s), T' = 0, cost' = T L(x, u, T s), s in [0, 1]

is a problem with a fixed horizon, but for where it starts: T is chosen. A sweep ends with V, V_x, V_xx at node 0, so
that T moves by its own Newton step there, dT = -V_T / V_TT, the rest of the plan following by the feedback on T.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from nocl.data import Solution
from nocl.definition.constraints import Free
from nocl.definition.ocp import OCP
from nocl.definition.parameters import time
from nocl.definition.sampling import Distribution, Gaussian, Uniform
from nocl.definition.scales import units
from nocl.definition.system import System
from nocl.solvers.ddp.augmented import KEPT, LARGEST, Augmented
from nocl.solvers.ddp.batch import Rows
from nocl.solvers.starts import middle
from nocl.support.checks import Array

FASTER, SLOWER = 0.5, 1.0  # shares of T by which a step may shorten and lengthen it: half, and twice as long
FAR = 0.01  # of a scale: while a constraint is off by more, T grows only: in a shorter time less can be held
DEARER = 10.0  # rho in a longer time, so that what was given up for a shorter one is not given up again
FLAT = 1e-9  # of the largest V_TT along a plan: below it, T is not found by what is left of the plan


def lifted(ocp: OCP) -> OCP:
    """The problem on s in [0, 1] with T as its last state."""
    s, name, horizon = ocp.system, _fresh_name(ocp), ocp.horizon
    T, t = ca.SX.sym(name), time()

    def in_share(e: ca.SX) -> ca.SX:
        return ca.substitute(e, t, T * t)

    system = System(
        f"{s.name}_free", x=ca.vertcat(s.x, T), u=s.u, xdot=ca.vertcat(T * in_share(s.equations), 0), p=s.p,
        lbu=s.lbu, ubu=s.ubu, lbx=np.r_[s.lbx, horizon.low], ubx=np.r_[s.ubx, horizon.high], angles=s.angles)
    of = ocp.functions
    scales = {**dict(zip(of.rows.names, of.scales, strict=True)),
              **dict(zip(of.end_rows.names, of.end_scales, strict=True))}
    with warnings.catch_warnings():  # of its kinks the problem itself has warned
        warnings.simplefilter("ignore")
        return ocp.with_constraints(
            in_share, system=system, horizon=1.0, running=T * in_share(ocp.running), scales=scales,
            x_goal=_with_middle(ocp.x_goal, horizon), initial_states=_starting(ocp.initial_states, horizon))


def _fresh_name(ocp: OCP) -> str:
    """A name for T that nothing has yet."""
    name, taken = "horizon", {*ocp.system.names, *ocp.parameter_names}
    while name in taken:
        name += "_"
    return name


def _with_middle(x_goal: Any, horizon: Free) -> Any:
    expression = getattr(x_goal, "expression", None)
    T = middle(horizon)
    return np.r_[x_goal, T] if expression is None else ca.vertcat(expression, T)


def _starting(states: Distribution, horizon: Free) -> Distribution:
    """The initial states with a middling horizon."""
    T = middle(horizon)
    if isinstance(states, Gaussian):
        return Gaussian(np.r_[states.mean, T], np.r_[states.std, 0.0])
    return Uniform(np.r_[states.lb, T], np.r_[states.ub, T])


def with_horizons(x: Array, T: Array) -> Array:
    """States x [B, ..., nx] of plans with horizons T [B], as the lifted problem has them."""
    there = np.broadcast_to(T.reshape(-1, *[1] * (x.ndim - 1)), (*x.shape[:-1], 1))
    return np.ascontiguousarray(np.concatenate([x, there], axis=-1))


@dataclass
class FreeTime(Augmented):
    """A batch of problems with free horizons while it descends; x0 [B, nx + 1] holds the horizons it begins with."""

    T: Array = field(init=False)  # [B]
    kept: ClassVar[tuple[str, ...]] = (*KEPT, "T")
    first: ClassVar[tuple[float, float]] = (100.0, 1000.0)  # else plans give up the end, and T, which costs, is short

    def __post_init__(self) -> None:
        B, K, n = len(self.x0), self.ddp.intervals, self.x0.shape[1]
        of = units(self.ddp.posed)
        self.curvature = of.cost / of.x[-1] ** 2  # V_TT of 1 in the solver's units: what mu is added by
        self.low, self.high = self.ddp.posed.system.lbx[-1], self.ddp.posed.system.ubx[-1]
        self.T, self.dT, self.from_x0 = self.x0[:, -1].copy(), np.zeros(B), self.x0.copy()
        self.V_x, self.V_xx = np.zeros((B, K + 1, n)), np.zeros((B, K + 1, n, n))
        super().__post_init__()

    def rollout(self, rows: Rows, x_bar: Array, u_bar: Array, gain: Array) -> None:
        moved = self.T[rows] + self.alpha[rows] * self.dT[rows]
        self.from_x0[rows, -1] = np.clip(moved, self.low, self.high)
        super().rollout(rows, x_bar, u_bar, gain)

    def _start(self) -> Array:
        return self.from_x0

    def backward(self, rows: Rows, V: Array | None = None, V_x: Array | None = None, V_xx: Array | None = None,
                 V_p: Array | None = None) -> None:
        V_x, V_xx = self.V_x if V_x is None else V_x, self.V_xx if V_xx is None else V_xx
        super().backward(rows, V, V_x, V_xx, V_p)
        self._move_horizon(rows, V_x[rows, 0, -1], V_xx[rows, 0, -1, -1])

    def _move_horizon(self, rows: Rows, slope: Array, curve: Array) -> None:
        """The step of T from V_T and V_TT at node 0, and what it adds to the model."""
        T = self.T[rows]
        least, most = np.maximum(-FASTER * T, self.low - T), np.minimum(SLOWER * T, self.high - T)
        least = np.where(self.parts[rows, 2] > FAR, 0.0, least)
        held = np.where(slope > 0, least >= 0, most <= 0)
        bent = curve + self.mu[rows] * self.curvature
        convex = held | (bent > 0)
        with np.errstate(all="ignore"):
            step = np.clip(-slope / np.where(bent > 0, bent, 1.0), least, most)
        step = np.where(held | ~convex, 0.0, step)
        self.dT[rows] = step
        self.slope[rows] += slope * step
        self.curve[rows] += 0.5 * curve * step**2
        self.positive[rows] *= convex & np.isfinite(self.slope[rows]) & np.isfinite(self.curve[rows])

    def _take(self, rows: Rows) -> None:
        super()._take(rows)
        self.T[rows] = self.new_x[rows, 0, -1]

    def _next_round(self, rows: Rows, grows: NDArray[np.bool_]) -> None:
        """What does not come nearer to its constraints has too little time: first it gets more."""
        short = (self.parts[rows, 2] > 0.5 * self.last[rows]) & (self.parts[rows, 2] > FAR) & (self.T[rows] < self.high)
        blown = self._lengthen(rows[short])
        left = ~short | np.isin(rows, blown)
        super()._next_round(rows[left], grows[left])

    def _lengthen(self, rows: Rows) -> Rows:
        """The same controls in a longer time, from which the descent begins anew; those that blow up, as they were."""
        if not rows.size:
            return rows
        before = {name: getattr(self, name)[rows] for name in ("k", "gain", "y", "penalty")}
        self.k[rows], self.gain[rows], self.y[rows] = 0.0, 0.0, 0.0
        self.penalty[rows, 0] = np.minimum(DEARER * self.penalty[rows, 0], LARGEST * self.unit)
        self.dT[rows], self.alpha[rows] = SLOWER * self.T[rows], 1.0
        self.rollout(rows, self.x, self.u, self.gain)
        good = np.isfinite(self.new_J[rows])
        for name, value in before.items():
            getattr(self, name)[rows[~good]] = value[~good]
        longer = rows[good]
        self._take(longer)
        self.mu[longer], self.last[longer], self.stalls[longer] = 0.0, np.inf, 0
        return rows[~good]

    def solution(self, curvature: bool) -> Solution:
        return unlifted(super().solution(True), self._found(), curvature, self.ddp.posed.uses_time)

    def _found(self) -> NDArray[np.bool_]:
        """Where T lies between its bounds."""
        return np.asarray((self.low < self.T) & (self.high > self.T))


def unlifted(s: Solution, found: NDArray[np.bool_], curvature: bool, timed: bool) -> Solution:
    """A lifted problem's solution as one of the problem itself: each row has the nodes t of its own T.

    gain and V_xx are those where the horizon is found anew from each node on, if `found` [B] says that T is no bound:
    for what is left of the plan T - V_Tx (x - x_k) / V_TT is best. Of a problem that holds the time (`timed`) that is
    so at the first node alone, since another T moves the time of the others: there they are those of a fixed T.
    """
    assert s.V_xx is not None
    bent = s.V_xx[..., -1, -1]
    firm = found[:, None] & (bent > FLAT * np.abs(bent).max(axis=1, keepdims=True))
    if timed:
        firm[:, 1:] = False
    moves = np.where(firm[..., None], -s.V_xx[..., -1, :-1] / np.where(firm, bent, 1.0)[..., None], 0.0)  # dT/dx
    gain = s.gain[..., :-1] + s.gain[..., -1:] * moves[:, :-1, None, :]
    V_xx = s.V_xx[..., :-1, :-1] + s.V_xx[..., :-1, -1:] * moves[..., None, :]
    return replace(s, t=s.t * s.x[:, :1, -1], x=np.ascontiguousarray(s.x[..., :-1]), gain=gain,
                   V_x=np.ascontiguousarray(s.V_x[..., :-1]), V_xx=V_xx if curvature else None)
