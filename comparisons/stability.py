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

from nocl.comparisons.each import Laws, at_each
from nocl.comparisons.methods import Starts
from nocl.comparisons.report.findings import Stability
from nocl.comparisons.report.report import Report
from nocl.comparisons.report.results import (
    REFERENCE,
)
from nocl.data import Solution
from nocl.definition.ocp import OCP
from nocl.definition.scales import usual_sizes
from nocl.judge.laws import policy_function
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
    point leaves that method out there. On a problem with parameters the goal is that of the nominal ones, where methods
    that are made for each p are made anew, and trajectories have their own.
    """
    ocp = report.ocp
    ocp.refuse_free("stability")
    ocp.system.refuse_discrete("stability")
    laws = {name: law for name, method in methods.items() if (law := _law(ocp, method)) is not None}
    if "LQR" not in methods:
        laws |= _lqr(ocp)
    goal, middle = Starts(ocp.x_goal[None], ocp.nominal[None]), _middle(report)
    places = [("goal", LATE * ocp.horizon, goal)] if ocp.has_goal else []
    places += [("mid-horizon", MIDDLE * ocp.horizon, middle)]
    found = [_near(ocp, name, law, where, t, at) for where, t, at in places if len(at) for name, law in laws.items()]
    return tuple([s for s in found if s is not None] + _optimum(report))


def _law(ocp: OCP, method: Any) -> Laws | ca.Function | None:
    """What is looked at of a method: its policy, or those that are made at each p."""
    return method if isinstance(method, Laws) else policy_function(ocp, method)


def _near(ocp: OCP, name: str, law: Laws | ca.Function, where: str, t: float, at: Starts) -> Stability | None:
    """A law at points and their parameters; one that is made at each p is made at theirs."""
    if not isinstance(law, Laws):
        return local(ocp, name, law, where, t, at.x, at.p)
    parts = [part for x, p in zip(at.x, at.p, strict=True) if (part := _made(law, name, where, t, x, p)) is not None]
    if not parts:
        return None
    eigenvalues, gain, growth = (np.concatenate([getattr(part, field) for part in parts])
                                 for field in ("eigenvalues", "gain", "growth"))
    return Stability(name, where, t, eigenvalues, gain, growth)


def _made(laws: Laws, name: str, where: str, t: float, x: Array, p: Array) -> Stability | None:
    try:
        one, _, policy = laws.at(p)
    except Exception:  # none can be made there: the judge's row says why
        return None
    if not isinstance(policy, ca.Function):
        return None
    return local(one, name, policy, where, t, x[None], np.zeros((1, 0)))


def local(ocp: OCP, name: str, policy: ca.Function, where: str, t: float, x: Array, p: Array) -> Stability | None:
    """A policy at points x [P, nx], parameters p [P, np] and time t."""
    s, given = ocp.system, [[row] if ocp.np else [] for row in p]
    at = ocp.functions.feedback(ca.MX)
    u = ca.fmin(ca.fmax(policy(*at.inputs), s.lbu), s.ubu)
    xdot = at.given(u=u).call(ocp.functions.f)
    loop = at.function("loop", {"xdot": xdot, "A": ca.densify(ca.jacobian(xdot, at["x"])),
                                "K": ca.densify(ca.jacobian(u, at["x"]))})
    parts = [loop(row, t, *more) for row, more in zip(x, given, strict=True)]
    A, K = (np.array([part[i].full() for part in parts]) for i in (1, 2))
    if not np.isfinite(A).all():
        return None
    size = usual_sizes(ocp).x
    growth = np.array([_growth(loop, row, more, t, ocp.horizon, size) for row, more in zip(x, given, strict=True)])
    return Stability(name, where, t, _eigenvalues(A), K, growth)


def _growth(loop: ca.Function, x: Array, p: list[Array], t: float, T: float, size: Array) -> float:
    """||Phi(T, t)||_2 along the closed loop's own run from x at t; inf where it is lost."""
    n, sizes = len(x), np.r_[size, np.divide.outer(size, size).ravel()]  # of x and Phi

    def field(time: float, z: Array) -> Array:
        xdot, A, _ = loop(z[:n], time, *p)
        return np.r_[xdot.full().ravel(), (A.full() @ z[n:].reshape(n, n)).ravel()]

    path = solve_ivp(field, (t, T), np.r_[x, np.eye(n).ravel()], rtol=1e-6, atol=1e-8 * sizes)
    end = path.y[n:, -1].reshape(n, n)
    return float(np.linalg.norm(end, 2)) if path.success and np.isfinite(end).all() else np.inf


