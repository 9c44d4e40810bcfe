"""The problems that constrained policies are judged on, with their constraints in nocl's words."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import replace

import casadi as ca
import numpy as np
import provenance

import nocl

sys.path.insert(0, str(provenance.ROOT / "tests"))
from constrained import planar_quadrotor as planar_of
from constrained import point as point_of


def cartpole() -> nocl.OCP:
    """The bundled problem on a track, |p| <= 0.6 and |v| <= 2."""
    ocp = nocl.load_ocp("cartpole")
    return replace(ocp, constraints={"track": (-0.6, ocp.system.x[0], 0.6)}, state_bounds={"v": (-2.0, 2.0)})


def dubins() -> nocl.OCP:
    """The bundled problem; its obstacle is a path constraint."""
    return nocl.load_ocp("dubins")


def _ends(ocp: nocl.OCP) -> dict[str, tuple[float, ca.SX, float]]:
    states = zip(ocp.system.state_names, ca.vertsplit(ocp.system.x), ocp.x_goal, strict=True)
    return {f"{name} at the end": (goal, x, goal) for name, x, goal in states}


def point() -> nocl.OCP:
    """A point in the plane, from rest to rest: a disc, limits of speed and thrust, all of the end."""
    ocp = point_of().ocp
    (px, py, vx, vy), (ax, ay) = ca.vertsplit(ocp.system.x), ca.vertsplit(ocp.system.u)
    return replace(ocp, constraints={"disc": (px + 1)**2 + (py - 0.1)**2 - 0.25, "speed": (None, vx**2 + vy**2, 1.0),
                                     "thrust": (None, ax**2 + ay**2, 1.5**2)}, terminal_constraints=_ends(ocp))


def planar() -> nocl.OCP:
    """A planar quadrotor: a disc, limits of tilt, speed and of both thrusts together, all of the end."""
    ocp = planar_of().ocp
    x, z, phi, vx, vz, _ = ca.vertsplit(ocp.system.x)
    return replace(ocp, constraints={"tilt": (-0.5, phi, 0.5), "speed": (None, vx**2 + vz**2, 4.0),
                                     "disc": x**2 + (z - 0.3)**2 - 0.16, "thrust": (None, ca.sum1(ocp.system.u), 14.0)},
                   terminal_constraints=_ends(ocp))


def pendcart() -> nocl.OCP:
    """acados' pendulum on a cart (M 1, m 0.1, l 0.8; forces up to 80 N), restated, on a track of +-0.5 m."""
    p, th, v, w = (ca.SX.sym(name) for name in ("x1", "theta", "v1", "dtheta"))
    F = ca.SX.sym("F")
    M, m, g, length = 1.0, 0.1, 9.81, 0.8
    den = M + m - m * ca.cos(th)**2
    swing = -m * length * ca.sin(th) * w**2
    system = nocl.System(
        "pendulum_ode", x=ca.vertcat(p, th, v, w), u=F,
        xdot=ca.vertcat(v, w, (swing + m * g * ca.cos(th) * ca.sin(th) + F) / den,
                        (swing * ca.cos(th) + F * ca.cos(th) + (M + m) * g * ca.sin(th)) / (length * den)),
        lbu=[-80], ubu=[80], lbx=[-2, -2 * np.pi, -20, -20], ubx=[2, 2 * np.pi, 20, 20])
    cost = 1e3 * (p**2 + th**2) + 1e-2 * (v**2 + w**2)
    return nocl.OCP(system, horizon=1.0, running=cost + 1e-2 * F**2, terminal=cost, x_goal=[0] * 4, u_goal=[0],
                    initial_states=nocl.Gaussian(mean=[0, np.pi, 0, 0], std=[0.05, 0.1, 0.1, 0.1]),
                    path_constraints={"right": 0.5 - p, "left": p + 0.5})


def lap() -> nocl.OCP:
    """The least time for 2.5 m of acados' miniature race track (Kloeser), restated: the independent variable is the way
    s along the middle of the track, so that the horizon is fixed, and time is what it costs. A small price keeps the
    rates of throttle and steering apart from noise."""
    s, n, al, v, D, de = (ca.SX.sym(name) for name in ("s", "n", "alpha", "v", "D", "delta"))
    throttle, steering = ca.SX.sym("derD"), ca.SX.sym("derDelta")
    m, C1, C2, Cm1, Cm2, Cr0, Cr2 = 0.043, 0.5, 15.5, 0.28, 0.05, 0.011, 0.006
    bends = [(ca.tanh(8 * (s - begin)) - ca.tanh(8 * (s - end))) / 2 for begin, end in ((0.5, 1.2), (1.6, 2.2))]
    kappa = 2.0 * bends[0] - 1.5 * bends[1]
    force = (Cm1 - Cm2 * v) * D - Cr2 * v**2 - Cr0 * ca.tanh(5 * v)
    s_dot = v * ca.cos(al + C1 * de) / (1 - kappa * n)
    by_time = ca.vertcat(s_dot, v * ca.sin(al + C1 * de), v * C2 * de - kappa * s_dot, force / m * ca.cos(C1 * de),
                         throttle, steering)
    system = nocl.System(
        "racecar", x=ca.vertcat(s, n, al, v, D, de), u=ca.vertcat(throttle, steering), xdot=by_time / s_dot,
        lbu=[-10, -2], ubu=[10, 2], lbx=[-1, -0.12, -0.8, 0.3, -1, -0.4], ubx=[4, 0.12, 0.8, 3, 1, 0.4])
    lateral = C2 * v**2 * de + force * ca.sin(C1 * de) / m
    return nocl.OCP(
        system, horizon=2.5, running=(1 + 1e-4 * throttle**2 + 5e-3 * steering**2) / s_dot, terminal=0.0,
        initial_states=nocl.Gaussian(mean=[0, 0, 0, 1.0, 0.3, 0], std=[0.05, 0.02, 0.05, 0.1, 0.05, 0.02]),
        state_bounds={"n": (-0.12, 0.12), "v": (0.3, None), "D": (-1, 1), "delta": (-0.4, 0.4)},  # s_dot > 0
        constraints={"lateral": (-4, lateral, 4), "along": (-4, force / m, 4)})


PROBLEMS: dict[str, Callable[[], nocl.OCP]] = {
    "cartpole": cartpole, "dubins": dubins, "point": point, "planar": planar, "pendcart": pendcart, "lap": lap}
