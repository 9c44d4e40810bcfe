"""Training that fits a budget, and rounds that no longer pay: by a clock of the tests' own."""

import importlib
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

import nocl
from nocl.solvers.cnd import TrainSettings
from nocl.solvers.cnd.plan import SCALED, Costs, Kind, Plan, iterations, measured, missed_by, stages, stalled
from nocl.solvers.cnd.regression.in_torch import InTorch
from nocl.solvers.cnd.regression.regress import LEAST, fit_net
from nocl.solvers.cnd.validate import Finer, floored_by, labels_gap, solved_again
from nocl.solvers.ddp.solver import DDP
from nocl.support.budget import Budget
from nocl.sysid import fitting

module = importlib.import_module("nocl.solvers.cnd.training")
NORMAL = TrainSettings()
TINY = TrainSettings(intervals=20, seeds=4, starts=2, states=10, tails=40, visits=20, rounds=2, iterations=30, batch=64,
                     hidden=(8,), value_initial=10, value_tails=40, value_visits=10, value_iterations=20,
                     value_rounds=1, held_out=4, gap_median=1e-9)
MACHINE = Costs(cold=0.02, tail=0.003, fine=0.02, roll=0.002, step=0.003, value_step=0.002)


class Clock:
    def __init__(self):
        self.now = 0.0

    def __call__(self):
        return self.now


def trained(minutes, slow=1.0, costs=MACHINE, settings=NORMAL):
    """(seconds, stages that were done with their settings or iterations) of a training on a machine whose solves take
    `slow` times as long as was measured; the goals are never met."""
    clock, done = Clock(), []
    plan = Plan(replace(settings, minutes=minutes), costs, Budget(60 * minutes, clock))

    def solve(name, number=0):
        s = plan.within(name, number)
        took = slow * costs.of((name, number), s, Kind())
        clock.now += took
        plan.took(name, number, s, took)
        done.append(((name, number), s))

    def fit(name, number):
        time, step = plan.time(name, number), costs.step if name == "controller" else costs.value_step
        count = min(iterations((name, number), settings), max(int(time.left / step), LEAST))
        clock.now += count * step
        done.append(((name, number), count))

    solve("labels")
    number = 0
    while number <= settings.rounds and (not number or plan.another(number)):
        if number:
            solve("visits", number)
        fit("controller", number)
        solve("check", number)
        number += 1
    solve("value check")
    for attempt in range(settings.value_rounds):
        if attempt and not plan.another_value(attempt):
            break
        solve("value labels", attempt)
        fit("value fit", attempt)
    return clock.now, done


@pytest.mark.parametrize("slow", [0.4, 1.0, 2.5])
@pytest.mark.parametrize("minutes", [1.0, 2.0, 5.0, 10.0])
def test_a_budget_is_kept_to_within_a_fifth_whatever_the_machine_does(minutes, slow):
    seconds, _ = trained(minutes, slow)
    assert seconds <= 1.2 * 60 * minutes
    assert seconds >= min(0.6 * 60 * minutes, trained(1000.0, slow)[0] - 1)


def test_with_time_enough_nothing_is_left_out():
    seconds, done = trained(1000.0)
    assert [stage for stage, _ in done] == list(stages(NORMAL, NORMAL.rounds, NORMAL.value_rounds))
    assert all(s == replace(NORMAL, minutes=1000.0) for (name, _), s in done if name in SCALED)
    assert seconds == pytest.approx(Plan(NORMAL, MACHINE).seconds[1])


def test_less_time_is_fewer_rounds_and_fewer_solves():
    rounds = [max(number for (name, number), _ in trained(minutes)[1] if name == "controller")
              for minutes in (0.5, 2.0, 5.0, 20.0)]
    assert rounds == sorted(rounds)
    assert rounds[0] < rounds[-1] == NORMAL.rounds
    tails = [trained(minutes)[1][0][1].tails for minutes in (0.5, 1.0, 5.0)]
    assert tails == sorted(tails)
    assert tails[0] < NORMAL.tails


def test_without_measurements_a_budget_still_ends_fits():
    plan = Plan(replace(NORMAL, minutes=1.0), None, Budget(60.0, Clock()))
    assert plan.within("labels").seeds == 4
    assert plan.time("controller", 0).left < 60.0
    assert "no estimate" in str(plan)


def test_what_the_estimate_says():
    assert str(Plan(NORMAL, MACHINE)).startswith("about ")
    assert "up to" in str(Plan(NORMAL, MACHINE))
    assert "; to end within 5 min" in str(Plan(NORMAL, MACHINE, Budget(300.0, Clock())))


