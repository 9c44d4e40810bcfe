"""What a comparison found, as rows and a summary. Gaps and shares are in per cent."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nocl.comparisons.report.findings import (
    MethodAudit,
    Promise,
    Region,
    Robustness,
    Row,
    Stability,
    per_cent,
    percentile,
)
from nocl.definition import measured
from nocl.definition.ocp import OCP
from nocl.definition.scales import usual_sizes
from nocl.judge.runs import Simulation
from nocl.support.checks import Array

REFERENCE = "reference"  # the name of a yardstick among the methods: its speed is no method's
ALIKE = 0.1  # per cent of a cost: a baseline is as good as a method
NOISE = 1e-9  # of a cost: gains that are less are the judge's rounding
BASELINE = "a simple baseline"  # a control that is held, or LQR: see comparisons/baselines.py
WIDTH = 118  # characters of a line in the terminal
Mask = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Planned:
    """A solver's own trajectory and costate, at the K+1 nodes of its run; NaN where it has none."""

    x: Array  # [B, K+1, nx]
    costate: Array  # [B, K+1, nx]


@dataclass(frozen=True, eq=False)
class Judged:
    """One method on all B initial states, as the judge saw it."""

    name: str
    how: str  # how its control was run, in words
    simulation: Simulation
    ms_first: Array  # [B], milliseconds to the first control: a solve, or one evaluation of a controller
    ms_per_control: Array  # [B], milliseconds for each later control; NaN in open loop, where none is computed
    evaluations: Array  # [B], of f with its derivatives, by which the controls were computed; NaN where unknown
    solves: Array  # [B], solves that `ms_first` went into: several starts, neighbours; 1 for a controller
    predicted: Array  # [B], the cost that the method itself expected, NaN where it has no opinion
    plan: Planned | None = None  # what a solver planned
    value: Callable[[Array, float, Array], Array] | None = None  # (x [B, nx], t, p [B, np]) -> V [B], where it has one
    held: bool = False  # whether each control is held to the next node; else it is continuous

    @property
    def feasible(self) -> Mask:
        """[B], whether the run reached the horizon with all constraints held."""
        return np.asarray(self.simulation.success, dtype=bool)

    @property
    def violates(self) -> Mask:
        """[B], whether it got there and did not hold them."""
        return np.asarray(self.simulation.reached, dtype=bool) & ~self.feasible

    @property
    def cost(self) -> Array:
        """[B], inf where the run failed."""
        return np.where(self.feasible, self.simulation.cost, np.inf)


class Summary(list[Row]):
    """One dict a method; printed as a table."""

    def __str__(self) -> str:
        return text_table([label for label, _, _ in columns(self)], [cells(row, columns(self)) for row in self])

    __repr__ = __str__


