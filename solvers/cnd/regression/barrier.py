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
boundary, and U gives h' >= 0, or h'' >= 0, at most of them. The places are those where plans come near, where some do:
a converter's current is held by its switch as soon as there is some voltage, and where there is none no plan has much
current; elsewhere they are all over the box X. Other rows are not for the map, like the distance of a rotor craft from
what is beside it: it would do harm by asking for what cannot be. Margins hold such rows (held.py). The map looks
at one row after the other, each with all of U: in a corner of two boundaries it may give too little.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from nocl.data import Solution
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
TRIED = 4096  # places in X at which rows are looked at: of those inside, the quarter nearest to the boundary
TOUCHED = 0.05  # of a scale: how near plans come where they come near
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


@dataclass(frozen=True, eq=False)
class Places:
    """What is known of a row at places: h, how far the half of U moves it, and the most that U gives, [n] each."""

    h: Array
    size: Array
    most: Array

    def __len__(self) -> int:
        return len(self.h)

    def __getitem__(self, rows: NDArray[np.bool_] | NDArray[np.int64]) -> Places:
        return Places(self.h[rows], self.size[rows], self.most[rows])


def guarded(ocp: OCP, plans: Solution | None = None, learned: bool = False) -> NDArray[np.bool_]:
    """Which rows along a trajectory and at its end [m + those at the end] the map holds: inequalities that the control
    moves soon enough, at once where the dynamics are `learned`, and that are not of the control alone (projection.py).

    plans : solutions that say where a row is touched, where they come near
    """
    found = np.zeros(len(ocp.functions.rows) + len(ocp.functions.end_rows), dtype=bool)
    for i, row in _moved_rows(ocp):
        found[i] = not (learned and row.order) and _sure(ocp, row, plans)
    return found


def _moved_rows(ocp: OCP) -> list[tuple[int, Moved]]:
    """Rows that the control moves, by number; where the equations of motion are not known, and in discrete time, those
    that it moves at once."""
    of, m = ocp.functions, len(ocp.functions.rows)
    mine = ~of.rows.equal & ~projected(ocp)
    moved = [(int(i), _at_once(ocp, of.rows.column[int(i)] / float(of.scales[i])))
             for i in np.flatnonzero(mine & of.rows.of_u)]
    if ocp.system.xdot is not None and not ocp.system.is_discrete:
        moved += [(int(i), _moved(ocp, of.rows.column[int(i)] / float(of.scales[i])))
                  for i in np.flatnonzero(mine & ~of.rows.of_u)]
        moved += [(m + int(i), _budget(ocp, of.end_rows.column[int(i)] / float(of.end_scales[i])))
                  for i in np.flatnonzero(~of.end_rows.equal)]
    return [(i, row) for i, row in moved if row is not None]


def _rows(ocp: OCP, held: NDArray[np.bool_] | None) -> list[Moved]:
    """The rows that are `held`, or those of `guarded`."""
    held = guarded(ocp) if held is None else held
    return [row for i, row in _moved_rows(ocp) if held[i]]


def _at_once(ocp: OCP, h: ca.SX) -> Moved | None:
    """A row of states and controls; None where that is not affine in u, or nothing violates it."""
    return _usually(ocp, Moved(h, ca.SX(0), h, 0, 0.0))


def _moved(ocp: OCP, c: ca.SX) -> Moved | None:
    """The first or second derivative of a row c along f that the control moves; None where it does not do so affinely.
    """
    h, u = c + TOLERANCE / 2, ocp.functions.arguments["u"]
    slope = _along(ocp, h)
    for order, moved in ((1, slope), (2, _along(ocp, slope))):
        if ca.depends_on(moved, u):
            return _usually(ocp, Moved(h, slope, moved, order, 0.0))
    return None


def _budget(ocp: OCP, c: ca.SX) -> Moved | None:
    """A row at the end of what is used up and never comes back, as fuel or a dose: it holds all along."""
    row = _moved(ocp, c)
    if row is None or row.order != 1:
        return None
    most = _in_box(ocp, row).most
    return row if len(most) == TRIED and most.max() <= IDLE * row.usual else None


def _usually(ocp: OCP, row: Moved) -> Moved | None:
    """The row with how far it is usually moved; None where that is not affine in u, or nothing."""
    u = ocp.functions.arguments["u"]
    if ca.depends_on(ca.jacobian(row.moved, u), u):
        return None
    box = _in_box(ocp, row)
    near = _near(box, row.order)
    usual = float(np.median(near.size)) if len(near) else 0.0
    return row._replace(usual=usual) if usual > IDLE * box.size.max(initial=0.0) else None