def _eigenvalues(A: Array) -> Any:
    """[P, nx], each point's by falling real part."""
    values = np.linalg.eigvals(A).astype(complex)
    return np.take_along_axis(values, np.argsort(-values.real, axis=1), axis=1)


def _lqr(ocp: OCP) -> dict[str, Laws | ca.Function]:
    """LQR about the goal, that of each p."""
    try:
        law = _law(ocp, at_each(ocp, LQR))
    except ValueError:  # the goal pair is no equilibrium, L not convex there, or it holds the time
        return {}
    return {} if law is None else {"LQR": law}


def _best_controls(report: Report) -> tuple[Starts, Array] | None:
    """(POINTS rows, controls [P, K, nu] of the reference's or another solver's plan)."""
    planned = sorted((j for j in report.judged if j.plan is not None), key=lambda j: j.name != REFERENCE)
    if not planned:
        return None
    u = planned[0].simulation.u[:, :-1]
    rows = np.flatnonzero(np.isfinite(u).all(axis=(1, 2)))[:POINTS]
    return (Starts(report.x0[rows], report.parameters[rows]), u[rows]) if rows.size else None


def _middle(report: Report) -> Starts:
    """States at mid-horizon [P, nx] of the best known plans; of the first method's runs where nobody plans."""
    planned = sorted((j for j in report.judged if j.plan is not None), key=lambda j: j.name != REFERENCE)
    judged = planned[0] if planned else report.judged[0]
    x = (judged.simulation.x if judged.plan is None else judged.plan.x)[:, (len(judged.simulation.t) - 1) // 2]
    rows = np.flatnonzero(np.isfinite(x).all(axis=1))[:POINTS]
    return Starts(x[rows], report.parameters[rows])


def _optimum(report: Report) -> list[Stability]:
    """The optimum's own feedback u + K (x' - x) on those plans, by DDP."""
    given, ocp = _best_controls(report), report.ocp
    if given is None:
        return []
    starts, u = given
    K = INTERVALS // u.shape[1] * u.shape[1] or u.shape[1]
    ddp = DDP(ocp, intervals=K)
    guess = np.ascontiguousarray(np.repeat(u, K // u.shape[1], axis=1))
    found = ddp.solve(starts.x, u=guess, p=starts.p if ocp.np else None)
    found = found[found.success]
    if not len(found):
        return []
    k, h = K // 2, ocp.horizon / K
    of, p = ocp.functions, found.parameters
    jacobians = [[j.full() for j in of.jacobian(*of.arguments.columns(
        x=found.x[[i], k], u=found.u[[i], k], t=[k * h], p=p[[i]]))] for i in range(len(found))]
    A = np.array([A + B @ found.gain[i, k] for i, (A, B) in enumerate(jacobians)])
    growth = np.array([np.linalg.norm(_transition(ocp, found[[i]], k), 2) for i in range(len(found))])
    return [Stability(OPTIMUM, "mid-horizon", k * h, _eigenvalues(A), found.gain[:, k], growth)]


def _transition(ocp: OCP, plan: Solution, first: int) -> Array:
    """The product of the closed loop's Jacobians over the RK4 steps of a solution from one on, [nx, nx]."""
    at, t = ocp.functions.stage, plan.t[0]
    after, _ = at.interval(t[1] - t[0])
    step = at.function("step", {"A": ca.densify(ca.jacobian(after, at.x)), "B": ca.densify(ca.jacobian(after, at.u))})
    Phi = np.eye(ocp.system.nx)
    for k in range(first, plan.u.shape[1]):
        given = at.columns(x=plan.x[:, k], u=plan.u[:, k], t=t[[k]], p=plan.parameters)
        by_x, by_u = (j.full() for j in step(*given))
        Phi = (by_x + by_u @ plan.gain[0, k]) @ Phi
    return Phi
