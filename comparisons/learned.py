"""Whether learned dynamics are good enough to train on: what their own optimum loses as feedback on the exact f.

Errors of f_theta in its box say little: what counts is where solutions go, and what it does to them. So a few initial
states are solved on f_theta, u_k + gain_k (x - x_k) is run on the exact f, and what that costs more than the exact
optimum in the same form is held against what there is to gain, the cost of simple baselines less the optimum's. Where
that is too much, f_theta is taught again along those ways.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace

import numpy as np

from nocl.comparisons.baselines import base_cost
from nocl.comparisons.methods import Solving, Starts
from nocl.data import Solution
from nocl.definition.constraints import TOLERANCE
from nocl.definition.ocp import OCP
from nocl.definition.scales import usual_sizes
from nocl.judge.simulation import simulate
from nocl.solvers.ddp.global_search import solve_globally
from nocl.solvers.ddp.solver import DDP
from nocl.support import checks
from nocl.support.budget import ENDLESS, Budget
from nocl.support.checks import Array
from nocl.support.progress import say
from nocl.sysid.identification import LearnedDynamics, Settings, identify

STATES, STARTS, INTERVALS = 8, 4, 80
SHARE = 0.1  # of the wanted gap, that a model may lose
REFINED = 2  # times, before networks are made wider
WIDER, MORE = 1.5, 2  # times as wide, on so many times the labels
LEAST = 1 / 60  # minutes of a fit
SMALL = 1e-3  # of a usual cost: what there is to gain counts as no less


@dataclass(frozen=True, eq=False)
class ModelLoss:
    """What a model's optimum loses as feedback on the exact f; inf where it does not get through, or was not found."""

    lost: Array  # [n], (J - J*) / (J_base - J*): 0 is nothing, 1 all that there is to gain
    gaps: Array  # [n], (J - J*) / |J*|, as training measures itself

    @property
    def median(self) -> float:
        """Of what there is to gain."""
        return float(np.median(self.lost))

    @property
    def gap(self) -> float:
        """The median gap."""
        return float(np.median(self.gaps))

    @property
    def failed(self) -> int:
        """From how many states it does not get through."""
        return int((~np.isfinite(self.lost)).sum())

    def __str__(self) -> str:
        n, failed = len(self.lost), f", {self.failed} of them not at all" if self.failed else ""
        worst = np.max(self.lost[np.isfinite(self.lost)], initial=0.0)
        return (f"f_theta loses {_percent(self.median)} of what control is about (median; at most {_percent(worst)}) "
                f"from {n} initial states{failed}; gap {_percent(self.gap)}")


def _percent(share: float) -> str:
    return f"{max(100 * share, 0.0):.2g} %" if np.isfinite(share) else "all"


@dataclass(frozen=True, eq=False)
class Yardstick:
    """The exact optima of a few initial states, and what there is to gain there."""

    ocp: OCP
    starts: Starts
    intervals: int
    seed: int
    best: Array  # [n], the cost of the exact optimum, as feedback
    gain: Array  # [n], of simple baselines beyond that; of a learned plant, that cost
    plant: LearnedDynamics | None = None  # in place of the exact f

    @staticmethod
    def of(ocp: OCP, n: int = STATES, intervals: int = INTERVALS, seed: int = 0,
           plant: LearnedDynamics | None = None) -> Yardstick:
        """Of n states, fewer where some are not solved; ValueError where none is, or f is not known.

        plant : what plans are made for and run on, in place of the exact f
        """
        checks.problem(ocp, "model_loss")
        if ocp.system.xdot is None and plant is None:
            raise ValueError(f"model_loss: the equations of {ocp.system.name!r} are not known; expected an exact f to "
                             "run on: model.validate(log) tells errors on logs")
        starts = Starts.drawn(ocp, n, checks.whole(seed, "seed", "model_loss"))
        exact = _optimum(ocp, plant, starts, intervals, seed)
        cost = _run(ocp, exact, starts, plant)
        there = np.isfinite(cost)
        if not there.any():
            on = "the exact f" if plant is None else "the model"
            raise ValueError(f"none of {n} initial states of {ocp.system.name!r} was solved on {on} "
                             f"({exact.message[0]}), expected some: more intervals, or other bounds or initial states")
        starts, cost = starts[there], cost[there]
        base = np.full(len(cost), np.nan)
        if plant is None:
            base = base_cost(ocp, starts, TOLERANCE, Solving(1, None, False)) - cost
        least = np.maximum(SMALL * usual_sizes(ocp).cost, SMALL * np.abs(cost))
        gain = np.where(np.isfinite(base) & (base > least), base, np.maximum(np.abs(cost), least))
        return Yardstick(ocp, starts, intervals, seed, cost, gain, plant)

    def loss(self, model: LearnedDynamics) -> tuple[ModelLoss, Solution]:
        """What a model loses, and its optima."""
        own = _optimum(self.ocp, model, self.starts, self.intervals, self.seed)
        more = _run(self.ocp, own, self.starts, self.plant) - self.best
        size = np.maximum(np.abs(self.best), SMALL * usual_sizes(self.ocp).cost)
        return ModelLoss(more / self.gain, more / size), own