@dataclass(frozen=True, eq=False, repr=False)
class Results:
    """Any methods on the same B initial states of a problem; `rows`, `summary` and `verdict` are read from `judged`.

    What a study finds beyond costs stands in the other fields, empty where it was not asked for.
    """

    ocp: OCP
    x0: Array  # [B, nx]
    judged: tuple[Judged, ...]
    settings: Mapping[str, Any]
    seconds: float  # wall time of the comparison
    p: Array | None = None  # [B, np], the parameters of each state; None where there are none
    audits: tuple[MethodAudit, ...] = ()  # of methods by name: models and integrators, values
    robustness: Robustness | None = None
    promises: tuple[Promise, ...] = ()  # one a method, where the states are independent draws
    stability: tuple[Stability, ...] = ()
    regions: tuple[Region, ...] = ()
    base: Array | None = None  # [B], the least cost of simple baselines, NaN where none is feasible
    impossible: tuple[str, ...] = ()  # [B], why no plan holds the constraints from a state; "", or (): not said

    def rows(self) -> list[Row]:
        """One dict a method and initial state; a run that failed has success False, its message, and infinite cost.

        One that reached the horizon and violated a constraint has failed: `reached` tells the two apart.
        """
        audits = {audit.method: audit.rows() for audit in self.audits}
        keys = list(dict.fromkeys(key for rows in audits.values() for key in rows[0]))
        return [self._row(m, i) | dict.fromkeys(keys, math.nan) | (audits[j.name][i] if j.name in audits else {})
                for m, j in enumerate(self.judged) for i in range(len(self.x0))]

    def summary(self) -> Summary:
        """One dict a method. Means are over the runs that did not fail; medians, percentiles and shares over all states
        that count: not those from which no plan holds the constraints.
        """
        return Summary(self._summarize(m) for m in range(len(self.judged)))

    @property
    def last(self) -> float:
        """The horizon; where it is free, when the last run ends."""
        if not self.ocp.is_free:
            return self.ocp.longest
        ends = np.concatenate([j.simulation.times[:, -1] for j in self.judged])
        return float(ends[np.isfinite(ends)].max(initial=0.0)) or self.ocp.longest

    @property
    def parameters(self) -> Array:
        """p [B, np], with no columns where the problem has none."""
        return np.zeros((len(self.x0), 0)) if self.p is None else self.p

    @property
    def starts(self) -> Array:
        """What tells the states apart, (x0, p) [B, nx + np]."""
        return np.c_[self.x0, self.parameters]

    @property
    def start_names(self) -> tuple[str, ...]:
        """Of the columns of `starts`."""
        return (*self.ocp.system.state_names, *self.ocp.parameter_names)

    def at(self, i: int) -> OCP:
        """The problem of state i, its parameters folded in."""
        return self.ocp.folded(self.parameters[i])

    @cached_property
    def cost(self) -> Array:
        """[methods, B] judged costs, inf where a run failed."""
        return np.array([j.cost for j in self.judged])

    @cached_property
    def feasible(self) -> Mask:
        """[methods, B]"""
        return np.array([j.feasible for j in self.judged])

    @cached_property
    def best(self) -> Array:
        """[B], the least judged cost of a run that violated nothing, simple baselines' too; NaN where there is none."""
        least = np.where(self.beaten, self._base, self.cost.min(axis=0))
        return np.where(np.isfinite(least), least, np.nan)

    @property
    def _base(self) -> Array:
        return np.full(len(self.x0), np.nan) if self.base is None else self.base

    @cached_property
    def beaten(self) -> Mask:
        """[B], where a simple baseline costs less than all methods."""
        least, base = self.cost.min(axis=0), self._base
        with np.errstate(invalid="ignore"):
            less = least - base > NOISE * (np.abs(base) + np.abs(least))
        return np.asarray(np.isfinite(base) & (np.isposinf(least) | less))

    @cached_property
    def counted(self) -> Mask:
        """[B], the states that rows are about: not those from which no plan holds the constraints, as a solver says,
        and nobody did better.
        """
        said = np.array([bool(why) for why in self.impossible or [""] * len(self.x0)], dtype=bool)
        return np.asarray(~said | self.feasible.any(axis=0) | np.isfinite(self._base))

    @cached_property
    def best_method(self) -> list[str]:
        """[B], who found it, BASELINE or "" where no method did; the first named where two are equal."""
        who = [BASELINE if beaten else self.judged[m].name for m, beaten in
               zip(self.cost.argmin(axis=0), self.beaten, strict=True)]
        return [name if math.isfinite(best) else "" for name, best in zip(who, self.best, strict=True)]

    def best_index(self, i: int) -> int | None:
        """The method that found the best known cost of state i; None where none did."""
        names = [j.name for j in self.judged]
        return names.index(self.best_method[i]) if self.best_method[i] not in ("", BASELINE) else None

    @cached_property
    def gap(self) -> Array:
        """[methods, B], cost - best in per cent of |best|; inf where a run failed or nobody has a best, NaN where the
        state does not count.
        """
        gap = per_cent(self.cost - self.best, self.best, usual_sizes(self.ocp).cost)
        return np.where(self.counted, np.where(np.isnan(gap), np.inf, gap), np.nan)

    @cached_property
    def gainful(self) -> Mask:
        """[B], where a simple baseline is known that costs more than the best known run."""
        with np.errstate(invalid="ignore"):
            return np.asarray(self._base - self.best > NOISE * (np.abs(self._base) + np.abs(self.best)))

    @cached_property
    def missed(self) -> Array:
        """[methods, B], cost - best in per cent of base - best, of what can be gained over simple baselines.

        inf where a run failed, NaN where nothing can be gained, no baseline is feasible, or the state does not count.
        """
        room = np.where(self.gainful, self._base - self.best, np.nan)
        with np.errstate(invalid="ignore"):
            missed = 100 * (self.cost - self.best) / room
        return np.where(self.counted & self.gainful, missed, np.nan)

    def violations(self, m: int) -> str:
        """Which constraints a method violates, by how much at most, on how many states that count, in words."""
        j, worst = self.judged[m], dict[str, list[int]]()
        for i in np.flatnonzero(j.violates & self.counted):
            name, _ = measured.excess(self.ocp, int(j.simulation.worst[i]), float(j.simulation.violation[i]))
            worst.setdefault(name, []).append(int(i))
        return ", ".join(self._violation(j, name, states) for name, states in worst.items())

    def _violation(self, judged: Judged, name: str, states: Sequence[int]) -> str:
        s = judged.simulation
        i = max(states, key=lambda state: s.violation[state])
        _, much = measured.excess(self.ocp, int(s.worst[i]), float(s.violation[i]))
        return f"{name!r} by {much} ({len(states)} of {self.counted.sum()})"

    def within(self, percent: float) -> Mask:
        """[methods, B], whether a run violates nothing and is within so much of the best known cost."""
        return np.asarray(self.feasible & (self.gap <= percent), dtype=bool)

    def _row(self, m: int, i: int) -> Row:
        j, s = self.judged[m], self.judged[m].simulation
        p = {"p": self.parameters[i].tolist()} if self.ocp.np else {}
        return {"method": j.name, "state": i, "x0": self.x0[i].tolist(), **p, "success": bool(s.success[i]),
                "feasible": bool(self.feasible[m, i]), "message": s.message[i], "cost": float(self.cost[m, i]),
                "gap": float(self.gap[m, i]), "best_cost": float(self.best[i]), "best_method": self.best_method[i],
                "missed": float(self.missed[m, i]), "base_cost": math.nan if self.base is None else float(self.base[i]),
                "predicted_cost": float(j.predicted[i]), "running_cost": float(s.running_cost[i]),
                "terminal_cost": float(s.terminal_cost[i]), "terminal_error": float(s.terminal_error[i]),
                "x_end": s.x[i, -1].tolist(), "error": self.ocp.from_goal(s.x[i, -1], self.parameters[i]).tolist(),
                "control_magnitude": float(s.control_magnitude[i]),
                "saturation": float(s.saturation[i]), "clearance": float(s.clearance[i]),
                "fallbacks": float(s.fallbacks[i]), "lost": float(s.lost[i]),
                "reached": bool(s.reached[i]), "violation": float(s.violation[i]), "counted": bool(self.counted[i]),
                "ms_first": float(j.ms_first[i]), "solves": int(j.solves[i]),
                "ms_per_control": float(j.ms_per_control[i]), "evaluations": float(j.evaluations[i])}

    def _summarize(self, m: int) -> Row:
        j, s, c = self.judged[m], self.judged[m].simulation, self.counted
        ok, gap, missed = self.feasible[m], self.gap[m, c], self.missed[m, c & self.gainful]
        return {"method": j.name, "how": j.how, "n": int(c.sum()), "failures": int((c & ~ok).sum()),
                "violations": int((c & j.violates).sum()), "violates": self.violations(m),
                "impossible": int((~c).sum()),
                "cost_mean": mean(s.cost[ok]),
                "cost_median": float(np.median(self.cost[m, c])) if c.any() else math.nan,
                "predicted_mean": mean(j.predicted[ok]),
                "gap_median": percentile(gap, 50), "gap_p95": percentile(gap, 95),
                "missed_median": percentile(missed, 50), "missed_p95": percentile(missed, 95),
                "missed_n": len(missed),
                "within_1": 100 * mean(self.within(1)[m, c]), "within_5": 100 * mean(self.within(5)[m, c]),
                "found_best": self.best_method.count(j.name),
                "terminal_error_mean": mean(s.terminal_error[ok]),
                "terminal_error_sd": float(s.terminal_error[ok].std()) if ok.any() else math.nan,
                "control_magnitude": mean(s.control_magnitude[ok]), "saturation": mean(s.saturation[ok]),
                "clearance_min": float(np.min(s.clearance[c & s.reached], initial=math.inf)),
                "ms_first": mean(j.ms_first[c]), "solves": mean(j.solves[c]), "ms_per_solve": mean(_each_answer(j)[c]),
                "ms_per_control": mean(j.ms_per_control[c])}


