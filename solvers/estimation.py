"""Parameters of the plant estimated while it runs, and laws u(x, t, p) that act on the estimate.

Recursive least squares in p: an extended Kalman filter whose state is p and whose measurement is the state after an
interval (Ljung (1999), "System Identification", 2nd ed., ch. 11). What is not excited is not learned: it stays at the
nominal value, and its variance says so.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from nocl.ocp import OCP
from nocl.support import checks
from nocl.support.checks import Array
from nocl.translate.arguments import Arguments
from nocl.translate.rk4 import rk4_cost

NOISE = 1e-3  # of half the width of X: what a measured state is off by, unless said otherwise
OUTLIER = 5.0  # standard deviations of an innovation, from where on it counts less: a kick is no change of mass
SAME_TIME = 1e-6  # of an interval


@dataclass(frozen=True, eq=False)
class Estimate:
    """What is known of the plant's parameters, in each of B runs."""

    p: Array  # [B, np of the system]
    covariance: Array  # [B, np, np]

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

    Raises ValueError for systems without parameters.
    """

    def __init__(self, ocp: OCP, dt: float, *, noise: ArrayLike | None = None, substeps: int = 4) -> None:
        checks.problem(ocp, "ParameterEstimator")
        s, owner = ocp.system, "ParameterEstimator"
        if not s.np:
            raise ValueError(f"{owner}: {s.name!r} has no parameters; expected a system with some: System(..., p=mass)")
        self.ocp, self.dt = ocp, checks.number(dt, "dt", owner, positive=True)
        off = NOISE * (s.ubx - s.lbx) / 2 if noise is None else checks.vector(noise, s.nx, "noise", owner)
        if not (off > 0).all():
            raise ValueError(f"{owner}: noise is {checks.shown(noise)}; expected numbers > 0, one for each state")
        self.noise = off
        low, high = (bound[:s.np] for bound in ocp.parameter_box)
        self.low, self.high, self.half = low, high, (high - low) / 2
        self._predict = _prediction(ocp, self.dt, checks.whole(substeps, "substeps", owner, 1))

    def start(self, n: int) -> Estimate:
        """Before anything is measured, for n runs."""
        p = np.tile(np.clip(self.ocp.nominal[:self.ocp.system.np], self.low, self.high), (n, 1))
        return Estimate(p, np.tile(np.diag(self.half**2), (n, 1, 1)))

    def update(self, estimate: Estimate, x: Array, u: Array, after: Array, t: float = 0.0) -> Estimate:
        """The estimate once states `after` [B, nx] are measured, dt after x [B, nx] at t, under u [B, nu] meanwhile."""
        nx, q = self.ocp.system.nx, self.ocp.system.np
        predicted = self._predict(x.T, u.T, t, estimate.p.T).full()
        expected, H = predicted[:nx].T, predicted[nx:].T.reshape(-1, q, nx).transpose(0, 2, 1)
        share = np.where(self.half > 0, self.half, 1.0)  # no width: known for certain, its variance is 0
        H, e = H / self.noise[:, None] * share, (after - expected) / self.noise  # in units of noise and of the box
        P = estimate.covariance / np.outer(share, share)
        spread = H @ P @ H.transpose(0, 2, 1)  # of what is expected, by what is not known of p
        size = np.einsum("bi,bi->b", e, np.linalg.solve(spread + np.eye(nx), e[..., None])[..., 0]) / nx
        doubt = np.maximum(size / OUTLIER**2, 1.0)[:, None, None]  # of the measurement: Huber's weight, inverted
        gain = np.linalg.solve(spread + doubt * np.eye(nx), H @ P).transpose(0, 2, 1)
        keep = np.eye(q) - gain @ H
        P = keep @ P @ keep.transpose(0, 2, 1) + doubt * gain @ gain.transpose(0, 2, 1)  # Joseph's form
        moved = estimate.p + share * (gain @ e[..., None])[..., 0]
        fine = np.isfinite(moved).all(axis=1)  # a state that blew up tells nothing
        p = np.where(fine[:, None], np.clip(moved, self.low, self.high), estimate.p)
        return Estimate(p, np.where(fine[:, None, None], P * np.outer(share, share), estimate.covariance))


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
