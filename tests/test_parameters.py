"""Parameters p and time t: in the definition, its files and checks, and through the judge, NMPC, DDP and the search."""

import dataclasses
import json
import pickle
import re

import casadi as ca
import lq
import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp

import nocl
from nocl.definition import parameters
from nocl.definition.sampling import own_numbers
from nocl.definition.scales import usual_sizes
from nocl.nets import MLP, FeatureNet
from nocl.solvers import DDP, LQR, NMPC
from nocl.solvers.ddp.bank import SolutionBank, extend
from nocl.solvers.ddp.global_search import solve_globally
from nocl.solvers.ddp.kernel import ddp_source
from nocl.solvers.ddp.without_compiler import NumpyKernel
from nocl.solvers.mirrors import mirrors
from nocl.solvers.rrt_star import RRTStar
from nocl.support.fingerprint import fingerprint
from nocl.sysid.identification import LearnedDynamics
from nocl.systems import NAMES

K = 20
P = np.array([[1.0, 1.5], [0.9, -1.0], [1.1, 0.4]])  # (mass, goal)
X0 = np.array([[0.0, 0.0], [0.5, 0.1], [1.0, -1.0]])
T0 = np.array([0.0, 0.5, 1.0])


def symbols() -> tuple[ca.SX, ca.SX, ca.SX, ca.SX]:
    """(x, u, mass, goal) of a cart."""
    x, u = ca.vertcat(ca.SX.sym("pos"), ca.SX.sym("v")), ca.SX.sym("force")
    return x, u, nocl.parameter("mass", nominal=1.0, unit="kg"), nocl.parameter("goal", unit="m")


def cart(timed: bool = True, wall: bool = False, **change: object) -> nocl.OCP:
    """A cart of some mass with a spring that stiffens with time, to a goal; nothing in it is only quadratic."""
    x, u, mass, goal = symbols()
    t = nocl.time() if timed else 0.7
    s = nocl.System("cart", x=x, u=u, p=mass, xdot=ca.vertcat(x[1], (u - (0.3 + 0.2 * t) * ca.sin(x[0])) / mass),
                    lbu=[-3], ubu=[3], lbx=[-5, -5], ubx=[5, 5])
    walls = {"wall": 0.8 + 0.1 * goal + 0.05 * t - x[0]} if wall else {}
    options: dict[str, object] = {
        "p": goal, "horizon": 2.0, "running": 0.01 * u**2 + 0.1 * (x[0] - goal * ca.sin(t)) ** 2,
        "terminal": (x[0] - goal) ** 2 + mass * x[1] ** 2, "x_goal": [goal, 0], "u_goal": [0],
        "initial_states": nocl.Gaussian([0, 0], [0.1, 0.1]), "parameters": nocl.Uniform([0.8, -2], [1.2, 2]),
        "path_constraints": walls}
    return nocl.OCP(s, **{**options, **change})  # type: ignore[arg-type]


def as_states() -> nocl.OCP:
    """The same with (mass, goal, t) as states, of rates (0, 0, 1)."""
    x, u, *_ = symbols()
    m, g, t = (ca.SX.sym(name) for name in ("m", "g", "clock"))
    s = nocl.System("wide", x=ca.vertcat(x, m, g, t), u=u, lbu=[-3], ubu=[3], lbx=[-5, -5, 0.5, -3, 0],
                    ubx=[5, 5, 2, 3, 3],
                    xdot=ca.vertcat(x[1], (u - (0.3 + 0.2 * t) * ca.sin(x[0])) / m, 0, 0, 1))
    return nocl.OCP(s, horizon=2.0, running=0.01 * u**2 + 0.1 * (x[0] - g * ca.sin(t)) ** 2,
                    terminal=(x[0] - g) ** 2 + m * x[1] ** 2, x_goal=[0, 0, 1, 0, 0], u_goal=[0],
                    initial_states=nocl.Gaussian([0, 0, 1, 0, 0], [0.1] * 5))


# The definition


def test_the_order_of_p_and_of_arguments():
    ocp = cart(wall=True)
    assert ocp.parameter_names == ("mass", "goal")
    assert (ocp.np, ocp.system.np) == (2, 1)
    assert ocp.system.arguments.names == ["x", "u", "t", "p"]
    at = ocp.functions
    assert (at.stage.names, at.node.names, at.end.names) == (["x", "u", "t", "p"], ["x", "t", "p"], ["x", "p"])
    assert at.feedback().names == ["x", "t", "p"]
    assert at.step().name_in() == ["x", "u", "t", "p", "h"]
    assert ocp.system.f.size_in("p") == (1, 1)
    assert at.f.size_in("p") == (2, 1)
    x, u, t, p = np.array([0.4, -0.2]), 0.3, 1.2, np.array([0.9, -1.5])
    np.testing.assert_allclose(at.f(x, u, t, p).full().ravel(), [-0.2, (0.3 - 0.54 * np.sin(0.4)) / 0.9], rtol=1e-14)
    assert float(ocp.L(x, u, t, p)) == pytest.approx(0.01 * 0.09 + 0.1 * (0.4 + 1.5 * np.sin(1.2)) ** 2, rel=1e-14)
    assert float(ocp.G(x, p)) == pytest.approx(1.9**2 + 0.9 * 0.04, rel=1e-14)
    assert float(ocp.h(x, t, p)) == pytest.approx(0.8 - 0.15 + 0.06 - 0.4, rel=1e-14)


