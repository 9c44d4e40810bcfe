"""Safeguards: the terminal set by hand, the step restated in numpy, sabotage that never leaves the constraints."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from scipy.linalg import expm, solve_discrete_are

import nocl
from nocl.comparisons import compare
from nocl.exports import c_code
from nocl.nets import MLP, FeatureNet
from nocl.solvers import LQR, Safeguard
from nocl.solvers.safeguard.motion import Motion
from nocl.solvers.safeguard.steps import KEPT, NONE, TAKEN
from nocl.solvers.safeguard.terminal import FACTOR, terminal_set

p, v, u = ca.SX.sym("p"), ca.SX.sym("v"), ca.SX.sym("u")
DT, WALL, FAST, MARGIN = 0.1, -0.1, 1.0, 1e-3


def mass(most=2.0, **options):
    """A mass that starts at p = 1 and may neither pass the wall behind the goal nor go faster than 1."""
    s = nocl.System("mass", x=ca.vertcat(p, v), u=u, xdot=ca.vertcat(v, u), lbu=[-most], ubu=[most], lbx=[-3, -3],
                    ubx=[3, 3])
    given = {"horizon": nocl.INFINITE, "running": p**2 + 0.1 * v**2 + 0.1 * u**2, "x_goal": [0, 0], "u_goal": [0],
             "initial_states": nocl.Gaussian([1.0, 0.0], [0.2, 0.2]), "constraints": {"wall": p - WALL},
             "state_bounds": {"v": (-FAST, FAST)}, "scales": {"wall": 1.0, "v": 1.0}}
    return nocl.OCP(s, **{**given, **options})


def pendulum(**options):
    s = nocl.System("pendulum", x=ca.vertcat(p, v), u=u, xdot=ca.vertcat(v, 9.81 * ca.sin(p) + u), lbu=[-5], ubu=[5],
                    lbx=[-7, -8], ubx=[7, 8], angles=["p"])
    return nocl.OCP(s, horizon=nocl.INFINITE, running=2 * (1 - ca.cos(p)) + 0.1 * v**2 + 0.1 * u**2, x_goal=[0, 0],
                    u_goal=[0], initial_states=nocl.Gaussian([np.pi, 0], [0.3, 0.5]), **options)


def policy(answer):
    """policy:(x, t) -> u from an expression of x."""
    x, t = ca.MX.sym("x", 2), ca.MX.sym("t")
    return ca.Function("policy", [x, t], [ca.densify(ca.MX(answer(x)))], ["x", "t"], ["u"])


def wild(x):
    """A network with random weights."""
    rng = np.random.default_rng(0)
    W = [rng.standard_normal((32, 2)), rng.standard_normal((32, 32)), rng.standard_normal((1, 32))]
    return ca.mtimes(W[2], ca.tanh(ca.mtimes(W[1], ca.tanh(ca.mtimes(W[0], x)))))


def nan(x):
    return ca.MX(np.nan) + 0 * x[0]


SABOTAGE = {"random weights": wild, "NaN": nan, "stuck": lambda x: ca.MX(2.0),
            "stuck below": lambda x: ca.MX(-2.0), "wrong sign": lambda x: 3 * x[0] + 2 * x[1],
            "too fast": lambda x: -6 * x[0] - 2 * x[1],
            "NaN near the wall": lambda x: ca.if_else(x[0] < 0.4, nan(x), -1.5 * x[0] - 2 * x[1]),
            "now and then": lambda x: -1.5 * x[0] - 2 * x[1] + 4 * ca.if_else(ca.sin(1e4 * x[0]) > 0.5, 1, 0)}


# the terminal set


def held_lqr():
    """(A, B, P, K) of the mass with controls that are held for DT, the integrals of L by van Loan's matrix."""
    A, B = np.array([[0, 1.0], [0, 0]]), np.array([[0.0], [1.0]])
    Z, W = np.zeros((3, 3)), np.diag([2.0, 0.2, 0.2])  # the Hessian of L
    Z[:2] = np.hstack([A, B])
    M = expm(DT * np.block([[-Z.T, W], [np.zeros((3, 3)), Z]]))
    step = M[3:, 3:]
    H = step.T @ M[:3, 3:]
    P = solve_discrete_are(step[:2, :2], step[:2, 2:], H[:2, :2], H[2:, 2:], s=H[:2, 2:])
    A, B = step[:2, :2], step[:2, 2:]
    return A, B, P, np.linalg.solve(H[2:, 2:] + B.T @ P @ B, B.T @ P @ A + H[2:, :2])


