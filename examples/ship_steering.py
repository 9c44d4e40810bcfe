"""A cargo ship back on its track by its rudder, which turns slowly.

Nomoto's model with Norrbin's cubic term; constants of the Mariner class at 15 knots as in Fossen (1994), "Guidance
and control of ocean vehicles"; the cubic term, weights and horizon are our own choice.
"""

import casadi as ca
import numpy as np

import nocl

speed, K, T = 7.7, 0.185, 107.3  # m/s, 1/s, s
n3 = 3000.0  # s^2, our own choice: hard rudder turns it by about 1.8 degrees a second
rudder_max, rudder_rate = np.radians(35.0), np.radians(2.5)  # rad, rad/s

y, psi, r, rudder = (ca.SX.sym(name) for name in ("y", "psi", "r", "rudder"))

ship = nocl.System(
    "ship_steering", x=ca.vertcat(y, psi, r), u=rudder,
    xdot=ca.vertcat(speed * ca.sin(psi), r, (K * rudder - r - n3 * r**3) / T),
    lbu=[-rudder_max], ubu=[rudder_max], lbx=[-300, -1.5, -0.04], ubx=[300, 1.5, 0.04],
    units={"y": "m", "psi": "rad", "r": "rad/s", "rudder": "rad"})

system = nocl.limit_rates(ship, {"rudder": rudder_rate})
error = (y / 50)**2 + psi**2
ocp = nocl.OCP(
    system, horizon=200.0, running=error + 0.5 * rudder**2 + 10 * system.u**2, terminal=100 * (error + (100 * r)**2),
    x_goal=[0, 0, 0, 0], u_goal=[0], initial_states=nocl.Uniform([-150, -0.5, -0.005, 0], [150, 0.5, 0.005, 0]),
    state_bounds={"rudder": (-rudder_max, rudder_max)})
