"""What a study finds beyond costs, as plain data that a page can show. B is the batch; gaps and losses in per cent."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nocl.support.checks import Array

FLOOR = 1e-8  # of the usual cost: costs below it are the judge's rounding
LEVELS = (5, 25, 50, 75, 95)  # percentiles that distributions are summed up by
Row = dict[str, Any]


def percentile(values: Array, q: float) -> float:
    """The q-th percentile; where some are inf (failures) the nearest value above, since inf cannot be interpolated; NaN
    of nothing.
    """
    if not len(values):
        return math.nan
    return float(np.percentile(values, q, method="linear" if np.isfinite(values).all() else "higher"))


def per_cent(excess: Array, of: Array, usual: float | None = None) -> Array:
    """100 excess / |of|, of costs; where those are less than FLOOR of the `usual` cost (default: the largest), of that.
    """
    size = np.abs(of)
    most = float(size[np.isfinite(size)].max(initial=0.0)) if usual is None else usual
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(100 * excess / np.maximum(size, FLOOR * most))


def quantiles(values: Array) -> dict[str, float]:
    """{"p5": ..., "p95": ...} of the values that are no NaN; inf where so many failed; {} of nothing."""
    known = values[~np.isnan(values)]
    return {f"p{q}": percentile(known, q) for q in LEVELS} if known.size else {}


@dataclass(frozen=True, eq=False)
class Rollouts:
    """One method's control under one model and one integrator."""

    name: str  # like "learned model, RK4"
    t: Array  # [K+1]
    x: Array  # [B, K+1, nx], NaN after it blew up
    u: Array  # [B, K, nu], at the first K nodes
    cost: Array  # [B], inf where it blew up


@dataclass(frozen=True, eq=False)
class ValueAudit:
    """A method's value function V, beside what its run cost and beside a solver's costate."""

    value: Array  # [B], V(x0, 0)
    error: Array  # [B], |V(x0, 0) - J|, J the judged cost of the method's own run; inf where that failed
    against: str  # the method whose costate grad V is held against, "" where there is none
    angle: Array  # [B], degrees between grad V(x0, 0) and that costate at t = 0
    size: Array  # [B], 100 (|grad V| / |costate| - 1) there
    path_angle: Array  # [B], the median angle over the nodes of that method's plan, grad V taken on it
    path_size: Array  # [B], the median size error in absolute value there
    t: Array  # [K+1], nodes of the method's own run
    hjb: Array  # [B, K+1], V_t + L + V_x f along it, in cost per time
    hamiltonian_gradient: Array  # [B, K+1], ||dH/du|| along it, without what pushes against an active bound

    def rows(self) -> list[Row]:
        """One dict a state."""
        hjb, slope = _time_mean(self.t, np.abs(self.hjb)), _time_mean(self.t, self.hamiltonian_gradient)
        columns = {"value": self.value, "value_error": self.error, "gradient_angle": self.angle,
                   "gradient_size": self.size, "path_gradient_angle": self.path_angle,
                   "path_gradient_size": self.path_size, "hjb": hjb, "hamiltonian_gradient": slope}
        return [{name: float(values[i]) for name, values in columns.items()} for i in range(len(self.value))]


def _time_mean(t: Array, values: Array) -> Array:
    """[B], the mean over time of values [B, K+1]; NaN where some are."""
    return np.trapezoid(values, t, axis=1) / (t[-1] - t[0])


@dataclass(frozen=True, eq=False)
class MethodAudit:
    """One method's rollouts beside the judge's own (CVODES, exact f), and its value function where it has one."""

    method: str
    rollouts: tuple[Rollouts, ...]  # on the learned model (where one was given) and on the exact f, both by RK4
    exploitation: Array  # [B], 100 (judged cost - cost on the learned model) / |judged cost|; NaN without a model
    discretisation: Array  # [B], 100 (judged cost - cost by RK4 on the exact f) / |judged cost|
    value: ValueAudit | None
    doubt: Array | None = None  # [B], share of the judged run's nodes where the model says it is not to be trusted

    def rows(self) -> list[Row]:
        """One dict a state."""
        doubt = np.full(len(self.exploitation), np.nan) if self.doubt is None else 100 * self.doubt
        value = self.value.rows() if self.value is not None else [{} for _ in self.exploitation]
        return [{**{f"cost, {r.name}": float(r.cost[i]) for r in self.rollouts},
                 "exploitation": float(self.exploitation[i]), "discretisation": float(self.discretisation[i]),
                 "doubt": float(doubt[i]), **more}
                for i, more in enumerate(value)]

    @property
    def sentence(self) -> str:
        """Where the model is not to be trusted; "" where it does not know."""
        if self.doubt is None:
            return ""
        known = self.doubt[np.isfinite(self.doubt)]
        failed = "" if len(known) == len(self.doubt) else f"; {len(self.doubt) - len(known)} more failed"
        return (f"{self.method}: the model is not to be trusted somewhere along {int((known > 0).sum())} of "
                f"{len(known)} trajectories{failed}.")

    def summary(self) -> Row:
        """Quantiles of each number over the states."""
        rows = self.rows()
        return {"method": self.method, "against": "" if self.value is None else self.value.against,
                **{key: quantiles(np.array([row[key] for row in rows])) for key in rows[0]}}


