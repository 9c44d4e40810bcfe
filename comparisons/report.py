"""Report: what a comparison found, as rows, a summary, a verdict and files. Gaps and shares are in per cent."""

from __future__ import annotations

import csv
import io
import math
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nocl.checks import Array
from nocl.ocp import OCP
from nocl.simulate import Simulation

COST_FLOOR = 1e-8  # gaps are relative to max(|best cost|, this): costs below it are the judge's rounding
REFERENCE = "reference"  # the name of a yardstick among the methods: its speed is no method's
UNSTABLE = 0.05  # a plan that costs more than predicted by this share, in the median, is said to lack feedback
VIOLATION = 1e-3  # a path constraint below minus this, in its own unit, is violated
OPEN_LOOP = "open loop"  # how a plan's control was run
WIDTH = 118  # characters of a line in the terminal
Row = dict[str, Any]
Mask = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Judged:
    """One method on all B initial states, as the judge saw it."""

    name: str
    how: str  # how its control was run
    simulation: Simulation
    ms_first: Array  # [B], milliseconds to the first control: a solve, or one evaluation of a controller
    ms_per_control: Array  # [B], milliseconds for each later control; NaN in open loop, where none is computed
    solves: Array  # [B], solves that `ms_first` went into: several starts, neighbours; 1 for a controller
    predicted: Array  # [B], the cost that the method itself expected, NaN where it has no opinion

    @property
    def feasible(self) -> Mask:
        """[B], whether the run reached the horizon with all path constraints held."""
        return np.asarray(self.simulation.success, dtype=bool) & ~(self.simulation.clearance < -VIOLATION)


class Summary(list[Row]):
    """One dict a method; printed as a table."""

    def __str__(self) -> str:
        return text_table([label for label, _, _ in COLUMNS], [cells(row) for row in self])

    __repr__ = __str__


@dataclass(frozen=True, eq=False, repr=False)
class Report:
    """Any methods on the same B initial states of a problem; `rows`, `summary` and `verdict` are read from `judged`."""

    ocp: OCP
    x0: Array  # [B, nx]
    judged: tuple[Judged, ...]
    settings: Mapping[str, Any]
    seconds: float  # wall time of the comparison

    def rows(self) -> list[Row]:
        """One dict a method and initial state; a run that failed has success False, its message, and infinite cost."""
        return [self._row(m, i) for m in range(len(self.judged)) for i in range(len(self.x0))]

    def summary(self) -> Summary:
        """One dict a method. Means are over the runs that did not fail; medians, percentiles and shares over all."""
        return Summary(self._summarize(m) for m in range(len(self.judged)))

    def verdict(self) -> list[str]:
        """What the numbers say, in a few sentences."""
        return verdict(self)

    @cached_property
    def cost(self) -> Array:
        """[methods, B] judged costs, inf where a run failed."""
        return np.array([j.simulation.cost for j in self.judged])

    @cached_property
    def feasible(self) -> Mask:
        """[methods, B]"""
        return np.array([j.feasible for j in self.judged])

    @cached_property
    def best(self) -> Array:
        """[B], the least judged cost of a run that violated nothing; NaN where there is none."""
        least = np.where(self.feasible, self.cost, np.inf).min(axis=0)
        return np.where(np.isfinite(least), least, np.nan)

    @cached_property
    def best_method(self) -> list[str]:
        """[B], who found it ("" where nobody did); the first named where two are equal."""
        who = np.where(self.feasible, self.cost, np.inf).argmin(axis=0)
        return [self.judged[m].name if math.isfinite(b) else "" for m, b in zip(who, self.best, strict=True)]

    @cached_property
    def gap(self) -> Array:
        """[methods, B], 100 (cost - best) / max(|best|, COST_FLOOR); inf where a run failed or nobody has a best."""
        gap = 100 * (self.cost - self.best) / np.maximum(np.abs(self.best), COST_FLOOR)
        return np.where(np.isnan(gap), np.inf, gap)

    def within(self, percent: float) -> Mask:
        """[methods, B], whether a run violates nothing and is within so much of the best known cost."""
        return np.asarray(self.feasible & (self.gap <= percent), dtype=bool)

    def _row(self, m: int, i: int) -> Row:
        j, s = self.judged[m], self.judged[m].simulation
        return {"method": j.name, "state": i, "x0": self.x0[i].tolist(), "success": bool(s.success[i]),
                "feasible": bool(self.feasible[m, i]), "message": s.message[i], "cost": float(s.cost[i]),
                "gap": float(self.gap[m, i]), "best_cost": float(self.best[i]), "best_method": self.best_method[i],
                "predicted_cost": float(j.predicted[i]), "running_cost": float(s.running_cost[i]),
                "terminal_cost": float(s.terminal_cost[i]), "terminal_error": float(s.terminal_error[i]),
                "x_end": s.x[i, -1].tolist(), "control_magnitude": float(s.control_magnitude[i]),
                "saturation": float(s.saturation[i]), "clearance": float(s.clearance[i]),
                "ms_first": float(j.ms_first[i]), "solves": int(j.solves[i]),
                "ms_per_control": float(j.ms_per_control[i])}

    def _summarize(self, m: int) -> Row:
        j, s, gap = self.judged[m], self.judged[m].simulation, self.gap[m]
        ok = np.asarray(s.success, dtype=bool)
        return {"method": j.name, "how": j.how, "n": len(self.x0), "failures": int((~ok).sum()),
                "violations": int((ok & ~self.feasible[m]).sum()),
                "cost_mean": _mean(s.cost[ok]), "cost_median": float(np.median(s.cost)),
                "predicted_mean": _mean(j.predicted[ok]),
                "gap_median": percentile(gap, 50), "gap_p95": percentile(gap, 95),
                "within_1": 100 * float(self.within(1).mean(axis=1)[m]),
                "within_5": 100 * float(self.within(5).mean(axis=1)[m]),
                "found_best": self.best_method.count(j.name),
                "terminal_error_mean": _mean(s.terminal_error[ok]),
                "terminal_error_sd": float(s.terminal_error[ok].std()) if ok.any() else math.nan,
                "control_magnitude": _mean(s.control_magnitude[ok]), "saturation": _mean(s.saturation[ok]),
                "clearance_min": float(np.min(s.clearance[ok], initial=math.inf)),
                "ms_first": _mean(j.ms_first), "solves": _mean(j.solves), "ms_per_solve": _mean(_each_answer(j)),
                "ms_per_control": _mean(j.ms_per_control)}

    def save(self, folder: str | Path) -> Path:
        """Write report.html, rows.csv, summary.json and figures/ into the folder, and return the path of report.html.

        A report that stands there is replaced, file by file and each atomically; other files stay.
        """
        from nocl.comparisons.files import write_report  # matplotlib is imported where pictures are drawn

        return write_report(self, Path(folder))

    def __str__(self) -> str:
        what = f"{self.ocp.system.name}, {count(len(self.x0), 'initial state')} {self.settings['initial states']}"
        said = [textwrap.fill(sentence, WIDTH, subsequent_indent="  ") for sentence in self.verdict()]
        return "\n".join([what, "", str(self.summary()), "", *NOTE, "", *said])

    __repr__ = __str__


