"""OCP: its functions, that it cannot be changed, and that each mistake is explained."""

import copy
import dataclasses
import json
import pickle
import subprocess
import sys

import casadi as ca
import numpy as np
import pytest

import nocl
from nocl.systems import NAMES

THETA, OMEGA, TAU = (ca.SX.sym(n) for n in ("theta", "omega", "tau"))
X = ca.vertcat(THETA, OMEGA)
TOY = nocl.System("toy", x=X, u=TAU, xdot=ca.vertcat(OMEGA, ca.sin(THETA) + TAU), lbu=[-1.0], ubu=[1.0],
                  lbx=[-4.0, -2.0], ubx=[4.0, 2.0], angles=["theta"])


def make(**changes):
    fields = {"system": TOY, "horizon": 3.0, "running": 0.01 * TAU**2 + THETA**2, "terminal": THETA**2 + OMEGA**2,
              "x_goal": [0.0, 0.0], "u_goal": [0.0], "initial_states": nocl.Gaussian([3.0, 0.0], [0.1, 0.1])}
    return nocl.OCP(**{**fields, **changes})


def test_functions():
    ocp = make(path_constraints={"wall": 2 - THETA, "floor": OMEGA + 1}, penalty=10.0, penalty_margin=0.5)
    assert float(ocp.L([2, 1], 3)) == pytest.approx(0.09 + 4)
    assert float(ocp.G([2, 1])) == 5
    assert ocp.h([1.8, 1]).full().ravel().tolist() == pytest.approx([0.2, 2])
    assert float(ocp.L_soft([1.8, 1], 0)) == pytest.approx(1.8**2 + 10 * 0.3**2)
    assert float(ocp.L_soft([1.5, 1], 0)) == pytest.approx(1.5**2)
    assert make().h([1, 1]).shape == (0, 1)
    assert float(make().L_soft([1, 2], 3)) == float(make().L([1, 2], 3))


def test_numbers_of_every_kind_are_accepted():
    ocp = make(horizon=np.int64(3), running=0, terminal=np.float32(2), u_goal=(0,), x_goal=np.array([0, 0]))
    assert (ocp.horizon, type(ocp.horizon)) == (3.0, float)
    assert (float(ocp.L([1, 2], 3)), float(ocp.G([1, 2]))) == (0, 2)


def test_quadratic_is_the_quadratic_form():
    P = np.array([[2.0, 0.5], [0.5, 1.0]])
    ocp = nocl.OCP.quadratic(TOY, horizon=1, x_goal=[1, -1], u_goal=[0.5], R=[0.3], P=P,
                             initial_states=nocl.Gaussian([0, 0], [1, 1]))
    e = np.array([2.0, 0.7]) - [1, -1]
    assert float(ocp.G([2.0, 0.7])) == pytest.approx(e @ P @ e, rel=1e-15)
    assert float(ocp.L([9, 9], 2)) == pytest.approx(0.3 * 1.5**2, rel=1e-15)


@pytest.mark.parametrize(("weights", "message"), [
    ({"R": -1}, r"weight R is -1\.0; expected a symmetric positive semidefinite"),
    ({"P": [[1, 2], [0, 1]]}, "weight P .*expected a symmetric"),
    ({"P": [1, 2, 3]}, r"weight P has shape \(3,\); expected a number, \[2\] or \[2, 2\]"),
    ({"P": "large"}, "weight P is 'large'"),
    ({"P": np.nan}, "weight P is nan"),
])
def test_wrong_weights_are_explained(weights, message):
    with pytest.raises(ValueError, match=message):
        nocl.OCP.quadratic(TOY, horizon=1, x_goal=[0, 0], u_goal=[0], initial_states=nocl.Gaussian([0, 0], [1, 1]),
                           **weights)


# it cannot be changed


def test_frozen():
    ocp = make(path_constraints={"wall": 4 - THETA})
    with pytest.raises(dataclasses.FrozenInstanceError):
        ocp.horizon = 2.0
    with pytest.raises(ValueError, match="read-only"):
        ocp.x_goal[0] = 1
    with pytest.raises(TypeError):
        ocp.path_constraints["roof"] = THETA
    for expression in (ocp.running, ocp.terminal, ocp.path_constraints["wall"]):
        with pytest.raises(TypeError, match="cannot be changed"):
            expression[0] = 3


