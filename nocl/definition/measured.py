"""How far trajectories are from violating a problem's constraints, row by row: in their own units and in scales."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from nocl.definition.constraints import Constraint
from nocl.definition.ocp import OCP
from nocl.support import checks
from nocl.support.checks import Array


def least(ocp: OCP, x: Array, t: Any = None, p: Array | None = None) -> Array:
    """The least value [B, number of them] of each row of h along states x [B, n, nx]; inf for NaN.

    t [n] or [B, n] and p [B, np] where the problem has them.
    """
    n = ocp.system.nx
    x = checks.numeric(x, "x", "least", f"states [B, n, {n}]")
    if x.ndim != 3 or x.shape[2] != n or not x.shape[1]:
        raise ValueError(f"least: x has shape {x.shape}; expected [B, n, {n}]")
    if not ocp.functions.rows.n_h:
        return np.full((len(x), 0), np.inf)
    return _least(ocp.h(*ocp.functions.node.columns(**_flat(x, t, p))).full(), *x.shape[:2])


def least_held(ocp: OCP, x: Array, u: Array, t: Array, p: Array) -> Array:
    """The least value [B, m] of each row of `functions.rows` along x [B, n, nx] and u [B, n, nu] at times t; of
    equations -|c|. The first ones are those of `least`; u [B, n - 1, nu] says nothing of the last state.
    """
    of = ocp.functions
    found, rows = least(ocp, x, t, p), of.rows
    if len(rows) == rows.n_h:
        return found
    if rows.n_x > rows.n_h:
        c = of.c_of_x(*of.node.columns(**_flat(x, t, p))).full()[rows.n_h:]
        found = np.hstack([found, _least(-np.abs(c), *x.shape[:2])])
    return np.hstack([found, _least_of_u(ocp, x[:, :u.shape[1]], u, t, p)])


def _least_of_u(ocp: OCP, x: Array, u: Array, t: Array, p: Array) -> Array:
    """Those of the rows that hold the control; x and u [B, n, nu] are of the same times, the first ones of t. In
    discrete time no control acts at the end, nor behind it.
    """
    of, rows = ocp.functions, ocp.functions.rows[ocp.functions.rows.n_x:]
    if not len(rows) or not x.shape[1]:
        return np.full((len(x), len(rows)), np.inf)
    given = _flat(x, np.asarray(t)[..., :x.shape[1]], p)
    c = rows.signed(of.c_of_u(*of.arguments.columns(**given, u=u.reshape(-1, ocp.system.nu))).full())
    if ocp.system.dt is not None:
        c = np.where(given["t"] > ocp.horizon - ocp.system.dt / 2, np.inf, c)
    return _least(c, *x.shape[:2])


def least_at_end(ocp: OCP, x: Array, p: Array) -> Array:
    """The value [B, m] of each row of `functions.end_rows` at x [B, nx]; of equations -|c|; inf for NaN."""
    rows, of = ocp.functions.end_rows, ocp.functions
    c = rows.signed(of.c_at_end(*of.end.columns(x=x, p=p)).full()) if len(rows) else np.zeros((0, len(x)))
    return _least(c, len(x), 1)


def clearance(ocp: OCP, x: Array, u: Array, t: Array, p: Array) -> Array:
    """The least of all constraints [B] at the nodes of trajectories x [B, K+1, nx], u [B, K, nu], as `nearest`."""
    return nearest(ocp, least_held(ocp, x, u, t, p), least_at_end(ocp, x[:, -1], p))


def nearest(ocp: OCP, least: Array, end: Array) -> Array:
    """The least of least values [B, m] along and [B, m] at the end, in scales; where the problem has path
    constraints alone, in their own units. inf where there are none.
    """
    if ocp.in_scales:
        least, end = least / ocp.functions.scales, end / ocp.functions.end_scales
    return np.asarray(np.hstack([least, end]).min(axis=1, initial=np.inf))


def violation(ocp: OCP, least: Array, end: Array | None = None) -> Array:
    """The largest violation of a constraint as a share of its scale [B], of least values [B, m] along the
    trajectory (`least_held`; where all are of states alone, `least`) and at its end (`least_at_end`); 0: none.
    """
    m = len(ocp.functions.rows)
    least = checks.numeric(least, "least", "violation", f"least values [B, {m}]")
    if least.ndim != 2 or least.shape[1] != m or np.isnan(least).any():
        raise ValueError(f"violation: least is {checks.shown(least)}; expected [B, {m}], as least_held gives it")
    return np.asarray(shares(ocp, least, end).max(axis=1, initial=0.0)) + 0.0


def shares(ocp: OCP, least: Array, end: Array | None = None) -> Array:
    """By how much each row along the way, and then at the end, is violated, as shares of their scales; < 0: it is
    held. Least values as `violation` has them.
    """
    along = -least / ocp.functions.scales
    return along if end is None else np.hstack([along, -end / ocp.functions.end_scales])


def excess(ocp: OCP, row: int, share: float) -> tuple[str, str]:
    """Whose row of `shares` it is, and a violation of it in its own unit: ("track", "0.12 m")."""
    of = ocp.functions
    one = (*of.rows.of, *of.end_rows.of)[row]
    amount = share * np.concatenate([of.scales, of.end_scales])[row]
    return one.name, f"{amount:.3g} {_unit_of(ocp, one)}".rstrip()


def _unit_of(ocp: OCP, one: Constraint) -> str:
    """The unit of a constraint whose expression is a state or a control; "" of any other."""
    s, at = ocp.system, ocp.functions.arguments
    each = zip(s.names, ca.vertsplit(ca.vertcat(at["x"], at["u"])), strict=True)
    return next((s.units.get(name, "") for name, z in each if ca.is_equal(one.expression, z)), "")


def _flat(x: Array, t: Any, p: Array | None) -> dict[str, Any]:
    """States x [B, n, nx] at times t [n] or [B, n], with parameters p [B, np], a row each."""
    B, nodes = x.shape[:2]
    return {"x": x.reshape(-1, x.shape[2]), "t": None if t is None else np.broadcast_to(t, (B, nodes)).ravel(),
            "p": None if p is None else np.repeat(p, nodes, axis=0)}


def _least(c: Array, B: int, nodes: int) -> Array:
    """Rows [m, B * nodes] as their least values [B, m]; inf for NaN."""
    if not B:
        return np.full((0, len(c)), np.inf)
    c = c.reshape(len(c), B, nodes)
    return np.where(np.isfinite(c), c, np.inf).min(axis=2, initial=np.inf).T
