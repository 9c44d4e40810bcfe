"""The audit of each initial state: models, integrators and values, beside the judge's run. B is the batch.

A control that looks good on a learned model or a coarse integrator may live on their errors: each method's control is
run under both, by RK4, beside the judge's CVODES on the exact f. A value function is held against the cost that its own
method paid, against a solver's costate, and against the Hamilton-Jacobi-Bellman equation.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from nocl.comparisons.each import Laws
from nocl.comparisons.methods import Starts
from nocl.comparisons.report.findings import MethodAudit, Rollouts, ValueAudit, per_cent
from nocl.comparisons.report.report import Report
from nocl.comparisons.report.results import (
    REFERENCE,
    Judged,
)
from nocl.definition.ocp import OCP
from nocl.judge.laws import dynamics_function, policy_function
from nocl.judge.runs import AT_BOUND
from nocl.solvers.nmpc.loop import Loop
from nocl.support.checks import Array
from nocl.translate.arguments import Arguments
from nocl.translate.rk4 import rk4

EXACT, LEARNED = "exact f, RK4", "learned model, RK4"
SUBSTEPS = 4  # RK4 steps between two nodes of continuous feedback: its gain grows towards the end
NODES = 40  # of a solver's plan that grad V is compared at, about
Ask = Callable[[Array, float, NDArray[np.int64]], Array]  # (x [n, nx], t, which of the states these are) -> u [n, nu]


def audit(report: Report, methods: Mapping[str, Any], model: Any = None) -> tuple[MethodAudit, ...]:
    """Audits of the methods of a report, by the names that they were compared under; others are left out.

    model: the dynamics that the controls were made on, a casadi.Function (x, u) -> xdot or an object with
    `to_casadi()`; without one the rollouts on it are missing. Where it has `doubt(x, u)` (learned dynamics, ensembles),
    what it says of the judged runs stands beside.
    """
    report.ocp.refuse_free("audit")
    report.ocp.system.refuse_discrete("audit")
    from nocl.support.threads import one_thread  # with torch

    learned = None if model is None else dynamics_function(report.ocp, model)
    with one_thread():
        return tuple(_audit(report, judged, methods[judged.name], learned, getattr(model, "doubt", None))
                     for judged in report.judged if judged.name in methods)


def _audit(report: Report, judged: Judged, method: Any, learned: ca.Function | None,
           doubt: Callable[[Array, Array], Array] | None) -> MethodAudit:
    plants = {EXACT: report.ocp.functions.f} | ({} if learned is None else {LEARNED: learned})
    control, starts = _control(report, judged, method), Starts(report.x0, report.parameters)
    rollouts = () if control is None else tuple(
        _rollout(report.ocp, name, f, judged.simulation.t, starts, *control) for name, f in plants.items())
    cost = {r.name: r.cost for r in rollouts}
    return MethodAudit(judged.name, rollouts, _excess(judged, cost.get(LEARNED)), _excess(judged, cost.get(EXACT)),
                       _value(report, judged, method),
                       None if doubt is None else doubt(judged.simulation.x, judged.simulation.u))


def _excess(judged: Judged, cost: Array | None) -> Array:
    """100 (judged - cost) / |judged|; inf where only the judge saw it fail, NaN where both did or nothing is known."""
    J = judged.simulation.cost
    if cost is None:
        return np.full(len(J), np.nan)
    with np.errstate(invalid="ignore"):
        excess = per_cent(J - cost, J)
    return np.where(np.isfinite(J), excess, np.where(np.isfinite(cost), np.inf, np.nan))


def _control(report: Report, judged: Judged, method: Any) -> tuple[Ask, bool] | None:
    """(the control, whether it is held from node to node); None for NMPC's loop: it would have to be solved anew."""
    if isinstance(method, Loop):
        return None
    ocp, t, u = report.ocp, judged.simulation.t, judged.simulation.u
    starts = Starts(report.x0, report.parameters)
    if judged.plan is not None:
        return (lambda x, time, rows: u[rows, int(np.searchsorted(t, time + 1e-9 * t[-1], side="right")) - 1]), True
    policy = policy_function(ocp, method)
    if policy is None or (not isinstance(method, ca.Function) and callable(method)):  # rows at once are faster
        held = policy is None and not (isinstance(method, Laws) and method.continuous)
        return (lambda x, time, rows: np.asarray(method(x, time, *starts[rows].given(ocp, method)), float)), held
    at = ocp.functions.feedback()
    return (lambda x, time, rows: policy(*at.columns(x=x, t=np.full(len(x), time), p=starts.p[rows])).full().T), False


def _rollout(ocp: OCP, name: str, f: ca.Function, t: Array, starts: Starts, ask: Ask, held: bool) -> Rollouts:
    """RK4 from node to node with the cost as an extra state, feedback at each stage unless held."""
    s, K, x0, of = ocp.system, len(t) - 1, starts.x, ocp.functions.on(f)
    z, first = np.c_[x0, np.zeros((len(x0), 2))], np.zeros((0, 0))  # z = (x, cost, t)
    x, u = np.full((len(x0), K + 1, s.nx), np.nan), np.full((len(x0), K, s.nu), np.nan)

    def answer(x: Array, time: float) -> Array:
        v, alive = np.full((len(x), s.nu), np.nan), np.flatnonzero(np.isfinite(x).all(axis=1))
        try:
            v[alive] = np.clip(ask(x[alive], min(time, float(t[-1])), alive), s.lbu, s.ubu)
        except Exception:  # whatever a user's controller raises: the judge's row has its message
            return v
        return v

    def field(z: Array, _: None) -> Array:
        v = first if held else answer(z[:, : s.nx], float(z[0, -1]))
        given = of.arguments.columns(x=z[:, : s.nx], u=v, t=z[:, -1], p=starts.p)
        return np.c_[of.f(*given).full().T, of.L(*given).full().T, np.ones(len(z))]

    steps = 1 if held else SUBSTEPS
    for k in range(K):
        x[:, k] = z[:, : s.nx]
        u[:, k] = first = answer(x[:, k], float(t[k]))
        for i in range(1, steps + 1):
            z = rk4(field, z, None, (t[k + 1] - t[k]) / steps)
            z[:, -1] = t[k] + i * (t[k + 1] - t[k]) / steps
    x[:, -1] = z[:, : s.nx]
    cost = z[:, s.nx] + of.G(*of.end.columns(x=x[:, -1], p=starts.p)).full().ravel()
    return Rollouts(name, t, x, u, np.where(np.isfinite(cost), cost, np.inf))


