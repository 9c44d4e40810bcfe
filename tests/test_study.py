"""What stands beside costs: audits, promises, stability, regions, disturbances; all against closed forms."""

import dataclasses

import casadi as ca
import numpy as np
import pytest
from scipy.linalg import expm
from scipy.stats import binom

import nocl
from nocl.comparisons import compare, robustness, study
from nocl.comparisons.audit import EXACT, LEARNED, audit
from nocl.comparisons.disturbances import Disturbances, mass_variants, on_plant, plant
from nocl.comparisons.promise import interval, lower_bound, promises
from nocl.comparisons.reference import Reference, resolved
from nocl.comparisons.region import grown, region
from nocl.comparisons.report.findings import ScenarioLoss, quantiles
from nocl.comparisons.report.tables import tables
from nocl.comparisons.stability import local, stability
from nocl.solvers import LQR, NMPC
from nocl.support.fingerprint import fingerprint
from nocl.systems import double_integrator, dubins


@pytest.fixture(scope="module")
def ocp():
    return double_integrator.ocp()


class Valued:
    """LQR with its value function x' P(t) x / 2 in CasADi, as CND has one; `factor` spoils it."""

    def __init__(self, ocp, factor=1.0):
        self.lqr, self.factor, self.ocp = LQR(ocp), factor, ocp

    def to_casadi(self):
        return self.lqr.to_casadi()

    def value(self, x, t=0.0):
        return self.factor * self.lqr.value(x, t)

    def value_to_casadi(self):
        """By P(t)^-1 = P_T^-1 + W(t), in closed form for the double integrator with R = 0.01, P = 2 I, T = 2."""
        x, t = ca.MX.sym("x", 2), ca.MX.sym("t")
        s, R = self.ocp.horizon - t, 0.01
        W = ca.blockcat([[s**3 / 3, s**2 / 2], [s**2 / 2, s]]) / R
        Phi = ca.blockcat([[1, s], [0, 1]])
        V = ca.bilin(ca.mtimes([Phi.T, ca.inv(ca.DM.eye(2) + W), Phi]), x, x)
        return ca.Function("value", [x, t], [self.factor * V], ["x", "t"], ["V"])


def test_an_exact_value_function_passes_its_audit(ocp):
    methods = {"law": Valued(ocp), "wrong": Valued(ocp, 1.1), "NMPC": NMPC(ocp, intervals=160, starts=1, passes=0)}
    report = compare(ocp, methods, n=3, progress=False)
    exact, wrong, nmpc = audit(report, methods)
    v = exact.value
    assert v.against == "NMPC"
    assert v.error.max() < 1e-7
    assert np.abs(v.hjb).max() < 1e-5
    assert np.abs(v.hamiltonian_gradient).max() < 1e-5
    assert v.angle.max() < 0.5
    assert np.abs(v.size).max() < 1
    np.testing.assert_allclose(wrong.value.error, 0.1 * report.cost[0], rtol=1e-4)
    np.testing.assert_allclose(wrong.value.size, 10 + v.size, atol=0.5)
    assert np.abs(wrong.value.hamiltonian_gradient).max() > 1e-3
    assert nmpc.value is None
    rows = dataclasses.replace(report, audits=(exact, wrong, nmpc)).rows()
    assert rows[0]["value_error"] < 1e-7
    assert np.isnan(rows[-1]["value_error"])
    assert rows[-1]["discretisation"] == pytest.approx(0, abs=1e-4)


def test_rollouts_on_a_model_show_what_is_gained_by_its_errors(ocp):
    """On a model whose controls are twice as strong half the control does."""
    s = ocp.system
    strong = ca.Function("strong", [s.x, s.u], [s.f(s.x, 2 * s.u)])
    other = on_plant(ocp, strong)
    methods = {"cheat": LQR(other), "plan": NMPC(other, intervals=40, starts=1, passes=0)}
    report = compare(ocp, methods, n=2, progress=False)
    for one, law in zip(audit(report, methods, strong), (True, False), strict=True):
        cost = {r.name: r.cost for r in one.rollouts}
        np.testing.assert_allclose(cost[EXACT], report.cost[0 if law else 1], rtol=1e-2)
        np.testing.assert_allclose(cost[LEARNED], LQR(other).value(report.x0), rtol=2e-2)
        assert one.exploitation.min() > 20
        assert np.abs(one.discretisation).max() < 1
        assert one.rollouts[0].x.shape == (2, len(one.rollouts[0].t), 2)


