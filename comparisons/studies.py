"""study: compare, and everything that stands beside costs in a report, with no code of the user's."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from numpy.typing import ArrayLike

from nocl.comparisons.audit import audit
from nocl.comparisons.comparison import compare
from nocl.comparisons.disturbances import Disturbances, robustness
from nocl.comparisons.promise import promises
from nocl.comparisons.reference import NAME, Reference
from nocl.comparisons.region import region
from nocl.comparisons.report.report import Report
from nocl.comparisons.stability import stability
from nocl.judge import policy_function
from nocl.ocp import OCP

FINE = 320  # intervals of the reference
ROBUST = 20  # initial states that disturbances are tried on


def study(ocp: OCP, methods: Mapping[str, Any], n: int = 200, x0: ArrayLike | None = None, seed: int = 1,
          hold: int | Sequence[int | None] | None = None, model: Any = None, robust: bool = False,
          variants: Mapping[str, Any] | None = None, disturbances: Disturbances | None = None,
          workers: int | str = "auto", out: str | os.PathLike[str] | None = None,
          progress: bool | None = None, p: Any = None) -> Report:
    """Everything about `methods`: compare's rows with a reference beside them, audits, promises, stability.

    Parameters
    ----------
    ocp, methods, n, x0, seed, hold, workers, out, progress, p : as compare has them
    model : the learned dynamics that the controls were made on, for the audits' rollouts
    robust : also the disturbances, on the first ROBUST states (NMPC in closed loop beside its plans), and the region
        of initial states where each feedback law works
    variants, disturbances : of robustness

    The reference is DDP's on FINE intervals, from what each method found; it is judged like the others. With `out`
    solves and judged runs are kept; the reference, audits, optima under disturbances and regions are found anew.
    """
    ocp.refuse_constraints("study")
    folder = None if out is None else Path(out)
    report = compare(ocp, methods, n, x0, seed, hold, workers, None if folder is None else folder / "compare", progress,
                     p)
    report = with_reference(report, FINE, workers, progress)
    report = replace(report, audits=audit(report, methods, model), promises=promises(report),
                     stability=stability(report, methods))
    if not robust:
        return report
    found = robustness(ocp, with_loops(methods), report.x0[:ROBUST], variants, disturbances, workers,
                       None if folder is None else folder / "robustness", progress,
                       report.p[:ROBUST] if ocp.np else None)
    laws = {name: method for name, method in methods.items() if policy_function(ocp, method) is not None}
    regions = tuple(region(ocp, name, law, progress=progress) for name, law in laws.items())
    return replace(report, robustness=found, regions=regions)


def with_reference(report: Report, intervals: int, workers: int | str = 1, progress: bool | None = None) -> Report:
    """The report with the reference as its last method, from the controls of all that are there."""
    guesses = [j.simulation.u[:, :-1] for j in report.judged]
    found = compare(report.ocp, {NAME: Reference(report.ocp, intervals, guesses)}, x0=report.x0, workers=workers,
                    progress=progress, p=report.p if report.ocp.np else None)
    return replace(report, judged=(*report.judged, *found.judged), seconds=report.seconds + found.seconds)


def with_loops(methods: Mapping[str, Any]) -> dict[str, Any]:
    """The methods, and beside each solver that has a closed loop (NMPC) that loop."""
    both: dict[str, Any] = {}
    for name, method in methods.items():
        both[name] = method
        if hasattr(method, "solve") and hasattr(method, "controller"):
            both[f"{name} closed loop"] = method.controller()
    return both