def test_a_fit_ends_with_its_budget_at_the_end_of_its_schedule():
    """100 of 1000 iterations' time: the rate has fallen to that of the last iteration by then."""
    clock, rates = Clock(), []
    net = torch.nn.Linear(1, 1)

    def loss(rows):
        clock.now += 1.0
        return (net.weight - 1.0).square().sum()

    def report(_):
        rates.append(float(net.weight.detach()))

    fit_net(net, loss, 10, iterations=1000, batch=4, lr=1e-2, seed=0, report=report, budget=Budget(100.0, clock))
    assert len(rates) == 100
    steps = np.abs(np.diff(rates))
    assert steps[-1] < 0.1 * steps.max()
    rates.clear()
    fit_net(net, loss, 10, iterations=1000, batch=4, lr=1e-2, seed=0, report=report, budget=Budget(1.0, clock))
    assert len(rates) == LEAST


def test_fits_of_dynamics_end_with_their_budget():
    clock, counted = Clock(), []
    w = torch.ones(3, requires_grad=True)

    def value_and_gradients():
        clock.now += 1.0
        return float(w.detach().square().sum()), [2 * w.detach()]

    fitting.soap_steps([w], value_and_gradients, iterations=500, lr=1e-2, report=counted.append,
                       budget=Budget(80.0, clock))
    assert len(counted) == 80


def row(median, p95=1e-9, **more):
    return {"gap_median": median, "gap_p95": p95, **more}


@pytest.mark.parametrize(("medians", "ends"), [
    ((1.2e-2, 1.19e-2, 1.185e-2), True),  # floored at 1.2 %
    ((1.2e-2, 1.19e-2), False),  # one round tells nothing
    ((1.2e-2, 1.19e-2, 0.9e-2), False), ((1.2e-2, 0.9e-2, 0.89e-2), False),
    ((3e-4, 2.9e-4, 2.85e-4), True),  # a twentieth of the goal each
    ((np.inf, np.inf, np.inf), False)])  # it blows up: anything may still happen
def test_training_ends_where_two_rounds_in_a_row_do_not_pay(medians, ends):
    assert stalled([row(median) for median in medians], NORMAL) is ends


def test_a_goal_of_several_that_still_comes_nearer_is_worth_a_round():
    assert not stalled([row(1e-2, 1e-1), row(1e-2, 5e-2), row(1e-2, 2e-2)], NORMAL)
    assert not stalled([row(1e-2, gap_violating=v) for v in (0.5, 0.3, 0.1)], NORMAL)


def test_a_round_that_violates_is_no_better_than_one_that_does_not():
    s = NORMAL
    assert missed_by(row(1e-4, 1e-4), s) <= 1 < missed_by(row(1e-2, 1e-4), s)
    assert missed_by(row(1.0, 1.0, gap_violating=0.0), s) < missed_by(row(1e-4, 1e-4, gap_violating=0.2), s)
    assert missed_by(row(np.inf), s) == np.inf


def test_labels_followed_as_feedback_lose_by_the_square_of_their_interval():
    """Plans of held controls, on the double integrator: a coarse grid's floor falls with h^2 or faster."""
    ocp = nocl.load_ocp("double_integrator")
    x0, fine = ocp.initial_states.sample(6, 3), DDP(ocp, intervals=160, threads=1)
    best, lost = fine.solve(x0, progress=False), []
    for intervals in (5, 10, 20):
        labels = DDP(ocp, intervals=intervals, threads=1).solve(x0, progress=False)
        assert solved_again(fine, labels).cost == pytest.approx(best.cost)
        lost.append(np.median(labels_gap(InTorch(ocp), labels, best)))
    assert lost[0] > 3 * lost[1] > 9 * abs(lost[2])
    assert abs(lost[2]) < 1e-3


def test_plans_whose_open_loop_runs_away_are_refined_as_feedback():
    """An unstable reactor: of its plans on 80 intervals most, held on 320, end in an explosion, and no descent."""
    ocp = nocl.load_ocp(Path(__file__).resolve().parents[1] / "examples" / "exothermic_reactor.py")
    labels = DDP(ocp, intervals=80, substeps=1, threads=1).solve(ocp.initial_states.sample(24, 5), progress=False)
    labels, fine = labels[labels.success], DDP(ocp, intervals=320, substeps=1, threads=1)
    found = solved_again(fine, labels)
    assert (found.success & (found.cost <= labels.cost)).sum() >= len(labels) - 2
    held = fine.solve(labels.x[:, 0], u=np.repeat(labels.u, 4, axis=1), progress=False)
    assert held.success.sum() < len(labels) - 4


