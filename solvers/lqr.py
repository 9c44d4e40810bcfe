"""LQR about the goal pair of an OCP: baseline, warm start, test oracle.

With d = x - x*, from the nearest image of the goal where the problem is periodic in an angle, it is
V = d' P d / 2 + const and u = u* - K d. With the Hessians Q, R, S of L and the Jacobians A, B of f at (x*, u*),
K = R^-1 (B' P + S') and -dP/dt = Q + A' P + P A - K' R K, P(T) = the Hessian of G (Anderson, Moore (1990), "Optimal
Control: Linear Quadratic Methods", ch. 2-3); on an infinite horizon dP/dt = 0. In discrete time P goes from sample to
sample (solvers/riccati.py). K has the field's sign, u* - K d, where
a Solution's gain is u_k + gain (x - x_k).
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike
from scipy.integrate import solve_ivp
from scipy.interpolate import BSpline, make_interp_spline
from scipy.linalg import LinAlgError, solve_continuous_are

from nocl.definition.discrete import WHOLE
from nocl.definition.ocp import OCP
from nocl.definition.scales import units
from nocl.solvers.riccati import Stages
from nocl.support import checks
from nocl.support.checks import Array

DEGREE = 5  # of the spline through P(t)
REFINE = 3  # spline nodes for each step of the Riccati integration
ESCAPE = 1e12  # entries of P beyond this: the Riccati solution has escaped to infinity
SEEN = 1e-9  # the least eigenvalue of P with a diagonal of 1, below which a motion costs nothing
STILL = 1e-7  # of what changes in a unit of time: a mode that does not decay
STATIONARY = 1e-8  # largest |f| and |gradient| at the goal pair, scaled, beyond which it is no equilibrium


@dataclass(frozen=True, eq=False)
class _LinearQuadratic:
    A: Array
    B: Array
    Q: Array
    R: Array
    S: Array
    P_final: Array
    unit: Array  # [nx, nx]
    dt: float | None = None  # in discrete time

    def gain(self, P: Array) -> Array:
        return np.asarray(np.linalg.solve(self.R, self.B.T @ P + self.S.T))

    @property
    def stages(self) -> Stages:
        """Those of a system in discrete time: a step changes, and costs, dt times what a unit of time does."""
        dt = self.dt or 0.0
        return Stages(np.eye(len(self.A)) + dt * self.A, dt * self.B, dt * self.Q, dt * self.R, dt * self.S)


class LQR:
    """u(x, t) = clip(u* - K(t) (x - x*), U) on a finite horizon, or with constant K where it is `infinite`, as
    nocl.INFINITE is. Of a system in discrete time K is that of the sample at t, or before it.

    Of one problem: with parameters, that at given ones, LQR(ocp.at(p=...)).

    Raises ValueError where the problem holds the time or parameters, where the goal pair is no equilibrium of f, no
    stationary point of L and G, where the Hessian of L in u is not positive definite, and (infinite) where (A, B) is
    not stabilisable.
    """

    def __init__(self, ocp: OCP, infinite: bool = False) -> None:
        checks.problem(ocp, "LQR", infinite=True, discrete=True)
        infinite = checks.flag(infinite, "infinite", "LQR") or ocp.is_infinite
        ocp.refuse_parameters("LQR")
        (ocp.lasting(ocp.system.dt or 1.0) if ocp.is_infinite else ocp).refuse_constraints("LQR")
        ocp.refuse_without_goal("LQR")
        self.ocp, self.infinite = ocp, infinite
        self.A, self.B = (j.full() for j in ocp.functions.jacobian(ocp.x_goal, ocp.u_goal))
        self.Q, self.R, self.S, self.P_final = _hessians(ocp)
        check_equilibrium(ocp)
        if not ocp.system.is_discrete and np.linalg.eigvalsh(self.R).min() <= 0:
            raise ValueError(f"LQR of {ocp.system.name!r}: the Hessian of L in u has the eigenvalues "
                             f"{np.linalg.eigvalsh(self.R).tolist()}; expected > 0: add a cost on each control")
        self._L_goal, self._G_goal = float(ocp.L(ocp.x_goal, ocp.u_goal)), float(ocp.G(ocp.x_goal))
        if infinite:
            self._P_infinite = self._solve_infinite()

    @cached_property
    def _spline(self) -> BSpline:
        """P(t) on [0, T] as one spline, for numpy and CasADi alike."""
        n, T, of = len(self.A), self.ocp.horizon, self._scaled

        def backward(s: float, p: Array) -> Array:
            P = p.reshape(n, n)
            P = (P + P.T) / 2  # rounding's skew part would grow
            if np.abs(P).max() > ESCAPE:
                raise ValueError(f"LQR of {self.ocp.system.name!r}: the Riccati equation has no solution before t = "
                                 f"{T - s:.4g}; expected one on [0, {T:g}]: L may not be convex at the goal, change it "
                                 "or shorten the horizon")
            K = of.gain(P)
            return (of.Q + of.A.T @ P + P @ of.A - K.T @ of.R @ K).ravel()

        path = solve_ivp(backward, (0.0, T), of.P_final.ravel(), method="LSODA", rtol=1e-11, atol=1e-12,
                         dense_output=True)
        if not path.success:
            raise ValueError(f"LQR of {self.ocp.system.name!r}: the Riccati equation was not solved: {path.message}; "
                             "scale the states and costs")
        fine = np.linspace(0, 1, REFINE, endpoint=False)
        s = np.r_[(path.t[:-1, None] + np.diff(path.t)[:, None] * fine).ravel(), T]
        t = np.unique(T - s)  # next to T the first steps of a stiff one may be less than rounding apart
        spline = make_interp_spline(t, path.sol(T - t).T, k=DEGREE)
        return BSpline(spline.t, spline.c * of.unit.ravel(), DEGREE)

    @cached_property
    def _samples(self) -> Array:
        """P [K+1, nx, nx] at the samples of a system in discrete time."""
        steps, of = self.ocp.steps, self._scaled
        assert steps is not None
        P = of.stages.backward(of.P_final, steps)
        lost = np.flatnonzero(~np.isfinite(P).all(axis=(1, 2)))
        if lost.size:
            raise ValueError(f"LQR of {self.ocp.system.name!r}: at step {lost[-1]} of {steps} no control is best; "
                             "expected dt L and what follows to be convex in u: add a cost on each control")
        return np.asarray(P * of.unit)

    def _solve_infinite(self) -> Array:
        of = self._scaled
        if of.dt is not None:
            found = of.stages.for_ever()
            if found is None:
                raise ValueError(self._no_gain())
            return np.asarray(found * of.unit)
        try:
            P = solve_continuous_are(of.A, of.B, of.Q, of.R, s=of.S)
            stable = np.isfinite(P).all() and np.linalg.eigvals(of.A - of.B @ of.gain(P)).real.max() < 0
        except LinAlgError:
            stable = False
        if not stable:
            raise ValueError(self._no_gain())
        return np.asarray(P * of.unit)

    def _no_gain(self) -> str:
        return (f"LQR of {self.ocp.system.name!r}: no stabilising gain on an infinite horizon{self._lasting_modes()}; "
                "expected (A, B) stabilisable at the goal and every slow mode in L: use a finite horizon, or a cost on "
                "the states in L")

    def _lasting_modes(self) -> str:
        """The states that stay as they are, in words: of the modes of A that do not decay and that L does not see."""
        rates, ways = np.linalg.eig(self._scaled.A)
        decay = -STILL if self.ocp.system.dt is None else -STILL / self.ocp.system.dt
        unseen = [way for rate, way in zip(rates, ways.T, strict=True)
                  if rate.real > decay and np.abs(self._scaled.Q @ way).max() < STILL * max(np.abs(way).max(), STILL)]
        names = [name for i, name in enumerate(self.ocp.system.state_names)
                 if any(abs(way[i]) > 0.3 * np.abs(way).max() for way in unseen)]
        return f", since nothing is lost where {', '.join(names)} stays as it is" if names else ""

    @cached_property
    def _scaled(self) -> _LinearQuadratic:
        """The problem in units of the solvers' scales: its P times `unit` is P."""
        of = units(self.ocp)
        x, u, c = of.x, of.u, of.cost
        return _LinearQuadratic(self.A / x[:, None] * x, self.B / x[:, None] * u, self.Q * x[:, None] * x / c,
                                self.R * u[:, None] * u / c, self.S * x[:, None] * u / c,
                                self.P_final * x[:, None] * x / c, c / (x[:, None] * x), self.ocp.system.dt)

    def _gain(self, P: Array) -> Array:
        """K in continuous time."""
        return np.asarray(np.linalg.solve(self.R, self.B.T @ P + self.S.T), dtype=np.float64)

    def _time(self, t: Any) -> float:
        """t as a float: any finite time."""
        return checks.between(t, -np.inf, np.inf, "t", f"LQR of {self.ocp.system.name!r}")

    def P(self, t: float = 0.0) -> Array:
        """The Hessian of V at time t, [nx, nx]."""
        if self.infinite:
            return self._P_infinite
        if self.ocp.system.is_discrete:
            return np.asarray(self._samples[self._sample(t, len(self._samples) - 1)])
        n = len(self.A)
        P = self._spline(min(max(self._time(t), 0.0), self.ocp.horizon)).reshape(n, n)
        return (P + P.T) / 2

    def K(self, t: float = 0.0) -> Array:
        """The gain at time t, [nu, nx], with its field's sign: u = u* - K (x - x*), where a Solution's `gain` is -K."""
        if not self.ocp.system.is_discrete:
            return self._gain(self.P(t))
        return np.asarray(self._gains[self._sample(t, len(self._gains) - 1)])

    def _sample(self, t: Any, last: int) -> int:
        """The number of the sample at a time, or before it, from 0 to `last`."""
        k = self._time(t) / (self.ocp.system.dt or 1.0)
        return int(np.clip(np.floor(k + WHOLE), 0, last))

    @cached_property
    def _gains(self) -> Array:
        """K [K, nu, nx] of the steps of a system in discrete time; one that is the same for ever."""
        of = _LinearQuadratic(self.A, self.B, self.Q, self.R, self.S, self.P_final, np.ones(1), self.ocp.system.dt)
        after = self._P_infinite[None] if self.infinite else self._samples[1:]
        return np.array([of.stages.gain(P) for P in after])

    def __call__(self, x: ArrayLike, t: float = 0.0) -> Array:
        """u [nu] or [B, nu], clipped to U."""
        s = self.ocp.system
        rows, single = checks.states(x, s.nx, s.name, "x")
        u = np.clip(self.ocp.u_goal - self.ocp.from_goal(rows) @ self.K(t).T, s.lbu, s.ubu)
        return u[0] if single else u

    def value(self, x: ArrayLike, t: float = 0.0) -> Array | float:
        """V [B], or a number for one state: cost to go of the linear-quadratic problem without bounds.

        On an infinite horizon, what it costs beyond staying at the goal.
        """
        rows, single = checks.states(x, self.ocp.system.nx, self.ocp.system.name, "x")
        d = self.ocp.from_goal(rows)
        rest = 0.0 if self.infinite else self._L_goal * (self.ocp.horizon - self._time(t)) + self._G_goal
        V = np.einsum("bi,ij,bj->b", d, self.P(t), d) / 2 + rest
        return float(V[0]) if single else V

    def to_casadi(self) -> ca.Function:
        """policy:(x, t) -> u, the same controller in MX."""
        s, n = self.ocp.system, len(self.A)
        at = self.ocp.functions.feedback(ca.MX)
        if self.ocp.system.is_discrete:
            u = self.ocp.u_goal - ca.mtimes(self._gain_at(at["t"]), self.ocp.from_goal(at["x"]))
            return at.function("policy", {"u": ca.fmin(ca.fmax(u, s.lbu), s.ubu)})
        P: Any = ca.DM(self.P(0.0))
        if not self.infinite:
            spline = self._spline
            inside = ca.fmin(ca.fmax(at["t"], 0.0), self.ocp.horizon)
            entries = ca.bspline(inside, spline.c.ravel().tolist(), [spline.t.tolist()], [DEGREE], n * n, {})
            P = ca.reshape(entries, n, n)
            P = (P + P.T) / 2
        K = ca.mtimes(ca.DM(np.linalg.inv(self.R)), ca.mtimes(self.B.T, P) + self.S.T)
        u = self.ocp.u_goal - ca.mtimes(K, self.ocp.from_goal(at["x"]))
        return at.function("policy", {"u": ca.fmin(ca.fmax(u, s.lbu), s.ubu)})


    def _gain_at(self, t: ca.MX) -> Any:
        """K at a time, of a system in discrete time: between samples on a straight line, so that a sample's is exact
        whatever rounding does to its time."""
        K, s = self._gains, self.ocp.system
        if len(K) == 1:
            return ca.DM(K[0])
        k = ca.fmin(ca.fmax(t / (s.dt or 1.0), 0.0), len(K) - 1)
        knots = [0.0, *range(len(K)), len(K) - 1.0]
        entries = ca.bspline(k, K.ravel().tolist(), [list(map(float, knots))], [1], s.nu * s.nx, {})
        return ca.reshape(entries, s.nx, s.nu).T


