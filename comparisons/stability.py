"""Local stability of feedback, from the exact linearisation of the closed loop. P points.

A policy of a finite horizon is time-varying, so that frozen eigenvalues prove nothing by themselves: they are given at
the goal near the end, where the loop changes least by what is still to come, and on the best known trajectories at
mid-horizon. Beside them stands what does prove something, the transition matrix Phi(T, t) of the closed loop linearised
along its own run: a small disturbance at t has grown by ||Phi(T, t)||_2 at T, at most. LQR stands beside the goal,
the optimum's own feedback (DDP) beside mid-horizon.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import casadi as ca
import numpy as np
from scipy.integrate import solve_ivp

from nocl.comparisons.report.findings import Stability
from nocl.comparisons.report.report import Report
from nocl.comparisons.report.results import (
    REFERENCE,
)
from nocl.judge import policy_function
from nocl.ocp import OCP
from nocl.scales import usual_sizes
from nocl.solvers.ddp.solver import DDP
from nocl.solvers.lqr import LQR
from nocl.support.checks import Array

LATE, MIDDLE = 0.99, 0.5  # of the horizon
POINTS = 8  # best known trajectories that mid-horizon is looked at on
INTERVALS = 320  # of the optimum's own feedback
OPTIMUM = "optimum's own feedback"


def stability(report: Report, methods: Mapping[str, Any]) -> tuple[Stability, ...]:
    """Each method with a policy (x, t) -> u in CasADi, LQR and the optimum's feedback, at both places.

    Where the goal pair is no equilibrium, or LQR has no answer, LQR is left out; a closed loop that is not finite at a
    point leaves that method out there.
    """
    ocp = report.ocp
    policies = {name: policy for name, method in methods.items()
                if (policy := policy_function(ocp, method)) is not None}
    if "LQR" not in policies:
        policies |= _lqr(ocp)
    goal, middle = ocp.x_goal[None], _middle(report)
    places = [("goal", LATE * ocp.horizon, goal), ("mid-horizon", MIDDLE * ocp.horizon, middle)]
    found = [local(ocp, name, policy, where, t, x) for where, t, x in places if len(x)
             for name, policy in policies.items()]
    return tuple([s for s in found if s is not None] + _optimum(report))


def local(ocp: OCP, name: str, policy: ca.Function, where: str, t: float, x: Array) -> Stability | None:
    """A policy at points x [P, nx] and time t."""
    s = ocp.system
    at = ocp.functions.feedback(ca.MX)
    u = ca.fmin(ca.fmax(policy(*at.inputs), s.lbu), s.ubu)
    xdot = at.given(u=u).call(ocp.functions.f)
    loop = at.function("loop", {"xdot": xdot, "A": ca.densify(ca.jacobian(xdot, at["x"])),
                                "K": ca.densify(ca.jacobian(u, at["x"]))})
    parts = [loop(row, t) for row in x]
    A, K = (np.array([part[i].full() for part in parts]) for i in (1, 2))
    if not np.isfinite(A).all():
        return None
    growth = np.array([_growth(loop, row, t, ocp.horizon, usual_sizes(ocp).x) for row in x])
    return Stability(name, where, t, _eigenvalues(A), K, growth)


def _growth(loop: ca.Function, x: Array, t: float, T: float, size: Array) -> float:
    """||Phi(T, t)||_2 along the closed loop's own run from x at t; inf where it is lost."""
    n, sizes = len(x), np.r_[size, np.divide.outer(size, size).ravel()]  # of x and Phi

    def field(time: float, z: Array) -> Array:
        xdot, A, _ = loop(z[:n], time)
        return np.r_[xdot.full().ravel(), (A.full() @ z[n:].reshape(n, n)).ravel()]

    path = solve_ivp(field, (t, T), np.r_[x, np.eye(n).ravel()], rtol=1e-6, atol=1e-8 * sizes)
    end = path.y[n:, -1].reshape(n, n)
    return float(np.linalg.norm(end, 2)) if path.success and np.isfinite(end).all() else np.inf


def _eigenvalues(A: Array) -> Any:
    """[P, nx], each point's by falling real part."""
    values = np.linalg.eigvals(A).astype(complex)
    return np.take_along_axis(values, np.argsort(-values.real, axis=1), axis=1)


def _lqr(ocp: OCP) -> dict[str, ca.Function]:
    try:
        return {"LQR": LQR(ocp).to_casadi()}
    except ValueError:  # the goal pair is no equilibrium, or L not convex there
        return {}


def _best_controls(report: Report) -> tuple[Array, Array] | None:
    """(states of POINTS rows, controls [P, K, nu] of the reference's or another solver's plan)."""
    planned = sorted((j for j in report.judged if j.plan is not None), key=lambda j: j.name != REFERENCE)
    if not planned:
        return None
    u = planned[0].simulation.u[:, :-1]
    rows = np.flatnonzero(np.isfinite(u).all(axis=(1, 2)))[:POINTS]
    return (report.x0[rows], u[rows]) if rows.size else None


def _middle(report: Report) -> Array:
    """States at mid-horizon [P, nx] of the best known plans; of the first method's runs where nobody plans."""
    planned = sorted((j for j in report.judged if j.plan is not None), key=lambda j: j.name != REFERENCE)
    judged = planned[0] if planned else report.judged[0]
    x = (judged.simulation.x if judged.plan is None else judged.plan.x)[:, (len(judged.simulation.t) - 1) // 2]
    return x[np.isfinite(x).all(axis=1)][:POINTS]


def _optimum(report: Report) -> list[Stability]:
    """The optimum's own feedback u + K (x' - x) on those plans, by DDP."""
    given, ocp = _best_controls(report), report.ocp
    if given is None:
        return []
    x0, u = given
    K = INTERVALS // u.shape[1] * u.shape[1] or u.shape[1]
    ddp = DDP(ocp, intervals=K, constraints="soft")
    found = ddp.solve(x0, u=np.ascontiguousarray(np.repeat(u, K // u.shape[1], axis=1)))
    found = found[found.success]
    if not len(found):
        return []
    k, h = K // 2, ocp.horizon / K
    linear = ocp.functions.jacobian
    jacobians = [[j.full() for j in linear(found.x[i, k], found.u[i, k])] for i in range(len(found))]
    A = np.array([A + B @ found.gain[i, k] for i, (A, B) in enumerate(jacobians)])
    growth = np.array([np.linalg.norm(_transition(ocp, found.x[i, k:], found.u[i, k:], found.gain[i, k:], h), 2)
                       for i in range(len(found))])
    return [Stability(OPTIMUM, "mid-horizon", k * h, _eigenvalues(A), found.gain[:, k], growth)]


def _transition(ocp: OCP, x: Array, u: Array, gain: Array, h: float) -> Array:
    """The product of the closed loop's Jacobians over RK4 steps of length h, [nx, nx]."""
    at = ocp.functions.stage
    after, _ = at.interval(h)
    step = at.function("step", {"A": ca.densify(ca.jacobian(after, at.x)), "B": ca.densify(ca.jacobian(after, at.u))})
    Phi = np.eye(ocp.system.nx)
    for k in range(len(u)):
        by_x, by_u = (j.full() for j in step(x[k], u[k]))
        Phi = (by_x + by_u @ gain[k]) @ Phi
    return Phi
