"""Parameters of the plant estimated while it runs, and laws u(x, t, p) that act on the estimate.

Nonlinear least squares over all that was measured, solved again with each measurement: Gauss-Newton on one-step
predictions, from the box of p as prior (Ljung (1999), "System Identification", 2nd ed., ch. 10). An extended Kalman
filter in p, which keeps the slopes of former estimates, is sure of wrong values where few states say much: a
cart-pole's length after one interval. What is not excited is not learned: it stays at the nominal value, and its
variance says so.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from nocl.definition.ocp import OCP
from nocl.support import checks
from nocl.support.checks import Array
from nocl.translate.arguments import Arguments
from nocl.translate.rk4 import rk4_cost

NOISE = 1e-3  # of half the width of X: what a measured state is off by, unless said otherwise
OUTLIER = 5.0  # standard deviations of an innovation, from where on it counts less: a kick is no change of mass
STEPS = 8  # of Gauss-Newton for a measurement, at most
ENOUGH = 0.01  # standard deviations: a step that is less is the last
LOST = 1e6  # units of noise: what a prediction that is not finite is off by
SHORTER = 0.25  # times a step that did not help
SAME_TIME = 1e-6  # of an interval


@dataclass(frozen=True, eq=False)
class Seen:
    """Measurements of B runs, the latest last."""

    x: Array  # [m, B, nx]
    u: Array  # [m, B, nu]
    after: Array  # [m, B, nx]
    t: Array  # [m]

    def and_then(self, x: Array, u: Array, after: Array, t: float) -> Seen:
        """One more."""
        return Seen(np.concatenate([self.x, x[None]]), np.concatenate([self.u, u[None]]),
                    np.concatenate([self.after, after[None]]), np.append(self.t, t))

    def __getitem__(self, rows: slice) -> Seen:
        return Seen(self.x[rows], self.u[rows], self.after[rows], self.t[rows])


@dataclass(frozen=True, eq=False)
class Estimate:
    """What is known of the plant's parameters, in each of B runs."""

    p: Array  # [B, np of the system]
    covariance: Array  # [B, np, np]
    seen: Seen
    mean: Array  # [B, np], of what is known without them, in half widths of the box from the nominal value
    information: Array  # [B, np, np], the same

    @property
    def std(self) -> Array:
        """Standard deviations [B, np]."""
        return np.sqrt(np.einsum("bii->bi", self.covariance))