def ended(ocp: OCP, T: float) -> OCP:
    """A problem of an infinite horizon for T alone, with LQR's cost to go at its end, d' P d / 2 about the goal. Of
    angles that the problem is periodic in d^2 is 2 (1 - cos d) there and d z is sin(d) z: all images are alike.

    Raises ValueError where LQR has no answer, or where its cost does not see a state: then to wait costs nothing.
    """
    lqr = LQR(ocp)
    _check_seen(lqr)
    with warnings.catch_warnings():  # of its kinks the problem itself has warned
        warnings.simplefilter("ignore")
        return replace(ocp, horizon=T, terminal=all_images(ocp, lqr.P()))


def all_images(ocp: OCP, P: Array) -> ca.SX:
    """d' P d / 2 about the goal, smooth and the same for all images of angles that the problem is periodic in."""
    d, more = ocp.functions.arguments["x"] - ca.DM(ocp.x_goal), ca.SX(0)
    for i in ocp.periodic:
        more += P[i, i] * (1 - ca.cos(d[i])) ** 2  # (1 - cos)^2 + sin^2 = 2 (1 - cos)
        d[i] = ca.sin(d[i])
    return (ca.bilin(ca.DM(P), d, d) + more) / 2

def _check_seen(lqr: LQR) -> None:
    """ValueError where V vanishes along a line through the goal."""
    of, names = lqr._scaled, lqr.ocp.system.state_names
    P = lqr.P() / of.unit
    size, ways = np.linalg.eigh(P / np.sqrt(np.outer(np.diag(P), np.diag(P)).clip(1e-300)))
    if size[0] > SEEN:
        return
    way = np.abs(ways[:, 0])
    mode = ", ".join(name for name, part in zip(names, way, strict=True) if part > 0.3 * way.max())
    raise ValueError(f"LQR of {lqr.ocp.system.name!r}: the cost does not see a motion of {mode}, so that to wait there "
                     "costs nothing, for ever; expected a cost on the states: add one to L, like 0.1 times their "
                     "squared distances from x*")


