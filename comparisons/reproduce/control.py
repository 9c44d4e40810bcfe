"""The paper's tables of control: acrobot and cart-pole by learned dynamics, and the quadrotor, f known and not."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from nocl.comparisons.reproduce import table
from nocl.comparisons.reproduce.controllers import (
    GYM,
    QUADROTOR,
    Assignment,
    Cell,
    Plan,
    Published,
    Way,
    identified,
    judged,
    shipped,
)
from nocl.comparisons.reproduce.table import Place, grid, number, small, spread
from nocl.solvers.cnd.controller import pretrained
from nocl.support.checks import Array
from nocl.support.fingerprint import fingerprint
from nocl.systems import load_ocp

if TYPE_CHECKING:
    from matplotlib.figure import Figure

HIDDEN = 500_000  # + seed: the seed of the initial states that cells are judged on
COLUMNS = 4  # panels in a row of the flights


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


def _entry(problem: str, way: str, cells: Sequence[Cell]) -> Entry:
    judged = [c for c in cells if c.error]
    numbers: dict[str, Any] = {}
    for what in ("error", "magnitude", "cost"):
        mean, std, low, high = _over([np.asarray(getattr(c, what)) for c in judged])
        numbers |= {what: mean, f"{what}_std": std, f"{what}_low": low, f"{what}_high": high}
    del numbers["cost_std"]
    for what in ("seconds", "cpu", "identify", "evaluations", "ms"):
        known = [value for c in cells if not math.isnan(value := getattr(c, what))]
        numbers[what] = float(np.mean(known)) if known else math.nan
    made = "; ".join(dict.fromkeys(c.made for c in cells))
    return Entry(problem, way, **numbers, failed=sum(int((~np.isfinite(c.error)).sum()) for c in judged),
                 n=max((len(c.error) for c in judged), default=0), seeds=len(cells), made=made)


def _over(parts: Sequence[Array]) -> tuple[float, float, float, float]:
    """(mean, standard deviation, least and greatest mean of a part) of what is finite; NaN where nothing is."""
    finite = [part[np.isfinite(part)] for part in parts]
    finite = [part for part in finite if part.size]
    if not finite:
        return (math.nan,) * 4
    values, means = np.concatenate(finite), [float(part.mean()) for part in finite]
    return float(values.mean()), float(values.std()), min(means), max(means)


class Control(table.PaperTable[Plan, Cell, Entry]):
    """One of the tables of control."""

    known, plan_type, cell_type = "the tables of control", Plan, Cell
    numbers = ("error", "magnitude", "cost", "paths", "seconds", "cpu", "identify", "evaluations", "ms")
    quick: ClassVar[dict[str, int]] = {"seeds": 1, "n": 8, "iterations": 10, "oc_iterations": 20, "oc_batch": 16}
    least: ClassVar[dict[str, int]] = dict.fromkeys(quick, 1)

    def __init__(self, name: str, title: str, problems: tuple[str, ...], ways: Mapping[str, Way]) -> None:
        self.name, self.title, self.problems, self.ways = name, title, problems, dict(ways)
        self.file = name + "-{problem}-{way}-{seed}"

    ways: dict[str, Way]

    def can_run(self) -> list[str]:
        return [name for name, way in self.ways.items() if way.make is not None]

    def states(self, plan: Plan, way: Way) -> int:
        """How many initial states a way is judged on."""
        return plan.n if way.most is None else min(plan.n, way.most)

    def is_shipped(self, plan: Plan, place: Place) -> bool:
        """Whether a cell is of the controller that comes with nocl."""
        return plan.shipped and place.seed == 0 and self.ways[place.way].default

    def key(self, plan: Plan, place: Place) -> dict[str, Any]:
        way = self.ways[place.way]
        key: dict[str, Any] = {"n": self.states(plan, way), "quick": plan.quick}
        if way.budgets is not None:
            key |= way.budgets(place.problem, plan)
        if self.is_shipped(plan, place):
            cnd = pretrained(place.problem, "learned" if way.learned else "exact")
            key |= {"controller": fingerprint(cnd.to_casadi()), "seconds": cnd.card["seconds"]}
        return key

    def make(self, plan: Plan, place: Place, folder: Path) -> Cell:
        way, ocp, ready = self.ways[place.way], load_ocp(place.problem), self.is_shipped(plan, place)
        assert way.make is not None
        start = time.perf_counter()
        model = identified(ocp, place.seed, plan) if way.learned and not ready else None
        identify = 0.0 if model is None else time.perf_counter() - start
        start, cpu, task = time.perf_counter(), time.process_time(), Assignment(ocp, model, place.seed, plan)
        made = shipped(task, way.learned) if ready else way.make(task)
        seconds, cpu = time.perf_counter() - start, time.process_time() - cpu
        if made.seconds is not None:
            seconds, cpu = made.seconds, math.nan
        cell = Cell(place.problem, place.way, place.seed, self.key(plan, place), made.made, [], [], [], seconds, cpu,
                    identify, made.evaluations, math.nan, [])
        if made.controller is None:
            return cell
        x0 = ocp.initial_states.sample(self.states(plan, way), HIDDEN + place.seed)
        return judged(cell, ocp, made.controller, x0)

    def entries(self, cells: Sequence[Cell]) -> list[Entry]:
        """One a problem and way; those without cells say so."""
        entries = [_entry(problem, way, [c for c in cells if (c.problem, c.way) == (problem, way)])
                   for problem in self.problems for way in self.ways]
        return [replace(e, made=e.made or ("not run yet" if self.ways[e.way].make is None else "not in this run"))
                for e in entries]

    def paper(self, e: Entry) -> Published | None:
        return self.ways[e.way].paper.get(e.problem)

    def columns(self) -> list[table.Column[Entry]]:
        def paper(e: Entry, what: str) -> str:
            p = self.paper(e)
            return "" if p is None else spread(getattr(p, what), getattr(p, f"{what}_std"))

        def seeds(e: Entry, low: float, high: float) -> str:
            return spread(low, high, "{} .. {}") if e.seeds > 1 else ""

        def counted(e: Entry) -> str:
            p = self.paper(e)
            return "" if p is None or p.evaluations is None else f"{p.evaluations}"

        return [("problem", lambda e: e.problem), ("way", lambda e: self.ways[e.way].title),
                ("trained on", lambda e: self.ways[e.way].trained_on),
                ("terminal error", lambda e: spread(e.error, e.error_std)),
                ("of a seed", lambda e: seeds(e, e.error_low, e.error_high)),
                ("control", lambda e: spread(e.magnitude, e.magnitude_std)),
                ("of a seed", lambda e: seeds(e, e.magnitude_low, e.magnitude_high)),
                ("cost", lambda e: number(e.cost)), ("failed", lambda e: f"{e.failed}" if e.n else ""),
                ("evaluations", lambda e: number(e.evaluations)),
                ("training: s (CPU s)", lambda e: spread(e.seconds, e.cpu, "{} ({})" if e.cpu == e.cpu else "{}")),
                ("ms a state", lambda e: number(e.ms)),
                ("seeds x states", lambda e: f"{e.seeds} x {e.n}" if e.n else ""), ("made", lambda e: e.made),
                ("paper: terminal error", lambda e: paper(e, "error")),
                ("paper: control", lambda e: paper(e, "magnitude")), ("paper: NFE", counted)]

    def row(self, entry: Entry) -> dict[str, Any]:
        paper = self.paper(entry)
        return {"trained_on": self.ways[entry.way].trained_on} | asdict(entry) | {
            f"paper_{name}": None if paper is None else getattr(paper, name) for name in Published._fields}

    def latex(self, entries: Sequence[Entry]) -> str:
        found = {(e.problem, e.way): e for e in entries}
        problems = [p for p in self.problems if any(e.problem == p and e.seeds for e in entries)]
        head = [" & & " + " & ".join(rf"\multicolumn{{3}}{{c}}{{{p.capitalize()}}}" for p in problems) + r" \\",
                r"\textbf{Methods} & S.T." + r" & Term. error & Control magn. & NFE" * len(problems) + r" \\"]
        body = []
        for name, way in self.ways.items():
            ours = [text for p in problems for text in _ours(found.get((p, name)))]
            theirs = [text for p in problems for text in _theirs(way.paper.get(p))]
            body.append(([way.title.replace("CND (R = 0)", "CND ($R = 0$)"), _dynamics(way), *ours], theirs))
        return grid("l c " + "| c c c " * len(problems), head, body)

    def figures(self, entries: Sequence[Entry], cells: Sequence[Cell]) -> dict[str, Figure]:
        """Terminal errors, and of the quadrotor its flights."""
        from nocl.comparisons.reproduce.dots import Dot, dots  # matplotlib

        found = {(e.problem, e.way): e for e in entries}

        def dot(problem: str, way: str) -> Dot:
            e, paper = found.get((problem, way)), self.ways[way].paper.get(problem)
            known = e is not None and math.isfinite(e.error)
            return Dot((e.error, e.error_low, e.error_high) if e is not None and known else None,
                       None if paper is None else paper.error)

        labels = [f"{way.title}, {_dynamics(way)}" for way in self.ways.values()]
        drawings = {"": dots({p: [dot(p, way) for way in self.ways] for p in self.problems}, labels, "terminal error")}
        return drawings | ({"-3d": self.flights(cells)} if any(cell.paths for cell in cells) else {})

    def flights(self, cells: Sequence[Cell]) -> Figure:
        """The first states' flights of each way in 3-D, first seed, the goal a cross; far outside they are cut."""
        import matplotlib
        from matplotlib.figure import Figure

        from nocl.comparisons.report.style import COLOURS, STYLE  # matplotlib

        shown = [c for c in cells if c.paths and c.seed == min(c.seed for c in cells if c.paths)]
        rows, ways = math.ceil(len(shown) / COLUMNS), self.ways
        goal, margin = load_ocp(shown[0].problem).x_goal[:3], 3.0
        low, high = np.minimum(goal, 0) - margin, np.maximum(goal, 0) + margin
        with matplotlib.rc_context(STYLE):
            drawing = Figure(figsize=(2.9 * COLUMNS, 2.9 * rows), layout="constrained")
            for k, cell in enumerate(shown):
                axes = drawing.add_subplot(rows, COLUMNS, k + 1, projection="3d")
                for path in np.array(cell.paths):
                    inside = np.where(((path >= low) & (path <= high)).all(1, keepdims=True), path, np.nan)
                    axes.plot(*inside.T, color=COLOURS[0], lw=0.9)
                    axes.plot(*path[:1].T, ".", color=COLOURS[0], ms=3)
                axes.set_box_aspect(None, zoom=0.85)
                axes.plot(*goal[:, None], "+", color=COLOURS[1], ms=9)
                axes.set(title=f"{ways[cell.way].title}, {_dynamics(ways[cell.way])}", xlim=(low[0], high[0]),
                         ylim=(low[1], high[1]), zlim=(low[2], high[2]), xlabel="x", ylabel="y", zlabel="z")
        return drawing


def _dynamics(way: Way) -> str:
    return {"f": "$f$", "f_theta": r"$f_\theta$"}.get(trained := way.trained_on, trained)


def _ours(e: Entry | None) -> list[str]:
    if e is None or not e.n:
        return ["--", "--", "--"]
    return [small(number(e.error, 4), number(e.error_std)), small(number(e.magnitude, 4), number(e.magnitude_std)),
            number(e.evaluations)]


def _theirs(p: Published | None) -> list[str]:
    if p is None:
        return ["", "", ""]
    return [small(number(p.error, 4), number(p.error_std)), small(number(p.magnitude, 4), number(p.magnitude_std)),
            "--" if p.evaluations is None else str(p.evaluations)]


GYM_TABLE = Control("gym", "Gym", ("acrobot", "cartpole"), GYM)
QUADROTOR_TABLE = Control("quadrotor", "quadrotor", ("quadrotor",), QUADROTOR)
