"""Constraints of states in the output map of a policy: no policy leaves them, and what holds them is left alone."""

from dataclasses import replace
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
import torch
from test_cnd_constraints import double_integrator

import nocl
from nocl.definition.constraints import TOLERANCE
from nocl.definition.ocp import OCP
from nocl.nets import MLP, FeatureNet
from nocl.solvers.cnd import CND
from nocl.solvers.cnd.fineness import few_plans
from nocl.solvers.cnd.held import Held
from nocl.solvers.cnd.regression.barrier import braked, guarded
from nocl.solvers.cnd.regression.in_torch import InTorch
from nocl.solvers.cnd.regression.labels import Problems
from nocl.solvers.cnd.regression.projection import retracted
from nocl.solvers.ddp import DDP
from nocl.translate.arguments import Arguments

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"
TRACK = 0.5


def on_a_track(unit: float = 1.0, **more) -> OCP:
    """x'' = u, |u| <= 2, |x| <= TRACK, |v| <= 0.8; lengths in `unit` metres."""
    x, v, u = (ca.SX.sym(name) for name in "xvu")
    system = nocl.System("car", x=ca.vertcat(x, v), u=u, xdot=ca.vertcat(v, u / unit), lbu=[-2], ubu=[2],
                         lbx=np.array([-1, -2]) / unit, ubx=np.array([1, 2]) / unit)
    given = {"constraints": {"track": (-TRACK / unit, x, TRACK / unit), "speed": (-0.8 / unit, v, 0.8 / unit)}, **more}
    return OCP(system, horizon=4.0, running=u**2, terminal=(unit * x)**2 + (unit * v)**2, x_goal=[0, 0], u_goal=[0],
               initial_states=nocl.Uniform(np.array([-0.3, -0.3]) / unit, np.array([0.3, 0.3]) / unit), **given)


def on_a_cart() -> OCP:
    """A pole that pushes the cart about, on a track with a limit of speed that depends on time."""
    ocp, T = nocl.load_ocp("cartpole"), 4.0
    return replace(ocp, constraints={"track": (-0.6, ocp.system.x[0], 0.6),
                                     "speed": 2.5 - 0.5 * nocl.time() / T - ocp.system.x[1]})


def wild(ocp: OCP, seed: int, loud: float) -> CND:
    """A network that says anything, in the output map."""
    torch.manual_seed(seed)
    at, s, y = ocp.functions.feedback(), ocp.system, ca.SX.sym("y", ocp.system.nu)
    half = (s.ubu - s.lbu) / 2
    phi = at.function("features", {"phi": ca.vertcat(at["x"] / ca.DM(s.ubx), at["t"])})
    said = ca.fmin(ca.fmax(loud * ca.DM(half) * y, ca.DM(s.lbu)), ca.DM(s.ubu))
    outputs = at.function("controls", {"u": retracted(ocp, braked(ocp, at.given(y=y), said, ocp.longest))}, y=y)
    return CND(ocp, FeatureNet(phi, [MLP([s.nx + 1, 16, s.nu])], outputs))


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("problem", [on_a_track, on_a_cart])
def test_no_policy_leaves_what_it_can_hold(problem, seed):
    ocp = problem()
    x0 = ocp.initial_states.sample(20, seed)
    run = nocl.simulate(ocp, wild(ocp, seed, 20.0), x0, nodes=81)
    assert run.success.all()
    assert run.violation.max() <= TOLERANCE
    plain = nocl.simulate(ocp.without("track"), wild(ocp.without("track"), seed, 20.0), x0, nodes=81)
    assert np.abs(plain.x[:, :, 0]).max() > 1.2 * float(ocp.constraints["track"].high)  # it would leave without