def _each_answer(judged: Judged) -> Array:
    """[B], milliseconds for one answer: a control of a controller's, or one of the solves of a solver."""
    feedback = ~np.isnan(judged.ms_per_control)
    return np.where(feedback, judged.ms_per_control, judged.ms_first / judged.solves)


def _mean(values: Array) -> float:
    known = values[~np.isnan(values)]
    return float(known.mean()) if known.size else math.nan


def percentile(values: Array, q: float) -> float:
    """The q-th percentile; where some are inf (failures) the nearest value above, since inf cannot be interpolated."""
    return float(np.percentile(values, q, method="linear" if np.isfinite(values).all() else "higher"))


# label, key(s) that the cell is made of, how it is written
COLUMNS: tuple[tuple[str, str, str], ...] = (
    ("method", "method", "text"), ("failed", "failures", "count"), ("mean cost", "cost_mean", "number"),
    ("predicted", "predicted_mean", "number"),
    ("median gap %", "gap_median", "percent"), ("p95 gap %", "gap_p95", "percent"),
    ("within 1 %", "within_1", "share"), ("within 5 %", "within_5", "share"),
    ("terminal error", "terminal_error", "spread"), ("mean |u|", "control_magnitude", "number"),
    ("ms", "ms_per_solve", "number"),
    ("solves", "solves", "number"))
NOTE = (
    "Judged on the exact f under CVODES. Gap: to the best known cost of the same initial state, over all methods here.",
    "ms: one evaluation of a controller, or one solve; a solver that tried several starts took so many solves a state.",
    "Mean costs, error and |u| are over the runs that did not fail; predicted is what the method itself expected.")


def cells(row: Row) -> list[str]:
    """A summary row as text, one cell a column."""
    return [_cell(row, key, form) for _, key, form in COLUMNS]


def _cell(row: Row, key: str, form: str) -> str:
    match form:
        case "text" | "count":
            return str(row[key])
        case "share":
            return f"{row[key]:.0f} %" if row[key] in (0, 100) else f"{row[key]:.1f} %"
        case "percent":
            return percent(row[key])
        case "spread":
            return f"{number(row[key + '_mean'])} ± {number(row[key + '_sd'])}"
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


