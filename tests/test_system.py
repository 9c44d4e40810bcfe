"""System: what it derives from its equations, that it cannot be changed, and that each mistake is explained."""

import copy
import dataclasses
import json
import pickle
import re
import subprocess
import sys

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import nocl
from nocl.definition import pretty
from nocl.systems import NAMES


def sx(*names):
    return tuple(ca.SX.sym(n) for n in names)


def make(**changes):
    """A two-state system with fields exchanged; expressions may be functions of (theta, omega, tau)."""
    theta, omega, tau = sx("theta", "omega", "tau")
    fields = {"name": "toy", "x": ca.vertcat(theta, omega), "u": tau, "xdot": ca.vertcat(omega, ca.sin(theta) + tau),
              "lbu": [-1.0], "ubu": [1.0], "lbx": [-4.0, -2.0], "ubx": [4.0, 2.0], "angles": ["theta"]}
    for key, value in changes.items():
        fields[key] = value(theta, omega, tau) if callable(value) else value
    return nocl.System(**fields)


def test_sizes_names_and_functions():
    s = make(units={"theta": "rad"})
    assert (s.nx, s.nu, s.state_names, s.control_names) == (2, 1, ("theta", "omega"), ("tau",))
    assert (s.angles, s.angle_indices) == (("theta",), (0,))
    assert (s.unit("theta"), s.unit("omega")) == ("theta [rad]", "omega")
    np.testing.assert_allclose(s.f([0.3, 2], 5).full().ravel(), [2, np.sin(0.3) + 5], rtol=1e-15)
    A, B = s.linearize([0.3, 2], [5])
    np.testing.assert_allclose(A, [[0, 1], [np.cos(0.3), 0]], rtol=1e-15)
    np.testing.assert_array_equal(B, [[0], [1]])
    assert (str(s.f), str(s.jacobian)) == ("f:(x[2],u)->(xdot[2]) SXFunction",
                                           "jacobian:(x[2],u)->(A[2x2],B[2]) SXFunction")


def test_linearize_checks_its_point():
    with pytest.raises(ValueError, match=r"toy\.linearize: x has shape \(3,\), expected \(2,\)"):
        make().linearize([1, 2, 3], [0])


def test_lists_integers_and_numpy_numbers_are_accepted():
    p, v, u = sx("p", "v", "u")
    s = nocl.System("list", x=[p, v], u=[u], xdot=[v, u + 1], lbu=[-1], ubu=np.array([1]), lbx=(-1, -1),
                    ubx=np.ones(2, dtype=np.float32))
    assert s.f([1, 2], 3).full().ravel().tolist() == [2, 4]
    assert s.ubu.dtype == s.ubx.dtype == np.float64
    constant = nocl.System("drift", x=p, u=u, xdot=ca.DM(2), lbu=[-1], ubu=[1], lbx=[-1], ubx=[1])
    assert float(constant.f(0, 0)) == 2
    assert float(dataclasses.replace(constant, xdot=np.int64(3)).f(0, 0)) == 3


# it cannot be changed


def test_fields_are_frozen():
    s = make(units={"tau": "N m"})
    with pytest.raises(dataclasses.FrozenInstanceError):
        s.name = "other"
    for array in (s.lbx, s.ubx, s.lbu, s.ubu):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 3
    with pytest.raises(TypeError):
        s.units["tau"] = "kg"


@pytest.mark.parametrize("edit", [
    lambda e: e.__setitem__(0, 3), lambda e: e.nz.__setitem__(0, 3), lambda e: e.set(3, False, 0),
    lambda e: e.set_nz(3, False, 0), lambda e: e.erase([0], False), lambda e: e.resize(1, 1),
    lambda e: e.remove([0], []), lambda e: e.clear(), lambda e: e.enlarge(3, 1, [0, 1], [0])])
@pytest.mark.parametrize("name", ["x", "xdot"])
def test_expressions_are_frozen(edit, name):
    s = make()
    before = str(getattr(s, name))
    with pytest.raises(TypeError, match="cannot be changed: edit a copy"):
        edit(getattr(s, name))
    assert str(getattr(s, name)) == before
    free = ca.SX(getattr(s, name))
    free[0] = 7
    assert str(getattr(s, name)) == before