def largest(most):
    """The level of the largest ellipsoid in which LQR holds U, the wall and the speed at all times of a held control,
    and what ends it: a linear row r reaches sqrt(2 level r P^-1 r')."""
    _, _, P, K = held_lqr()
    rows = {"u": (most, -K)}
    for tau in np.linspace(0, DT, 1001):
        rows[f"wall {tau}"] = (-WALL - MARGIN, np.array([[1.0, tau]]) - tau**2 / 2 * K)
        rows[f"v {tau}"] = (FAST - MARGIN, np.array([[0.0, 1.0]]) - tau * K)
    levels = {name: room**2 / (2 * (r @ np.linalg.solve(P, r.T)).item()) for name, (room, r) in rows.items()}
    name = min(levels, key=levels.__getitem__)
    return levels[name], name


@pytest.mark.parametrize(("most", "ends"), [(2.0, "wall"), (0.1, "u")])
def test_the_terminal_set_of_a_linear_problem_is_the_largest_ellipsoid(most, ends):
    _, _, P, K = held_lqr()
    found = terminal_set(Motion.of(mass(most), DT), MARGIN)
    expected, name = largest(most)
    assert name.startswith(ends)
    np.testing.assert_allclose(found.P, P, rtol=1e-6)  # Runge-Kutta quadrature of L
    np.testing.assert_allclose(found.K, K, rtol=1e-6)
    assert found.proven
    assert found.share == 0.0
    assert 0.99 * expected < found.level <= expected * (1 + 1e-5)


def on_edge(terminal, n=40):
    """States [n, nx] on the edge of a terminal set."""
    angle = np.linspace(0, 2 * np.pi, n, endpoint=False)
    return np.sqrt(2 * terminal.level) * np.stack([np.cos(angle), np.sin(angle)], 1) @ np.linalg.inv(
        np.linalg.cholesky(terminal.P))


def test_what_is_proven_of_a_pendulum_holds_under_cvodes():
    ocp = pendulum()
    found = terminal_set(Motion.of(ocp, 0.05), 0.0)
    assert found.proven
    room = 5.0**2 / (2 * (found.K @ np.linalg.solve(found.P, found.K.T)).item())
    assert found.level == pytest.approx(room, rel=1e-6)  # all of where LQR stays in U
    for share in (1.0, 0.3, 0.01):
        x = np.sqrt(share) * on_edge(found)
        run = nocl.simulate(ocp, lambda x, t: -x @ found.K.T, x, duration=0.05, hold=1)
        V, after = (np.einsum("bi,ij,bj->b", x, found.P, x) / 2 for x in (x, run.x[:, -1]))
        assert (FACTOR * (V - after) >= run.cost).all()
        assert (run.cost > 0).all()


def test_what_is_not_proven_is_tried_and_says_so():
    """Four states are too many for a proof; by Clopper and Pearson at most 1 - (0.01 / 40)^(1/n) of the set is not so,
    of whichever of 40 levels."""
    cart = nocl.load_ocp("cartpole").system
    ocp = nocl.OCP(cart, horizon=nocl.INFINITE, running=ca.sumsqr(cart.x) + 0.05 * ca.sumsqr(cart.u), x_goal=[0] * 4,
                   u_goal=[0], initial_states=nocl.Gaussian([0] * 4, [0.1] * 4))
    found = terminal_set(Motion.of(ocp, 0.04), 0.0)
    assert not found.proven
    assert (1 - found.share) ** 10_000 == pytest.approx(0.01 / 40)
    x = np.random.default_rng(1).standard_normal((30, 4))
    x *= np.sqrt(2 * found.level / np.einsum("bi,ij,bj->b", x, found.P, x))[:, None]
    run = nocl.simulate(ocp, lambda x, t: -x @ found.K.T, x, duration=0.04, hold=1)
    V, after = (np.einsum("bi,ij,bj->b", x, found.P, x) / 2 for x in (x, run.x[:, -1]))
    assert (FACTOR * (V - after) >= run.cost).all()


