"""Constraints in comparisons: who violates them has failed, who could not hold them is told apart, and nobody's numbers
count with them; what can be gained over simple baselines has no constant in it.
"""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from scipy.stats import binom

import nocl
from nocl.comparisons import compare, study
from nocl.comparisons.audit import audit
from nocl.comparisons.disturbances import Disturbances, robustness
from nocl.comparisons.judging import Judging
from nocl.comparisons.promise import promises
from nocl.comparisons.reference import Reference
from nocl.comparisons.region import region
from nocl.comparisons.report import limits
from nocl.comparisons.report.explain import worst
from nocl.comparisons.report.payload import payload
from nocl.comparisons.report.results import number
from nocl.comparisons.report.tables import tables
from nocl.solvers import DDP, LQR, NMPC

P, V, U = (ca.SX.sym(name) for name in ("p", "v", "u"))
CART = nocl.System("cart", x=ca.vertcat(P, V), u=U, xdot=ca.vertcat(V, U), lbu=[-2], ubu=[2], lbx=[-5, -4],
                   ubx=[5, 4], units={"p": "m", "v": "m/s", "u": "m/s^2"})
T, FAST = 2.0, 0.7


def make(**changed):
    good = {"horizon": T, "running": 0.1 * U**2 + P**2, "terminal": P**2 + V**2, "x_goal": [0, 0], "u_goal": [0],
            "initial_states": nocl.Uniform([0.9, -0.1], [1.1, 0.1])}
    return nocl.OCP(**{"system": CART, **good, **changed})


def policy(expression, name="policy"):
    """(x, t) -> u from an expression of p, v and t."""
    x, t = ca.MX.sym("x", 2), ca.MX.sym("t")
    return ca.Function(name, [x, t], [expression(x[0], x[1], t)])


PD = policy(lambda p, v, t: -p - 1.5 * v)
WEAK = policy(lambda p, v, t: -0.2 * p)


@pytest.fixture(scope="module")
def transfer():
    """From 1 m to rest at 0 in 2 s, at 0.7 m/s at most, by the least int u^2 / 2."""
    return make(running=U**2 / 2, terminal=0.0, state_bounds={"v": (-FAST, FAST)}, scales={"v": FAST},
                terminal_constraints={"there": (0, P, 0), "at rest": (0, V, 0)})


# u falls linearly to 0 at `RAMP`, where the limit is reached; then it coasts, and brakes likewise
RAMP = 1.5 * (T - 1 / FAST)
LEAST = 4 * FAST**2 / (3 * RAMP)
PUSH = 2 * FAST / RAMP
BEST = policy(lambda p, v, t: -PUSH * (ca.fmax(1 - t / RAMP, 0) - ca.fmax(1 - (T - t) / RAMP, 0)), "best")
FREE = policy(lambda p, v, t: -1.5 * (1 - t), "free")  # without a limit: up to 0.75 m/s, and int u^2 / 2 = 0.75


def test_the_optimum_with_a_speed_limit_is_the_analytic_one(transfer):
    found = Reference(transfer, 80).solve(np.array([[1.0, 0.0]]))
    assert found.cost[0] == pytest.approx(LEAST, rel=1e-3)
    assert found.cost[0] > LEAST * (1 - 1e-4)  # held controls cost more, not less
    run = nocl.simulate(transfer, found.u, [1.0, 0.0])
    assert run.success[0]
    assert run.violation[0] < 1e-4


def test_who_violates_has_failed_however_cheap_it_is(transfer):
    report = compare(transfer, {"free": FREE, "best": BEST}, x0=[[1.0, 0.0]], progress=False)
    free, best = report.rows()
    s = report.judged[0].simulation
    assert (free["success"], free["reached"], best["success"]) == (False, True, True)
    assert free["message"] == "violates 'v' by 0.05 m/s"
    assert s.cost[0] == pytest.approx(0.75, rel=1e-6)
    assert free["violation"] == pytest.approx(0.05 / FAST, rel=1e-4)
    assert best["cost"] == report.best[0] == pytest.approx(LEAST, rel=1e-6)
    assert (free["cost"], free["gap"], best["gap"]) == (np.inf, np.inf, 0)
    first, second = report.summary()
    assert (first["failures"], first["violations"], second["failures"]) == (1, 1, 0)
    assert np.isnan(first["cost_mean"])
    assert first["violates"] == "'v' by 0.05 m/s (1 of 1)"
    assert "'v' by 0.05 m/s (1 of 1)" in str(report)
    assert report.verdict()[-1] == "free violates 'v' by 0.05 m/s (1 of 1)."
    assert tables(report)["failures"].body == [["free", "0", "violates 'v' by 0.05 m/s"]]


