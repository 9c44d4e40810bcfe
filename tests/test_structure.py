"""The structure read off labels: found where it is, not found where it is not, exact where it says exact."""

import casadi as ca
import numpy as np
import pytest

import nocl
from nocl.data import Dataset
from nocl.sysid.structure import Expansion, Variables, evaluate, find, plain, read
from nocl.systems import acrobot, cartpole, dubins, quadrotor, van_der_pol


def box_of(system: nocl.System) -> Variables:
    return Variables(system.names, np.r_[system.lbx, system.lbu], np.r_[system.ubx, system.ubu], system.nx,
               system.angle_indices)


def structure_of(system: nocl.System, **options):
    return find(lambda x, u: Dataset.label(system, x, u), box_of(system), **options)


def one_state(xdot, **options) -> nocl.System:
    """A system of two states q, v and two controls, d q/dt = v, d v/dt = xdot(q, v, a, b)."""
    q, v, a, b = (ca.SX.sym(n) for n in "qvab")
    return nocl.System("test", x=ca.vertcat(q, v), u=ca.vertcat(a, b), xdot=ca.vertcat(v, xdot(q, v, a, b)),
                       lbx=[-2, -2], ubx=[2, 2], lbu=[-1, -1], ubu=[1, 2], **options)


def smooth() -> nocl.System:
    rng = np.random.default_rng(0)
    x, u = ca.vertcat(*map(ca.SX.sym, "abc")), ca.SX.sym("u")
    W, V = rng.normal(size=(8, 4)), rng.normal(size=(3, 8))
    return nocl.System("smooth", x=x, u=u, xdot=V @ ca.tanh(W @ ca.vertcat(x, u)),
                       lbx=[-1] * 3, ubx=[1] * 3, lbu=[-1], ubu=[1])


def model(structure, z):
    """xdot rows [N, nx] with the networks replaced by the labels themselves: exact if the structure is right."""
    box = structure.split.box
    symbol = ca.SX.sym("z", box.nz)
    learned = sorted(c for g in structure.groups for c in g.coefficients)
    answers = [ca.SX.sym(f"y{c}") for c in learned]
    xdot = structure.xdot(dict(zip(learned, answers, strict=True)), symbol)
    return ca.Function("xdot", [symbol, ca.vertcat(*answers)], [xdot]), learned


@pytest.mark.parametrize("problem", [cartpole, acrobot, quadrotor, dubins, van_der_pol])
def test_structure_with_exact_coefficients_is_f(problem):
    """f = known + coefficients times monomials, the coefficients taken from their labels, at points never seen."""
    system = problem.system()
    structure = structure_of(system)
    z = structure.split.box.sample(50, np.random.default_rng(5))
    function, learned = model(structure, z)
    value, _ = structure.residual(lambda x, u: Dataset.label(system, x, u), z)
    got = function(z.T, value[:, learned].T).full()
    want = system.f(z[:, :system.nx].T, z[:, system.nx:].T).full()
    np.testing.assert_allclose(got, want, atol=1e-12 * max(1, np.abs(want).max()), rtol=0)


def test_cartpole_is_six_functions_of_theta():
    structure = structure_of(cartpole.system())
    assert [structure.split.box.names[k] for k in structure.split.affine] == ["u"]
    assert [[structure.split.box.names[k] for k in g.variables] for g in structure.groups] == [["theta"]]
    assert len(structure.groups[0].coefficients) == 6
    assert "affine in u; d p/dt = v exact; d theta/dt = omega exact" in structure.words
    assert "quadratic in omega" in structure.words


def test_without_features_cartpole_splits_into_drift_and_control_column():
    structure = structure_of(cartpole.system(), features=False)
    names = [[structure.split.box.names[k] for k in g.variables] for g in structure.groups]
    assert names == [["theta", "omega"], ["theta"]]
    assert [len(g.coefficients) for g in structure.groups] == [2, 2]


def test_acrobot_is_functions_of_the_second_angle():
    structure = structure_of(acrobot.system())
    assert [g.variables for g in structure.groups] == [(1,)]
    assert len(structure.split.affine) == 2


@pytest.mark.parametrize("problem", [quadrotor, dubins, van_der_pol])
def test_polynomials_in_features_are_closed_forms(problem):
    assert structure_of(problem.system()).groups == ()


def test_dubins_is_affine_in_one_control_only():
    structure = structure_of(dubins.system())
    assert [structure.split.box.names[k] for k in structure.split.affine] == ["v"]