# sabotage


def guarded(ocp, answer, steps=30, dt=DT):
    return Safeguard(ocp, policy(answer), dt=dt, steps=steps, margin=MARGIN)


def test_one_constraint_alone_and_nothing_of_u():
    """CasADi's index by an empty list is a row of a scalar, which would count as a constraint that nothing holds."""
    ocp = mass(state_bounds={}, scales={"wall": 1.0})
    safe = guarded(ocp, SABOTAGE["stuck below"])
    run = nocl.simulate(ocp, safe, ocp.initial_states.sample(3, 1), duration=8.0, tolerance=0.0)
    assert safe.terminal.proven
    assert (run.violation == 0).all()
    assert np.abs(run.x[:, -1]).max() < 1e-2


def within(set_, n=20_000):
    """States of a terminal set, in rows."""
    rng = np.random.default_rng(5)
    way = rng.standard_normal((2, n))
    way *= np.sqrt(2 * set_.level) * rng.uniform(size=n) ** 0.5 / np.linalg.norm(way, axis=0)
    return np.linalg.cholesky(np.linalg.inv(set_.P)) @ way


@pytest.mark.parametrize("more", [
    10 * ca.fmax(p - 0.2, 0), 10 * ca.if_else(p > 0.2, p - 0.2, 0), 0.5 * (1 + ca.sign(p - 0.2)),
    -3 * ca.fmax(p - 0.2, 0)], ids=["max", "condition", "step", "cost below 0"])
@pytest.mark.filterwarnings("ignore:.*(kink|jump)")
def test_what_derivatives_do_not_see_is_never_called_proven(more):
    """Second derivatives of these are 0 wherever they are defined, and 26 % of the set without them would lose more."""
    safe = guarded(mass(constraints={}, scales={"v": 1.0}, running=p**2 + 0.1 * v**2 + 0.1 * u**2 + more), wild)
    found = safe.terminal
    assert not found.proven
    assert found.share > 0
    d = within(found)
    end, cost, *_ = (part.full() for part in safe.steps.motion.function(d, -found.K @ d))
    fall = sum(sign * np.einsum("ik,ij,jk->k", z, found.P, z) for sign, z in ((1, d), (-1, end)))
    assert (fall - cost.ravel() < -1e-9).mean() <= found.share + 1e-3
    assert (cost < -1e-9).mean() <= found.share + 1e-3


def test_a_constraint_that_jumps_is_held_in_the_set():
    ocp = mass(constraints={"zone": ca.if_else(p > 0.2, 0.2, 1.0) + v, "far": p + 9}, state_bounds={}, scales={})
    found = guarded(ocp, wild).terminal
    x = within(found)
    assert not found.proven
    assert (np.where(x[0] > 0.2, 0.2, 1.0) + x[1] >= 0).mean() > 1 - found.share - 1e-3


def test_asked_twice_at_one_time_it_answers_the_same_and_keeps_its_plan():
    once, twice = (guarded(mass(), SABOTAGE["stuck"]) for _ in range(2))
    x = np.array([[1.0, 0.0]])
    for k in range(8):
        first = once(x, k * DT)
        np.testing.assert_array_equal(twice(x, k * DT), first)
        np.testing.assert_array_equal(twice(x, k * DT), first)
        np.testing.assert_array_equal(twice.plan, once.plan)
        x = once.steps.motion.function(x.T, first.T)[0].full().T
    assert once.fallbacks == twice.fallbacks == 8
    with pytest.raises(TypeError, match="t"):
        once(x)