def test_without_a_feasible_baseline_only_the_gap_is_given(transfer):
    report = compare(transfer, {"best": BEST}, x0=[[1.0, 0.0]], progress=False)
    assert np.isnan(report.base).all()
    assert np.isnan(report.rows()[0]["missed"])
    assert np.isnan(report.summary()[0]["missed_median"])
    assert "From 1 of 1 state no such baseline reaches the horizon and holds all constraints" in \
        tables(report)["summary"].note


def test_the_tolerance_is_a_share_of_the_scale(transfer):
    for tolerance, good in ((0.07, False), (0.072, True)):  # 0.05 / 0.7 = 0.0714
        run = nocl.simulate(transfer, FREE, [1.0, 0.0], tolerance=tolerance)
        assert (run.success[0], run.reached[0]) == (good, True)
        report = compare(transfer, {"free": FREE}, x0=[[1.0, 0.0]], tolerance=tolerance, progress=False)
        assert report.feasible[0, 0] == good
        assert report.settings["tolerance"] == tolerance
    with pytest.raises(ValueError, match="tolerance is -1; expected a finite number >= 0"):
        nocl.simulate(transfer, FREE, [1.0, 0.0], tolerance=-1)


def test_path_constraints_are_judged_alike():
    ocp = make(path_constraints={"wall": P - 0.5})
    report = compare(ocp, {"through": PD, "idle": policy(lambda p, v, t: 0 * t)}, x0=[[1.0, 0.0]], progress=False)
    through, idle = report.rows()
    assert (through["success"], idle["success"]) == (False, True)
    assert through["message"].startswith("violates 'wall' by 0.")


def test_states_from_which_no_plan_holds_a_constraint_are_left_out():
    """Braking at 2 from 1.5 m/s takes 0.5625 m and 0.75 s, and the end of the track is 0.1 m away."""
    ocp = make(constraints={"track": (-2, P, 1.1)})
    x0 = [[1.0, 0.0], [1.0, 1.5], [1.5, 0.0], [0.9, 0.0]]
    report = compare(ocp, {"PD": PD, "out": policy(lambda p, v, t: 0.5 + 0 * p)}, x0=x0, progress=False)
    assert report.counted.tolist() == [True, False, False, True]
    assert report.impossible == ("", "no plan holds 'track' from here: worst at node 30 of 80 by 0.463 m",
                                 "the initial state itself violates 'track' by 0.4 m", "")
    alone = compare(ocp, {"PD": PD, "out": policy(lambda p, v, t: 0.5 + 0 * p)}, x0=x0[::3], progress=False)
    for row, other in zip(report.summary(), alone.summary(), strict=True):
        assert row["n"] == 2
        assert row["impossible"] == 2
        assert row["failures"] == other["failures"]
        assert row["violates"] == other["violates"]
        for key in ("cost_mean", "gap_median", "gap_p95", "missed_median", "within_1", "terminal_error_mean"):
            np.testing.assert_array_equal(row[key], other[key])
    assert [row["counted"] for row in report.rows()[:4]] == report.counted.tolist()
    assert np.isnan(report.gap[:, [1, 2]]).all()
    said = [sentence for sentence in report.verdict() if sentence.startswith("Left out of all numbers: 2 of 4")]
    assert "(state 1: no plan holds 'track' from here: worst at node 30 of 80 by 0.463 m)" in said[0]
    assert [line[0] for line in tables(report)["impossible"].body] == ["1", "2"]
    assert all(line[1] in "03" for line in tables(report)["failures"].body)
    assert set(payload(report)["impossible"]) == {"1", "2"}


def test_a_state_that_all_methods_fail_on_counts_where_a_plan_exists():
    ocp = make(constraints={"track": (-2, P, 1.1)})
    report = compare(ocp, {"out": policy(lambda p, v, t: 0.5 + 0 * p)}, x0=[[1.0, 0.0]], progress=False)
    assert report.counted.all()
    assert report.summary()[0]["failures"] == report.summary()[0]["violations"] == 1


def gains(ocp):
    report = compare(ocp, {"PD": PD, "weak": WEAK, "LQR": LQR(ocp)}, x0=[[1.0, 0.0], [0.8, 0.1]], progress=False)
    return report, report.missed


