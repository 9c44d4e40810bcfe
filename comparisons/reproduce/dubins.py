"""The paper's Dubins experiment: RRT* against CND round an obstacle, here with NMPC, level sets and the optimum too.

A cell is one way with one seed, of the initial states and of what is random in the way. All trajectories are judged on
the exact f by nocl.simulate. A run succeeds where it ends within TOLERANCE of the goal (m and rad, angles modulo 2 pi)
and holds the obstacle.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import numpy as np

from nocl.comparisons.reproduce import table
from nocl.comparisons.reproduce.table import Place, grid, small
from nocl.definition.ocp import OCP
from nocl.judge.runs import Simulation
from nocl.judge.simulation import simulate
from nocl.solvers.cnd.controller import pretrained
from nocl.solvers.cnd.paper import PaperSettings
from nocl.solvers.cnd.training import train
from nocl.solvers.ddp.global_search import solve_globally
from nocl.solvers.ddp.solver import DDP
from nocl.solvers.nmpc.solver import NMPC
from nocl.support.checks import Array
from nocl.support.fingerprint import fingerprint
from nocl.support.threads import one_thread
from nocl.systems import load_ocp
from nocl.translate.rk4 import rk4

if TYPE_CHECKING:
    from matplotlib.figure import Figure

TOLERANCE = 0.1
VIOLATION = 1e-3  # m, that a run may cut into the obstacle
INTERVALS = 80
NODES = 401  # at which continuous feedback is recorded, to measure lengths
DRAWN = 12  # trajectories that a cell keeps for the figure
BOX = ([-4.05, -3.9, -4.0], [0.45, 3.9, 4.0])  # of the level sets
STRETCH = (0.5, 0.5, 0.7)  # their cells are narrow near the goal
PENALTY_SLOPE = 0.1  # of the obstacle's penalty there, a second and m; at 0.06 a shortcut begins to pay
MARGIN = 0.05  # m, by which the obstacle is wider there: half a cell, so that interpolated gradients hold it
# of the paper's method: at the rate of 0.01 it ends 0.6 from the goal; held controls are several times as fast to train
PAPER: dict[str, Any] = {"learning_rate": 3e-3, "batch": 128, "hold": True}
COLUMNS = 4  # panels in a row of the figure
Made = tuple[Any, float, str]  # (controller or controls, ms a state, how it was made)


@dataclass(frozen=True, kw_only=True)
class Plan(table.Plan):
    """Each way on the n initial states of each seed."""

    n: int = 1000
    grid: tuple[int, ...] = (41, 81, 81)  # of the level sets
    iterations: int = 1000  # of Adam, of the paper's method


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
    def place(self) -> Place:
        return Place("dubins", self.way, self.seed)

    @property
    def success(self) -> Array:
        return np.asarray((np.asarray(self.error) <= TOLERANCE) & (np.asarray(self.clearance) >= -VIOLATION))


def judged(ocp: OCP, controller: Any, x0: Array) -> tuple[Simulation, Array]:
    """The judge's run, and lengths in m; rows of controls that are NaN have no trajectory and the length inf."""
    if isinstance(controller, np.ndarray):
        bad = ~np.isfinite(controller).all(axis=(1, 2))
        s = simulate(ocp, np.where(np.isfinite(controller), controller, 0.0), x0)
        s.success[bad], s.reached[bad], s.cost[bad], s.x[bad] = False, False, np.inf, np.nan
    else:
        s = simulate(ocp, controller, x0, nodes=NODES) if hasattr(controller, "to_casadi") else \
            simulate(ocp, controller, x0, hold=INTERVALS)
    h = np.diff(s.t)
    continuous = hasattr(controller, "to_casadi")
    v = (s.u[:, :-1, 0] + s.u[:, 1:, 0]) / 2 if continuous else s.u[:, :-1, 0]
    return s, np.where(s.reached, v @ h, np.inf)


def rollout_ms(ocp: OCP, controller: Callable[[Array, float], Array], x0: Array) -> float:
    """Milliseconds a state: all states together, INTERVALS controls asked for, RK4 between them; on one thread.

    A state to which the controller has no answer stays where it is: only the time counts here.
    """
    x, h, f = x0, ocp.horizon / INTERVALS, ocp.functions.f
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
        from nocl.solvers.rrt_star import RRTStar  # OMPL

        planner = RRTStar(ocp, iterations=iterations, seed=seed)
        solution = planner.solve(x0)
        u = np.where(np.asarray(solution.success)[:, None, None], solution.u, np.nan)
        return u, float(1e3 * np.mean(solution.seconds)), f"goal within {planner.tolerance:g} m of Dubins distance"

    return made


