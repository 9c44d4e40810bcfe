"""Two catalysts along a tubular reactor, mixed so that the most of the last product comes out: bang, singular, bang.

Gunn and Thomas (1965), "Mass transport and chemical reaction in multifunctional catalyst systems", Chemical
Engineering Science 20; numbers as in COPS 3.0 (Dolan, More and Munson, 2004), "catalyst mixing".
"""

import casadi as ca

import nocl

forth, back, further = 1.0, 10.0, 1.0  # of the reactions A <-> B -> C, for each unit of length

A, B, u = ca.SX.sym("A"), ca.SX.sym("B"), ca.SX.sym("u")  # u: the share of the first catalyst
first = forth * A - back * B

system = nocl.System(
    "catalyst_mixing", x=ca.vertcat(A, B), u=u, xdot=ca.vertcat(-u * first, u * first - (1 - u) * further * B),
    lbu=[0], ubu=[1], lbx=[0, 0], ubx=[1.1, 0.3])

ocp = nocl.OCP(
    system, horizon=1.0, running=0.0, terminal=A + B, initial_states=nocl.Uniform([0.9, 0.0], [1.0, 0.05]))
