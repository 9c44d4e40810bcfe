"""The paper's "which approach gives what", as measured facts: what each takes as the number of states grows.

Level sets give V over a whole box, from a grid; NMPC an answer for one state at a time; CND a network for all initial
states.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from nocl.comparisons.reproduce import table
from nocl.comparisons.reproduce.dubins import rollout_ms
from nocl.comparisons.reproduce.table import Place, grid
from nocl.definition.ocp import OCP
from nocl.solvers.cnd.controller import pretrained
from nocl.solvers.ddp.global_search import solve_globally
from nocl.solvers.ddp.solver import DDP
from nocl.solvers.nmpc.solver import NMPC
from nocl.support.checks import Array
from nocl.support.fingerprint import fingerprint
from nocl.systems import load_ocp

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PROBLEMS = ("double_integrator", "pendulum", "dubins", "cartpole", "acrobot", "quadrotor")
UNLIMITED = 1e12
REFERENCE = 320  # intervals of DDP's optimum
# of the paper's table of approaches: HJB-LSM, NMPC, CT-MBRL; None where it has a dash
CLAIMS = {"solution over the entire state space": (True, False, True), "no space discretization": (False, True, True),
          "no requirement of true dynamics": (False, False, True), "sample efficiency": (None, True, False)}


@dataclass(frozen=True, kw_only=True)
class Plan(table.Plan):
    """Each way on each problem."""

    nodes: int = 31  # of a grid, along each axis
    states: int = 10  # initial states that NMPC solves


@dataclass(frozen=True)
class Cell:
    """One way on one problem."""

    problem: str
    nx: int
    way: str
    size: str  # nodes, unknowns or weights
    memory: float  # MB: of the grid's solver, or of the network's weights; NaN where it was not measured
    before: float  # s, until the first state can be answered
    ms: float  # a state's whole control trajectory
    error: float  # mean |V - J| / J of its V, or of NMPC's cost, over the states; J the best of DDP's starts
    covers: str
    note: str
    key: dict[str, Any]

    @property
    def place(self) -> Place:
        return Place(self.problem, self.way)


def _key(way: str, plan: Plan, problem: str) -> dict[str, Any]:
    """What a cell is made with; of CND the controller that comes with nocl, too."""
    key: dict[str, Any] = {"nodes": plan.nodes} if way == "level-sets" else {"states": plan.states}
    if way == "cnd" and (cnd := _shipped(problem)) is not None:
        key["controller"] = fingerprint(cnd.to_casadi())
    return key


def _level_sets(problem: str, plan: Plan) -> Cell:
    """Solved up to 3 states; of 4 predicted by the compiled solver and a timed step; beyond, the nodes are counted."""
    from nocl.solvers.levelset.solver import LevelSet  # JAX

    ocp, nan = load_ocp(problem), float("nan")
    nx, covers, key = ocp.system.nx, "V(x, t) on the whole box", _key("level-sets", plan, problem)
    size = f"{float(plan.nodes) ** nx:.3g} nodes"
    if nx > 4:
        at_least = float(plan.nodes) ** nx * 8 / 1e6  # one array of doubles
        return Cell(problem, nx, "level-sets", size, at_least, nan, nan, nan, covers,
                    "not possible: a single array would need that memory", key)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # 4 states: the table says so
        grid = LevelSet(ocp, (plan.nodes,) * nx, max_memory=UNLIMITED, max_seconds=UNLIMITED, slices=11)
    if nx == 4:
        p = grid.predict()
        return Cell(problem, nx, "level-sets", size, 1e3 * p.memory, p.seconds, nan, nan, covers, "predicted", key)
    solution, x0 = grid.solve(), ocp.initial_states.sample(plan.states, 1)
    return Cell(problem, nx, "level-sets", size, 1e3 * solution.prediction.memory, solution.seconds,
                rollout_ms(ocp, solution, x0), _error(ocp, x0, solution.value(x0)), covers, "", key)


def _nmpc(problem: str, plan: Plan) -> Cell:
    ocp = load_ocp(problem)
    start = time.perf_counter()
    solver = NMPC(ocp, starts=1, passes=0)
    solver.solve(ocp.initial_states.sample(1, 0), progress=False)
    built = time.perf_counter() - start
    x0 = ocp.initial_states.sample(plan.states, 1)
    solution = solver.solve(x0, progress=False)
    unknowns = solver.intervals * (ocp.system.nx + ocp.system.nu) + ocp.system.nx
    return Cell(problem, ocp.system.nx, "nmpc", f"{unknowns} unknowns", float("nan"), built,
                float(1e3 * np.median(solution.seconds)), _error(ocp, x0, solution.cost),
                "one initial state, a local optimum", "one start a state",
                _key("nmpc", plan, problem))


def _cnd(problem: str, plan: Plan) -> Cell:
    ocp, nan, cnd, key = load_ocp(problem), float("nan"), _shipped(problem), _key("cnd", plan, problem)
    covers = "the initial states that it was trained for"
    if cnd is None:
        return Cell(problem, ocp.system.nx, "cnd", "", nan, nan, nan, nan, covers, "none ships with nocl", key)
    x0 = ocp.initial_states.sample(plan.states, 1)
    weights = sum(p.numel() for net in (cnd.policy, cnd.value_net) if net is not None for p in net.parameters())
    return Cell(problem, ocp.system.nx, "cnd", f"{weights} weights", weights * 8 / 1e6, _training_seconds(cnd),
                rollout_ms(ocp, cnd, x0), _error(ocp, x0, cnd.value(x0, 0.0)), covers,
                "its training's time as its card has it", key)


def _error(ocp: OCP, x0: Array, V: Any) -> float:
    """Mean |V - J| / J over the states; where V has no answer, the states are left out."""
    best = solve_globally(DDP(ocp, intervals=REFERENCE), x0, seed=0)
    wrong = np.abs(np.asarray(V).ravel() - best.cost) / best.cost
    return float(np.mean(wrong[best.success & np.isfinite(wrong)]))


def _shipped(problem: str) -> Any:
    """The controller that comes with nocl, or None."""
    try:
        return pretrained(problem, "exact")
    except ValueError:
        return None


def _training_seconds(cnd: Any) -> float:
    seconds = cnd.card.get("seconds", float("nan"))
    return float(sum(seconds.values())) if isinstance(seconds, dict) else float(seconds)


@dataclass(frozen=True)
class Way:
    """A way to solve a problem."""

    title: str
    make: Callable[[str, Plan], Cell]


WAYS = {"level-sets": Way("HJB level sets", _level_sets), "nmpc": Way("NMPC", _nmpc), "cnd": Way("CND", _cnd)}


class Approaches(table.PaperTable[Plan, Cell, Cell]):
    """A row for each cell, by rising numbers of states."""

    name, title, known = "approaches", "approaches", "the table of approaches"
    file = "approaches-{problem}-{way}"
    problems, ways, plan_type, cell_type = PROBLEMS, WAYS, Plan, Cell
    numbers = ("memory", "before", "ms", "error")
    quick: ClassVar[dict[str, int]] = {"nodes": 15}
    least: ClassVar[dict[str, int]] = {"nodes": 8, "states": 8}
    methods: ClassVar[dict[str, str]] = {"level-sets": "level-sets"}

    def key(self, plan: Plan, place: Place) -> dict[str, Any]:
        return _key(place.way, plan, place.problem)

    def make(self, plan: Plan, place: Place, folder: Path) -> Cell:
        return WAYS[place.way].make(place.problem, plan)

    def entries(self, cells: Sequence[Cell]) -> list[Cell]:
        return list(cells)

    def columns(self) -> list[table.Column[Cell]]:
        return [("problem", lambda c: c.problem), ("states", lambda c: str(c.nx)),
                ("way", lambda c: WAYS[c.way].title), ("size", lambda c: c.size),
                ("memory, MB", lambda c: _number(c.memory)), ("s before", lambda c: _number(c.before)),
                ("ms a state", lambda c: _number(c.ms)),
                ("mean error", lambda c: f"{100 * c.error:.2g} %" if np.isfinite(c.error) else "-"),
                ("covers", lambda c: c.covers), ("note", lambda c: c.note)]

    def markdown(self, entries: Sequence[Cell]) -> str:
        """What was measured, and what the paper says."""
        marks = {True: "yes", False: "no", None: "-"}
        claims = [[claim, *(marks[m] for m in said)] for claim, said in CLAIMS.items()]
        return super().markdown(entries) + "\nWhat the paper says of them:\n\n" + table.lines(
            ["", "HJB-LSM", "NMPC", "CT-MBRL"], claims)

    def row(self, entry: Cell) -> dict[str, Any]:
        return {name: value for name, value in asdict(entry).items() if name != "key"}

    def latex(self, entries: Sequence[Cell]) -> str:
        """The measured part."""
        head = [r"problem & states & way & memory (MB) & s before & ms a state & error (\%) \\"]
        return grid("l r l r r r r", head, [
            ([c.problem.replace("_", " "), str(c.nx), WAYS[c.way].title, _number(c.memory), _number(c.before),
              _number(c.ms), _number(100 * c.error)], []) for c in entries])

    def figures(self, entries: Sequence[Cell], cells: Sequence[Cell]) -> dict[str, Figure]:
        """Memory, seconds before, milliseconds a state and mean error against the number of states."""
        import matplotlib
        from matplotlib.figure import Figure

        from nocl.comparisons.report.style import COLOURS, STYLE  # matplotlib

        quantities = {"memory": "memory, MB", "before": "s before", "ms": "ms a state", "error": "mean error of V"}
        with matplotlib.rc_context(STYLE):
            drawing = Figure(figsize=(12, 3), layout="constrained")
            panels = drawing.subplots(1, len(quantities))
            for axes, (name, title) in zip(panels, quantities.items(), strict=True):
                for colour, (key, way) in zip(COLOURS, WAYS.items(), strict=False):
                    own = [c for c in cells if c.way == key]
                    axes.plot([c.nx for c in own], [getattr(c, name) for c in own], "o", color=colour, label=way.title)
                axes.set(yscale="log", xlabel="states", title=title)
            panels[0].legend(fontsize=7)
        return {"": drawing}


def _number(x: float) -> str:
    return f"{x:.3g}" if np.isfinite(x) else "-"


TABLE = Approaches()