def test_a_model_that_knows_where_not_to_trust_it_marks_trajectories(ocp):
    """Doubtful where the speed is above 0.3: of the two states one flies through such speeds."""
    class Doubting:
        def to_casadi(self):
            return ocp.system.f

        def doubt(self, x, u):
            assert u.shape[:2] == x.shape[:2]
            return (np.abs(x[:, :, 1]) > 0.3).mean(axis=1)

    report = compare(ocp, {"LQR": LQR(ocp)}, x0=[[0.02, 0.0], [1.0, 0.0]], progress=False)
    report = dataclasses.replace(report, audits=audit(report, {"LQR": LQR(ocp)}, Doubting()))
    one, = report.audits
    fast = 100 * (np.abs(report.judged[0].simulation.x[:, :, 1]) > 0.3).mean(axis=1)
    assert fast[0] == 0 < fast[1]
    assert [row["doubt"] for row in report.rows()] == pytest.approx(fast.tolist())
    assert one.sentence == "LQR: the model is not to be trusted somewhere along 1 of 2 trajectories."
    table = tables(report)["audits"]
    assert table.head[-1] == "model doubtful % of nodes"
    assert one.sentence in table.note
    silent, = audit(report, {"LQR": LQR(ocp)}, ocp.system.f)
    assert silent.sentence == ""
    assert np.isnan([row["doubt"] for row in silent.rows()]).all()


def test_a_law_that_fails_on_one_state_is_audited_on_the_others(ocp):
    mine = lambda x, t: np.where(x[:, :1] > 1.05, np.nan, -x[:, :1])  # noqa: E731
    report = compare(ocp, {"mine": mine}, x0=[[1.0, 0.0], [1.1, 0.0]], progress=False)
    one, = audit(report, {"mine": mine})
    assert np.isfinite(one.discretisation[0])
    assert np.isnan(one.discretisation[1])
    assert promises(report) == ()


@pytest.mark.parametrize(("k", "n", "confidence"), [(97, 100, 0.99), (100, 100, 0.99), (1, 7, 0.9), (50, 200, 0.95)])
def test_the_lower_bound_is_where_the_binomial_says(k, n, confidence):
    p = lower_bound(k, n, confidence)
    assert binom.sf(k - 1, n, p) == pytest.approx(1 - confidence, rel=1e-9)
    low, high = interval(k, n, confidence)
    assert low < p < k / n <= high


def test_the_bounds_at_the_ends():
    assert lower_bound(0, 10, 0.99) == 0
    assert lower_bound(100, 100, 0.99) == pytest.approx(0.01**0.01)
    assert interval(10, 10, 0.95)[1] == 1
    assert interval(0, 10, 0.95)[0] == 0
    for wrong in ((11, 10, 0.9), (-1, 10, 0.9), (0, 0, 0.9), (1, 2, 1.0)):
        with pytest.raises(ValueError, match="expected"):
            lower_bound(*wrong)


@pytest.mark.parametrize("share", [0.5, 0.9, 0.97, 0.995])
@pytest.mark.parametrize("n", [20, 200])
def test_a_promise_holds_as_often_as_it_says(share, n):
    """A synthetic method that succeeds with a known probability: by simulation, and exactly by summing."""
    confidence, rng = 0.95, np.random.default_rng(0)
    bound = np.array([lower_bound(k, n, confidence) for k in range(n + 1)])
    assert (bound[rng.binomial(n, share, 20_000)] <= share).mean() > confidence - 0.005
    assert binom.pmf(np.arange(n + 1), n, share)[bound <= share].sum() >= confidence