def _along(ocp: OCP, e: ca.SX) -> ca.SX:
    """de/dt along f."""
    at = ocp.functions.arguments
    change = ca.jtimes(e, at["x"], at.call(ocp.functions.f))
    return change + ca.jtimes(e, at["t"], ca.SX(1)) if "t" in at.names else change


def _sure(ocp: OCP, row: Moved, plans: Solution | None) -> bool:
    """Whether the control is a sure hold of a row where plans come near its boundary, or else all over X."""
    near = _near(_in_box(ocp, row), row.order)
    if plans is not None:
        on_plans = _on_plans(ocp, row, plans)
        touched = on_plans[np.abs(on_plans.h) <= TOUCHED] if row.order else _near(on_plans, 0)
        near = touched if len(touched) else near
    steady = row.order == 0 or near.size.min() > SURE * row.usual
    return bool(steady and (near.most >= 0).mean() >= MOSTLY)


def _near(box: Places, order: int) -> Places:
    """The quarter of the places inside that is nearest to the boundary, or one of them; of a row that is moved at once,
    where some control violates it."""
    if order == 0:
        return box[box.h < 0]
    inside = box[box.h >= 0]
    return inside[np.argsort(inside.h)[:max(len(inside) // 4, 1)]]


def _in_box(ocp: OCP, row: Moved) -> Places:
    """TRIED places in X x U."""
    s, rng = ocp.system, np.random.default_rng(0)
    x, u = rng.uniform(s.lbx, s.ubx, (TRIED, s.nx)), rng.uniform(s.lbu, s.ubu, (TRIED, s.nu))
    return _places(ocp, row, x=x, u=u, **ocp.moments(TRIED))


def _on_plans(ocp: OCP, row: Moved, plans: Solution) -> Places:
    """The nodes of plans that succeeded, under any control."""
    s = plans[plans.success]
    x, t, p = s.x.reshape(-1, s.x.shape[2]), s.t.ravel(), np.repeat(s.parameters, s.x.shape[1], axis=0)
    u = np.random.default_rng(0).uniform(ocp.system.lbu, ocp.system.ubu, (len(x), ocp.system.nu))
    return _places(ocp, row, x=x, u=u, t=t, p=p)


def _places(ocp: OCP, row: Moved, **where: Array) -> Places:
    """What is known of a row there, at places where all of it is finite."""
    s, at = ocp.system, ocp.functions.arguments
    by_u = ca.jacobian(row.moved, at["u"])
    size = ca.norm_2(by_u.T * ca.DM((s.ubu - s.lbu) / 2))
    most = row.moved + ca.mtimes(by_u, _best(ocp, by_u) - at["u"])
    tried = at.function("tried", {"h": row.h, "size": size, "most": most})
    n = len(where["x"])
    found = np.array([np.broadcast_to(ca.DM(value).full().ravel(), n) for value in tried(*at.columns(**where))])
    return Places(*found[:, np.isfinite(found).all(axis=0)])


def _best(ocp: OCP, by_u: ca.SX) -> ca.SX:
    """The control in U, and in what the output map holds of u alone, that moves a row the most, or nearly."""
    s = ocp.system
    return retracted(ocp, ca.if_else(by_u.T > 0, ca.DM(s.ubu), ca.DM(s.lbu)))


def steps(ocp: OCP, lasting: float, held: NDArray[np.bool_] | None = None) -> int:
    """How many steps of RK4 a run takes at least where the map is at work."""
    return math.ceil(max((lasting / _time(row, lasting) for row in _rows(ocp, held) if row.order), default=1.0))


def _time(row: Moved, lasting: float) -> float:
    """s of a row."""
    quick = math.sqrt(2 * BEYOND / row.usual) if row.order == 2 else math.inf
    return min(CORRECTION * lasting, quick)


def braked(ocp: OCP, at: Arguments, v: ca.SX, lasting: float, held: NDArray[np.bool_] | None = None) -> ca.SX:
    """v [nu] moved to where rows are held, at symbols `at` of a policy: x, t[, p][, dt].

    lasting : how long a run is, in the system's unit of time; s and w are shares of it
    held : which rows, as `guarded` says; None: as it says without plans
    """
    rows = _rows(ocp, held)
    if not rows:
        return v
    own, said, dt = ocp.functions.arguments, ca.SX.sym("v", ocp.system.nu), ca.SX.sym("dt")
    wanted = [_wanted(ocp, row, said, ca.fmax(_time(row, lasting), dt)) for row in rows]
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
