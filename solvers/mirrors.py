"""Mirror images of a problem: changes of sign about the goal pair under which it stays what it is."""

from __future__ import annotations

import itertools
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components

from nocl.definition.goals import beside
from nocl.definition.ocp import OCP
from nocl.judge.laws import dynamics_function
from nocl.support.checks import Array

Mirror = tuple[Array, Array]  # signs of x - x* [nx] and of u - u* [nu]
LARGEST = 10  # groups of coordinates up to which mirror images of the problem are looked for, by trying all signs
PROBES = 5  # states that a mirror image must hold at
ROUNDING = 1e-9  # of the largest: a derivative that counts as none
EQUAL = 1e-10  # relative difference of equal costs and derivatives
LEARNED = 1e-3  # ... of a learned f: an image is where a solve starts from, no more


def mirrors(ocp: OCP, dynamics: Any = None) -> list[Mirror]:
    """Signs (of x - x* [nx], of u - u* [nu]) under which f, L, G, h and U stay what they are, other than all +1.

    They hold at any parameters, and change none; the goal pair is that of each. Found by trial at random points, so up
    to rounding, or with `dynamics` in place of f up to LEARNED; none are looked for with more than LARGEST groups of
    coordinates that f, L and G couple at the goal, and so must share a sign.
    """
    s, equal = ocp.system, EQUAL if dynamics is None else LEARNED
    if s.xdot is None and dynamics is None:  # a plant that is not known: no symmetry is
        return []
    f_of = dynamics_function(ocp, dynamics)
    group = _coupled(ocp, f_of, ROUNDING if dynamics is None else LEARNED)
    if group.max() >= LARGEST:
        return []
    rng, n = np.random.default_rng(0), s.nx
    z = rng.uniform(-0.5, 0.5, (PROBES, n + s.nu)) * np.r_[s.ubx - s.lbx, s.ubu - s.lbu] / 2
    moments, of = ocp.moments(PROBES), ocp.functions
    goal = np.column_stack(ocp.goals(moments["p"]))
    middle = (s.lbu + s.ubu) / 2 - goal[:, n:]  # of U: a sign may change only where u* is in it

    def everything(signs: Array) -> Array:
        x, u = np.split(z * signs + goal, [n], axis=1)
        stage, node, end = (a.columns(x=x, u=u, **moments) for a in (of.arguments, of.node, of.end))
        f = f_of(*stage).full() * signs[:n, None]
        return np.vstack([f, of.L(*stage).full(), of.G(*end).full(), *_held(ocp, stage, node, end)])

    same, found = everything(np.ones(n + s.nu)), []
    for flips in itertools.product((1.0, -1.0), repeat=int(group.max()) + 1):
        signs = np.array(flips)[group]
        if (signs > 0).all() or np.abs(middle[:, signs[n:] < 0]).max(initial=0.0) > 0:
            continue
        if np.abs(everything(signs) - same).max() <= equal * np.abs(same).max():
            found.append((signs[:n], signs[n:]))
    return found


def _held(ocp: OCP, stage: list[Array], node: list[Array], end: list[Array]) -> list[Array]:
    """Values of all constraints, rising: which is which does not matter."""
    of = ocp.functions
    if ocp.states_only:
        return [np.sort(of.h(*node).full(), axis=0)]
    return [np.sort(rows.signed(c(*given).full()), axis=0)
            for rows, c, given in ((of.rows, of.c, stage), (of.end_rows, of.c_end, end))]


def _coupled(ocp: OCP, f: ca.Function, rounding: float) -> NDArray[np.int32]:
    """A number for each of (x, u), equal where f's Jacobian or a Hessian of L or G at the goal couples them."""
    s = ocp.system
    n, of = s.nx, ocp.functions.on(f)
    at = {"x": ocp.x_goal, "u": ocp.u_goal, "t": 0.0, "p": ocp.nominal}
    H = of.L_derivatives(*of.arguments.columns(**at))[2].full()
    H[:n, :n] += of.G_derivatives(*of.end.columns(**at))[2].full()
    A = np.hstack([j.full() for j in of.jacobian(*of.arguments.columns(**at))])
    scale = np.r_[s.ubx - s.lbx, s.ubu - s.lbu]
    A, H = np.abs(A * scale) / scale[:n, None], np.abs(H * np.outer(scale, scale))
    H[:n] += A
    return np.asarray(connected_components(rounding * H.max() < H, directed=False)[1])


def mirrored(ocp: OCP, mirror: Mirror, x: Array, u: Array, p: Array | None = None) -> tuple[Array, Array]:
    """The mirror image of states [..., nx] and controls [..., nu] at the goal pair.

    p [B, np], a row for each of the first axis, where the goal depends on it.
    """
    x_goal, u_goal = ocp.x_goal, ocp.u_goal
    if p is not None and ocp.goal_varies:
        x_goal, u_goal = (beside(goal, x.ndim) for goal in ocp.goals(p))
    return x_goal + mirror[0] * (x - x_goal), u_goal + mirror[1] * (u - u_goal)
