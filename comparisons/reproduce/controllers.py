"""What the tables of control run: each way's controller, and the judge's word on it.

A cell is one way on one problem with one seed, of all that is random in the way and of the n initial states that it is
judged on. Whatever a way was trained on, nocl.simulate judges it on the exact f and the cost of the problem: terminal
error ||x(T) - x*||_2, control magnitude the mean over time of ||u||_2.

What is counted as evaluations of the dynamics: evaluations of f or f_theta in forward simulation while a controller is
trained, one for each state (a rollout of a batch of 64 in 40 RK4 steps: 64 * 40 * 4). The labels that f_theta was
learned from, derivatives of f and what is evaluated when a controller runs are not among them.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from nocl.comparisons.reproduce import table
from nocl.comparisons.reproduce.dubins import INTERVALS, rollout_ms
from nocl.comparisons.reproduce.table import Place
from nocl.definition.ocp import OCP
from nocl.judge.simulation import simulate
from nocl.solvers.cnd.controller import pretrained
from nocl.solvers.cnd.paper import PaperSettings
from nocl.solvers.cnd.settings import TrainSettings
from nocl.solvers.cnd.training import train
from nocl.solvers.lqr import LQR
from nocl.solvers.neural_oc import NeuralOCSettings, train_neural_oc
from nocl.solvers.nmpc.loop import Loop
from nocl.solvers.nmpc.solver import NMPC
from nocl.support.checks import Array
from nocl.sysid.identification import LearnedDynamics, Settings, identify
from nocl.systems import quadrotor

DRAWN = 6  # trajectories that a cell of the quadrotor keeps for the figure
NODES = 41  # of those
# of the paper's method on the quadrotor: with U = [-100, 100]^4 controllers that start at random, or learn at the rate
# of 0.01, spin the body up within a second and do not learn to fly; held controls are four times as fast to train
NEAR: dict[str, Any] = {"near_goal": 1e-3, "learning_rate": 3e-4, "decay": 0.1, "race": 1, "hold": True}
OC_DROPS = 5  # of NeuralOC's learning rate while it trains
POSITION = ("px", "py", "pz")


@dataclass(frozen=True, kw_only=True)
class Plan(table.Plan):
    """Budgets of the tables of control."""

    seeds: int = 3
    n: int = 1000  # initial states of each seed
    iterations: int = 1000  # of Adam, of the paper's method
    oc_iterations: int = 6000  # of Adam, of NeuralOC, with as many drops of the learning rate as published
    oc_batch: int = 1024  # initial states in each of those
    shipped: bool = False  # nocl's default of seed 0 as it comes with nocl, instead of trained anew


@dataclass(frozen=True)
class Cell:
    """One way on the n initial states of one seed."""

    problem: str
    way: str
    seed: int
    key: dict[str, Any]  # what it was made with
    made: str  # in words; where there is no controller, why not
    error: list[float]  # ||x(T) - x*||_2 of each state, inf where the run failed; empty without a controller
    magnitude: list[float]  # mean over time of ||u||_2
    cost: list[float]
    seconds: float  # of training the controller, wall-clock; f_theta apart
    cpu: float  # the same in seconds of CPU time
    identify: float  # seconds of learning f_theta; 0 on the exact f
    evaluations: float  # of f or f_theta in forward simulation while training, one for each state
    ms: float  # a state's whole control trajectory, INTERVALS controls
    paths: list[list[list[float]]] = field(repr=False)  # [DRAWN, NODES, 3], positions of the first states

    @property
    def place(self) -> Place:
        return Place(self.problem, self.way, self.seed)


@dataclass(frozen=True)
class Assignment:
    """What a way is given."""

    ocp: OCP
    model: LearnedDynamics | None  # f_theta; None: the exact f
    seed: int
    plan: Plan


@dataclass(frozen=True)
class Made:
    """What a way gives back."""

    controller: Any  # what nocl.simulate takes; None: there is none, `made` says why
    made: str
    evaluations: float = 0.0
    seconds: float | None = None  # of training, where that was not now


class Published(NamedTuple):
    """A row of the paper's: mean and standard deviation over initial states."""

    error: float
    error_std: float
    magnitude: float
    magnitude_std: float
    evaluations: int | None = None  # as the paper counts them