def test_what_is_missed_has_no_constant_and_no_unit_in_it():
    ocp = make(state_bounds={"v": (-0.6, None)})  # LQR is faster
    report, missed = gains(ocp)
    assert np.isfinite(missed[:2]).all()
    J, best = report.cost, report.best
    np.testing.assert_allclose(missed, 100 * (J - best) / (report.base - best), rtol=1e-12)
    shifted, same = gains(replace(ocp, terminal=ocp.terminal + 1000))
    np.testing.assert_allclose(same, missed, rtol=1e-6, atol=1e-6)
    assert (shifted.gap[1] < report.gap[1] / 50).all()  # which is how a constant hides errors
    _, same = gains(replace(ocp, running=1e6 * ocp.running, terminal=1e6 * ocp.terminal))
    np.testing.assert_allclose(same, missed, rtol=1e-6, atol=1e-6)


def test_a_baseline_that_costs_less_than_all_methods_is_the_best_known():
    ocp = make()
    report = compare(ocp, {"weak": WEAK}, x0=[[1.0, 0.0], [0.0, 0.0]], progress=False)
    lqr = nocl.simulate(ocp, LQR(ocp), [[1.0, 0.0]]).cost
    assert report.best_method == ["a simple baseline", "weak"]  # from rest at the goal both cost nothing
    assert report.best[0] == report.base[0] == pytest.approx(lqr[0], rel=1e-9)
    assert report.gap[0, 0] == pytest.approx(100 * (report.cost[0, 0] / lqr[0] - 1), rel=1e-6)
    assert np.isnan(report.missed[0, 0])
    assert report.summary()[0]["found_best"] == 1
    assert f"against {number(lqr[0])} by a simple baseline: " in " ".join(worst(report, 1)[0].sentences)
    assert payload(report)["best"] == [-1, 0]


def test_what_compare_asks_beside_the_methods_is_kept_and_spread_too(tmp_path, monkeypatch):
    ocp = make(constraints={"track": (-2, P, 1.1)})
    methods = {"out": policy(lambda p, v, t: 0.5 + 0 * p)}
    x0 = [[1.0, 0.0], [1.0, 1.5], [0.9, 0.0]]
    first = compare(ocp, methods, x0=x0, out=tmp_path, workers=2, progress=False)
    monkeypatch.setattr(Judging, "judge", None)
    monkeypatch.setattr(DDP, "descend", None)
    again = compare(ocp, methods, x0=x0, out=tmp_path, progress=False)
    assert again.impossible == first.impossible
    assert any(first.impossible)
    np.testing.assert_array_equal(again.base, first.base)


def test_the_baselines_are_held_controls_and_lqr():
    """p = p0 + v0 t under u = 0, which is u*, the middle of U and 0; LQR would be faster than the limit."""
    ocp = make(running=1e-4 * U**2 + P**2, state_bounds={"v": (-0.05, 1)})
    report = compare(ocp, {"PD": PD}, x0=[[1.0, 0.05], [1.0, -0.04]], progress=False)
    p, v = np.array([[1.0, 1.0], [0.05, -0.04]])
    held = p**2 * T + p * v * T**2 + v**2 * T**3 / 3 + (p + v * T)**2 + v**2
    np.testing.assert_allclose(report.base, held, rtol=1e-8)
    free = make()
    lqr = nocl.simulate(free, LQR(free), [[1.0, 0.0]]).cost
    report = compare(free, {"PD": PD, "LQR": LQR(free)}, x0=[[1.0, 0.0]], progress=False)
    np.testing.assert_array_equal(report.base, lqr)
    assert np.isnan(report.missed).all()  # LQR is a method here: nothing is to be gained over it
    assert "On 1 of 1 state such a baseline is as good as the best method." in tables(report)["summary"].note
    report = compare(free, {"PD": PD}, x0=[[1.0, 0.0]], progress=False)
    assert report.cost[0, 0] > 1.01 * report.base[0]
    assert "On 1 of 1 state no method costs as little as such a baseline" in tables(report)["summary"].note


def test_a_promise_of_no_violation_is_the_exact_bound():
    """PD from v0 = 0 reaches a speed in proportion to p0: a limit splits the states."""
    ocp = make(state_bounds={"v": (-0.44, None)})
    report = compare(ocp, {"PD": PD}, n=30, seed=2, progress=False)
    k = int(report.feasible[0].sum())
    assert 0 < k < 30
    cost, held = promises(report, confidence=0.9)
    assert (held.within, held.successes, held.n) == (None, k, 30)
    assert binom.sf(k - 1, 30, held.share) == pytest.approx(0.1, rel=1e-9)
    assert f"reach the horizon with all constraints held ({k} of 30 did)" in str(held)
    assert cost.within == 2.0
    assert len(promises(compare(make(), {"PD": PD}, n=3, progress=False))) == 1


