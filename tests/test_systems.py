"""Each bundled system against its sources, restated in numpy on purpose; physics; the problems; load_ocp."""

import os
import sys
from importlib import import_module

import numpy as np
import pytest
from lq import lq_value
from numpy import cos, pi, sin

import nocl
from nocl.systems import NAMES
from nocl.translate.rk4 import rk4

RNG = np.random.default_rng  # every test seeds its own


def cartpole(x, u):
    """Barto, Sutton, Anderson (1983), appendix, friction dropped; F = 3 u."""
    _, v, theta, omega = x
    g, m_c, m, l, F = 9.8, 1.0, 0.1, 1.0, 3.0 * u[0]  # noqa: E741
    numerator = g * sin(theta) + cos(theta) * (-F - m * l * omega**2 * sin(theta)) / (m_c + m)
    alpha = numerator / (l * (4 / 3 - m * cos(theta) ** 2 / (m_c + m)))
    a = (F + m * l * (omega**2 * sin(theta) - alpha * cos(theta))) / (m_c + m)
    return np.array([v, a, omega, alpha])


def acrobot(x, u):
    """Sutton and Barto's book; u2 as in ENODE's fully actuated acrobot."""
    t1, t2, w1, w2 = x
    m1 = m2 = l1 = I1 = I2 = 1.0
    lc1 = lc2 = 0.5
    g = 9.8
    d1 = m1 * lc1**2 + m2 * (l1**2 + lc2**2 + 2 * l1 * lc2 * cos(t2)) + I1 + I2
    d2 = m2 * (lc2**2 + l1 * lc2 * cos(t2)) + I2
    phi2 = m2 * lc2 * g * cos(t1 + t2 - pi / 2)
    phi1 = -m2 * l1 * lc2 * w2**2 * sin(t2) - 2 * m2 * l1 * lc2 * w2 * w1 * sin(t2) \
        + (m1 * lc1 + m2 * l1) * g * cos(t1 - pi / 2) + phi2
    dw2 = (u[0] + d2 / d1 * phi1 - m2 * l1 * lc2 * w1**2 * sin(t2) - phi2) / (m2 * lc2**2 + I2 - d2**2 / d1)
    return np.array([w1, w2, -(u[1] + d2 * dw2 + phi1) / d1, dw2])


def quadrotor(x, u):
    """Onken et al. (2022): the body's thrust direction is the third column of Rz(psi) Ry(theta) Rx(phi)."""
    psi, theta, phi = x[3:6]
    Rz = np.array([[cos(psi), -sin(psi), 0], [sin(psi), cos(psi), 0], [0, 0, 1]])
    Ry = np.array([[cos(theta), 0, sin(theta)], [0, 1, 0], [-sin(theta), 0, cos(theta)]])
    Rx = np.array([[1, 0, 0], [0, cos(phi), -sin(phi)], [0, sin(phi), cos(phi)]])
    acceleration = (Rz @ Ry @ Rx)[:, 2] * u[0] / 1.0 - np.array([0, 0, 9.81])
    return np.concatenate([x[6:9], x[9:12], acceleration, u[1:4]])


def dubins(x, u):
    return np.array([u[0] * cos(x[2]), u[0] * sin(x[2]), u[1] * u[0] / 0.5])


def pendulum(x, u):
    return np.array([x[1], 9.81 * sin(x[0]) + u[0]])


def double_integrator(x, u):
    return np.array([x[1], u[0]])


def van_der_pol(x, u):
    return np.array([x[1], 1.0 * (1 - x[0] ** 2) * x[1] - x[0] + u[0]])


SOURCES = {f.__name__: f for f in (cartpole, acrobot, quadrotor, dubins, pendulum, double_integrator, van_der_pol)}
GOALS = {  # x*, u*, horizon, of DESIGN's table
    "cartpole": ([0] * 4, [0], 4), "acrobot": ([pi, 0, 0, 0], [0, 0], 4),
    "quadrotor": ([3, 3, 3] + [0] * 9, [9.81, 0, 0, 0], 4), "dubins": ([0] * 3, [0, 0], 8),
    "pendulum": ([0, 0], [0], 3), "double_integrator": ([0, 0], [0], 2), "van_der_pol": ([0, 0], [0], 5)}


