"""compare: gaps to a known optimum, a row for every method and state, the same states for all, no lost failure."""

import dataclasses
import shutil

import casadi as ca
import numpy as np
import pytest
from lq import lq_value

import nocl
from nocl.comparisons import compare
from nocl.comparisons.report.results import percentile
from nocl.data import Solution
from nocl.solvers import DDP, LQR, NMPC
from nocl.systems import double_integrator, dubins

N = 6


def nothing(x, t=0.0):
    return np.zeros((len(x), 1))


@pytest.fixture(scope="module")
def ocp():
    return double_integrator.ocp()


@pytest.fixture(scope="module")
def report(ocp):
    methods = {"LQR": LQR(ocp), "NMPC": NMPC(ocp, intervals=20, starts=1, passes=0), "nothing": nothing}
    return compare(ocp, methods, n=N, seed=3, hold=40, progress=False)


def test_costs_and_gaps_are_those_of_the_known_optimum(ocp, report):
    x0 = ocp.initial_states.sample(N, 3)
    optimum = np.einsum("bi,ij,bj->b", x0, lq_value([0.0])[0][0], x0)
    rows = {(row["method"], row["state"]): row for row in report.rows()}
    for i, best in enumerate(optimum):
        assert rows["LQR", i]["cost"] == pytest.approx(best, rel=1e-7)
        assert rows["LQR", i]["gap"] == pytest.approx(0, abs=1e-5)
        assert rows["nothing", i]["gap"] == pytest.approx(100 * (rows["nothing", i]["cost"] / best - 1), rel=1e-6)
        assert {rows[name, i]["best_method"] for name in ("LQR", "NMPC", "nothing")} == {"LQR"}
        assert 0 < rows["NMPC", i]["gap"] < 5
        assert rows["NMPC", i]["predicted_cost"] == pytest.approx(rows["NMPC", i]["cost"], rel=1e-6)


def test_there_is_a_row_for_each_method_and_state_from_the_same_states(ocp, report):
    names = ["LQR", "LQR (40 holds)", "NMPC", "nothing"]
    assert [(row["method"], row["state"]) for row in report.rows()] == [(m, i) for m in names for i in range(N)]
    x0 = ocp.initial_states.sample(N, 3)
    for judged in report.judged:
        np.testing.assert_array_equal(judged.simulation.x[:, 0], x0)
    for row in report.rows():
        assert row["x0"] == x0[row["state"]].tolist()


def test_a_held_feedback_costs_a_little_more(report):
    cost = {row["method"]: row["cost_mean"] for row in report.summary()}
    assert cost["LQR"] < cost["LQR (40 holds)"] < cost["LQR"] * 1.02


def test_summary(report):
    summary = {row["method"]: row for row in report.summary()}
    assert summary["LQR"]["within_1"] == summary["LQR"]["within_5"] == 100
    assert summary["LQR"]["found_best"] == N
    assert summary["nothing"]["within_5"] == 0
    assert all(row["failures"] == row["violations"] == 0 for row in summary.values())
    assert summary["LQR"]["how"] == "continuous feedback"
    assert summary["NMPC"]["how"] == "open loop, held on 20 intervals"
    assert np.isnan(summary["NMPC"]["ms_per_control"])
    assert summary["NMPC"]["ms_first"] > 0
    assert summary["LQR"]["ms_per_control"] > 0
    text = str(report.summary())
    assert all(name in text for name in summary)
    assert "LQR on all 6" in report.verdict()[0]
    assert "NMPC: open loop, held on 20 intervals" in report.verdict()[1]
    assert not any("not optimality" in sentence for sentence in report.verdict())


def test_one_is_not_many(ocp):
    report = compare(ocp, {"LQR": LQR(ocp)}, n=1, hold=1, progress=False)
    assert [(row["method"], row["how"]) for row in report.summary()] == \
        [("LQR", "continuous feedback"), ("LQR (1 hold)", "feedback, held on 1 interval")]


def test_the_report_is_frozen(report):
    with pytest.raises(dataclasses.FrozenInstanceError):
        report.x0 = None


def far(x, t=0.0):
    if (x[:, 0] > 1.0).any() and t > 1.0:
        raise RuntimeError("too far\nto the right")
    return np.zeros((len(x), 1))