def test_a_promise_on_a_method_of_known_failure_rate(ocp):
    """It leaves the best of the states of p > 1 alone: over many comparisons the promise is broken in 10 % at most."""
    lqr, rate = LQR(ocp), 0.7
    edge = np.quantile(ocp.initial_states.sample(100_000, 9)[:, 0], rate)
    lazy = lambda x, t: lqr(x, t)  # noqa: E731
    report = compare(ocp, {"LQR": lqr}, n=40, seed=5, progress=False)
    broken = 0
    for seed in range(200):
        x0 = ocp.initial_states.sample(40, seed)
        good = int((x0[:, 0] <= edge).sum())
        broken += lower_bound(good, 40, 0.9) > rate
    assert broken <= 0.1 * 200 + 3 * np.sqrt(200 * 0.09)
    said = promises(report, within=2, confidence=0.9)[0]
    assert (said.successes, said.n) == (40, 40)
    assert str(said).startswith("LQR: with 90 % confidence, at least 94.4 % of the initial states")
    assert lazy(x0[:1], 0.0).shape == (1, 1)


def test_stability_of_a_linear_loop_is_known(ocp):
    """x' = (A - B K) x with constant K: its eigenvalues, and Phi = expm."""
    K = np.array([[4.0, 3.0]])
    x, t = ca.MX.sym("x", 2), ca.MX.sym("t")
    policy = ca.Function("policy", [x, t], [-ca.mtimes(K, x)])
    found = local(ocp, "PD", policy, "goal", 0.5, np.zeros((1, 2)), np.zeros((1, 0)))
    A = np.array([[0.0, 1.0], [-4.0, -3.0]])
    np.testing.assert_allclose(np.sort_complex(found.eigenvalues[0]), np.sort_complex(np.linalg.eigvals(A)), rtol=1e-9)
    assert found.growth[0] == pytest.approx(np.linalg.norm(expm(1.5 * A), 2), rel=1e-4)
    np.testing.assert_allclose(found.gain[0], -K)


def test_lqr_and_the_optimum_stand_beside_a_law(ocp):
    methods = {"law": Valued(ocp), "NMPC": NMPC(ocp, intervals=40, starts=1, passes=0)}
    found = {(s.method, s.where): s for s in stability(compare(ocp, methods, n=2, progress=False), methods)}
    assert set(found) == {("law", "goal"), ("LQR", "goal"), ("law", "mid-horizon"), ("LQR", "mid-horizon"),
                          ("optimum's own feedback", "mid-horizon")}
    assert found["law", "goal"].abscissa == pytest.approx(found["LQR", "goal"].abscissa)
    own, best = found["law", "mid-horizon"], found["optimum's own feedback", "mid-horizon"]
    assert own.growth == pytest.approx(best.growth, rel=0.05)
    assert own.abscissa == pytest.approx(best.abscissa, rel=0.05)


def test_a_distribution_grows_about_its_centre():
    wide = grown(nocl.Uniform([0.0, 1.0], [2.0, 1.0]), 3.0)
    np.testing.assert_allclose((wide.lb, wide.ub), ([-2.0, 1.0], [4.0, 1.0]))
    wide = grown(nocl.Gaussian([1.0], [0.5]), 2.0)
    np.testing.assert_allclose((wide.mean, wide.std), ([1.0], [1.0]))


def test_a_region_ends_where_the_method_fails(ocp):
    """The law is given up beyond |p| = 1.3, so that the share that works is the share of draws inside."""
    lqr = LQR(ocp).to_casadi()
    x, t = ca.MX.sym("x", 2), ca.MX.sym("t")
    switch = ca.if_else(ca.fabs(x[0]) > 1.3, ca.MX(0), lqr(x, t))
    law = ca.Function("policy", [x, t], [switch])
    found = region(ocp, "law", law, scales=(1, 4, 16, 32), n=12, progress=False)
    inside = (np.abs(found.x0[:, :, 0]) < 1.25).sum(axis=1)
    assert (np.abs(found.successes - inside) <= 3).all()
    assert found.successes[-1] < 6
    assert len(found.scale) < 4
    assert (found.lower <= found.successes / 12).all()
    assert (found.upper >= found.successes / 12).all()
    with pytest.raises(ValueError, match="rising"):
        region(ocp, "law", law, scales=(2, 1))