def _each_answer(judged: Judged) -> Array:
    """[B], milliseconds for one answer: a control of a controller's, or one of the solves of a solver."""
    feedback = ~np.isnan(judged.ms_per_control)
    return np.where(feedback, judged.ms_per_control, judged.ms_first / judged.solves)


def mean(values: Array) -> float:
    """Of what is no NaN; NaN of nothing."""
    known = values[~np.isnan(values)]
    return float(known.mean()) if known.size else math.nan


# label, key(s) that the cell is made of, how it is written
COLUMNS: tuple[tuple[str, str, str], ...] = (
    ("method", "method", "text"), ("failed", "failures", "count"), ("mean cost", "cost_mean", "number"),
    ("predicted", "predicted_mean", "number"),
    ("median gap %", "gap_median", "percent"), ("p95 gap %", "gap_p95", "percent"),
    ("missed %", "missed_median", "known"),
    ("within 1 %", "within_1", "share"), ("within 5 %", "within_5", "share"),
    ("terminal error %", "terminal_error", "spread"), ("mean |u|", "control_magnitude", "number"),
    ("ms", "ms_per_solve", "number"),
    ("solves", "solves", "number"))
NOTE = (
    "Judged on the exact f under CVODES, in discrete time by its own steps. Gap: to the best known cost of the same "
    "initial state, over all methods here and simple baselines.",
    "ms: one evaluation of a controller, or one solve; a solver that tried several starts took so many solves a state.",
    "Mean costs, error and |u| are over the runs that did not fail; predicted is what the method itself expected.",
    "Terminal error: the largest distance of a state from the goal, in per cent of half the width of that state's box.")