def test_a_controller_that_raises_or_blows_up_has_rows_that_say_so(ocp):
    x0 = [[0.9, 0.0], [1.1, 0.0], [0.8, 0.0]]
    nan = lambda x, t: np.where(x[:, :1] > 0.85, np.nan, 0.0)  # noqa: E731
    report = compare(ocp, {"LQR": LQR(ocp), "far": far, "NaN": nan}, x0=x0, progress=False)
    rows = {(row["method"], row["state"]): row for row in report.rows()}
    assert [rows["far", i]["success"] for i in range(3)] == [True, False, True]
    assert rows["far", 1]["message"] == "RuntimeError: too far to the right"
    assert rows["far", 1]["cost"] == rows["far", 1]["gap"] == np.inf
    assert [rows["NaN", i]["success"] for i in range(3)] == [False, False, True]
    assert "NaN" in rows["NaN", 0]["message"]
    summary = {row["method"]: row for row in report.summary()}
    assert (summary["far"]["failures"], summary["NaN"]["failures"]) == (1, 2)
    assert summary["far"]["gap_p95"] == np.inf
    assert summary["far"]["cost_mean"] == pytest.approx((0.9**2 + 0.8**2) / 2, rel=1e-6)
    assert "far failed on 1 of 3" in report.verdict()[-1]


class Fragile:
    """A solver that gives up on some states, and raises on others."""

    def solve(self, x0):
        if (x0[:, 0] > 1.0).any():
            raise RuntimeError("no memory")
        B = len(x0)
        x = np.repeat(x0[:, None], 5, axis=1)
        blank = Solution.blank(np.tile(np.linspace(0, 2, 5), (B, 1)), 2, 1)
        message = np.array(["too near" if p <= 0.85 else "" for p in x0[:, 0]])
        return dataclasses.replace(blank, x=x, u=np.zeros((B, 4, 1)), V_x=x, cost=np.full(B, 0.5),
                                   success=x0[:, 0] > 0.85, message=message, seconds=np.full(B, 0.25),
                                   iterations=np.full(B, 3), tried=np.full((B, 5), 0.5))


def test_a_solver_that_fails_on_some_states_keeps_the_others(ocp):
    report = compare(ocp, {"fragile": Fragile()}, x0=[[0.9, 0.0], [1.1, 0.0], [0.8, 0.0]], progress=False)
    ok, raised, gave_up = report.rows()
    assert ok["success"]
    assert ok["cost"] == pytest.approx(0.81, rel=1e-9)
    assert ok["predicted_cost"] == 0.5
    assert ok["ms_first"] == 250
    assert (raised["success"], raised["message"]) == (False, "RuntimeError: no memory")
    assert (gave_up["success"], gave_up["message"], gave_up["cost"]) == (False, "not solved: too near", np.inf)
    assert report.feasible[0].tolist() == [True, False, False]
    assert raised["best_method"] == "a simple baseline"  # LQR; u held at 0 costs more
    assert raised["best_cost"] == report.base[1]
    assert report.verdict()[0] == \
        "Only fragile has answers that count, on 1 of 3 initial states: simple baselines cost less on 3 of 3."


def test_a_plan_that_costs_more_than_it_predicts_is_told():
    """x' = 3 x + u over 4: what the grid gets wrong grows by exp(12) in open loop, and the optimum is not to blame."""
    x, u = ca.SX.sym("x"), ca.SX.sym("u")
    system = nocl.System("unstable", x=x, u=u, xdot=3 * x + u, lbu=[-20], ubu=[20], lbx=[-5], ubx=[5])
    ocp = nocl.OCP.quadratic(system, horizon=4.0, x_goal=[0], u_goal=[0],
                             initial_states=nocl.Gaussian(mean=[1], std=[0.1]))
    report = compare(ocp, {"LQR": LQR(ocp), "NMPC": NMPC(ocp, intervals=16, starts=1, passes=0)}, n=3, progress=False)
    lqr, nmpc = report.summary()
    assert lqr["predicted_mean"] == pytest.approx(lqr["cost_mean"], rel=1e-5)
    assert nmpc["predicted_mean"] == np.mean([row["predicted_cost"] for row in report.rows()[3:]])
    assert nmpc["cost_mean"] > 1.05 * nmpc["predicted_mean"]
    said = [sentence for sentence in report.verdict() if "not optimality" in sentence]
    assert len(said) == 1
    assert said[0].startswith(f"NMPC's plans predict a cost of {nmpc['predicted_mean']:.4g} on average; run open loop")


