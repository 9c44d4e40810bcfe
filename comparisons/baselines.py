"""What anyone gets without optimisation: the yardstick of what there is to gain. B is the batch."""

from __future__ import annotations

import warnings

import casadi as ca
import numpy as np

from nocl.comparisons.methods import Starts
from nocl.judge import simulate
from nocl.ocp import OCP
from nocl.solvers.lqr import LQR
from nocl.support.checks import Array


def base_cost(ocp: OCP, starts: Starts, tolerance: float) -> Array:
    """[B], the least cost of simple baselines that reach the horizon with all constraints held; NaN where none does.

    They are a control that is held throughout, at u*, at the middle of U and at 0, and LQR, clipped to U, where the
    goal has one.
    """
    p = starts.p if ocp.np else None
    runs = [simulate(ocp, law, starts.x, p=p, tolerance=tolerance) for law in _laws(ocp)]
    least = np.min([np.where(run.success, run.cost, np.inf) for run in runs], axis=0)
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
