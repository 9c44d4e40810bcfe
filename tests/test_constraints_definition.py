"""Constraints as they are written down: forms, rows, scales, data, errors; the judge; and who refuses which."""

import json
import pickle
import re
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

import nocl
from nocl.comparisons import compare, study
from nocl.comparisons.region import region
from nocl.definition.constraints import Free
from nocl.definition.hamiltonian import minimiser
from nocl.solvers import DDP, LQR, NMPC
from nocl.solvers.levelset.solver import LevelSet
from nocl.solvers.mirrors import mirrors
from nocl.solvers.neural_oc import train_neural_oc

P, V, U = ca.SX.sym("p"), ca.SX.sym("v"), ca.SX.sym("u")
W, GOAL = nocl.parameter("w", nominal=0.5), nocl.parameter("goal")
CART = nocl.System("cart", x=ca.vertcat(P, V), u=U, xdot=ca.vertcat(V, U), lbu=[-2], ubu=[2], lbx=[-5, -4], ubx=[5, 4])


def make(**changed):
    good = {"horizon": 2.0, "running": U**2, "terminal": P**2 + V**2, "x_goal": [0, 0], "u_goal": [0],
            "initial_states": nocl.Gaussian([1, 0], [0.1, 0.1])}
    return nocl.OCP(**{"system": CART, **good, **changed})


def every(**changed):
    return make(constraints={"track": (-0.5, P, 2), "wall": V + 3, "power": (None, U * V, 1.5), "line": (1, P + V, 1),
                             "tied": (0, U - V, 0)},
                terminal_constraints={"at goal": (0, P - 0.25, 0), "slow": (None, V**2, 0.04)},
                state_bounds={"v": (-2, 3)}, path_constraints={"pillar": (P - 3)**2 + V**2 - 0.04}, **changed)


def test_each_row_is_what_was_written():
    ocp, x, u = every(), np.array([0.7, -1.1]), np.array([0.4])
    (p, v), of = x, ocp.functions
    rows = [("track", "low", p + 0.5), ("track", "high", 2 - p), ("wall", "low", v + 3),
            ("pillar", "low", (p - 3)**2 + v**2 - 0.04), ("v", "low", v + 2), ("v", "high", 3 - v),
            ("line", "equal", p + v - 1), ("power", "high", 1.5 - u[0] * v), ("tied", "equal", u[0] - v)]
    assert list(zip(of.rows.names, of.rows.sides, strict=True)) == [(name, side) for name, side, _ in rows]
    values = np.array([value for *_, value in rows])
    np.testing.assert_allclose(of.c(x, u).full().ravel() * of.scales, values, rtol=1e-14)
    np.testing.assert_allclose(ocp.h(x).full().ravel(), values[:6], rtol=1e-14)
    assert of.rows.equal.tolist() == [False] * 6 + [True, False, True]
    assert of.rows.of_u.tolist() == [False] * 7 + [True, True]
    assert (of.end_rows.names, of.end_rows.equal.tolist()) == (("slow", "at goal"), [False, True])
    np.testing.assert_allclose(of.c_end(x).full().ravel() * of.end_scales, [0.04 - v**2, p - 0.25], rtol=1e-14)
    assert not ocp.states_only


def test_scales_are_those_of_the_box_or_given():
    ocp = make(constraints={"track": (-0.5, P, 0.5), "far": P + 4, "power": U * V + 2, "tied": (0, U - V, 0)},
               terminal_constraints={"set": 0.04 - P**2, "at": (1, P, 1)}, scales={"far": 0.25})
    scale = dict(zip(ocp.functions.rows.names, ocp.functions.scales, strict=True))
    assert scale["track"] == 0.5  # half its width
    assert scale["far"] == 0.25
    assert scale["power"] == pytest.approx(2, rel=1e-9)  # at x*; it is 6 deep in X x U
    assert scale["tied"] == pytest.approx(6, rel=0.05)  # |U| + |V|
    assert ocp.functions.end_scales == pytest.approx([0.04, 6], rel=0.01)  # at x*; the largest in X
    near = make(constraints={"wall": 1.5 - P})  # initial states are at 1 +- .1, x* at 1.5 from it; 3.5 deep
    assert near.constraint_scales == pytest.approx([1.5], abs=1e-12)


