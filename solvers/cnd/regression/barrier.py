"""Constraints of states in the output map of a policy: near a boundary it brakes in time.

A network's errors lie on both sides of a boundary, so a policy that is trained to touch it is outside half of the time;
margins that keep it inside cost much (cart-pole on a track: 4 % for 1 % of the track). The map costs next to nothing
instead: what the network says is moved, as little as needed, to where the run cannot leave.

A row h(x, t, p) >= 0 that the control moves by its first derivative along f, as a limit of speed, or by its second, as
a track, is held by (control barrier functions: Ames et al., IEEE TAC 62(8), 2017)

    h' >= -h / s                                            (first derivative)
    h'' >= b - (1 - b / (r B)) (h / w^2 - h' / w)           (second; terms of h' where h' < 0, and 1 - ... where > 0)

b = h'^2 / (2 h) is the constant braking that stops at the boundary; a run that touches the boundary tends to it by
itself. The other term lets braking be less while there is time, w, and while it takes less than a share r of B, the
most that U gives. Where b = r B, b stays what it is, and h' -> 0 as h -> 0. Corrections take a time s, at least that
for which a control is held: b <= -h' / s. Where U does not give h'' >= 0, or at a boundary h' >= 0, no map helps: the
network is there to see it coming.
"""

from __future__ import annotations

from typing import NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from nocl.definition.ocp import OCP
from nocl.translate.arguments import Arguments

CORRECTION = 1 / 400  # of the horizon: s
WINDOW = 10  # of corrections: w
NOTHING = 1e-9  # of a scale
PASSES = 2  # over the rows, where there are several
TRIED = 256  # places at which it is seen whether the control moves a row
IDLE = 1e-9  # of the largest: less is no movement
RESERVE = 0.9  # of the braking that U gives: r
FLAT = 1e-3  # of the usual movement: where the control moves a row less than that, it is not asked for more


class Moved(NamedTuple):
    """A row by what the control moves: h, h' and the derivative, h' or h'', that depends on u, in scales."""

    h: ca.SX
    slope: ca.SX
    moved: ca.SX
    order: int
    usual: float  # how far the half of U moves it, a median over X


def guarded(ocp: OCP) -> NDArray[np.bool_]:
    """Which rows along a trajectory [m] the map holds: inequalities of (x, t, p) that the control moves soon enough."""
    found = np.zeros(len(ocp.functions.rows), dtype=bool)
    found[[i for i, _ in _rows(ocp)]] = True
    return found


def _rows(ocp: OCP) -> list[tuple[int, Moved]]:
    """Such rows by number; none where the equations of motion are not known."""
    rows = ocp.functions.rows
    if ocp.system.xdot is None:
        return []
    moved = [(int(i), _moved(ocp, int(i))) for i in np.flatnonzero(~rows.of_u & ~rows.equal)]
    return [(i, row) for i, row in moved if row is not None]


def _moved(ocp: OCP, i: int) -> Moved | None:
    """The first or second derivative of row i along f that the control moves; None where neither does."""
    of = ocp.functions
    h, at = of.rows.column[i] / float(of.scales[i]), of.arguments
    slope = _along(ocp, h)
    for order, moved in ((1, slope), (2, _along(ocp, slope))):
        by_u = ca.jacobian(moved, at["u"])
        if by_u.nnz():
            usual = _usual(ocp, by_u)
            return Moved(h, slope, moved, order, usual) if usual > 0 else None
    return None


def _along(ocp: OCP, e: ca.SX) -> ca.SX:
    """de/dt along f."""
    at = ocp.functions.arguments
    change = ca.jtimes(e, at["x"], at.call(ocp.functions.f))
    return change + ca.jtimes(e, at["t"], ca.SX(1)) if "t" in at.names else change


def _usual(ocp: OCP, by_u: ca.SX) -> float:
    """A usual size of by_u [1, nu] times half of U; 0 where it is none at most places."""
    s, rng = ocp.system, np.random.default_rng(0)
    x, u = rng.uniform(s.lbx, s.ubx, (TRIED, s.nx)), rng.uniform(s.lbu, s.ubu, (TRIED, s.nu))
    at = ocp.functions.arguments
    values = at.function("by_u", {"by_u": ca.densify(by_u)})(*at.columns(x=x, u=u, **ocp.moments(TRIED))).full()
    size = np.linalg.norm(values.reshape(s.nu, TRIED, order="F") * ((s.ubu - s.lbu) / 2)[:, None], axis=0)
    size = size[np.isfinite(size)]
    return float(np.median(size)) if size.size and np.median(size) > IDLE * size.max() else 0.0


def braked(ocp: OCP, at: Arguments, v: ca.SX) -> ca.SX:
    """v [nu] moved to where the rows of `guarded` are held, at symbols `at` of a policy: x, t[, p][, dt]."""
    rows = _rows(ocp)
    if not rows:
        return v
    own, step = ocp.functions.arguments, CORRECTION * ocp.longest
    said, least = ca.SX.sym("v", ocp.system.nu), ca.SX.sym("s")
    wanted = [_wanted(ocp, row, said, least) for _, row in rows]
    u = said
    for _ in range(PASSES if len(wanted) > 1 else 1):
        for short, by_u, usual in wanted:
            u = _pushed(ocp, u, said, short, by_u, usual)
    moved = own.but("u").function("braked", {"u": u}, v=said, s=least)
    return at.given(v=v, s=ca.fmax(step, at["dt"]) if "dt" in at.names else ca.SX(step)).call(moved)


def _wanted(ocp: OCP, row: Moved, v: ca.SX, s: ca.SX) -> tuple[ca.SX, ca.SX, float]:
    """(what is missing at v, the row's slope by u there, how far U usually moves it)."""
    u, w, U = ocp.functions.arguments["u"], WINDOW * s, ocp.system
    by_u, got = (ca.substitute(e, u, v) for e in (ca.jacobian(row.moved, u), row.moved))
    if row.order == 1:
        return -ca.fmax(row.h, 0) / s - ca.fmin(row.h, 0) / w - got, by_u, row.usual
    most = got + ca.mtimes(by_u, (U.ubu + U.lbu) / 2 - v) + ca.mtimes(ca.fabs(by_u), (U.ubu - U.lbu) / 2)
    closing = ca.fmin(row.slope, 0)
    stop = closing**2 / (ca.fmax(2 * row.h, -s * closing) + NOTHING)
    spare = ca.fmax(1 - stop / (RESERVE * ca.fmax(most, IDLE * row.usual)), 0)
    return stop - spare * (ca.fmax(row.h, 0) / w**2 - closing / w) - ca.fmin(row.h, 0) / w**2 - got, by_u, row.usual


def _pushed(ocp: OCP, u: ca.SX, v: ca.SX, missing: ca.SX, by_u: ca.SX, usual: float) -> ca.SX:
    """u with the smallest change, in halves of U, that makes up for what is missing at v, in U."""
    s = ocp.system
    half = ca.DM(((s.ubu - s.lbu) / 2) ** 2)
    short = ca.fmax(missing - ca.mtimes(by_u, u - v), 0)
    step = half * by_u.T * short / (ca.mtimes(by_u, half * by_u.T) + (FLAT * usual) ** 2)
    return ca.fmin(ca.fmax(u + step, ca.DM(s.lbu)), ca.DM(s.ubu))
