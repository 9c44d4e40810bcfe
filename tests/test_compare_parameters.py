"""compare on a problem with parameters: each state at its own p, also for methods that are made anew at each."""

import csv
import dataclasses
from base64 import b64decode

import casadi as ca
import numpy as np
import pytest
from movers import law_of_mass, mover, optimum

import nocl
from nocl.comparisons import at_each, compare, study
from nocl.comparisons.disturbances import Disturbances, robustness
from nocl.comparisons.methods import Starts
from nocl.comparisons.region import region
from nocl.comparisons.report.payload import payload
from nocl.solvers import DDP, LQR, NMPC

N = 5


def proportional(x, t, p):
    return p[:, :1] * (3 * (p[:, 1:] - x[:, :1]) - 3 * x[:, 1:])


def function_of_p():
    x, t, p = (ca.MX.sym(name, n) for name, n in (("x", 2), ("t", 1), ("p", 2)))
    return ca.Function("policy", [x, t, p], [p[0] * (3 * (p[1] - x[0]) - 3 * x[1])], ["x", "t", "p"], ["u"])


@pytest.fixture(scope="module")
def ocp():
    return mover()


@pytest.fixture(scope="module")
def report(ocp):
    methods = {"CND": law_of_mass(), "LQR": at_each(ocp, LQR), "LQR of one": LQR(ocp.at([1.0, 0.0])),
               "DDP": DDP(ocp, intervals=40), "NMPC": NMPC(ocp, 40, starts=1, passes=0), "P": function_of_p(),
               "by hand": proportional}
    return compare(ocp, methods, n=N, seed=3, hold=[None, 40], progress=False)


def of(report, name):
    return next(j for j in report.judged if j.name == name).simulation


def test_states_and_parameters_are_drawn_apart(ocp, report):
    np.testing.assert_array_equal(report.x0, ocp.initial_states.sample(N, 3))  # as without parameters
    low, high = ocp.parameter_box
    assert ((low <= report.p) & (report.p <= high)).all()
    assert len(np.unique(report.p, axis=0)) == N
    many = Starts.drawn(ocp, 2000, 3)
    np.testing.assert_array_equal(many.p[:N], report.p)
    shared = np.corrcoef(np.c_[many.x, many.p].T)[:2, 2:]
    assert np.abs(shared).max() < 0.08  # 3.5 standard deviations of what it is where they are independent
    assert (report.settings["initial states"], report.settings["parameters"]) == ("drawn with seed 3",) * 2


def test_costs_are_riccatis_at_each_p(ocp, report):
    best = optimum(report.x0, report.p)
    assert of(report, "LQR").cost == pytest.approx(best, rel=1e-7)
    assert set(report.best_method) == {"LQR"}
    gaps = {row["method"]: row["gap_p95"] for row in report.summary()}
    assert gaps["LQR"] == pytest.approx(0, abs=1e-4)
    assert 0 < gaps["DDP"] < 2
    assert gaps["NMPC"] == pytest.approx(gaps["DDP"], abs=1e-3)
    assert (of(report, "LQR of one").cost >= best * (1 - 1e-9)).all()
    assert gaps["LQR of one"] > 5  # it goes to another goal
    off = (of(report, "LQR").x[:, -1] - np.c_[report.p[:, 1], np.zeros(N)]) / ocp.system.ubx
    np.testing.assert_allclose(of(report, "LQR").terminal_error, np.abs(off).max(axis=1))


def test_each_run_is_that_of_the_problem_at_its_p(ocp, report):
    for i, p in enumerate(report.p):
        one = ocp.at(p)
        law, laws = law_of_mass().at(p), {"CND": None, "CND (40 holds)": 40}
        for name, hold in laws.items():
            alone = nocl.simulate(one, law, report.x0[i], hold=hold)
            assert of(report, name).cost[i] == pytest.approx(alone.cost[0], rel=1e-7)
        held = nocl.simulate(one, LQR(one), report.x0[i], hold=40)
        assert of(report, "LQR (40 holds)").cost[i] == pytest.approx(held.cost[0], rel=1e-9)
    np.testing.assert_allclose(of(report, "P (40 holds)").cost, of(report, "by hand").cost, rtol=1e-9)
    expected = law_of_mass().value(report.x0, 0.0, report.p)
    np.testing.assert_allclose(report.judged[0].predicted, expected, rtol=1e-12)
    plan = DDP(ocp, intervals=40).solve(report.x0, p=report.p)
    np.testing.assert_allclose(next(j for j in report.judged if j.name == "DDP").predicted, plan.cost, rtol=1e-9)


