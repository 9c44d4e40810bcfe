"""Fed-batch fermentation of penicillin: as much product as the feed can make in 150 hours.

Srinivasan, Bonvin, Visser and Palanki (2003), "Dynamic optimization of batch processes II", Computers and Chemical
Engineering 27(1); numbers as in do-mpc's example "batch bioreactor". Its penalty on moves of the feed is left out:
here a small one on the feed itself.
"""

import casadi as ca

import nocl

mu_max, K_m, K_i = 0.02, 0.05, 5.0  # 1/h, g/l, g/l
v_product, Y_p, Y_x, S_in = 0.004, 1.2, 0.4, 200.0  # 1/h, 1, 1, g/l

X, S, P, V, F = (ca.SX.sym(name) for name in ("X", "S", "P", "V", "F"))
mu = mu_max * S / (K_m + S + S**2 / K_i)

system = nocl.System(
    "penicillin", x=ca.vertcat(X, S, P, V), u=F,
    xdot=ca.vertcat(mu * X - F / V * X, -mu * X / Y_x - v_product * X / Y_p + F / V * (S_in - S),
                    v_product * X - F / V * P, F),
    lbu=[0], ubu=[0.2], lbx=[0, 0, 0, 100], ubx=[3.7, 2, 3, 160],
    units={"X": "g/l", "S": "g/l", "P": "g/l", "V": "l", "F": "l/h"})

ocp = nocl.OCP(
    system, horizon=150.0, running=-P + F**2, terminal=-P,
    initial_states=nocl.Gaussian(mean=[1.0, 0.5, 0, 120], std=[0.05, 0.05, 0, 2]),
    state_bounds={"X": (None, 3.7), "P": (None, 3.0), "S": (-0.01, None)})
