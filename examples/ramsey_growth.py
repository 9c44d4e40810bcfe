"""How much of its output a country should consume, and how much invest: Ramsey's growth, discounted.

Ramsey (1928), Cass (1965), Koopmans (1965); utility -1 / c, a Cobb-Douglas economy, and numbers of our own choice.
What is left after sixty years is at least the steady state's capital.
"""

import casadi as ca

import nocl

share, wear, impatience = 1 / 3, 0.05, 0.03  # of capital; 1/a, 1/a
k_steady = (share / (wear + impatience))**(1 / (1 - share))  # marginal product = wear + impatience

k, c = ca.SX.sym("k"), ca.SX.sym("c")  # of each worker, in a unit of output

system = nocl.System(
    "ramsey_growth", x=k, u=c, xdot=k**share - wear * k - c, lbu=[0.2], ubu=[3.0], lbx=[0.5], ubx=[15.0])

ocp = nocl.OCP(
    system, horizon=60.0, running=ca.exp(-impatience * nocl.time()) / c, terminal=0.0,  # a
    initial_states=nocl.Uniform([3.0], [10.0]), terminal_constraints={"bequest": (k_steady, k, None)})
