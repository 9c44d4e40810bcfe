"""f(x, u, p) learned, from labels and from logs: one model of all parameters, equal to those of each."""

import casadi as ca
import numpy as np
import pytest
import torch

import nocl
from nocl.solvers import DDP
from nocl.sysid import LogSettings, Settings

WHERE = nocl.Uniform([0.7, 0.05], [1.3, 0.2])
QUICK = Settings.of("quick")


def cart():
    pos, v, force = (ca.SX.sym(name) for name in ("pos", "v", "force"))
    mass, drag = nocl.parameter("mass", 1.0, "kg"), nocl.parameter("drag", 0.1)
    return nocl.System("cart", x=ca.vertcat(pos, v), u=force, p=ca.vertcat(mass, drag), lbu=[-3], ubu=[3],
                       xdot=ca.vertcat(v, force / mass - drag * v - ca.sin(pos)), lbx=[-5, -5], ubx=[5, 5])


@pytest.fixture(scope="module")
def learned():
    return nocl.identify(cart(), parameters=WHERE, settings=QUICK, progress=False)


def samples(n=50, seed=0):
    rng = np.random.default_rng(seed)
    return rng.uniform(-3, 3, (n, 2)), rng.uniform(-3, 3, (n, 1)), WHERE.sample(n, seed)


def test_the_structure_is_found_in_the_parameters_too(learned):
    assert "d pos/dt = v exact" in learned.structure
    assert "affine in force and drag" in learned.structure
    x, u, p = samples()
    error = learned(*map(torch.from_numpy, (x, u, p))).detach().numpy() - cart().f(x.T, u.T, p.T).full().T
    assert np.abs(error).max() < 0.01 * 5.3  # of the largest acceleration
    assert learned.score().mean < 0.01


def test_torch_is_casadi_and_what_is_saved(learned, tmp_path):
    x, u, p = samples()
    f = learned.to_casadi()
    assert f.name_in() == ["x", "u", "p"]
    value = f(x.T, u.T, p.T).full().T
    np.testing.assert_allclose(learned(*map(torch.from_numpy, (x, u, p))).detach(), value, rtol=0, atol=1e-12)
    learned.save(tmp_path)
    again = nocl.LearnedDynamics.load(tmp_path)
    np.testing.assert_array_equal(again.to_casadi()(x.T, u.T, p.T).full().T, value)
    np.testing.assert_array_equal(again.parameters.lb, WHERE.lb)
    wide = again.widened
    np.testing.assert_allclose(wide.to_casadi()(x.T, np.hstack([u, p]).T).full().T, value, rtol=0, atol=1e-12)


def test_a_refined_model_is_better_where_it_was_asked_to_be(learned):
    x, u, _ = samples(20)
    finer = learned.refine(0.1 * x, u, p=[1.25, 0.18], settings=QUICK, progress=False)
    at = [torch.from_numpy(a) for a in (0.1 * x, u, np.tile([1.25, 0.18], (20, 1)))]
    true = cart().f(*(a.numpy().T for a in at)).full().T
    errors = [np.abs(model(*at).detach().numpy() - true).max() for model in (learned, finer)]
    assert errors[1] < errors[0]
    with pytest.raises(ValueError, match="p is missing"):
        learned.refine(x, u)


def test_problems_are_solved_on_it_at_every_p(learned):
    s = cart()
    goal = nocl.parameter("goal", 0.5)
    pos, v = ca.vertsplit(s.x)
    ocp = nocl.OCP(s, p=goal, horizon=2.0, running=0.01 * s.u**2, terminal=(pos - goal)**2 + v**2,
                   x_goal=[goal, 0], u_goal=[0], initial_states=nocl.Gaussian([0, 0], [0.3, 0.3]),
                   parameters=nocl.Uniform([0.7, 0.05, -1], [1.3, 0.2, 1]))
    np.testing.assert_array_equal(ocp.plant_parameters.ub, WHERE.ub)
    x0, p = ocp.initial_states.sample(6, 0), ocp.parameters.sample(6, 0)
    exact = DDP(ocp, intervals=20).solve(x0, p=p)
    found = DDP(ocp, intervals=20, dynamics=learned).solve(x0, p=p)
    assert found.success.all()
    run = nocl.simulate(ocp, found.u, x0, p=p)
    np.testing.assert_allclose(run.cost, exact.cost, rtol=0.02, atol=1e-4)


def test_a_log_has_parameters_as_columns(tmp_path):
    """Twelve carts of other masses, in a file: the model of all predicts each."""
    s, rng = cart(), np.random.default_rng(0)
    rows = []
    for run, p in enumerate(WHERE.sample(12, 0)):
        ocp = nocl.OCP(s.at(p), horizon=3.0, running=s.u**2, terminal=0 * s.x[0], x_goal=[0, 0], u_goal=[0],
                       initial_states=nocl.Gaussian([0, 0], [0.3, 0.3]))
        u = np.repeat(rng.uniform(-3, 3, 6), 10)[:, None]
        seen = nocl.simulate(ocp, u[None], rng.uniform(-1, 1, (1, 2)))
        rows += [[run, t, *x, *v, *p] for t, x, v in zip(seen.t, seen.x[0], np.vstack([u, u[-1:]]), strict=True)]
    file = tmp_path / "carts.csv"
    np.savetxt(file, rows, delimiter=",", header="run,t,pos,v,force,mass,drag", comments="")
    log = nocl.Log.read(file, s)
    assert log.controls == ("force", "mass", "drag")
    quick = LogSettings.of("quick")
    model = nocl.identify(s, data=log, parameters=WHERE, known={"pos": "v"}, settings=quick, progress=False)
    assert model.to_casadi().name_in() == ["x", "u", "p"]
    seen = model.validate(log, (1, 10))
    assert (seen.relative < 0.2 * seen.still_relative).all()
    a = np.array(rows)
    again = nocl.Log.of(s, a[:, 1], a[:, 2:4], a[:, 4:5], p={"mass": a[:, 5], "drag": a[:, 6]}, run=a[:, 0].astype(int))
    assert all((one.u == other.u).all() for one, other in zip(log, again, strict=True))


def test_refusals():
    s = cart()
    with pytest.raises(ValueError, match="parameters is None; expected where mass, drag lie"):
        nocl.identify(s)
    with pytest.raises(ValueError, match=r"parameters is Uniform.*expected where mass, drag lie"):
        nocl.identify(s, parameters=nocl.Uniform([0.7], [1.3]))
    with pytest.raises(ValueError, match="the system has none"):
        nocl.identify(s.at([1.0, 0.1]), parameters=WHERE)
    with pytest.raises(ValueError, match="control_affine is not stated"):
        nocl.identify(s, parameters=WHERE, control_affine=True)
    with pytest.raises(ValueError, match="p is missing; expected values of mass, drag"):
        nocl.Log.of(s, np.arange(9.0), np.zeros((9, 2)), np.zeros((9, 1)))
    net = nocl.identify(s.at([1.0, 0.1]), settings=QUICK, progress=False).net
    for ask in (nocl.LearnedDynamics.score, nocl.LearnedDynamics.plot):
        with pytest.raises(ValueError, match="where mass, drag lie is not known"):
            ask(nocl.LearnedDynamics(s, net, "by hand"))
    timed = nocl.System("timed", x=s.x, u=s.u, p=s.p, xdot=ca.vertcat(s.x[1], s.u + s.p[0] * nocl.time()),
                        lbu=[-1], ubu=[1], lbx=[-1, -1], ubx=[1, 1])
    with pytest.raises(ValueError, match="f holds the time"):
        nocl.identify(timed, parameters=WHERE)