def box_points(system, n, seed):
    rng = RNG(seed)
    return rng.uniform(system.lbx, system.ubx, (n, system.nx)), rng.uniform(system.lbu, system.ubu, (n, system.nu))


def test_every_file_is_listed_and_restated():
    folder = os.path.dirname(import_module("nocl.systems").__file__)
    assert {f[:-3] for f in os.listdir(folder) if f.endswith(".py")} - {"__init__"} == set(NAMES) == set(SOURCES)


@pytest.mark.parametrize("name", NAMES)
class TestEverySystem:
    def test_equations_are_the_sources(self, name):
        system = import_module(f"nocl.systems.{name}").system()
        for x, u in zip(*box_points(system, 200, 1), strict=True):
            expected = SOURCES[name](x, u)
            np.testing.assert_allclose(system.f(x, u).full().ravel(), expected, rtol=1e-12, atol=1e-12)

    def test_jacobian_is_the_difference_quotient(self, name):
        system = import_module(f"nocl.systems.{name}").system()
        h = 1e-6
        for x, u in zip(*box_points(system, 20, 2), strict=True):
            z, A_B = np.r_[x, u], np.hstack(system.linearize(x, u))
            steps = h * np.eye(len(z))
            f = lambda z: SOURCES[name](z[: system.nx], z[system.nx:])  # noqa: E731
            quotient = np.array([(f(z + s) - f(z - s)) / (2 * h) for s in steps]).T
            np.testing.assert_allclose(A_B, quotient, atol=1e-6, rtol=1e-6)

    def test_costs_and_goal_are_the_tables(self, name):
        ocp = nocl.load_ocp(name)
        x_goal, u_goal, horizon = GOALS[name]
        np.testing.assert_allclose(ocp.x_goal, x_goal, rtol=1e-15)
        np.testing.assert_allclose(ocp.u_goal, u_goal, rtol=1e-15)
        assert ocp.horizon == horizon
        for x, u in zip(*box_points(ocp.system, 20, 3), strict=True):
            np.testing.assert_allclose(float(ocp.L(x, u)), 0.01 * np.sum((u - u_goal) ** 2), rtol=1e-13)
            np.testing.assert_allclose(float(ocp.G(x)), np.sum((x - x_goal) ** 2), rtol=1e-13)

    def test_the_goal_is_an_equilibrium(self, name):
        ocp = nocl.load_ocp(name)
        np.testing.assert_allclose(ocp.system.f(ocp.x_goal, ocp.u_goal).full(), 0, atol=1e-14)

    def test_initial_states_lie_in_the_box(self, name):
        ocp = nocl.load_ocp(name)
        x = ocp.initial_states.sample(500, 0)
        assert (x >= ocp.system.lbx).all()
        assert (x <= ocp.system.ubx).all()

    def test_angles_are_periodic_coordinates(self, name):
        """f does not change when a declared angle turns once; of a coordinate in f that is no angle it does."""
        system = nocl.load_ocp(name).system
        x, u = (v[0] for v in box_points(system, 1, 4))
        for i in system.angle_indices:
            turned = x + 2 * pi * np.eye(system.nx)[i]
            np.testing.assert_allclose(system.f(turned, u).full(), system.f(x, u).full(), atol=1e-12, rtol=1e-12)

    def test_options_reach_the_problem(self, name):
        ocp = nocl.load_ocp(name, horizon=1.5, R=0.5, P=2.0)
        base = nocl.load_ocp(name)
        x, u = (v[0] for v in box_points(base.system, 1, 5))
        assert ocp.horizon == 1.5
        np.testing.assert_allclose(float(ocp.L(x, u)), 50 * float(base.L(x, u)), rtol=1e-13)
        np.testing.assert_allclose(float(ocp.G(x)), 2 * float(base.G(x)), rtol=1e-13)


