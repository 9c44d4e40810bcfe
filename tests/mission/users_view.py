"""The lines that nocl stands by, as they stand: the README shows them, the mission test runs them."""

import casadi as ca
import nocl
from nocl.solvers import NMPC
from nocl.comparisons import compare

# 1. a system: symbols, equations, bounds. Nothing else.
theta, omega, tau = ca.SX.sym("theta"), ca.SX.sym("omega"), ca.SX.sym("tau")
pendulum = nocl.System(
    "pendulum", x=ca.vertcat(theta, omega), u=tau,
    xdot=ca.vertcat(omega, 9.81 * ca.sin(theta) + tau),     # theta = 0 is upright
    lbu=[-5.0], ubu=[5.0],                                  # U, hard bounds (vectors of length nu)
    lbx=[-6.3, -8.0], ubx=[6.3, 8.0],                       # X, the box that samples are drawn from
    angles=["theta"])                                       # 2 pi periodic coordinates, by name

# 2. an optimal control problem on it
ocp = nocl.OCP(
    pendulum, horizon=3.0,
    running=0.01 * tau**2,                                  # L(x, u), SX in the system's own symbols
    terminal=theta**2 + omega**2,                           # G(x)
    x_goal=[0.0, 0.0], u_goal=[0.0],
    initial_states=nocl.Gaussian(mean=[3.14159, 0.0], std=[0.1, 0.1]))
x0 = ocp.initial_states.sample(8, seed=0)                   # [8, 2]

# 3. learn the dynamics (optional), then the controller and the value function
model = nocl.identify(pendulum, seed=0)                     # f_theta, from exact f and Jacobian labels
cnd = nocl.train(ocp, dynamics=model, seed=0)               # dynamics=None: the exact f
u = cnd(x0, t=0.0)                                          # numpy in, numpy out: [nx]->[nu] or [B, nx]->[B, nu]
V, dVdx = cnd.value(x0, t=0.0), cnd.value_gradient(x0, t=0.0)
cnd.save("runs/pendulum"); cnd = nocl.CND.load("runs/pendulum")

# 4. back into CasADi, and out to C
policy = cnd.to_casadi()                                    # ca.Function policy:(x[nx], t)->(u[nu]), native MX
policy_l4c = cnd.to_casadi(backend="l4casadi")              # the same through L4CasADi (optional extra)
V_fun = cnd.value_to_casadi()                               # ca.Function value:(x, t)->(V)
f_theta = model.to_casadi()                                 # ca.Function f:(x, u)->(xdot)
cnd.to_c("build/pendulum")                                  # C99 source + header + test vectors, no torch, no libcasadi

# 5. the reference, per initial state
nmpc = NMPC(ocp, intervals=80)                              # multiple shooting
solution = nmpc.solve(x0)                                   # one [nx] or many [B, nx]; .cost [B], .x, .u, .costate, .success, .message
report = compare(ocp, {"CND": cnd, "NMPC": nmpc}, n=100, seed=1)
report.summary()                                            # one row a method
report.rows()                                               # one row a method and initial state
report.save("runs/pendulum/report")                         # report.html, rows.csv, summary.json, figures

# 6. what comes with nocl
ocp = nocl.load_ocp("cartpole")                             # a bundled name, or a path to a user's file that defines `ocp`
cnd = nocl.pretrained("cartpole")                           # trained on the exact f; dynamics="learned" for the other
f_torch = nocl.to_torch(ocp.system.f)                       # any SX/MX ca.Function -> torch: [B, n] arguments, one output or a tuple