def test_an_optimum_that_touches_the_boundary_is_left_alone():
    """Bryson and Denham's problem: min of the integral of a^2 / 2 from (0, 1) to (0, -1) in 1 s, x <= l = 1/9;
    a = -2/(3 l) (1 - t/(3 l)) until 3 l, 0 while it touches, and the mirror image; J = 4 / (9 l)."""
    x, v, a = (ca.SX.sym(name) for name in "xva")
    system = nocl.System("bd", x=ca.vertcat(x, v), u=a, xdot=ca.vertcat(v, a), lbu=[-20], ubu=[20], lbx=[-1, -3],
                         ubx=[1, 3])
    size = 1 / 9
    ocp = OCP(system, horizon=1.0, running=a**2 / 2, terminal=0 * x, x_goal=[0, -1], u_goal=[0],
              constraints={"wall": (None, x, size)}, scales={"wall": size},
              initial_states=nocl.Gaussian([0, 1], [0, 0]))
    at = ocp.functions.feedback()
    left = ca.fmin(at["t"], 1 - at["t"])
    optimum = -2 / (3 * size) * ca.fmax(1 - left / (3 * size), 0)
    law = at.function("law", {"u": braked(ocp, at, optimum, 1.0)})
    run = nocl.simulate(ocp, law, [[0.0, 1.0]], nodes=161)
    assert run.violation.max() <= TOLERANCE
    assert run.cost[0] == pytest.approx(4 / (9 * size), rel=2e-4)
    np.testing.assert_allclose(run.x[0, -1], [0, -1], atol=2e-3)


def test_which_rows_the_map_holds():
    ocp = on_a_track()
    (p, v), u = ca.vertsplit(ocp.system.x), ocp.system.u
    mixed = replace(ocp, constraints={"track": p + 1, "speed": 2 - v, "power": 2 - u * v, "equal": (0, p - v, 0),
                                      "time": 1 + nocl.time(), "push": 1 - u})
    assert dict(zip(mixed.functions.rows.names, guarded(mixed), strict=True)) == {
        "track": True, "speed": True, "power": True, "equal": False, "time": False, "push": False}
    assert dict(zip(mixed.functions.rows.names, guarded(mixed, learned=True), strict=True)) == {
        name: name == "power" for name in mixed.functions.rows.names}
    slow = nocl.limit_rates(ocp.system, {"u": 5.0})
    third = OCP(slow, horizon=4.0, running=slow.x[2]**2, terminal=slow.x[0]**2, x_goal=[0] * 3, u_goal=[0],
                initial_states=nocl.Gaussian([0] * 3, [0.1] * 3), constraints={"track": (-0.5, slow.x[0], 0.5)})
    assert not guarded(third).any()


@pytest.mark.parametrize("learned", [False, True])
def test_a_limit_that_the_control_moves_at_once_is_held_as_it_stands(learned):
    """Power u v <= 0.5, force between bounds that move: no policy leaves them, and what holds them is left alone."""
    ocp = on_a_track()
    (_, v), u = ca.vertsplit(ocp.system.x), ocp.system.u
    ocp = replace(ocp, constraints={"power": (None, u * v, 0.5), "force": u + 1 + ca.sin(nocl.time())})
    s, at, rng = ocp.system, ocp.functions.feedback().given(said=ca.SX.sym("said", 1)), np.random.default_rng(0)
    law = at.function("law", {"u": braked(ocp, at.but("said"), at["said"], 4.0, guarded(ocp, learned=learned))})
    x, t, said = rng.uniform(s.lbx, s.ubx, (500, 2)), rng.uniform(0, 4, 500), rng.uniform(s.lbu, s.ubu, (500, 1))
    u = law(*at.columns(x=x, t=t, said=said)).full().T
    power, force = 0.5 - u[:, 0] * x[:, 1], u[:, 0] + 1 + np.sin(t)
    assert min(power.min(), force.min()) > -1e-4
    assert (u >= s.lbu).all()
    assert (u <= s.ubu).all()
    inside = (said[:, 0] * x[:, 1] <= 0.5) & (said[:, 0] + 1 + np.sin(t) >= 0)
    assert 100 < inside.sum() < 400
    np.testing.assert_array_equal(u[inside], said[inside])
    assert not Held(ocp, learned).first.any()


def with_a_budget(lowest: float) -> OCP:
    """x' = u - x, and what u amounts to is at most 1 at the end; u in [lowest, 2]."""
    x, spent, u = (ca.SX.sym(name) for name in ("x", "spent", "u"))
    system = nocl.System("tap", x=ca.vertcat(x, spent), u=u, xdot=ca.vertcat(u - x, u), lbu=[lowest], ubu=[2],
                         lbx=[-1, 0], ubx=[1, 2])
    return OCP(system, horizon=4.0, running=(x - 1)**2, terminal=0.0, terminal_constraints={"budget": (None, spent, 1)},
               initial_states=nocl.Uniform([-0.3, 0], [0.3, 0.2]))