@pytest.mark.parametrize("unit", [1e-4, 1.0, 1e5])
def test_rows_have_no_unit(unit):
    """The same cart in other units of length, and constraints in any."""
    p, v, u = unit * P, unit * V, unit * U
    system = nocl.System("cart", x=ca.vertcat(P, V), u=U, xdot=ca.vertcat(V, U), lbu=[-2 / unit], ubu=[2 / unit],
                         lbx=np.array([-5, -4]) / unit, ubx=np.array([5, 4]) / unit)
    ocp = make(system=system, running=u**2, terminal=p**2 + v**2,
               initial_states=nocl.Gaussian(np.array([1, 0]) / unit, np.array([0.1, 0.1]) / unit),
               constraints={"track": (-0.5 / unit, P, 2 / unit), "power": (None, 1e3 * u * v, 1500)},
               terminal_constraints={"at": (0, 1e-3 * (p - 0.25), 0)})
    same = make(constraints={"track": (-0.5, P, 2), "power": (None, U * V, 1.5)},
                terminal_constraints={"at": (0, P - 0.25, 0)})
    x, control = np.array([0.7, -1.1]), np.array([0.4])
    for name, given in (("c", (x, control)), ("c_end", (x,))):
        values, right = getattr(ocp.functions, name)(*(g / unit for g in given)), getattr(same.functions, name)(*given)
        np.testing.assert_allclose(values, right, rtol=1e-6)
    np.testing.assert_allclose(float(ocp.L_soft([2.1 / unit, 0], [0])), float(same.L_soft([2.1, 0], [0])), rtol=1e-6)


def test_a_penalty_is_of_the_scaled_row_and_of_a_path_constraint_as_ever():
    ocp = make(constraints={"track": (None, P, 1)}, path_constraints={"wall": 2 - P}, penalty=10.0, penalty_margin=0.1,
               scales={"track": 0.5})
    assert float(ocp.L_soft([3, 0], [0])) == pytest.approx(10 * (0.1 + 2 / 0.5)**2 + 10 * (0.1 + 1)**2, rel=1e-14)


def test_path_constraints_are_what_they_were():
    ocp = make(path_constraints={"wall": 2 - P})
    assert ocp.states_only
    assert not ocp.in_scales
    assert ocp.functions.c_of_x is ocp.functions.h
    assert set(ocp.to_data()) == {"system", "horizon", "x_goal", "u_goal", "initial_states", "L", "G", "h",
                                  "path_constraints", "penalty", "penalty_margin"}
    run = nocl.simulate(ocp, np.full((1, 4, 1), 2.0), [1.0, 0.0])
    assert run.clearance[0] == pytest.approx(2 - 5)  # in its own unit: p(2) = 1 + 2 * 2^2 / 2
    assert run.violation[0] == pytest.approx(3 / ocp.constraint_scales[0])


def again(ocp):
    return [pickle.loads(pickle.dumps(ocp)), nocl.OCP.from_data(json.loads(json.dumps(ocp.to_data()))),
            replace(ocp, penalty=ocp.penalty)]


@pytest.mark.parametrize("ocp", [every(), every(horizon=Free(0.5, 10), scales={"power": 0.25}),
                                 make(constraints={"moving": P + nocl.time()}, state_bounds={"p": (None, 4)})])
def test_it_comes_back_from_data(ocp):
    for other in again(ocp):
        assert repr(other) == repr(ocp)
        assert other.to_data() == ocp.to_data()
        np.testing.assert_array_equal(other.functions.scales, ocp.functions.scales)
        assert other.functions.rows.names == ocp.functions.rows.names