def test_the_reference_and_bystanders_stay_out_of_the_speed(ocp):
    report = compare(ocp, {name: LQR(ocp) for name in ("CND", "NMPC", "DDP", "reference")}, n=2, progress=False)
    timed = [dataclasses.replace(j, ms_per_control=np.full(2, ms))
             for j, ms in zip(report.judged, (0.5, 10.0, 100.0, 1000.0), strict=True)]

    def speed(*judged):
        return dataclasses.replace(report, judged=judged).verdict()[-2]

    cnd, nmpc, ddp, reference = timed
    assert speed(*timed) == speed(cnd, nmpc) == "CND has its control in 0.5 ms, NMPC in 10 ms: 20 times faster."
    assert speed(cnd, ddp, reference) == "CND has its control in 0.5 ms, DDP in 100 ms: 200 times faster."
    assert "faster" not in speed(cnd, reference)


def test_a_run_that_violates_a_constraint_is_never_the_best():
    ocp = dubins.ocp()
    x0 = [[-2.5, 0.0, 0.0]]  # straight ahead stands the obstacle
    straight, slow = (lambda x, t, v=v: np.tile([v, 0.0], (len(x), 1)) for v in (0.32, 0.1))
    report = compare(ocp, {"through": straight, "short of it": slow}, x0=x0, progress=False)
    through, short = report.rows()
    paid = report.judged[0].simulation.cost[0]  # through the obstacle is cheaper, and no answer
    assert paid < short["cost"] < through["cost"] == np.inf
    assert (through["success"], through["reached"]) == (False, True)
    assert through["message"].startswith("violates 'obstacle' by 0.")
    assert through["clearance"] < 0 < short["clearance"]
    assert (through["feasible"], short["feasible"]) == (False, True)
    assert through["best_method"] == short["best_method"] == "short of it"
    assert through["gap"] == np.inf  # it counts in no mean and no gap
    assert [row["within_5"] for row in report.summary()] == [0, 100]
    assert [row["violations"] for row in report.summary()] == [row["failures"] for row in report.summary()] == [1, 0]
    assert np.isnan(report.summary()[0]["cost_mean"])
    assert "through violates 'obstacle' by 0." in report.verdict()[-1]
    assert "(1 of 1)" in report.verdict()[-1]


def test_a_solution_is_judged_as_it_is(ocp):
    x0 = ocp.initial_states.sample(3, 1)
    solution = NMPC(ocp, intervals=20, starts=1, passes=0).solve(x0)
    report = compare(ocp, {"plan": solution}, x0=x0, progress=False)
    np.testing.assert_allclose(report.cost[0], solution.cost, rtol=1e-6)
    with pytest.raises(ValueError, match="the comparison starts it at"):
        compare(ocp, {"plan": solution}, x0=x0[::-1], progress=False)
    with pytest.raises(ValueError, match="one solution for each of the 2 initial states"):
        compare(ocp, {"plan": solution}, x0=x0[:2], progress=False)


def test_a_plan_on_another_grid_is_refused(ocp):
    x0 = ocp.initial_states.sample(2, 1)
    late = NMPC(ocp, intervals=20, starts=1, passes=0).solve(x0, t0=1.0)
    with pytest.raises(ValueError, match="equal steps from 0 to the horizon"):
        compare(ocp, {"late": late}, x0=x0, progress=False)


def test_nmpc_in_closed_loop_is_sampled_at_its_own_rate(ocp):
    loop = NMPC(ocp, intervals=10, starts=1, passes=0).controller()
    report = compare(ocp, {"loop": loop}, n=1, progress=False)
    assert report.judged[0].how == "feedback, held on 10 intervals"
    assert report.summary()[0]["failures"] == 0