def test_only_what_is_used_is_an_argument():
    still, alone = cart(timed=False), cart(timed=False, wall=True).at(p=[1, 0])
    assert still.functions.stage.names == ["x", "u", "p"]
    assert not still.uses_time
    assert alone.functions.stage.names == ["x", "u"]
    x, u = ca.SX.sym("y"), ca.SX.sym("v")
    s = nocl.System("free", x=x, u=u, xdot=u - x, lbu=[-1], ubu=[1], lbx=[-1], ubx=[1])
    timed = nocl.OCP(s, horizon=2.0, running=u**2 * nocl.time(), terminal=x**2 * nocl.time(), x_goal=[0], u_goal=[0],
                     initial_states=nocl.Gaussian([0], [1]))
    assert s.arguments.names == ["x", "u"]
    assert timed.functions.f.name_in() == timed.L.name_in() == ["x", "u", "t"]
    assert float(timed.G(3.0)) == 18.0  # t in G is the horizon
    assert float(dataclasses.replace(timed, horizon=5.0).G(3.0)) == 45.0


def test_what_is_known_of_a_parameter_survives_columns():
    mass, plain = nocl.parameter("mass", nominal=2.5, unit="kg"), ca.SX.sym("gain")
    column = ca.vertcat(ca.vertsplit(ca.vertcat(plain, mass))[1], plain)
    np.testing.assert_array_equal(parameters.nominal_of(column), [2.5, np.nan])
    assert parameters.units_of(column) == {"mass": "kg"}
    assert ca.is_equal(nocl.time(), nocl.time())
    assert nocl.parameter("mass").element_hash() != mass.element_hash()


def test_nominal_values_units_and_text():
    ocp = cart()
    np.testing.assert_array_equal(ocp.nominal, [1.0, 0.0])  # given, and the centre of the distribution
    assert (ocp.unit("goal"), ocp.unit("mass"), ocp.unit("pos")) == ("goal [m]", "mass [kg]", "pos")
    text = repr(ocp)
    for part in ("p: mass = 1 kg", "goal: x* = [goal, 0]", "p = (mass, goal) ~ Uniform(lb=[0.8, -2]", "sin(t)",
                 "2 states, 1 control, 1 parameter"):
        assert part in text, text
    named = dataclasses.replace(ocp.system, units={"pos": "m"})
    assert (named.unit("pos"), named.unit("mass")) == ("pos [m]", "mass [kg]")


def test_goals_follow_p():
    ocp = cart()
    x, u = ocp.goals(P)
    np.testing.assert_array_equal(x, np.c_[P[:, 1], np.zeros(3)])
    np.testing.assert_array_equal(u, np.zeros((3, 1)))
    np.testing.assert_array_equal(ocp.x_goal, [0.0, 0.0])
    np.testing.assert_array_equal(ocp.from_goal(X0, P), X0 - x)
    np.testing.assert_array_equal(ocp.from_goal(X0, P[0]), X0 - x[0])
    along = np.repeat(X0[:, None], 4, axis=1)
    np.testing.assert_array_equal(ocp.from_goal(along, P), along - x[:, None])
    symbolic = ca.MX.sym("x", 2), ca.MX.sym("p", 2)
    error = ca.Function("error", list(symbolic), [ocp.from_goal(*symbolic)])
    np.testing.assert_array_equal(error(X0[1], P[1]).full().ravel(), X0[1] - x[1])
    longer = dataclasses.replace(ocp, horizon=3.0)
    np.testing.assert_array_equal(longer.goals(P)[0], x)
    wider = dataclasses.replace(ocp, parameters=nocl.Uniform([0.8, 1], [1.2, 2]))
    np.testing.assert_array_equal(wider.x_goal, [1.5, 0.0])


def test_angles_stay_periodic_where_the_goal_moves():
    theta, omega, tau = (ca.SX.sym(name) for name in ("theta", "omega", "tau"))
    goal = nocl.parameter("goal")
    s = nocl.System("pendulum", x=ca.vertcat(theta, omega), u=tau, xdot=ca.vertcat(omega, ca.sin(theta) + tau),
                    lbu=[-1], ubu=[1], lbx=[-6, -6], ubx=[6, 6], angles=["theta"])
    ocp = nocl.OCP(s, p=goal, horizon=1.0, running=tau**2, terminal=1 - ca.cos(theta - goal), x_goal=[goal, 0],
                   u_goal=[0], initial_states=nocl.Gaussian([3, 0], [1, 1]), parameters=nocl.Uniform([-3], [3]))
    assert ocp.periodic == (0,)
    np.testing.assert_allclose(ocp.from_goal(np.array([[-3.0, 1.0]]), np.array([[3.0]])), [[2 * np.pi - 6, 1.0]])
    flat = dataclasses.replace(ocp, terminal=(theta - goal) ** 2)
    assert flat.periodic == ()


def test_round_trips_are_exact():
    ocp = cart(wall=True)
    z = (X0[1], 0.3, 0.7, P[1])
    for again in (pickle.loads(pickle.dumps(ocp)), nocl.OCP.from_data(json.loads(json.dumps(ocp.to_data())))):
        assert json.dumps(again.to_data()) == json.dumps(ocp.to_data())
        assert float(again.L(*z)) == float(ocp.L(*z))
        np.testing.assert_array_equal(again.functions.f(*z), ocp.functions.f(*z))
        np.testing.assert_array_equal(again.goals(P)[0], ocp.goals(P)[0])
        np.testing.assert_array_equal(again.nominal, ocp.nominal)
        assert again.unit("goal") == "goal [m]"
        assert not ocp.system.difference(again.system)
    system = pickle.loads(pickle.dumps(ocp.system))
    assert repr(system) == repr(ocp.system)


