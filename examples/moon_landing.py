"""A powered descent to the Moon with the least fuel: fall, then brake as hard as the engine can.

Vertical motion with a mass that burns away, as in Meditch (1964), "On the problem of optimal thrust programming for a
lunar soft landing", IEEE Trans. Automatic Control 9(4). The lander's numbers (2.5 t, 7.5 kN, Isp = 311 s, from 2.4
km) are those of a script that is public; here the engine cannot be shut off. In a fixed time every landing would take
the same fuel.
"""

import casadi as ca

import nocl

g_moon, v_exhaust = 1.62, 311.0 * 9.81  # m/s^2, m/s
F_min, F_max = 1000.0, 7500.0  # N

y, v, m, F = (ca.SX.sym(name) for name in ("y", "v", "m", "F"))

system = nocl.System(
    "moon_landing", x=ca.vertcat(y, v, m), u=F, xdot=ca.vertcat(v, F / m - g_moon, -F / v_exhaust),
    lbu=[F_min], ubu=[F_max], lbx=[-10, -150, 1500], ubx=[3000, 20, 2700],
    units={"y": "m", "v": "m/s", "m": "kg", "F": "N"})

ocp = nocl.OCP(
    system, horizon=nocl.Free(20.0, 120.0), running=F / v_exhaust, terminal=0.0,  # kg of fuel
    initial_states=nocl.Gaussian(mean=[2400, -70, 2500], std=[50, 3, 20]),
    state_bounds={"y": (0, None)}, terminal_constraints={"touchdown": (0, y, 0), "softly": (0, v, 0)})