def test_the_resolved_optimum_of_a_linear_problem(ocp):
    """V is quadratic: the optimum solved anew after each kick costs what Riccati says along its own path."""
    lqr, x0 = LQR(ocp), ocp.initial_states.sample(3, 0)
    start = Reference(ocp, 320).solve(x0)
    dx = np.array([[0.1, -0.2]])
    cost = resolved(ocp, start, [(10, dx), (30, -dx)])
    V = lambda x, t: np.array([lqr.value(row, t) for row in x])  # noqa: E731
    first = start.x[:, 80]
    after = Reference(ocp, 320).solve(x0)  # the path from the kicked state
    from nocl.judge import simulate
    kicked = simulate(ocp, lqr, x0, kicks=[(0.5, dx[0]), (1.5, -dx[0])])
    np.testing.assert_allclose(cost, kicked.cost, rtol=2e-3)
    assert (V(first + dx, 0.5) != V(first, 0.5)).all()
    assert after.success.all()
    with pytest.raises(ValueError, match="multiple of 40"):
        resolved(ocp, Reference(ocp, 30).solve(x0), [])


def test_a_state_without_an_optimum_does_not_stop_the_others(ocp):
    start = Reference(ocp, 40).solve(ocp.initial_states.sample(2, 7))
    kicks = [(10, np.full((2, 2), 0.1))]
    whole = resolved(ocp, start, kicks)
    for values in (start.x, start.V, start.u):
        values[1] = np.nan
    start.cost[1], start.success[1] = np.inf, False
    np.testing.assert_array_equal(resolved(ocp, start, kicks), [whole[0], np.inf])


@pytest.fixture(scope="module")
def robust(ocp):
    loop = NMPC(ocp, intervals=10, starts=1, passes=0)
    methods = {"LQR": LQR(ocp), "plan": loop, "loop": loop.controller(), "mine": lambda x, t: -3 * x[:, :1] - x[:, 1:]}
    settings = Disturbances(hold=20, fastest=20)
    return robustness(ocp, methods, ocp.initial_states.sample(2, 4), mass_variants(ocp), settings, progress=False)


@pytest.mark.slow
def test_every_scenario_has_every_method(robust):
    assert [s.name for s in robust.scenarios] == ["undisturbed", "noise", "kicks", "held", "late", "masses +20 %",
                                                  "masses -20 %", "controls 20 % weaker", "real time"]
    for s in robust.scenarios:
        assert [loss.method for loss in s.losses] == ["LQR", "plan", "loop", "mine"]
        assert all(loss.success.all() for loss in s.losses)
    assert len(robust.summary()) == 9 * 4


def test_feedback_stands_disturbances_and_plans_do_not(robust):
    lost = {(s.name, loss.method): float(np.median(loss.lost)) for s in robust.scenarios for loss in s.losses}
    assert abs(lost["undisturbed", "LQR"]) < 0.01
    assert abs(lost["kicks", "LQR"]) < 0.5
    assert lost["kicks", "plan"] > 20 * lost["kicks", "LQR"]
    for name in ("masses +20 %", "masses -20 %", "controls 20 % weaker"):
        assert lost[name, "LQR"] < lost[name, "plan"]
    assert lost["undisturbed", "LQR"] < lost["held", "LQR"] < lost["late", "LQR"]


def test_real_time_is_run_at_measured_rates(robust):
    how = {loss.method: loss.how for loss in robust.scenarios[-1].losses}
    assert how["LQR"] == "continuous feedback"
    assert how["plan"].startswith("open loop")
    assert "ms late" in how["loop"]


def test_mass_variants():
    assert list(mass_variants(dubins.ocp())) == ["constants +20 %", "constants -20 %"]
    heavy = mass_variants(nocl.load_ocp("cartpole"))["masses +20 %"]
    from nocl.systems import cartpole
    same = cartpole.system(m_cart=1.2, m_pole=0.12)
    z = np.array([0.1, 0.2, 0.3, 0.4])
    np.testing.assert_allclose(heavy.f(z, 0.5).full(), same.f(z, 0.5).full())
    assert mass_variants(nocl.load_ocp("cartpole", m_cart=2.0)) == {}


