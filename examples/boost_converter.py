"""A boost converter from standby to twice its input voltage in four milliseconds, its current limited.

The averaged model of Middlebrook and Cuk (1976), "A general unified approach to modelling switching-converter power
stages"; constants of our own choice, of usual sizes. Non-minimum phase: the voltage falls at first where the current
is to rise.
"""

import casadi as ca

import nocl

L, C, R = 200e-6, 200e-6, 20.0  # H, F, Ohm
V_in, V_goal, i_max = 12.0, 24.0, 6.0  # V, V, A
i_goal, d_goal = V_goal**2 / (R * V_in), 1 - V_in / V_goal

i, v, d = ca.SX.sym("i"), ca.SX.sym("v"), ca.SX.sym("d")  # d: duty cycle of the switch to ground

system = nocl.System(
    "boost_converter", x=ca.vertcat(i, v), u=d,
    xdot=ca.vertcat((V_in - (1 - d) * v) / L, ((1 - d) * i - v / R) / C),
    lbu=[0.05], ubu=[0.9], lbx=[0, 0], ubx=[8, 40], units={"i": "A", "v": "V"})

error = 0.5 * (i - i_goal)**2 + (v - V_goal)**2
ocp = nocl.OCP(
    system, horizon=4e-3, running=error + 50 * (d - d_goal)**2, terminal=1e-3 * error,  # s
    x_goal=[i_goal, V_goal], u_goal=[d_goal], initial_states=nocl.Uniform([0.4, 10.5], [1.2, 13.5]),
    state_bounds={"i": (0, i_max)})