def test_each_controller_is_run_at_the_rates_that_are_named(ocp):
    loop = NMPC(ocp, intervals=10, starts=1, passes=0).controller()
    report = compare(ocp, {"LQR": LQR(ocp), "loop": loop, "mine": nothing}, n=2, hold=[None, 20, 40], progress=False)
    assert [row["method"] for row in report.summary()] == \
        ["LQR", "LQR (20 holds)", "LQR (40 holds)", "loop (20 holds)", "loop (40 holds)", "mine (20 holds)",
         "mine (40 holds)"]
    cost = dict(zip([j.name for j in report.judged], report.cost[:, 0], strict=True))
    assert cost["LQR"] < cost["loop (40 holds)"] < cost["loop (20 holds)"] < 1.05 * cost["LQR"]
    assert cost["LQR (40 holds)"] < cost["LQR (20 holds)"]
    row = next(row for row in report.rows() if row["method"] == "loop (40 holds)")
    assert row["ms_first"] > 0
    assert row["ms_per_control"] > 0
    assert row["evaluations"] >= 40 * 10 * 4


def test_an_imported_onnx_policy_is_a_method(ocp, tmp_path):
    onnx = pytest.importorskip("onnx")
    from nocl.exports.onnx_reader import from_onnx

    W = onnx.numpy_helper.from_array(np.array([[-1.0], [-2.0]]), "W")
    obs, u = (onnx.helper.make_tensor_value_info(name, onnx.TensorProto.DOUBLE, [1, n]) for name, n in (("obs", 2),
                                                                                                    ("u", 1)))
    graph = onnx.helper.make_graph([onnx.helper.make_node("MatMul", ["obs", "W"], ["u"])], "policy", [obs], [u], [W])
    path = tmp_path / "policy.onnx"
    onnx.save(onnx.helper.make_model(graph, opset_imports=[onnx.helper.make_opsetid("", 17)], ir_version=8), path)
    gain = lambda x, t: x @ np.array([[-1.0], [-2.0]])  # noqa: E731
    report = compare(ocp, {"ONNX": from_onnx(path), "by hand": gain}, n=2, hold=[30], progress=False)
    np.testing.assert_allclose(report.cost[0], report.cost[1], rtol=1e-9)
    x = ca.MX.sym("x", 2)
    with pytest.raises(ValueError, match=r"returns action, value; .* needs one output, u: .*outputs="):
        nocl.simulate(ocp, ca.Function("pi", [x], [-x[0], x[1]], ["x"], ["action", "value"]), [[1.0, 0.0]])


def test_ddp_counts_what_it_evaluated(ocp):
    report = compare(ocp, {"DDP": DDP(ocp, intervals=20), "LQR": LQR(ocp)}, n=2, progress=False)
    assert report.judged[0].evaluations.min() >= 20 * 4
    assert (report.judged[1].evaluations == 0).all()
    plan = report.judged[0].plan
    np.testing.assert_allclose(plan.x, report.judged[0].simulation.x, atol=1e-6)
    assert plan.costate.shape == plan.x.shape


def test_processes_find_the_same(ocp):
    methods = {"LQR": LQR(ocp), "NMPC": NMPC(ocp, intervals=10, starts=1, passes=0), "mine": lambda x, t: -x[:, :1]}
    here, there = (compare(ocp, methods, n=4, workers=workers, progress=False) for workers in (1, 2))
    np.testing.assert_array_equal(here.cost, there.cost)
    assert [j.how for j in here.judged] == [j.how for j in there.judged]


class Counting:
    """A controller that counts its calls."""

    calls = 0

    def __call__(self, x, t):
        Counting.calls += 1
        if t > 1.0 and Counting.calls < 50:
            Counting.calls = 50
            raise KeyboardInterrupt
        return -x[:, :1]


def test_a_comparison_resumes_where_it_was_interrupted(ocp, tmp_path):
    methods = {"LQR": LQR(ocp), "NMPC": NMPC(ocp, intervals=10, starts=1, passes=0), "mine": Counting()}
    with pytest.raises(KeyboardInterrupt):
        compare(ocp, methods, n=3, hold=20, out=tmp_path, progress=False)
    whole = compare(ocp, methods, n=3, hold=20, out=tmp_path, progress=False)
    calls = Counting.calls
    again = compare(ocp, methods, n=3, hold=20, out=tmp_path, progress=False)
    assert Counting.calls == calls
    for a, b in zip(whole.judged, again.judged, strict=True):
        np.testing.assert_array_equal(a.simulation.x, b.simulation.x)
        assert list(a.simulation.message) == list(b.simulation.message)
        np.testing.assert_array_equal(a.ms_first, b.ms_first)
    with pytest.raises(ValueError, match="another run"):
        compare(ocp, methods, n=4, hold=20, out=tmp_path, progress=False)


