"""Progress without a terminal, and budgets: by a clock of the tests' own."""

import io
import sys

import pytest

import nocl
from nocl.solvers.cnd.training import Training
from nocl.support import progress
from nocl.support.budget import Budget
from nocl.support.progress import EVERY, Log, Stage, in_words


class Clock:
    def __init__(self):
        self.now = 100.0

    def __call__(self):
        return self.now


@pytest.fixture
def log():
    lines, clock = [], Clock()
    return Log(clock, lines.append, beats=False), clock, lines


def test_a_line_at_least_every_ten_seconds_with_done_total_and_time_left(log):
    log, clock, lines = log
    written = []
    with Stage(log, "labels", 20) as stage:
        for k in range(20):
            clock.now += 3
            stage.set_postfix_str(f"cold start {k + 1}")
            stage.update()
            written += [clock.now] * (len(lines) - len(written))
    assert max(b - a for a, b in zip([100.0, *written], [*written, clock.now], strict=True)) <= EVERY + 3
    assert lines[0] == "labels: 4 of 20, cold start 4, 10 s, about 50 s left"
    assert lines[-1] == "labels: 20 of 20, cold start 20, 60 s"


def test_short_stages_one_after_the_other_are_told_too(log):
    log, clock, lines = log
    for k in range(5):
        with Stage(log, f"stage {k}", 1) as stage:
            clock.now += 4
            stage.update()
    assert [line.partition(":")[0] for line in lines] == ["stage 2"]
    clock.now += 1000  # nothing was under way
    with Stage(log, "later", 2) as stage:
        clock.now += 4
        stage.update()
    assert len(lines) == 1


def test_what_is_asked_for_holds_for_work_within():
    assert progress.shown(None)
    with progress.within(False):
        assert not progress.shown(None)
        assert progress.shown(True)
        with progress.within(None):
            assert not progress.shown(None)
        with progress.within(True):
            assert progress.shown(None)
        assert not progress.shown(None)
    assert progress.shown(None)


@pytest.mark.parametrize("asked", [True, False])
def test_solves_within_a_training_say_what_it_says(asked, monkeypatch):
    seen = []
    monkeypatch.setattr(Training, "_run", lambda self: seen.append(progress.shown(None)))
    nocl.train(nocl.load_ocp("double_integrator"), progress=asked)
    assert seen == [asked]


def test_a_line_has_all_stages_the_outermost_first(log):
    log, clock, lines = log
    with Stage(log, "labels", 4) as outer:
        outer.update()
        with Stage(log, "DDP", 8, unit="state") as inner:
            clock.now += 12
            inner.update(4)
    assert lines[0] == "labels: 1 of 4, 10 s, about 40 s left; DDP: 4 of 8 state, 10 s, about 10 s left"
    assert not log.stages


def test_a_thread_tells_of_a_stage_that_says_nothing(monkeypatch):
    """Its clock alone is quick: ten seconds are over at once."""
    from threading import Event

    told, clock = Event(), Clock()
    log = Log(clock, lambda _: told.set())
    with Stage(log, "one long solve", 1):
        clock.now += 11
        assert told.wait(30)


@pytest.mark.parametrize(("seconds", "said"), [(0.4, "0 s"), (8.2, "8 s"), (43, "40 s"), (89, "90 s"), (170, "2.8 min"),
                                               (1500, "25 min"), (9000, "2.5 h")])
def test_times_in_words(seconds, said):
    assert in_words(seconds) == said


def test_bars_are_for_terminals_and_lines_for_logs(monkeypatch):
    class Terminal(io.StringIO):
        def isatty(self):
            return True

    for stream, kind in ((io.StringIO(), "Stage"), (Terminal(), "tqdm")):
        monkeypatch.setattr(sys, "stderr", stream)
        with progress.bar(3, "x", None) as bar:
            assert type(bar).__name__ == kind
            bar.set_postfix_str("y")
            bar.update()
    monkeypatch.setattr(sys, "stderr", io.StringIO())
    with progress.bar(3, "x", False) as bar:
        bar.update()
    progress.say("x", False)
    assert sys.stderr.getvalue() == ""
    monkeypatch.setattr(sys, "stderr", None)
    assert not progress.shown(None)
    assert not progress.shown(True)


def test_a_budget_is_spent_with_time():
    clock = Clock()
    budget = Budget(60.0, clock, spent_before=6.0)
    assert (budget.spent, budget.left, budget.share) == (6.0, 54.0, pytest.approx(0.1))
    clock.now += 24
    part = budget.part(0.5)
    assert (part.left, part.share) == (15.0, 0.0)
    clock.now += 1000
    assert (budget.left, budget.share, part.share) == (0.0, 1.0, 1.0)
    endless = Budget(clock=clock)
    assert (endless.share, endless.part(0.1).left, endless.limited) == (0.0, float("inf"), False)
