"""The paper's Dubins experiment: RRT* against CND round an obstacle, here with NMPC, level sets and the optimum too.

A cell is one way and one seed (of the initial states, and of what is random in the way); it is kept as a file of its
own once it is finished. All trajectories are judged on the exact f by nocl.simulate. A run succeeds where it ends
within TOLERANCE of the goal (m and rad, angles modulo 2 pi) and holds the obstacle.
"""

from __future__ import annotations

import importlib.util
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from nocl.comparisons.report.results import VIOLATION
from nocl.comparisons.reproduce.cells import read_cell
from nocl.judge import Simulation, simulate
from nocl.ocp import OCP
from nocl.support import store
from nocl.support.checks import Array
from nocl.support.compiler import fingerprint
from nocl.systems import load_ocp
from nocl.translate.rk4 import rk4

TOLERANCE = 0.1
INTERVALS = 80
NODES = 401  # at which continuous feedback is recorded, to measure lengths
DRAWN = 12  # trajectories that a cell keeps for the figure
BOX = ([-4.05, -3.9, -4.0], [0.45, 3.9, 4.0])  # of the level sets
STRETCH = (0.5, 0.5, 0.7)  # their cells are narrow near the goal
PENALTY_SLOPE = 0.1  # of the obstacle's penalty there, a second and m; at 0.06 a shortcut begins to pay
MARGIN = 0.05  # m, by which the obstacle is wider there: half a cell, so that interpolated gradients hold it
# of the paper's method: at the rate of 0.01 it ends 0.6 from the goal; held controls are several times as fast to train
PAPER: dict[str, Any] = {"learning_rate": 3e-3, "batch": 128, "hold": True}
CELLS = "cells"
Made = tuple[Any, float, str]  # (controller or controls, ms a state, how it was made)


@dataclass(frozen=True)
class Plan:
    """What to run."""

    n: int = 1000
    seeds: int = 1
    grid: tuple[int, ...] = (41, 81, 81)
    paper_iterations: int = 1000  # of Adam, of the paper's method
    quick: bool = False
    ways: tuple[str, ...] = ()  # default: all

    def __post_init__(self) -> None:
        for name in ("n", "seeds", "paper_iterations"):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int) or value < 1:
                raise ValueError(f"reproduce dubins: {name} is {value!r}; expected an integer >= 1")
        unknown = [way for way in self.ways if way not in WAYS]
        if unknown:
            raise ValueError(f"reproduce dubins: ways are {list(self.ways)}; expected some of {', '.join(WAYS)}")

    def cells(self) -> list[tuple[str, int]]:
        """(way, seed) of every cell."""
        return [(way, seed) for seed in range(self.seeds) for way in self.ways or WAYS]


@dataclass(frozen=True)
class Cell:
    """One way on the n initial states of one seed."""

    way: str
    seed: int
    key: dict[str, Any]  # what it was made with
    ms: float  # a state: until its whole control trajectory is there
    made: str  # what came before, in words
    length: list[float]  # m
    error: list[float]  # distance to the goal at the end, angles modulo 2 pi
    clearance: list[float]
    cost: list[float]  # inf where there is no trajectory
    paths: list[list[list[float]]] = field(repr=False)  # [DRAWN, nodes, 2], of the first states

    @property
    def success(self) -> Array:
        return (np.asarray(self.error) <= TOLERANCE) & (np.asarray(self.clearance) >= -VIOLATION)


def run(out: str | Path, plan: Plan | None = None, *, progress: bool = True) -> list[Cell]:
    """The cells of a plan, those that are finished in folder `out` taken from there; a way without its extra is left
    out, and says so on the bar."""
    folder, plan, cells = Path(out), plan or Plan(), []
    with tqdm(plan.cells(), "Dubins", disable=not progress, unit="cell", smoothing=0.05) as bar:
        for way, seed in bar:
            if (missing := NEEDS.get(way)) and importlib.util.find_spec(missing) is None:
                bar.write(f"{WAYS[way].title} is left out: {missing} is not installed")
                continue
            bar.set_postfix_str(f"{WAYS[way].title}, seed {seed}")
            path = folder / CELLS / f"dubins-{way}-{seed}.json"
            cell = _read(path) if path.is_file() else None
            if cell is None or cell.key != _key(way, plan):
                cell = make(way, seed, plan, folder)
                store.write_json(path, asdict(cell))
            cells.append(cell)
    return cells


def finished(out: str | Path) -> list[Cell]:
    """All cells that the folder holds, seed by seed in the order of WAYS."""
    cells = [_read(path) for path in sorted((Path(out) / CELLS).glob("dubins-*.json"))]
    return sorted(cells, key=lambda c: (c.seed, list(WAYS).index(c.way)))


