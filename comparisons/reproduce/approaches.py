"""The paper's "which approach gives what", as measured facts: what each takes as the number of states grows.

Level sets give V over a whole box, from a grid; NMPC an answer for one state at a time; CND a network for all initial
states. A cell is one problem and one way, kept as a file of its own once it is finished.
"""

from __future__ import annotations

import csv
import importlib.util
import io
import time
import warnings
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from nocl.comparisons.reproduce.cells import read_cell
from nocl.comparisons.reproduce.dubins import rollout_ms
from nocl.ocp import OCP
from nocl.support import store
from nocl.support.checks import Array
from nocl.support.compiler import fingerprint
from nocl.systems import load_ocp

PROBLEMS = ("double_integrator", "pendulum", "dubins", "cartpole", "acrobot", "quadrotor")
WAYS = {"level-sets": "HJB level sets", "nmpc": "NMPC", "cnd": "CND"}
CELLS = "cells"
UNLIMITED = 1e12
REFERENCE = 320  # intervals of DDP's optimum
# of the paper's table of approaches: HJB-LSM, NMPC, CT-MBRL; None where it has a dash
CLAIMS = {"solution over the entire state space": (True, False, True), "no space discretization": (False, True, True),
          "no requirement of true dynamics": (False, False, True), "sample efficiency": (None, True, False)}


@dataclass(frozen=True)
class Plan:
    """What to run."""

    nodes: int = 31  # of a grid, along each axis
    states: int = 10  # initial states that NMPC solves
    problems: tuple[str, ...] = PROBLEMS

    def __post_init__(self) -> None:
        for name in ("nodes", "states"):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int) or value < 8:
                raise ValueError(f"reproduce approaches: {name} is {value!r}; expected an integer >= 8")
        unknown = [p for p in self.problems if p not in PROBLEMS]
        if unknown or not self.problems:
            raise ValueError(f"reproduce approaches: problems are {list(self.problems)}; expected some of "
                             f"{', '.join(PROBLEMS)}")


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


def run(out: str | Path, plan: Plan | None = None, *, progress: bool = True) -> list[Cell]:
    """The cells of a plan, those that are finished in folder `out` taken from there."""
    folder, plan, cells = Path(out), plan or Plan(), []
    pairs = [(problem, way) for problem in plan.problems for way in WAYS]
    with tqdm(pairs, "approaches", disable=not progress, unit="cell") as bar:
        for problem, way in bar:
            if way == "level-sets" and importlib.util.find_spec("hj_reachability") is None:
                bar.write("level sets are left out: hj-reachability is not installed")
                continue
            bar.set_postfix_str(f"{problem}, {WAYS[way]}")
            path = folder / CELLS / f"approaches-{problem}-{way}.json"
            cell = _read(path) if path.is_file() else None
            if cell is None or cell.key != _key(way, plan, problem):
                cell = MAKERS[way](problem, plan)
                store.write_json(path, asdict(cell))
            cells.append(cell)
    return cells


def finished(out: str | Path) -> list[Cell]:
    """All cells that the folder holds, by rising numbers of states."""
    cells = [_read(path) for path in sorted((Path(out) / CELLS).glob("approaches-*.json"))]
    return sorted(cells, key=lambda c: (PROBLEMS.index(c.problem), list(WAYS).index(c.way)))


def _key(way: str, plan: Plan, problem: str) -> dict[str, Any]:
    """What a cell is made with; of CND the controller that comes with nocl, too."""
    key: dict[str, Any] = {"nodes": plan.nodes} if way == "level-sets" else {"states": plan.states}
    if way == "cnd" and (cnd := _shipped(problem)) is not None:
        key["controller"] = fingerprint(cnd.to_casadi())
    return key


def _read(path: Path) -> Cell:
    return read_cell(path, Cell, "the table of approaches", ("memory", "before", "ms", "error"))


def _level_sets(problem: str, plan: Plan) -> Cell:
    """Solved up to 3 states; of 4 predicted by the compiled solver and a timed step; beyond, the nodes are counted."""
    from nocl.solvers.levelset.solver import LevelSet

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
    from nocl.solvers.nmpc.solver import NMPC

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
    from nocl.solvers.ddp.global_search import solve_globally
    from nocl.solvers.ddp.solver import DDP

    best = solve_globally(DDP(ocp, intervals=REFERENCE), x0, seed=0)
    wrong = np.abs(np.asarray(V).ravel() - best.cost) / best.cost
    return float(np.mean(wrong[best.success & np.isfinite(wrong)]))


