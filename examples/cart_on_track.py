"""A pendulum on a cart, swung up within a second on a track of one metre.

Constants and weights of acados' example "getting started" (pendulum on a cart). The track is shorter here than what
its optimum needs.
"""

import casadi as ca
import numpy as np

import nocl

m_cart, m_ball, length, g = 1.0, 0.1, 0.8, 9.81  # kg, kg, m, m/s^2
F_max, track = 80.0, 0.5  # N, m to either side

p, theta, v, omega = (ca.SX.sym(name) for name in ("p", "theta", "v", "omega"))
F = ca.SX.sym("F")
sin, cos = ca.sin(theta), ca.cos(theta)
inertia = m_cart + m_ball - m_ball * cos**2

system = nocl.System(
    "cart_on_track", x=ca.vertcat(p, theta, v, omega), u=F,  # theta = 0 is upright
    xdot=ca.vertcat(
        v, omega,
        (-m_ball * length * sin * omega**2 + m_ball * g * cos * sin + F) / inertia,
        (-m_ball * length * cos * sin * omega**2 + F * cos + (m_cart + m_ball) * g * sin) / (length * inertia)),
    lbu=[-F_max], ubu=[F_max], lbx=[-2, -2 * np.pi, -20, -20], ubx=[2, 2 * np.pi, 20, 20],
    units={"p": "m", "theta": "rad", "v": "m/s", "omega": "rad/s", "F": "N"})

error = 1e3 * (p**2 + theta**2) + 1e-2 * (v**2 + omega**2)
ocp = nocl.OCP(
    system, horizon=1.0, running=error + 1e-2 * F**2, terminal=error, x_goal=[0, 0, 0, 0], u_goal=[0],
    initial_states=nocl.Gaussian(mean=[0, np.pi, 0, 0], std=[0.05, 0.1, 0.1, 0.1]),
    state_bounds={"p": (-track, track)})