def test_times_of_a_resumed_solver_are_those_of_its_first_run(ocp, tmp_path):
    """They are kept with its pieces."""
    methods = {"DDP": DDP(ocp, intervals=10)}
    first, again = (compare(ocp, methods, n=3, out=tmp_path / "whole", progress=False).judged[0] for _ in range(2))
    assert np.isfinite(first.ms_first).all()
    shutil.rmtree(tmp_path / "whole" / "judged")
    fresh = compare(ocp, methods, n=3, out=tmp_path / "whole", progress=False).judged[0]
    np.testing.assert_array_equal(first.ms_first, again.ms_first)
    np.testing.assert_array_equal(first.ms_first, fresh.ms_first)


def test_casadi_functions_are_methods(ocp):
    x, t = ca.MX.sym("x", 2), ca.MX.sym("t")
    policy = ca.Function("policy", [x, t], [-x[0] - x[1]])
    assert compare(ocp, {"PD": policy}, n=2, progress=False).judged[0].how == "continuous feedback"


@pytest.mark.parametrize(("methods", "options", "message"), [
    ({}, {}, "expected a dict of methods"),
    ([nothing], {}, "expected a dict of methods"),
    ({"": nothing}, {}, "expected a printable name"),
    ({3: nothing}, {}, "expected a printable name"),
    ({"two": 2}, {}, "method 'two' is a int"),
    ({"wrong": ca.Function("p", [ca.MX.sym("x", 3), ca.MX.sym("t")], [ca.MX(0)])}, {}, "method 'wrong'"),
    ({"a": nothing}, {"n": 0}, "n is 0"),
    ({"a": nothing}, {"n": 2.5}, "n is 2.5"),
    ({"a": nothing}, {"hold": 0}, "hold is 0"),
    ({"a": nothing}, {"hold": []}, "hold is"),
    ({"a": nothing}, {"hold": [None, 2.5]}, "hold is"),
    ({"a": nothing}, {"hold": "80"}, "hold is"),
    ({"a": nothing}, {"workers": 0}, "workers is 0"),
    ({"a": nothing}, {"x0": [[1.0, 2.0, 3.0]]}, "nx = 2"),
    ({"a": nothing}, {"x0": np.zeros((0, 2))}, "no rows"),
    ({"a": nothing}, {"x0": [np.nan, 0.0]}, "finite"),
])
def test_bad_input_is_told_before_any_work(ocp, methods, options, message):
    with pytest.raises(ValueError, match=message):
        compare(ocp, methods, progress=False, **options)


def test_a_name_that_a_held_twin_would_take_is_refused(ocp):
    with pytest.raises(ValueError, match="different names"):
        compare(ocp, {"LQR": LQR(ocp), "LQR (5 holds)": nothing}, hold=5, progress=False)


@pytest.mark.parametrize("values", [[0.0, 1.0, 2.0, np.inf], [0.0, np.inf], [np.inf], [1.0, 2.0]])
@pytest.mark.parametrize("q", [0, 50, 95, 100])
def test_percentiles_with_failures_are_never_nan(values, q):
    value = percentile(np.array(values), q)
    assert not np.isnan(value)
    if np.isfinite(values).all():
        assert value == np.percentile(values, q)


def test_the_public_names():
    assert nocl.comparisons.compare is compare


def test_the_reference_is_finer_than_what_it_starts_from():
    """On a fine grid the held optimum lies below that of the coarse grid, and above the continuous one (Riccati)."""
    from nocl.comparisons.reference import Reference
    from nocl.solvers import DDP, LQR

    ocp = nocl.load_ocp("double_integrator")
    x0 = ocp.initial_states.sample(5, 3)
    coarse = DDP(ocp, intervals=10).solve(x0)
    guess = coarse.u.copy()
    guess[0] = np.nan
    fine = Reference(ocp, 40, [guess]).solve(x0)
    assert fine.success.all()
    optimum = LQR(ocp).value(x0, 0.0)
    assert (fine.cost < coarse.cost).all()
    assert (fine.cost > optimum).all()
    assert (fine.cost - optimum < (coarse.cost - optimum) / 10).all()  # the loss of holding falls like h^2