def _shipped(problem: str) -> Any:
    """The controller that comes with nocl, or None."""
    from nocl.solvers.cnd.controller import pretrained

    try:
        return pretrained(problem, "exact")
    except ValueError:
        return None


def _training_seconds(cnd: Any) -> float:
    seconds = cnd.card.get("seconds", float("nan"))
    return float(sum(seconds.values())) if isinstance(seconds, dict) else float(seconds)


MAKERS = {"level-sets": _level_sets, "nmpc": _nmpc, "cnd": _cnd}


def write(folder: str | Path, cells: Sequence[Cell]) -> list[Path]:
    """approaches.md, .tex, .csv and .png in the folder; their paths."""
    texts = {"md": markdown(cells), "tex": latex(cells), "csv": as_csv(cells)}
    paths = [store.write_text(Path(folder) / f"approaches.{kind}", text) for kind, text in texts.items()]
    return [*paths, store.write_bytes(Path(folder) / "approaches.png", figure(cells))]


def figure(cells: Sequence[Cell]) -> bytes:
    """Memory, seconds before, milliseconds a state and mean error against the number of states, as PNG."""
    import matplotlib
    from matplotlib.figure import Figure

    from nocl.comparisons.report.style import COLOURS, STYLE, encode

    quantities = {"memory": "memory, MB", "before": "s before", "ms": "ms a state", "error": "mean error of V"}
    with matplotlib.rc_context(STYLE):
        drawing = Figure(figsize=(12, 3), layout="constrained")
        panels = drawing.subplots(1, len(quantities))
        for axes, (name, title) in zip(panels, quantities.items(), strict=True):
            for colour, (way, label) in zip(COLOURS, WAYS.items(), strict=False):
                own = [c for c in cells if c.way == way]
                axes.plot([c.nx for c in own], [getattr(c, name) for c in own], "o", color=colour, label=label)
            axes.set(yscale="log", xlabel="states", title=title)
        panels[0].legend(fontsize=7)
        return bytes(encode(drawing, "png"))


def _number(x: float) -> str:
    return f"{x:.3g}" if np.isfinite(x) else "-"


def _percent(x: float) -> str:
    return f"{100 * x:.2g} %" if np.isfinite(x) else "-"


def markdown(cells: Sequence[Cell]) -> str:
    """A row for each problem and way, by rising numbers of states."""
    lines = ["| problem | states | way | size | memory, MB | s before | ms a state | mean error | covers | note |",
             f"|{'---|' * 10}"]
    lines += [f"| {c.problem} | {c.nx} | {WAYS[c.way]} | {c.size} | {_number(c.memory)} | {_number(c.before)} | "
              f"{_number(c.ms)} | {_percent(c.error)} | {c.covers} | {c.note} |" for c in cells]
    marks = {True: "yes", False: "no", None: "-"}
    lines += ["", "What the paper says of them:", "", "| | HJB-LSM | NMPC | CT-MBRL |", f"|{'---|' * 4}"]
    lines += [f"| {claim} | {' | '.join(marks[m] for m in said)} |" for claim, said in CLAIMS.items()]
    return "\n".join(lines) + "\n"


def latex(cells: Sequence[Cell]) -> str:
    """The measured part."""
    lines = [r"\begin{tabular}{l r l r r r r}", r"\toprule",
             r"problem & states & way & memory (MB) & s before & ms a state & error (\%) \\", r"\midrule"]
    lines += [f"{c.problem.replace('_', ' ')} & {c.nx} & {WAYS[c.way]} & {_number(c.memory)} & {_number(c.before)} & "
              rf"{_number(c.ms)} & {_number(100 * c.error)} \\" for c in cells]
    return "\n".join([*lines, r"\bottomrule", r"\end{tabular}", ""])


def as_csv(cells: Sequence[Cell]) -> str:
    """All of it."""
    file = io.StringIO()
    names = [f.name for f in fields(Cell) if f.name != "key"]
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow(names)
    writer.writerows([getattr(c, name) for name in names] for c in cells)
    return file.getvalue()