def test_repr_says_what_is_held():
    lines = repr(every(horizon=nocl.Free(0.5, 10))).splitlines()
    assert lines[0] == "OCP on 'cart': horizon free in [0.5, 10]"
    for line in ("  track: -0.5 <= p <= 2", "  wall: v + 3 >= 0", "  power: u v <= 1.5", "  line: p + v = 1",
                 "  v: -2 <= v <= 3", "  at goal at the end: p - 0.25 = 0"):
        assert line in lines


def with_p(**changed):
    return make(p=ca.vertcat(W, GOAL), parameters=nocl.Uniform([0.4, -1], [0.6, 1]),
                constraints={"track": W - P + 2, "push": (None, U - W, 3)},
                terminal_constraints={"at goal": (0, P - GOAL, 0)}, **changed)


def test_parameters_are_folded_in_and_time_at_the_end_is_the_horizon():
    ocp, x, u = with_p(), [0.3, 0.2], [0.5]
    of, at = ocp.functions, ocp.at(p={"w": 0.45, "goal": 0.7}).functions
    assert of.c_of_x.name_in() == ["x", "p"]
    np.testing.assert_allclose(at.c_of_x(x), of.c_of_x(x, [0.45, 0.7]), rtol=1e-14)
    np.testing.assert_allclose(at.c_of_u(x, u), of.c_of_u(x, u, [0.45, 0.7]), rtol=1e-14)
    assert float(at.c_at_end(x)) == pytest.approx(0.3 - 0.7)
    ends = make(terminal_constraints={"late": P - nocl.time()})
    assert not ends.uses_time
    assert float(ends.functions.c_at_end(x)) == pytest.approx(0.3 - 2.0)
    assert make(constraints={"late": P - nocl.time() + 9}).uses_time


def test_other_constraints_break_mirrors_and_periods():
    assert len(mirrors(make())) == 1
    assert mirrors(make(constraints={"push": U + 1.5})) == []
    assert mirrors(make(terminal_constraints={"right": P})) == []
    assert len(mirrors(make(constraints={"power": (None, U * V, 2)}, state_bounds={"p": (-4, 4)}))) == 1
    theta = ca.SX.sym("theta")
    turn = nocl.System("turn", x=ca.vertcat(theta, V), u=U, xdot=ca.vertcat(V, U + ca.sin(theta)), lbu=[-2], ubu=[2],
                       lbx=[-3, -3], ubx=[3, 3], angles=["theta"])
    goal = {"system": turn, "terminal": V**2, "running": U**2}
    assert make(**goal).periodic == (0,)
    assert make(**goal, terminal_constraints={"once": (0, theta, 0)}).periodic == ()
    assert make(**goal, terminal_constraints={"up": (0, ca.sin(theta), 0)}).periodic == (0,)


