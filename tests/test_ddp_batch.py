"""Many problems by DDP: pieces, threads, a cluster and a resumed run give what one go does; hard ones on their own."""

import json
import pickle
from functools import lru_cache

import casadi as ca
import numpy as np
import pytest
from test_ddp import BUNDLED, problem, random_model, scalar_problem, solver
from test_nmpc_pool import dask_cluster

import nocl
from nocl.solvers import NMPC
from nocl.solvers.ddp import batch
from nocl.solvers.ddp.solver import DDP


def assert_same(a, b):
    for name, value in a.arrays().items():
        assert name == "seconds" or np.array_equal(value, getattr(b, name)), name


@lru_cache
def pendulum() -> tuple[DDP, np.ndarray]:
    ocp = nocl.load_ocp("pendulum")
    return DDP(ocp, intervals=20, threads=1), ocp.initial_states.sample(30, 0)


# Pieces


def test_pieces_give_what_one_go_does(monkeypatch):
    ddp, x0 = pendulum()
    t0, guess = np.linspace(0, 1, 30), ddp.solve(x0)
    options = {"u": guess.u, "x": guess.x, "gain": guess.gain, "curvature": True}
    whole = ddp.solve(x0, t0, **options)
    monkeypatch.setattr(batch, "MOST", 7)
    assert_same(whole, ddp.solve(x0, t0, **options))
    assert_same(whole, ddp.solve(x0, t0, **options, workers=2))


def test_pieces_are_as_large_as_the_memory_allows(monkeypatch):
    def largest(ddp, x0, curvature=False):
        parts = batch.pieces(ddp, x0, np.zeros(len(x0)), {}, curvature)
        assert sum(p.size for p in parts) == len(x0)
        return max(p.size for p in parts)

    short, long = solver("double_integrator"), solver("double_integrator", 10_000)
    x0 = np.zeros((5000, 2))
    assert largest(short, x0) == batch.MOST
    assert 1 < largest(long, x0) < 500
    assert largest(long, x0) * batch.bytes_each(long, False) <= batch.BYTES
    assert largest(long, x0, True) < largest(long, x0)
    monkeypatch.setattr(batch, "BYTES", 1)
    assert largest(long, x0[:3]) == 1
    assert len(batch.pieces(short, x0[:0], np.zeros(0), {}, False)) == 1  # an empty batch has an empty answer


def test_a_solver_pickles_with_and_without_learned_dynamics():
    ddp, x0 = pendulum()
    assert_same(pickle.loads(pickle.dumps(ddp)).solve(x0), ddp.solve(x0))
    learned = DDP(problem("cartpole"), intervals=10, dynamics=random_model("cartpole"), threads=1)
    x0 = problem("cartpole").initial_states.sample(3, 0)
    assert_same(pickle.loads(pickle.dumps(learned)).solve(x0), learned.solve(x0))


def test_an_interrupted_run_resumes(tmp_path, monkeypatch):
    ddp, x0 = pendulum()
    whole, done, descend = ddp.solve(x0, curvature=True), [], DDP.descend
    monkeypatch.setattr(batch, "MOST", 8)

    def interrupted(self, batch):
        if len(done) == 2:
            raise KeyboardInterrupt
        done.append(batch.first)
        return descend(self, batch)

    with monkeypatch.context() as m:
        m.setattr(DDP, "descend", interrupted)
        with pytest.raises(KeyboardInterrupt):
            ddp.solve(x0, curvature=True, out=tmp_path / "run")
    assert done == [0, 8]
    monkeypatch.setattr(DDP, "descend", lambda self, batch: done.append(batch.first) or descend(self, batch))
    assert_same(ddp.solve(x0, curvature=True, out=tmp_path / "run"), whole)
    assert done == [0, 8, 16, 24]
    assert_same(ddp.solve(x0, curvature=True, out=tmp_path / "run", workers=2), whole)
    assert len(done) == 4
    assert json.loads((tmp_path / "run" / "manifest.json").read_text())["kind"] == "nocl DDP run"
    for other in ({"x0": x0[:4]}, {"x0": x0, "t0": 0.5}, {"x0": x0, "u": whole.u + 0.1}, {"x0": x0}):
        with pytest.raises(ValueError, match="another run"):
            ddp.solve(**other, out=tmp_path / "run")


@pytest.mark.parametrize("workers", [0, True, "two", None])
def test_bad_workers(workers):
    ddp, x0 = pendulum()
    with pytest.raises(ValueError, match="workers is"):
        ddp.solve(x0, workers=workers)


@pytest.mark.slow
def test_a_dask_cluster_gives_the_same(tmp_path, monkeypatch):
    ddp, x0 = pendulum()
    monkeypatch.setattr(batch, "MOST", 8)
    with dask_cluster(tmp_path) as (address, _):
        solution = ddp.solve(x0, workers=address, out=tmp_path / "run")
    assert_same(solution, ddp.solve(x0))


# Agreement with NMPC: optimum, costates and gains all along


