"""The four problems, with exact and with learned dynamics: CND, NMPC and LQR per initial state, as numbers.

    python benchmarks/compare.py [PROBLEM ...] [--n 200] [--robust] [--workers auto] [--reports DIR]

The controllers are those that come with nocl (trained on the exact f, and on a learned one), NMPC solves the exact
problem with its default starts, LQR stands about the goal; all are judged by CVODES on the exact f, from the same
initial states, that training did not see. The summaries go to benchmarks/results/compare.json and compare.md; a call
for some problems keeps the rows of the others. Whole reports go to DIR.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parent))
import provenance

import nocl
from nocl import solvers
from nocl.comparisons import Report, study
from nocl.comparisons.disturbances import mass_variants

PROBLEMS = ("cartpole", "acrobot", "quadrotor", "dubins")
NAME = "compare"
CONTINUOUS, LEARNED = "CND", "CND, learned f"


def compared(problem: str, n: int, seed: int, robust: bool, workers: int | str) -> Report:
    """One problem's study: both controllers, NMPC and LQR."""
    ocp = nocl.load_ocp(problem)
    methods = {CONTINUOUS: nocl.pretrained(problem), LEARNED: nocl.pretrained(problem, "learned"),
               "NMPC": solvers.NMPC(ocp), **lqr(ocp)}
    return study(ocp, methods, n=n, seed=seed, robust=robust, variants=mass_variants(ocp) if robust else None,
                 workers=workers)


def lqr(ocp: nocl.OCP) -> dict[str, Any]:
    """LQR where the goal pair is an equilibrium; at dubins's, a car that stands, its linear model cannot steer."""
    try:
        law = solvers.LQR(ocp)
        law.P(0.0)
    except ValueError:
        return {}
    return {"LQR": law}


def row(problem: str, report: Report, seconds: float) -> dict[str, Any]:
    """What is kept of a report: no arrays over states."""
    return {"problem": problem, "n": len(report.x0), "seed": report.settings["seed"], "seconds": round(seconds, 1),
            "verdict": report.verdict(), "summary": list(report.summary()),
            "promises": [str(p) for p in report.promises], "audits": [a.summary() for a in report.audits],
            "stability": [{k: v for k, v in s.summary().items() if k != "eigenvalues_first_point"}
                          for s in report.stability],
            "robustness": [] if report.robustness is None else report.robustness.summary(),
            "regions": [r.summary() for r in report.regions]}


def plain(value: Any) -> Any:
    """JSON data with four digits; inf and NaN as text."""
    if isinstance(value, dict):
        return {key: plain(one) for key, one in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(one) for one in value]
    if isinstance(value, float):
        return float(f"{value:.4g}") if abs(value) < float("inf") else str(value)
    return value


def markdown(rows: list[dict[str, Any]]) -> str:
    """The table of all problems."""
    lines = ["| problem | method | failed | mean cost | median gap % | p95 gap % | within 1 % | within 5 % | "
             "ms per answer |", "| --- |" + " --- |" * 8]
    keys = ("cost_mean", "gap_median", "gap_p95", "within_1", "within_5", "ms_per_solve")
    for one in rows:
        for s in one["summary"]:
            cells = [one["problem"], s["method"], f"{s['failures']} of {one['n']}", *(str(s[key]) for key in keys)]
            lines.append("| " + " | ".join(cells) + " |")
    said = [f"- {one['problem']}: {text}" for one in rows for text in (*one["verdict"], *one["promises"])]
    return "\n".join([*lines, "", *said, ""])


def kept() -> dict[str, Any]:
    """Rows of former calls, by problem."""
    path = provenance.RESULTS / f"{NAME}.json"
    return {one["problem"]: one for one in json.loads(path.read_text())["rows"]} if path.exists() else {}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("problems", nargs="*", default=list(PROBLEMS))
    parser.add_argument("--n", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--robust", action="store_true")
    parser.add_argument("--workers", default="auto")
    parser.add_argument("--reports", type=Path)
    options = parser.parse_args()
    workers = int(options.workers) if options.workers.isdecimal() else options.workers
    for problem in options.problems:
        start = time.perf_counter()
        report = compared(problem, options.n, options.seed, options.robust, workers)
        seconds = time.perf_counter() - start
        print(f"{report}\n{seconds:.0f} s\n", flush=True)
        if options.reports:
            report.save(options.reports / problem)
        rows = kept() | {problem: plain(row(problem, report, seconds)) | {"made": provenance.made()}}
        ordered = [rows[name] for name in (*PROBLEMS, *(set(rows) - set(PROBLEMS))) if name in rows]
        provenance.write(NAME, ordered)
        (provenance.RESULTS / f"{NAME}.md").write_text(markdown(ordered))


if __name__ == "__main__":
    main()
