"""A chain of masses on springs, one end held, the other moved: brought to rest, clear of a wall.

Wirsching, Bock and Diehl (2006), "Fast NMPC of a chain of masses connected by springs", IEEE CCA; numbers as in
acados' example "chain mass", with three free masses. There it starts from rest, disturbed for one second; here all
about that.
"""

from itertools import pairwise

import casadi as ca
import numpy as np

import nocl

masses, mass, stiffness, rest_length = 3, 0.033, 1.0, 0.033  # free ones; kg, N/m, m
g, wall = 9.81, -0.05  # m/s^2, m

positions = [[ca.SX.sym(f"p{i}{c}") for c in "xyz"] for i in range(1, masses + 2)]
velocities = [[ca.SX.sym(f"v{i}{c}") for c in "xyz"] for i in range(1, masses + 1)]
u = ca.vertcat(*(ca.SX.sym(f"u{c}") for c in "xyz"))  # m/s, of the last mass


def pull(first: ca.SX, second: ca.SX) -> ca.SX:
    """What a spring between two masses does to the first one's velocity, m/s^2."""
    d = second - first
    return stiffness / mass * (1 - rest_length / ca.norm_2(d)) * d


places = [ca.SX.zeros(3), *(ca.vertcat(*p) for p in positions)]
springs = [pull(first, second) for first, second in pairwise(places)]
accelerations = [springs[i + 1] - springs[i] - ca.DM([0, 0, g]) for i in range(masses)]
x = ca.vertcat(*places[1:], *(ca.vertcat(*v) for v in velocities))
xdot = ca.vertcat(*(ca.vertcat(*v) for v in velocities), u, *accelerations)

# at rest with the last mass at (1, 0, 0) m; and where one second of u = (-1, 1, 1) leads from there
hanging, n_free = ca.vertcat(*places[1:-1]), 3 * masses
still = ca.substitute(ca.vertcat(*accelerations), places[-1], ca.DM([1, 0, 0]))
guess = np.ravel([[(i + 1) / (masses + 1), 0, -0.1] for i in range(masses)])
found = ca.rootfinder("rest", "newton", ca.Function("still", [hanging], [still]))(guess).full().ravel()
x_rest = np.r_[found, 1, 0, 0, np.zeros(n_free)]
second = ca.integrator("second", "cvodes", {"x": x, "p": u, "ode": xdot}, 0, 1.0)
x_start = second(x0=x_rest, p=[-1, 1, 1])["xf"].full().ravel()

reach = np.r_[np.full(n_free + 3, 1.5), np.full(n_free, 3.0)]
system = nocl.System("chain", x=x, u=u, xdot=xdot, lbu=[-1] * 3, ubu=[1] * 3, lbx=x_rest - reach, ubx=x_rest + reach)

weights = np.r_[np.full(n_free, 2.0), np.full(3, 50.0), np.full(n_free, 2.0)]
error = ca.dot(ca.DM(weights), (x - ca.DM(x_rest))**2)
ocp = nocl.OCP(
    system, horizon=8.0, running=error + 0.02 * ca.sumsqr(u), terminal=error, x_goal=x_rest, u_goal=[0] * 3,
    initial_states=nocl.Gaussian(mean=x_start, std=np.r_[np.full(n_free + 3, 0.02), np.full(n_free, 0.05)]),
    state_bounds={f"p{i}y": (wall, None) for i in range(1, masses + 2)})
