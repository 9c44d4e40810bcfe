"""Labels that are given, affine in the controls: the mathematics of the fit, what is found, what is refused."""

import dataclasses

import casadi as ca
import numpy as np
import pytest
import torch

import nocl
from nocl.data import Dataset
from nocl.sysid import fitting
from nocl.sysid.affine import affine_in_controls
from nocl.sysid.identification import LearnedDynamics, Settings, identify
from nocl.sysid.labels import Source, box_of, draw_pool, find_structure
from nocl.sysid.networks import samples_of
from nocl.sysid.progress import Progress
from nocl.sysid.stated import Stated
from nocl.sysid.structure import Variables, read
from nocl.sysid.trial import better_affine
from nocl.systems import cartpole

SMALL = Settings(width=16, iterations=200, batch=256, polish=25, polish_batch=256)


def plant(bent: float = 0.0) -> nocl.System:
    """Two learned rows: the first linear in u with a known slope, the second with one that depends on p; bent u^3."""
    p, v, u = ca.SX.sym("p"), ca.SX.sym("v"), ca.SX.sym("u")
    xdot = ca.vertcat(ca.sin(p * v) + 2 * u, ca.exp(ca.sin(2 * p)) * u + ca.tanh(v * p) + bent * u**3 * ca.cos(v))
    return nocl.System("plant", x=ca.vertcat(p, v), u=u, xdot=xdot, lbu=[-1], ubu=[2], lbx=[-1, -1], ubx=[1, 1])


def both(system: nocl.System, n: int, seed: int = 3) -> tuple[Dataset, Dataset]:
    """Given labels with Jacobians, and the same without."""
    data = Dataset.sample(system, n, seed)
    return data, Dataset(data.x, data.u, data.xdot)


def slope_in_u(model: LearnedDynamics, u: float) -> torch.Tensor:
    x = torch.tensor([[0.3, -0.2]], dtype=torch.float64)
    return torch.func.jacfwd(lambda c: model(x, c)[0])(torch.tensor([[u]], dtype=torch.float64))[:, 0, 0].detach()


def mixture(n: int = 50) -> tuple[fitting.Samples, fitting.Weights]:
    """Labels of a network of (sin a, cos a, b) with outputs y0, y1, y2: y0 + w y1 and y2, w a third variable."""
    g = torch.Generator().manual_seed(4)
    a, b, w = torch.rand(3, n, generator=g, dtype=torch.float64) * 2 - 1
    phi = torch.stack([a.sin(), a.cos(), b], 1)
    slope = torch.stack([a.cos(), -a.sin(), torch.ones_like(b)], 1)
    place = torch.tensor([[[1, 0], [0, 1], [0, 0]], [[0, 0], [0, 0], [1, 0]]], dtype=torch.float64)
    rate = torch.tensor([[0, 0, 0], [0, 0, 0.5]], dtype=torch.float64)
    mix = fitting.Mix(torch.stack([torch.ones_like(w), 0.5 * w], 1), place, rate)
    y, dy = torch.randn(n, 2, generator=g).double(), torch.randn(n, 2, 3, generator=g).double()
    shapes = ((5, 4), (5, 6), (3, 9))
    weights = [torch.randn(s, generator=g, dtype=torch.float64) for s in shapes]
    return fitting.Samples(phi, slope, torch.tensor([0, 0, 1]), y, dy, mix), weights