@pytest.mark.parametrize("name", SABOTAGE)
def test_a_sabotaged_policy_never_leaves_the_constraints_and_arrives(name):
    ocp = mass()
    safe = guarded(ocp, SABOTAGE[name])
    x0 = np.vstack([ocp.initial_states.sample(6, 1), [[1.8, 0.0], [1.0, -0.9], [0.05, -0.3], [-0.09, 0.0]]])
    run = nocl.simulate(ocp, safe, x0, duration=8.0, tolerance=0.0)
    assert run.success.all()
    assert (run.violation == 0).all()
    assert np.abs(run.x[:, -1]).max() < 1e-2
    assert (run.lost == 0).all()
    assert (run.fallbacks <= 80).all()
    assert (run.fallbacks > 0).all() or name in ("now and then", "too fast")


@pytest.mark.parametrize(("answer", "expected"), [(1e16 + 2, 2.0), (-1e300, -2.0), (np.inf, 2.0), (0.3, 0.3),
                                                  (np.nan, np.nan)])
def test_answers_are_clipped_to_the_last_bit_and_nan_stays(answer, expected):
    safe = guarded(mass(), lambda x: answer + 0 * x[0])
    np.testing.assert_array_equal(safe.steps._by_policy()([1.0, 0, 0, 0], [])[1].full(), [[expected]])


@pytest.mark.parametrize("name", ["NaN", "stuck"])
def test_a_pendulum_swings_up_under_any_policy(name):
    """LQR has no plan from hanging: NMPC is asked for the first one."""
    ocp = pendulum()
    safe = guarded(ocp, SABOTAGE[name], steps=60, dt=0.06)
    run = nocl.simulate(ocp, safe, np.array([[np.pi, 0.0], [2.5, 0.5], [0.1, -0.2]]), duration=9.0)
    assert run.success.all()
    assert (run.lost == 0).all()
    assert np.abs(ocp.from_goal(run.x[:, -1])).max() < 1e-2


def test_two_controls_go_round_a_disc():
    """LQR drives through it; with rows that are curved, one of them of the controls."""
    x = ca.vertcat(*map(ca.SX.sym, ("a", "b", "va", "vb")))
    s = nocl.System("planar", x=x, u=ca.vertcat(u, v), xdot=ca.vertcat(x[2], x[3], u, v), lbu=[-2] * 2, ubu=[2] * 2,
                    lbx=[-3] * 4, ubx=[3] * 4)
    ocp = nocl.OCP(s, horizon=nocl.INFINITE, running=ca.sumsqr(x) + 0.1 * (u**2 + v**2), x_goal=[0] * 4,
                   u_goal=[0, 0], initial_states=nocl.Gaussian([2, 0, 0, 0], [0.1] * 4),
                   constraints={"disc": (x[0] - 1)**2 + x[1]**2 - 0.16, "power": (None, u**2 + v**2, 3)})
    lqr, x0 = LQR(ocp.unconstrained), np.array([[2, 0.05, 0, 0], [1.8, -0.3, 0, 0.2], [0.3, 0.3, 0, 0]])
    safe = Safeguard(ocp, lqr, dt=DT, steps=40)
    assert safe.terminal.proven  # of a linear motion, whatever the number of states
    assert safe.terminal.level > 0.01
    run = nocl.simulate(ocp, safe, x0, duration=8.0, tolerance=0.0)
    assert nocl.simulate(ocp, lqr, x0, duration=8.0, hold=80).violation.max() > 0.5
    assert run.success.all()
    assert (run.lost == 0).all()
    assert (run.fallbacks < 20).all()
    assert np.abs(run.x[:, -1]).max() < 1e-2