@pytest.mark.parametrize("name", [*BUNDLED, "double_integrator"])
def test_optimum_costates_and_gains_are_nmpcs(name):
    ocp = problem(name)
    nmpc = NMPC(ocp, constraints="soft", options={"fatrop.tol": 1e-10})
    x0 = ocp.initial_states.sample(2, 3)
    first = solver(name).solve(x0)
    nlp = nmpc.solve(x0, (first.x, first.u), gains=True)
    ours = solver(name).solve(x0, u=nlp.u, x=nlp.x)
    assert nlp.success.all()
    assert ours.success.all()
    assert np.abs(nlp.cost / ours.cost - 1).max() < 1e-6
    assert np.abs(nlp.V_x - ours.V_x).max() < 1e-5 * (1e-2 + np.abs(ours.V_x).max())
    s = ocp.system
    known = np.isfinite(nlp.gain).all(axis=(2, 3))
    inside = ((ours.u > s.lbu + 1e-4) & (ours.u < s.ubu - 1e-4)).all(axis=2)  # which bounds are active: fatrop's guess
    free = known & np.logical_and.accumulate(inside[:, ::-1], axis=1)[:, ::-1]
    assert free.sum() > 10 or name == "dubins"  # there v is at its bound to the end
    for i in range(2):
        scale = np.abs(ours.gain[i][free[i]]).max(initial=1e-3)
        assert np.abs(nlp.gain[i][free[i]] - ours.gain[i][free[i]]).max(initial=0.0) < 1e-3 * scale


# Hard input: each problem on its own


@pytest.mark.slow
def test_one_step_and_many_in_any_problem():
    for name in ("cartpole", "dubins"):
        ocp = problem(name)
        one = DDP(ocp, intervals=1, threads=1).solve(ocp.initial_states.sample(20, 0))
        assert one.u.shape[:2] == (20, 1)
        assert (one.success | (one.message != "converged")).all()
        assert (np.isfinite(one.cost) == one.success).all()
    many = DDP(problem("pendulum"), intervals=10_000, threads=1).solve(problem("pendulum").initial_states.sample(2, 0))
    assert many.success.all()
    rough = solver("pendulum").solve(many.x[:, 0], u=many.u.reshape(2, 80, 125, 1).mean(axis=2))
    assert np.abs(many.cost / rough.cost - 1).max() < 0.01


def test_nan_that_the_descent_meets_is_stepped_back_from_or_told():
    """sqrt(1.2 - x) is NaN beyond 1.2, where the target pulls: the line search stays where numbers are."""
    x, u = ca.SX.sym("x"), ca.SX.sym("u")
    ocp = scalar_problem(u + 1e-6 * ca.sqrt(1.2 - x), 1e-3 * u**2, x=x, u=u, u_max=5.0, lbx=-1, ubx=1,
                         terminal=(x - 1.1) ** 2)
    s = DDP(ocp, intervals=20, threads=1).solve([[0.0], [1.0], [1.5], [-0.5]])
    assert s.success.tolist() == [True, True, False, True]
    assert "not finite" in s.message[2]
    assert np.isfinite(s.x[s.success]).all()


def test_non_convex_costs_find_a_minimum_or_say_that_there_is_none():
    x, u = ca.SX.sym("x"), ca.SX.sym("u")
    ocp = scalar_problem(u, 0.01 * u**2 + 0.3 * ca.cos(3 * x) - 0.2 * x**2, x=x, u=u, terminal=ca.sin(5 * x), u_max=4.0)
    ddp, x0 = DDP(ocp, intervals=30, threads=1), np.linspace(-1, 1, 40)[:, None]
    s = ddp.solve(x0)
    assert s.success.mean() > 0.9
    assert all(m != "converged" for m in s.message[~s.success])
    rng = np.random.default_rng(0)
    for _ in range(5):  # no small change of the controls is cheaper
        u_near = np.clip(s.u + 0.01 * rng.standard_normal(s.u.shape), -4, 4)
        rolled = ddp.rollout(x0, u=u_near)
        cost = cost_of(ocp, rolled, u_near)
        assert (cost[s.success] > s.cost[s.success] - 1e-9).all()


def cost_of(ocp, x, u):
    """The common RK4's cost [B] of controls u [B, K, 1] along x [B, K+1, 1]."""
    from nocl.translate.rk4 import rk4_cost

    z, v = ca.SX.sym("z"), ca.SX.sym("v")
    step = ca.Function("step", [z, v], list(rk4_cost(ocp.system.f, ocp.L_soft, z, v, ocp.horizon / u.shape[1])))
    stages = step(x[:, :-1, 0].reshape(1, -1), u.reshape(1, -1))[1].full().reshape(len(u), -1)
    return stages.sum(axis=1) + ocp.G(x[:, -1].T).full().ravel()


def test_saturated_throughout_beside_free_ones():
    """Far states are at a bound all along, near ones are not, in one batch."""
    ocp = problem("double_integrator")
    far = np.array([[1e4, 0.0], [-1e4, 0.0]])
    near = ocp.initial_states.sample(6, 0) * 0.1
    s = solver("double_integrator").solve(np.vstack([far, near]))
    assert s.success.all()
    bound = np.asarray(ocp.system.ubu)
    assert np.allclose(s.u[0], -bound)
    assert np.allclose(s.u[1], bound)
    assert (np.abs(s.gain[:2]) == 0).all()
    assert (np.abs(s.u[2:]) < bound).all()


def test_a_stiff_blow_up_does_not_slow_or_spoil_its_neighbours():
    x, u = ca.SX.sym("x"), ca.SX.sym("u")
    ocp = scalar_problem(x**3 + u, 0.1 * u**2, x=x, u=u, horizon=2.0)
    x0 = np.tile([[0.1], [9.0]], (20, 1))
    s = DDP(ocp, intervals=40, threads=1).solve(x0)
    assert s.success.tolist() == [True, False] * 20
    assert (s.iterations[1::2] == 0).all()
    assert len(set(s.cost[::2])) == 1