def test_the_callers_objects_are_left_alone_and_apart():
    running, terminal, wall, goal = ca.SX(TAU**2), ca.SX(THETA**2), ca.SX(4 - THETA), np.zeros(2)
    constraints = {"wall": wall}
    ocp = make(running=running, terminal=terminal, path_constraints=constraints, x_goal=goal)
    running[0], terminal[0], wall[0], goal[0], constraints["b"] = 7, 7, 7, 1.0, THETA
    assert (float(ocp.L([1, 1], 2)), float(ocp.G([2, 0])), float(ocp.h([1, 0])), ocp.x_goal[0]) == (4, 4, 3, 0)
    assert list(ocp.path_constraints) == ["wall"]


def test_replace_makes_another_problem():
    ocp = make()
    assert dataclasses.replace(ocp, horizon=1).horizon == 1
    assert ocp.horizon == 3


# each mistake: what was got, what was expected, the remedy

MISTAKES = [
    ({"system": "toy"}, "system is a str; expected a nocl.System"),
    ({"horizon": 0}, "horizon is 0; expected a finite positive number"),
    ({"horizon": -1.0}, r"horizon is -1\.0"),
    ({"horizon": np.nan}, "horizon is nan"),
    ({"horizon": np.inf}, "horizon is inf"),
    ({"horizon": "3"}, "horizon is '3'"),
    ({"horizon": True}, "horizon is True"),
    ({"penalty": -1}, "penalty is -1; expected a finite number >= 0"),
    ({"penalty_margin": None}, "penalty_margin is None"),
    ({"running": X}, r"running has shape \(2, 1\), expected \(1, 1\): a scalar expression"),
    ({"running": THETA * ca.SX.sym("weight")},
     r"running contains the symbol\(s\) weight, expected only .*\(theta, omega, tau\)"),
    ({"running": ca.SX.sym("tau") ** 2}, "use the very symbols given to the System, not new ones of the same name"),
    ({"running": ca.MX.sym("L")}, "running is a MX; expected a casadi.SX expression"),
    ({"running": None}, "running is a NoneType"),
    ({"terminal": THETA**2 + TAU**2}, r"terminal contains the control\(s\) tau, expected the states only"),
    ({"terminal": ca.norm_2(X)},
     r"gradient of terminal gives NaN or inf at the goal, x = \[0, 0\]; .*square a norm, or smooth"),
    ({"terminal": ca.log(OMEGA)}, "terminal gives NaN or inf at the goal"),
    ({"running": ca.fabs(THETA) ** 1.5}, "second derivative of running gives NaN or inf at the goal"),
    ({"running": 1 / ca.fmin(2 - THETA, 0)}, "running gives NaN or inf at the goal"),
    ({"running": ca.sqrt(2 - THETA)}, r"running gives NaN or inf at an initial state, x = \[\d"),
    ({"x_goal": [0.0]}, r"x_goal has shape \(1,\), expected \(2,\)"),
    ({"x_goal": [0.0, np.nan]}, "x_goal is .*NaN"),
    ({"x_goal": [0.0, 3.0]}, r"x_goal has omega = 3, outside its box \[-2, 2\]: move the goal or widen"),
    ({"x_goal": [np.inf, 0.0]}, "x_goal has theta = inf, outside"),
    ({"u_goal": [5.0]}, r"u_goal has tau = 5, outside its box \[-1, 1\]"),
    ({"u_goal": 0.0}, r"u_goal has shape \(\)"),
    ({"initial_states": [0.0, 0.0]}, "initial_states is a list; expected nocl.Gaussian or nocl.Uniform"),
    ({"initial_states": nocl.Gaussian([0.0], [1.0])}, "initial_states has 1 coordinates, expected nx = 2"),
    ({"initial_states": nocl.Uniform([0.0, 2.0], [0.0, 5.0])}, r"centred at omega = 3\.5, outside the box \[-2, 2\]"),
    ({"path_constraints": {"speed": 1 - TAU}},
     r"path constraint 'speed' contains the control\(s\) tau, expected the states only: bound controls by .*lbu"),
    ({"path_constraints": {"wall": ca.SX.sym("z")}}, r"path constraint 'wall' contains the symbol\(s\) z"),
    ({"path_constraints": {"wall": X}}, r"path constraint 'wall' has shape \(2, 1\)"),
    ({"path_constraints": [THETA]}, "path_constraints is .*; expected a dict from names to expressions"),
    ({"path_constraints": {3: THETA}}, "path_constraints is"),
    ({"path_constraints": {"ball": ca.norm_2(X) - 1}},
     "gradient of path constraint 'ball' gives NaN or inf at the goal"),
]


