"""How many intervals training's plans need: to hold a control costs something, and labels are made of such plans."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from nocl.data import Solution
from nocl.definition.ocp import OCP
from nocl.definition.sampling import own_numbers
from nocl.definition.substeps import USUAL, Steps
from nocl.solvers.cnd.regression.in_torch import InTorch
from nocl.solvers.cnd.validate import labels_gap, solved_again
from nocl.solvers.ddp.solver import DDP
from nocl.support.checks import Array

if TYPE_CHECKING:
    from nocl.sysid.identification import LearnedDynamics

MOST = 4  # times as many as are usual
STATES = 8  # initial states that plans are made from
WORTH = 1e-3  # of the optimum, which a plan may cost more


def intervals_for(ocp: OCP, dynamics: LearnedDynamics | None, steps: Callable[[int], Steps]) -> int:
    """USUAL intervals, or two or four times as many, while plans cost more than WORTH.

    steps : intervals -> the steps that these take
    """
    intervals = USUAL
    while intervals < MOST * USUAL and not _floor(ocp, dynamics, intervals, steps(intervals)) <= WORTH:
        intervals *= 2
    return intervals


def few_plans(ddp: DDP) -> Solution:
    """Of STATES initial states, those solutions from u* that succeed."""
    ocp = ddp.ocp
    x0, p = ocp.initial_states.sample(STATES, own_numbers(0)), ocp.sample_parameters(STATES, own_numbers(0, 2))
    found = ddp.solve(x0, p=p if ocp.np else None, progress=False)
    return found[found.success]


def _floor(ocp: OCP, dynamics: LearnedDynamics | None, intervals: int, steps: Steps) -> float:
    """The median of what plans on a grid cost more than finer ones, as feedback in continuous time; 0 where nothing
    says."""
    same = {"dynamics": dynamics, "integrator": steps.integrator, "constraints": "elastic" if ocp.is_held else "hard"}
    coarse = DDP(ocp, intervals=intervals, substeps=steps.substeps, **same)
    fine = DDP(ocp, intervals=4 * intervals, substeps=-(-steps.substeps // 4), **same)
    labels = few_plans(coarse)
    if not len(labels):
        return 0.0
    best = solved_again(fine, labels)
    labels, best = labels[best.success], best[best.success]
    if not len(best):
        return 0.0
    lost: Array = labels_gap(InTorch(ocp, dynamics, steps.integrator), labels, best, fine.substeps)
    lost = lost[~np.isnan(lost)]  # 0 / 0; what runs away when it is followed is infinitely bad
    return float(np.median(lost)) if len(lost) else 0.0