@pytest.mark.parametrize("name", ["now and then", "NaN near the wall", "wrong sign"])
def test_plans_stay_admissible_and_what_they_may_cost_falls_by_what_was_paid(name):
    """Recursive feasibility and decrease, step by step on the motion that plans are made with."""
    ocp = mass()
    safe = guarded(ocp, SABOTAGE[name])
    motion, step = safe.steps.motion.function, safe.step_to_casadi()
    x = np.random.default_rng(3).uniform([-0.05, -0.9], [1.5, 0.9], (60, 2))
    plan, promised, seen = np.zeros((60, safe.steps.size)), np.full(60, np.inf), set()
    alive = np.ones(60, dtype=bool)
    for k in range(70):
        answer, plan, status = (part.full().T for part in step(x.T, plan.T))
        alive &= (status[:, 0] != NONE) | (k > 0)
        assert (status[alive] != NONE).all()
        x, paid, held, _ = (part.full().T for part in motion(x.T, answer.T))
        assert (held[alive] > 0).all()
        may = plan[:, 1]
        assert (may <= promised - paid[:, 0] + 1e-12)[alive & (promised < np.inf)].all()
        promised, seen = may, seen | set(status[alive, 0])
    assert alive.sum() > 40  # the others start where nothing can be held
    assert np.abs(x[alive]).max() < 1e-3
    assert seen >= ({TAKEN, KEPT} if name == "now and then" else {KEPT})


def test_a_policy_that_is_well_acts_itself():
    """LQR of held controls is; that of continuous time costs a little more, and is taken later."""
    ocp, x0 = mass(), np.array([[0.3, 0.0], [0.1, 0.2]])
    _, _, _, K = held_lqr()
    run = nocl.simulate(ocp, guarded(ocp, lambda x: -ca.mtimes(K, x)), x0, duration=6.0)
    plain = nocl.simulate(ocp, lambda x, t: -x @ K.T, x0, duration=6.0, hold=60)
    assert (run.fallbacks == 0).all()
    np.testing.assert_allclose(run.u, plain.u, atol=1e-9)
    other = nocl.simulate(ocp, Safeguard(ocp, LQR(ocp.unconstrained), dt=DT, steps=30), x0, duration=6.0)
    assert (other.fallbacks < 12).all()
    assert (other.cost <= 1.01 * plain.cost).all()


def test_where_there_is_no_plan_it_says_so():
    """A mass that cannot stop before the wall; the one that is pushed asks again."""
    ocp = mass()
    safe = guarded(ocp, SABOTAGE["stuck"])
    run = nocl.simulate(ocp, safe, np.array([[0.0, -0.9], [1.0, 0.0]]), duration=4.0)
    assert run.lost[0] > 0
    assert run.lost[1] == 0
    assert not run.success[0]
    assert run.success[1]
    pushed = nocl.simulate(ocp, safe, np.array([[1.0, 0.0]]), duration=8.0, kicks=[(1.0, [0.3, 0.2])])
    assert pushed.success.all()
    assert pushed.lost[0] == 0


# the same in numpy, CasADi and C


def restated(x, plan, answer, N, terminal):
    """One step on the mass in plain numpy: (u, next, status)."""
    def moved(x, a, n=2):
        """RK4 by its stages, the cost by the same ones."""
        cost, h = 0.0, DT / n
        for _ in range(n):
            k, at = [], [x]
            for reach in (h / 2, h / 2, h, None):
                k.append(np.array([at[-1][1], a]))
                if reach is not None:
                    at.append(x + reach * k[-1])
            L = [z[0]**2 + 0.1 * z[1]**2 + 0.1 * a**2 for z in at]
            cost += h / 6 * (L[0] + 2 * L[1] + 2 * L[2] + L[3])
            x = x + h / 6 * (k[0] + 2 * k[1] + 2 * k[2] + k[3])
        return x, cost

    def rows(x, a, n=2):
        """Bernstein coefficients of the wall and of both bounds of the speed over both halves."""
        for h in [DT / n] * n:
            end = np.array([x[0] + h * x[1] + h**2 / 2 * a, x[1] + h * a])
            for (c, slope), (c_end, slope_end) in zip(lines(x, a), lines(end, a), strict=True):
                yield from (c + h / 3 * slope, c_end - h / 3 * slope_end, c_end)
            x = end

    def lines(x, a):
        return (x[0] - WALL, x[1]), (x[1] + FAST, a), (FAST - x[1], -a)

    def rolled(law, margin):
        z, cost, off, us = x, [], 0.0, []
        for k in range(N):
            a = law(k, z)
            off += sum(max(margin - c, 0.0) for c in rows(z, a))
            z, paid = moved(z, a)
            us, cost = [*us, a], [*cost, paid]
        first, cost = cost[0], sum(cost)
        V = FACTOR * z @ terminal.P @ z / 2
        return us, first, cost + V, off + max(V / (FACTOR * terminal.level) - 1, 0.0)

    left, budget, held = plan[0], plan[1], plan[2:]
    new = rolled(lambda k, z: answer(z), MARGIN)
    last = rolled(lambda k, z: held[k] if k < left else np.clip(-terminal.K @ z, -2, 2)[0], 0.0)
    taken = new[3] <= 0 and (last[3] > 0 or new[2] <= max(budget, last[2]))
    taken |= new[3] > 0 and last[3] > 0 and new[3] < last[3]
    none = new[3] > 0 and last[3] > 0
    us, first, cost, _ = new if taken else last
    may = 0.0 if none else (cost if taken else max(budget, cost)) - first
    following = np.r_[max((N if taken else left) - 1, 0), may, us[1:], 0.0]
    return us[0], following, NONE if none else TAKEN if taken else KEPT