@dataclass(frozen=True, eq=False)
class ScenarioLoss:
    """One method in one scenario, on all its B states."""

    method: str
    how: str  # how its control was run: rate, delay
    cost: Array  # [B], inf where it failed
    best: Array  # [B], cost of the optimum solved anew under the same disturbance
    success: NDArray[np.bool_]  # [B], reached the horizon with all constraints held
    ms_per_control: Array  # [B], measured there; NaN where no control is computed
    counted: NDArray[np.bool_] | None = None  # [B], not those from which no plan holds the constraints; None: all

    @property
    def lost(self) -> Array:
        """[B], 100 (cost - best) / |best|; inf where it failed, NaN where no optimum is known."""
        with np.errstate(invalid="ignore"):
            lost = per_cent(self.cost - self.best, self.best)
        return np.where(np.isfinite(self.best), np.where(self.success, lost, np.inf), np.nan)

    def summary(self) -> Row:
        c = np.ones(len(self.cost), dtype=bool) if self.counted is None else self.counted
        return {"method": self.method, "how": self.how, "failures": int((c & ~self.success).sum()),
                "impossible": int((~c).sum()),
                "cost_median": percentile(self.cost[c], 50), "best_median": percentile(self.best[c], 50),
                "lost": quantiles(self.lost)}


@dataclass(frozen=True, eq=False)
class Scenario:
    """One disturbance, all methods."""

    name: str  # like "kicks"
    text: str  # what was done, in a sentence
    losses: tuple[ScenarioLoss, ...]


@dataclass(frozen=True, eq=False)
class Robustness:
    """The same states and methods under disturbances, held against the optimum solved anew under each."""

    x0: Array  # [B, nx]
    scenarios: tuple[Scenario, ...]  # the first is the undisturbed one
    settings: Mapping[str, Any]

    def summary(self) -> list[Row]:
        """One dict a scenario and method."""
        return [{"scenario": s.name, **loss.summary()} for s in self.scenarios for loss in s.losses]


@dataclass(frozen=True)
class Promise:
    """With `confidence`, at least `share` of the initial states end within `within` % of the best known cost; without
    `within`: get there with all constraints held.
    """

    method: str
    within: float | None  # per cent
    confidence: float  # like 0.99
    n: int  # independent initial states
    successes: int
    share: float  # exact lower bound (Clopper, Pearson 1934), in [0, 1]
    of: str = "initial states of this distribution"

    def __str__(self) -> str:
        share = math.floor(1000 * self.share) / 10  # rounded down: it is a bound
        what = "reach the horizon with all constraints held" if self.within is None else \
            f"end within {self.within:g} % of the best known cost"
        return (f"{self.method}: with {100 * self.confidence:g} % confidence, at least {share:g} % of the {self.of} "
                f"{what} ({self.successes} of {self.n} did).")


@dataclass(frozen=True, eq=False)
class Stability:
    """A feedback near a point, frozen at a time: eigenvalues of A + B K, K = d pi / dx, on the exact f."""

    method: str
    where: str  # "goal" or "mid-horizon"
    t: float
    eigenvalues: NDArray[np.complex128]  # [points, nx], those of a point by falling real part
    gain: Array  # [points, nu, nx], K
    growth: Array  # [points], how much a small disturbance at t has grown by the horizon, at most: ||Phi(T, t)||_2

    @property
    def abscissa(self) -> float:
        """The largest real part, at the worst point: below 0 the frozen loop is stable."""
        return float(self.eigenvalues.real.max())

    def summary(self) -> Row:
        return {"method": self.method, "where": self.where, "t": self.t, "points": len(self.eigenvalues),
                "largest_real_part": self.abscissa, "growth_median": float(np.median(self.growth)),
                "growth_max": float(self.growth.max()),
                "eigenvalues_first_point": [[float(e.real), float(e.imag)] for e in self.eigenvalues[0]]}


@dataclass(frozen=True, eq=False)
class Region:
    """How far the distribution of initial states can grow: the share of successes at each scale of its spread."""

    method: str
    within: float  # per cent of the best known cost that counts as a success
    confidence: float  # of the interval [lower, upper] at each scale
    scale: Array  # [S], rising; 1 is the problem's own distribution
    successes: NDArray[np.int64]  # [S], of n
    n: int
    lower: Array  # [S], exact two-sided bounds of the share of successes
    upper: Array  # [S]
    x0: Array  # [S, n, nx]
    success: NDArray[np.bool_]  # [S, n]
    p: Array = field(default_factory=lambda: np.zeros((0, 0)))  # [n, np], the same at each scale

    def summary(self) -> Row:
        return {"method": self.method, "within": self.within, "confidence": self.confidence, "n": self.n,
                "scale": self.scale.tolist(), "successes": self.successes.tolist(),
                "lower": self.lower.round(4).tolist(), "upper": self.upper.round(4).tolist()}