def make(way: str, seed: int, plan: Plan, folder: Path) -> Cell:
    """One cell, from nothing."""
    ocp = load_ocp("dubins")
    x0 = ocp.initial_states.sample(plan.n, 1 + seed)
    controller, ms, made = WAYS[way].make(ocp, x0, seed, plan, folder)
    s, length = judged(ocp, controller, x0)
    turned = s.x[:, -1] - ocp.x_goal
    turned[:, 2] = (turned[:, 2] + math.pi) % (2 * math.pi) - math.pi
    error = np.where(s.success, np.linalg.norm(turned, axis=1), np.inf)
    return Cell(way, seed, _key(way, plan), ms, made, length.tolist(), error.tolist(), s.clearance.tolist(),
                s.cost.tolist(), np.round(s.x[:DRAWN, :, :2], 3).tolist())


def judged(ocp: OCP, controller: Any, x0: Array) -> tuple[Simulation, Array]:
    """The judge's run, and lengths in m; rows of controls that are NaN have no trajectory and the length inf."""
    if isinstance(controller, np.ndarray):
        bad = ~np.isfinite(controller).all(axis=(1, 2))
        s = simulate(ocp, np.where(np.isfinite(controller), controller, 0.0), x0)
        s.success[bad], s.cost[bad], s.x[bad] = False, np.inf, np.nan
    else:
        s = simulate(ocp, controller, x0, nodes=NODES) if hasattr(controller, "to_casadi") else \
            simulate(ocp, controller, x0, hold=INTERVALS)
    h = np.diff(s.t)
    continuous = hasattr(controller, "to_casadi")
    v = (s.u[:, :-1, 0] + s.u[:, 1:, 0]) / 2 if continuous else s.u[:, :-1, 0]
    return s, np.where(s.success, v @ h, np.inf)


def rollout_ms(ocp: OCP, controller: Callable[[Array, float], Array], x0: Array) -> float:
    """Milliseconds a state: all states together, INTERVALS controls asked for, RK4 between them; on one thread.

    A state to which the controller has no answer stays where it is: only the time counts here.
    """
    from nocl.support.threads import one_thread

    x, h, f = x0, ocp.horizon / INTERVALS, ocp.system.f
    with one_thread():
        controller(x, 0.0)
        start = time.perf_counter()
        for k in range(INTERVALS):
            u = np.asarray(controller(x, k * h), dtype=np.float64).T
            after = rk4(lambda z, w: f(z, w).full(), x.T, u, h).T
            x = np.where(np.isfinite(after).all(axis=1, keepdims=True), after, x)
        return 1e3 * (time.perf_counter() - start) / len(x0)


def _rrt(iterations: int) -> Callable[..., Made]:
    def made(ocp: OCP, x0: Array, seed: int, plan: Plan, folder: Path) -> Made:
        from nocl.solvers.rrt_star import RRTStar

        planner = RRTStar(ocp, iterations=iterations, seed=seed)
        solution = planner.solve(x0)
        u = np.where(np.asarray(solution.success)[:, None, None], solution.u, np.nan)
        return u, float(1e3 * np.mean(solution.seconds)), f"goal within {planner.tolerance:g} m of Dubins distance"

    return made


def _nmpc(ocp: OCP, x0: Array, seed: int, plan: Plan, folder: Path) -> Made:
    from nocl.solvers.nmpc.solver import NMPC

    solver = NMPC(ocp, INTERVALS, seed=seed)
    solution = solver.solve(x0, progress=False)
    u = np.where(np.asarray(solution.success)[:, None, None], solution.u, np.nan)
    return u, float(1e3 * np.mean(solution.seconds)), f"{solver.starts} starts, then neighbours' solutions"


def _optimum(ocp: OCP, x0: Array, seed: int, plan: Plan, folder: Path) -> Made:
    from nocl.solvers.ddp.global_search import solve_globally
    from nocl.solvers.ddp.solver import DDP

    ddp, start = DDP(ocp, intervals=INTERVALS), time.perf_counter()
    best = solve_globally(ddp, x0, seed=seed)
    u = np.where(best.success[:, None, None], best.u, np.nan)
    return u, 1e3 * (time.perf_counter() - start) / len(x0), "DDP, best of many starts"


def _level_sets(ocp: OCP, x0: Array, seed: int, plan: Plan, folder: Path) -> Made:
    from nocl.solvers.levelset.solver import LevelSet, LevelSetSolution

    path = folder / CELLS / "dubins-V.safetensors"
    wide = replace(ocp, penalty_margin=MARGIN)
    problem = LevelSet(wide, plan.grid, box=BOX, stretch=STRETCH, penalty_slope=PENALTY_SLOPE, scheme="weno5",
                       max_seconds=3600.0)
    try:
        solution = LevelSetSolution.load(path, problem)
    except ValueError:  # none yet, or of another grid
        solution = problem.solve()
        solution.save(path)
    grid = " x ".join(map(str, plan.grid))
    made = f"{grid} nodes, {solution.seconds:.0f} s; the obstacle wider by {MARGIN:g} m"
    return solution, rollout_ms(ocp, solution, x0), made


def _pretrained(way: str) -> Callable[..., Made]:
    def made(ocp: OCP, x0: Array, seed: int, plan: Plan, folder: Path) -> Made:
        from nocl.solvers.cnd.controller import pretrained

        cnd = pretrained("dubins", SHIPPED[way])
        return cnd, rollout_ms(ocp, cnd, x0), "as it ships with nocl"

    return made