class ParameterEstimator:
    """The parameters of an OCP's system from states that are measured `dt` apart under held controls.

    Parameters
    ----------
    ocp : OCP
        Whose system has parameters. `ocp.parameters` says where they lie: estimates start at the nominal values, with
        half the width of their box as standard deviation, and stay in the box.
    dt : float
        Between two measurements, in the system's unit of time.
    noise : [nx], optional
        Standard deviation of what a measured state, or the model's step, is off by. Default: 1e-3 of half the width
        of X.
    substeps : int
        RK4 steps of a prediction.
    memory : int
        How many measurements are kept as they are; of older ones what they said, to first order.

    Raises ValueError for systems without parameters.
    """

    def __init__(self, ocp: OCP, dt: float, *, noise: ArrayLike | None = None, substeps: int = 4,
                 memory: int = 100) -> None:
        checks.problem(ocp, "ParameterEstimator")
        s, owner = ocp.system, "ParameterEstimator"
        if not s.np:
            raise ValueError(f"{owner}: {s.name!r} has no parameters; expected a system with some: System(..., p=mass)")
        self.ocp, self.dt = ocp, checks.number(dt, "dt", owner, positive=True)
        off = NOISE * (s.ubx - s.lbx) / 2 if noise is None else checks.vector(noise, s.nx, "noise", owner)
        if not (off > 0).all():
            raise ValueError(f"{owner}: noise is {checks.shown(noise)}; expected numbers > 0, one for each state")
        self.noise, self.memory = off, checks.whole(memory, "memory", owner, 1)
        low, high = (bound[:s.np] for bound in ocp.parameter_box)
        self.low, self.high, self.half = low, high, (high - low) / 2
        self.nominal = np.clip(ocp.nominal[:s.np], low, high)
        self._predict = _prediction(ocp, self.dt, checks.whole(substeps, "substeps", owner, 1))

    def start(self, n: int) -> Estimate:
        """Before anything is measured, for n runs."""
        s = self.ocp.system
        nothing = Seen(np.zeros((0, n, s.nx)), np.zeros((0, n, s.nu)), np.zeros((0, n, s.nx)), np.zeros(0))
        return Estimate(np.tile(self.nominal, (n, 1)), np.tile(np.diag(self.half**2), (n, 1, 1)), nothing,
                        np.zeros((n, s.np)), np.tile(np.eye(s.np), (n, 1, 1)))

    def update(self, estimate: Estimate, x: Array, u: Array, after: Array, t: float = 0.0) -> Estimate:
        """The estimate once states `after` [B, nx] are measured, dt after x [B, nx] at t, under u [B, nu] meanwhile.

        A state that is not finite tells nothing.
        """
        seen, mean, information = estimate.seen.and_then(x, u, after, t), estimate.mean, estimate.information
        z, P = self._in_box(estimate.p), estimate.covariance / np.outer(*(self._width,) * 2)
        if len(seen.t) > self.memory:
            mean, information = self._folded(seen[:1], z, P, mean, information)
            seen = seen[1:]
        fine = np.isfinite(np.c_[x, u, after]).all(axis=1)
        found, covariance = self._fitted(z, P, seen, mean, information)
        p = np.where(fine[:, None], np.clip(self.nominal + self.half * found, self.low, self.high), estimate.p)
        covariance = np.where(fine[:, None, None], covariance * np.outer(self.half, self.half), estimate.covariance)
        return Estimate(p, covariance, seen, mean, information)

    @property
    def _width(self) -> Array:
        """Half widths, 1 of what is known for certain."""
        return np.where(self.half > 0, self.half, 1.0)

    def _in_box(self, p: Array) -> Array:
        """p in half widths of the box from the nominal value."""
        return np.asarray((p - self.nominal) / self._width)

    def _fitted(self, z: Array, P: Array, seen: Seen, mean: Array, information: Array) -> tuple[Array, Array]:
        """(z, its covariance) of least squares in the box, from z and P [B, np, np] of the estimate before."""
        box = self._in_box(self.low), self._in_box(self.high)
        e, H = self._residuals(z, seen)
        w = _weights(e, H, P)
        step, P = _newton(z, e, H, w, mean, information, box)
        for _ in range(STEPS):
            if (np.abs(step) <= ENOUGH * np.sqrt(np.einsum("bii->bi", P))).all():
                break
            trial = np.clip(z + step, *box)
            there, slopes = self._residuals(trial, seen)
            less = _misfit(trial, there, w, mean, information) <= _misfit(z, e, w, mean, information)
            z, e = np.where(less[:, None], trial, z), np.where(less[:, None], there, e)
            H = np.where(less[:, None, None], slopes, H)
            w = np.where(less, _weights(e, H, P), w)
            onward, P = _newton(z, e, H, w, mean, information, box)
            step = np.where(less[:, None], onward, SHORTER * step)
        return z, P

    def _residuals(self, z: Array, seen: Seen) -> tuple[Array, Array]:
        """What predictions are off by [m, B, nx], in units of noise, and their slopes in z [m, B, nx, np]; 0 where the
        measurement is not finite, and LOST where the prediction alone is not."""
        (m, B, nx), q = seen.x.shape, self.ocp.system.np
        columns = [np.reshape(v, (m * B, v.shape[2])).T for v in (seen.x, seen.u)]
        p = np.tile(self.nominal + self.half * z, (m, 1)).T
        predicted = self._predict(*columns, np.repeat(seen.t, B)[None], p).full()
        expected, H = predicted[:nx].T.reshape(m, B, nx), predicted[nx:].T.reshape(m, B, q, nx).swapaxes(2, 3)
        e, H = (seen.after - expected) / self.noise, H / self.noise[:, None] * self.half
        fine = np.isfinite(e).all(axis=2) & np.isfinite(H).all(axis=(2, 3))
        known = np.isfinite(np.concatenate([seen.x, seen.u, seen.after], axis=2)).all(axis=2)
        off = np.where(known, LOST, 0.0)[..., None]
        return np.where(fine[..., None], e, off), np.where(fine[..., None, None], H, 0.0)

    def _folded(self, seen: Seen, z: Array, P: Array, mean: Array, information: Array) -> tuple[Array, Array]:
        """(mean, information) of what is known, with what measurements say to first order about z."""
        e, H = self._residuals(z, seen)
        w = _weights(e, H, P)
        more = information + np.einsum("mb,mbip,mbiq->bpq", w, H, H)
        ahead = e + np.einsum("mbip,bp->mbi", H, z - mean)
        return mean + _solved(more, np.einsum("mb,mbip,mbi->bp", w, H, ahead)), more


