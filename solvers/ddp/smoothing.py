"""Controls that the Hamiltonian is linear in: a small quadratic term, lowered as far as the descent converges.

The optimum jumps between bounds there, or is singular: second derivatives say nothing of it. So the kernel solves the
problem with

    weight * (usual cost / T) * ((u_i - middle of U) / half width of U)^2

added to L in each such control, which costs the same at both bounds, and with kinks of L in the controls, as of |u|,
rounded off over `weight` of their size. The weight is a parameter of that problem, its last one, so that one kernel
serves all of them; each is solved from the last. What is returned has the cost and V of the problem itself. V_x, the
gains and V_xx are those with the term: V_x is off by as little as the weight is.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import replace

import casadi as ca
import numpy as np

from nocl.data import Solution
from nocl.definition.ocp import OCP
from nocl.definition.parameters import parameter, time
from nocl.definition.sampling import Distribution, Gaussian, Uniform
from nocl.definition.scales import usual_sizes
from nocl.definition.smoothness import rounded
from nocl.solvers.ddp.batch import Piece, Rows
from nocl.support.checks import Array

WEIGHTS = (1e-1, 1e-2, 1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8)  # of the term: those that are tried
USUAL = WEIGHTS[:4]  # where no problem tells which
SHARP = 1e-4  # of the size of a kinked term: over how much kinks are rounded for NMPC
LITTLE = 1e-3  # of the cost: as small as the term need be
SMALL = 1e-3  # of the usual cost: costs count as not less; and the term and the rounding may make up for each other


def regularised(ocp: OCP) -> OCP:
    """The problem with the term, its weight as the last parameter."""
    s, of = ocp.system, ocp.functions
    weight = parameter(_fresh_name(ocp), nominal=USUAL[-1])
    flat = np.isin(s.control_names, ocp.flat_controls)
    away = ((s.u - ca.DM((s.lbu + s.ubu) / 2)) / ca.DM((s.ubu - s.lbu) / 2))[np.flatnonzero(flat).tolist()]
    term = weight * (usual_sizes(ocp).cost / ocp.longest) * ca.sumsqr(away)
    scales = {**dict(zip(of.rows.names, of.scales, strict=True)),
              **dict(zip(of.end_rows.names, of.end_scales, strict=True))}
    with warnings.catch_warnings():  # of its kinks the problem itself has warned
        warnings.simplefilter("ignore")
        return replace(ocp, running=_rounded(ocp, weight) + term, p=ca.vertcat(ocp.p, weight), scales=scales,
                       parameters=_with_weight(ocp.parameters))


def _fresh_name(ocp: OCP) -> str:
    name, taken = "smoothing", {*ocp.system.names, *ocp.parameter_names}
    while name in taken:
        name += "_"
    return name


def without_kinks(ocp: OCP) -> OCP:
    """The problem with kinks of L in the controls rounded so little that its cost is the same; itself if it has none.
    """
    L = _rounded(ocp, SHARP)
    if L is ocp.running:
        return ocp
    with warnings.catch_warnings():  # of its kinks the problem itself has warned
        warnings.simplefilter("ignore")
        return replace(ocp, running=L)


def _rounded(ocp: OCP, width: ca.SX | float) -> ca.SX:
    """L, with its kinks in u rounded."""
    s, p = ocp.system, ca.vertcat(ocp.system.p, ocp.p)
    low, high = ocp.parameter_box
    z = ca.vertcat(s.x, s.u, time(), p)
    return rounded(ocp.running, z, s.u, width, np.r_[s.lbx, s.lbu, 0.0, low], np.r_[s.ubx, s.ubu, ocp.longest, high])


def _with_weight(parameters: Distribution | None) -> Distribution:
    if parameters is None:
        return Uniform([USUAL[-1]], [USUAL[-1]])
    if isinstance(parameters, Gaussian):
        return Gaussian(np.r_[parameters.mean, USUAL[-1]], np.r_[parameters.std, 0.0])
    return Uniform(np.r_[parameters.lb, USUAL[-1]], np.r_[parameters.ub, USUAL[-1]])


def with_weight(p: Array | None, B: int, weight: float) -> Array:
    """Parameters [B, np] as the regularised problem has them."""
    return np.column_stack([np.zeros((B, 0)) if p is None else p, np.full(B, weight)])


def weights_for(ocp: OCP, posed: OCP, solve: Callable[[Piece, float], Solution], batch: Piece) -> tuple[float, ...]:
    """The weights that solutions are continued through: from the first of WEIGHTS to that at which the term is LITTLE
    of the cost of a few problems, or the last at which most of them converge.
    """
    kept = list[float]()
    for weight in WEIGHTS:
        found = solve(batch, weight)
        rows = np.flatnonzero(found.success)
        if 2 * len(rows) <= len(batch.x0):
            break
        kept.append(weight)
        own = in_own_cost(ocp, posed, found[rows]).cost
        floor = SMALL * usual_sizes(ocp).cost
        if weight <= SMALL and np.median(np.abs(found.cost[rows] - own) / (np.abs(own) + floor)) <= LITTLE:
            break
        batch = _part(batch, rows, _plans(found, rows))
    return tuple(kept) or USUAL


def continued(solve: Callable[[Piece, float], Solution], batch: Piece, weights: tuple[float, ...]) -> Solution:
    """A piece of a batch, each problem at the last of these weights that it converges at.

    A guess with gains is a solution nearby: it is tried at the last weight first.
    """
    warm = "gain" in batch.guess
    best = solve(batch, weights[-1 if warm else 0])
    rows = np.flatnonzero(best.success != warm)
    guess = {name: value[rows] for name, value in batch.guess.items()} if warm else _plans(best, rows)
    for weight in weights if warm else weights[1:]:
        if not rows.size:
            break
        found, former = solve(_part(batch, rows, guess), weight), best[rows]
        found = replace(found, seconds=found.seconds + former.seconds, iterations=found.iterations + former.iterations)
        won = np.flatnonzero(found.success)
        best.seconds[rows], best.iterations[rows] = found.seconds, found.iterations
        best.put(rows[won], found[won])
        rows, guess = rows[won], _plans(found, won)
    return best


def _part(batch: Piece, rows: Rows, guess: dict[str, Array]) -> Piece:
    p = None if batch.p is None else batch.p[rows]
    return replace(batch, x0=batch.x0[rows], t0=batch.t0[rows], guess=guess, p=p)


def _plans(s: Solution, rows: Rows) -> dict[str, Array]:
    return {name: np.ascontiguousarray(getattr(s, name)[rows]) for name in ("u", "x", "gain")}


def in_own_cost(ocp: OCP, posed: OCP, s: Solution, last: float = 1.0) -> Solution:
    """A solution of the regularised problem with the cost and V of the problem itself, and its parameters.

    last : the smallest weight that was asked for; messages tell of larger ones
    """
    at, (B, K, nu) = posed.functions.arguments, s.u.shape
    if not B:
        return replace(s, p=s.parameters[:, :-1] if ocp.np else None, V_p=None if s.V_p is None else s.V_p[:, :-1])
    more = at.function("more", {"more": posed.running - ocp.running})
    p, h = np.repeat(s.parameters, K, axis=0), np.diff(s.t, axis=1)

    def added(nodes: slice) -> Array:
        """[B, K], at the starts or the ends of intervals."""
        values = at.columns(x=s.x[:, nodes].reshape(B * K, -1), u=s.u.reshape(-1, nu), t=s.t[:, nodes].ravel(), p=p)
        return more(*values).full().reshape(B, K)

    each = h * (added(slice(None, -1)) + added(slice(1, None))) / 2  # exact where it holds u alone, which is held
    to_go = np.c_[np.cumsum(each[:, ::-1], axis=1)[:, ::-1], np.zeros(B)]
    own = {"p": s.parameters[:, :-1], "V_p": None if s.V_p is None else s.V_p[:, :-1]} if ocp.np else \
        {"p": None, "V_p": None}
    return replace(s, V=s.V - to_go, cost=s.cost - np.where(s.success, to_go[:, 0], 0.0),
                   message=np.array([_words(ocp, last, *one) for one in zip(s.message, s.success, s.parameters[:, -1],
                                                                     strict=True)], dtype=np.str_), **own)


def _words(ocp: OCP, last: float, message: str, success: bool, weight: float) -> str:
    """What came of a problem, and with what weight where that is not the last one."""
    if not success or weight <= last:
        return message
    return f"{message}; with a quadratic term of {weight:g} in {', '.join(ocp.flat_controls)}, with less not"