def _paper(ocp: OCP, x0: Array, seed: int, plan: Plan, folder: Path) -> Made:
    from nocl.solvers.cnd.paper import PaperSettings
    from nocl.solvers.cnd.training import train

    start = time.perf_counter()
    settings = PaperSettings(iterations=plan.paper_iterations, **PAPER)
    cnd = train(ocp, method="paper", seed=seed, settings=settings, progress=False)
    text = f"u(x), {settings.iterations} iterations of {settings.batch} rollouts, Adam from {settings.learning_rate:g}"
    text += f", {time.perf_counter() - start:.0f} s"
    return cnd, rollout_ms(ocp, cnd, x0), text


@dataclass(frozen=True)
class Way:
    """A row of the table; `paper`: mean length, its s.d., seconds, success rate;
    `costed`: whether costs compare (RRT* turns round as often as it likes, and G counts that)."""

    title: str
    make: Callable[..., Made]
    paper: tuple[float, float, float, float] | None = None
    costed: bool = True


WAYS = {"rrt-100": Way("RRT* (iter: 100)", _rrt(100), (4.8871, 0.9607, 6.9313, 0.889), costed=False),
        "rrt-200": Way("RRT* (iter: 200)", _rrt(200), (4.7343, 0.8451, 26.0595, 0.939), costed=False),
        "nmpc": Way("NMPC", _nmpc), "level-sets": Way("HJB level sets", _level_sets),
        "cnd-paper": Way("CND, the paper's method", _paper, (4.1076, 0.6916, 0.0634, 0.999)),
        "cnd": Way("CND, nocl's default, exact f", _pretrained("cnd")),
        "cnd-learned": Way("CND, nocl's default, learned f", _pretrained("cnd-learned")),
        "optimum": Way("multi-start optimum", _optimum)}
SHIPPED = {"cnd": "exact", "cnd-learned": "learned"}  # way -> dynamics
NEEDS = {"rrt-100": "ompl", "rrt-200": "ompl", "level-sets": "hj_reachability"}
PLANS = {False: Plan(), True: Plan(n=20, grid=(24, 37, 41), paper_iterations=20, quick=True)}


def _key(way: str, plan: Plan) -> dict[str, Any]:
    key: dict[str, Any] = {"n": plan.n}
    if way == "level-sets":
        key |= {"grid": list(plan.grid), "stretch": list(STRETCH), "penalty_slope": PENALTY_SLOPE, "margin": MARGIN}
    if way == "cnd-paper":
        key |= {"iterations": plan.paper_iterations, **PAPER}
    if way in SHIPPED:
        from nocl.solvers.cnd.controller import pretrained

        key["controller"] = fingerprint(pretrained("dubins", SHIPPED[way]).to_casadi())
    return key


def _read(path: Path) -> Cell:
    return read_cell(path, Cell, "the Dubins table", ("length", "error", "clearance", "cost", "paths"))


@dataclass(frozen=True)
class Entry:
    """A row: over all states of all seeds; lengths and costs are of the runs that succeeded."""

    way: str
    length: float
    length_std: float
    success: float
    collisions: int
    ms: float
    cost: float
    gap: float  # per cent, median of (J - J*) / J* over states where both succeed; NaN without the optimum
    gap95: float  # per cent, the 95th percentile
    ratio: float  # mean length over the optimum's mean length on the same states
    n: int
    seeds: int
    made: str


def table(cells: Sequence[Cell]) -> list[Entry]:
    """One entry a way, in the order of WAYS."""
    best = {cell.seed: cell for cell in cells if cell.way == "optimum"}
    return [_entry([c for c in cells if c.way == way], best) for way in WAYS if any(c.way == way for c in cells)]


def _entry(cells: Sequence[Cell], best: dict[int, Cell]) -> Entry:
    ok = np.concatenate([c.success for c in cells])
    length, cost, clear = (np.concatenate([getattr(c, name) for c in cells])
                           for name in ("length", "cost", "clearance"))
    hits = int((clear < -VIOLATION).sum())
    gap = gap95 = ratio = math.nan
    if all(c.seed in best and len(best[c.seed].cost) >= len(c.cost) for c in cells):  # same seed, same first states
        same = [(best[c.seed], slice(len(c.cost))) for c in cells]
        both = ok & np.concatenate([b.success[rows] for b, rows in same])
        least, short = (np.concatenate([getattr(b, name)[rows] for b, rows in same]) for name in ("cost", "length"))
        if both.any():
            if WAYS[cells[0].way].costed:
                gap, gap95 = map(float, 100 * np.percentile((cost[both] - least[both]) / least[both], (50, 95)))
            ratio = float(length[both].mean() / short[both].mean())
    mean, std, J = (float(length[ok].mean()), float(length[ok].std()), float(cost[ok].mean())) if ok.any() else \
        (math.nan, math.nan, math.nan)
    ms = float(np.mean([c.ms for c in cells]))
    return Entry(cells[0].way, mean, std, float(ok.mean()), hits, ms, J, gap, gap95, ratio, len(cells[0].cost),
                 len(cells), cells[0].made)