def _weights(e: Array, H: Array, P: Array) -> Array:
    """[m, B], what measurements count for: Huber's weight of how far they are off for what is not known of z."""
    nx = e.shape[2]
    spread = np.eye(nx) + H @ P @ H.swapaxes(2, 3)
    size = np.einsum("mbi,mbi->mb", e, _solved(spread, e)) / nx
    return np.asarray(1 / np.maximum(size / OUTLIER**2, 1.0))


def _newton(z: Array, e: Array, H: Array, w: Array, mean: Array, information: Array,
            box: tuple[Array, Array]) -> tuple[Array, Array]:
    """(the step [B, np] of Gauss-Newton in the box, the covariance there [B, np, np] without it).

    What stands at a bound and would go beyond is held, and the others are solved for again, until none is.
    """
    A = information + np.einsum("mb,mbip,mbiq->bpq", w, H, H)
    slope = np.einsum("bpq,bq->bp", information, mean - z) + np.einsum("mb,mbip,mbi->bp", w, H, e)
    held, q = np.zeros(z.shape, dtype=bool), z.shape[1]
    for _ in range(q + 1):
        free = (~held[:, :, None] & ~held[:, None]) * A + held[:, :, None] * np.eye(q)
        step = _solved(free, np.where(held, 0.0, slope))
        beyond = ((z <= box[0]) & (step < 0)) | ((z >= box[1]) & (step > 0))
        if not beyond.any():
            break
        held |= beyond
    return step, np.linalg.inv(A)


def _misfit(z: Array, e: Array, w: Array, mean: Array, information: Array) -> Array:
    """[B], what least squares make small."""
    off = z - mean
    return np.asarray(np.einsum("bp,bpq,bq->b", off, information, off) + np.einsum("mb,mbi->b", w, e**2))


def _solved(A: Array, b: Array) -> Array:
    return np.asarray(np.linalg.solve(A, b[..., None])[..., 0])


def _prediction(ocp: OCP, dt: float, substeps: int) -> ca.Function:
    """(x, u, t, p of the system) -> (the state after dt, its derivatives by p), as one column."""
    s = ocp.system
    at = Arguments.new(ca.SX, x=s.nx, u=s.nu, t=1, p=s.np)
    every = ca.vertcat(at["p"], ca.DM(ocp.nominal[s.np:]))  # f holds none of the problem's own

    def f(x: Any, u: Any, t: Any) -> Any:
        return at.given(x=x, u=u, t=t, p=every).call(ocp.functions.f)

    end, _ = rk4_cost(f, lambda *_: 0, at["x"], at["u"], dt, substeps, at["t"])
    return at.function("prediction", {"column": ca.vertcat(end, ca.vec(ca.densify(ca.jacobian(end, at["p"]))))})


class Adaptive:
    """A law (x, t, p) -> u that is told an estimate of the plant's parameters, made from the states that it sees.

    For simulate(ocp, Adaptive(...), x0, p=..., hold=K), with the estimator's dt an interval: of p it uses the
    problem's own part alone. A run begins where the time does not go on; `estimates` keeps those of the last one.

    Parameters
    ----------
    law : callable
        (x [B, nx], t, p [B, np]) -> u [B, nu], a CND for example.
    estimator : ParameterEstimator
    """

    def __init__(self, law: Any, estimator: ParameterEstimator) -> None:
        if not callable(law):
            raise ValueError(f"Adaptive: law is a {type(law).__name__}; expected a callable (x, t, p) -> u")
        self.law = law
        self.estimator = checks.instance(ParameterEstimator, estimator, "estimator", "Adaptive",
                                         "ParameterEstimator(ocp, dt)")
        self.estimates: list[Estimate] = []
        self._last: tuple[Array, Array, float] | None = None

    def __call__(self, x: Array, t: float, p: Array) -> Array:
        of = self.estimator
        if self._last is None or t <= self._last[2] or len(x) != len(self._last[0]):
            self.estimates = [of.start(len(x))]
        else:
            before, u, when = self._last
            if abs(t - when - of.dt) > SAME_TIME * of.dt:
                raise ValueError(f"Adaptive: asked at t = {t:g}, {t - when:g} after the last time; the estimator's dt "
                                 f"is {of.dt:g}: give simulate hold={of.ocp.horizon / of.dt:.4g}, or the estimator "
                                 "that dt")
            self.estimates.append(of.update(self.estimates[-1], before, u, x, when))
        known = np.concatenate([self.estimates[-1].p, p[:, of.ocp.system.np:]], axis=1)
        u = np.clip(np.asarray(self.law(x, t, known)), of.ocp.system.lbu, of.ocp.system.ubu)
        self._last = (np.array(x), u, t)
        return u
