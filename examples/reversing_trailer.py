"""A car that reverses with a trailer into a lane, without jack-knifing.

Kinematics of a car with a trailer hitched to its rear axle (Laumond, ed., 1998, "Robot motion planning and control",
chapter 1); lengths, limits and weights are our own choice.
"""

import casadi as ca

import nocl

wheelbase, hitch = 2.7, 4.0  # m, from the car's rear axle to the trailer's
v_max, steer_max, fold_max = 1.5, 0.6, 1.0  # m/s, rad, rad

x, y, theta, phi = (ca.SX.sym(name) for name in ("x", "y", "theta", "phi"))  # of the car's rear axle; car, trailer
v, steer = ca.SX.sym("v"), ca.SX.sym("steer")

system = nocl.System(
    "reversing_trailer", x=ca.vertcat(x, y, theta, phi), u=ca.vertcat(v, steer),
    xdot=ca.vertcat(v * ca.cos(theta), v * ca.sin(theta),
                    v * ca.tan(steer) / wheelbase, v * ca.sin(theta - phi) / hitch),
    lbu=[-v_max, -steer_max], ubu=[v_max, steer_max], lbx=[-5, -5, -2, -2], ubx=[15, 5, 2, 2],
    units={"x": "m", "y": "m", "theta": "rad", "phi": "rad", "v": "m/s", "steer": "rad"})

ocp = nocl.OCP(
    system, horizon=12.0, running=0.05 * v**2 + 0.2 * steer**2,
    terminal=2 * x**2 + 10 * y**2 + 20 * (theta**2 + phi**2),
    x_goal=[0, 0, 0, 0], u_goal=[0, 0],
    initial_states=nocl.Uniform([9, -1.0, -0.1, -0.1], [11, 1.0, 0.1, 0.1]),
    constraints={"fold": (-fold_max, theta - phi, fold_max)})
