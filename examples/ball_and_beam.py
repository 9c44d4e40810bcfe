"""A ball on a beam, brought to its middle by the torque on the beam, before it rolls off.

Hauser, Sastry and Kokotovic (1992), "Nonlinear control via approximate input-output linearization: the ball and beam
example", IEEE Trans. Automatic Control 37(3). Limits, weights and horizon are our own choice.
"""

import casadi as ca

import nocl

mass, radius, g = 0.05, 0.01, 9.81  # kg and m, of the ball; m/s^2
J_beam, J_ball = 0.02, 2e-6  # kg m^2
torque_max, half_length, tilt = 0.6, 0.6, 0.6  # N m, m, rad

r, v, theta, omega = (ca.SX.sym(name) for name in ("r", "v", "theta", "omega"))
tau = ca.SX.sym("tau")
rolling = mass / (J_ball / radius**2 + mass)

system = nocl.System(
    "ball_and_beam", x=ca.vertcat(r, v, theta, omega), u=tau,
    xdot=ca.vertcat(v, rolling * (r * omega**2 - g * ca.sin(theta)), omega,
                    (tau - 2 * mass * r * v * omega - mass * g * r * ca.cos(theta))
                    / (mass * r**2 + J_beam + J_ball)),
    lbu=[-torque_max], ubu=[torque_max], lbx=[-1, -2, -1, -5], ubx=[1, 2, 1, 5],
    units={"r": "m", "v": "m/s", "theta": "rad", "omega": "rad/s", "tau": "N m"})

error = 10 * r**2 + v**2 + theta**2 + 0.1 * omega**2
ocp = nocl.OCP(
    system, horizon=3.0, running=error + tau**2, terminal=10 * error, x_goal=[0, 0, 0, 0], u_goal=[0],
    initial_states=nocl.Uniform([-0.4, -0.3, -0.1, -0.1], [0.4, 0.3, 0.1, 0.1]),
    state_bounds={"r": (-half_length, half_length), "theta": (-tilt, tilt)})