def test_a_budget_at_the_end_is_held_all_along_where_nothing_comes_back():
    ocp = with_a_budget(0.0)
    x0 = ocp.initial_states.sample(20, 0)
    runs = [nocl.simulate(ocp, wild(ocp, seed, 20.0), x0, nodes=81) for seed in range(4)]
    assert max(run.violation.max() for run in runs) <= TOLERANCE
    assert max(run.x[:, -1, 1].max() for run in runs) > 0.99  # all of it is used
    assert not Held(ocp).first.any()
    for other, learned in ((with_a_budget(-1.0), False), (with_a_budget(0.1), False), (ocp, True)):
        assert not guarded(other, learned=learned).any()
        assert (Held(other, learned).first > 0).all()


def car(xdot, wall, fastest: float = 2.0) -> OCP:
    """A problem on (x, v) under u [1] with a constraint."""
    x, v, u = (ca.SX.sym(name) for name in "xvu")
    system = nocl.System("car", x=ca.vertcat(x, v), u=u, xdot=xdot(x, v, u), lbu=[-1], ubu=[1], lbx=[-1, -fastest],
                         ubx=[1, fastest])
    return OCP(system, horizon=4.0, running=u**2, terminal=x**2, x_goal=[0, 0], u_goal=[0],
               initial_states=nocl.Gaussian([0, 0], [0.1, 0.1]), constraints={"wall": wall(x, v, u)})


@pytest.mark.filterwarnings("ignore:.*equilibrium")
@pytest.mark.parametrize(("why", "xdot", "wall"), [
    ("parasitic order", lambda x, v, u: ca.vertcat(v + 1e-3 * u, u), lambda x, v, u: 0.5 - x),
    ("not affine", lambda x, v, u: ca.vertcat(v, u**3), lambda x, v, u: 0.8 - v),
    ("U is too weak there", lambda x, v, u: ca.vertcat(v, u + 1.5 * ca.sin(3 * x)), lambda x, v, u: 0.5 - x),
    ("no hold at some places", lambda x, v, u: ca.vertcat(v, u * ca.cos(3 * v)), lambda x, v, u: 0.5 - x)])
def test_rows_without_a_sure_hold_keep_their_margins(why, xdot, wall):
    ocp = car(xdot, wall)
    assert not guarded(ocp).any(), why
    assert (Held(ocp).first > 0).all()
    assert guarded(car(lambda x, v, u: ca.vertcat(v, u), wall)).all()


def test_a_sample_that_is_not_finite_does_not_decide():
    ocp = car(lambda x, v, u: ca.vertcat(v, u), lambda x, v, u: ca.sqrt(0.7 - x) - 0.4, 0.2)
    assert guarded(ocp).all()


@pytest.mark.parametrize(("name", "rows"), [
    (EXAMPLES / "boost_converter.py", [False, True]),  # without voltage nothing holds the current, and no plan has both
    ("dubins", [False])])  # that slides along an obstacle: to stand still is what the control could do
def test_places_where_plans_come_near_decide(name, rows):
    ocp = nocl.load_ocp(name)
    plans = few_plans(DDP(ocp, constraints="elastic"))
    assert not guarded(ocp).any()
    assert guarded(ocp, plans).tolist() == rows
    held = Held(ocp, plans=plans)
    assert ((held.first == 0) == rows).all()


def test_a_current_is_held_where_plans_have_it():
    ocp = nocl.load_ocp(EXAMPLES / "boost_converter.py")
    at, on = ocp.functions.feedback(), ca.SX(ocp.system.ubu)
    violation = []
    for rows in ([False, False], [False, True]):
        law = at.function("law", {"u": braked(ocp, at, on, ocp.horizon, np.array(rows))})
        violation.append(nocl.simulate(replace(ocp, horizon=5e-4), law, [[0.8, 13.5]]).violation.max())
    assert violation[0] > 0.1
    assert violation[1] <= TOLERANCE