@pytest.mark.parametrize(("changed", "said"), [
    ({"constraints": [P]}, r"constraints is \[SX\(p\)\]; expected a dict from names"),
    ({"constraints": {"": P}}, "constraints is"),
    ({"constraints": {"a": (0, P)}}, r"constraint 'a' is \(0, SX\(p\)\); expected an expression, .* or \(low, expres"),
    ({"constraints": {"a": (2, P, 1)}}, "constraint 'a' is to lie between 2 and 1, which nothing does"),
    ({"constraints": {"a": (None, P, None)}}, "constraint 'a' has neither a low nor a high bound"),
    ({"constraints": {"a": (np.inf, P, None)}}, "constraint 'a' has neither|between inf and inf"),
    ({"constraints": {"a": ("0", P, 1)}}, "a bound of constraint 'a' is '0'; expected a number"),
    ({"constraints": {"a": (np.nan, P, 1)}}, "a bound of constraint 'a' is nan"),
    ({"constraints": {"a": (True, P, 1)}}, "a bound of constraint 'a' is True"),
    ({"constraints": {"a": (W, P, None)}}, "a bound of constraint 'a' is the expression SX.w.; .*constraints of their"),
    ({"constraints": {"a": ca.vertcat(P, V)}}, r"constraint 'a' has shape \(2, 1\)"),
    ({"constraints": {"a": ca.MX.sym("q")}}, "constraint 'a' is a MX"),
    ({"constraints": {"a": ca.SX.sym("q")}}, r"constraint 'a' contains the symbol\(s\) q"),
    ({"constraints": {"a": P, "b": -1 - P**2}}, "constraint 'b', e >= 0, holds nowhere in X x U: the nearest e .* -1"),
    ({"constraints": {"a": (0, 1 + U**2, 0)}}, "constraint 'a', e = 0, holds nowhere in X x U"),
    ({"constraints": {"a": ca.norm_2(ca.vertcat(P, V)) - 0.1}}, "the gradient of constraint 'a' gives NaN or inf"),
    ({"constraints": {"a": ca.if_else(P > 9, 1, 1 / ca.fmax(V, -9))}}, "gives NaN or inf"),
    ({"terminal_constraints": {"a": U}}, r"terminal constraint 'a' contains the control\(s\) u"),
    ({"terminal_constraints": {"a": (6, P, 7)}}, "terminal constraint 'a', 6 <= e <= 7, holds nowhere at the end"),
    ({"state_bounds": {"q": (0, 1)}}, r"state_bounds has 'q'; expected names of states \(p, v\)"),
    ({"state_bounds": {"v": 3}}, r"state bound 'v' is 3; expected \(low, high\)"),
    ({"state_bounds": {"v": (1, 1)}}, "state bound 'v' is .*; expected low < high"),
    ({"state_bounds": {"v": (5, 6)}}, "state bound 'v', 5 <= e <= 6, holds nowhere in X x U: the nearest e there is 4"),
    ({"state_bounds": {"v": (-1, 1)}, "constraints": {"v": P}}, "constraint 'v' and state bound 'v' have one name"),
    ({"path_constraints": {"a": P}, "terminal_constraints": {"a": P}}, "path constraint 'a' and terminal cons.* 'a'"),
    ({"scales": {"a": 1}}, r"scales has 'a'; expected names of constraints \(there are none\)"),
    ({"constraints": {"a": P}, "scales": {"a": 0}}, r"scales\['a'\] is 0; expected a finite positive number"),
    ({"horizon": Free(1, 2), "terminal": nocl.time()}, "terminal holds the time, .* and that is free"),
    ({"horizon": Free(1, 2), "terminal_constraints": {"a": P - nocl.time()}}, "terminal constraint 'a' holds the time"),
])
def test_wrong_ones_are_refused(changed, said):
    with pytest.raises(ValueError, match=said):
        make(**changed)


@pytest.mark.parametrize(("low", "high"), [(0, 1), (2, 1), (1, 1), (-1, 1), (1, np.inf), ("1", 2), (np.nan, 1)])
def test_a_free_horizon_has_a_range(low, high):
    with pytest.raises(ValueError, match=r"^Free: "):
        Free(low, high)
    assert (Free(1, 2.5).low, repr(Free(1, 2.5))) == (1.0, "Free(1, 2.5)")


def test_a_thin_set_is_found_between_samples():
    make(constraints={"disc": 1e-8 - (P - 1.234)**2 - (V + 0.777)**2})


def test_kinks_are_told():
    with pytest.warns(UserWarning, match="constraint 'gate' has a kink.*terminal constraint 'near' has a kink"):
        make(constraints={"gate": 1.5 - ca.fabs(P)}, terminal_constraints={"near": 1 - ca.fabs(V)})


BEYOND = {"of u": {"constraints": {"push": (None, U + V, 3)}}, "equation": {"constraints": {"tied": (0, P - V, 0)}},
          "at the end": {"terminal_constraints": {"at goal": (0, P, 0)}}, "free": {"horizon": Free(0.5, 4)}}
SAID = {"of u": "constraint 'push' of the control", "equation": "constraint 'tied', an equation",
        "at the end": "terminal constraint 'at goal'", "free": r"is Free\(0.5, 4\)"}
