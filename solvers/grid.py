"""Whether steps are short enough: solutions held against the same equations on far shorter steps.

A solver knows its plant on its own grid alone. Where that is too coarse for a fast part of the plant, what it plans,
and says that it costs, has nothing to do with the plant, and a descent even looks for such plans. So a few solutions
are followed again, interval by interval, each from its own nodes: an unstable plant does no harm. What counts is by how
much of X a state is off after an interval, and by how much of J the cost is, to first order: errors of states count by
the costate there, and add up with those of the running cost.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from nocl.data import Solution
from nocl.definition.functions import Functions
from nocl.definition.ocp import OCP
from nocl.definition.sampling import own_numbers
from nocl.definition.scales import usual_sizes
from nocl.definition.substeps import FEW, FINEST, RADAU, REMEDY, RK4, STABLE, TRIED, Grid, grid_of
from nocl.support.checks import Array

ROWS = 4  # solutions that are looked at
APART = 0.1  # a plan that is off by more is none
FINEST_IMPLICIT = 16  # steps in an interval taken for the truth where explicit ones are unstable even so
SMALL = 1e-3  # of the usual cost: below it, errors count as shares of that
Stages = dict[str, Array]  # x [n, nx], u [n, nu], t [n], p [n, np]


def measured(ocp: OCP, functions: Functions, solution: Solution, substeps: int, integrator: str = RK4,
             soft: bool = False) -> Grid | None:
    """The grid of some solutions of an OCP under f, by the first ROWS that were solved; None where none was, and in
    discrete time, where plan and plant have the same steps.

    soft : whether their costs have the penalty of soft constraints; its kinks are no error of plans that hold them
    """
    solution = solution[np.flatnonzero(solution.success)[:ROWS]]
    if not len(solution) or ocp.system.is_discrete:
        return None
    step, errors = float(np.diff(solution.t, axis=1).max()), _errors(ocp, functions, solution, integrator, soft)
    return grid_of(step, substeps, lambda n: float(errors(n).max()), fastest(functions, _stages(solution)),
                   tried=TRIED if integrator == RK4 else FEW, explicit=integrator == RK4)


def followed(ocp: OCP, functions: Functions, solution: Solution, substeps: int, integrator: str = RK4,
             soft: bool = False) -> Solution:
    """The same, where a grid is too coarse: rows whose plan is off by more than APART have failed, and say so."""
    solved = np.flatnonzero(solution.success)
    if not len(solved):
        return solution
    error = _errors(ocp, functions, solution[solved], integrator, soft)(substeps)
    lost, error = solved[error > APART], error[error > APART]
    said = [f"not solved: with substeps={substeps} plan and plant differ by {100 * e:.3g} %: a singularity on the way, "
            f"or {REMEDY}" for e in error]
    message, cost, success = solution.message.tolist(), solution.cost.copy(), solution.success.copy()
    for i, text in zip(lost, said, strict=True):
        message[i] = text
    cost[lost], success[lost] = np.inf, False
    return replace(solution, message=np.array(message), cost=cost, success=success)


def fastest_at_start(ocp: OCP, functions: Functions, number: int = ROWS) -> float:
    """The shortest time constant of f at some initial states under u*."""
    x, p = firsts(ocp, number)
    return fastest(functions, {"x": x, "u": ocp.goals(p)[1], "t": np.zeros(number), "p": p})


def firsts(ocp: OCP, number: int = ROWS) -> tuple[Array, Array]:
    """A few initial states [number, nx] and parameters [number, np], always the same."""
    return ocp.initial_states.sample(number, own_numbers(0)), ocp.sample_parameters(number, own_numbers(0, 2))


def _errors(ocp: OCP, functions: Functions, s: Solution, integrator: str, soft: bool) -> Callable[[int], Array]:
    """substeps -> the error of each row."""
    B, K, nx = len(s), s.u.shape[1], s.x.shape[2]
    x, h = s.x[:, :-1].reshape(-1, nx).T, np.diff(s.t, axis=1).reshape(1, -1)
    moment = _stages(s)
    usual = usual_sizes(ocp)
    cost, slope = np.maximum(np.abs(s.cost), SMALL * usual.cost), s.V_x[:, 1:].reshape(-1, nx).T
    known: dict[int, Array] = {}
    finest = (RK4, FINEST) if h.max() <= STABLE * FINEST * fastest(functions, moment) else (RADAU, FINEST_IMPLICIT)
    steps = {kind: functions.step(soft=soft, integrator=kind) for kind in {integrator, finest[0]}}

    def after(kind: str, n: int) -> tuple[Array, Array]:
        z, total = x, np.zeros((1, B * K))
        for i in range(n):
            now = {**moment, "x": z.T, "t": moment["t"] + (i * h / n).ravel()}
            z, part = (v.full() for v in steps[kind](*functions.arguments.columns(**now), h / n))
            total = total + part
        return z, total

    with np.errstate(all="ignore"):
        true, paid = after(*finest)

    def error(n: int) -> Array:
        if n not in known:
            with np.errstate(all="ignore"):
                z, total = after(integrator, n)
                off = np.abs(total - paid).ravel() + np.abs((slope * (z - true)).sum(axis=0))
                parted = (np.abs(z - true) / usual.x[:, None]).max(axis=0).reshape(B, K).max(axis=1)
                worst = np.maximum(off.reshape(B, K).sum(axis=1) / cost, parted)
            known[n] = np.where(np.isfinite(worst), worst, np.inf)
        return known[n]

    return error


def _stages(s: Solution) -> Stages:
    """The start of each interval of all solutions, a row each: x, u, t, p."""
    K = s.u.shape[1]
    p = np.zeros((len(s), 0)) if s.p is None else s.p
    return {"x": s.x[:, :-1].reshape(-1, s.x.shape[2]), "u": s.u.reshape(len(s) * K, -1), "t": s.t[:, :-1].ravel(),
            "p": np.repeat(p, K, axis=0)}


def fastest(functions: Functions, at: Stages) -> float:
    """The shortest time constant of the linearised f at stages x [n, nx], u [n, nu], t [n], p [n, np]; inf for none.

    1 / |lambda|: what swings has one too, which steps have to follow.
    """
    nx = at["x"].shape[1]
    A = functions.jacobian(*functions.arguments.columns(**at))[0].full()
    A = A.reshape(nx, -1, nx).transpose(1, 0, 2)
    rate = np.abs(np.linalg.eigvals(A[np.isfinite(A).all(axis=(1, 2))])).max(initial=0.0)
    return float(1 / rate) if rate > 0 else np.inf