def test_the_callers_objects_are_left_alone_and_apart():
    theta, omega, tau = sx("theta", "omega", "tau")
    x, u, xdot = ca.vertcat(theta, omega), ca.SX(tau), ca.vertcat(omega, tau)
    lbx, angles, units = np.array([-1.0, -1.0]), ["theta"], {"theta": "rad"}
    s = nocl.System("toy", x=x, u=u, xdot=xdot, lbu=[-1], ubu=[1], lbx=lbx, ubx=[1, 1], angles=angles, units=units)
    x[0], u[0], xdot[0], lbx[0], units["theta"] = ca.SX.sym("z"), 4, 5, -9, "deg"
    angles.append("omega")
    assert (s.state_names, str(s.u), str(s.xdot), s.lbx[0]) == (("theta", "omega"), "tau", "[omega, tau]", -1)
    assert (s.angles, dict(s.units)) == (("theta",), {"theta": "rad"})
    assert s.f([1, 2], 3).full().ravel().tolist() == [2, 3]


# each mistake: what was got, what was expected, the remedy

MISTAKES = [
    ({"name": "cart pole"}, "name is 'cart pole'; expected letters"),
    ({"name": ""}, "name is ''"),
    ({"name": 3}, "name is 3"),
    ({"x": lambda a, b, u: ca.horzcat(a, b)}, r"x has shape \(1, 2\), expected a column .* use ca\.vertcat"),
    ({"x": lambda a, b, u: ca.vertcat(a, b + 1)}, r"x\[1\] is the expression \(?omega\+1\)?; expected a plain symbol"),
    ({"x": lambda a, b, u: ca.vertcat(a, 2)}, r"x\[1\] is the expression 2"),
    ({"x": ca.SX(0, 1)}, r"x has shape \(0, 1\)"),
    ({"x": ca.MX.sym("x", 2)}, r"x is a MX; expected casadi\.SX symbols.*MX is not accepted"),
    ({"x": [1.0, 2.0]}, r"x is a DM; expected casadi\.SX"),
    ({"u": None}, r"u is a NoneType; expected casadi\.SX"),
    ({"x": lambda a, b, u: ca.vertcat(a, a)}, "theta occurs more than once in x and u"),
    ({"x": lambda a, b, u: ca.vertcat(a, u)}, "tau occurs more than once"),
    ({"x": lambda a, b, u: ca.vertcat(a, ca.SX.sym("tau"))}, "tau occurs more than once"),
    ({"x": lambda a, b, u: ca.vertcat(a, ca.SX.sym(""))}, r"x\[1\] is a symbol without a name"),
    ({"xdot": lambda a, b, u: b}, r"xdot has shape \(1, 1\), expected \(2, 1\): one row per state"),
    ({"xdot": lambda a, b, u: ca.horzcat(a, b)}, r"xdot has shape \(1, 2\)"),
    ({"xdot": lambda a, b, u: ca.vertcat(b, ca.SX.sym("mass") * a / ca.SX.sym("drag"))},
     r"symbol\(s\) drag, mass, expected only the system's own \(theta, omega, tau\): put a number"),
    ({"xdot": lambda a, b, u: ca.vertcat(ca.SX.sym("omega"), u)},
     r"omega, expected only .* not new ones of the same name"),
    ({"xdot": ca.MX.sym("xdot", 2)}, "xdot is a MX; expected a casadi.SX expression"),
    ({"xdot": "omega"}, "xdot is a str"),
    ({"lbu": [-1.0, 0.0]}, r"lbu has shape \(2,\), expected \(1,\): pass one number per coordinate"),
    ({"lbu": -1.0}, r"lbu has shape \(\)"),
    ({"ubu": ["a"]}, r"ubu is \['a'\], which holds text, not numbers: convert it; expected 1 numbers"),
    ({"ubu": None}, "ubu"),
    ({"lbu": [np.nan]}, "lbu is .*nan.* NaN: check how it was computed"),
    ({"ubu": [np.inf]}, r"tau is in \[-1\.0, inf\]; expected finite bounds"),
    ({"lbu": [2.0]}, r"tau is in \[2\.0, 1\.0\], an empty interval; expected lbu < ubu"),
    ({"lbx": [-4.0, 2.0]}, r"omega is in \[2\.0, 2\.0\], an empty interval; expected lbx < ubx"),
    ({"xdot": lambda a, b, u: ca.vertcat(b, ca.sqrt(a + 3.9))},
     r"equation\(s\) of omega gives NaN or inf inside the box, at theta = -4, omega = -2, tau = -1; .*shrink lbx"),
    ({"xdot": lambda a, b, u: ca.vertcat(1 / a, u)}, r"equation\(s\) of theta gives .* at theta = 0, omega = 0"),
    ({"xdot": lambda a, b, u: ca.vertcat(b, ca.norm_2(ca.vertcat(a, b)))}, "the Jacobian of xdot gives NaN or inf"),
    ({"angles": ["phi"]}, r"angles is \['phi'\]; expected a list of names of states \(theta, omega\)"),
    ({"angles": ["tau"]}, r"angles is \['tau'\]"),
    ({"angles": None}, "angles is None"),
    ({"angles": [0]}, r"angles is \[0\]"),
    ({"units": {"phi": "rad"}},
     r"units is .*phi.*expected a dict from names of states and controls \(theta, omega, tau\)"),
    ({"units": "rad"}, "units is 'rad'"),
]