def _nmpc(ocp: OCP, x0: Array, seed: int, plan: Plan, folder: Path) -> Made:
    solver = NMPC(ocp, INTERVALS, seed=seed)
    solution = solver.solve(x0, progress=False)
    u = np.where(np.asarray(solution.success)[:, None, None], solution.u, np.nan)
    return u, float(1e3 * np.mean(solution.seconds)), f"{solver.starts} starts, then neighbours' solutions"


def _optimum(ocp: OCP, x0: Array, seed: int, plan: Plan, folder: Path) -> Made:
    ddp, start = DDP(ocp, intervals=INTERVALS), time.perf_counter()
    best = solve_globally(ddp, x0, seed=seed)
    u = np.where(best.success[:, None, None], best.u, np.nan)
    return u, 1e3 * (time.perf_counter() - start) / len(x0), "DDP, best of many starts"


def _level_sets(ocp: OCP, x0: Array, seed: int, plan: Plan, folder: Path) -> Made:
    from nocl.solvers.levelset.solver import LevelSet, LevelSetSolution  # JAX

    path = folder / table.CELLS / "dubins-V.safetensors"
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
        cnd = pretrained("dubins", SHIPPED[way])
        return cnd, rollout_ms(ocp, cnd, x0), "as it ships with nocl"

    return made


def _paper(ocp: OCP, x0: Array, seed: int, plan: Plan, folder: Path) -> Made:
    start = time.perf_counter()
    settings = PaperSettings(iterations=plan.iterations, **PAPER)
    cnd = train(ocp, method="paper", seed=seed, settings=settings, progress=False)
    text = f"u(x), {settings.iterations} iterations of {settings.batch} rollouts, Adam from {settings.learning_rate:g}"
    text += f", {time.perf_counter() - start:.0f} s"
    return cnd, rollout_ms(ocp, cnd, x0), text


class Published(NamedTuple):
    """The paper's numbers."""

    length: float
    length_std: float
    seconds: float
    success: float


@dataclass(frozen=True)
class Way:
    """A row; `costed`: whether costs compare (RRT* turns round as often as it likes, and G counts that)."""

    title: str
    make: Callable[..., Made]
    paper: Published | None = None
    costed: bool = True


WAYS = {"rrt-100": Way("RRT* (iter: 100)", _rrt(100), Published(4.8871, 0.9607, 6.9313, 0.889), costed=False),
        "rrt-200": Way("RRT* (iter: 200)", _rrt(200), Published(4.7343, 0.8451, 26.0595, 0.939), costed=False),
        "nmpc": Way("NMPC", _nmpc), "level-sets": Way("HJB level sets", _level_sets),
        "cnd-paper": Way("CND, the paper's method", _paper, Published(4.1076, 0.6916, 0.0634, 0.999)),
        "cnd": Way("CND, nocl's default, exact f", _pretrained("cnd")),
        "cnd-learned": Way("CND, nocl's default, learned f", _pretrained("cnd-learned")),
        "optimum": Way("multi-start optimum", _optimum)}
SHIPPED = {"cnd": "exact", "cnd-learned": "learned"}  # way -> dynamics


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


