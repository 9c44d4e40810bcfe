"""compare: any methods on the same initial states, one judge, one row a method and initial state. B is the batch.

Fair by construction: every method gets the same states, and its controls are run on the exact f under CVODES with the
cost as an extra state (nocl.simulate), whatever model, grid or integrator it used itself. `methods.py` has what a
method may be, `judging.py` how its runs are spread over processes.
"""

from __future__ import annotations

import os
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from nocl.comparisons.baselines import base_cost
from nocl.comparisons.each import Laws
from nocl.comparisons.judging import Disturbance, Judgement, Judging, judge
from nocl.comparisons.methods import MethodRun, Rates, Solving, Starts, Value, checked, is_count, rates_of, runs_of
from nocl.comparisons.possible import impossible
from nocl.comparisons.report.report import Report
from nocl.comparisons.report.results import Judged
from nocl.definition.constraints import TOLERANCE
from nocl.definition.ocp import OCP
from nocl.support import checks
from nocl.support.checks import Array
from nocl.support.pool import Pool


def compare(ocp: OCP, methods: Mapping[str, Any], n: int = 100, x0: ArrayLike | None = None, seed: int = 1,
            hold: int | Sequence[int | None] | None = None, workers: int | str = 1,
            out: str | os.PathLike[str] | None = None, progress: bool | None = None, p: Any = None,
            tolerance: float = TOLERANCE) -> Report:
    """Judge `methods` (by name) on the same initial states: x0 [nx] or [B, nx], else n drawn with `seed`.

    On a problem with parameters each state has its own p, drawn with `seed` too. Methods that know no p are made anew
    at each by nocl.comparisons.at_each.

    Parameters
    ----------
    p : parameters, [np] for all states, [B, np], or by name (OCP.parameters_of); default: drawn, where states are
    hold : rates of feedback: None, continuous; K, continuous and once more held on K intervals, as the method
        "NAME (K holds)"; a list of these, [None, 80, 400], each. In discrete time None: feedback is asked at every
        sample
    workers : 1, a number of processes, or "auto": processes where the measured cost of the first parts says that they
        pay; or a Dask scheduler's "tcp://...". Solvers that take `workers` get it too
    out : a folder that gets each part's outcome as soon as it is there: the same call resumes what is there. A plain
        callable is known by its name: another one of that name needs another folder
    progress : what is done and left on stderr: bars on a terminal, else a line every 10 s; default: True
    tolerance : a run that violates a constraint by more than this share of its scale has failed

    Nothing is dropped: where a method raises, does not converge or blows up, its row says so. Milliseconds: a solver's
    own `seconds` for that state (the whole control trajectory; without them, its wall time over the number of states);
    for a controller the median time of one control evaluation there; for NMPC's loop those of its own solves.

    Where no method holds the constraints from a state, DDP is asked whether a plan does; a state from which none was
    found is told apart, and counts in no row.

    Raises ValueError for methods that are none, or are made for another problem.
    """
    checks.problem(ocp, "compare", discrete=True)
    checks.whole(seed, "seed", "compare", most=2**63)
    Pool(workers)  # refuses what is none before anything is solved
    states = starts_of(ocp, n, x0, seed, p)
    rates, folder = rates_of(hold, ocp.steps), None if out is None else Path(out)
    most, start = checks.number(tolerance, "tolerance", "compare"), time.perf_counter()
    solving = Solving(workers, folder, progress)
    judged = judged_runs(ocp, methods, states, rates, solving, most)
    solved = np.any([j.feasible for j in judged], axis=0)
    why = impossible(ocp, states, solved, [j.simulation.u[:, :-1] for j in judged],
                     [j.simulation.times[:, -1] for j in judged], most, solving)
    base = base_cost(ocp, states, most, solving)
    drawn = f"drawn with seed {seed}"
    settings: dict[str, Any] = {"seed": seed if x0 is None and p is None else None, "n": len(states),
                                "hold": ", ".join("continuous" if rate is None else str(rate) for rate in rates),
                                "initial states": "given" if x0 is not None else drawn}
    if ocp.np:
        settings["parameters"] = "given" if p is not None else drawn
    if len(ocp.constraint_names):
        settings["tolerance"] = most
    return Report(ocp, states.x, judged, settings, time.perf_counter() - start, states.p, base=base, impossible=why)


def judged_runs(ocp: OCP, methods: Mapping[str, Any], states: Starts, rates: Rates, solving: Solving,
                tolerance: float) -> tuple[Judged, ...]:
    """The methods' runs, as the judge sees them."""
    runs = runs_of(ocp, checked(methods), states, rates, solving)
    job = Judging(ocp, states, runs, Disturbance(), [0.0] * len(runs), tolerance=tolerance)
    folder = None if solving.out is None else solving.out / "judged"
    judgements = judge(job, solving.workers, folder, solving.progress, "judging")
    return tuple(_judged(ocp, run, judgement, states) for run, judgement in zip(runs, judgements, strict=True))


def starts_of(ocp: OCP, n: int, x0: ArrayLike | None, seed: int, p: Any) -> Starts:
    """The states and parameters that are meant."""
    if x0 is None:
        if not is_count(n):
            raise ValueError(f"n is {checks.shown(n)}; expected a number of initial states >= 1")
        drawn = Starts.drawn(ocp, int(n), seed)
        owner = f"compare, with n = {n} states drawn (n or x0 has other ones)"
        return drawn if p is None else Starts(drawn.x, ocp.parameters_of(p, len(drawn), owner))
    rows = checks.states(x0, ocp.system.nx, ocp.system.name)[0].copy()
    if not len(rows):
        raise ValueError("x0 has no rows; expected at least one initial state")
    return Starts(rows, ocp.parameters_of(p, len(rows), "compare"))


def _judged(ocp: OCP, run: MethodRun, judgement: Judgement, starts: Starts) -> Judged:
    s, solved = judgement.simulation, run.solved
    solves = np.ones(len(starts)) if solved is None else solved.solves
    predicted = _predicted(ocp, run.method, starts) if solved is None else solved.predicted
    return Judged(run.name, run.how, s, judgement.ms_first, judgement.ms_per_control, judgement.evaluations, solves,
                  predicted, None if solved is None else solved.plan, _value(ocp, run.method, predicted), run.held)


def _value(ocp: OCP, method: Any, predicted: Array) -> Any:
    """The method's own value function, which the report draws slices of, where it answers."""
    return Value(ocp, method) if hasattr(method, "value") and np.isfinite(predicted).any() else None


def _predicted(ocp: OCP, method: Any, starts: Starts) -> Array:
    """The cost that the method itself expects, V(x0, 0[, p]), where it has a value function; else NaN."""
    if isinstance(method, Laws):
        return np.concatenate([_predicted_at(method, x, p) for x, p in zip(starts.x, starts.p, strict=True)])
    if hasattr(method, "value"):
        try:
            values = np.asarray(method.value(starts.x, 0.0, *starts.given(ocp, method)), dtype=np.float64).ravel()
        except Exception:  # a prediction that cannot be had is no failure of the controller
            values = np.empty(0)
        if len(values) == len(starts):
            return values
    return np.full(len(starts), np.nan)


def _predicted_at(laws: Laws, x0: Array, p: Array) -> Array:
    try:
        ocp, law, _ = laws.at(p)
    except Exception:  # the judge's row says what it raised
        return np.full(1, np.nan)
    return _predicted(ocp, law, Starts(x0[None], np.zeros((1, 0))))
