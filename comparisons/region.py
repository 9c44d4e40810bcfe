"""The region of initial states where a controller works, mapped by growing their distribution until it fails."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from nocl.comparisons.promise import interval
from nocl.comparisons.reference import Reference
from nocl.comparisons.report.findings import Region, per_cent
from nocl.definition.constraints import TOLERANCE
from nocl.definition.ocp import OCP
from nocl.definition.sampling import Distribution, Gaussian, Uniform, own_numbers
from nocl.definition.scales import usual_sizes
from nocl.judge.simulation import simulate
from nocl.solvers.ddp.global_search import solve_globally
from nocl.solvers.ddp.solver import DDP
from nocl.support.checks import Array
from nocl.support.progress import bar as progress_bar

SCALES = (0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 8.0, 12.0, 16.0, 24.0)
HELD = 80  # intervals of the optimum that successes are measured by
STARTS = 6  # cold starts of that optimum for each state


def region(ocp: OCP, name: str, method: Any, scales: Sequence[float] = SCALES, n: int = 50, within: float = 5.0,
           confidence: float = 0.95, seed: int = 2, progress: bool | None = None,
           tolerance: float = TOLERANCE) -> Region:
    """The share of n states that succeed at each scale of the distribution's spread, until more than half fail.

    With parameters each state has its own, drawn from where they lie: their distribution does not grow.

    A run succeeds that reaches the horizon, violates nothing and costs at most `within` per cent more than the best
    known: its own, or DDP's from cold starts, neighbours and the run itself. Every scale has the same draws, farther
    out. Farther out there may be states from which no plan holds the constraints: nobody succeeds there.
    """
    ocp.refuse_free("region")
    ocp.system.refuse_discrete("region")
    if not scales or min(scales) <= 0 or list(scales) != sorted(set(scales)):
        raise ValueError(f"scales is {scales!r}; expected rising numbers > 0, like (0.5, 1, 2)")
    states, good, p = list[Array](), list[Array](), ocp.sample_parameters(n, own_numbers(seed, 0, 1))
    with progress_bar(len(scales), f"region of {name}", progress, unit="scale", leave=False) as bar:
        for scale in scales:
            states.append(grown(ocp.initial_states, scale).sample(n, seed))
            good.append(succeeds(ocp, method, states[-1], within, p, tolerance))
            bar.update()
            if good[-1].mean() < 0.5:
                break
    k = np.array([g.sum() for g in good], dtype=np.int64)
    bounds = np.array([interval(int(one), n, confidence) for one in k])
    return Region(name, within, confidence, np.array(scales[: len(k)], dtype=np.float64), k, n, bounds[:, 0],
                  bounds[:, 1], np.array(states), np.array(good, dtype=bool), p)


def grown(distribution: Distribution, scale: float) -> Distribution:
    """The same centre, `scale` times the spread."""
    if isinstance(distribution, Gaussian):
        return Gaussian(distribution.mean, scale * np.asarray(distribution.std))
    centre = distribution.centre
    lb, ub = np.asarray(distribution.lb), np.asarray(distribution.ub)
    return Uniform(centre + scale * (lb - centre), centre + scale * (ub - centre))


def succeeds(ocp: OCP, method: Any, x0: Array, within: float, values: Array, tolerance: float) -> Array:
    """[B] bool, of states with parameters values [B, np]. A state that violates a constraint itself, or that nobody
    solves, is no success."""
    p = values if ocp.np else None
    run = simulate(ocp, method, x0, p=p, tolerance=tolerance)
    own = simulate(ocp, method, x0, hold=HELD, p=p).u[:, :-1]
    cold = solve_globally(DDP(ocp, intervals=HELD), x0, p=p, starts=STARTS, seed=0, workers=1, progress=False).u
    rival = Reference(ocp, HELD, [own, cold]).solve(x0, p)
    judged = simulate(ocp, rival.u, x0, p=p, tolerance=tolerance)
    best = np.minimum(run.cost, np.where(rival.success & judged.success, judged.cost, np.inf))
    with np.errstate(invalid="ignore"):
        return np.asarray(run.success & (per_cent(run.cost - best, best, usual_sizes(ocp).cost) <= within))