def test_constraints_are_drawn_as_lines_or_by_their_values():
    ocp = make(constraints={"track": (-0.5, P, 2), "half": 1 - 2 * V, "power": (None, U * V, 0.5), "mixed": 3 - P - V},
               terminal_constraints={"at": (0, P - 0.25, 0), "ring": (None, P**2 + V**2, 1)})
    assert [tuple(line) for line in limits.lines(ocp)] == \
        [(0, -0.5, False), (0, 2, False), (1, 0.5, False), (0, 0.25, True)]
    assert [one.name for one in limits.others(ocp)] == ["power", "mixed"]
    s = nocl.simulate(ocp, PD, [[1.0, 0.0], [0.5, 0.1]], nodes=11)
    drawn = limits.values(ocp, s, np.zeros((2, 0)))
    np.testing.assert_allclose(drawn[..., 0], s.u[..., 0] * s.x[..., 1], atol=1e-14)
    np.testing.assert_allclose(drawn[..., 1], 3 - s.x.sum(axis=2), atol=1e-14)
    report = compare(ocp, {"PD": PD}, x0=[[1.0, 0.0]], progress=False)
    data = payload(report)
    assert data["held"] == [{"name": "power", "bounds": [0.5]}, {"name": "mixed", "bounds": [0.0]}]
    assert data["channels"] == {"togo": 3, "held power": 4, "held mixed": 5}


POWER = {"power": (None, -U * V, 0.3)}


def test_a_study_takes_constraints_of_the_control(tmp_path):
    """Its reference holds them, and costs no more than NMPC, which holds them on fewer intervals."""
    ocp = make(constraints=POWER)
    methods = {"PD": PD, "NMPC": NMPC(ocp, 20, starts=1, passes=0)}
    report = study(ocp, methods, n=2, workers=1, progress=False)
    assert [j.name for j in report.judged] == ["PD", "NMPC", "reference"]
    assert report.feasible[2].all()
    assert (report.best == report.cost[2]).all()
    assert {promise.within for promise in report.promises} == {2.0, None}
    page = report.save(tmp_path, animation=False).read_text()
    assert "power" in page


class Valued:
    """A law with a value function."""

    def to_casadi(self):
        return PD

    def value(self, x, t=0.0):
        return (x**2).sum(axis=1)

    def value_to_casadi(self):
        x, t = ca.MX.sym("x", 2), ca.MX.sym("t")
        return ca.Function("value", [x, t], [ca.sumsqr(x)], ["x", "t"], ["V"])


@pytest.mark.parametrize(("constraints", "known"), [({}, True), (POWER, False)])
def test_an_audit_does_not_say_what_multipliers_it_does_not_know(constraints, known):
    """Where a constraint holds the control, dH/du need not vanish at an optimum."""
    ocp, methods = make(constraints=constraints), {"law": Valued()}
    one, = audit(compare(ocp, methods, x0=[[1.0, 0.0]], progress=False), methods)
    assert np.isfinite(one.value.hamiltonian_gradient).all() == known
    assert np.isfinite(one.value.hjb).all()


@pytest.mark.slow
def test_kicks_count_only_where_a_plan_still_holds_the_constraints():
    ocp = make(state_bounds={"v": (-1.0, 1.0)}, scales={"v": 1.0})
    found = robustness(ocp, {"NMPC loop": NMPC(ocp, 20, starts=1, passes=0).controller(), "PD": PD},
                       [[1.0, 0.0], [0.9, 0.0]], settings=Disturbances(kick=[0.0, 3.0], kicks=2, hold=20, fastest=20),
                       progress=False)
    kicked = next(s for s in found.scenarios if s.name == "kicks")
    for loss in kicked.losses:
        assert loss.summary()["impossible"] == 2
        assert loss.summary()["failures"] == 0
        assert np.isnan(loss.lost).all()
    assert all(loss.summary()["impossible"] == 0 for loss in found.scenarios[0].losses)


@pytest.mark.slow
def test_a_region_counts_who_violates_as_failed():
    """PD reaches about 0.37 m/s for each metre it starts from the goal."""
    peak = -nocl.simulate(make(), PD, [1.0, 0.0]).x[0, :, 1].min()
    ocp = make(state_bounds={"v": (-1.5 * peak, None)}, initial_states=nocl.Uniform([-1, 0], [1, 0]))
    found = region(ocp, "PD", PD, scales=(1, 4), n=8, within=1e6, progress=False)
    right = found.x0[1][:, 0] <= 1.5
    assert found.successes[0] == 8
    np.testing.assert_array_equal(found.success[1], right)