@pytest.mark.parametrize(("change", "message"), MISTAKES)
def test_mistakes_are_explained(change, message):
    with pytest.raises(ValueError, match=message) as error:
        make(**change)
    assert "OCP" in str(error.value)


# plain data, pickles, copies, text


def same_numbers(a, b):
    rng = np.random.default_rng(0)
    s = a.system
    x, u = rng.uniform(s.lbx, s.ubx, (50, s.nx)).T, rng.uniform(s.lbu, s.ubu, (50, s.nu)).T
    for name, args in (("L", (x, u)), ("G", (x,)), ("h", (x,)), ("L_soft", (x, u))):
        np.testing.assert_array_equal(getattr(a, name)(*args).full(), getattr(b, name)(*args).full())
    np.testing.assert_array_equal(a.system.f(x, u).full(), b.system.f(x, u).full())
    np.testing.assert_array_equal(a.initial_states.sample(5, 1), b.initial_states.sample(5, 1))
    np.testing.assert_array_equal(np.r_[a.x_goal, a.u_goal], np.r_[b.x_goal, b.u_goal])
    assert (a.horizon, a.penalty, a.penalty_margin) == (b.horizon, b.penalty, b.penalty_margin)
    assert (list(a.path_constraints), repr(a)) == (list(b.path_constraints), repr(b))


@pytest.mark.parametrize("name", NAMES)
def test_data_pickle_and_copies_give_the_same_numbers_to_the_last_bit(name):
    ocp = dataclasses.replace(nocl.load_ocp(name), penalty=1 / 3)
    text = json.dumps(ocp.to_data(), allow_nan=False)
    for other in (nocl.OCP.from_data(json.loads(text)), pickle.loads(pickle.dumps(ocp)), copy.deepcopy(ocp)):
        same_numbers(ocp, other)
    assert json.dumps(nocl.OCP.from_data(json.loads(text)).to_data()) == text


def test_a_pickle_is_read_by_another_process(tmp_path):
    ocp = nocl.load_ocp("dubins")
    (tmp_path / "ocp.pickle").write_bytes(pickle.dumps(ocp))
    code = ("import pickle, sys; o = pickle.load(open(sys.argv[1], 'rb'));"
            "print(float(o.L_soft([-1.2, 0.1, 3], [0.3, 0.4])).hex(), o.initial_states.sample(1, 2)[0, 2].hex())")
    run = subprocess.run([sys.executable, "-c", code, str(tmp_path / "ocp.pickle")], capture_output=True, text=True,
                         check=True)
    assert run.stdout.split() == [float(ocp.L_soft([-1.2, 0.1, 3], [0.3, 0.4])).hex(),
                                  ocp.initial_states.sample(1, 2)[0, 2].hex()]


@pytest.mark.parametrize("data", [{}, {"system": {}}, []])
def test_other_data_is_refused(data):
    with pytest.raises(ValueError, match="written by nocl"):
        nocl.OCP.from_data(data)


def test_repr_reads_like_the_problem():
    text = repr(make(path_constraints={"wall": 4 - THETA})).splitlines()
    assert text[:7] == [
        "OCP on 'toy': horizon 3", "  L = 0.01 tau^2 + theta^2", "  G = theta^2 + omega^2", "  wall: 4 - theta >= 0",
        "  goal: x* = [0, 0], u* = [0]", "  x0 ~ Gaussian(mean=[3, 0], std=[0.1, 0.1])",
        "System 'toy': 2 states, 1 control"]


@pytest.mark.parametrize("user", ["LQR", "NMPC", "DDP", "simulate", "to_torch"])
def test_what_is_no_problem_is_refused_by_name(user):
    from nocl import solvers

    calls = {"simulate": lambda thing: nocl.simulate(thing, None, [0.0]), "to_torch": nocl.to_torch}
    for thing in (3, nocl.load_ocp("pendulum").system):
        with pytest.raises(ValueError, match=r"expected a (nocl.OCP|casadi.Function)"):
            calls.get(user, getattr(solvers, user, None))(thing)