VIOLATES = ("violates", "violates", "text")  # the column that stands where there is something in it


def columns(rows: Sequence[Row]) -> tuple[tuple[str, str, str], ...]:
    """Of a table of summary rows."""
    told = any(row["violates"] for row in rows)
    return (*COLUMNS[:2], VIOLATES, *COLUMNS[2:]) if told else COLUMNS


def cells(row: Row, of: Sequence[tuple[str, str, str]] = COLUMNS) -> list[str]:
    """A summary row as text, one cell a column."""
    return [_cell(row, key, form) for _, key, form in of]


def notes(report: Results) -> list[str]:
    """What the numbers of the summary are, in sentences."""
    n, c = int(report.counted.sum()), report.counted
    if report.ocp.is_free:
        share = report.settings.get("tolerance", 0)
        ends = [] if not report.ocp.held_at_end else [
            "Feedback ends as soon as all terminal constraints hold within the tolerance, a share of "
            f"{share:g} of their scales, and so does the reference; other plans end where they hold exactly, and cost "
            "more: part of their gap is that."]
        return [*NOTE, *ends]
    if report.base is None:
        return [*NOTE]
    known = int((c & np.isfinite(report.base)).sum())
    said = ["Missed: the excess over the best known cost, in per cent of what can be gained over simple baselines (a "
            "control that is held, at u*, at the middle of U or at 0, and LQR's); median."]
    if known < n:
        said.append(f"From {n - known} of {count(n, 'state')} no such baseline reaches the horizon and holds all "
                    "constraints: there the gap to the best known cost alone is given.")
    return [*NOTE, *said, *_none_better(report, n)]