@pytest.mark.slow
def test_rows_have_columns_for_p(report, tmp_path):
    report.save(tmp_path, animation=False)
    with (tmp_path / "rows.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == N * len(report.judged)
    for row in rows:
        p = report.p[int(row["state"])]
        assert [float(row["p_mass"]), float(row["p_goal"])] == p.tolist()
        end = np.array([float(row["end_pos"]) - p[1], float(row["end_v"])])
        np.testing.assert_allclose([float(row["error_pos"]), float(row["error_v"])], end, atol=1e-12)
    assert [row["p"] for row in report.rows()[:N]] == report.p.tolist()
    assert "mass" in str(report)
    page = (tmp_path / "report.html").read_text()
    assert '"plabels":["mass [kg]","goal [m]"]' in page


def test_the_page_knows_each_goal_and_p(ocp, report):
    data = payload(report)
    assert data["parameters"] == ("mass", "goal")
    p = np.frombuffer(b64decode(data["p"]), "<f4").reshape(N, 2)
    np.testing.assert_allclose(p, report.p, rtol=1e-6)
    goals = np.frombuffer(b64decode(data["goals"]), "<f4").reshape(N, 3)
    np.testing.assert_allclose(goals[:, 0], report.p[:, 1], rtol=1e-6)
    assert not goals[:, 1:].any()
    assert data["slices"]["p"] == ocp.nominal.tolist()
    shared = compare(ocp, {"CND": law_of_mass()}, n=2, p=[1.1, 0.4], progress=False)
    assert payload(shared)["slices"]["p"] == [1.1, 0.4]
    assert payload(shared)["slices"]["goal"] == [0.4, 0]
    fixed = compare(ocp, {"at": law_of_mass().at([1.1, 0.4])}, n=2, progress=False)
    assert "p" not in payload(fixed)["slices"]
    plain = ocp.at([1.0, 0.5])
    assert "p" not in payload(compare(plain, {"LQR": LQR(plain)}, n=2, progress=False))


def test_given_parameters_are_those(ocp):
    x0, p = [[0.3, -0.2], [0.1, 0.0]], [[0.9, 0.5], [1.1, -0.5]]
    by_row = compare(ocp, {"LQR": at_each(ocp, LQR)}, x0=x0, p=p, progress=False)
    assert by_row.cost[0] == pytest.approx(optimum(np.array(x0), np.array(p)), rel=1e-7)
    by_name = compare(ocp, {"LQR": at_each(ocp, LQR)}, n=2, seed=1, p={"mass": 0.9, "goal": 0.5}, progress=False)
    np.testing.assert_array_equal(by_name.p, [[0.9, 0.5]] * 2)
    np.testing.assert_array_equal(by_name.x0, ocp.initial_states.sample(2, 1))
    assert by_name.settings["parameters"] == "given"


def test_a_solution_is_judged_at_its_own_p(ocp):
    x0, p = np.array([[0.3, -0.2], [0.1, 0.0]]), np.array([[0.9, 0.5], [1.1, -0.5]])
    s = DDP(ocp, intervals=20).solve(x0, p=p)
    assert compare(ocp, {"DDP": s}, x0=x0, p=p, progress=False).cost[0] == pytest.approx(s.cost, rel=1e-6)
    with pytest.raises(ValueError, match="solves other parameters than those of the comparison"):
        compare(ocp, {"DDP": s}, x0=x0, p=p[::-1], progress=False)


class Fixed:
    def solve(self, x0):
        raise AssertionError("it is refused before")


@pytest.mark.parametrize(("method", "match"), [
    (Fixed(), r"'M' is a Fixed, whose solve takes no p.*mass, goal.*at_each"),
    (lambda x, t: x, r"method 'M': the controller does not take \(x, t, p\)"),
    (ca.Function("f", [ca.MX.sym("x", 3)], [ca.MX(1)]), r"method 'M': the policy f takes vectors of length \[3\]")])
def test_what_takes_no_p_is_refused_by_name(ocp, method, match):
    with pytest.raises(ValueError, match=match):
        compare(ocp, {"M": method}, n=2, progress=False)


def test_states_without_parameters_are_refused(ocp):
    with pytest.raises(ValueError, match="compare: p is missing; expected values of mass, goal"):
        compare(ocp, {"by hand": proportional}, x0=[0.0, 0.0], progress=False)
    with pytest.raises(ValueError, match="make is 3; expected a function"):
        at_each(ocp, 3)
    for made, kind in ((3, "int"), (DDP(ocp, intervals=10).solve([0, 0], p=[1, 0]), "Solution")):
        with pytest.raises(ValueError, match=f"make returned a {kind}; expected feedback, or a solver"):
            at_each(ocp, lambda one, made=made: made)
    with pytest.raises(ValueError, match=r"with n = 100 states drawn .*p has shape \(2, 2\)"):
        compare(ocp, {"by hand": proportional}, p=[[1, 0], [1, 0.1]], progress=False)
    solution = DDP(ocp, intervals=10).solve([0, 0], p=[1, 0])
    with pytest.raises(ValueError, match="solves other parameters than those of the comparison"):
        compare(ocp.at([1, 0]), {"s": solution}, x0=[0, 0], progress=False)


def test_a_solver_made_at_each_p_solves_that_problem(ocp):
    def make(one):
        return NMPC(one, 20, starts=1, passes=0)

    report = compare(ocp, {"each": at_each(ocp, make), "rows": make(ocp)}, n=3, progress=False)
    np.testing.assert_allclose(report.cost[0], report.cost[1], rtol=1e-6)
    assert isinstance(at_each(ocp.at([1.0, 0.0]), LQR), LQR)  # without parameters the method itself


def test_a_failure_at_one_p_is_a_row(ocp):
    def some(one):
        if one.x_goal[0] > 0.2:
            raise ValueError("not to the right")
        return LQR(one)

    report = compare(ocp, {"some": at_each(ocp, some)}, x0=np.zeros((2, 2)), p=[[1, 0.1], [1, 0.5]], progress=False)
    assert of(report, "some").success.tolist() == [True, False]
    assert of(report, "some").message[1] == "ValueError: not to the right"


def test_plans_on_other_grids_are_rows_that_say_so(ocp):
    report = compare(ocp, {"DDP": at_each(ocp, lambda one: DDP(one, intervals=10 if one.x_goal[0] < 0 else 20))},
                     x0=np.zeros((2, 2)), p=[[1, -0.5], [1, 0.5]], progress=False)
    assert of(report, "DDP").success.tolist() == [False, True]
    assert "its plan has 10 intervals, those of other parameters 20" in of(report, "DDP").message[0]


def test_a_solver_with_any_keyword_gets_p(ocp):
    class Any:
        def solve(self, x0, **given):
            return DDP(ocp, intervals=10).solve(x0, p=given["p"])

    report = compare(ocp, {"any": Any(), "DDP": DDP(ocp, intervals=10)}, n=2, progress=False)
    np.testing.assert_array_equal(report.cost[0], report.cost[1])


def test_feedback_made_at_each_p_keeps_its_own_rate(ocp):
    def make(one):
        return NMPC(one, 10, starts=1, passes=0).controller()

    report = compare(ocp, {"each": at_each(ocp, make), "rows": make(ocp)}, n=1, progress=False)
    assert report.cost[0] == pytest.approx(report.cost[1], rel=1e-6)


def test_parameters_without_units_have_a_report(tmp_path):
    x, u, goal = ca.SX.sym("x"), ca.SX.sym("u"), nocl.parameter("goal")
    s = nocl.System("line", x=x, u=u, xdot=u, lbu=[-1], ubu=[1], lbx=[-4], ubx=[4])
    ocp = nocl.OCP(s, p=goal, horizon=1.0, running=u**2, terminal=(x - goal)**2, x_goal=[goal], u_goal=[0],
                   initial_states=nocl.Gaussian([0], [0.1]), parameters=nocl.Uniform([-1], [1]))
    assert ocp.unit("goal") == "goal"
    path = compare(ocp, {"LQR": at_each(ocp, LQR)}, n=2, progress=False).save(tmp_path / "report", animation=False)
    assert '"plabels":["goal"]' in (path if path.is_file() else path / "report.html").read_text()


def test_nmpc_as_feedback_has_each_p(ocp):
    loop = NMPC(ocp, 10, starts=1, passes=0).controller()
    x0, p = np.array([[0.3, -0.2], [0.1, 0.0]]), np.array([[0.9, 0.5], [1.1, -0.5]])
    found = compare(ocp, {"loop": loop}, x0=x0, p=p, progress=False)
    assert found.cost[0] == pytest.approx(optimum(x0, p), rel=0.05)


def test_processes_and_a_folder_find_the_same(ocp, tmp_path):
    methods = {"LQR": at_each(ocp, LQR), "mine": lambda x, t, p: 3 * (p[:, 1:] - x[:, :1] - x[:, 1:])}
    alone = compare(ocp, methods, n=3, progress=False)
    shared = compare(ocp, methods, n=3, workers=2, out=tmp_path, progress=False)
    again = compare(ocp, methods, n=3, out=tmp_path, progress=False)
    for found in (shared, again):
        np.testing.assert_array_equal(found.cost, alone.cost)
    with pytest.raises(ValueError, match="another run"):
        compare(ocp, methods, n=3, out=tmp_path, progress=False, p=[1.0, 0.0])


def test_a_folder_knows_what_is_made_at_each_p(ocp, tmp_path):
    def weak(one):
        law = LQR(one).to_casadi()
        return ca.Function("weak", law.mx_in(), [0.5 * law(*law.mx_in())], law.name_in(), law.name_out())

    compare(ocp, {"LQR": at_each(ocp, LQR)}, n=2, out=tmp_path, progress=False)
    with pytest.raises(ValueError, match="another run"):
        compare(ocp, {"LQR": at_each(ocp, weak)}, n=2, out=tmp_path, progress=False)


def test_a_study_holds_audits_and_stability_at_each_p(ocp):
    report = study(ocp, {"P": function_of_p(), "LQR": at_each(ocp, LQR), "CND": law_of_mass()}, n=3, workers=1,
                   progress=False)
    assert report.judged[-1].name == "reference"
    assert report.gap[-1].max() < 0.1  # DDP's on 320 intervals, at each p
    for audit in report.audits:
        np.testing.assert_allclose(audit.rollouts[0].cost, of(report, audit.method).cost, rtol=1e-5)
    value = report.audits[2].value
    np.testing.assert_allclose(value.value, law_of_mass().value(report.x0, 0.0, report.p), rtol=1e-10)
    at_goal = next(s for s in report.stability if (s.method, s.where) == ("P", "goal"))
    expected = np.roots([1, 3, 3])  # m xdd = m (-3 x - 3 xd)
    np.testing.assert_allclose(np.sort_complex(at_goal.eigenvalues[0]), np.sort_complex(expected), rtol=1e-9)
    middle = next(s for s in report.stability if (s.method, s.where) == ("P", "mid-horizon"))
    np.testing.assert_allclose(middle.gain[:, 0], -3 * report.p[:, :1] * [1, 1], rtol=1e-9)  # each its own mass
    for method, place in (("LQR", "goal"), ("LQR", "mid-horizon")):  # made at each p, at mid-horizon too
        own = next(s for s in report.stability if (s.method, s.where) == (method, place))
        p = ocp.nominal[None] if place == "goal" else report.p
        laws = [LQR(ocp.at(row)).to_casadi() for row in p]
        gains = [ca.Function("K", law.mx_in(), [ca.jacobian(law(*law.mx_in()), law.mx_in()[0])])(
            [*(row[1:] if place == "goal" else [0.1]), 0], own.t).full()[0] for law, row in zip(laws, p, strict=True)]
        np.testing.assert_allclose(own.gain[:, 0], gains, rtol=1e-9)
    assert len(report.promises) == 3
    assert "of the initial states and parameters of these distributions end within 2 %" in str(report.promises[0])


def test_a_problem_in_time_is_compared():
    timed = mover(p=None, parameters=nocl.Uniform([0.8], [1.2]), x_goal=[0, 0])
    x, u = timed.system.x, timed.system.u
    timed = dataclasses.replace(timed, running=0.01 * u**2 + (x[0] - ca.sin(nocl.time())) ** 2)
    report = study(timed, {"DDP": DDP(timed, intervals=40)}, n=2, workers=1, progress=False)
    assert report.gap[0].max() < 2
    np.testing.assert_allclose(report.audits[0].rollouts[0].cost, report.cost[0], rtol=1e-4)


@pytest.mark.slow
def test_disturbances_at_p_are_those_of_the_problem_there(ocp):
    """Noise, kicks, delays, wrong plants and the optima under them, of what knows p and of what is made at each p."""
    p, x0, settings = np.array([0.85, 0.6]), np.array([[0.3, -0.2]]), Disturbances(hold=20, fastest=20)
    here = ocp.at(p)
    variant = ocp.functions.arguments.function("twice", {"xdot": ocp.system.equations / 2})

    def by_hand(x, t):
        return proportional(x, t, np.tile(p, (len(x), 1)))

    folded = ca.Function("twice", here.functions.arguments.inputs, [here.system.equations / 2])
    every, alone = (robustness(problem, {**laws, "NMPC": NMPC(problem, 10, starts=1, passes=0)}, x0, {"twice": f},
                               settings, progress=False, p=at)
                    for problem, laws, f, at in
                    ((ocp, {"LQR": at_each(ocp, LQR), "by hand": proportional}, variant, p),
                     (here, {"LQR": LQR(here), "by hand": by_hand}, folded, None)))
    assert [s.name for s in every.scenarios] == [s.name for s in alone.scenarios]
    assert {"noise", "kicks", "late", "twice", "controls 20 % weaker"} < {s.name for s in every.scenarios}
    for a, b in zip(every.scenarios, alone.scenarios, strict=True):
        for one, other in zip(a.losses, b.losses, strict=True):
            assert one.success.all()
            if a.name != "real time":  # whose rates are measured
                np.testing.assert_allclose(one.cost, other.cost, rtol=1e-6)
            np.testing.assert_allclose(one.best, other.best, rtol=1e-5)


def test_each_state_has_its_own_p_and_kicks_under_disturbances(ocp):
    """Of what is made at each p, as of what knows it: the second state is no copy of the first."""
    p, x0 = np.array([[0.85, 0.6], [1.1, -0.4]]), np.array([[0.3, -0.2], [-0.1, 0.4]])
    def make(one):
        goal = float(one.x_goal[0])
        return lambda x, t: 3 * (goal - x[:, :1] - x[:, 1:])

    def same(x, t, p):
        return 3 * (p[:, 1:] - x[:, :1] - x[:, 1:])

    found = robustness(ocp, {"each": at_each(ocp, make), "rows": same}, x0, None, Disturbances(hold=20), p=p,
                       progress=False)
    for s in found.scenarios:
        if s.name != "real time":
            each, rows = s.losses
            np.testing.assert_allclose(each.cost, rows.cost, rtol=1e-6)
            assert each.cost[0] != pytest.approx(each.cost[1])


def test_the_region_grows_in_x0_and_keeps_p_where_it_lies(ocp):
    """A law that is given up for goals above 0.5 fails as often as they are drawn, at any scale."""
    at = ocp.functions.feedback(ca.MX)
    x, t, p = at.inputs
    near = LQR(ocp.at([1.0, 0.0])).to_casadi()(x - ca.vertcat(p[1], 0), t)
    law = at.function("policy", {"u": ca.if_else(p[1] > 0.5, 0.0, near)})
    found = region(ocp, "law", law, scales=(0.5, 1.0), n=20, within=50.0, progress=False)
    assert found.p.shape == (20, 2)
    low, high = ocp.parameter_box
    assert ((found.p >= low) & (found.p <= high)).all()
    fails = found.p[:, 1] > 0.5
    assert 2 < fails.sum() < 10
    assert not found.success[:, fails & (np.abs(found.x0[0, :, 0]) < 0.4)].any()
    assert found.success[:, ~fails].mean() > 0.9
