"""The paper's method on problems with parameters and time: on z = (x, clock, p), which is the same problem."""

import casadi as ca
import numpy as np
import pytest
import torch
from movers import mover, optimum

import nocl
from nocl.nets import MLP, FeatureNet
from nocl.solvers.cnd.lifted import Lifted
from nocl.solvers.cnd.paper import PaperSettings, Trainer, controller_net, value_net

SMALL = PaperSettings(hidden=(16,), value_hidden=(16,), iterations=30, batch=32, race=1, intervals=20, time_input=True)


def timed():
    """A reference in time, drag that fades, a wall in p."""
    x, u, t = ca.vertcat(ca.SX.sym("pos"), ca.SX.sym("v")), ca.SX.sym("u"), nocl.time()
    mass, goal = nocl.parameter("mass", 1.0), nocl.parameter("goal", 0.5)
    s = nocl.System("timed", x=x, u=u, p=mass, xdot=ca.vertcat(x[1], u / mass - ca.exp(-t) * x[1]), lbu=[-2], ubu=[2],
                    lbx=[-4, -4], ubx=[4, 4])
    return nocl.OCP(s, p=goal, horizon=2.0, running=0.1 * u**2 + (x[0] - goal * ca.sin(t))**2, terminal=mass * x[1]**2,
                    x_goal=[goal, 0], u_goal=[0], initial_states=nocl.Gaussian([0, 0], [0.3, 0.3]),
                    parameters=nocl.Uniform([0.5, -1], [2, 1]), path_constraints={"wall": goal + 2 - x[0]})


@pytest.mark.parametrize("make", [mover, timed])
def test_the_lifted_problem_is_the_problem(make):
    ocp = make()
    of, rng = Lifted(ocp), np.random.default_rng(0)
    n, at = 40, ocp.functions.arguments
    z, u, t = of.sample(n, rng), rng.uniform(-2, 2, (n, 1)), rng.uniform(0, 2, n)
    z[:, 2:2 + len(of.clock)] = t[:, None]
    x, p = z[:, :2], z[:, -2:]
    given = at.columns(x=x, u=u, t=t, p=p)
    xdot = of.ocp.system.f(z.T, u.T).full()
    np.testing.assert_allclose(xdot[:2], ocp.functions.f(*given).full(), rtol=1e-14)
    np.testing.assert_array_equal(xdot[2:], np.repeat([[1.0]] * len(of.clock) + [[0.0]] * 2, n, axis=1))
    np.testing.assert_allclose(of.ocp.L_soft(z.T, u.T).full(), ocp.L_soft(*given).full(), rtol=1e-14)
    np.testing.assert_allclose(of.ocp.G(z.T).full(), ocp.G(x.T, p.T).full(), rtol=1e-14)
    low, high = ocp.parameter_box
    assert ((low <= p) & (p <= high)).all()
    assert np.abs(np.corrcoef(of.sample(2000, rng)[:, [0, 1, -2, -1]].T)[:2, 2:]).max() < 0.08


@pytest.mark.parametrize("make", [mover, timed])
def test_costs_and_losses_are_those_at_each_p(make):
    """Feedback in continuous time, on a fine grid, is what the judge says; of the optimum the HJB residual is V's."""
    ocp = make()
    of = Lifted(ocp)
    torch.manual_seed(0)
    policy, value = controller_net(of.ocp, SMALL).double(), value_net(of.ocp, SMALL).double()
    own, V = of.lowered(policy), of.lowered(value)
    assert own.inputs.name_in() == V.inputs.name_in() == ["x", "t", "p"]
    fine = PaperSettings(**{**vars(SMALL), "intervals": 200})
    trainer = Trainer(of.ocp, None, fine, 0, False, "cpu", torch.float64, of.sample)
    z = of.sample(5, np.random.default_rng(1))
    cost = trainer.costs(policy, torch.from_numpy(z), hold=False).detach().numpy()
    law = nocl.CND(ocp, own, V)
    run = nocl.simulate(ocp, law, z[:, :2], p=z[:, -2:])
    soft = ocp.penalty * np.maximum(ocp.penalty_margin - run.clearance, 0)
    assert not soft.any()
    np.testing.assert_allclose(cost, run.cost, rtol=1e-5)
    t = torch.full((5, 1), 0.0, dtype=torch.float64)
    x, p = (torch.from_numpy(np.ascontiguousarray(part)) for part in (z[:, :2], z[:, -2:]))
    np.testing.assert_array_equal(V(x, t, p).detach(), value(torch.from_numpy(z), t).detach())


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_it_trains_and_learns_each_goal(tmp_path):
    ocp = mover()
    settings = PaperSettings(**{**vars(SMALL), "iterations": 400, "batch": 128, "hidden": (32,), "value_hidden": (32,)})
    cnd = nocl.train(ocp, method="paper", settings=settings, progress=False)
    x0, p = ocp.initial_states.sample(20, 1), ocp.parameters.sample(20, 2)
    run = nocl.simulate(ocp, cnd, x0, p=p)
    still = nocl.simulate(ocp, lambda x, t, p: 0 * x[:, :1], x0, p=p).cost
    lost = run.cost - optimum(x0, p)
    assert lost.mean() < 0.05 * still.mean()
    goals = np.corrcoef(run.x[:, -1, 0], p[:, 1])[0, 1]
    assert goals > 0.95
    cnd.save(tmp_path)
    again = nocl.CND.load(tmp_path)
    np.testing.assert_array_equal(again(x0, 0.5, p), cnd(x0, 0.5, p))


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_learned_dynamics_and_checkpoints(tmp_path):
    ocp = mover()
    at = ocp.system.arguments
    x, u, p = at.inputs
    y = ca.SX.sym("y")
    net = FeatureNet(at.function("none", {"phi": ca.vertcat(x, u, p)}), [MLP([4, 2, 1])],
                     at.function("xdot", {"xdot": ca.vertcat(x[1], u / p) + 0 * y}, y=y))
    model = nocl.LearnedDynamics(ocp.system, net.double(), "known", parameters=ocp.plant_parameters)
    exact, learned, resumed = (nocl.train(ocp, m, method="paper", settings=SMALL, progress=False, out=tmp_path / name)
                               for m, name in ((None, "a"), (model, "b"), (model, "b")))
    x0, q = ocp.initial_states.sample(4, 1), ocp.parameters.sample(4, 2)
    np.testing.assert_allclose(learned(x0, 0.0, q), exact(x0, 0.0, q), rtol=0, atol=2e-2)
    np.testing.assert_array_equal(resumed(x0, 0.0, q), learned(x0, 0.0, q))
    cnd = nocl.train(timed(), method="paper", settings=SMALL, progress=False)
    assert cnd.policy.inputs.name_in() == ["x", "t", "p"]