BOXES = {"cartpole": (5, 3), "acrobot": (6, 5), "quadrotor": (5, 100)}


@pytest.mark.parametrize("name", BOXES)
def test_boxes_are_the_tables(name):
    system = nocl.load_ocp(name).system
    x, u = BOXES[name]
    assert set(system.ubx) == {x}
    assert set(system.lbx) == {-x}
    assert set(system.ubu) == {u}
    assert set(system.lbu) == {-u}


def test_initial_distributions_are_the_tables():
    mean_std = {n: (d.mean.tolist(), d.std.tolist()) for n in ("cartpole", "acrobot", "quadrotor", "pendulum")
                for d in [nocl.load_ocp(n).initial_states]}
    assert mean_std["cartpole"] == ([0, 0, pi, 0], [0.1] * 4)
    assert mean_std["acrobot"] == ([0] * 4, [0.1] * 4)
    assert mean_std["quadrotor"] == ([0] * 12, [1] * 3 + [0] * 9)
    assert mean_std["pendulum"] == ([pi, 0], [0.1] * 2)
    box = nocl.load_ocp("dubins").initial_states
    assert (box.lb.tolist(), box.ub.tolist()) == ([-3.5, -3, -pi], [-2.5, 3, pi])


# physics


def energy_pendulum(x, m=1.3, length=0.7, g=9.81):
    return m * length**2 * x[1] ** 2 / 2 + m * g * length * cos(x[0])


def energy_cartpole(x, m_c=1.0, m=0.1, l=1.0, g=9.8):  # noqa: E741
    """Cart, the pole's centre of mass at (p + l sin, l cos), and its rotation about it with inertia m l^2 / 3."""
    _, v, theta, omega = x
    vx, vy = v + l * omega * cos(theta), -l * omega * sin(theta)
    return m_c * v**2 / 2 + m * (vx**2 + vy**2) / 2 + m * l**2 / 3 * omega**2 / 2 + m * g * l * cos(theta)


def energy_acrobot(x, g=9.8):
    """Two links of mass, inertia and length 1, centres of mass at half length, hanging from the origin."""
    t1, t2, w1, w2 = x
    v1 = 0.5 * w1 * np.array([cos(t1), sin(t1)])
    v2 = w1 * np.array([cos(t1), sin(t1)]) + 0.5 * (w1 + w2) * np.array([cos(t1 + t2), sin(t1 + t2)])
    height = -0.5 * cos(t1) - (cos(t1) + 0.5 * cos(t1 + t2))
    return (v1 @ v1 + v2 @ v2 + w1**2 + (w1 + w2) ** 2) / 2 + g * height


@pytest.mark.parametrize(("name", "constants", "energy", "x0"), [
    ("pendulum", {"mass": 1.3, "length": 0.7}, energy_pendulum, [2.0, 1.0]),
    ("cartpole", {}, energy_cartpole, [0.1, -0.3, 2.0, 1.5]),
    ("cartpole", {"m_pole": 0.7, "l": 0.4, "g": 3.7}, lambda x: energy_cartpole(x, m=0.7, l=0.4, g=3.7), [0, 1, 1, -2]),
    ("acrobot", {}, energy_acrobot, [1.0, -2.0, 0.5, 1.5]),
])
def test_energy_is_kept_without_force_and_friction(name, constants, energy, x0):
    system = import_module(f"nocl.systems.{name}").system(**constants)
    x, u = np.array(x0, float), np.zeros(system.nu)
    start = energy(x)
    for _ in range(2000):
        x = rk4(lambda x, u: system.f(x, u).full().ravel(), x, u, 1e-3)
    assert abs(energy(x) - start) < 1e-9
    assert np.abs(x - x0).max() > 0.5  # it did move