@dataclass(frozen=True)
class Way:
    """A row of a table."""

    title: str
    make: Callable[[Assignment], Made] | None  # None: not run yet
    learned: bool = False  # whether it has f_theta only
    paper: dict[str, Published] = field(default_factory=dict)  # by problem
    most: int | None = None  # initial states at most, where each takes long
    budgets: Callable[[str, Plan], dict[str, Any]] | None = None  # (problem, plan) -> what its cells depend on
    default: bool = False  # whether it is nocl's default, which ships with nocl

    @property
    def trained_on(self) -> str:
        """Rivals that have not been run learn models of their own."""
        return "its own model" if self.make is None else "f_theta" if self.learned else "f"


def judged(cell: Cell, ocp: OCP, controller: Any, x0: Array) -> Cell:
    """The cell with what the judge says of its controller: continuous where it can be, NMPC's loop on its own grid."""
    looped = isinstance(controller, Loop)
    s = simulate(ocp, controller, x0, hold=INTERVALS if looped else None, nodes=INTERVALS + 1)
    ms = float(1e3 * np.mean(np.sum([step["seconds"] for step in controller.stats], axis=0))) if looped else \
        rollout_ms(ocp, controller, x0)
    magnitude = np.where(s.success, s.control_magnitude, np.inf)
    names = ocp.system.state_names
    place = [names.index(p) for p in POSITION] if set(POSITION) <= set(names) else []
    paths = np.round(s.x[:DRAWN, ::(INTERVALS // (NODES - 1)), place], 3).tolist() if place else []
    error = np.where(s.reached, np.linalg.norm(ocp.from_goal(s.x[:, -1]), axis=1), np.inf)
    return replace(cell, error=error.tolist(), magnitude=magnitude.tolist(), cost=s.cost.tolist(), ms=ms,
                   paths=paths)


def identified(ocp: OCP, seed: int, plan: Plan) -> LearnedDynamics:
    settings = Settings(iterations=100, polish=5, samples=10_000) if plan.quick else None
    return identify(ocp.system, seed=seed, settings=settings, progress=False)


def paper_settings(problem: str, plan: Plan) -> PaperSettings:
    """Those of the paper's method: u(x) as published. The quadrotor needs others: see NEAR."""
    settings = PaperSettings(iterations=plan.iterations, **(NEAR if problem == "quadrotor" else {}))
    if plan.quick:
        settings = replace(settings, batch=8, intervals=10, race=2, race_iterations=2, hidden=(16,), value_hidden=(16,))
    return settings


def _paper_budgets(problem: str, plan: Plan) -> dict[str, Any]:
    """All settings, as JSON has them."""
    settings = asdict(paper_settings(problem, plan))
    return {name: list(value) if isinstance(value, tuple) else value for name, value in settings.items()}


def _paper(task: Assignment) -> Made:
    settings = paper_settings(task.ocp.system.name, task.plan)
    cnd = train(task.ocp, task.model, method="paper", seed=task.seed, settings=settings, progress=False)
    text = f"u(x), {settings.iterations} iterations of {settings.batch} rollouts, Adam from {settings.learning_rate:g}"
    text += f", starts at u*, controls held on {settings.intervals} intervals" if settings.near_goal else ""
    return Made(cnd, text, cnd.card["dynamics_evaluations"])


def _default(task: Assignment) -> Made:
    quick = TrainSettings(seeds=6, starts=6, states=40, tails=200, visits=100, rounds=1, iterations=200,
                          value=False, held_out=8)
    settings = quick if task.plan.quick else None
    cnd = train(task.ocp, task.model, seed=task.seed, settings=settings, progress=False)
    rounds = f"u(x, t), {len(cnd.card['history'])} regressions" + (", and V" if cnd.value_net is not None else "")
    return Made(cnd, rounds, cnd.card["dynamics_evaluations"])


def shipped(task: Assignment, learned: bool) -> Made:
    """nocl's default as it comes with nocl, made by the same call with seed 0."""
    card = (cnd := pretrained(task.ocp.system.name, "learned" if learned else "exact")).card
    return Made(cnd, "u(x, t) and V, as it ships with nocl", card.get("dynamics_evaluations", math.nan),
                float(card["seconds"]))


def _no_control_cost(make: Callable[[Assignment], Made], task: Assignment) -> Made:
    """The quadrotor's problem with R = 0; where a method refuses that, it says why."""
    try:
        return make(replace(task, ocp=quadrotor.ocp(R=0.0)))
    except ValueError as error:
        return Made(None, f"refused: {error}")


def _nmpc(task: Assignment) -> Made:
    return Made(NMPC(task.ocp, INTERVALS, dynamics=task.model, seed=task.seed).controller(),
                f"closed loop, {INTERVALS} intervals, solved again at each")


def _lqr(task: Assignment) -> Made:
    return Made(LQR(task.ocp), "finite horizon, about the goal, clipped to U")


def _oc_budgets(problem: str, plan: Plan) -> dict[str, Any]:
    return {"iterations": plan.oc_iterations, "batch": plan.oc_batch}


def _neural_oc(task: Assignment) -> Made:
    n = task.plan.oc_iterations
    settings = NeuralOCSettings(iterations=n, batch=task.plan.oc_batch, drop_every=math.ceil(n / OC_DROPS))
    if task.plan.quick:
        settings = replace(settings, width=16, check_every=5)
    controller = train_neural_oc(task.ocp, settings, seed=task.seed, progress=False)
    return Made(controller, f"{settings.iterations} iterations of {settings.batch} rollouts", controller.card["nfe"])


def _rows(*rows: tuple[float, float, float, float, int]) -> dict[str, Published]:
    """The paper's rows of acrobot and cart-pole."""
    return {problem: Published(*row) for problem, row in zip(("acrobot", "cartpole"), rows, strict=True)}


GYM = {
    "cnd": Way("CND, nocl's default", _default, True, default=True),
    "cnd-paper": Way("CND, the paper's method", _paper, True,
                     _rows((1.071, 0.63, 5.936, 0.72, 1000), (0.049, 0.03, 0.742, 0.47, 1000)), budgets=_paper_budgets),
    "nmpc": Way("NMPC", _nmpc, True, most=5),
    "deep-pilco": Way("Deep PILCO", None, True,
                      _rows((0.284, 0.10, 4.624, 2.63, 4789), (0.146, 0.20, 1.168, 1.17, 7057))),
    "pets": Way("PETS", None, True, _rows((3.095, 0.69, 6.968, 0.36, 12602), (0.910, 0.22, 1.311, 0.82, 12602))),
    "enode": Way("ENODE", None, True, _rows((1.133, 0.52, 4.934, 1.83, 27812), (0.170, 0.10, 1.317, 1.18, 6262)))}

QUADROTOR = {
    "cnd": Way("CND, nocl's default", _default, default=True),
    "cnd-learned": Way("CND, nocl's default", _default, True, default=True),
    "cnd-paper": Way("CND, the paper's method", _paper, False,
                     {"quadrotor": Published(0.0690, 0.2119, 60.6403, 39.7774)}, budgets=_paper_budgets),
    "cnd-paper-learned": Way("CND, the paper's method", _paper, True,
                             {"quadrotor": Published(0.5666, 0.1131, 71.3644, 29.4289)}, budgets=_paper_budgets),
    "r0-paper": Way("CND (R = 0), the paper's method", partial(_no_control_cost, _paper), True,
                    {"quadrotor": Published(0.4161, 0.1732, 72.4603, 18.6037)}, budgets=_paper_budgets),
    "r0": Way("CND (R = 0), nocl's default", partial(_no_control_cost, _default), True),
    "nmpc": Way("NMPC", _nmpc),
    "lqr": Way("LQR", _lqr),
    "neural-oc": Way("NeuralOC", _neural_oc, False, {"quadrotor": Published(0.4601, 0.1552, 45.9289, 17.8367)},
                     budgets=_oc_budgets)}
