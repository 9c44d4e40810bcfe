"""Constraints of states in the output map of a policy: no policy leaves them, and what holds them is left alone."""

from dataclasses import replace

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
from nocl.solvers.cnd.held import Held
from nocl.solvers.cnd.regression.barrier import braked, guarded
from nocl.translate.arguments import Arguments

TRACK = 0.5


def on_a_track(unit: float = 1.0, dt: bool = False, **more) -> OCP:
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
    outputs = at.function("controls", {"u": braked(ocp, at.given(y=y), said)}, y=y)
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
              constraints={"wall": (None, x, size)}, scales={"wall": size}, initial_states=nocl.Gaussian([0, 1], [0, 0]))
    at = ocp.functions.feedback()
    left = ca.fmin(at["t"], 1 - at["t"])
    optimum = -2 / (3 * size) * ca.fmax(1 - left / (3 * size), 0)
    law = at.function("law", {"u": braked(ocp, at, optimum)})
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
        "track": True, "speed": True, "power": False, "equal": False, "time": False, "push": False}
    slow = nocl.limit_rates(ocp.system, {"u": 5.0})
    third = OCP(slow, horizon=4.0, running=slow.x[2]**2, terminal=slow.x[0]**2, x_goal=[0] * 3, u_goal=[0],
                initial_states=nocl.Gaussian([0] * 3, [0.1] * 3), constraints={"track": (-0.5, slow.x[0], 0.5)})
    assert not guarded(third).any()


def test_margins_are_for_rows_that_the_map_does_not_hold():
    ocp = double_integrator()
    names = np.array(Held(ocp).names)
    assert not Held(ocp).inward.any()
    assert set(names[Held(ocp, learned=True).inward]) == {"speed"}  # f is not known there


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
    return at.function("map", {"u": braked(ocp, at, v)}, v=v)


def test_a_control_that_is_held_brakes_for_as_long():
    """Asked every 0.1 s and held, a policy that always pushes outwards leaves by less than 1 % of the track; a map that
    does not know the rate lets it bounce."""
    ocp, dt = on_a_track(), 0.1
    at = ocp.functions.feedback()
    for held, low, high in ((Arguments({**at.symbols, "dt": ca.SX(dt)}), 0.0, 0.01), (at, 0.02, 0.2)):
        law = at.function("law", {"u": braked(ocp, held, ca.SX(2.0))})
        run = nocl.simulate(ocp, law, [[0.0, 0.0], [-0.3, 0.2]], hold=40)
        assert low <= run.violation.max() <= high


def test_what_is_exported_is_the_same(tmp_path):
    assert wild(on_a_cart(), 0, 20.0).export(tmp_path, to=("casadi", "c", "onnx")).ok
