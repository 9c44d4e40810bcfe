"""Kinks and jumps are found and named, what only looks like one is not; costs that no smooth controller has an optimum
of are refused at the start."""

import casadi as ca
import numpy as np
import pytest

import nocl
from nocl.definition.smoothness import _switches, kinks, linear_controls, rounded
from nocl.solvers import DDP, NMPC
from nocl.solvers.ddp.solver import DDPSettings

p, v, u = z_parts = [ca.SX.sym(name) for name in ("p", "v", "u")]
z = ca.vertcat(*z_parts)
BOX = np.array([-2.0, -2.0, -1.0]), np.array([2.0, 2.0, 1.0])

KINKED = {"|p|": (ca.fabs(p), "kink", p), "|u| tiny": (1e-9 * ca.fabs(u), "kink", u),
          "|u| huge": (1e9 * ca.fabs(u), "kink", u), "max": (ca.fmax(p, v), "kink", p - v),
          "min": (u**2 + ca.fmin(p, 0.5), "kink", p - 0.5), "if": (ca.if_else(p > 1, p, 1), "kink", p - 1),
          "product": (ca.fabs(p * v), "kink", p * v), "deadzone": (ca.fmax(ca.fabs(p) - 1, 0), "kink", ca.fabs(p) - 1),
          "sign": (ca.sign(v), "jump", v), "step": (ca.if_else(v > 0.5, 1, 0), "jump", v - 0.5),
          "copysign": (ca.copysign(1 + p**2, v), "jump", v)}
SMOOTH = {"hinge squared": ca.fmax(0, p - 1) ** 2, "p |p|": p * ca.fabs(p), "out of the box": ca.fmax(0, p - 5),
          "Huber": ca.if_else(ca.fabs(p) < 0.5, p**2 / 2, (ca.fabs(p) - 0.25) / 2), "square": p**2 + 0.1 * u**2,
          "two parabolas": ca.if_else(p > 0, p**2, 3 * p**2), "rounded": nocl.smooth_abs(p, 1e-2),
          "rounded max": nocl.smooth_max(p, v, 1e-2), "steep": 1e6 * p**2 + ca.fabs(u) * 0}


@pytest.mark.parametrize("name", KINKED)
def test_kinks_are_found_where_they_are(name):
    expression, what, zero = KINKED[name]
    found = kinks(expression, z, *BOX)
    assert [k.what for k in found] == [what] * len(found) != []
    assert min(abs(float(ca.Function("zero", [z], [zero])(k.at))) for k in found) < 1e-9


@pytest.mark.parametrize("name", SMOOTH)
def test_what_is_smooth_has_no_kink(name):
    assert kinks(SMOOTH[name], z, *BOX) == []


def problem(L, **options):
    s = nocl.System("cart", x=z[:2], u=u, xdot=ca.vertcat(v, u), lbu=[-1], ubu=[1], lbx=[-2, -2], ubx=[2, 2],
                    units={"u": "N"})
    return nocl.OCP(s, horizon=2.0, running=L, terminal=p**2 + v**2, x_goal=[0, 0], u_goal=[0],
                    initial_states=nocl.Gaussian([1, 0], [0.1, 0.1]), **options)


def test_a_problem_with_kinks_says_where_and_what_to_write():
    with pytest.warns(UserWarning, match=r"running cost has a kink where p = 0.*smooth_abs") as said:
        problem(0.1 * u**2 + ca.fabs(p))
    assert said[0].filename == __file__
    with pytest.warns(UserWarning, match=r"path constraint 'wall' has a kink where p = 0"):
        problem(0.1 * u**2, path_constraints={"wall": 1.5 - ca.fabs(p)})


@pytest.mark.parametrize("width", [1e-3, 1e-1])
def test_rounded_kinks_are_near_the_sharp_ones(width):
    a, b = np.random.default_rng(0).uniform(-1, 1, (2, 1000))
    x, y = ca.SX.sym("x"), ca.SX.sym("y")
    f = ca.Function("f", [x, y], [nocl.smooth_abs(x, width), nocl.smooth_max(x, y, width)])
    absolute, larger = (value.full().ravel() for value in f(a[None], b[None]))
    assert (np.abs(absolute - np.abs(a)) <= width).all()
    assert ((larger - np.maximum(a, b) >= -1e-15) & (larger - np.maximum(a, b) <= width / 2 + 1e-15)).all()