def test_margins_are_left_behind_on_the_way_to_the_fine_grid():
    ocp = nocl.load_ocp(Path(__file__).resolve().parents[1] / "examples" / "epidemic.py")
    plain, fine = DDP(ocp, intervals=40, threads=1, constraints="elastic"), DDP(ocp, intervals=160, threads=1)
    inside = plain.inside(np.full(len(plain.rows.stage), 0.02)).solve(ocp.initial_states.sample(4, 5), progress=False)
    assert inside.success.all()
    bare = Finer(fine, plain).without_margins(inside)
    assert (bare.cost < 0.99 * inside.cost).all()
    found, straight = solved_again(Finer(fine, plain), inside), solved_again(fine, inside)
    assert found.cost == pytest.approx(straight.cost, rel=1e-7)
    assert (found.iterations < 0.7 * straight.iterations).all()


def test_what_floors_the_gap_is_named():
    last = {**row(1.2e-2), "loss": [1e-4]}
    assert "on 80 intervals, cost 1.1 % more" in floored_by(last, 1.1e-2, 80, 2e-4)
    assert "--intervals 160" in floored_by(last, 1.1e-2, 80, 2e-4)
    assert "keep margins inside the constraints, which cost 1 %" in floored_by(last, 1.1e-2, 80, 2e-4, 1e-3)
    assert "on 80 intervals" in floored_by(last, 1.1e-2, 80, 2e-4, 1e-2)
    assert "misses its own labels" in floored_by({**last, "loss": [1e-2]}, 1e-5, 80, 2e-4)
    assert "do not cover" in floored_by(last, 1e-5, 80, 2e-4)
    assert "several kinds" in floored_by({**row(1e-4, 0.5), "loss": [1e-2]}, 1e-5, 80, 2e-4)


def test_measuring_draws_and_counts_nothing_that_training_does():
    ocp = nocl.load_ocp("double_integrator")
    ddp, fine = DDP(ocp, intervals=20), DDP(ocp, intervals=80)
    ddp.solve(ocp.initial_states.sample(2, 0), progress=False)
    before, numbers = dict(ddp.evaluations), torch.random.get_rng_state()
    costs = measured(ocp, ddp, fine, InTorch(ocp), TINY)
    assert dict(ddp.evaluations) == before
    assert not fine.evaluations
    assert torch.equal(torch.random.get_rng_state(), numbers)
    assert min(vars(costs).values()) > 0


def test_a_training_on_a_budget_returns_the_best_so_far_and_says_so(monkeypatch):
    """A clock that ticks whenever it is asked: the budget is over in the first round."""
    clock = Clock()

    def tick():
        clock.now += 0.1
        return clock.now

    monkeypatch.setattr(module, "Budget", partial(Budget, clock=tick))
    monkeypatch.setattr(module, "time", SimpleNamespace(monotonic=tick, perf_counter=tick, process_time=tick))
    monkeypatch.setattr(module, "measured", lambda *_: MACHINE)
    monkeypatch.setattr(module, "stalled", lambda *_: False)
    cnd = nocl.train(nocl.load_ocp("double_integrator"), settings=replace(TINY, rounds=30, iterations=100), minutes=2,
                     progress=False)
    assert cnd.card["minutes"] == 2
    assert cnd.card["stopped"] == "no time for a further round within 2 minutes"
    assert cnd.card["minutes_taken"] == pytest.approx(2, rel=0.2)
    gaps = [missed_by(r, TINY) for r in cnd.card["history"]]
    assert cnd.card["round"] == int(np.argmin(gaps)) < 30
    assert cnd.card["gap_median"] == cnd.card["history"][cnd.card["round"]]["gap_median"]


def test_a_training_that_no_longer_gains_ends_and_says_what_floors_it(monkeypatch, capsys):
    """LQR's optimum is learned by a network that cannot get nearer than its own few weights do."""
    ocp = nocl.load_ocp("double_integrator")
    monkeypatch.setattr(module, "summary", lambda shares, name: {f"{name}_median": 0.012, f"{name}_p95": 0.02})
    with pytest.warns(UserWarning, match="costs 1.2 % more than the optimum .* after 2 rounds"):
        cnd = nocl.train(ocp, settings=replace(TINY, rounds=9, value=False), progress=True)
    assert cnd.card["stopped"] == "the last two rounds did not pay"
    assert [r["round"] for r in cnd.card["history"]] == [0, 1, 2]
    assert cnd.card["history"][cnd.card["round"]]["floor"]["by"] in (said := capsys.readouterr().err)
    assert "double_integrator: training takes about" in said


def test_minutes_are_for_the_default_method():
    with pytest.raises(ValueError, match="minutes are for the default method"):
        nocl.train(nocl.load_ocp("double_integrator"), method="paper", minutes=1)
    with pytest.raises(ValueError, match="minutes is -1; expected a finite number > 0"):
        nocl.train(nocl.load_ocp("double_integrator"), minutes=-1)