def test_no_structure_is_found_in_a_random_smooth_function():
    structure = structure_of(smooth())
    assert not structure.found
    assert structure.words == "no structure found: one network of all variables"
    assert structure.groups == plain(box_of(smooth())).groups


def test_controls_that_multiply_each_other_are_not_affine_together():
    structure = structure_of(one_state(lambda q, v, a, b: ca.exp(q) * a * b))
    assert len(structure.split.affine) == 1
    assert structure_of(one_state(lambda q, v, a, b: ca.exp(q) * a**2)).split.affine == (3,)


def test_an_affine_control_whose_bounds_exclude_zero():
    q, v, a = ca.SX.sym("q"), ca.SX.sym("v"), ca.SX.sym("a")
    system = nocl.System("test", x=ca.vertcat(q, v), u=a, xdot=ca.vertcat(v, ca.exp(q) * a), lbx=[-1, -1], ubx=[1, 1],
                         lbu=[2], ubu=[5])
    structure = structure_of(system)
    z = structure.split.box.sample(20, np.random.default_rng(0))
    function, learned = model(structure, z)
    value, _ = structure.residual(lambda x, u: Dataset.label(system, x, u), z)
    np.testing.assert_allclose(function(z.T, value[:, learned].T).full(), system.f(z[:, :2].T, z[:, 2:].T).full(),
                               atol=1e-13)


def test_affine_parts_are_exact_to_1e_12():
    structure = structure_of(one_state(lambda q, v, a, b: 0.3 * v - 1.7 + ca.exp(ca.sin(q)) + 2.5 * a))
    z = structure.split.box.sample(100, np.random.default_rng(1))
    _, slope = evaluate(structure.linear, z)
    columns = structure.split.columns
    assert np.abs(slope[:, columns, 1] - 0.3).max() < 1e-12  # d(d v/dt at rest)/dv
    assert [g.variables for g in structure.groups] == [(0,)]


def test_a_step_is_seen_though_its_derivative_is_zero():
    structure = structure_of(one_state(lambda q, v, a, b: ca.sign(v) * 0.5 + a))
    assert [g.variables for g in structure.groups] == [(1,)]


def test_gradient_labels_of_coefficients_match_finite_differences():
    """The derivatives of the split and expanded labels are those of their values."""
    system = cartpole.system()
    structure = structure_of(system)
    z = structure.split.box.sample(20, np.random.default_rng(2))
    k, h = 2, 1e-6

    def values(shift):
        moved = z.copy()
        moved[:, k] += shift
        return structure.residual(lambda x, u: Dataset.label(system, x, u), moved)[0]

    _, gradient = structure.residual(lambda x, u: Dataset.label(system, x, u), z)
    np.testing.assert_allclose(gradient[:, :, k], (values(h) - values(-h)) / (2 * h), atol=1e-7)


def test_expansion_interpolates_a_product_of_a_quadratic_and_sines():
    box = Variables(("a", "w"), np.array([-5.0, -6.0]), np.array([5.0, 6.0]), 2, (0,))
    expansion = Expansion(box, (0,), (0, 1), (1, 2))

    def labels(z):
        value = (1 + 2 * np.sin(z[:, 0])) * (3 + z[:, 1] ** 2)
        return value[:, None], np.zeros((len(z), 1, 2))

    got, _ = expansion.labels(labels, box.sample(3, np.random.default_rng(0)))
    want = np.zeros(9)  # monomials: (1, sin, cos) x (1, w/6, (w/6)^2)
    want[[0, 2, 3, 5]] = 3, 36, 6, 72
    np.testing.assert_allclose(got, np.tile(want, (3, 1)), atol=1e-12)


def test_structure_from_given_data():
    system = cartpole.system()
    data = Dataset.sample(system, 400, seed=3)
    structure = read(np.hstack([data.x, data.u]), data.xdot, np.concatenate([data.A, data.B], axis=2), box_of(system))
    assert [g.variables for g in structure.groups] == [(2, 3, 4)]
    assert "d p/dt = v exact; d theta/dt = omega exact" in structure.words


def test_labels_that_are_not_finite_or_lack_jacobians_are_refused():
    system = cartpole.system()

    def broken(x, u):
        data = Dataset.label(system, x, u)
        data.xdot[0] = np.nan
        return data

    with pytest.raises(ValueError, match="not finite"):
        find(broken, box_of(system))
    with pytest.raises(ValueError, match="no Jacobians"):
        find(lambda x, u: Dataset(x, u, Dataset.label(system, x, u).xdot), box_of(system))