TAKERS = {"DDP with constraints='soft'": lambda ocp: DDP(ocp, constraints="soft"), "LQR": LQR,
          "train with method='paper'": lambda ocp: nocl.train(ocp, method="paper"),
          "LevelSet": lambda ocp: LevelSet(ocp, [9, 9]),
          "train_neural_oc": train_neural_oc, "to_gymnasium": nocl.to_gymnasium, "minimiser": minimiser,
          "NMPC with gains": lambda ocp: NMPC(ocp, 4).solve([1.0, 0.0], gains=True),
          "NMPC with constraints='soft'": lambda ocp: NMPC(ocp, 4, constraints="soft")}


@pytest.mark.parametrize("kind", BEYOND)
@pytest.mark.parametrize("taker", TAKERS)
def test_who_takes_no_such_thing_says_so(taker, kind):
    with pytest.raises(ValueError, match=f"^{taker} takes .*{SAID[kind]}.*(NMPC|gains|penalty)"):
        TAKERS[taker](make(**BEYOND[kind]))


@pytest.mark.parametrize(("taker", "take"), [
    ("study(robust=True)", lambda ocp: study(ocp, {}, robust=True)),
    ("region", lambda ocp: region(ocp, "none", lambda x, t: x[:, :1]))])
def test_what_takes_constraints_takes_no_free_horizon(taker, take):
    with pytest.raises(ValueError, match=rf"^{re.escape(taker)} takes .*{SAID['free']}"):
        take(make(**BEYOND["free"]))


def test_constraints_are_left_out_by_name():
    ocp = every(scales={"power": 0.25, "slow": 0.1, "v": 2.0})
    less = ocp.without("power", "at goal", "v", "pillar")
    assert less.constraint_names == ("track", "wall", "line", "tied", "slow")
    assert dict(less.scales) == {"slow": 0.1}
    assert ocp.unconstrained.constraint_names == ()
    assert "ocp.without('line', 'power', 'tied', 'at goal', 'slow')" in refusal_of(minimiser, ocp)
    DDP(ocp.without("line", "power", "tied", "slow", "at goal"))
    with pytest.raises(ValueError, match=r"without.'push'.; expected names of constraints"):
        ocp.without("push")


def refusal_of(taker, ocp):
    with pytest.raises(ValueError, match="takes inequalities") as refused:
        taker(ocp)
    return str(refused.value)


def test_a_free_horizon_has_no_loop_of_nmpc():
    with pytest.raises(ValueError, match=r"^NMPC.controller takes a number as horizon.*replace\(ocp, horizon=4\)"):
        NMPC(make(horizon=Free(0.5, 4)), 4).controller()


def pushed(u):
    """Judged from rest at 1 under u on two intervals of 1 s: v = u t, p = 1 + u t^2 / 2."""
    ocp = make(constraints={"power": (None, U * V, 1)}, terminal_constraints={"at": (0, P - 3, 0)},
               state_bounds={"p": (None, 3)}, scales={"power": 0.5, "at": 2.0, "p": 4.0})
    runs = {"plan": np.full((1, 2, 1), u), "held": lambda x, t: np.full((1, 1), u)}
    x, t = ca.MX.sym("x", 2), ca.MX.sym("t")
    runs["continuous"] = ca.Function("pi", [x, t], [u + 0 * t], ["x", "t"], ["u"])
    return {how: nocl.simulate(ocp, run, [1.0, 0.0], hold=2 if how == "held" else None) for how, run in runs.items()}


@pytest.mark.parametrize("u", [1.0, 0.5, 1.2])
def test_the_judge_measures_all_of_them(u):
    power, end, bound = (1 - u * 2 * u) / 0.5, -abs(1 + 2 * u - 3) / 2, (3 - 1 - 2 * u) / 4
    for how, run in pushed(u).items():
        assert run.clearance[0] == pytest.approx(min(power, end, bound), abs=1e-7), how
        assert run.violation[0] == pytest.approx(max(-min(power, end, bound), 0), abs=1e-7), how


