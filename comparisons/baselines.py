"""What anyone gets without optimisation: the yardstick of what there is to gain. B is the batch."""

from __future__ import annotations

import warnings

import casadi as ca
import numpy as np

from nocl.comparisons.judging import Disturbance, Judging, judge
from nocl.comparisons.methods import Solving, Starts, runs_of
from nocl.definition.ocp import OCP
from nocl.solvers.lqr import LQR
from nocl.support.checks import Array


def base_cost(ocp: OCP, starts: Starts, tolerance: float, solving: Solving) -> Array:
    """[B], the least cost of simple baselines that reach the horizon with all constraints held; NaN where none does.

    They are a control that is held throughout, at u*, at the middle of U and at 0, and LQR, clipped to U, where the
    goal has one. None of them ends by itself: of a free horizon nothing is known.
    """
    if ocp.is_free:
        return np.full(len(starts), np.nan)
    laws = {f"baseline {number}": law for number, law in enumerate(_laws(ocp), 1)}
    runs = runs_of(ocp, laws, starts, (None,), solving)
    job = Judging(ocp, starts, runs, Disturbance(), [0.0] * len(runs), timed=False, tolerance=tolerance)
    folder = None if solving.out is None else solving.out / "baselines"
    judged = [of.simulation for of in judge(job, solving.workers, folder, solving.progress, "simple baselines")]
    least = np.min([np.where(run.success, run.cost, np.inf) for run in judged], axis=0)
    return np.where(np.isfinite(least), least, np.nan)


def _laws(ocp: OCP) -> list[ca.Function]:
    """Policies (x, t[, p]) -> u, different ones."""
    s, at = ocp.system, ocp.functions.feedback(ca.MX)
    held = {tuple(np.clip(u, s.lbu, s.ubu)) for u in ((s.lbu + s.ubu) / 2, np.zeros(s.nu))}
    if not ocp.goal_varies:
        held.add(tuple(ocp.u_goal))
    laws = [at.function("held", {"u": ca.MX(ca.DM(u))}) for u in sorted(held)]
    if ocp.goal_varies:
        laws.append(at.function("held", {"u": ocp.goal(at["p"])[1]}))
    return laws + _lqr(ocp)


def _lqr(ocp: OCP) -> list[ca.Function]:
    """LQR about the goal, at the nominal parameters; constraints are no matter of its own."""
    try:
        with warnings.catch_warnings():  # of its kinks the problem itself has warned
            warnings.simplefilter("ignore")
            one = ocp.folded(ocp.nominal)
            return [LQR(one.unconstrained if one.constraint_names else one).to_casadi()]
    except ValueError:  # the goal pair is no equilibrium, L is not convex there, or the problem holds the time
        return []