def in_the_plane(ball: bool = False) -> OCP:
    """Two forces, one wall askew, whose place is a parameter."""
    x, u, wall = ca.SX.sym("x", 4), ca.SX.sym("u", 2), nocl.parameter("wall")
    system = nocl.System("puck", x=x, u=u, xdot=ca.vertcat(x[2], x[3], u[0], u[1]), lbu=[-1, -1], ubu=[1, 1],
                         lbx=[-2] * 4, ubx=[2] * 4)
    return OCP(system, horizon=4.0, running=ca.sumsqr(u), terminal=ca.sumsqr(x), x_goal=[0] * 4, u_goal=[0, 0], p=wall,
               parameters=nocl.Uniform([0.5], [0.8]), initial_states=nocl.Uniform([-0.1, -0.1, 0, 0], [0, 0, 0.6, 0.6]),
               constraints={"wall": wall - x[0] - 0.7 * x[1], **({"ball": 1 - ca.sumsqr(u)} if ball else {})})


@pytest.mark.parametrize("said", [(1, 1), (1, -1), (-1, 1), (0, 0), (0.7, 0.7)])
@pytest.mark.parametrize("ball", [False, True])
def test_what_one_control_cannot_give_the_others_do(said, ball):
    ocp = in_the_plane(ball=ball)
    at = ocp.functions.feedback()
    law = at.function("law", {"u": retracted(ocp, braked(ocp, at, ca.DM(said) + ca.SX(2, 1), ocp.horizon))})
    x0 = ocp.initial_states.sample(12, 0)
    run = nocl.simulate(ocp, law, x0, p=ocp.sample_parameters(12, 0))
    assert run.violation.max() <= TOLERANCE
    assert not ball or (run.u**2).sum(axis=-1).max() <= 1 + 1e-9


def test_margins_are_for_rows_that_the_map_does_not_hold():
    ocp = double_integrator()
    held, names = Held(ocp), np.array(Held(ocp).names)
    assert (held.first == 0).all()
    assert set(names[Held(ocp, learned=True).first > 0]) == {"speed"}  # f is not known there
    exceeded = np.full((10, len(names)), TOLERANCE * 0.7)
    assert (held.next(held.first, exceeded, exceeded) == 0).all()
    exceeded[:] = 0.01
    assert set(names[held.next(held.first, exceeded, exceeded) > 0]) == {"speed"}  # where the map fails


def test_training_judges_as_the_judge_does():
    """At the boundary the map is stiff: what RK4 says of runs that it holds there."""
    ocp = on_a_track()
    cnd, x0 = wild(ocp, 0, 20.0), ocp.initial_states.sample(6, 0)
    over = Held(ocp).exceeded(cnd.policy, InTorch(ocp), Problems(x0, np.zeros(6), np.zeros((6, 0))), 640)
    judged = nocl.simulate(ocp, cnd, x0, nodes=161).violation
    np.testing.assert_allclose(np.maximum(over.max(axis=1), 0), judged, atol=2e-4)


def test_it_does_not_depend_on_units():
    metres, millimetres = on_a_track(), on_a_track(1e-3)
    rng = np.random.default_rng(0)
    x, v = rng.uniform([-0.6, -1.0], [0.6, 1.0], (200, 2)), rng.uniform(-2, 2, 200)
    u = [of(z.T, 0.0, v[None]).full() for of, z in ((_map(metres), x), (_map(millimetres), x * 1e3))]
    np.testing.assert_allclose(u[0], u[1], atol=1e-9)
    assert (np.abs(u[0] - v) > 1e-3).mean() > 0.1  # it does something
    assert (u[0] == v).mean() > 0.3  # bit for bit


def _map(ocp: OCP) -> ca.Function:
    at, v = ocp.functions.feedback(), ca.SX.sym("v", ocp.system.nu)
    return at.function("map", {"u": braked(ocp, at, v, ocp.horizon)}, v=v)


def test_a_control_that_is_held_brakes_for_as_long():
    """Asked every 0.1 s and held, a policy that always pushes outwards leaves by less than 1 % of the track; a map that
    does not know the rate lets it bounce."""
    ocp, dt = on_a_track(), 0.1
    at = ocp.functions.feedback()
    for held, low, high in ((Arguments({**at.symbols, "dt": ca.SX(dt)}), 0.0, 0.01), (at, 0.02, 0.3)):
        law = at.function("law", {"u": braked(ocp, held, ca.SX(2.0), ocp.horizon)})
        run = nocl.simulate(ocp, law, [[0.0, 0.0], [-0.3, 0.2]], hold=40)
        assert low <= run.violation.max() <= high


def test_what_is_exported_is_the_same(tmp_path):
    assert wild(on_a_cart(), 0, 20.0).export(tmp_path, to=("casadi", "c", "onnx")).ok