def test_a_control_counts_while_it_acts():
    """u = 2 in the first interval, -2 in the second: u v is 4 just before t = 1, and -4 just after."""
    ocp = make(constraints={"power": (-3, U * V, 3)}, scales={"power": 1.0})
    run = nocl.simulate(ocp, np.array([[[2.0], [-2.0]]]), [1.0, 0.0])
    assert run.violation[0] == pytest.approx(1, abs=1e-6)
    brake = nocl.simulate(replace(ocp, constraints={"power": (-3, U * V, 5)}), np.array([[[2.0], [-2.0]]]), [1.0, 0.0])
    assert brake.violation[0] == pytest.approx(1, abs=1e-6)


def test_who_violates_has_failed_in_a_comparison():
    ocp = make(constraints={"power": (None, U * V, 1)}, terminal_constraints={"at": (0, P - 3, 0)})
    report = compare(ocp, {"one": lambda x, t: 1 + 0 * x[:, :1], "idle": lambda x, t: 0 * x[:, :1]}, x0=[[1.0, 0.0]])
    assert not report.feasible.any()
    assert np.isnan(report.best).all()
    assert [row["success"] for row in report.rows()] == [False, False]
    said = [row["message"] for row in report.rows()]  # u v goes up to 2, where it may be 1; p stays 1, and is to be 3
    assert said == ["violates 'power' by 1", "violates 'at' by 2"]


def test_rates_make_a_control_a_state():
    two = ca.SX.sym("thrust")
    system = nocl.System("two", x=ca.vertcat(P, V), u=ca.vertcat(U, two), xdot=ca.vertcat(V, U * W + two), p=W,
                         lbu=[-2, -1], ubu=[2, 3], lbx=[-5, -4], ubx=[5, 4], units={"thrust": "N", "p": "m"})
    slow = nocl.limit_rates(system, {"thrust": 0.5})
    assert slow.state_names == ("p", "v", "thrust")
    assert slow.control_names == ("u", "thrust_rate")
    assert (slow.lbu.tolist(), slow.ubu.tolist()) == ([-2, -0.5], [2, 0.5])
    assert (slow.lbx.tolist(), slow.ubx.tolist()) == ([-5, -4, -1], [5, 4, 3])
    np.testing.assert_allclose(slow.f([1, 2, 3], [0.5, 0.25], 2.0).full().ravel(), [2, 4, 0.25])
    assert slow.unit("thrust") == "thrust [N]"


@pytest.mark.parametrize(("rates", "said"), [({"q": 1}, "rates is .*names of controls .u."), ([1], "rates is"),
                                             ({}, "rates is"), ({"u": 0}, "the rate of u is 0; expected a finite pos")])
def test_rates_are_of_controls(rates, said):
    with pytest.raises(ValueError, match=f"^limit_rates: {said}"):
        nocl.limit_rates(CART, rates)


def test_ddp_tells_whose_row_it_could_not_hold():
    """From 1.5 m/s braking at 2 m/s^2 takes .56 m: the end of the track is .1 m away."""
    s = DDP(make(constraints={"track": (-2, P, 1.1)}, running=0.1 * U**2), intervals=40).solve([[1.0, 1.5], [1.0, 0.0]])
    assert s.success.tolist() == [False, True]
    assert "no plan holds 'track' from here" in s.message[0]


@pytest.mark.parametrize("kind", BEYOND)
def test_what_is_not_there_has_no_rows(kind):
    of = make(**BEYOND[kind]).functions
    assert of.h.size_out(0) == (0, 1)
    assert of.c.size_out(0) == (len(of.rows), 1)
    assert of.c_end.size_out(0) == (len(of.end_rows), 1)
    assert of.c_of_x.size_out(0) == (of.rows.n_x, 1)
    assert of.c_of_u.size_out(0) == (len(of.rows) - of.rows.n_x, 1)
