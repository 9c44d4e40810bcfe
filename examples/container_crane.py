"""A container crane: ten metres along the quay, eight up, with the least swing, in nine seconds.

Sakawa and Shindo (1982), "Optimal control of container cranes", Automatica 18(3). The cost has no control in it, as
published, and the end is fixed; the load starts from all about the published state, which sinks already.
"""

import casadi as ca

import nocl

gravity, coupling = 17.2656, 27.0756  # m/s^2: what the swing does to the trolley, and to itself

x1, x2, x3, x4, x5, x6 = (ca.SX.sym(name) for name in ("trolley", "rope", "swing", "v", "v_rope", "omega"))
u1, u2 = ca.SX.sym("drive"), ca.SX.sym("hoist")

system = nocl.System(
    "container_crane", x=ca.vertcat(x1, x2, x3, x4, x5, x6), u=ca.vertcat(u1, u2),
    xdot=ca.vertcat(x4, x5, x6, u1 + gravity * x3, u2, -(u1 + coupling * x3 + 2 * x5 * x6) / x2),
    lbu=[-2.83374, -0.80865], ubu=[2.83374, 0.71265], lbx=[-2, 10, -0.5, -3, -2, -0.5], ubx=[12, 25, 0.5, 3, 2, 0.5],
    units={"trolley": "m", "rope": "m", "swing": "rad", "v": "m/s", "v_rope": "m/s", "omega": "rad/s",
           "drive": "m/s^2", "hoist": "m/s^2"})

end = {"trolley": (x1, 10), "rope": (x2, 14), "swing": (x3, 0), "v": (x4, 2.5), "v_rope": (x5, 0), "omega": (x6, 0)}
ocp = nocl.OCP(
    system, horizon=9.0, running=0.5 * (x3**2 + x6**2), terminal=0.0,
    initial_states=nocl.Gaussian(mean=[0, 22, 0, 0, -1, 0], std=[0.2, 0.2, 0.005, 0.05, 0, 0.002]),
    state_bounds={"v": (-2.5, 2.5), "v_rope": (-1.0, 1.0)},
    terminal_constraints={f"{name} at the end": (value, x, value) for name, (x, value) in end.items()})
