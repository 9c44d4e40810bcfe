"""To the largest circular orbit with a small constant thrust, by its direction alone; the time fixed.

Bryson and Ho (1975), "Applied optimal control", section 2.5: Earth to Mars in 193 days, in units of the first orbit
(radius, gravity and mass are 1). The mass falls with time, which stands in the equations.
"""

import casadi as ca
import numpy as np

import nocl

thrust, burn = 0.1405, 0.07487  # of m g, and of m per unit of time
horizon = 3.32  # 193 days

r, u, v, phi = (ca.SX.sym(name) for name in ("r", "u", "v", "phi"))  # phi: from the tangent outwards
push = thrust / (1 - burn * nocl.time())

system = nocl.System(
    "orbit_transfer", x=ca.vertcat(r, u, v), u=phi,
    xdot=ca.vertcat(u, v**2 / r - 1 / r**2 + push * ca.sin(phi), -u * v / r + push * ca.cos(phi)),
    lbu=[-np.pi], ubu=[2 * np.pi], lbx=[0.8, -0.5, 0.5], ubx=[1.8, 0.5, 1.3], units={"phi": "rad"})

ocp = nocl.OCP(
    system, horizon=horizon, running=0.0, terminal=-r,
    initial_states=nocl.Gaussian(mean=[1.0, 0.0, 1.0], std=[0.01, 0.01, 0.01]),
    terminal_constraints={"no way out": (0, u, 0), "circular": (0, v - 1 / ca.sqrt(r), 0)})
