"""Algebraic variables against IDAS on the equations as they are written, numpy's roots, and the implicit function
theorem; and what is refused."""

import json
import pickle

import casadi as ca
import numpy as np
import pytest

import nocl
from nocl.solvers import DDP, NMPC

RNG = np.random.default_rng(0)


def sx(*names):
    return [ca.SX.sym(n) for n in names]


def diode():
    """A capacitor fed through a node whose load is no line: 0 = u - w - 0.1 sinh(w / 0.3) - (w - v) / 0.5."""
    v, u, w = sx("v", "u", "w")
    return {"name": "diode", "x": v, "u": u, "z": w, "xdot": (w - v) / 0.5, "lbx": [-2], "ubx": [2],
            "alg": u - w - 0.1 * ca.sinh(w / 0.3) - (w - v) / 0.5, "lbu": [-3], "ubu": [3]}


def crane(m=1.0, inertia=0.1, g=9.81):
    """acados' pendulum as a DAE (its example pendulum_dae, other numbers): accelerations and forces are algebraic."""
    names = "x y alpha vx vy omega", "ax ay aw Fx Fy"
    (x, y, alpha, vx, vy, w), (ax, ay, aw, Fx, Fy) = (sx(*these.split()) for these in names)
    u = ca.SX.sym("u")
    alg = [m * ax - (Fx + u), m * ay + m * g - Fy, inertia * aw - (Fx + u) * y + Fy * x, ax + vy * w + y * aw,
           ay - vx * w - x * aw]
    return {"name": "crane", "x": [x, y, alpha, vx, vy, w], "u": u, "z": [ax, ay, aw, Fx, Fy], "alg": alg,
            "xdot": [vx, vy, w, ax, ay, aw], "lbx": [-5, -5, -10, -10, -10, -10], "ubx": [5, 5, 10, 10, 10, 10],
            "lbu": [-80], "ubu": [80], "angles": ["alpha"]}


def double_pendulum():
    """do-mpc's double inverted pendulum on a cart: Euler and Lagrange's equations in three accelerations."""
    m0, m1, m2, L1, g = 0.6, 0.2, 0.2, 0.5, 9.80665
    l1 = l2 = 0.25
    J1, J2 = m1 * l1**2 / 3, m2 * l2**2 / 3
    h = [m0 + m1 + m2, m1 * l1 + m2 * L1, m2 * l2, m1 * l1**2 + m2 * L1**2 + J1, m2 * l2 * L1, m2 * l2**2 + J2,
         (m1 * l1 + m2 * L1) * g, m2 * l2 * g]
    x = sx("pos", "th1", "th2", "v", "w1", "w2")
    (_, a, b, v, w1, w2), (dv, d1, d2), u = x, sx("dv", "dw1", "dw2"), ca.SX.sym("force")
    alg = [h[0] * dv + h[1] * d1 * ca.cos(a) + h[2] * d2 * ca.cos(b) - h[1] * w1**2 * ca.sin(a)
           - h[2] * w2**2 * ca.sin(b) - u,
           h[1] * ca.cos(a) * dv + h[3] * d1 + h[4] * ca.cos(a - b) * d2 + h[4] * w2**2 * ca.sin(a - b)
           - h[6] * ca.sin(a),
           h[2] * ca.cos(b) * dv + h[4] * ca.cos(a - b) * d1 + h[5] * d2 - h[4] * w1**2 * ca.sin(a - b)
           - h[7] * ca.sin(b)]
    return {"name": "dip", "x": x, "u": u, "z": [dv, d1, d2], "alg": alg, "xdot": [v, w1, w2, dv, d1, d2],
            "angles": ["th1", "th2"], "lbx": [-3, -4, -4, -5, -10, -10], "ubx": [3, 4, 4, 5, 10, 10], "lbu": [-4],
            "ubu": [4]}


def raw(make):
    """(x, u, z, alg, xdot) as a definition writes them, before they are solved."""
    return tuple(ca.vertcat(*e) if isinstance(e, list) else e for e in map(make().get, ("x", "u", "z", "alg", "xdot")))


def points(s, n=200):
    return RNG.uniform(s.lbx, s.ubx, (n, s.nx)).T, RNG.uniform(s.lbu, s.ubu, (n, s.nu)).T


