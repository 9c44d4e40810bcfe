"""Four tanks and two pumps: levels of the lower two, each pump filling a tank below and one above the other.

Johansson (2000), "The quadruple-tank process", IEEE Trans. Control Systems Technology 8(3), minimum-phase setting.
Weights, bounds and horizon are our own choice.
"""

import casadi as ca

import nocl

A = (28.0, 32.0, 28.0, 32.0)  # cm^2, of the tanks
a = (0.071, 0.057, 0.071, 0.057)  # cm^2, of their outlets
k, gamma, g = (3.33, 3.35), (0.70, 0.60), 981.0  # cm^3/(V s), share that goes below, cm/s^2
V_goal = (3.0, 3.0)  # V

h = [ca.SX.sym(f"h{i + 1}") for i in range(4)]
v = [ca.SX.sym(f"v{i + 1}") for i in range(2)]
out = [a[i] * ca.sqrt(2 * g * h[i]) for i in range(4)]  # cm^3/s

system = nocl.System(
    "quadruple_tank", x=ca.vertcat(*h), u=ca.vertcat(*v),
    xdot=ca.vertcat(
        (out[2] - out[0] + gamma[0] * k[0] * v[0]) / A[0],
        (out[3] - out[1] + gamma[1] * k[1] * v[1]) / A[1],
        ((1 - gamma[1]) * k[1] * v[1] - out[2]) / A[2],
        ((1 - gamma[0]) * k[0] * v[0] - out[3]) / A[3]),
    lbu=[0, 0], ubu=[6, 6], lbx=[0.2] * 4, ubx=[20] * 4,
    units={**{f"h{i + 1}": "cm" for i in range(4)}, "v1": "V", "v2": "V"})

above = [(1 - gamma[1]) * k[1] * V_goal[1], (1 - gamma[0]) * k[0] * V_goal[0]]  # cm^3/s, into the upper two
flow = [above[0] + gamma[0] * k[0] * V_goal[0], above[1] + gamma[1] * k[1] * V_goal[1], *above]
h_goal = [(flow[i] / a[i])**2 / (2 * g) for i in range(4)]

error = (h[0] - h_goal[0])**2 + (h[1] - h_goal[1])**2
ocp = nocl.OCP(
    system, horizon=200.0, running=error + 0.1 * sum((v[i] - V_goal[i])**2 for i in range(2)), terminal=50 * error,
    x_goal=h_goal, u_goal=V_goal, initial_states=nocl.Uniform([5, 5, 1, 1], [15, 15, 4, 4]),
    state_bounds={f"h{i + 1}": (0.2, 20) for i in range(4)})