@pytest.mark.parametrize("name", ["pendulum", "cartpole"])
def test_a_force_does_work(name):
    """dE/dt = force times velocity: the sign and the size of the control."""
    system = nocl.load_ocp(name).system
    x, u = (v[0] for v in box_points(system, 1, 6))
    energy = {"pendulum": lambda x: energy_pendulum(x, 1.0, 1.0), "cartpole": energy_cartpole}[name]
    power = {"pendulum": u[0] * x[1], "cartpole": 3 * u[0] * x[1]}[name]
    h, xdot = 1e-6, system.f(x, u).full().ravel()
    np.testing.assert_allclose((energy(x + h * xdot) - energy(x - h * xdot)) / (2 * h), power, rtol=1e-6)


def test_the_acrobots_first_torque_does_work_on_its_second_joint():
    system = nocl.load_ocp("acrobot").system
    x, h = np.array([1.0, -2.0, 0.5, 1.5]), 1e-6
    xdot = system.f(x, [2.0, 0.0]).full().ravel()
    np.testing.assert_allclose((energy_acrobot(x + h * xdot) - energy_acrobot(x - h * xdot)) / (2 * h), 2.0 * 1.5,
                               rtol=1e-6)


def test_pendulum_loses_energy_by_damping():
    system = import_module("nocl.systems.pendulum").system(damping=0.3)
    x = np.array([1.0, 2.0])
    assert float(system.f(x, [0.0])[1]) == pytest.approx(9.81 * sin(1.0) - 0.3 * 2.0, rel=1e-15)


def test_dubins_turns_with_radius_r_to_the_left():
    """Full speed and full left: a circle of radius r about the point r to the left, once round in 2 pi r seconds."""
    system = import_module("nocl.systems.dubins").system(r=0.8)
    x, n = np.zeros(3), 400
    for k in range(n):
        x = rk4(lambda x, u: system.f(x, u).full().ravel(), x, np.array([1.0, 1.0]), 2 * pi * 0.8 / n)
        assert np.hypot(x[0], x[1] - 0.8) == pytest.approx(0.8, abs=1e-8), k
    np.testing.assert_allclose(x, [0, 0, 2 * pi], atol=1e-8)


def test_dubins_obstacle_is_the_disk():
    ocp = nocl.load_ocp("dubins")
    angle = np.linspace(0, 2 * pi, 7)
    edge = np.c_[-1 + 0.5 * cos(angle), 0.5 * sin(angle), angle].T
    np.testing.assert_allclose(ocp.h(edge).full(), 0, atol=1e-14)
    x = ocp.initial_states.sample(100, 0)
    distance = np.hypot(x[:, 0] + 1, x[:, 1]) - 0.5
    np.testing.assert_allclose(ocp.h(x.T).full().ravel(), distance, atol=1e-6)
    slope = ocp.h.jacobian()([-1, 0, 0], 0).full()  # at the very centre
    np.testing.assert_array_equal(slope, 0)
    assert float(ocp.h([-1, 0, 0])) == pytest.approx(-0.5, abs=1.1e-3)
    assert nocl.load_ocp("dubins", obstacle=False).h.numel_out() == 0