class Dubins(table.PaperTable[Plan, Cell, Entry]):
    """One problem, a row a way."""

    name, title, known, file = "dubins", "Dubins", "the Dubins table", "dubins-{way}-{seed}"
    problems, ways, plan_type, cell_type = ("dubins",), WAYS, Plan, Cell
    numbers = ("length", "error", "clearance", "cost", "paths")
    quick: ClassVar[dict[str, Any]] = {"n": 20, "grid": (24, 37, 41), "iterations": 20}
    least: ClassVar[dict[str, int]] = {"n": 1, "seeds": 1, "iterations": 1}
    methods: ClassVar[dict[str, str]] = {"rrt-100": "rrt-star", "rrt-200": "rrt-star", "level-sets": "level-sets"}

    def key(self, plan: Plan, place: Place) -> dict[str, Any]:
        way, key = place.way, dict[str, Any](n=plan.n)
        if way == "level-sets":
            key |= {"grid": list(plan.grid), "stretch": list(STRETCH), "penalty_slope": PENALTY_SLOPE, "margin": MARGIN}
        if way == "cnd-paper":
            key |= {"iterations": plan.iterations, **PAPER}
        if way in SHIPPED:
            key["controller"] = fingerprint(pretrained("dubins", SHIPPED[way]).to_casadi())
        return key

    def make(self, plan: Plan, place: Place, folder: Path) -> Cell:
        ocp = load_ocp("dubins")
        x0 = ocp.initial_states.sample(plan.n, 1 + place.seed)
        controller, ms, made = WAYS[place.way].make(ocp, x0, place.seed, plan, folder)
        s, length = judged(ocp, controller, x0)
        turned = s.x[:, -1] - ocp.x_goal
        turned[:, 2] = (turned[:, 2] + math.pi) % (2 * math.pi) - math.pi
        error = np.where(s.reached, np.linalg.norm(turned, axis=1), np.inf)
        return Cell(place.way, place.seed, self.key(plan, place), ms, made, length.tolist(), error.tolist(),
                    s.clearance.tolist(), s.cost.tolist(), np.round(s.x[:DRAWN, :, :2], 3).tolist())

    def entries(self, cells: Sequence[Cell]) -> list[Entry]:
        """One a way that has cells."""
        best = {cell.seed: cell for cell in cells if cell.way == "optimum"}
        return [_entry([c for c in cells if c.way == way], best) for way in WAYS if any(c.way == way for c in cells)]

    def columns(self) -> list[table.Column[Entry]]:
        def paper(e: Entry) -> str:
            p = WAYS[e.way].paper
            return "" if p is None else f"{p.length:.3f} ± {p.length_std:.3f}, {p.seconds:.3g}, {p.success:.3f}"

        return [("way", lambda e: WAYS[e.way].title),
                ("length, mean ± s.d.", lambda e: f"{e.length:.3f} ± {e.length_std:.3f}"),
                ("success", lambda e: f"{e.success:.3f}"), ("collisions", lambda e: f"{e.collisions}"),
                ("ms a state", lambda e: f"{e.ms:.3g}"), ("mean cost", lambda e: f"{e.cost:.4f}"),
                ("gap: median, 95 %", lambda e: f"{e.gap:.2f}, {e.gap95:.2f} %" if math.isfinite(e.gap) else ""),
                ("length / optimum's", lambda e: f"{e.ratio:.3f}" if math.isfinite(e.ratio) else ""),
                ("states", lambda e: f"{e.n}" + (f" x {e.seeds}" if e.seeds > 1 else "")), ("made", lambda e: e.made),
                ("paper: length, s, success", paper)]

    def row(self, entry: Entry) -> dict[str, Any]:
        paper = WAYS[entry.way].paper
        return asdict(entry) | {f"paper_{name}": None if paper is None else getattr(paper, name)
                                for name in Published._fields}

    def latex(self, entries: Sequence[Entry]) -> str:
        def cells(length: float, std: float, seconds: float, success: float) -> list[str]:
            return [small(f"{length:.4f}", f"{std:.4f}"), f"{seconds:.4f}", f"{success:.3f}"]

        head = [r"\textbf{Methods} & Trajectory len. & Compute time (s) & Success rate \\"]
        body = [([WAYS[e.way].title.replace("RRT*", "RRT$^*$"), *cells(e.length, e.length_std, e.ms / 1e3, e.success)],
                 [] if (paper := WAYS[e.way].paper) is None else cells(*paper)) for e in entries]
        return grid("l | c c c", head, body)

    def figures(self, entries: Sequence[Entry], cells: Sequence[Cell]) -> dict[str, Figure]:
        """The first states' trajectories of each way, first seed; those that fail dashed."""
        import matplotlib
        from matplotlib.figure import Figure
        from matplotlib.patches import Circle

        from nocl.comparisons.report.style import COLOURS, STYLE  # matplotlib

        shown = [c for c in cells if c.seed == min(c.seed for c in cells)]
        rows = math.ceil(len(shown) / COLUMNS)
        with matplotlib.rc_context(STYLE):
            drawing = Figure(figsize=(2.9 * COLUMNS, 2.9 * rows), layout="constrained")
            panels = drawing.subplots(rows, COLUMNS, sharex=True, sharey=True, squeeze=False).ravel()
            centre, radius = obstacle()
            for cell, axes in zip(shown, panels, strict=False):
                axes.add_patch(Circle(centre, radius, color="0.8"))
                for path, ok in zip(cell.paths, cell.success, strict=False):
                    axes.plot(*zip(*path, strict=True), "-" if ok else "--", color=COLOURS[0 if ok else 1], lw=0.9)
                axes.plot(0, 0, "k+")
                axes.set(title=WAYS[cell.way].title, aspect="equal")
            for axes in panels[len(shown):]:
                axes.set_axis_off()
        return {"": drawing}


def obstacle() -> tuple[tuple[float, float], float]:
    """Centre and radius in m, read off the problem's own constraint."""
    h = load_ocp("dubins").h
    axis = np.linspace(-4, 4, 161)
    x, y = np.meshgrid(axis, axis)
    inside = h(np.array([x.ravel(), y.ravel(), 0 * x.ravel()])).full().ravel()
    k = int(np.argmin(inside))
    return (float(x.ravel()[k]), float(y.ravel()[k])), float(-inside[k])


TABLE = Dubins()
