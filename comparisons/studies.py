"""study: compare, and everything that stands beside costs in a report, with no code of the user's."""

from __future__ import annotations

import os
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from numpy.typing import ArrayLike

from nocl.comparisons.audit import audit
from nocl.comparisons.comparison import compare, judged_runs
from nocl.comparisons.disturbances import Disturbances, robustness
from nocl.comparisons.methods import Solving, Starts
from nocl.comparisons.promise import promises
from nocl.comparisons.reference import NAME, Reference
from nocl.comparisons.region import region
from nocl.comparisons.report.report import Report
from nocl.comparisons.stability import stability
from nocl.definition.constraints import TOLERANCE
from nocl.definition.ocp import OCP
from nocl.judge.laws import policy_function
from nocl.support import checks

FINE = 320  # intervals of the reference
ROBUST = 20  # initial states that disturbances are tried on


def study(ocp: OCP, methods: Mapping[str, Any], n: int = 200, x0: ArrayLike | None = None, seed: int = 1,
          hold: int | Sequence[int | None] | None = None, model: Any = None, robust: bool = False,
          variants: Mapping[str, Any] | None = None, disturbances: Disturbances | None = None,
          workers: int | str = "auto", out: str | os.PathLike[str] | None = None,
          progress: bool | None = None, p: Any = None, tolerance: float = TOLERANCE) -> Report:
    """Everything about `methods`: compare's rows with a reference beside them, audits, promises, stability.

    Parameters
    ----------
    ocp, methods, n, x0, seed, hold, workers, out, progress, p, tolerance : as compare has them
    model : the learned dynamics that the controls were made on, for the audits' rollouts
    robust : also the disturbances, on the first ROBUST states (NMPC in closed loop beside its plans), and the region
        of initial states where each feedback law works
    variants, disturbances : of robustness

    The reference is DDP's on FINE intervals, from what each method found; it holds the constraints, and is judged like
    the others. Where the horizon is free, and in discrete time, there are no audits, stability and disturbances. With
    `out` solves and judged runs are kept; the reference, audits, optima under disturbances and regions are found anew.
    """
    checks.problem(ocp, "study", discrete=True)
    if robust:
        ocp.refuse_free("study(robust=True)")
        ocp.system.refuse_discrete("study(robust=True)")
    folder = None if out is None else Path(out)
    report = compare(ocp, methods, n, x0, seed, hold, workers, None if folder is None else folder / "compare", progress,
                     p, tolerance)
    report = with_reference(report, FINE, workers, progress)
    report = replace(report, promises=promises(report))
    if ocp.is_free or ocp.system.is_discrete:
        return report
    report = replace(report, audits=audit(report, methods, model), stability=stability(report, methods))
    if not robust:
        return report
    found = robustness(ocp, with_loops(methods), report.x0[:ROBUST], variants, disturbances, workers,
                       None if folder is None else folder / "robustness", progress,
                       report.p[:ROBUST] if ocp.np else None, tolerance)
    laws = {name: method for name, method in methods.items() if policy_function(ocp, method) is not None}
    regions = tuple(region(ocp, name, law, progress=progress, tolerance=tolerance) for name, law in laws.items())
    return replace(report, robustness=found, regions=regions)


def with_reference(report: Report, intervals: int, workers: int | str = 1, progress: bool | None = None) -> Report:
    """The report with the reference as its last method, from the controls of all that are there."""
    guesses = [j.simulation.u[:, :-1] for j in report.judged]
    ends = [j.simulation.times[:, -1] for j in report.judged] if report.ocp.is_free else []
    tolerance = report.settings.get("tolerance", TOLERANCE)
    reference = Reference(report.ocp, intervals, guesses, ends, tolerance)
    start, states = time.perf_counter(), Starts(report.x0, report.parameters)
    found = judged_runs(report.ocp, {NAME: reference}, states, (None,), Solving(workers, None, progress), tolerance)
    seconds = report.seconds + time.perf_counter() - start
    return replace(report, judged=(*report.judged, *found), seconds=seconds)


def with_loops(methods: Mapping[str, Any]) -> dict[str, Any]:
    """The methods, and beside each solver that has a closed loop (NMPC) that loop."""
    both: dict[str, Any] = {}
    for name, method in methods.items():
        both[name] = method
        if hasattr(method, "solve") and hasattr(method, "controller"):
            both[f"{name} closed loop"] = method.controller()
    return both