@pytest.mark.parametrize("make", [diode, crane, double_pendulum])
def test_the_solution_solves_the_equations(make):
    s, (x, u, z, alg, xdot) = nocl.System(**make()), raw(make)
    at = points(s)
    found = s.algebraic(*at)
    left = ca.Function("g", [x, u, z], [alg])(*at, found).full()
    size = 1 + np.abs(ca.Function("J", [x, u, z], [ca.jacobian(alg, z) @ z])(*at, found).full())
    assert np.abs(left / size).max() < 1e-12
    np.testing.assert_allclose(s.f(*at), ca.Function("f", [x, u, z], [xdot])(*at, found), rtol=1e-13, atol=1e-13)


@pytest.mark.parametrize("make", [diode, crane])
def test_derivatives_are_those_of_the_implicit_function_theorem(make):
    """z_v = -g_z^-1 g_v; the second ones by central differences of that."""
    s, (x, u, z, alg, _) = nocl.System(**make()), raw(make)
    v, symbols = ca.vertcat(x, u), ca.vertcat(*s.arguments.inputs)
    slope = ca.Function("slope", [v, z], [-ca.solve(ca.jacobian(alg, z), ca.jacobian(alg, v))])
    solution = s.algebraic(*s.arguments.inputs)
    first = ca.Function("first", [symbols], [ca.jacobian(solution, symbols)])
    second = ca.Function("second", [symbols], [ca.jacobian(ca.vec(ca.jacobian(solution, symbols)), symbols)])
    for at in np.vstack(points(s, 8)).T:
        where = s.algebraic(at[:s.nx], at[s.nx:])
        np.testing.assert_allclose(first(at), slope(at, where), rtol=1e-8, atol=1e-9)
        step = 1e-5
        moved = [np.asarray(first(at + step * e) - first(at - step * e)).ravel("F") / (2 * step)
                 for e in np.eye(len(at))]
        scale = max(1, np.abs(moved).max())
        np.testing.assert_allclose(second(at), np.transpose(moved), atol=1e-6 * scale)


@pytest.mark.parametrize("make", [diode, crane, double_pendulum])
def test_the_judge_agrees_with_idas_on_the_dae(make):
    s, (x, u, z, alg, xdot) = nocl.System(**make()), raw(make)
    x0, held = 0.3 * s.ubx, 0.2 * s.ubu
    if make is crane:
        x0 = np.array([0.0, -0.8, 0.1, 0.1, 0, 0])
    dae = {"x": x, "z": z, "p": u, "ode": xdot, "alg": alg}
    idas = ca.integrator("idas", "idas", dae, 0, 0.5, {"abstol": 1e-11, "reltol": 1e-11})
    truth = idas(x0=x0, p=held, z0=s.algebraic(x0, held))["xf"].full().ravel()
    ocp = nocl.OCP(s, horizon=0.5, running=ca.sumsqr(s.u), terminal=ca.sumsqr(s.x),
                   initial_states=nocl.Gaussian(x0, 0.01 * s.ubx))
    run = nocl.simulate(ocp, held[None, None], x0)
    np.testing.assert_allclose(run.x[0, -1], truth, rtol=1e-6, atol=1e-6)


def test_costs_and_constraints_hold_z_and_two_solvers_agree():
    s = nocl.System(**diode())
    ocp = nocl.OCP(s, horizon=2.0, running=(s.u - 0.3) ** 2 + (s.z - 0.4) ** 2, terminal=s.x**2,
                   initial_states=nocl.Uniform([-1], [1]), constraints={"node": (-0.2, s.z, 0.3)})
    x0 = [[0.5], [-0.3]]
    nmpc, ddp = NMPC(ocp).solve(x0, progress=False), DDP(ocp).solve(x0)
    assert nmpc.success.all()
    assert ddp.success.all()
    np.testing.assert_allclose(ddp.cost, nmpc.cost, rtol=1e-7)
    z = s.algebraic(nmpc.x[:, :-1].reshape(-1, 1).T, nmpc.u.reshape(-1, 1).T).full()
    assert z.min() > -0.2 - 1e-7
    assert abs(z.max() - 0.3) < 1e-7
    again = nocl.OCP.from_data(json.loads(json.dumps(ocp.to_data())))
    np.testing.assert_array_equal(NMPC(again).solve(x0, progress=False).cost, nmpc.cost)