def _value(report: Report, judged: Judged, method: Any) -> ValueAudit | None:
    try:
        V = method.value_to_casadi() if hasattr(method, "value_to_casadi") else None
    except ValueError:  # it was trained without a value function
        V = None
    if V is None:
        return None
    ocp, s, (B, K), of = report.ocp, judged.simulation, judged.simulation.x.shape[:2], report.ocp.functions
    derivatives = _derivatives(V, report.parameters)
    _, V_x, V_t = derivatives(s.x, s.t)
    x, u, slopes = (rows.reshape(B * K, -1) for rows in (s.x, s.u, V_x))
    at = {"x": x, "u": u, "t": np.tile(s.t, B), "p": np.repeat(report.parameters, K, axis=0)}
    given = of.arguments.columns(**at)
    flow = np.einsum("bki,bki->bk", V_x, of.f(*given).full().T.reshape(V_x.shape))
    hjb = V_t + of.L(*given).full().reshape(B, -1) + flow
    slope = _hamiltonian_gradient(ocp)(*of.stage.columns(**at), slopes.T).full().T
    start = derivatives(report.x0[:, None], s.t[:1])[0][:, 0]
    return ValueAudit(start, np.abs(start - s.cost), *_against_costate(report, derivatives), s.t, hjb,
                      _slope_size(ocp, u, slope).reshape(B, -1))


def _derivatives(V: ca.Function, p: Array) -> Callable[[Array, Array], tuple[Array, Array, Array]]:
    """(x [B, n, nx], t [n]) -> V [B, n], V_x [B, n, nx], V_t [B, n], at parameters p [B, np]."""
    at = Arguments.of(V)
    value, (x, t) = at.call(V), at.inputs[:2]
    gradient = at.function("gradient", {"V": value, "V_x": ca.densify(ca.jacobian(value, x)).T,
                                        "V_t": ca.densify(ca.jacobian(value, t))})
    takes_p = V.n_in() > 2

    def derivatives(x: Array, t: Array) -> tuple[Array, Array, Array]:
        B, n, nx = x.shape
        more = [np.repeat(p, n, axis=0).T] if takes_p else []
        value, V_x, V_t = (g.full() for g in gradient(x.reshape(-1, nx).T, np.tile(t, B)[None], *more))
        return value.reshape(B, n), V_x.T.reshape(B, n, nx), V_t.reshape(B, n)

    return derivatives


def _hamiltonian_gradient(ocp: OCP) -> ca.Function:
    """(x, u, costate) -> L_u + f_u' costate."""
    at, costate = ocp.functions.stage, ca.SX.sym("costate", ocp.system.nx)
    H_u = ca.gradient(at.hamiltonian(costate, soft=False), at.u)
    return at.function("H_u", {"H_u": ca.densify(H_u)}, costate=costate)


def _slope_size(ocp: OCP, u: Array, slope: Array) -> Array:
    """||dH/du|| of rows; NaN where constraints hold the control: what pushes against them is not known."""
    size = np.linalg.norm(_free(ocp, u, slope), axis=1)
    return np.full(len(size), np.nan) if ocp.functions.rows.of_u.any() else size


def _free(ocp: OCP, u: Array, slope: Array) -> Array:
    """dH/du without what pushes against an active bound: there it need not vanish."""
    s = ocp.system
    near = AT_BOUND * (s.ubu - s.lbu)
    return np.where(((u <= s.lbu + near) & (slope > 0)) | ((u >= s.ubu - near) & (slope < 0)), 0.0, slope)


def _against_costate(report: Report, derivatives: Callable[..., Any]) -> tuple[str, Array, Array, Array, Array]:
    """(whose costate, angle and size error at the start, their medians along that plan)."""
    planned = sorted((j for j in report.judged if j.plan is not None), key=lambda j: (j.name != REFERENCE,
                                                                                       j.name != "NMPC"))
    if not planned:
        return "", *np.full((4, len(report.x0)), np.nan)
    plan, t = planned[0].plan, planned[0].simulation.t
    assert plan is not None
    nodes = np.unique(np.linspace(0, len(t) - 1, min(len(t), NODES + 1)).astype(int))
    _, V_x, _ = derivatives(plan.x[:, nodes], t[nodes])
    costate = plan.costate[:, nodes]
    own, theirs = np.linalg.norm(V_x, axis=2), np.linalg.norm(costate, axis=2)
    with np.errstate(invalid="ignore", divide="ignore"):
        cosine = np.einsum("bki,bki->bk", V_x, costate) / (own * theirs)
        angle, size = np.degrees(np.arccos(np.clip(cosine, -1, 1))), 100 * (own / theirs - 1)
    return planned[0].name, angle[:, 0], size[:, 0], np.median(angle, axis=1), np.median(np.abs(size), axis=1)