@pytest.mark.parametrize(("change", "message"), MISTAKES)
def test_mistakes_are_explained(change, message):
    with pytest.raises(ValueError, match=message) as error:
        make(**change)
    if "name" not in change:
        assert "System 'toy'" in str(error.value)


# plain data, pickles, copies


def same_numbers(a, b):
    rng = np.random.default_rng(0)
    x, u = rng.uniform(a.lbx, a.ubx, (50, a.nx)).T, rng.uniform(a.lbu, a.ubu, (50, a.nu)).T
    np.testing.assert_array_equal(a.f(x, u).full(), b.f(x, u).full())
    for j, k in zip(a.jacobian(x, u), b.jacobian(x, u), strict=True):
        np.testing.assert_array_equal(j.full(), k.full())
    assert repr(a) == repr(b)
    assert (a.name, a.names, a.angles, dict(a.units)) == (b.name, b.names, b.angles, dict(b.units))
    for name in ("lbx", "ubx", "lbu", "ubu"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))


@pytest.mark.parametrize("name", NAMES)
def test_data_pickle_and_copies_give_the_same_numbers_to_the_last_bit(name):
    s = nocl.load_ocp(name).system
    text = json.dumps(s.to_data(), allow_nan=False)
    others = nocl.System.from_data(json.loads(text)), pickle.loads(pickle.dumps(s)), copy.deepcopy(s), copy.copy(s)
    for other in others:
        same_numbers(s, other)
    assert json.dumps(nocl.System.from_data(json.loads(text)).to_data()) == text


def test_branches_and_many_operations_survive():
    s = make(xdot=lambda a, b, u: ca.vertcat(ca.if_else(a > b, ca.atan2(a, 2 + b**2), ca.fmin(b, u)),
                                             ca.tanh(a) ** 3 + ca.fabs(b) + 1 / 3))
    same_numbers(s, pickle.loads(pickle.dumps(s)))


def test_a_pickle_is_read_by_another_process(tmp_path):
    s = nocl.load_ocp("acrobot").system
    (tmp_path / "system.pickle").write_bytes(pickle.dumps(s))
    code = ("import pickle, sys; s = pickle.load(open(sys.argv[1], 'rb'));"
            "print([v.hex() for v in s.f([1, 2, 3, 4], [0.1, 0.2]).full().ravel()])")
    run = subprocess.run([sys.executable, "-c", code, str(tmp_path / "system.pickle")], capture_output=True, text=True,
                         check=True)
    assert run.stdout.strip() == str([v.hex() for v in s.f([1, 2, 3, 4], [0.1, 0.2]).full().ravel()])


@pytest.mark.parametrize("data", [{}, {"name": "a"}, {"x": 3}, []])
def test_other_data_is_refused(data):
    with pytest.raises(ValueError, match="not a System written by nocl"):
        nocl.System.from_data(data)


# the text


def test_repr_shows_equations_boxes_and_angles():
    text = repr(make())
    assert text.splitlines() == [
        "System 'toy': 2 states, 1 control", "  dtheta/dt = omega", "  domega/dt = sin(theta) + tau",
        "  X: theta in [-4, 4] (angle), omega in [-2, 2]", "  U: tau in [-1, 1]"]


@pytest.mark.parametrize("name", NAMES)
def test_repr_lines_are_narrow(name):
    assert max(map(len, repr(nocl.load_ocp(name)).splitlines())) <= 120


def evaluate(expression, symbols, values):
    """What the printed text says, by Python: ' ' is a product, '^' a power."""
    rows, shared = pretty.lines(expression, ca.vertcat(*symbols), digits=17)
    scope = {s.name(): v for s, v in zip(symbols, values, strict=True)} | {n: getattr(np, n) for n in ("sin", "exp")}
    for name, text in [*shared.items(), ("result", rows[0])]:
        python = re.sub(r"(?<=[\w)]) (?=[\w(])", "*", text).replace("^", "**")
        scope[name] = eval(python, {}, scope)
    return scope["result"]


