"""A hang glider through a thermal: as far as it gets while it sinks a hundred metres.

Bulirsch, Nerz, Pesch and von Stryk (1993), "Combining direct and indirect methods in optimal control: range
maximization of a hang glider"; numbers as in COPS 3.0 (Dolan, More and Munson, 2004).
"""

import casadi as ca

import nocl

mass, area, g, rho = 100.0, 14.0, 9.80665, 1.13  # kg, m^2, m/s^2, kg/m^3
c0, k, c_max = 0.034, 0.069662, 1.4  # drag without lift, and with its square
updraft, width = 2.5, 100.0  # m/s, m: of the thermal, which stands 250 m away
vx_end, vy_end, y_end = 13.227567500, -1.2875005200, 900.0  # m/s, m/s, m: steady flight, where it starts too

x, y, vx, vy = (ca.SX.sym(name) for name in ("x", "y", "vx", "vy"))
c_L = ca.SX.sym("c_L")
place = (x / width - 2.5)**2
w = vy - updraft * (1 - place) * ca.exp(-place)  # through the air
v = ca.sqrt(vx**2 + w**2)
lift, drag = c_L * rho * area * v**2 / 2, (c0 + k * c_L**2) * rho * area * v**2 / 2

system = nocl.System(
    "hang_glider", x=ca.vertcat(x, y, vx, vy), u=c_L,
    xdot=ca.vertcat(vx, vy, (-lift * w / v - drag * vx / v) / mass, (lift * vx / v - drag * w / v) / mass - g),
    lbu=[0], ubu=[c_max], lbx=[-10, 850, 5, -10], ubx=[1500, 1100, 30, 10],
    units={"x": "m", "y": "m", "vx": "m/s", "vy": "m/s"})

ocp = nocl.OCP(
    system, horizon=nocl.Free(50.0, 150.0), running=0.0, terminal=-x,
    initial_states=nocl.Uniform([0, 995, 13.0, -1.5], [0, 1005, 13.5, -1.0]),
    terminal_constraints={"down": (0, y - y_end, 0), "vx": (0, vx - vx_end, 0), "vy": (0, vy - vy_end, 0)})