def test_torch_has_the_same_system():
    import torch

    s = nocl.System(**double_pendulum())
    at = points(s, 32)
    found = nocl.to_torch(s.f)(*(torch.tensor(a.T) for a in at))
    np.testing.assert_allclose(found.numpy().T, s.f(*at), rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("make", [diode, crane])
def test_it_survives_data_and_pickles_to_the_last_bit(make):
    s = nocl.System(**make())
    for other in (nocl.System.from_data(json.loads(json.dumps(s.to_data()))), pickle.loads(pickle.dumps(s))):
        at = points(s, 16)
        np.testing.assert_array_equal(other.f(*at), s.f(*at))
        np.testing.assert_array_equal(other.algebraic(*at), s.algebraic(*at))
        assert other.algebraic_names == s.algebraic_names


def test_parameters_time_and_variants_of_the_system():
    (v, u, w), r = sx("v", "u", "w"), nocl.parameter("r", nominal=0.5)
    s = nocl.System("diode", x=v, u=u, z=w, p=r, alg=u + ca.sin(nocl.time()) - w - (w - v) / r - w**3, lbx=[-2],
                    xdot=(w - v) / r, ubx=[2], lbu=[-3], ubu=[3], units={"w": "V"})
    assert s.uses_time
    x, uu, t, p = np.array([0.3]), np.array([1.0]), 0.7, np.array([0.6])
    z = float(s.algebraic(x, uu, t, p))
    assert abs(1.0 + np.sin(t) - z - (z - 0.3) / 0.6 - z**3) < 1e-13
    assert abs(float(s.at([0.6]).algebraic(x, uu, t)) - z) < 1e-13
    slow = nocl.limit_rates(s, {"u": 2.0})
    assert abs(float(slow.algebraic([0.3, 1.0], [0.0], t, p)) - z) < 1e-13
    both = nocl.split_controls(s, ["u"])
    assert abs(float(both.algebraic([0.3], [1.5, 0.5], t, p)) - z) < 1e-13


def test_the_branch_is_that_of_the_guess():
    x, u, z = sx("x", "u", "z")
    options = {"x": x, "u": u, "z": z, "alg": z**2 - 1 - x**2, "xdot": -x + z * u, "lbx": [-2], "ubx": [2],
               "lbu": [-1], "ubu": [1]}
    for sign in (1, -1):
        s = nocl.System("branches", **options, z_guess=[0.7 * sign])
        at = points(s)[0]
        np.testing.assert_allclose(s.algebraic(at, 0), sign * np.sqrt(1 + at**2), rtol=1e-13)


def test_where_it_is_not_found_it_is_nan():
    s = nocl.System(**diode())
    assert np.isnan([float(of(1e4, 0.0)) for of in (s.algebraic, s.f)]).all()


X, U, Z, W = sx("x", "u", "z", "w")


def toy(**changes):
    return nocl.System("toy", **{"x": X, "u": U, "z": Z, "alg": Z - X - U, "xdot": -X + Z, "lbx": [-1], "ubx": [1],
                                 "lbu": [-1], "ubu": [1], **changes})


@pytest.mark.parametrize("decades", [0, 5, 8])
@pytest.mark.parametrize("n", [1, 4, 8])
@pytest.mark.parametrize("bent", [0.0, 0.2])
def test_units_of_z_and_of_equations_do_not_count(n, decades, bent):
    """Equations whose solution is known, A y = x + i u, or A (y + bent y^3), with z and rows of any size."""
    rng = np.random.default_rng(n)
    A, z = np.eye(n) * 2 + 0.3 * rng.normal(size=(n, n)), sx(*(f"z{i}" for i in range(n)))
    of_z, of_g = (10.0 ** rng.uniform(-decades, decades, n) for _ in range(2))
    y = ca.vertcat(*z) / ca.DM(of_z)
    right = ca.DM(np.linspace(0.5, 1, n)) * X + ca.DM(np.linspace(-1, 1, n)) * U
    s = toy(z=z, alg=ca.DM(of_g) * (ca.DM(A) @ (y + bent * y**3) - right), xdot=-X + y[0])
    at = points(s)
    found = s.algebraic(*at).full() / of_z[:, None]
    wanted = np.linspace(0.5, 1, n)[:, None] * at[0] + np.linspace(-1, 1, n)[:, None] * at[1]
    np.testing.assert_allclose(A @ (found + bent * found**3), wanted, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize(("changes", "message"), [
    ({"alg": X - U}, "do not determine z"),
    ({"z": [Z, W], "alg": [Z + W - X, Z + W - U]}, "singular in z"),
    ({"alg": Z**2 + 1 + X**2}, "no z solve"),
    ({"alg": Z**2 - X, "z_guess": [1.0]}, "no z solve"),
    ({"alg": ca.log(Z) - X - U}, "no z solve"),  # where the guess is 0
    ({"alg": 1 / Z - X, "z_guess": [5.0]}, "no z solve"),
    ({"alg": Z / X - U}, "no z solve"),
    ({"alg": ca.log(Z) - 8 * X, "z_guess": [1.0]}, "make its logarithm"),
    ({"alg": Z + ca.tanh(1e4 * Z) - X - U}, "not found by|no z solve"),
    ({"alg": None}, "alg is not"),
    ({"z": None}, "z is not"),
    ({"z": None, "alg": None, "z_guess": [1.0]}, "z_guess is given and z is not"),
    ({"alg": [Z, Z]}, "alg has shape"),
    ({"alg": Z - W}, "contains the symbol"),
    ({"z": X}, "more than once"),
    ({"z_guess": [1.0, 2.0]}, "z_guess has shape"),
    ({"M": 1}, "System\\(..., z=z, alg=...\\)"),
])
def test_what_cannot_be_solved_is_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        toy(**changes)


def test_a_guess_that_is_the_solution_is_taken():
    """Two branches that come near each other: z = (-x / 2 +- sqrt(x^2 / 4 + 0.004)) / 2."""
    half = X / 2
    s = toy(alg=Z * Z + X * Z / 2 - 1e-3, z_guess=(-half + ca.sqrt(half**2 + 4e-3)) / 2)
    x = np.linspace(-1, 1, 401)[None]
    np.testing.assert_allclose(s.algebraic(x, 0), (-x / 2 + np.sqrt(x**2 / 4 + 4e-3)) / 2, rtol=1e-9)


def test_empty_lists_are_nothing():
    assert toy(z=[], alg=[], xdot=-X).z.is_empty()


def test_units_and_equations_are_shown():
    s = toy(units={"z": "V"})
    assert s.unit("z") == "z [V]"
    assert "dx/dt = z - x" in repr(s)
    assert "0 = z - x - u" in repr(s)


def test_nothing_is_solved_for_parameters_without_a_value():
    mass = nocl.parameter("mass")
    assert float(toy(p=mass, alg=mass * Z - X - U).algebraic(1, 2, 4)) == 0.75
    with pytest.raises(ValueError, match="nominal="):
        toy(p=mass, alg=mass * Z + Z**3 - X - U)


def test_a_problem_solves_for_z_all_over_its_times_and_parameters():
    gain = nocl.parameter("gain", nominal=1.0)
    s = toy(p=gain, alg=Z + Z**3 - X - gain * U - nocl.time(), z_guess=[0.0])
    ocp = nocl.OCP(s, horizon=30.0, running=U**2 + 1e-3 * s.z**2, terminal=0.0,
                   initial_states=nocl.Uniform([-0.5], [0.5]), parameters=nocl.Uniform([0.2], [30.0]))
    for t, p in ((0.0, 0.2), (30.0, 30.0), (12.0, 3.0)):
        z = float(ocp.system.algebraic(0.4, 0.9, t, p))
        assert abs(z + z**3 - 0.4 - p * 0.9 - t) < 1e-11
    z = float(ocp.at([30.0]).system.algebraic(0.4, 0.9, 12.0))
    assert abs(z + z**3 - 0.4 - 27 - 12) < 1e-11
    z = float(s.with_inputs([0.2], [30.0]).algebraic(0.4, [0.9, 30.0], 0.0))
    assert abs(z + z**3 - 0.4 - 27) < 1e-11


def test_an_end_that_hangs_on_the_control_is_refused():
    s = nocl.System(**diode())
    with pytest.raises(ValueError, match="contains the control"):
        nocl.OCP(s, horizon=1.0, running=s.u**2, terminal=s.z**2, initial_states=nocl.Uniform([-1], [1]))