def test_tangents_of_mixed_labels_are_derivatives():
    """By central differences in each of the three variables a, b and w."""
    samples, weights = mixture(1)
    a, b, w = torch.atan2(samples.phi[0, 0], samples.phi[0, 1]), samples.phi[0, 2], 2 * samples.mix.weights[0, 1]

    def label(z: torch.Tensor) -> torch.Tensor:
        phi = torch.stack([z[0].sin(), z[0].cos(), z[1]])
        y = fitting.forward(weights, phi[None, None])[0, 0]
        return torch.stack([y[0] + 0.5 * z[2] * y[1], y[2]])

    batch = samples.batch(torch.tensor([0]), torch.eye(3))
    got = fitting.mixed(fitting.forward(weights, batch.phi), batch.mix)[:, 0]
    z = torch.stack([a, b, w])
    torch.testing.assert_close(got[0], label(z), rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(got[1:], torch.func.jacfwd(label)(z).T, rtol=1e-10, atol=1e-10)


def test_gauss_newton_of_mixed_labels_is_automatic_differentiation():
    samples, weights = mixture()
    batch = samples.batch(torch.arange(50), torch.eye(3))
    scale = torch.rand(4, 1, 2, generator=torch.Generator().manual_seed(2), dtype=torch.float64)

    def labels(*w):
        return fitting.mixed(fitting.forward(w, batch.phi), batch.mix)

    jacobian = torch.func.jacrev(labels, argnums=(0, 1, 2))(*weights)
    J = (torch.cat([j.flatten(3) for j in jacobian], 3) * scale[..., None]).flatten(0, 2)
    r = ((labels(*weights) - batch.y) * scale).flatten()
    JJ, Jr, square = fitting.gauss_newton(weights, batch, scale, chunk=16)
    torch.testing.assert_close(JJ, J.T @ J / 50, rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(Jr, J.T @ r / 50, rtol=1e-4, atol=1e-4)
    assert square == pytest.approx(float(r @ r) / 50, rel=1e-12)


def three_controls() -> nocl.System:
    """Boxes of controls off 0, a negative step, an angle, rows with different controls, known linear terms."""
    th, v, q, s, a, b, c = (ca.SX.sym(n) for n in ("th", "v", "q", "s", "a", "b", "c"))
    xdot = ca.vertcat(v, ca.sin(th) * ca.exp(ca.cos(th)) + ca.exp(ca.sin(th)) * a + 3 * b,
                      ca.tanh(q * s) + ca.exp(-q * q) * b + ca.sin(q + s) * c - 2 * a,
                      ca.exp(ca.sin(s)) * c * ca.tanh(q) + v / 2)
    return nocl.System("three", x=ca.vertcat(th, v, q, s), u=ca.vertcat(a, b, c), xdot=xdot, lbu=[-3, 1, -1],
                       ubu=[-1, 2, 0.5], lbx=[-3, -1, -1, -1], ubx=[3, 1, 1, 1], angles=["th"])


@pytest.mark.parametrize("known", [None, ["q"]])
def test_exact_coefficients_meet_the_labels(known):
    """Coefficients that the exact f has, mixed, are the given labels, values and derivatives, to rounding."""
    system = three_controls()
    source = Source.of(system, Dataset.sample(system, 100, 3), True)
    parts = find_structure(source, Settings(), 0, Stated.of(system, known, True))
    pool = draw_pool(source, parts, Settings(), np.random.default_rng(0))
    oracle = Source.of(system, None, True).oracle
    exact, slope = parts.residual(oracle, pool.z)
    assert parts.groups
    for i, group in enumerate(parts.groups):
        samples, mean, spread = samples_of(parts, pool, i, True)
        variables = [*group.variables, *parts.controls(group)]
        unit = parts.split.box.width[variables] / np.sqrt(12)
        c = list(group.coefficients)
        y = (exact[:, c] - mean) / spread
        dy = slope[:, c][:, :, variables] * unit / spread[:, None]
        outputs = torch.from_numpy(np.concatenate([y[None], dy.transpose(2, 0, 1)]))
        batch = samples.batch(torch.arange(100), torch.eye(len(variables)))
        torch.testing.assert_close(fitting.mixed(outputs, batch.mix), batch.y, rtol=0, atol=1e-12)


def test_rows_kept_apart_are_not_fitted(monkeypatch):
    seen = []
    data = Dataset.sample(plant(), 100, 3)
    source = Source.of(plant(), data, True)

    def spy(part, parts, *_):
        seen.append(part.data[0])
        raise InterruptedError

    monkeypatch.setattr("nocl.sysid.trial.fit_groups", spy)
    parts = find_structure(source, Settings(), 0, Stated.of(plant(), None, False))
    with pytest.raises(InterruptedError):
        better_affine(source, parts, Settings(), 0, Progress("", False))
    assert len(seen[0]) == 80
    assert len(np.unique(seen[0], axis=0)) == 80


def test_each_row_counts_in_its_own_unit():
    """A row a thousand times larger, affine, does not make one affine that is not."""
    p, v, u = ca.SX.sym("p"), ca.SX.sym("v"), ca.SX.sym("u")
    xdot = ca.vertcat(1000 * (ca.sin(3 * p * v) + ca.exp(ca.sin(2 * p + v)) * u), ca.tanh(2 * u + p))
    system = nocl.System("units", x=ca.vertcat(p, v), u=u, xdot=xdot, lbu=[-1], ubu=[1], lbx=[-1, -1], ubx=[1, 1])
    model = identify(system, data=Dataset.sample(system, 100, 3), settings=SMALL, progress=False)
    assert "affine" not in model.structure


def test_a_statement_that_labels_contradict_is_refused_and_never_ignored():
    p, v, u = ca.SX.sym("p"), ca.SX.sym("v"), ca.SX.sym("u")

    def system(*rows):
        return nocl.System("s", x=ca.vertcat(p, v), u=u, xdot=ca.vertcat(*rows), lbu=[-1], ubu=[1], lbx=[-1, -1],
                           ubx=[1, 1])

    square = system(u**2 * p, ca.exp(ca.sin(2 * p)) * u + ca.tanh(v * p))
    data = Dataset.sample(square, 100, 3)
    with pytest.raises(ValueError, match="d p/dt is not affine"):
        identify(square, data=data, control_affine=True, settings=SMALL, progress=False)
    stated = identify(square, data=data, control_affine=True, known=["p"], settings=SMALL, progress=False)
    assert "affine in u" in stated.structure
    x, w = torch.from_numpy(data.x), torch.from_numpy(data.u)
    torch.testing.assert_close(stated(x, w)[:, :1], w**2 * x[:, :1], rtol=0, atol=1e-12)  # known, and not affine
    noisy = system(2 * u, ca.exp(ca.sin(2 * p)) * u + ca.tanh(v * p))
    data = Dataset.sample(noisy, 100, 3)
    data = dataclasses.replace(data, B=data.B + 1e-4 * np.random.default_rng(0).standard_normal(data.B.shape))
    model = identify(noisy, data=data, control_affine=True, settings=SMALL, progress=False)
    torch.testing.assert_close(slope_in_u(model, -0.7), slope_in_u(model, 0.9), rtol=0, atol=1e-12)


@pytest.mark.parametrize("drawn", [True, False])
def test_false_statements_are_told(drawn):
    """What is bent is refused where labels are drawn, told where they are given; so are rows that are not as known."""
    p, v, u = ca.SX.sym("p"), ca.SX.sym("v"), ca.SX.sym("u")
    system = nocl.System("s", x=ca.vertcat(p, v), u=u, xdot=ca.vertcat(v, ca.exp(ca.sin(v)) + ca.sin(2 * u) * p),
                         lbu=[-1], ubu=[1], lbx=[-1, -1], ubx=[1, 1])
    given = {} if drawn else {"data": Dataset.sample(system, 200, 3)}
    if drawn:
        with pytest.raises(ValueError, match="not affine in u"):
            identify(system, control_affine=True, settings=SMALL, progress=False)
    else:
        with pytest.warns(UserWarning, match="d v/dt affine in the controls misses its slopes in u"):
            identify(system, control_affine=True, settings=SMALL, progress=False, **given)
    with pytest.warns(UserWarning, match="d p/dt as it is known misses the labels by 1e"):
        identify(system, known={"p": 2 * v}, settings=SMALL, progress=False, **given)


@pytest.mark.parametrize("gradients", [True, False])
def test_stated_affine_controls_are_affine(gradients):
    data = both(plant(), 300)[0 if gradients else 1]
    model = identify(plant(), data=data, control_affine=True, settings=SMALL, progress=False)
    torch.testing.assert_close(slope_in_u(model, -0.7), slope_in_u(model, 1.9), rtol=0, atol=1e-12)
    assert "affine in" in model.structure
    assert model.score().mean < (1e-3 if gradients else 2e-2)  # f is about 2


def test_what_is_affine_is_found():
    data = both(plant(), 60)[0]
    found = identify(plant(), data=data, settings=SMALL, progress=False)
    assert found.structure.startswith("affine in u;")
    torch.testing.assert_close(slope_in_u(found, -0.7), slope_in_u(found, 1.9), rtol=0, atol=1e-12)
    assert found.score().mean < 5e-3
    assert float(slope_in_u(found, 0.0)[0]) == pytest.approx(2.0, abs=1e-9)  # read off, not learned


@pytest.mark.slow
def test_what_is_not_affine_is_not():
    data = both(plant(0.3), 60)[0]
    model = identify(plant(0.3), data=data, settings=SMALL, progress=False)
    assert "affine" not in model.structure
    with pytest.warns(UserWarning, match="d v/dt affine in the controls"):
        stated = identify(plant(0.3), data=data, control_affine=True, settings=SMALL, progress=False)
    assert model.score().mean < 0.5 * stated.score().mean


@pytest.mark.filterwarnings("ignore:identify. the labels speak against:UserWarning")  # too few steps
def test_the_model_is_saved_and_refined(tmp_path):
    """Refining goes on from where SOAP ended: from hardly trained weights Levenberg-Marquardt may end anywhere.

    Over five seeds the error falls to 0.8 to 1.8 % of what it was; from 30 steps of SOAP, to 0.1 to 51 %.
    """
    model = identify(plant(), data=both(plant(), 60)[0], control_affine=True,
                     settings=dataclasses.replace(SMALL, polish=2), progress=False)
    model.save(tmp_path)
    loaded = LearnedDynamics.load(tmp_path)
    x, u = np.random.default_rng(0).uniform(-1, 1, (20, 2)), np.random.default_rng(1).uniform(-1, 1, (20, 1))
    torch.testing.assert_close(loaded(torch.from_numpy(x), torch.from_numpy(u)),
                               model(torch.from_numpy(x), torch.from_numpy(u)), rtol=0, atol=0)
    better = loaded.refine(x, u, settings=SMALL, progress=False)
    assert better.score().mean < 0.2 * model.score().mean
    torch.testing.assert_close(slope_in_u(better, -0.7), slope_in_u(better, 1.9), rtol=0, atol=1e-12)


def test_controls_are_taken_out_where_that_leaves_something():
    data = Dataset.sample(cartpole.system(), 200, 1)
    z, gradient = np.hstack([data.x, data.u]), np.concatenate([data.A, data.B], axis=2)
    found = read(z, data.xdot, gradient, box_of(cartpole.system()))
    changed = affine_in_controls(found)
    assert [g.variables for g in found.groups] == [(2, 3, 4)]
    assert [g.variables for g in changed.groups] == [(2, 3)]
    assert len(changed.groups[0].coefficients) == 2 * len(found.groups[0].coefficients)
    assert affine_in_controls(changed) is None
    box = Variables(("x", "u"), np.array([-1.0, -1.0]), np.array([1.0, 1.0]), 1)
    z = np.random.default_rng(0).uniform(-1, 1, (200, 2))
    alone = read(z, np.exp(np.sin(3 * z[:, 1:])), np.stack([0 * z[:, :1], 3 * np.cos(3 * z[:, 1:])
                                                            * np.exp(np.sin(3 * z[:, 1:]))], 2), box)
    assert [g.variables for g in alone.groups] == [(1,)]
    assert affine_in_controls(alone) is None