def test_a_split_control_has_the_same_dynamics_and_an_absolute_value_without_a_kink():
    s = problem(u**2).system
    split = nocl.split_controls(s, ["u"])
    x, w = np.array([0.3, -0.2]), np.array([0.7, 0.1])
    assert split.control_names == ("u_plus", "u_minus")
    assert split.units == {"u_plus": "N", "u_minus": "N"}
    np.testing.assert_array_equal(split.f(x, w).full(), s.f(x, w[0] - w[1]).full())
    assert kinks(ca.sum1(split.u), ca.vertcat(split.x, split.u), np.r_[BOX[0][:2], 0, 0], np.r_[BOX[1][:2], 1, 1]) == []
    with pytest.raises(ValueError, match="expected a list of names of controls"):
        nocl.split_controls(s, ["force"])


@pytest.mark.parametrize(("L", "f", "linear"), [
    (u, u, ["u"]), (p**2, u, ["u"]), (p * u, v * u, ["u"]), (u**2, u, []), (u, u**2, []), (ca.exp(u), u, []),
    (1e-12 * u**2, u, [])])
def test_controls_that_the_hamiltonian_is_linear_in(L, f, linear):
    assert linear_controls(L, ca.vertcat(v, f), u) == linear


def test_coupled_controls_are_not_linear():
    w = ca.SX.sym("w", 2)
    assert linear_controls(w[0] * w[1], w[0], w) == []
    assert linear_controls(w[0] ** 2, w[0] + w[1], w) == ["w_1"]


def test_flat_controls_are_those_of_the_hamiltonian():
    assert problem(p**2 + u).flat_controls == ("u",)
    assert problem(p**2 + 0.1 * u**2).flat_controls == ()
    with pytest.warns(UserWarning, match="kink where u = 0"):
        assert problem(ca.fabs(u)).flat_controls == ("u",)  # piece by piece


@pytest.mark.parametrize("e", [ca.fabs(u - p / 2), ca.fmax(u, p), ca.fmin(3 * u, 1 - p),
                               ca.fmax(ca.fabs(u), ca.fabs(p))])
def test_kinks_in_the_controls_are_rounded_off(e):
    width = 1e-3
    w = ca.SX.sym("w")
    smooth = ca.substitute(rounded(e, z, u, w, *BOX), w, width)
    points = np.random.default_rng(0).uniform(*BOX, (500, 3)).T
    gap = ca.Function("gap", [z], [smooth - e])(points).full()
    assert 0 < np.abs(gap).max() <= 2 * width * 5  # both switches in turn, and what they are at most in the box
    assert not any(ca.depends_on(one, u) for one in _switches(smooth, z))


def test_kinks_in_states_stay():
    e = u**2 + ca.fabs(p)
    assert rounded(e, z, u, 1e-3, *BOX) is e


def test_solvers_that_fail_at_a_kink_say_so():
    """They had advised more iterations, which cannot help."""
    p, v, u = ca.SX.sym("p"), ca.SX.sym("v"), ca.SX.sym("u")
    system = nocl.System("mass", x=ca.vertcat(p, v), u=u, xdot=ca.vertcat(v, u), lbu=[-2], ubu=[2], lbx=[-3, -3],
                         ubx=[3, 3])
    with pytest.warns(UserWarning, match="has a kink where p = 0"):
        ocp = nocl.OCP(system, horizon=3.0, running=0.1 * u**2 + ca.fabs(p), terminal=p**2 + v**2, x_goal=[0, 0],
                       u_goal=[0], initial_states=nocl.Gaussian([1, 0], [0.1, 0.1]))
    for solution in (NMPC(ocp, 20, starts=1, passes=0, options={"fatrop.max_iter": 2}).solve([1.0, 0.0], workers=1),
                     DDP(ocp, intervals=20, settings=DDPSettings(max_iterations=1)).solve([1.0, 0.0])):
        if not solution.success[0]:
            assert "the running cost has a kink where p = 0" in solution.message[0]
            assert "nocl.smooth_abs" in solution.message[0]
    assert not DDP(ocp, intervals=20, settings=DDPSettings(max_iterations=1)).solve([1.0, 0.0]).success[0]