def _hessians(ocp: OCP) -> tuple[Array, Array, Array, Array]:
    """(Q, R, S [nx, nu], Hessian of G) at the goal pair."""
    n = ocp.system.nx
    H = ocp.functions.L_derivatives(ocp.x_goal, ocp.u_goal)[2].full()
    P = ocp.functions.G_derivatives(ocp.x_goal)[2].full()
    return H[:n, :n], H[n:, n:], H[:n, n:], P


def check_equilibrium(ocp: OCP) -> None:
    """ValueError where f, or a slope of a cost, is not 0 at the goal pair."""
    s, of = ocp.system, ocp.functions
    L_z = of.L_derivatives(ocp.x_goal, ocp.u_goal)[1].full().ravel()
    G_x = of.G_derivatives(ocp.x_goal)[1].full().ravel()
    f, one = of.f(ocp.x_goal, ocp.u_goal).full().ravel(), units(ocp)
    for what, values, unit, names in (("f", f, 1 / one.x, s.state_names),
                                      ("the gradient of L", L_z, np.r_[one.x, one.u] / one.cost, s.names),
                                      ("the gradient of G", G_x, one.x / one.cost, s.state_names)):
        i = int(np.argmax(np.abs(values * unit)))
        if abs(values[i] * unit[i]) > STATIONARY:
            raise ValueError(f"LQR of {s.name!r}: at the goal pair {what} is {values[i]:.4g} in {names[i]}; "
                             "expected 0: LQR needs an equilibrium that is stationary for the cost; move the goal pair")