def model_loss(ocp: OCP, model: LearnedDynamics, *, n: int = STATES, intervals: int = INTERVALS,
               seed: int = 0) -> ModelLoss:
    """What the optimum of learned dynamics loses as feedback on the exact f, from n initial states.

    Raises ValueError where the exact f is not known, or solves none of them.
    """
    checks.instance(LearnedDynamics, model, "model", "model_loss", "as nocl.identify makes it")
    return Yardstick.of(ocp, n, intervals, seed).loss(model)[0]


def held_out_loss(ocp: OCP, model: LearnedDynamics, part: LearnedDynamics, *, n: int = STATES,
                  intervals: int = INTERVALS, seed: int = 0) -> ModelLoss:
    """What the optimum of `part`, learned from a part of a log, loses as feedback on `model`, learned from all of it.

    Where the plant is not known this tells what its recordings leave open: where the two differ in what counts, so may
    the plant. It does not see what both have wrong. Raises ValueError where no initial state is solved on the model.
    """
    for name, one in (("model", model), ("part", part)):
        checks.instance(LearnedDynamics, one, name, "held_out_loss", "as nocl.identify makes it")
    return Yardstick.of(ocp, n, intervals, seed, model).loss(part)[0]


def good_enough(ocp: OCP, model: LearnedDynamics, wanted: float, settings: Settings, *, seed: int = 0,
                intervals: int = INTERVALS, budget: Budget = ENDLESS) -> tuple[LearnedDynamics, ModelLoss]:
    """The model, or one taught again along its own optima while its gap is more than SHARE of the wanted one, and what
    it loses: refined twice, then with wider networks on more labels, as far as the budget goes. The best is kept.
    """
    yard = Yardstick.of(ocp, intervals=intervals, seed=seed)
    loss, own = yard.loss(model)
    best, found, trials = model, loss, 0
    while found.gap > SHARE * wanted and trials <= REFINED and budget.share < 1 and _has_networks(model):
        if budget.limited:
            settings = replace(settings, minutes=max(budget.left / 60, LEAST))
        if trials == REFINED:
            settings = _wider(model, settings)
            model = identify(ocp.system, seed=seed, settings=settings, parameters=ocp.plant_parameters)
        model = _along(ocp, model, own, yard.starts, seed + trials, settings)
        loss, own = yard.loss(model)
        trials += 1
        say(f"{ocp.system.name}: taught again along its own optima, {loss}")
        if loss.gap < found.gap:
            best, found = model, loss
    return best, found


def _has_networks(model: LearnedDynamics) -> bool:
    return model.parts is not None and bool(model.parts.groups)


def _wider(model: LearnedDynamics, settings: Settings) -> Settings:
    assert model.parts is not None
    widest = max(settings.budget(len(group.variables)).width for group in model.parts.groups)
    return replace(settings, width=round(WIDER * widest), samples=MORE * settings.samples)


def _along(ocp: OCP, model: LearnedDynamics, own: Solution, starts: Starts, seed: int,
           settings: Settings) -> LearnedDynamics:
    """The model, refined in the tube of its own optima and of what they become on the exact f; itself where none was
    found."""
    rows = np.flatnonzero(own.success)
    if not rows.size:
        return model
    s = own[rows]
    x, u = s.x[:, :-1].reshape(-1, ocp.system.nx), s.u.reshape(-1, ocp.system.nu)
    p = np.repeat(starts.p[rows][:, :ocp.system.np], s.u.shape[1], axis=0) if ocp.system.np else None
    return model.refine(x, u, p=p, seed=seed, settings=settings)


def _optimum(ocp: OCP, model: LearnedDynamics | None, starts: Starts, intervals: int, seed: int) -> Solution:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of grids: training tells them
        ddp = DDP(ocp, intervals=intervals, dynamics=model)
        return solve_globally(ddp, starts.x, p=starts.p if ocp.np else None, starts=STARTS, rounds=1, seed=seed,
                              progress=False)


def _run(ocp: OCP, s: Solution, starts: Starts, plant: LearnedDynamics | None = None) -> Array:
    """[n], the cost of plans as feedback on the exact f, or on a learned plant; inf where they fail."""
    K, cost = s.u.shape[1], np.full(len(s), np.inf)
    rows = np.flatnonzero(s.success)
    if rows.size:
        some = s[rows]
        run = simulate(ocp, lambda x, t, *_: some.feedback(x, t), starts.x[rows], f=plant, hold=K,
                       p=starts.p[rows] if ocp.np else None)
        cost[rows] = np.where(run.success, run.cost, np.inf)
    return cost