def test_at_given_parameters():
    ocp, p = cart(wall=True), {"goal": -1.0, "mass": 0.9}
    fixed = ocp.at(p=p)
    assert (fixed.np, fixed.parameter_names, fixed.system.np) == (0, (), 0)
    x, u, t = X0[1], 0.4, 1.3
    assert float(fixed.L(x, u, t)) == pytest.approx(float(ocp.L(x, u, t, P[1])), rel=1e-14)
    assert float(fixed.G(x)) == pytest.approx(float(ocp.G(x, P[1])), rel=1e-14)
    assert float(fixed.h(x, t)) == pytest.approx(float(ocp.h(x, t, P[1])), rel=1e-14)
    np.testing.assert_allclose(fixed.functions.f(x, u, t), ocp.functions.f(x, u, t, P[1]), rtol=1e-14)
    np.testing.assert_array_equal(fixed.x_goal, [-1.0, 0.0])
    plain = nocl.load_ocp("pendulum")
    assert plain.at() is plain
    A, B = ocp.system.linearize(x, [u], t=t, p=[0.9])
    np.testing.assert_allclose(B, [[0], [1 / 0.9]], rtol=1e-14)
    np.testing.assert_allclose(A[1, 0], -0.56 * np.cos(0.5) / 0.9, rtol=1e-14)


MISTAKES = [
    (lambda: nocl.parameter(""), "expected a text"),
    (lambda: nocl.parameter("m", nominal=np.inf), "finite"),
    (lambda: nocl.parameter("m", unit=3), "expected a text, like 'kg'"),
    (lambda: cart(parameters=None), "expected nocl.Gaussian or nocl.Uniform of the 2 parameters mass, goal"),
    (lambda: cart(parameters=nocl.Uniform([1], [2])), "has 1 coordinate, but the problem has the 2 parameters"),
    (lambda: cart(x_goal=[3 * symbols()[3], 0]), "x_goal contains the symbol"),
    (lambda: cart(p=None), "goal, expected only the system's own .*declared"),
    (lambda: cart(p=nocl.parameter("v")), "v occurs more than once"),
    (lambda: cart(p=nocl.parameter("mass")), "mass occurs more than once"),
    (lambda: cart(p=nocl.time()), "expected parameters only"),
    (lambda: cart(parameters=nocl.Uniform([0, 0], [0, 1])), "NaN or inf inside the box.* at mass = 0, goal"),
    (lambda: cart(parameters=nocl.Uniform([1, 4], [1, 9])), r"x_goal has pos = 6.5 at mass = 1, goal = 6.5, outside"),
    (lambda: dataclasses.replace(nocl.load_ocp("pendulum"), parameters=nocl.Uniform([0], [1])), "has no parameters"),
    (lambda: cart().at(), "p is missing; expected values of mass, goal"),
    (lambda: cart().at(p={"mass": 1}), "lacks goal"),
    (lambda: cart().at(p={"mass": 1, "goal": 0, "gaol": 0}), "has the unknown gaol"),
    (lambda: cart().parameters_of([1, 2, 3], 5, "solve"), r"solve: p has shape \(3,\); expected \[2\] or \[5, 2\]"),
    (lambda: cart().parameters_of([[1, np.nan]] * 2, 2, "solve"), "goal = nan in row 0"),
    (lambda: cart().parameters_of({"mass": [1, 1], "goal": 0}, 3, "solve"), r"p\['mass'\] has shape \(2,\)"),
    (lambda: nocl.load_ocp("pendulum").parameters_of([1.0], 1, "solve"), "the problem has no parameters"),
    (lambda: cart().from_goal(X0), "pass p to from_goal"),
    (lambda: DDP(cart()).solve(X0), "DDP: p is missing"),
    (lambda: NMPC(cart()).solve(X0), "NMPC: p is missing"),
    (lambda: nocl.simulate(cart(), lambda x, t, p: x, X0), "simulate: p is missing"),
    (lambda: nocl.simulate(cart(), lambda x, t: x[:, :1], X0, p=P), r"does not take \(x, t, p\)"),
    (lambda: NMPC(cart()).controller(receding=True), "holds the time"),
    (lambda: cart().from_data({**cart().to_data(), "p": [{}]}), "not an OCP written by nocl"),
]