def test_numpy_casadi_and_c_agree(tmp_path):
    ocp, N = mass(), 30

    def cautious(x, low=ca.fmax, high=ca.fmin, sin=ca.sin):
        """Drives at no more than 0.8; as CasADi or numpy."""
        a = 4 * (-low(high(1.2 * x[0], 0.8), -0.8) - x[1]) + 0.05 * sin(40 * x[0])
        return low(high(a, 2), -2)

    def rough(x):
        return cautious(x, np.maximum, np.minimum, np.sin)

    safe = Safeguard(ocp, policy(cautious), dt=DT, steps=N, margin=MARGIN)
    assert safe.steps.motion.substeps == 2
    assert safe.steps.between < 1e-12
    compiled = c_code.load(safe.to_c(tmp_path))
    assert "calloc" not in (tmp_path / "mass_safeguard_casadi.c").read_text()
    x, seen = np.random.default_rng(5).uniform([0.1, -0.5], [1.6, 0.5], (8, 2)), set()
    plan = np.zeros((8, safe.steps.size))
    for k in range(25):
        answers = [part.full().T for part in safe.step(x.T, plan.T)]
        np.testing.assert_allclose(safe(x, DT * k), answers[0], rtol=0, atol=0)
        for i, (a, following, status) in enumerate(zip(*answers, strict=True)):
            for said in (compiled(x[i], plan[i]), restated(x[i], plan[i], rough, N, safe.terminal)):
                np.testing.assert_allclose(said[0], a[0], rtol=0, atol=1e-12)
                np.testing.assert_allclose(said[1], following, rtol=0, atol=1e-12)
                assert said[2] == status[0]
            seen.add(status[0])
        x, plan = safe.steps.motion.function(x.T, answers[0].T)[0].full().T, answers[1]
    assert seen >= {TAKEN, KEPT}


def test_c_without_a_plan_has_a_status(tmp_path):
    safe = guarded(mass(), SABOTAGE["stuck"])
    compiled = c_code.load(safe.to_c(tmp_path))
    _, _, status = compiled([0.0, -0.9], np.zeros(safe.steps.size))
    assert status == NONE
    text = (tmp_path / "mass_safeguard.h").read_text()
    assert "2: neither is admissible" in text
    assert "The first plan is of zeros" in text


# the judge, laws, refusals


def test_rows_of_a_comparison_count_what_the_safeguard_did():
    ocp = mass()
    safe, x0 = guarded(ocp, SABOTAGE["NaN"]), np.array([[1.0, 0.0], [0.4, 0.1]])
    rows = compare(ocp.lasting(3.0), {"safe": safe, "LQR": LQR(ocp.unconstrained)}, x0=x0).rows()
    assert [row["fallbacks"] for row in rows if row["method"] == "safe"] == [30, 30]
    assert [row["lost"] for row in rows if row["method"] == "safe"] == [0, 0]
    assert all(np.isnan(row["fallbacks"]) for row in rows if row["method"] == "LQR")


