"""Constraints of states in the output map of a policy: near a boundary it brakes in time.

A network's errors lie on both sides of a boundary, so a policy that is trained to touch it is outside half of the time;
margins that keep it inside cost much (cart-pole on a track: 4 % for 1 % of the track). The map costs little instead:
what the network says is moved to where the run stays inside.

A row h(x, t, p) >= 0 that the control moves by its first derivative along f, as a limit of speed, or by its second, as
a track, is held by (control barrier functions: Ames et al., IEEE TAC 62(8), 2017)

    h' >= -h / s                                            (first derivative)
    h'' >= b - (1 - b / (r B)) (h / w^2 - h' / w)           (second; terms of h' where h' < 0, and 1 - ... where > 0)

and one h(x, u, t, p) >= 0 that it moves itself, as a limit of power, as it stands, on learned dynamics too. A row at
the end of what is only ever used up, as a dose, holds all along, and is held so.

b = h'^2 / (2 h) is the constant braking that stops at the boundary; a run that touches the boundary tends to it by
itself. The other term lets braking be less while there is time, w, and while it takes less than a share r of B, the
most that U gives. Where b = r B, b stays what it is, and h' -> 0 as h -> 0. Corrections take a time s, at least that
for which a control is held: b <= -h' / s. The boundary is where half of what is allowed is used up.

Rows are for the map where the control moves that derivative, affinely, as much as usual at all places near the
boundary, and U gives h' >= 0, or h'' >= 0, at most of them. Others are not, like the distance of a rotor craft from
what is beside it: the map would do harm by asking for what cannot be. Margins hold such rows (held.py). The map looks
at one row after the other, each with all of U: in a corner of two boundaries it may give too little.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from nocl.definition.constraints import TOLERANCE
from nocl.definition.ocp import OCP
from nocl.solvers.cnd.regression.projection import projected, retracted
from nocl.support.checks import Array
from nocl.translate.arguments import Arguments

CORRECTION = 1 / 400  # of a run: s, or less
BEYOND = TOLERANCE / 4  # of a scale: how far a run gets beyond a boundary within s, while half of U turns it back
WINDOW = 4  # of corrections: w
NOTHING = 1e-9  # of a scale
PASSES = 2  # over the rows, where there are several
TRIED = 4096  # places at which rows are looked at: of those inside, the quarter nearest to the boundary
SURE = 0.1  # of the usual movement: a row that it moves less somewhere is not for the map
MOSTLY = 0.9  # of these places: where U must be able to turn it back
IDLE = 1e-9  # of the largest: less is no movement
RESERVE = 0.98  # of the braking that U gives: r
FLAT = (1e-3, 0.03, 0.03)  # of the usual movement, by order: where the control moves a row less, little is asked of it


class Moved(NamedTuple):
    """A row by what the control moves: h, h' and the first of h, h', h'' that depends on u, in scales."""

    h: ca.SX
    slope: ca.SX
    moved: ca.SX  # h, h' or h'', by the order
    order: int
    usual: float  # how far the half of U moves it, a median over X near h = 0


def guarded(ocp: OCP, learned: bool = False) -> NDArray[np.bool_]:
    """Which rows along a trajectory and at its end [m + those at the end] the map holds: inequalities that the control
    moves soon enough, at once where the dynamics are `learned`, and that are not of the control alone (projection.py).
    """
    found = np.zeros(len(ocp.functions.rows) + len(ocp.functions.end_rows), dtype=bool)
    found[[i for i, _ in _rows(ocp, learned)]] = True
    return found


def _rows(ocp: OCP, learned: bool = False) -> list[tuple[int, Moved]]:
    """Such rows by number; where the equations of motion are not known, and in discrete time, those moved at once."""
    of, m = ocp.functions, len(ocp.functions.rows)
    mine = ~of.rows.equal & ~projected(ocp)
    moved = [(int(i), _at_once(ocp, int(i))) for i in np.flatnonzero(mine & of.rows.of_u)]
    if not (learned or ocp.system.xdot is None or ocp.system.is_discrete):
        moved += [(int(i), _moved(ocp, of.rows.column[int(i)] / float(of.scales[i])))
                  for i in np.flatnonzero(mine & ~of.rows.of_u)]
        moved += [(m + int(i), _budget(ocp, of.end_rows.column[int(i)] / float(of.end_scales[i])))
                  for i in np.flatnonzero(~of.end_rows.equal)]
    return [(i, row) for i, row in moved if row is not None]


def _at_once(ocp: OCP, i: int) -> Moved | None:
    """Row i of states and controls; None where the map cannot hold it."""
    h = ocp.functions.rows.column[i] / float(ocp.functions.scales[i])
    by_u = _by_u(ocp, h)
    usual = 0.0 if by_u is None else _usual_at_once(ocp, h, by_u)
    return Moved(h, ca.SX(0), h, 0, usual) if usual > 0 else None


def _moved(ocp: OCP, c: ca.SX) -> Moved | None:
    """The first or second derivative of a row c along f that the control moves; None where the map cannot hold it so.
    """
    h, at = c + TOLERANCE / 2, ocp.functions.arguments
    slope = _along(ocp, h)
    for order, moved in ((1, slope), (2, _along(ocp, slope))):
        if ca.depends_on(moved, at["u"]):
            by_u = _by_u(ocp, moved)
            usual = 0.0 if by_u is None else _usual(ocp, h, moved, by_u)
            return Moved(h, slope, moved, order, usual) if usual > 0 else None
    return None


def _budget(ocp: OCP, c: ca.SX) -> Moved | None:
    """A row at the end of what is used up and never comes back, as fuel or a dose: it holds all along."""
    row = _moved(ocp, c)
    if row is None or row.order != 1:
        return None
    most, = _over_places(ocp, _most(ocp, row.moved, ca.jacobian(row.moved, ocp.functions.arguments["u"])))
    return row if np.isfinite(most).all() and most.max() <= IDLE * row.usual else None


def _by_u(ocp: OCP, moved: ca.SX) -> ca.SX | None:
    """Its derivative by u [1, nu]; None where it is not affine in u."""
    u = ocp.functions.arguments["u"]
    by_u = ca.jacobian(moved, u)
    return None if ca.depends_on(by_u, u) else by_u


def _along(ocp: OCP, e: ca.SX) -> ca.SX:
    """de/dt along f."""
    at = ocp.functions.arguments
    change = ca.jtimes(e, at["x"], at.call(ocp.functions.f))
    return change + ca.jtimes(e, at["t"], ca.SX(1)) if "t" in at.names else change


def _usual_at_once(ocp: OCP, h: ca.SX, by_u: ca.SX) -> float:
    """The median size of by_u [1, nu] times half of U where U may violate h >= 0; 0 where no control mends that."""
    least, most, sizes = _over_places(ocp, -_most(ocp, -h, -by_u), _most(ocp, h, by_u), _size(ocp, by_u))
    short = np.isfinite(least) & np.isfinite(most) & np.isfinite(sizes) & (least < 0)
    return float(np.median(sizes[short])) if short.any() and (most[short] >= 0).mean() >= MOSTLY else 0.0


def _usual(ocp: OCP, h: ca.SX, moved: ca.SX, by_u: ca.SX) -> float:
    """The median size of by_u [1, nu] times half of U where h >= 0 is small; 0 where the control is no sure hold."""
    distance, most, sizes = _over_places(ocp, h, _most(ocp, moved, by_u), _size(ocp, by_u))
    fine = np.isfinite(distance) & np.isfinite(sizes) & np.isfinite(most) & (distance >= 0)
    order = np.flatnonzero(fine)[np.argsort(distance[fine])][:max(int(fine.sum()) // 4, 1)]
    if not order.size:
        return 0.0
    usual = float(np.median(sizes[order]))
    sure = sizes[order].min() > SURE * usual and usual > IDLE * sizes[fine].max()
    return usual if sure and (most[order] >= 0).mean() >= MOSTLY else 0.0


def _over_places(ocp: OCP, *expressions: ca.SX) -> list[Array]:
    """The values [TRIED] of each expression [1] over X x U."""
    s, rng, at = ocp.system, np.random.default_rng(0), ocp.functions.arguments
    x, u = rng.uniform(s.lbx, s.ubx, (TRIED, s.nx)), rng.uniform(s.lbu, s.ubu, (TRIED, s.nu))
    tried = at.function("tried", {f"e{i}": e for i, e in enumerate(expressions)})
    values = tried.call(at.columns(x=x, u=u, **ocp.moments(TRIED)))
    return [np.broadcast_to(value.full().ravel(), TRIED) for value in values]


def _size(ocp: OCP, by_u: ca.SX) -> ca.SX:
    """How far the half of U moves a row."""
    return ca.norm_2(by_u.T * ca.DM((ocp.system.ubu - ocp.system.lbu) / 2))


def _most(ocp: OCP, moved: ca.SX, by_u: ca.SX) -> ca.SX:
    """A row under the control that moves it the most."""
    return moved + ca.mtimes(by_u, _best(ocp, by_u) - ocp.functions.arguments["u"])


def _best(ocp: OCP, by_u: ca.SX) -> ca.SX:
    """The control in U, and in what the output map holds of u alone, that moves a row the most, or nearly."""
    s = ocp.system
    return retracted(ocp, ca.if_else(by_u.T > 0, ca.DM(s.ubu), ca.DM(s.lbu)))


def steps(ocp: OCP, lasting: float) -> int:
    """How many steps of RK4 a run takes at least where the map is at work."""
    return math.ceil(max((lasting / _time(row, lasting) for _, row in _rows(ocp) if row.order), default=1.0))


def _time(row: Moved, lasting: float) -> float:
    """s of a row."""
    quick = math.sqrt(2 * BEYOND / row.usual) if row.order == 2 else math.inf
    return min(CORRECTION * lasting, quick)


def braked(ocp: OCP, at: Arguments, v: ca.SX, lasting: float) -> ca.SX:
    """v [nu] moved to where the rows of `guarded` are held, at symbols `at` of a policy: x, t[, p][, dt].

    lasting : how long a run is, in the system's unit of time; s and w are shares of it. 0: where that is not known, or
        where f is not; rows that the control moves itself are held alone
    """
    rows = _rows(ocp, learned=not lasting)
    if not rows:
        return v
    own, said, dt = ocp.functions.arguments, ca.SX.sym("v", ocp.system.nu), ca.SX.sym("dt")
    wanted = [_wanted(ocp, row, said, ca.fmax(_time(row, lasting), dt)) for _, row in rows]
    u = said
    for _ in range(PASSES if len(wanted) > 1 else 1):
        for short, by_u, flat in wanted:
            u = _pushed(ocp, u, said, short, by_u, flat)
    moved = own.but("u").function("braked", {"u": ca.cse(u)}, v=said, dt=dt)
    return at.given(v=v, dt=at["dt"] if "dt" in at.names else ca.SX(0)).call(moved)


def _wanted(ocp: OCP, row: Moved, v: ca.SX, s: ca.SX) -> tuple[ca.SX, ca.SX, float]:
    """(what is missing at v, the row's slope by u there, how far U moves it where that is little)."""
    u, w, flat = ocp.functions.arguments["u"], WINDOW * s, FLAT[row.order] * row.usual
    by_u, got = (ca.substitute(e, u, v) for e in (ca.jacobian(row.moved, u), row.moved))
    if row.order == 0:
        return -got, by_u, flat
    if row.order == 1:
        return -ca.fmax(row.h, 0) / s - ca.fmin(row.h, 0) / w - got, by_u, flat
    most = got + ca.mtimes(by_u, _best(ocp, by_u) - v)
    closing = ca.fmin(row.slope, 0)
    stop = closing**2 / (ca.fmax(2 * row.h, -s * closing) + NOTHING)
    spare = ca.fmax(1 - stop / (RESERVE * ca.fmax(most, IDLE * row.usual)), 0)
    return stop - spare * (ca.fmax(row.h, 0) / w**2 - closing / w) - ca.fmin(row.h, 0) / w**2 - got, by_u, flat


def _pushed(ocp: OCP, u: ca.SX, v: ca.SX, missing: ca.SX, by_u: ca.SX, flat: float) -> ca.SX:
    """u changed, as little as needed in halves of U, by what is missing at v; where that leaves U, the rest is made up
    on the way to the control that moves the row the most."""
    s = ocp.system
    half, small = ca.DM(((s.ubu - s.lbu) / 2) ** 2), flat**2
    short = ca.fmax(missing - ca.mtimes(by_u, u - v), 0)
    step = half * by_u.T * short / (ca.mtimes(by_u, half * by_u.T) + small)
    moved = retracted(ocp, ca.fmin(ca.fmax(u + step, ca.DM(s.lbu)), ca.DM(s.ubu)))
    rest, to_best = ca.fmax(missing - ca.mtimes(by_u, moved - v), 0), _best(ocp, by_u) - moved
    gain = ca.mtimes(by_u, to_best)
    return moved + to_best * ca.fmin(rest * gain / (gain**2 + small), 1)
