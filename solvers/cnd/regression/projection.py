"""Constraints of the control alone, in the output map of a policy: what it says holds them, to rounding.

The map is a retraction: along the ray from a point u_c that holds all of them strictly, back to where the first one
begins, u = v - (v - u_c) (1 - 1 / max(1, q)). What holds them is left as it is. Along a ray u_c + s d a row c is a
parabola c_0 + b s + a s^2 with c_0 > 0 >= a, where it is affine or concave and quadratic in u, as half-spaces, balls
and ellipsoids are; its zero is at s = 1 / q, q = (-b + sqrt(b^2 - 4 a c_0)) / (2 c_0), without a division by what may
vanish. From a point in the box U it stays there. Other rows that hold the control are learned as those of states are.
"""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from nocl.definition.ocp import OCP
from nocl.support.checks import Array

CURVED = 1e-9  # of the largest entry: a Hessian's eigenvalue above that is not concave
DEEP = 0.2  # of the deepest point's distance to what is held: u* is the centre where it is as deep
TRIED = 256  # controls at which a row is held against its quadratic model
TINY = 1e-30  # under the root, whose slope at 0 is inf
QUIET: dict[str, Any] = {"print_time": False, "ipopt.print_level": 0, "ipopt.sb": "yes", "ipopt.tol": 1e-8}


def projected(ocp: OCP) -> NDArray[np.bool_]:
    """Which rows along a trajectory [m] the output map of a policy holds: affine or concave quadratic ones of u alone.
    """
    rows, at = ocp.functions.rows, ocp.functions.arguments
    others = ca.vertcat(*at.but("u").inputs)
    found = np.zeros(len(rows), dtype=bool)
    for i in np.flatnonzero(rows.of_u & ~rows.equal):
        c = rows.column[int(i)]
        found[i] = not ca.depends_on(c, others) and _concave(c, at["u"]) and _smooth(ocp, c)
    return found


def _concave(c: ca.SX, u: ca.SX) -> bool:
    """Whether c is affine in u, or quadratic and concave."""
    H = ca.hessian(c, u)[0]
    if ca.depends_on(H, u):
        return False
    values = np.linalg.eigvalsh(ca.DM(ca.densify(ca.evalf(H))).full())
    return bool(values.max() <= CURVED * max(np.abs(values).max(), 1e-300))


def _smooth(ocp: OCP, c: ca.SX) -> bool:
    """Whether c is what its value and derivatives at the middle of U say everywhere in U: |u| has none that do."""
    s, u, d = ocp.system, ocp.functions.arguments["u"], ca.SX.sym("d", ocp.system.nu)
    middle = ca.DM((s.lbu + s.ubu) / 2)
    H, g = ca.hessian(c, u)
    model = c + ca.dot(g, d) + ca.bilin(H, d, d) / 2
    both = ca.Function("both", [d], [ca.substitute(model, u, middle), ca.substitute(c, u, middle + d)])
    away = np.random.default_rng(0).uniform(-1, 1, (TRIED, s.nu)) * (s.ubu - s.lbu) / 2
    said, true = (value.full() for value in both(away.T))
    return bool(np.allclose(said, true, rtol=1e-9, atol=1e-9 * np.abs(true).max()))


def retracted(ocp: OCP, v: ca.SX) -> ca.SX:
    """v [nu] in U, moved to where all rows of `projected` hold; v itself where there are none."""
    mine = np.flatnonzero(projected(ocp))
    if not mine.size:
        return v
    u, rows = ocp.functions.arguments["u"], ocp.functions.rows
    centre, over = ca.DM(_centre(ocp, mine)), ca.SX(1)
    d = v - centre
    for i in mine:
        c = rows.column[int(i)] / float(ocp.functions.scales[i])
        H, g = ca.hessian(c, u)
        c_0, g_0 = (ca.substitute(e, u, centre) for e in (c, g))
        a, b = ca.bilin(H, d, d) / 2, ca.dot(g_0, d)
        root = ca.sqrt(b**2 - 4 * ca.fmin(a, 0) * c_0 + TINY)
        over = ca.fmax(over, (root - b) / (2 * c_0))
    return v - d * (1 - 1 / over)  # v itself, bit for bit, where nothing is over


def _centre(ocp: OCP, mine: NDArray[np.int64]) -> Array:
    """u* where it holds the rows well, or the point of U that is deepest inside, in units of U and the scales.

    Raises ValueError where no control holds all of them strictly.
    """
    s, scales = ocp.system, ocp.functions.scales[mine]
    u, depth = ocp.functions.arguments["u"], ca.SX.sym("depth")
    half = (s.ubu - s.lbu) / 2
    inside = ca.vertcat(*(ocp.functions.rows.column[int(i)] / size for i, size in zip(mine, scales, strict=True)),
                        (u - ca.DM(s.lbu)) / ca.DM(half), (ca.DM(s.ubu) - u) / ca.DM(half))
    deepest = ca.nlpsol("deepest", "ipopt", {"x": ca.vertcat(u, depth), "f": -depth, "g": inside - depth}, QUIET)
    start = (s.lbu + s.ubu) / 2
    z = deepest(x0=np.r_[start, 0.0], lbg=0.0, lbx=np.r_[s.lbu, -np.inf], ubx=np.r_[s.ubu, 1.0])["x"].full().ravel()
    most, at_goal = (float(ca.evalf(ca.mmin(ca.substitute(inside, u, ca.DM(at))))) for at in (z[:-1], ocp.u_goal))
    if not most > 0:
        names = ", ".join(dict.fromkeys(repr(ocp.functions.rows.names[i]) for i in mine))
        raise ValueError(f"no control in U holds {names} with room to spare; expected constraints of u alone that some "
                         "control inside U holds strictly: widen their bounds, or lbu and ubu")
    return np.asarray(ocp.u_goal if at_goal >= DEEP * most else z[:-1])
