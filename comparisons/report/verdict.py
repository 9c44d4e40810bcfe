"""What a comparison's numbers say, in sentences."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from nocl.comparisons.report.findings import per_cent
from nocl.comparisons.report.results import (
    REFERENCE,
    Judged,
    Results,
    Row,
    count,
    mean,
    number,
    percent,
)

UNSTABLE = 0.05  # a plan that costs more than predicted by this share, in the median, is said to lack feedback


def verdict(report: Results) -> list[str]:
    """Who is how near to the best known cost; how fast; what failed."""
    summary, n = report.summary(), int(report.counted.sum())
    open_loop = [said for j in report.judged for said in _without_feedback(j)]
    return [*_near(report, summary), *_left_out(report), *_manners(summary), *open_loop, *_speed(summary),
            *_failures(summary, n)]


def _near(report: Results, summary: Sequence[Row]) -> list[str]:
    """Who is within 5 % of the best known cost; a method with all the answers is the best known by itself."""
    n, answers = int(report.counted.sum()), report.feasible.sum(axis=1)
    if not n:
        return []
    if np.count_nonzero(answers) == 1:
        m, cheaper = int(answers.argmax()), int((report.beaten & report.counted).sum())
        beside = f"simple baselines cost less on {cheaper} of {n}" if cheaper else \
            "there is nothing to compare its cost with"
        return [f"Only {summary[m]['method']} has answers that count, on {_share(100 * answers[m] / n, n)} initial "
                f"states: {beside}."]
    near = [f"{row['method']} on {_share(row['within_5'], n)}{_gap_text(row)}" for row in summary]
    return [f"Within 5 % of the best known cost of {count(n, 'initial state')}: " + ", ".join(near) + "."]


def _left_out(report: Results) -> list[str]:
    """States from which no plan holds the constraints, the first of them with the reason."""
    out = np.flatnonzero(~report.counted)
    if not out.size:
        return []
    return [f"Left out of all numbers: {len(out)} of {count(len(report.x0), 'initial state')}, from which no plan was "
            f"found that holds the constraints (state {out[0]}: {report.impossible[out[0]]})."]


def _without_feedback(judged: Judged) -> list[str]:
    """Plans that cost more than they predict, in the median: without feedback errors grow, most where f is unstable."""
    known = np.asarray(judged.simulation.success, dtype=bool) & np.isfinite(judged.predicted)
    cost, predicted = judged.simulation.cost[known], judged.predicted[known]
    excess = per_cent(cost - predicted, predicted)
    if judged.plan is None or not known.any() or np.median(excess) <= 100 * UNSTABLE:
        return []
    return [f"{judged.name}'s plans predict a cost of {number(mean(predicted))} on average; run open loop on the "
            f"exact f they cost {number(mean(cost))}: what is missing there is feedback, or a finer grid or model, "
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


def _speed(summary: Sequence[Row]) -> list[str]:
    """The fastest and the slowest of the useful methods; CND and NMPC, where both are there."""
    useful = [row for row in summary if row["within_5"] > 0 and row["ms_per_solve"] > 0 and row["method"] != REFERENCE]
    pair = [row for row in useful if row["method"] in ("CND", "CND on f_theta", "NMPC")]
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
    stopped = {row["method"]: row["failures"] - row["violations"] for row in summary}
    parts = [f"{method} failed on {k} of {n}" for method, k in stopped.items() if k]
    parts += [f"{row['method']} violates {row['violates']}" for row in summary if row["violates"]]
    if parts:
        return ["; ".join(parts) + "."]
    held = any(math.isfinite(row["clearance_min"]) for row in summary)
    return (["No run failed, and no constraint was violated." if held else "No run failed."]) if n else []
