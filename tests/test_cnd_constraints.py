"""Policies of problems with constraints: the output map that holds those of u alone, margins, what is refused."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
import torch
from constrained import point

import nocl
from nocl.definition.constraints import TOLERANCE
from nocl.definition.ocp import OCP
from nocl.nets import MLP, FeatureNet
from nocl.solvers.cnd import CND, TrainSettings
from nocl.solvers.cnd.held import FIRST, LARGEST, LOST, Held
from nocl.solvers.cnd.regression.in_torch import InTorch
from nocl.solvers.cnd.regression.labels import Labels, Problems
from nocl.solvers.cnd.regression.projection import projected, retracted
from nocl.solvers.cnd.training import Training
from nocl.solvers.ddp.solver import DDP
from nocl.solvers.ddp.without_compiler import NumpyKernel
from nocl.translate.torch_functions import to_torch

TINY = TrainSettings.of("quick", value=False, seeds=4, starts=3, states=20, tails=60, visits=40, iterations=500,
                        held_out=12, intervals=20, hidden=(24, 24))


def double_integrator(unit: float = 1.0, **more) -> OCP:
    """To rest at 0 with |v| <= 0.7 and u1^2 + u2^2 <= 1; lengths in `unit` metres."""
    x, v, a, b = (ca.SX.sym(name) for name in ("x", "v", "a", "b"))
    s = nocl.System("cart", x=ca.vertcat(x, v), u=ca.vertcat(a, b), xdot=ca.vertcat(v, (a + b) / unit), lbu=[-1, -1],
                    ubu=[1, 1], lbx=np.array([-2, -2]) / unit, ubx=np.array([2, 2]) / unit)
    given = {"constraints": {"thrust": (None, a**2 + b**2, 1.0), "speed": (-0.7 / unit, v, 0.7 / unit)}, **more}
    return OCP(s, horizon=2.0, running=0.05 * (a**2 + b**2), terminal=unit**2 * (x**2 + v**2), x_goal=[0, 0],
               u_goal=[0, 0], initial_states=nocl.Uniform(np.array([0.6, -0.1]) / unit, np.array([1, 0.1]) / unit),
               **given)


def random_sets(seed: int) -> tuple[OCP, np.ndarray]:
    """A problem on three controls with random half-spaces, a ball and an ellipsoid that hold about u*."""
    rng = np.random.default_rng(seed)
    x, u = ca.SX.sym("x"), ca.SX.sym("u", 3)
    goal = rng.uniform(-0.3, 0.3, 3)
    A = rng.standard_normal((3, 3))
    constraints = {f"plane {i}": float(rng.uniform(0.2, 1)) - ca.dot(ca.DM(rng.standard_normal(3)), u - goal)
                   for i in range(3)}
    constraints |= {"ball": (None, ca.sumsqr(u - 0.1), 2.0), "ellipsoid": 3.0 - ca.bilin(ca.DM(A.T @ A), u, u)}
    s = nocl.System("s", x=x, u=u, xdot=-x + ca.sum1(u), lbu=[-1, -1, -1], ubu=[1, 2, 1.5], lbx=[-2], ubx=[2])
    return OCP(s, horizon=1.0, running=ca.sumsqr(u), terminal=x**2, x_goal=[0], u_goal=goal, constraints=constraints,
               initial_states=nocl.Uniform([-1], [1])), rng.uniform(s.lbu, s.ubu, (4000, 3))


def retraction(ocp: OCP) -> ca.Function:
    v = ca.SX.sym("v", ocp.system.nu)
    return ca.Function("retracted", [v], [retracted(ocp, v)], ["v"], ["u"])


# The output map


@pytest.mark.parametrize("seed", range(6))
def test_the_retraction_holds_all_rows_and_leaves_what_holds_them(seed):
    ocp, v = random_sets(seed)
    rows, s = ocp.functions.rows, ocp.system
    assert projected(ocp).all()
    u = retraction(ocp)(v.T).full()
    c = ca.Function("c", [s.u], [rows.column / ca.DM(ocp.functions.scales)])
    before, after = c(v.T).full().min(axis=0), c(u).full().min(axis=0)
    outside = before < 0
    assert 0.05 < outside.mean() < 1
    assert after.min() > -1e-13
    np.testing.assert_array_equal(u[:, before >= 0], v.T[:, before >= 0])
    assert np.abs(after[outside]).max() < 1e-12  # on the boundary, no further
    np.testing.assert_array_equal(u.T, np.clip(u.T, s.lbu, s.ubu))


def test_the_retraction_is_the_same_in_torch_and_differentiable_everywhere():
    ocp, v = random_sets(1)
    of = retraction(ocp)
    v = np.vstack([v, ocp.u_goal])  # the centre itself, where a root has a slope of inf
    rows = torch.from_numpy(v).requires_grad_(True)
    u = to_torch(of)(rows)
    np.testing.assert_allclose(u.detach().numpy(), of(v.T).full().T, rtol=0, atol=1e-15)
    (slope,) = torch.autograd.grad(u.sum(), rows)
    assert torch.isfinite(slope).all()


def test_a_centre_is_found_where_the_goal_is_at_the_boundary():
    ocp = double_integrator()
    ocp = replace(ocp, constraints={"one side": ocp.system.u[0] + ocp.system.u[1]})
    u = retraction(ocp)(np.random.default_rng(0).uniform(-1, 1, (2, 1000))).full()
    assert u.sum(axis=0).min() > -1e-14


def test_which_rows_the_output_map_holds():
    ocp = double_integrator()
    x, (a, b) = ocp.system.x[0], ca.vertsplit(ocp.system.u)
    ocp = replace(ocp, constraints={"state": 2 - x, "mixed": 3 - x - a, "product": 2 - a * b,
                                    "outside": a**2 + b**2 + 0.1,
                                    "equal": (0.0, a - b, 0.0), "ball": 4 - a**2 - b**2, "line": 1.9 - a - b})
    names = [name for name, mine in zip(ocp.functions.rows.names, projected(ocp), strict=True) if mine]
    assert names == ["ball", "line"]


@pytest.mark.filterwarnings("ignore:.*kink")
def test_a_row_with_a_kink_is_not_taken_for_affine():
    """The derivatives of |u| at 0 say that it is constant; the map would let everything through."""
    u = ca.SX.sym("u", 2)
    x = ca.SX.sym("x", 2)
    system = nocl.System("slide", x=x, u=u, xdot=u, lbu=[-1, -1], ubu=[1, 1], lbx=[-2, -2], ubx=[2, 2])
    ocp = OCP(system, horizon=1.0, running=ca.sumsqr(u), terminal=ca.sumsqr(x), x_goal=[0, 0], u_goal=[0, 0],
              initial_states=nocl.Uniform([-1, -1], [1, 1]),
              constraints={"diamond": 1 - ca.fabs(u[0]) - ca.fabs(u[1]), "sum": 1 - u[0] - u[1],
                           "least": ca.fmin(1 - u[0], 0.9 - u[1])})
    assert dict(zip(ocp.functions.rows.names, projected(ocp), strict=True)) == {
        "diamond": False, "sum": True, "least": False}


def test_a_set_without_room_is_refused():
    ocp = double_integrator(constraints={})
    a, b = ca.vertsplit(ocp.system.u)
    flat = replace(ocp, constraints={"down": -a - b, "up": a + b})
    with pytest.raises(ValueError, match="no control in U holds 'down', 'up' with room to spare"):
        retraction(flat)


def wild_policy(ocp: OCP) -> CND:
    """A policy with the output map of the problem and a network that says anything."""
    torch.manual_seed(0)
    at, y = ocp.functions.feedback(), ca.SX.sym("y", ocp.system.nu)
    s = ocp.system
    phi = at.function("features", {"phi": ca.vertcat(at["x"], at["t"])})
    clipped = ca.fmin(ca.fmax(5 * y, ca.DM(s.lbu)), ca.DM(s.ubu))
    outputs = at.function("controls", {"u": retracted(ocp, clipped)}, y=y)
    return CND(ocp, FeatureNet(phi, [MLP([s.nx + 1, 16, s.nu])], outputs))


def thrust(u: np.ndarray) -> float:
    return float((u**2).sum(axis=-1).max())


def test_a_policy_holds_constraints_of_u_in_casadi_and_in_files(tmp_path):
    ocp = double_integrator()
    cnd = wild_policy(ocp)
    x = np.random.default_rng(0).uniform(-2, 2, (500, 2))
    u = cnd(x, 0.3)
    assert 1 - 1e-6 < thrust(u) <= 1 + 1e-14
    np.testing.assert_allclose(cnd.to_casadi()(x.T, 0.3).full().T, u, atol=1e-14)
    cnd.save(tmp_path)
    np.testing.assert_array_equal(CND.load(tmp_path)(x, 0.3), u)
    run = nocl.simulate(ocp, cnd, x[:3])
    assert thrust(run.u) <= 1 + 1e-13


def test_what_is_exported_is_the_same(tmp_path):
    certificate = wild_policy(double_integrator()).export(tmp_path, to=("casadi", "c", "onnx"))
    assert certificate.ok


# Margins


def test_a_solver_keeps_its_margins():
    ocp = double_integrator()
    held, x0 = Held(ocp, learned=True), np.array([[1.0, 0.0], [0.7, -0.1]])
    elastic = DDP(ocp, intervals=20, substeps=1, constraints="elastic", threads=1)
    margin = np.where(held.inward, 0.05, 0.0)
    s = held.solver(elastic, margin).solve(x0)
    scale = dict(zip(ocp.functions.rows.names, ocp.functions.scales, strict=True))["speed"]
    assert s.success.all()
    assert np.abs(s.x[..., 1]).max() == pytest.approx(0.7 - 0.05 * scale, abs=1e-7)
    assert np.abs(elastic.solve(x0).x[..., 1]).max() == pytest.approx(0.7, abs=1e-7)
    slow = held.solver(elastic, margin)
    slow.kernel = NumpyKernel(ocp, None, 1, slow.rows)
    np.testing.assert_allclose(slow.solve(x0).cost, s.cost, rtol=1e-8)


def test_a_solver_with_margins_is_another_solver():
    ddp = DDP(double_integrator(), intervals=10, substeps=1, threads=1)
    n, known = len(ddp.rows.stage) + len(ddp.rows.end), ddp.key
    inside = ddp.inside(np.full(n, 0.01))
    assert inside.key != known == ddp.key
    for wrong in (np.zeros(n + 1), np.full(n, np.nan)):
        with pytest.raises(ValueError, match="margin"):
            ddp.inside(wrong)
    assert len(ddp.solve(np.zeros((0, 2)))) == 0


def test_a_state_between_margin_and_boundary_has_a_label():
    ocp = double_integrator()
    held = Held(ocp, learned=True)
    elastic = DDP(ocp, intervals=20, substeps=8, constraints="elastic", threads=1)
    ddp = held.solver(elastic, np.where(held.inward, 0.05, 0.0))
    s = held.labels(ddp.solve([[1.0, -0.69], [1.0, -0.7001], [1.0, -1.5]]))
    assert s.success.tolist() == [True, True, False]  # the last one is lost for many steps
    assert abs(s.x[0, 3, 1]) < 0.69


def test_margins_make_up_for_what_is_exceeded_and_no_more():
    held = Held(double_integrator(), learned=True)
    names = np.array(held.names)
    exceeded = np.full((100, len(names)), -0.3)
    exceeded[:, names == "speed"] = 4e-3
    later = held.next(held.first, exceeded, exceeded[:0])
    np.testing.assert_allclose(later[names == "speed"], FIRST + 4e-3 - TOLERANCE / 2)
    assert (later[names == "thrust"] == 0).all()  # the output map holds it
    kicked = np.full((100, len(names)), -0.3)
    kicked[:3] = 1.0  # three kicks in a hundred may
    kicked[3:6] = 0.02  # six may not
    np.testing.assert_allclose(held.next(held.first, exceeded, kicked)[names == "speed"], FIRST + 0.02 - TOLERANCE / 2)
    exceeded[:] = -0.3
    assert (held.next(later, exceeded, kicked[6:]) == 0).all()
    exceeded[:] = np.inf
    assert held.next(later, exceeded, kicked[6:]).max() == LARGEST


def test_equations_have_no_margin():
    ocp = double_integrator()
    held = Held(replace(ocp, terminal_constraints={"at rest": (0, ocp.system.x[1], 0)}), learned=True)
    assert held.first[np.array(held.names) == "at rest"] == 0
    assert held.first[np.array(held.names) == "speed"].tolist() == [FIRST, FIRST]


def test_what_a_policy_exceeds_is_what_the_judge_says():
    ocp = double_integrator()
    held, cnd = Held(ocp), wild_policy(ocp)
    x0 = ocp.initial_states.sample(4, 0)
    over = held.exceeded(cnd.policy, InTorch(ocp), Problems(x0, np.zeros(4), np.zeros((4, 0))), 320)
    judged = nocl.simulate(ocp, cnd, x0, nodes=41).violation
    np.testing.assert_allclose(np.maximum(over.max(axis=1), 0), judged, atol=2e-4)
    shares = held.summary(over, "gap")
    assert shares["gap_violating"] == np.mean(judged > TOLERANCE)
    assert shares["gap_worst"]["speed"] == pytest.approx(judged.max(), abs=2e-4)


def test_margins_and_labels_do_not_know_the_units():
    plain, other = (Held(double_integrator(unit), learned=True) for unit in (1.0, 1e-3))
    of_speed = np.array(plain.names) == "speed"
    np.testing.assert_allclose(plain.scales * 1e3, np.where(of_speed, 1, 1e3) * other.scales, rtol=1e-6)
    x0 = np.array([[1.0, 0.0], [0.8, 0.05]])
    answers = []
    for held, unit in ((plain, 1.0), (other, 1e-3)):
        ddp = DDP(held.ocp, intervals=20, substeps=1, constraints="elastic", threads=1)
        answers.append(held.solver(ddp, held.first).solve(x0 / unit))
    np.testing.assert_allclose(answers[0].u, answers[1].u, atol=1e-6)
    np.testing.assert_allclose(answers[0].cost, answers[1].cost, rtol=1e-7)


# Training


def test_seeds_hold_what_can_be_held_and_the_others_pay_for_little():
    """From v = -0.75 beyond the limit of 0.7 no plan holds it; from the others all do, and cost what those cost."""
    ocp = double_integrator()
    x0 = np.array([[1.0, 0.0], [0.9, 0.05], [0.8, -0.75]])
    training = Training(ocp, None, TINY, 0, None, False)
    at = Problems(x0, np.zeros(3), np.zeros((3, 0)))
    found = training._seeds(at, 3, np.random.default_rng(0), lambda _: None)
    hard = DDP(ocp, intervals=20, substeps=training.substeps, threads=1).solve(x0)
    assert found.success.all()
    np.testing.assert_allclose(found.cost[:2], hard.cost[:2], rtol=1e-6)
    assert (np.abs(found.x[:2, :, 1]) <= 0.7 + 1e-7).all()
    assert hard.success.tolist() == [True, True, False]


def test_first_labels_pass_on_the_better_side():
    """Of a disc in the way, though the one seed passes on one side: the farther off a state lies, the dearer it is."""
    p, u = ca.SX.sym("p", 2), ca.SX.sym("u", 2)
    s = nocl.System("past", x=p, u=u, xdot=u, lbu=[-3, -3], ubu=[3, 3], lbx=[-2, -2], ubx=[2, 2])
    ocp = OCP(s, horizon=2.0, running=ca.sumsqr(u), terminal=20 * ((p[0] - 1.5)**2 + p[1]**2), x_goal=[1.5, 0],
              u_goal=[0, 0], initial_states=nocl.Uniform([-1.5, -0.4], [-1.5, 0.4]),
              constraints={"disc": ca.sumsqr(p) - 0.49})
    training = Training(ocp, None, replace(TINY, seeds=1, states=24, tails=0), 0, None, False)
    training._first_labels()
    found = training.bank.solution
    mirrored = training.ddp.solve(found.x[:, 0], u=found.u * [1, -1])
    assert len(found) == 25
    assert (np.sign(found.x[:, 10, 1]) == np.sign(found.x[:, 0, 1])).mean() > 0.9
    assert (found.cost <= 1.001 * mirrored.cost).all()


def test_lost_states_are_no_labels():
    ocp = double_integrator()
    held = Held(ocp)
    elastic = DDP(ocp, intervals=20, substeps=1, constraints="elastic", threads=1)
    s = held.labels(elastic.solve([[1.0, 0.0], [1.0, -1.9]]))
    assert s.success.tolist() == [True, False]
    over = np.abs(s.x[1, 1:, 1]).max() / 0.7 - 1
    assert over > LOST
    assert len(Labels.of(s, InTorch(ocp), 1.0)) == 20


def test_what_is_not_taken_is_refused_by_name():
    ocp = point().ocp
    free = replace(ocp, horizon=nocl.Free(1, 9), running=ca.SX(1))
    with pytest.raises(ValueError, match="a free horizon and no terminal constraints"):
        nocl.train(free)


def interrupted(training: Training) -> None:
    raise KeyboardInterrupt


@pytest.mark.slow
def test_a_trained_controller_says_what_it_violates(tmp_path, monkeypatch):
    """And one that was interrupted after its first round goes on to the same."""
    ocp = double_integrator()
    cnd = nocl.train(ocp, settings=TINY, seed=0, progress=False)
    row = cnd.card["history"][cnd.card["round"]]
    assert set(row) >= {"gap_violating", "gap_worst", "kicked_violating", "infeasible", "margin"}
    assert set(row["gap_worst"]) == {"thrust", "speed"}
    assert row["gap_worst"]["thrust"] <= 1e-12
    assert row["gap_worst"]["speed"] < 0.05
    assert row["gap_median"] < 0.3
    x0 = ocp.initial_states.sample(20, 5)
    assert thrust(nocl.simulate(ocp, cnd, x0).u) <= 1 + 1e-12
    with monkeypatch.context() as patched:
        patched.setattr(Training, "_visit", interrupted)
        with pytest.raises(KeyboardInterrupt):
            nocl.train(ocp, settings=TINY, seed=0, progress=False, out=tmp_path)
    again = nocl.train(ocp, settings=TINY, seed=0, progress=False, out=tmp_path)
    np.testing.assert_array_equal(again(x0), cnd(x0))
