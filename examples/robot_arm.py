"""A two-link arm in the vertical plane, swung upright by torques, its hand always above a table.

The textbook's arm (Spong, Hutchinson and Vidyasagar, "Robot modeling and control"), with two uniform links; their
numbers, the limits and the weights are our own choice.
"""

import casadi as ca
import numpy as np

import nocl

mass, length, g = 1.0, 0.5, 9.81  # kg and m, of each link; m/s^2
inertia, centre = mass * length**2 / 12, length / 2  # kg m^2, m
table = -0.6  # m

q1, q2, w1, w2 = (ca.SX.sym(name) for name in ("q1", "q2", "w1", "w2"))  # q1 = pi / 2, q2 = 0: upright
tau1, tau2 = ca.SX.sym("tau1"), ca.SX.sym("tau2")
a = 2 * inertia + mass * centre**2 + mass * (length**2 + centre**2)
b, d = mass * length * centre, inertia + mass * centre**2
M = ca.blockcat([[a + 2 * b * ca.cos(q2), d + b * ca.cos(q2)], [d + b * ca.cos(q2), d]])
coriolis = ca.vertcat(-b * ca.sin(q2) * (2 * w1 * w2 + w2**2), b * ca.sin(q2) * w1**2)
lower, upper = mass * (centre + length) * g * ca.cos(q1), mass * centre * g * ca.cos(q1 + q2)
acceleration = ca.solve(M, ca.vertcat(tau1, tau2) - coriolis - ca.vertcat(lower + upper, upper))

system = nocl.System(
    "robot_arm", x=ca.vertcat(q1, q2, w1, w2), u=ca.vertcat(tau1, tau2), xdot=ca.vertcat(w1, w2, acceleration),
    lbu=[-15, -8], ubu=[15, 8], lbx=[-np.pi, -np.pi, -10, -10], ubx=[np.pi, np.pi, 10, 10],
    units={"q1": "rad", "q2": "rad", "w1": "rad/s", "w2": "rad/s", "tau1": "N m", "tau2": "N m"})

goal = np.array([np.pi / 2, 0, 0, 0])
error = (system.x - ca.DM(goal))**2
hand = length * ca.sin(q1) + length * ca.sin(q1 + q2)  # m, its height
ocp = nocl.OCP(
    system, horizon=2.0, running=ca.dot(ca.DM([10, 10, 0.1, 0.1]), error) + 0.01 * (tau1**2 + tau2**2),
    terminal=ca.dot(ca.DM([100, 100, 10, 10]), error), x_goal=goal, u_goal=[0, 0],
    initial_states=nocl.Gaussian(mean=[-0.5, 0.5, 0, 0], std=[0.2, 0.2, 0.1, 0.1]),
    constraints={"table": (table, hand, None)})