def verdict(report: Report) -> list[str]:
    """Who is how near to the best known cost; how fast; what failed."""
    summary = report.summary()
    n = len(report.x0)
    open_loop = [said for j in report.judged for said in _without_feedback(j)]
    return [_near(report, summary), *_manners(summary), *open_loop, *_speed(summary), *_failures(summary, n)]


def _near(report: Report, summary: Sequence[Row]) -> str:
    """Who is within 5 % of the best known cost; a method with all the answers is the best known by itself."""
    n, answers = len(report.x0), report.feasible.sum(axis=1)
    if np.count_nonzero(answers) == 1:
        m = int(answers.argmax())
        return (f"Only {summary[m]['method']} has answers that count, on {_share(100 * answers[m] / n, n)} initial "
                "states: there is nothing to compare its cost with.")
    near = [f"{row['method']} on {_share(row['within_5'], n)}{_gap_text(row)}" for row in summary]
    return f"Within 5 % of the best known cost of {count(n, 'initial state')}: " + ", ".join(near) + "."


def _without_feedback(judged: Judged) -> list[str]:
    """Plans that cost more than they predict, in the median: without feedback errors grow, most where f is unstable."""
    known = np.asarray(judged.simulation.success, dtype=bool) & np.isfinite(judged.predicted)
    cost, predicted = judged.simulation.cost[known], judged.predicted[known]
    excess = (cost - predicted) / np.maximum(np.abs(predicted), COST_FLOOR)
    if not judged.how.startswith(OPEN_LOOP) or not known.any() or np.median(excess) <= UNSTABLE:
        return []
    return [f"{judged.name}'s plans predict a cost of {number(_mean(predicted))} on average; run open loop on the "
            f"exact f they cost {number(_mean(cost))}: what is missing there is feedback, or a finer grid or model, "
            "not optimality."]


def _manners(summary: Sequence[Row]) -> list[str]:
    """How each control was run, where they differ: holding a control costs something by itself."""
    if len({row["how"] for row in summary}) < 2:
        return []
    return ["How they were run: " + "; ".join(f"{row['method']}: {row['how']}" for row in summary)
            + ". Holding a control costs something by itself."]


def _gap_text(row: Row) -> str:
    return f" (median gap {percent(row['gap_median'])} %)" if math.isfinite(row["gap_median"]) else ""


def _share(percent_of_n: float, n: int) -> str:
    k = round(percent_of_n * n / 100)
    return f"all {n}" if k == n > 1 else f"{k} of {n}"


def count(k: int, what: str) -> str:
    """Like '1 interval' or '2 intervals'."""
    return f"{k} {what}" + ("" if k == 1 else "s")


def _speed(summary: Sequence[Row]) -> list[str]:
    """The fastest and the slowest of the useful methods; CND and NMPC, where both are there."""
    useful = [row for row in summary if row["within_5"] > 0 and row["ms_per_solve"] > 0 and row["method"] != REFERENCE]
    pair = [row for row in useful if row["method"] in ("CND", "NMPC")]
    timed = sorted(pair if len(pair) == 2 else useful, key=lambda row: row["ms_per_solve"])
    if len(timed) < 2:
        return []
    fast, slow = timed[0], timed[-1]
    ratio = slow["ms_per_solve"] / fast["ms_per_solve"]
    if ratio < 1.5:
        return [f"{fast['method']} and {slow['method']} answer about equally fast."]
    times = f"{float(f'{ratio:.2g}'):,.0f}" if ratio >= 10 else f"{ratio:.1f}"
    return [f"{fast['method']} has its control in {number(fast['ms_per_solve'])} ms, {slow['method']} in "
            f"{number(slow['ms_per_solve'])} ms: {times} times faster."]


def _failures(summary: Sequence[Row], n: int) -> list[str]:
    parts = [f"{row['method']} failed on {row['failures']} of {n}" for row in summary if row["failures"]]
    parts += [f"{row['method']} violates a path constraint on {row['violations']} of {n}" for row in summary
              if row["violations"]]
    return ["; ".join(parts) + "."] if parts else ["No run failed, and no path constraint was violated."
                                                   if math.isfinite(summary[0]["clearance_min"]) else "No run failed."]


def flat_rows(report: Report) -> list[Row]:
    """The rows with one column a coordinate: x0 as x0_NAME, x_end as end_NAME."""
    names = report.ocp.system.state_names
    flat = []
    for row in report.rows():
        x0, end = row.pop("x0"), row.pop("x_end")
        flat.append(row | {f"x0_{name}": v for name, v in zip(names, x0, strict=True)}
                    | {f"end_{name}": v for name, v in zip(names, end, strict=True)})
    return flat


def csv_text(rows: Sequence[Row]) -> str:
    """Rows as CSV; numbers in full, so that they come back bit by bit."""
    file = io.StringIO()
    writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return file.getvalue()