@pytest.mark.parametrize(("make", "message"), MISTAKES)
def test_mistakes_are_named(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_a_state_may_be_called_t_without_time():
    x, u = ca.SX.sym("t"), ca.SX.sym("v")
    box = {"lbu": [-1], "ubu": [1], "lbx": [-1], "ubx": [1]}
    assert nocl.System("clock", x=x, u=u, xdot=u, **box).state_names == ("t",)
    with pytest.raises(ValueError, match=r"t occurs more than once .*t is the time"):
        nocl.System("clock", x=x, u=u, xdot=u + nocl.time(), **box)


def test_extrapolation_is_warned_of():
    with pytest.warns(UserWarning, match=r"extrapolation: mass = 1\.3 is outside \[0\.8, 1\.2\]"):
        cart().parameters_of([[1.0, 0], [1.3, 0]], 2, "solve")


def test_kinks_count_in_states_and_controls_only():
    ocp = cart()
    x, goal = ocp.system.x, ocp.p
    with pytest.warns(UserWarning, match=r"kink where pos - goal = 0"):
        dataclasses.replace(ocp, running=ocp.running + ca.fabs(x[0] - goal))
    assert dataclasses.replace(ocp, running=ocp.running + ca.fabs(goal) * ca.fabs(nocl.time() - 1)).kinks == ()


REFUSED = [("LQR", LQR), ("RRTStar", lambda ocp: RRTStar(ocp, iterations=5))]


@pytest.mark.parametrize(("owner", "use"), REFUSED)
def test_what_has_no_parameters_yet_says_so(owner, use):
    name = re.escape(owner)
    with pytest.raises(ValueError, match=rf"{name} is not implemented for the parameter\(s\) mass, goal.*ocp.at\(p="):
        use(cart(timed=False))
    with pytest.raises(ValueError, match=rf"{name} is not implemented for the time t.*without t"):
        use(cart().at(p=[1, 0]))


def test_a_system_with_parameters_is_refused_where_nothing_is_done_with_them():
    with pytest.raises(ValueError, match=r"not implemented for the parameter\(s\) mass.*system.at\(p="):
        nocl.Dataset.sample(cart(timed=False).system, 3)


def test_folded_in_they_are_anybodys():
    fixed = cart(timed=False).at(p=[0.9, 0.5])
    assert nocl.to_control(fixed.system).nstates == 2
    env = nocl.to_gymnasium(fixed, steps=4)
    env.reset(options={"x0": X0[1]})
    u = np.array([0.7])
    rewards = sum(env.step(u)[1] for _ in range(4))
    run = nocl.simulate(fixed, np.full((1, 4, 1), 0.7), X0[1])
    assert -rewards == pytest.approx(run.cost[0], rel=1e-3)


# Without parameters and time nothing changes: (of DDP's generated source, of to_data), as they were before these came

BEFORE = {"cartpole": ("d698b7418d800fe592bfb4001922c3b8", "3ea2c65521b03dbf7fcafaaddd6f9f55"),
          "acrobot": ("38485e6408168ec5ccaeb3a0e25fb267", "ac072a12b1fc3bf9fdfc1c7f71207c0c"),
          "quadrotor": ("09cab127103bde36d550fcfe360d5b11", "6b2656b09aaad1082dd0cb369f256466"),
          "dubins": ("9090b4cc58334756d0c401fc504f9fd9", "dff1ee394f63ed822d816ab104b57194"),
          "pendulum": ("232c34981a29d1d0d4937f114426b3be", "ebd1f0669955937a707390f836dda366"),
          "double_integrator": ("a8a4e1d66dc03d2e879d0def81d763da", "553a12bf87758dd9ce106475cb05b097"),
          "van_der_pol": ("e3a258fce8a0b209cb2ac13a6927fcef", "fa49d57f157b7a0bbca74d43acd649e4")}


@pytest.mark.skipif(ca.CasadiMeta.version() != "3.8.2", reason="another CasADi writes instructions in another order")
@pytest.mark.parametrize("name", NAMES)
def test_files_and_kernels_without_parameters_are_what_they_were(name):
    ocp = nocl.load_ocp(name)
    assert (fingerprint(ddp_source(ocp)), fingerprint(json.dumps(ocp.to_data()))) == BEFORE[name]


# The judge


def test_time_in_f_and_L_is_the_time():
    """xdot = a cos t, L = t x: x = a sin t, the cost a (sin T - T cos T)."""
    x, u, a = ca.SX.sym("x"), ca.SX.sym("u"), nocl.parameter("a")
    t, T = nocl.time(), 2.0
    s = nocl.System("wave", x=x, u=u, p=a, xdot=a * ca.cos(t) + 0 * u, lbu=[-1], ubu=[1], lbx=[-3], ubx=[3])
    ocp = nocl.OCP(s, horizon=T, running=t * x, terminal=0 * x, x_goal=[0], u_goal=[0],
                   initial_states=nocl.Gaussian([0], [1]), parameters=nocl.Uniform([1], [2]))
    p, t0 = np.array([[1.0], [2.0]]), 0.5
    policy = ca.Function("policy", [ca.MX.sym("x"), ca.MX.sym("t"), ca.MX.sym("p")], [ca.MX(0)])
    for controller in (policy, lambda x, t, p: 0 * x, np.zeros((2, 7, 1))):
        run = nocl.simulate(ocp, controller, np.zeros((2, 1)), p=p, nodes=8)
        np.testing.assert_allclose(run.x[:, :, 0], p * np.sin(run.t), atol=1e-8)
        np.testing.assert_allclose(run.cost, p[:, 0] * (np.sin(T) - T * np.cos(T)), rtol=1e-8)
    late = nocl.simulate(ocp, policy, p * np.sin(t0), p=p, t0=t0)
    np.testing.assert_allclose(late.x[:, -1], p * np.sin(T), atol=1e-8)
    own = DDP(ocp, intervals=40).rollout(np.zeros((2, 1)), p)
    np.testing.assert_allclose(own[:, :, 0], p * np.sin(np.linspace(0, T, 41)), atol=1e-8)


@pytest.mark.parametrize("kind", ["callable", "function", "open loop"])
def test_a_row_at_its_own_p_is_the_problem_at_that_p(kind):
    ocp = cart(wall=True)
    given = [ca.MX.sym(n, k) for n, k in (("x", 2), ("t", 1), ("p", 2))]
    function = ca.Function("policy", given, [given[2][1] - given[0][0] - given[0][1] + given[1]])
    u = np.random.default_rng(0).uniform(-1, 1, (3, 10, 1))
    all_of = {"callable": lambda x, t, p: p[:, 1:] - x[:, :1] - x[:, 1:] + t, "function": function, "open loop": u}
    run = nocl.simulate(ocp, all_of[kind], X0, p=P, nodes=11)
    for i, p in enumerate(P):
        one = {"callable": lambda x, t, p=p: p[1] - x[:, :1] - x[:, 1:] + t, "open loop": u[[i]],
               "function": ca.Function("policy", given[:2], [function(*given[:2], p)])}
        alone = nocl.simulate(ocp.at(p=p), one[kind], X0[i], nodes=11)
        for name in ("cost", "terminal_error", "clearance", "control_magnitude"):
            np.testing.assert_allclose(getattr(run, name)[i], getattr(alone, name)[0], rtol=1e-8, err_msg=name)
    np.testing.assert_allclose(run.terminal_error, np.abs(ocp.from_goal(run.x[:, -1], P) / ocp.system.ubx).max(axis=1))


def test_a_law_for_one_p_may_be_tried_on_others():
    ocp = pendulum_with_mass()
    law = LQR(ocp.at(p=ocp.nominal))
    p = np.array([[0.8], [1.0], [1.2]])
    run = nocl.simulate(ocp, law, np.full((3, 2), 0.1), p=p)
    best = np.concatenate([nocl.simulate(ocp.at(p=one), LQR(ocp.at(p=one)), np.full(2, 0.1)).cost for one in p])
    assert run.cost[1] == pytest.approx(best[1], rel=1e-9)
    assert (run.cost[[0, 2]] > best[[0, 2]]).all()
    with pytest.raises(ValueError, match="its parameters are mass, not none"):
        nocl.simulate(ocp.at(p=[1.0]), NMPC(ocp).controller(), np.full(2, 0.1))


def pendulum_with_mass() -> nocl.OCP:
    """Upright, of a mass; linear feedback is optimal near the goal."""
    theta, omega, tau = (ca.SX.sym(name) for name in ("theta", "omega", "tau"))
    mass = nocl.parameter("mass", nominal=1.0)
    s = nocl.System("pendulum", x=ca.vertcat(theta, omega), u=tau, p=mass,
                    xdot=ca.vertcat(omega, ca.sin(theta) + tau / mass), lbu=[-5], ubu=[5], lbx=[-1, -5], ubx=[1, 5])
    return nocl.OCP.quadratic(s, horizon=2.0, x_goal=[0, 0], u_goal=[0], R=1.0, P=10.0,
                              initial_states=nocl.Gaussian([0, 0], [0.1, 0.1]), parameters=nocl.Uniform([0.7], [1.3]))


# DDP and NMPC


def differences(cost, p, h):
    """Central differences of cost(p) [B] in each of p [B, np]."""
    moves = h * np.eye(p.shape[1])
    return np.stack([(cost(p + d) - cost(p - d)) / (2 * h) for d in moves], axis=1)


@pytest.mark.parametrize("kernel", ["compiled", "numpy"])
def test_p_as_data_is_p_as_constant_states(kernel):
    ocp = cart()
    ddp = DDP(ocp, intervals=K, substeps=2)
    if kernel == "numpy":
        ddp.kernel = NumpyKernel(ocp, None, 2)
    data = ddp.solve(X0, T0, p=P, curvature=True)
    wide = DDP(as_states(), intervals=K, substeps=2).solve(np.c_[X0, P, T0], T0, curvature=True)
    assert data.success.all()
    np.testing.assert_allclose(data.cost, wide.cost, rtol=1e-8)
    np.testing.assert_allclose(data.V_x, wide.V_x[:, :, :2], atol=1e-8)
    np.testing.assert_allclose(data.V_p, wide.V_x[:, 0, 2:4], atol=1e-8)
    np.testing.assert_allclose(data.V_xx, wide.V_xx[:, :, :2, :2], atol=1e-8)
    np.testing.assert_allclose(data.gain, wide.gain[..., :2], atol=1e-8)
    np.testing.assert_array_equal(data.p, P)


def test_nmpc_agrees_with_ddp():
    ocp = cart()
    nmpc = NMPC(ocp, K, substeps=2, starts=2, passes=1)
    ours = nmpc.solve(X0, p={"goal": P[:, 1], "mass": P[:, 0]}, gains=True, workers=1)
    theirs = DDP(ocp, intervals=K, substeps=2).solve(X0, p=P)
    assert ours.success.all()
    np.testing.assert_allclose(ours.cost, theirs.cost, rtol=1e-6)
    for name in ("V_p", "V_x", "V", "gain"):
        np.testing.assert_allclose(getattr(ours, name), getattr(theirs, name), atol=1e-6, err_msg=name)
    assert NMPC(ocp, K, substeps=2).program is nmpc.program  # of any p
    late = nmpc.solve(X0[:1], p=P[0], t0=1.0, workers=1)
    assert late.cost[0] == pytest.approx(DDP(ocp, intervals=K, substeps=2).solve(X0[:1], 1.0, p=P[0]).cost[0], rel=1e-6)
    t = np.array([0.3, 1.1])
    x, _, costate = ours(t)  # between nodes
    np.testing.assert_allclose(x[:, 0], nocl.simulate(ocp, ours.u, X0, p=P, nodes=21).x[:, 3], atol=1e-5)
    np.testing.assert_allclose(costate[:, 1], ours.V_x[:, 11], atol=1e-6)


def test_the_gradient_by_p_is_that_of_differences():
    ocp = cart()
    ddp, nmpc = DDP(ocp, intervals=K), NMPC(ocp, K, starts=1, passes=0, solver="ipopt", options={"ipopt.tol": 1e-12})
    by_ddp = differences(lambda p: ddp.solve(X0, T0, p=p).cost, P, 1e-4)
    np.testing.assert_allclose(ddp.solve(X0, T0, p=P).V_p, by_ddp, rtol=1e-5)
    by_nmpc = differences(lambda p: nmpc.solve(X0[:2], p=p, workers=1).cost, P[:2], 1e-4)
    np.testing.assert_allclose(nmpc.solve(X0[:2], p=P[:2], workers=1).V_p, by_nmpc, rtol=1e-5)


def test_the_gradient_by_p_across_an_active_constraint():
    """The wall's place depends on p and t, and so does the optimum that touches it."""
    ocp, p = cart(wall=True), np.array([[1.0, 1.5], [0.9, 1.2]])
    nmpc = NMPC(ocp, K, starts=1, passes=0, solver="ipopt", options={"ipopt.tol": 1e-12})
    held = nmpc.solve(X0[:2], p=p, workers=1)
    assert (np.abs(held.clearance) < 1e-6).all()
    by_nmpc = differences(lambda p: nmpc.solve(X0[:2], p=p, workers=1).cost, p, 1e-4)
    np.testing.assert_allclose(held.V_p, by_nmpc, rtol=1e-5)
    refused = nmpc.solve([[1.2, 0.0]], p=[1.0, 1.5], workers=1)
    assert "by x0 = [1.2, 0. ] at mass = 1, goal = 1.5 itself" in refused.message[0]


def test_a_goal_in_p_is_riccati_shifted():
    R, weights, T = 0.01, np.eye(2), 2.0
    x, u, goal = ca.vertcat(ca.SX.sym("pos"), ca.SX.sym("v")), ca.SX.sym("a"), nocl.parameter("goal")
    s = nocl.System("double", x=x, u=u, xdot=ca.vertcat(x[1], u), lbu=[-500], ubu=[500], lbx=[-9, -9], ubx=[9, 9])
    ocp = nocl.OCP.quadratic(s, p=goal, horizon=T, R=R, P=weights, x_goal=[goal, 0], u_goal=[0],
                             initial_states=nocl.Gaussian([0, 0], [1, 1]), parameters=nocl.Uniform([-3], [3]))
    S, gains, *_ = lq.riccati(lq.A, lq.B, R * np.eye(1), weights, T, K)
    p = np.array([[2.0], [-1.0], [0.5]])
    off = X0 - np.c_[p, np.zeros(3)]
    for found in (DDP(ocp, intervals=K).solve(X0, p=p),
                  NMPC(ocp, K, starts=1, passes=0).solve(X0, p=p, workers=1)):
        np.testing.assert_allclose(found.cost, np.einsum("bi,ij,bj->b", off, S[0], off), rtol=1e-8)
        np.testing.assert_allclose(found.V_p[:, 0], -2 * (off @ S[0])[:, 0], rtol=1e-7)
        np.testing.assert_allclose(found.u[:, 0], off @ gains[0].T, rtol=1e-7)


def test_a_reference_in_time_is_tracked_as_riccati_does():
    """xdot = u, L = u^2 + (x - a sin 3t)^2: V = s x^2 + 2 b x + c, -s' = 1 - s^2, -b' = -r - s b, -c' = r^2 - b^2.

    Held controls cost more by a multiple of h^2, which two grids tell.
    """
    x, u, a, T = ca.SX.sym("x"), ca.SX.sym("u"), nocl.parameter("a"), 2.0
    s = nocl.System("integrator", x=x, u=u, xdot=u, lbu=[-50], ubu=[50], lbx=[-5], ubx=[5])
    ocp = nocl.OCP(s, p=a, horizon=T, running=u**2 + (x - a * ca.sin(3 * nocl.time())) ** 2, terminal=0 * x,
                   x_goal=[0], u_goal=[0], initial_states=nocl.Gaussian([0], [1]), parameters=nocl.Uniform([-2], [2]))
    p, x0 = np.array([[1.5], [-0.7]]), np.array([[0.2], [0.4]])

    def optimum(amplitude, start):
        def back(left, V):
            r = amplitude * np.sin(3 * (T - left))
            return [1 - V[0] ** 2, -r - V[0] * V[1], r**2 - V[1] ** 2]

        s, b, c = solve_ivp(back, (0, T), [0, 0, 0], rtol=1e-12, atol=1e-13).y[:, -1]
        return s * start**2 + 2 * b * start + c

    exact = np.array([optimum(*row) for row in np.c_[p, x0]])
    coarse, fine = (DDP(ocp, intervals=n).solve(x0, p=p).cost for n in (80, 160))
    np.testing.assert_allclose((4 * fine - coarse) / 3, exact, rtol=1e-6)
    assert (fine > exact).all()
    assert (np.abs((coarse - exact) / (fine - exact) - 4) < 0.05).all()
    nmpc = NMPC(ocp, 80, starts=1, passes=0).solve(x0, p=p, workers=1)
    np.testing.assert_allclose(nmpc.cost, coarse, rtol=1e-7)


def learned_cart() -> tuple[nocl.OCP, LearnedDynamics]:
    """A cart, and random networks of its states, control and mass."""
    ocp = cart(timed=False)
    x, u, p = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("p")
    features = [ca.vertcat(ca.sin(x[0]), x[1] * p, u), ca.vertcat(p, x[0])]
    torch.manual_seed(0)
    nets = [MLP([3, 6, 2], "sine").double().eval(), MLP([2, 5, 1], "tanh", skip=True).double().eval()]
    y = [ca.SX.sym("y0", 2), ca.SX.sym("y1")]
    xdot = ca.vertcat(x[1], u / p + 0.2 * y[0][0] * p + 0.2 * y[1] * y[0][1])
    net = FeatureNet(ca.Function("phi", [x, u, p], features), nets, ca.Function("xdot", [x, u, p, *y], [xdot]))
    return ocp, LearnedDynamics(ocp.system, net, "random")


def test_learned_dynamics_of_p():
    """Through the networks too: the compiled sweep against CasADi's derivatives, and V_p against differences."""
    ocp, model = learned_cart()
    ddp = DDP(ocp, intervals=K, dynamics=model)
    found = ddp.solve(X0, p=P)
    assert found.success.all()
    np.testing.assert_allclose(found.V_p, differences(lambda p: ddp.solve(X0, p=p).cost, P, 1e-4), rtol=1e-5)
    ddp.kernel = NumpyKernel(ocp, model)
    twin = ddp.solve(X0, p=P)
    np.testing.assert_allclose(found.cost, twin.cost, rtol=1e-10)
    np.testing.assert_allclose(found.V_p, twin.V_p, atol=1e-8)
    nmpc = NMPC(ocp, K, dynamics=model, starts=1, passes=0).solve(X0[:1], found[:1], p=P[0], workers=1)
    assert nmpc.cost[0] == pytest.approx(found.cost[0], rel=1e-6)


def test_a_model_without_p_serves_a_problem_with_a_goal():
    base = nocl.load_ocp("pendulum")
    goal = nocl.parameter("goal")
    ocp = nocl.OCP.quadratic(base.system, p=goal, horizon=1.0, x_goal=[goal, 0], u_goal=[0],
                             parameters=nocl.Uniform([-1], [1]), initial_states=base.initial_states)
    x, u = ca.SX.sym("x", 2), ca.SX.sym("u")
    torch.manual_seed(0)
    net = FeatureNet(ca.Function("phi", [x, u], [x]), [MLP([2, 4, 1], "sine").double().eval()],
                     ca.Function("xdot", [x, u, y := ca.SX.sym("y")], [base.system.f(x, u) + ca.vertcat(0, y)]))
    found = DDP(ocp, intervals=K, dynamics=LearnedDynamics(base.system, net, "random")).solve(X0, p=[0.3])
    assert found.success.all()
    run = nocl.simulate(ocp, found.u, X0, f=LearnedDynamics(base.system, net, "random"), p=[0.3])
    np.testing.assert_allclose(run.cost, found.cost, rtol=1e-4)


def test_the_looped_chain_rule_has_data_too(monkeypatch):
    ocp = cart()
    straight = DDP(ocp, intervals=K).solve(X0, T0, p=P)
    monkeypatch.setattr("nocl.solvers.ddp.kernel.STRAIGHT", 0)
    looped = DDP(ocp, intervals=K).solve(X0, T0, p=P)
    np.testing.assert_allclose(looped.cost, straight.cost, rtol=1e-12)
    np.testing.assert_allclose(looped.V_p, straight.V_p, rtol=1e-8)


# Loops, searches and banks


def test_nmpc_as_feedback_follows_a_changed_parameter():
    ocp = cart(timed=False)
    loop = NMPC(ocp, 12, starts=1, passes=0).controller(hold=6)
    run = nocl.simulate(ocp, loop, X0[:2], p=P[:2], hold=6)
    assert loop.failures == 0
    planned = NMPC(ocp, 12, starts=1, passes=0).solve(X0[:2], p=P[:2], workers=1)
    np.testing.assert_allclose(run.cost, planned.cost, rtol=0.3)
    assert abs(run.x[0, -1, 0] - 1.5) < 0.3
    before = loop(X0[0], 0.0, P[0])
    assert np.sign(before) != np.sign(loop(X0[0], 0.1, [1.0, -1.5]))


def test_pieces_and_journals_keep_p(tmp_path):
    ddp, rng = DDP(cart(), intervals=8), np.random.default_rng(0)
    n = 1030  # two pieces
    x0, p = rng.normal(0, 0.3, (n, 2)), ddp.ocp.parameters.sample(n, 1)
    whole = ddp.solve(x0, p=p, out=tmp_path / "run")
    assert len(list((tmp_path / "run").iterdir())) >= 2
    again = ddp.solve(x0, p=p, out=tmp_path / "run")
    for name in ("cost", "p", "V_p"):
        np.testing.assert_array_equal(getattr(whole, name), getattr(again, name))
    part = ddp.solve(x0[-3:], p=p[-3:])
    np.testing.assert_array_equal(part.V_p, whole.V_p[-3:])
    nmpc = NMPC(ddp.ocp, 8, starts=1, passes=0)
    first, second = (nmpc.solve(x0[:2], p=p[:2], workers=1, out=tmp_path / "nmpc") for _ in range(2))
    np.testing.assert_array_equal(first.V_p, second.V_p)


def goal_cartpole() -> nocl.OCP:
    base, goal = nocl.load_ocp("cartpole"), nocl.parameter("goal", unit="m")
    return nocl.OCP.quadratic(base.system, p=goal, horizon=4.0, x_goal=[goal, 0, 0, 0], u_goal=[0],
                              parameters=nocl.Uniform([-2], [2]), initial_states=base.initial_states)


def test_mirrors_are_about_each_goal():
    ocp = goal_cartpole()
    (signs, sign_u), = mirrors(ocp)
    assert (signs == -1).all()
    assert (sign_u == -1).all()
    moved = dataclasses.replace(ocp, running=ocp.running + ocp.system.x[0] ** 2)  # about 0, not about the goal
    assert mirrors(moved) == []


@pytest.mark.slow
def test_a_global_search_over_goals_and_its_bank(tmp_path):
    ocp = goal_cartpole()
    ddp, n = DDP(ocp, intervals=60), 12
    x0, p = ocp.initial_states.sample(n, 1), ocp.parameters.sample(n, 2)
    found = solve_globally(ddp, x0, p=p, starts=8, rounds=3)
    assert found.success.all()
    best = np.array([solve_globally(DDP(ocp.at(p=row), intervals=60), x, starts=8, rounds=3).cost[0]
                     for x, row in zip(x0[:2], p[:2], strict=True)])
    np.testing.assert_allclose(found.cost[:2], best, rtol=1e-6)
    bank = SolutionBank.of(ddp, found)
    bank.save(tmp_path)
    again = SolutionBank.load(tmp_path)
    np.testing.assert_array_equal(again.solution.p, p)
    np.testing.assert_array_equal(again.nearest(x0, p=p)[:, 0], np.arange(n))
    near = extend(ddp, bank, x0[:3] + 0.01, p=p[:3] + 0.01)
    linear = found.cost[:3] + 0.01 * (found.V_x[:3, 0].sum(axis=1) + found.V_p[:3, 0])
    np.testing.assert_allclose(near.cost, linear, rtol=2e-2)
    assert len(bank.add(near)) == n + 3
    assert len(bank.add(found)) == n


def test_a_bank_tells_problems_by_their_parameters():
    ddp = DDP(cart(), intervals=8)
    p = np.array([[1.0, -1.5], [1.0, 0.0], [1.0, 1.5]])
    x0 = np.zeros((3, 2))
    bank = SolutionBank.of(ddp, ddp.solve(x0, p=p))
    np.testing.assert_array_equal(bank.nearest(x0, p=p + 0.3 * np.array([[0, 1]]))[:, 0], [0, 1, 2])
    np.testing.assert_allclose(bank.interpolate(x0, 0.0, p)[0], bank.solution.u[:, 0])
    assert len(bank.add(ddp.solve(x0, p=p))) == 3
    with pytest.raises(ValueError, match=r"a bank of a problem with 2 parameter\(s\) got p = None"):
        bank.nearest(x0)


def test_nmpc_finds_neighbours_in_states_and_parameters():
    """Solutions of one state at many parameters help each other."""
    ocp = goal_cartpole()
    p = np.linspace(-1, 1, 4)[:, None]
    found = NMPC(ocp, 30, starts=3, passes=2, neighbours=2).solve(np.tile(ocp.initial_states.centre, (4, 1)), p=p,
                                                                  workers=1)
    assert found.success.all()
    assert (found.starts > 3).all()
    slopes = (found.V_p[1:] + found.V_p[:-1]) / 2  # exact where J* is quadratic in the goal, as it nearly is
    np.testing.assert_allclose(np.diff(found.cost), slopes[:, 0] * np.diff(p[:, 0]), rtol=1e-2)


# What is found out of a problem by trying is found out at parameters of its distribution


def lag():
    """An integrator behind an actuator that lags by 1 / rate; for rate h > 2.8 Runge-Kutta steps h are unstable."""
    x, z, u = ca.SX.sym("x"), ca.SX.sym("z"), ca.SX.sym("u")
    rate, weight = nocl.parameter("rate", nominal=1.0), nocl.parameter("weight")
    s = nocl.System("lag", x=ca.vertcat(x, z), u=u, p=rate, xdot=ca.vertcat(z, rate * (u - z)), lbu=[-1], ubu=[1],
                    lbx=[-3, -2], ubx=[3, 2])
    return nocl.OCP(s, p=weight, horizon=4.0, running=weight * 0.1 * u**2, terminal=weight * (5 * x**2 + z**2),
                    x_goal=[0, 0], u_goal=[0], initial_states=nocl.Gaussian([1, 0], [0.1, 0.1]),
                    parameters=nocl.Uniform([90, 1e6], [100, 2e6]))


def test_substeps_are_chosen_for_the_parameters():
    """Of rates from 90 on; at the nominal one, 1, a step would do."""
    ocp, p = lag(), np.array([95.0, 1.5e6])
    for make in (lambda o, n: DDP(o, intervals=80, substeps=n), lambda o, n: NMPC(o, 80, substeps=n, starts=1)):
        with pytest.warns(UserWarning, match="Runge-Kutta step|too coarse"):
            s = make(ocp, None).solve([1.0, 0.0], p=p)
        own = make(ocp.at(p), 8).solve([1.0, 0.0])
        assert s.success.all()
        assert s.cost[0] == pytest.approx(own.cost[0], rel=1e-3)


def test_the_usual_cost_is_that_at_the_parameters():
    ocp = lag()
    cost, one = (usual_sizes(o).cost for o in (ocp, ocp.at([95.0, 1.5e6])))
    assert cost == pytest.approx(one, rel=0.2)


def test_parameters_are_tried_apart_from_states():
    """A draw of p is none of x0's: where both were the same numbers, only a diagonal would be tried."""
    at, x = lag().moments(500), lag().initial_states.sample(500, own_numbers(0))
    drawn = np.c_[x, at["p"], at["t"]]
    assert np.abs(np.corrcoef(drawn.T) - np.eye(5)).max() < 0.2


def limited(low, **held):
    """A pendulum with a limit and a goal as parameters; held: constraints as functions of (x, limit)."""
    limit, goal, s = nocl.parameter("limit", 1.0), nocl.parameter("goal", 0.0), nocl.load_ocp("pendulum").system
    held = {kind: {"it": of(s.x, limit)} for kind, of in held.items()}
    return nocl.OCP.quadratic(s, p=ca.vertcat(limit, goal), horizon=3.0, x_goal=[goal, 0], u_goal=[0],
                              initial_states=nocl.Gaussian([np.pi, 0], [0.1, 0.1]),
                              parameters=nocl.Uniform([low, -0.5], [1.0, 0.5]), **held)


@pytest.mark.parametrize(("held", "said"), [
    ({"constraints": lambda x, limit: 8.5 * limit - 1 - ca.fabs(x[1]) - 0 * x[0]}, None),
    ({"constraints": lambda x, limit: limit - 0.6 - x[1]**2}, "at limit = 0.5, goal = -0.5: constraint 'it'.* nowhere"),
    ({"path_constraints": lambda x, limit: x[1] - 9 * limit}, "at limit = 1, .*path constraint 'it'.* holds nowhere"),
    ({"terminal_constraints": lambda x, limit: limit - 0.6 - x[1]**2}, "at limit = 0.5.* terminal constraint 'it'")])
@pytest.mark.filterwarnings("ignore:.*the goal itself", "ignore:.*not smooth", "ignore:.*kink")
def test_what_cannot_be_held_at_some_parameters_is_named(held, said):
    if said is None:
        assert limited(0.5, **held).np == 2
        return
    with pytest.raises(ValueError, match=said):
        limited(0.5, **held)


def test_a_goal_that_violates_a_constraint_at_some_parameters_is_named():
    with pytest.warns(UserWarning, match=r"does not hold path constraint 'it' at \d+ of 65 .* worst at limit"):
        limited(0.05, path_constraints=lambda x, limit: limit - x[0]**2)
