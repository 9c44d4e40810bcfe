"""The paper's future work as a table: one controller u(x, t, p) for every goal, mass and obstacle.

"Our method learns the controller for a fixed goal state, and requires re-optimization for new goal states": here each
problem has parameters, each row is one controller of all of them, judged on fresh (x0, p), each against the best of
many starts on the exact f at its own p.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import casadi as ca
import numpy as np

import nocl
from nocl.comparisons.comparison import compare
from nocl.comparisons.report.results import Judged
from nocl.comparisons.reproduce import table
from nocl.comparisons.reproduce.table import Place, grid, number
from nocl.comparisons.studies import FINE, with_reference
from nocl.definition.ocp import OCP
from nocl.definition.sampling import own_numbers
from nocl.solvers.cnd.settings import TrainSettings
from nocl.solvers.cnd.training import train
from nocl.solvers.ddp.global_search import GlobalDDP
from nocl.solvers.ddp.solver import DDP
from nocl.support.checks import Array
from nocl.sysid.identification import Settings, identify
from nocl.systems import acrobot, cartpole, dubins, pendulum, quadrotor

if TYPE_CHECKING:
    from matplotlib.figure import Figure

CLEAR = 0.1  # m between the car's obstacle and its goal, in the problems that are judged
Bounds = dict[str, tuple[float, float]]


def _about(mean: Sequence[float], half: float) -> nocl.Uniform:
    return nocl.Uniform(np.array(mean) - half, np.array(mean) + half)


def _within(bounds: Bounds) -> nocl.Uniform:
    low, high = zip(*bounds.values(), strict=True)
    return nocl.Uniform(low, high)


def _symbols(bounds: Bounds, units: dict[str, str] | None = None) -> dict[str, ca.SX]:
    return {name: nocl.parameter(name, unit=(units or {}).get(name, "")) for name in bounds}


def cartpole_problem(**plant: tuple[float, float]) -> OCP:
    """Swing up and stop at a goal; some constants of the plant vary too."""
    units = {"l": "m", "m_pole": "kg", "m_cart": "kg", "gain": "N", "friction": "N s/m"}
    constants, goal = _symbols(plant, units), nocl.parameter("goal", 0.0, "m")
    system = cartpole.system(**constants, parameters=ca.vertcat(*constants.values()) if constants else None)
    return OCP.quadratic(system, p=goal, horizon=4.0, x_goal=[goal, 0, 0, 0], u_goal=[0],
                         initial_states=_about([0, 0, np.pi, 0], 0.3),
                         parameters=_within({**plant, "goal": (-2.0, 2.0)}))


def _quadrotor() -> OCP:
    """From rest anywhere in a box of 4 m to rest anywhere in it."""
    bounds: Bounds = dict.fromkeys(("goal_x", "goal_y", "goal_z"), (-2.0, 2.0))
    goal, system = ca.vertcat(*_symbols(bounds, dict.fromkeys(bounds, "m")).values()), quadrotor.system()
    half = np.r_[np.full(3, 2.0), np.zeros(9)]
    return OCP.quadratic(system, p=goal, horizon=4.0, x_goal=ca.vertcat(goal, np.zeros(9)),
                         u_goal=quadrotor.ocp().u_goal, initial_states=nocl.Uniform(-half, half),
                         parameters=_within(bounds))


def _acrobot() -> OCP:
    """Swing up with the second joint at an angle."""
    masses: Bounds = dict.fromkeys(("m1", "m2"), (0.8, 1.2))
    constants, goal = _symbols(masses, dict.fromkeys(masses, "kg")), nocl.parameter("goal", 0.0, "rad")
    system = acrobot.system(**constants, parameters=ca.vertcat(*constants.values()))
    return OCP.quadratic(system, p=goal, horizon=4.0, x_goal=[np.pi, goal, 0, 0], u_goal=[0, 0],
                         initial_states=nocl.Gaussian(np.zeros(4), [0.1] * 4),
                         parameters=_within({**masses, "goal": (-0.5, 0.5)}))


def _dubins() -> OCP:
    """A car round an obstacle of any size and place to any pose."""
    bounds: Bounds = {"obstacle_x": (-1.5, -0.8), "obstacle_y": (-1.0, 1.0), "radius": (0.3, 0.6),
                      "goal_x": (-0.5, 0.5), "goal_y": (-0.5, 0.5), "goal_psi": (-0.8, 0.8)}
    p = _symbols(bounds, {**dict.fromkeys(bounds, "m"), "goal_psi": "rad"})
    car = dubins.system()
    clear = dubins.distance(car, ca.vertcat(p["obstacle_x"], p["obstacle_y"]), p["radius"])
    return OCP.quadratic(car, p=ca.vertcat(*p.values()), horizon=8.0, x_goal=[*list(p.values())[3:]], u_goal=[0, 0],
                         initial_states=nocl.Uniform([-3.5, -3.0, -1.57], [-2.5, 3.0, 1.57]),
                         parameters=_within(bounds), path_constraints={"obstacle": clear})


def _sights(ocp: OCP) -> ca.SX:
    """Features of the car: where goal and obstacle are, seen from the car, and car and obstacle, seen from the goal."""
    at = ocp.functions.arguments
    x, heading, centre, radius = at["x"][:2], at["x"][2], at["p"][:2], at["p"][2]
    goal, direction = at["p"][3:5], at["p"][5]
    to_goal, to_obstacle = goal - x, centre - x
    away, left = (ca.sqrt(ca.sumsqr(way) + 1e-4) for way in (to_obstacle, to_goal))
    ahead, straight = _turned(to_obstacle, heading), to_goal / left
    beside = straight[0] * to_obstacle[1] - straight[1] * to_obstacle[0]  # of the straight way to the goal
    return ca.vertcat(_turned(-to_goal, direction), ca.sin(heading - direction), ca.cos(heading - direction),
                      _turned(centre - goal, direction), ahead, _turned(to_goal, heading), ahead / away, radius / away,
                      ca.fmax(-1, ca.fmin(1, ahead[1] / radius)), beside, ca.dot(straight, to_obstacle))


def _turned(v: ca.SX, angle: ca.SX) -> ca.SX:
    """v [2] in axes that are turned by an angle."""
    return ca.vertcat(ca.cos(angle) * v[0] + ca.sin(angle) * v[1], ca.cos(angle) * v[1] - ca.sin(angle) * v[0])


def _pendulum() -> OCP:
    """Swing up to an angle, with another mass."""
    mass, goal = nocl.parameter("mass", 1.0, "kg"), nocl.parameter("goal", 0.0, "rad")
    return OCP.quadratic(pendulum.system(mass=mass, parameters=mass), p=goal, horizon=3.0, x_goal=[goal, 0],
                         u_goal=[0], initial_states=nocl.Gaussian([np.pi, 0], [0.1, 0.1]),
                         parameters=nocl.Uniform([0.7, -0.5], [1.3, 0.5]))


POLE: Bounds = {"l": (0.7, 1.3), "m_pole": (0.07, 0.13)}
CART: Bounds = {"m_cart": (0.7, 1.3), "gain": (2.1, 3.9), "friction": (0.0, 0.5)}
PROBLEMS: dict[str, tuple[str, Callable[[], OCP]]] = {
    "cartpole-goal": ("cart-pole: goal", cartpole_problem),
    "cartpole-pole": ("cart-pole: goal, length, pole's mass", lambda: cartpole_problem(**POLE)),
    "cartpole-all": ("cart-pole: goal, length, both masses, gain, friction", lambda: cartpole_problem(**POLE, **CART)),
    "quadrotor-goal": ("quadrotor: goal and start anywhere in a 4 m box", _quadrotor),
    "acrobot-goal": ("acrobot: angle of joint 2, both masses", _acrobot),
    "dubins-obstacle": ("dubins: obstacle, its radius, goal pose", _dubins),
    "pendulum-goal": ("pendulum: goal, mass", _pendulum)}


FEATURES: dict[str, Callable[[OCP], ca.SX]] = {"dubins-obstacle": _sights}  # what networks are shown beside nocl's own


def drawn(ocp: OCP, n: int, seed: int) -> tuple[Array, Array]:
    """n initial states and parameters that no training saw; goals inside an obstacle, or next to it, are left out."""
    x0, p = ocp.initial_states.sample(4 * n, own_numbers(seed, 7)), ocp.sample_parameters(4 * n, own_numbers(seed, 8))
    of = ocp.functions.node
    h = np.array([ocp.h(*of.columns(x=x, t=[0.0], p=p)).full().min(axis=0, initial=np.inf)
                  for x in (x0, ocp.goals(p)[0])]).min(axis=0)
    rows = np.flatnonzero(h > CLEAR)[:n]
    return x0[rows], p[rows]


@dataclass(frozen=True, kw_only=True)
class Plan(table.Plan):
    """Which problems, exact and learned."""

    n: int = 200  # (x0, p) of each seed


@dataclass(frozen=True)
class Way:
    """A row of the table."""

    title: str
    learned: bool


@dataclass(frozen=True)
class Cell:
    """One controller on n fresh (x0, p)."""

    problem: str
    way: str
    seed: int
    key: dict[str, Any]
    gap: list[float]  # (J - J*) / J* of each, inf where the run failed, NaN where no J* is known
    collisions: int
    identify: float  # s of learning f(x, u, p); 0 on the exact f
    seconds: float  # of training, wall-clock
    cpu: float  # the same in seconds of CPU time
    failed: list[str] = field(default_factory=list)  # what the judge says of runs that failed

    @property
    def place(self) -> Place:
        return Place(self.problem, self.way, self.seed)


@dataclass(frozen=True)
class Entry:
    """A row: over all (x0, p) of all seeds."""

    problem: str
    way: str
    median: float  # %
    p95: float
    worst: float
    collisions: int
    n: int
    identify: float
    seconds: float
    cpu: float


class Goals(table.PaperTable[Plan, Cell, Entry]):
    """The table of goals."""

    name, title, known, file = "goals", "goals", "the table of goals", "goals-{problem}-{way}-{seed}"
    plan_type, cell_type = Plan, Cell
    problems, numbers = tuple(PROBLEMS), ("gap",)
    ways: ClassVar[dict[str, Way]] = {"exact": Way("f", False), "learned": Way("f_theta(x, u, p)", True)}
    quick: ClassVar[dict[str, int]] = {"n": 8}
    least: ClassVar[dict[str, int]] = {"seeds": 1, "n": 1}

    def key(self, plan: Plan, place: Place) -> dict[str, Any]:
        return {"n": plan.n, "quick": plan.quick}

    def make(self, plan: Plan, place: Place, folder: Path) -> Cell:
        ocp, effort, start = PROBLEMS[place.problem][1](), "quick" if plan.quick else "normal", time.perf_counter()
        model = identify(ocp.system, parameters=ocp.plant_parameters, seed=place.seed, settings=Settings.of(effort),
                         progress=False) if self.ways[place.way].learned else None
        identified = 0.0 if model is None else time.perf_counter() - start
        start, cpu = time.perf_counter(), time.process_time()
        settings = TrainSettings.of(effort, parameters=ocp.np, value=False)
        shown = FEATURES[place.problem](ocp) if place.problem in FEATURES else None
        cnd = train(ocp, model, seed=place.seed, settings=settings, progress=False, features=shown)
        seconds, cpu = time.perf_counter() - start, time.process_time() - cpu
        cnd.save(self.path(folder, place).with_suffix(""))
        gap, collisions, failed = judged(place.problem, cnd, plan.n, place.seed)
        return Cell(place.problem, place.way, place.seed, self.key(plan, place), gap.tolist(), collisions, identified,
                    seconds, cpu, failed)

    def entries(self, cells: Sequence[Cell]) -> list[Entry]:
        groups = [(problem, way, [c for c in cells if (c.problem, c.way) == (problem, way)])
                  for problem in self.problems for way in self.ways]
        return [_entry(problem, way, own) for problem, way, own in groups if own]

    def columns(self) -> list[table.Column[Entry]]:
        return [("problem: parameters", lambda e: PROBLEMS[e.problem][0]),
                ("trained on", lambda e: self.ways[e.way].title),
                ("median gap %", lambda e: number(e.median)), ("95th percentile", lambda e: number(e.p95)),
                ("worst", lambda e: number(e.worst)), ("collisions", lambda e: str(e.collisions)),
                ("(x0, p) with a known optimum", lambda e: str(e.n)),
                ("training s", lambda e: number(e.seconds)), ("CPU s", lambda e: number(e.cpu)),
                ("f learned s", lambda e: number(e.identify) if e.identify else "")]

    def row(self, entry: Entry) -> dict[str, Any]:
        return vars(entry)

    def latex(self, entries: Sequence[Entry]) -> str:
        head = [r"problem: parameters & trained on & median & 95 \% & worst & training s \\"]
        body = [([PROBLEMS[e.problem][0], self.ways[e.way].title.replace("_", r"\_"), number(e.median), number(e.p95),
                  number(e.worst), number(e.seconds)], [""] * 6) for e in entries]
        return grid("llrrrr", head, body)

    def figures(self, entries: Sequence[Entry], cells: Sequence[Cell]) -> dict[str, Figure]:
        """The gaps of all (x0, p), sorted: the share of them below a gap."""
        from matplotlib.figure import Figure  # matplotlib is imported where pictures are drawn

        figure = Figure(figsize=(7, 4.2), layout="constrained")
        axes = figure.subplots()
        for e in entries:
            gaps = np.sort(_gaps([c for c in cells if (c.problem, c.way) == (e.problem, e.way)]))
            axes.step(np.maximum(gaps, 1e-4), np.arange(1, len(gaps) + 1) / len(gaps), where="post",
                      label=f"{PROBLEMS[e.problem][0]}, {self.ways[e.way].title}", lw=1.3)
        axes.set(xscale="log", xlabel="gap to the optimum at its own p [%]", ylabel="share of (x0, p)", ylim=(0, 1.01))
        axes.legend(fontsize=6)
        return {"": figure}


def judged(problem: str, cnd: Any, n: int, seed: int) -> tuple[Array, int, list[str]]:
    """(gap of each fresh (x0, p), collisions, why runs failed).

    Gaps are to the best of `optima` and of what the controller's runs lead to; inf where the run failed, NaN where it
    did not and no plan was found that holds the constraints.
    """
    ocp = PROBLEMS[problem][1]()
    x0, p = drawn(ocp, n, seed)
    own, reference = with_reference(compare(ocp, {"CND": cnd}, x0=x0, p=p, progress=False), FINE).judged
    best = np.minimum(optima(problem, n, seed), _held(reference))
    cost, known = own.simulation.cost, np.isfinite(best)
    gap = np.divide(cost - best, np.abs(best), out=np.full(len(best), np.nan), where=known)
    run = own.simulation
    return np.where(run.success, gap, np.inf), int((run.violation > 0).sum()), [why for why in run.message if why]


@lru_cache(maxsize=1)  # the ways of a problem come one after the other
def optima(problem: str, n: int, seed: int) -> Array:
    """[n], what the optimum of many starts costs at the fresh (x0, p), refined on FINE intervals."""
    ocp = PROBLEMS[problem][1]()
    x0, p = drawn(ocp, n, seed)
    found = compare(ocp, {"optimum": GlobalDDP(DDP(ocp, intervals=80), starts=32)}, x0=x0, p=p, progress=False)
    cost: Array = np.min([_held(j) for j in with_reference(found, FINE).judged], axis=0)
    return cost


def _held(judged: Judged) -> Array:
    """[n], what runs cost that hold all constraints; inf of others."""
    return np.where(judged.simulation.success, judged.simulation.cost, np.inf)


def _gaps(cells: Sequence[Cell]) -> Array:
    """The gaps that are known, in per cent."""
    gap = 100 * np.concatenate([c.gap for c in cells])
    return gap[~np.isnan(gap)]


def _entry(problem: str, way: str, cells: Sequence[Cell]) -> Entry:
    gap = _gaps(cells)
    median, p95 = np.percentile(gap if len(gap) else [math.nan], [50, 95], method="higher")
    known = {what: float(np.mean([getattr(c, what) for c in cells])) for what in ("identify", "seconds", "cpu")}
    worst = float(gap.max()) if len(gap) else math.nan
    return Entry(problem, way, float(median), float(p95), worst, sum(c.collisions for c in cells), len(gap), **known)


TABLE = Goals()