def test_a_law_takes_constraints_that_it_was_not_trained_with():
    ocp = mass()
    at, y = ocp.functions.feedback(), ca.SX.sym("y", 1)
    law = nocl.CND(ocp.unconstrained, FeatureNet(at.function("phi", {"phi": at["x"]}), [MLP([2, 8, 1])],
                                                 at.function("controls", {"u": y}, y=y)))
    safe = law.safeguarded(ocp, dt=DT, steps=30)
    run = nocl.simulate(ocp, safe, np.array([[1.0, 0.0]]), duration=6.0)
    assert run.success.all()
    assert "wall" in safe.ocp.constraint_names
    assert not law.safeguarded(dt=DT).ocp.constraint_names
    with pytest.raises(ValueError, match="expected dt"):
        law.safeguarded()
    law.card["arrives_in"] = 4.0  # as training says
    assert law.safeguarded(steps=20).control_dt == 0.2


@pytest.mark.parametrize(("make", "words"), [
    (lambda: guarded(mass(horizon=2.0, terminal=p**2), wild), "horizon of the problem on 'mass' is 2.0.*INFINITE"),
    (lambda: guarded(mass(constraints={"line": (0, p + v, 0)}, scales={}), wild), r"equations line.*without\('line'\)"),
    (lambda: Safeguard(mass(), lambda x, t: x[:, :1], dt=DT), "expected a casadi.Function"),
    (lambda: guarded(mass(constraints={"wall": p}), wild), "constraint 'wall' holds by 0 of its scale"),
    (lambda: Safeguard(mass(constraints={"w": (-1.5e-3, p, 1.5e-3)}, scales={"w": 1.0}), policy(wild), dt=DT),
     "holds by 0.0015 of its scale; expected more than 0.002"),
    (lambda: guarded(mass(running=p**2 + 0.1 * v**2 + 0.1 * u**2 + 0.3 * u), wild), "the gradient of L is 0.3 in u"),
    (lambda: guarded(mass(running=u**2 + v**2), wild), "a cost that does not see a state"),
    (lambda: guarded(mass(), wild, dt=0.0), "dt is 0.0"), (lambda: guarded(mass(), wild, steps=0), "steps is 0"),
    (lambda: nocl.simulate(mass(), guarded(mass(), wild), [1.0, 0.0], duration=3.05), "does not fit into 3.05"),
    (lambda: nocl.simulate(mass(), guarded(mass(), wild), [1.0, 0.0], duration=3.0, hold=20), "next sample")])
def test_what_a_safeguard_does_not_take(make, words):
    with pytest.raises(ValueError, match=words):
        make()


def test_steps_that_are_too_long_are_refused():
    fast = nocl.System("fast", x=p, u=u, xdot=-900 * p + u, lbu=[-1], ubu=[1], lbx=[-1], ubx=[1])
    ocp = nocl.OCP(fast, horizon=nocl.INFINITE, running=p**2 + u**2, x_goal=[0], u_goal=[0],
                   initial_states=nocl.Gaussian([0.5], [0.1]))
    with pytest.raises(ValueError, match="hold them for a shorter time dt"):
        Motion.of(ocp, 1.0)


def test_between_samples_a_row_is_no_less_than_what_is_held_of_it():
    """Of a pendulum's speed and energy, by fine steps."""
    ocp = pendulum(constraints={"energy": 20 - v**2 / 2 - 9.81 * ca.cos(p)}, state_bounds={"v": (-7, 7)})
    motion, rng = Motion.of(ocp, 0.3), np.random.default_rng(7)
    assert 0 < motion.between < 1e-5
    x, a = rng.uniform([-4, -6], [4, 6], (300, 2)).T, rng.uniform(-5, 5, (1, 300))
    said, step, path = motion._least(x, a), ocp.functions.step(soft=False), [x]
    for _ in range(100):
        path.append(step(path[-1], a, 0.3 / 100)[0].full())
    true = np.min([ocp.functions.c(z, a).full() for z in path], axis=0)
    assert (said <= true + motion.between).all()
    assert (true - said).max() < 0.05  # and not much less