a_, b_, c_ = sx("a", "b", "c")
LEAVES = st.sampled_from([a_, b_, c_, ca.SX(2), ca.SX(-3), ca.SX(0.5)])
EXPRESSIONS = st.recursive(LEAVES, lambda e: st.one_of(
    st.tuples(st.sampled_from(["+", "-", "*", "/"]), e, e).map(
        lambda t: {"+": t[1] + t[2], "-": t[1] - t[2], "*": t[1] * t[2], "/": t[1] / (t[2] ** 2 + 1)}[t[0]]),
    e.map(lambda v: -v), e.map(lambda v: v**2), e.map(ca.sin), e.map(lambda v: 1 / (2 + ca.sin(v))),
    e.map(lambda v: v * ca.sin(v) + v)), max_leaves=12)


@settings(max_examples=200, deadline=None, derandomize=True)
@given(EXPRESSIONS)
def test_the_printed_text_means_the_expression(expression):
    values = (0.7, -1.3, 0.4)
    expected = float(ca.Function("e", [a_, b_, c_], [expression])(*values))
    np.testing.assert_allclose(evaluate(expression, (a_, b_, c_), values), expected, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize(("expression", "text"), [
    (a_ - (b_ - c_), "a - (b - c)"), (a_ / b_ * c_, "(a/b) c"), (a_ / (b_ * c_), "a/(b c)"), (-3 * a_, "-3 a"),
    ((a_ + b_) ** 2, "(a + b)^2"), (a_**b_, "a^b"), (1 / a_, "1/a"), (ca.fmin(a_, b_), "fmin(a, b)"),
    (a_ + -3 * b_, "a - 3 b"), (ca.if_else(a_ > b_, a_, 0), "(a if b < a else 0)"), (2 * a_, "2 a")])
def test_notation(expression, text):
    assert pretty.lines(expression, ca.vertcat(a_, b_, c_))[0] == [text]


@pytest.mark.parametrize("kind", ["linear", "bspline"])
def test_table_look_ups_are_refused_at_once(kind):
    """As f, in equations and in costs: nothing can translate them, nor differentiate them as SX."""
    knots = np.linspace(-2, 2, 9)
    table = ca.interpolant("table", kind, [knots], np.sin(knots))
    x, u = ca.MX.sym("x", 2), ca.MX.sym("u")
    f = ca.Function("f", [x, u], [ca.vertcat(x[1], u + table(x[0]))])
    box = {"lbu": [-1], "ubu": [1], "lbx": [-2, -2], "ubx": [2, 2]}
    with pytest.raises(ValueError, match=r"(table look-up|SX)"):
        nocl.System.from_casadi(f, **box)
    p, v, a = ca.SX.sym("p"), ca.SX.sym("v"), ca.SX.sym("a")
    with pytest.raises(ValueError, match="xdot contains OP_CALL"):
        nocl.System("table", x=ca.vertcat(p, v), u=a, xdot=ca.vertcat(v, a + table(p)), **box)
    plain = nocl.System("plain", x=ca.vertcat(p, v), u=a, xdot=ca.vertcat(v, a), **box)
    with pytest.raises(ValueError, match="running contains OP_CALL"):
        nocl.OCP(plain, horizon=1.0, running=a**2 + table(p), terminal=p**2, x_goal=[0, 0], u_goal=[0],
                 initial_states=nocl.Gaussian([1, 0], [0.1, 0.1]))


@pytest.mark.parametrize(("word", "way"), [
    ("delay", "a few more states, each a first-order lag"), ("integrality", "one problem for each mode"),
    ("mass_matrix", "an equation for a z of its own"), ("sample_time", "hold=K"),
    ("outputs", "put an observer before it"),
    ("noise", "robust=True"), ("du_max", "nocl.limit_rates"), ("x_max", 'state_bounds={"v": (-2, 2)}'),
    ("angle", "units: did you mean angles?"), ("colour", "expected name, x, u, xdot, lbu")])
def test_what_there_is_not_is_answered(word, way):
    with pytest.raises(ValueError, match=f"^System: {word} is no argument") as said:
        make(**{word: 1})
    assert way in str(said.value)
    with pytest.raises(ValueError, match=f"^OCP: {word} is no argument"):
        nocl.OCP(make(), **{word: 1})
