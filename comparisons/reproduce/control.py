"""The paper's tables of control: acrobot and cart-pole by learned dynamics, and the quadrotor, f known and not.

A cell is one way on one problem with one seed, of all that is random in the way and of the n initial states that it is
judged on; it is kept as a file of its own once it is finished. Whatever a way was trained on, nocl.simulate judges it
on the exact f and the cost of the problem: terminal error ||x(T) - x*||_2, control magnitude the mean over time of
||u||_2.

What is counted as evaluations of the dynamics: evaluations of f or f_theta in forward simulation while a controller is
trained, one for each state (a rollout of a batch of 64 in 40 RK4 steps: 64 * 40 * 4). The labels that f_theta was
learned from, derivatives of f and what is evaluated when a controller runs are not among them.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from tqdm import tqdm

from nocl.comparisons.reproduce.cells import read_cell
from nocl.comparisons.reproduce.dubins import INTERVALS, rollout_ms
from nocl.judge import simulate
from nocl.ocp import OCP
from nocl.solvers.nmpc.loop import Loop
from nocl.support import store
from nocl.support.checks import Array
from nocl.support.fingerprint import fingerprint
from nocl.systems import load_ocp, quadrotor

if TYPE_CHECKING:
    from nocl.solvers.cnd.paper import PaperSettings
    from nocl.sysid.identification import LearnedDynamics

CELLS = "cells"
HIDDEN = 500_000  # + seed: the seed of the initial states that cells are judged on
DRAWN = 6  # trajectories that a cell of the quadrotor keeps for the figure
NODES = 41  # of those
# of the paper's method on the quadrotor: with U = [-100, 100]^4 controllers that start at random, or learn at the rate
# of 0.01, spin the body up within a second and do not learn to fly; held controls are four times as fast to train
NEAR: dict[str, Any] = {"near_goal": 1e-3, "learning_rate": 3e-4, "decay": 0.1, "race": 1, "hold": True}
DEFAULTS = ("cnd", "cnd-learned")  # the rows of nocl's default
OC_DROPS = 5  # of NeuralOC's learning rate while it trains
POSITION = ("px", "py", "pz")


@dataclass(frozen=True)
class Plan:
    """What to run of one table."""

    table: str
    n: int = 1000
    seeds: int = 3
    iterations: int = 1000  # of Adam, of the paper's method
    oc_iterations: int = 6000  # of Adam, of NeuralOC, with as many drops of the learning rate as published
    oc_batch: int = 1024  # initial states in each of those
    quick: bool = False  # small budgets everywhere
    ways: tuple[str, ...] = ()  # default: all
    shipped: bool = False  # nocl's default of seed 0 as it comes with nocl, instead of trained anew

    def __post_init__(self) -> None:
        if self.table not in TABLES:
            raise ValueError(f"reproduce: the table is {self.table!r}; expected {' or '.join(TABLES)}")
        for name in ("n", "seeds", "iterations", "oc_iterations", "oc_batch"):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int) or value < 1:
                raise ValueError(f"reproduce {self.table}: {name} is {value!r}; expected an integer >= 1")
        known = [name for name, way in TABLES[self.table].ways.items() if way.make is not None]
        if not set(self.ways) <= set(known):
            raise ValueError(f"reproduce {self.table}: ways are {list(self.ways)}; expected some of {', '.join(known)}")

    def cells(self) -> list[tuple[int, str, str]]:
        """(seed, problem, way) of every cell: all of the first seed, then of the next."""
        table = TABLES[self.table]
        names = [name for name, way in table.ways.items() if way.make is not None and name in (self.ways or table.ways)]
        return [(seed, problem, name) for seed in range(self.seeds) for problem in table.problems for name in names]

    def states(self, way: Way) -> int:
        """How many initial states a way is judged on."""
        return self.n if way.most is None else min(self.n, way.most)


@dataclass(frozen=True)
class Cell:
    """One way on the n initial states of one seed."""

    problem: str
    way: str
    seed: int
    key: dict[str, Any]  # what it was made with
    made: str  # in words; where there is no controller, why not
    error: list[float]  # terminal error of each state, inf where the run failed; empty without a controller
    magnitude: list[float]  # mean over time of ||u||_2
    cost: list[float]
    seconds: float  # of training the controller, wall-clock; f_theta apart
    cpu: float  # the same in seconds of CPU time
    identify: float  # seconds of learning f_theta; 0 on the exact f
    evaluations: float  # of f or f_theta in forward simulation while training, one for each state
    ms: float  # a state's whole control trajectory, INTERVALS controls
    paths: list[list[list[float]]] = field(repr=False)  # [DRAWN, NODES, 3], positions of the first states


@dataclass(frozen=True)
class Task:
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


@dataclass(frozen=True)
class Published:
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
    make: Callable[[Task], Made] | None  # None: not run yet
    learned: bool = False  # whether it has f_theta only
    paper: dict[str, Published] = field(default_factory=dict)  # by problem
    most: int | None = None  # initial states at most, where each takes long


@dataclass(frozen=True)
class Table:
    """Its problems and rows."""

    title: str
    problems: tuple[str, ...]
    ways: dict[str, Way]


def run(out: str | Path, plan: Plan, *, progress: bool = True) -> list[Cell]:
    """The cells of a plan, those that are finished in folder `out` taken from there."""
    folder, cells, table = Path(out), [], TABLES[plan.table]
    with tqdm(plan.cells(), table.title, disable=not progress, unit="cell", smoothing=0.05) as bar:
        for seed, problem, name in bar:
            bar.set_postfix_str(f"{problem}, {table.ways[name].title}, seed {seed}")
            path = folder / CELLS / f"{plan.table}-{problem}-{name}-{seed}.json"
            cell = _read(path) if path.is_file() else None
            if cell is None or cell.key != _key(plan, problem, name, seed):
                cell = make(plan, problem, name, seed)
                store.write_json(path, asdict(cell))
            cells.append(cell)
    return cells


def finished(out: str | Path, table: str) -> list[Cell]:
    """All cells of a table that the folder holds, seed by seed in the order of its rows."""
    order = list(TABLES[table].ways)
    cells = [_read(path) for path in sorted((Path(out) / CELLS).glob(f"{table}-*.json"))]
    return sorted(cells, key=lambda c: (c.seed, TABLES[table].problems.index(c.problem), order.index(c.way)))


def make(plan: Plan, problem: str, name: str, seed: int) -> Cell:
    """One cell, from nothing."""
    way, ocp, shipped = TABLES[plan.table].ways[name], load_ocp(problem), _is_shipped(plan, name, seed)
    assert way.make is not None
    start = time.perf_counter()
    model = _identified(ocp, seed, plan) if way.learned and not shipped else None
    identify = 0.0 if model is None else time.perf_counter() - start
    start, cpu, task = time.perf_counter(), time.process_time(), Task(ocp, model, seed, plan)
    made = _shipped(task, way.learned) if shipped else way.make(task)
    seconds, cpu = time.perf_counter() - start, time.process_time() - cpu
    if made.seconds is not None:
        seconds, cpu = made.seconds, math.nan
    cell = Cell(problem, name, seed, _key(plan, problem, name, seed), made.made, [], [], [], seconds, cpu, identify,
                made.evaluations, math.nan, [])
    if made.controller is None:
        return cell
    return _judged(cell, ocp, made.controller, ocp.initial_states.sample(plan.states(way), HIDDEN + seed))


def _judged(cell: Cell, ocp: OCP, controller: Any, x0: Array) -> Cell:
    """The cell with what the judge says of its controller: continuous where it can be, NMPC's loop on its own grid."""
    looped = isinstance(controller, Loop)
    s = simulate(ocp, controller, x0, hold=INTERVALS if looped else None, nodes=INTERVALS + 1)
    ms = float(1e3 * np.mean(np.sum([step["seconds"] for step in controller.stats], axis=0))) if looped else \
        rollout_ms(ocp, controller, x0)
    magnitude = np.where(s.success, s.control_magnitude, np.inf)
    names = ocp.system.state_names
    place = [names.index(p) for p in POSITION] if set(POSITION) <= set(names) else []
    paths = np.round(s.x[:DRAWN, ::(INTERVALS // (NODES - 1)), place], 3).tolist() if place else []
    return replace(cell, error=s.terminal_error.tolist(), magnitude=magnitude.tolist(), cost=s.cost.tolist(), ms=ms,
                   paths=paths)


def _identified(ocp: OCP, seed: int, plan: Plan) -> LearnedDynamics:
    from nocl.sysid.identification import Settings, identify

    settings = Settings(iterations=100, polish=5, samples=10_000) if plan.quick else None
    return identify(ocp.system, seed=seed, settings=settings, progress=False)


def paper_settings(problem: str, plan: Plan) -> PaperSettings:
    """Those of the paper's method: u(x) as published. The quadrotor needs others: see NEAR."""
    from nocl.solvers.cnd.paper import PaperSettings

    settings = PaperSettings(iterations=plan.iterations, **(NEAR if problem == "quadrotor" else {}))
    if plan.quick:
        settings = replace(settings, batch=8, intervals=10, race=2, race_iterations=2, hidden=(16,), value_hidden=(16,))
    return settings


def _paper(task: Task) -> Made:
    from nocl.solvers.cnd.training import train

    settings = paper_settings(task.ocp.system.name, task.plan)
    cnd = train(task.ocp, task.model, method="paper", seed=task.seed, settings=settings, progress=False)
    text = f"u(x), {settings.iterations} iterations of {settings.batch} rollouts, Adam from {settings.learning_rate:g}"
    text += f", starts at u*, controls held on {settings.intervals} intervals" if settings.near_goal else ""
    return Made(cnd, text, cnd.card["dynamics_evaluations"])


def _default(task: Task) -> Made:
    from nocl.solvers.cnd.settings import TrainSettings
    from nocl.solvers.cnd.training import train

    quick = TrainSettings(seeds=6, starts=6, states=40, tails=200, visits=100, rounds=1, iterations=200,
                          value=False, held_out=8)
    settings = quick if task.plan.quick else None
    cnd = train(task.ocp, task.model, seed=task.seed, settings=settings, progress=False)
    rounds = f"u(x, t), {len(cnd.card['history'])} regressions" + (", and V" if cnd.value_net is not None else "")
    return Made(cnd, rounds, cnd.card["dynamics_evaluations"])


def _is_shipped(plan: Plan, name: str, seed: int) -> bool:
    return plan.shipped and seed == 0 and name in DEFAULTS


def _shipped(task: Task, learned: bool) -> Made:
    """nocl's default as it comes with nocl, made by the same call with seed 0."""
    from nocl.solvers.cnd.controller import pretrained

    card = (cnd := pretrained(task.ocp.system.name, "learned" if learned else "exact")).card
    return Made(cnd, "u(x, t) and V, as it ships with nocl", card.get("dynamics_evaluations", math.nan),
                float(card["seconds"]))


def _no_control_cost(make: Callable[[Task], Made], task: Task) -> Made:
    """The quadrotor's problem with R = 0; where a method refuses that, it says why."""
    try:
        return make(replace(task, ocp=quadrotor.ocp(R=0.0)))
    except ValueError as error:
        return Made(None, f"refused: {error}")


def _nmpc(task: Task) -> Made:
    from nocl.solvers.nmpc.solver import NMPC

    return Made(NMPC(task.ocp, INTERVALS, dynamics=task.model, seed=task.seed).controller(),
                f"closed loop, {INTERVALS} intervals, solved again at each")


def _lqr(task: Task) -> Made:
    from nocl.solvers.lqr import LQR

    return Made(LQR(task.ocp), "finite horizon, about the goal, clipped to U")


def _neural_oc(task: Task) -> Made:
    from nocl.solvers.neural_oc import NeuralOCSettings, train_neural_oc

    n = task.plan.oc_iterations
    settings = NeuralOCSettings(iterations=n, batch=task.plan.oc_batch, drop_every=math.ceil(n / OC_DROPS))
    if task.plan.quick:
        settings = replace(settings, width=16, check_every=5)
    controller = train_neural_oc(task.ocp, settings, seed=task.seed, progress=False)
    return Made(controller, f"{settings.iterations} iterations of {settings.batch} rollouts", controller.card["nfe"])


def _rows(*rows: tuple[float, float, float, float, int]) -> dict[str, Published]:
    """The paper's rows of acrobot and cart-pole."""
    return {problem: Published(*row) for problem, row in zip(("acrobot", "cartpole"), rows, strict=True)}


GYM = Table("Gym", ("acrobot", "cartpole"), {
    "cnd": Way("CND, nocl's default", _default, True),
    "cnd-paper": Way("CND, the paper's method", _paper, True,
                     _rows((1.071, 0.63, 5.936, 0.72, 1000), (0.049, 0.03, 0.742, 0.47, 1000))),
    "nmpc": Way("NMPC", _nmpc, True, most=5),
    "deep-pilco": Way("Deep PILCO", None, True,
                      _rows((0.284, 0.10, 4.624, 2.63, 4789), (0.146, 0.20, 1.168, 1.17, 7057))),
    "pets": Way("PETS", None, True, _rows((3.095, 0.69, 6.968, 0.36, 12602), (0.910, 0.22, 1.311, 0.82, 12602))),
    "enode": Way("ENODE", None, True, _rows((1.133, 0.52, 4.934, 1.83, 27812), (0.170, 0.10, 1.317, 1.18, 6262)))})

QUADROTOR = Table("quadrotor", ("quadrotor",), {
    "cnd": Way("CND, nocl's default", _default),
    "cnd-learned": Way("CND, nocl's default", _default, True),
    "cnd-paper": Way("CND, the paper's method", _paper, False,
                     {"quadrotor": Published(0.0690, 0.2119, 60.6403, 39.7774)}),
    "cnd-paper-learned": Way("CND, the paper's method", _paper, True,
                             {"quadrotor": Published(0.5666, 0.1131, 71.3644, 29.4289)}),
    "r0-paper": Way("CND (R = 0), the paper's method", partial(_no_control_cost, _paper), True,
                    {"quadrotor": Published(0.4161, 0.1732, 72.4603, 18.6037)}),
    "r0": Way("CND (R = 0), nocl's default", partial(_no_control_cost, _default), True),
    "nmpc": Way("NMPC", _nmpc),
    "lqr": Way("LQR", _lqr),
    "neural-oc": Way("NeuralOC", _neural_oc, False, {"quadrotor": Published(0.4601, 0.1552, 45.9289, 17.8367)})})

TABLES = {"gym": GYM, "quadrotor": QUADROTOR}
QUICK = {"n": 8, "seeds": 1, "iterations": 10, "oc_iterations": 20, "oc_batch": 16}


def _key(plan: Plan, problem: str, name: str, seed: int) -> dict[str, Any]:
    way = TABLES[plan.table].ways[name]
    key: dict[str, Any] = {"n": plan.states(way), "quick": plan.quick}
    if name.endswith(("paper", "paper-learned")):
        settings = asdict(paper_settings(problem, plan))
        key |= {k: list(v) if isinstance(v, tuple) else v for k, v in settings.items()}  # as JSON has them
    if _is_shipped(plan, name, seed):
        from nocl.solvers.cnd.controller import pretrained

        cnd = pretrained(problem, "learned" if way.learned else "exact")
        key |= {"controller": fingerprint(cnd.to_casadi()), "seconds": cnd.card["seconds"]}
    if name == "neural-oc":
        key |= {"iterations": plan.oc_iterations, "batch": plan.oc_batch}
    return key


def _read(path: Path) -> Cell:
    return read_cell(path, Cell, "the tables of control",
                     ("error", "magnitude", "cost", "paths", "seconds", "cpu", "identify", "evaluations", "ms"))


@dataclass(frozen=True)
class Entry:
    """A row of a table: over all initial states of all seeds; means are of the runs that did not fail."""

    problem: str
    way: str
    error: float
    error_std: float  # over initial states
    error_low: float  # the least mean of a seed
    error_high: float
    magnitude: float
    magnitude_std: float
    magnitude_low: float
    magnitude_high: float
    cost: float
    cost_low: float
    cost_high: float
    failed: int  # runs
    seconds: float  # means over the seeds that tell
    cpu: float
    identify: float
    evaluations: float
    ms: float
    n: int  # initial states of a seed
    seeds: int  # 0: not run
    made: str


def table(cells: Sequence[Cell], name: str) -> list[Entry]:
    """One entry a problem and way, in the order of the table; those without cells say so."""
    t = TABLES[name]
    entries = [_entry(p, w, [c for c in cells if (c.problem, c.way) == (p, w)]) for p in t.problems for w in t.ways]
    return [replace(e, made=e.made or ("not run yet" if t.ways[e.way].make is None else "not in this run"))
            for e in entries]


def _entry(problem: str, way: str, cells: Sequence[Cell]) -> Entry:
    judged = [c for c in cells if c.error]
    numbers: dict[str, Any] = {}
    for what in ("error", "magnitude", "cost"):
        mean, std, low, high = _spread([np.asarray(getattr(c, what)) for c in judged])
        numbers |= {what: mean, f"{what}_std": std, f"{what}_low": low, f"{what}_high": high}
    del numbers["cost_std"]
    for what in ("seconds", "cpu", "identify", "evaluations", "ms"):
        known = [value for c in cells if not math.isnan(value := getattr(c, what))]
        numbers[what] = float(np.mean(known)) if known else math.nan
    made = "; ".join(dict.fromkeys(c.made for c in cells))
    return Entry(problem, way, **numbers, failed=sum(int((~np.isfinite(c.error)).sum()) for c in judged),
                 n=max((len(c.error) for c in judged), default=0), seeds=len(cells), made=made)


def _spread(parts: Sequence[Array]) -> tuple[float, float, float, float]:
    """(mean, standard deviation, least and greatest mean of a part) of what is finite; NaN where nothing is."""
    finite = [part[np.isfinite(part)] for part in parts]
    finite = [part for part in finite if part.size]
    if not finite:
        return (math.nan,) * 4
    values, means = np.concatenate(finite), [float(part.mean()) for part in finite]
    return float(values.mean()), float(values.std()), min(means), max(means)