def _none_better(report: Results, n: int) -> list[str]:
    """Where simple baselines are the best known: as good as a method, or better than all."""
    base, least = report.base, report.cost.min(axis=0)
    assert base is not None
    with np.errstate(invalid="ignore"):
        best = report.counted & (base <= report.best)
        equal = best & (per_cent(least - base, base, usual_sizes(report.ocp).cost) <= ALIKE)
    said = []
    if equal.any():
        said.append(f"On {int(equal.sum())} of {count(n, 'state')} such a baseline is as good as the best method.")
    if (best & ~equal).any():
        said.append(f"On {int((best & ~equal).sum())} of {count(n, 'state')} no method costs as little as such a "
                    "baseline, whose cost is the best known there, and may be far from the optimum.")
    return said


def _cell(row: Row, key: str, form: str) -> str:
    match form:
        case "text" | "count":
            return str(row[key])
        case "share":
            return f"{row[key]:.0f} %" if row[key] in (0, 100) else f"{row[key]:.1f} %"
        case "percent":
            return percent(row[key])
        case "known":
            return "-" if math.isnan(row[key]) else percent(row[key])
        case "spread":
            return f"{number(100 * row[key + '_mean'])} ± {number(100 * row[key + '_sd'])}"
    return number(row[key])


def number(value: float) -> str:
    """Three or four digits, '-' for NaN."""
    if math.isnan(value):
        return "-"
    return f"{value:.3g}" if abs(value) < 1e-3 or abs(value) >= 1e4 else f"{value:.4g}"


def percent(value: float) -> str:
    """A gap with the digits that matter, without its sign of per cent."""
    if not math.isfinite(value):
        return "failed"
    return f"{value:.0f}" if abs(value) >= 100 else f"{value:.1f}" if abs(value) >= 10 else f"{value:.2f}"


def text_table(head: Sequence[str], body: Iterable[Sequence[str]]) -> str:
    """A table in plain text: the first column to the left, numbers to the right."""
    lines = [list(head), *map(list, body)]
    widths = [max(len(line[c]) for line in lines) for c in range(len(head))]
    text = ["  ".join(cell.ljust(w) if c == 0 else cell.rjust(w)
                      for c, (cell, w) in enumerate(zip(line, widths, strict=True))).rstrip() for line in lines]
    return "\n".join([text[0], "  ".join("-" * w for w in widths), *text[1:]])


def count(k: int, what: str) -> str:
    """Like '1 interval' or '2 intervals'."""
    return f"{k} {what}" + ("" if k == 1 else "s")


def flat_rows(report: Results) -> list[Row]:
    """The rows with one column a coordinate: x0 as x0_NAME, p as p_NAME, x_end as end_NAME, x_end - x* as error_NAME.
    """
    names, flat = report.ocp.system.state_names, list[Row]()
    of = {"x0": ("x0", names), "p": ("p", report.ocp.parameter_names), "x_end": ("end", names),
          "error": ("error", names)}
    for row in report.rows():
        for key, (short, columns) in of.items():
            row |= {f"{short}_{name}": v for name, v in zip(columns, row.pop(key, ()), strict=True)}
        flat.append(row)
    return flat


def csv_text(rows: Sequence[Row]) -> str:
    """Rows as CSV; numbers in full, so that they come back bit by bit."""
    file = io.StringIO()
    writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return file.getvalue()