def test_a_variant_may_be_a_system_a_problem_or_a_function(ocp):
    other = double_integrator.ocp(mass=2.0)
    for variant in (other, other.system, other.system.f):
        assert float(plant(ocp, variant)([0.0, 0.0], 1.0)[1]) == 0.5
    with pytest.raises(ValueError, match="dynamics"):
        robustness(ocp, {"LQR": LQR(ocp)}, [1.0, 0.0], {"wrong": 3})
    with pytest.raises(ValueError, match="kicks is 0"):
        Disturbances(kicks=0)


def test_disturbances_resume_from_a_folder(ocp, tmp_path):
    x0, law = ocp.initial_states.sample(2, 1), {"LQR": LQR(ocp)}
    found, files = [], []
    for _ in range(2):
        found.append(robustness(ocp, law, x0, mass_variants(ocp), Disturbances(hold=20), out=tmp_path, progress=False))
        files.append({file: file.stat().st_mtime_ns for file in tmp_path.rglob("*.npz")})
    for a, b in zip(found[0].scenarios, found[1].scenarios, strict=True):
        np.testing.assert_array_equal(a.losses[0].cost, b.losses[0].cost)
    assert len(files[0]) == 2 * len(found[0].scenarios)
    assert files[0] == files[1]  # nothing was done twice


def test_a_fingerprint_of_a_function_does_not_change_with_its_use():
    t = ca.MX.sym("t")
    first, other = (ca.Function("law", [t], [ca.bspline(t, [0, 1, end, 2], [[0, 0, 0, 0, 1, 1, 1, 1]], [3], 1, {})])
                    for end in (1, 3))
    before = fingerprint(first)
    assert before != fingerprint(other)
    first.jacobian()  # the spline keeps its derivative, and serialises with it
    assert fingerprint(first) == before


def test_losses_of_failures_and_of_unknown_optima():
    loss = ScenarioLoss("m", "how", np.array([1.1, np.inf, 1.0]), np.array([1.0, 1.0, np.inf]),
                        np.array([True, False, True]), np.zeros(3))
    np.testing.assert_allclose(loss.lost, [10, np.inf, np.nan])
    assert quantiles(loss.lost)["p95"] == np.inf
    assert quantiles(np.array([np.nan])) == {}


def test_a_study_fills_the_report(ocp, tmp_path):
    methods = {"LQR": LQR(ocp), "NMPC": NMPC(ocp, intervals=20, starts=1, passes=0)}
    report = study(ocp, methods, n=3, model=ocp.system.f, workers=1, out=tmp_path / "work", progress=False)
    assert [j.name for j in report.judged] == ["LQR", "NMPC", "reference"]
    assert [a.method for a in report.audits] == ["LQR", "NMPC"]
    assert [p.method for p in report.promises] == ["LQR", "NMPC"]
    assert report.robustness is None
    assert "with 99 % confidence" in str(report)


@pytest.mark.slow
def test_a_robust_study_in_one_go(ocp, tmp_path):
    methods = {"LQR": LQR(ocp), "NMPC": NMPC(ocp, intervals=10, starts=1, passes=0)}
    report = study(ocp, methods, n=2, robust=True, disturbances=Disturbances(hold=10, fastest=10), workers=1,
                   progress=False)
    assert report.robustness is not None
    assert [loss.method for loss in report.robustness.scenarios[0].losses] == ["LQR", "NMPC", "NMPC closed loop"]
    assert [r.method for r in report.regions] == ["LQR"]
    assert "cost lost %" in str(report)
    page = report.save(tmp_path).read_text()
    assert "id=robustness" in page
    assert "id=regions" in page


@pytest.mark.parametrize("wrong", [{"noise": [0.1] * 3}, {"kick": -0.1}, {"noise": "loud"}])
def test_disturbances_that_make_no_sense_are_refused(ocp, wrong):
    with pytest.raises(ValueError, match=f"Disturbances: {next(iter(wrong))} is .*; expected a number >= 0, or 2"):
        robustness(ocp, {"LQR": LQR(ocp)}, ocp.initial_states.sample(1, 0), settings=Disturbances(**wrong))