@pytest.mark.parametrize(("name", "goals", "at"), [("cartpole", 2.0, [0.7]), ("quadrotor", 3.5, [-1.0, 2.0, 0.5])])
def test_the_goal_may_be_a_parameter(name, goals, at):
    """At the nominal goal it is the bundled problem, at another the one that is bundled for that goal."""
    every, known = nocl.load_ocp(name, goals=goals), nocl.load_ocp(name)
    np.testing.assert_array_equal(every.parameter_box, [[-goals] * len(at), [goals] * len(at)])
    rng, s = np.random.default_rng(3), known.system
    x, u = rng.uniform(s.lbx, s.ubx, (20, s.nx)).T, rng.uniform(s.lbu, s.ubu, (20, s.nu)).T
    there = every.at(at)
    shift = there.x_goal - known.x_goal
    for one, x_of_known in ((every.at(every.nominal), x), (there, x - shift[:, None])):
        np.testing.assert_allclose(one.G(x).full(), known.G(x_of_known).full(), rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(one.L(x, u).full(), known.L(x, u).full(), rtol=1e-12)
        np.testing.assert_allclose(one.u_goal, known.u_goal)
    np.testing.assert_array_equal(every.initial_states.mean, known.initial_states.mean)


def test_hovering_thrust_follows_mass_and_gravity():
    ocp = nocl.load_ocp("quadrotor", mass=2.5, g=3.7, target=[1.0, 2.0, -1.0])
    np.testing.assert_allclose(ocp.u_goal, [2.5 * 3.7, 0, 0, 0], rtol=1e-15)
    np.testing.assert_allclose(ocp.system.f(ocp.x_goal, ocp.u_goal).full(), 0, atol=1e-14)
    assert ocp.x_goal[:3].tolist() == [1, 2, -1]


def test_double_integrators_closed_form_solves_riccatis_equation():
    """The docstring's S(t): S(T) = P, and -dS/dt = A'S + SA - SB R^-1 B'S by central differences."""
    ocp = nocl.load_ocp("double_integrator", mass=1.5, R=0.3, P=[2.0, 0.5])
    A, B = ocp.system.linearize([0, 0], [0])
    R, T = 0.3, ocp.horizon

    def S(t):
        return lq_value([t], T=T, R=R, P=(2.0, 0.5), mass=1.5)[0][0]

    np.testing.assert_allclose(S(T), np.diag([2.0, 0.5]), atol=1e-14)
    for t in (0.1, 0.9, 1.7):
        rate = (S(t + 1e-5) - S(t - 1e-5)) / 2e-5
        np.testing.assert_allclose(-rate, A.T @ S(t) + S(t) @ A - S(t) @ B @ B.T @ S(t) / R, atol=1e-8)


# load_ocp

USER_FILE = """\
from dataclasses import dataclass
import casadi as ca
import nocl
from my_constants import STIFFNESS

@dataclass
class Settings:
    horizon: float = 2.0

def ocp(horizon=Settings().horizon):
    p, v, u = ca.SX.sym("p"), ca.SX.sym("v"), ca.SX.sym("u")
    spring = nocl.System("spring", x=[p, v], u=u, xdot=[v, u - STIFFNESS * p],
                         lbu=[-1], ubu=[1], lbx=[-2, -2], ubx=[2, 2])
    return nocl.OCP.quadratic(spring, horizon=horizon, x_goal=[0, 0], u_goal=[0],
                              initial_states=nocl.Gaussian([1, 0], [0.1, 0.1]))
"""


@pytest.fixture
def user_file(tmp_path):
    (tmp_path / "my_constants.py").write_text("STIFFNESS = 4.0\n")
    path = tmp_path / "my_system.py"
    path.write_text(USER_FILE)
    return path


def test_a_users_file_loads_and_leaves_no_trace(user_file, monkeypatch):
    monkeypatch.setattr(sys, "dont_write_bytecode", False)
    path, modules = list(sys.path), set(sys.modules)
    for name in (user_file, str(user_file)):
        ocp = nocl.load_ocp(name)
        assert ocp.system.f([1, 2], [3]).full().ravel().tolist() == [2, -1]
        assert ocp.horizon == 2
    assert nocl.load_ocp(user_file, horizon=7).horizon == 7
    assert sorted(p.name for p in user_file.parent.iterdir()) == ["my_constants.py", "my_system.py"]
    assert sys.path == path
    assert not {m for m in set(sys.modules) - modules if "my_" in m}
    assert not sys.dont_write_bytecode


def test_a_changed_neighbour_is_read_again(user_file):
    nocl.load_ocp(user_file)
    (user_file.parent / "my_constants.py").write_text("STIFFNESS = 9.0\n")
    assert float(nocl.load_ocp(user_file).system.f([1, 0], [0])[1]) == -9


def test_an_ocp_variable_is_enough(user_file):
    user_file.write_text(USER_FILE + "\nocp = ocp()\n")
    assert nocl.load_ocp(user_file).system.name == "spring"
    with pytest.raises(ValueError, match=r"is no function, so it takes no options \(got horizon\)"):
        nocl.load_ocp(user_file, horizon=3)


def test_a_relative_path_is_taken_from_the_working_folder(user_file, monkeypatch):
    monkeypatch.chdir(user_file.parent)
    assert nocl.load_ocp("my_system.py").system.name == "spring"
    with pytest.raises(ValueError, match=r"no problem 'my_system', did you mean 'my_system\.py'\?"):
        nocl.load_ocp("my_system")


@pytest.mark.parametrize(("text", "message"), [
    ("import nocl\n\nocp = 1 / 0\n", r"my_system\.py, line 3: ZeroDivisionError: division by zero"),
    ("def ocp():\n    return missing\n", r"line 2: NameError: name 'missing'"),
    ("x = (\n", r"line 1: SyntaxError"),
    ("import my_broken\n", r"my_broken\.py, line 2: ValueError: two lines"),
    ("import sys\nsys.exit(3)\n", r"line 2: SystemExit: 3"),
    ("import no_such_package\n", r"line 1: ModuleNotFoundError"),
    ("x = 1\n", r"defines no `ocp`; expected ocp = nocl\.OCP"),
    ("ocp = 3\n", r"`ocp` is a int; expected ocp = nocl\.OCP"),
    ("def ocp():\n    return None\n", r"`ocp` is a NoneType"),
    ("def ocp(a):\n    return a\n", r"TypeError: .*missing 1 required"),
    ("from nocl.systems import pendulum\nocp = pendulum.ocp(horizon=-1)\n", r"line 2: ValueError: .*horizon is -1"),
])
def test_a_broken_file_is_explained_in_one_line(user_file, text, message):
    (user_file.parent / "my_broken.py").write_text("\nraise ValueError('two\\nlines')\n")
    user_file.write_text(text)
    before = set(sys.modules)
    with pytest.raises(ValueError, match=message) as error:
        nocl.load_ocp(user_file)
    assert "\n" not in str(error.value)
    assert str(user_file.parent) in str(error.value)
    assert not {m for m in set(sys.modules) - before if "my_" in m}
    assert str(user_file.parent) not in sys.path


@pytest.mark.parametrize(("name", "message"), [
    ("cartpol", r"no problem 'cartpol', did you mean 'cartpole'\?.*dubins"),
    ("zzz", r"no problem 'zzz'; expected a Python file .* one of cartpole, acrobot"),
    ("missing.py", r"there is no file missing\.py"),
    ("some/where", r"some/where is not a \.py file"),
    (3, r"got a int; expected a name"),
    (None, r"got a NoneType"),
])
def test_a_wrong_name_is_explained(name, message):
    with pytest.raises(ValueError, match=message):
        nocl.load_ocp(name)


def test_wrong_options_are_explained(tmp_path):
    with pytest.raises(ValueError, match=r"no option 'horizn', did you mean 'horizon'\?; expected .*m_cart"):
        nocl.load_ocp("cartpole", horizn=3)
    with pytest.raises(ValueError, match=r"cartpole: .*expected numbers as options, got .*'g': 'x'"):
        nocl.load_ocp("cartpole", g="x")
    with pytest.raises(ValueError, match=r"weight R has shape \(3,\); expected a number, \[1\] or \[1, 1\]"):
        nocl.load_ocp("cartpole", R=[1, 2, 3])
    (tmp_path / "notes.txt").write_text("ocp = 1")
    with pytest.raises(ValueError, match=r"notes\.txt is not a \.py file"):
        nocl.load_ocp(tmp_path / "notes.txt")
    (tmp_path / "folder.py").mkdir()
    with pytest.raises(ValueError, match=r"there is no file .*folder\.py"):
        nocl.load_ocp(tmp_path / "folder.py")
