"""Ctrl-C inside a solver of CasADi's ends the work, and is never taken for a failed solve."""

import os
import signal
import threading

import numpy as np
import pytest

from nocl.judge import simulate
from nocl.support.interrupt import deferred
from nocl.systems import cartpole


@pytest.fixture(autouse=True)
def ctrl_c_counts():
    """Jobs in the background of a shell inherit that it is ignored."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def press():
    os.kill(os.getpid(), signal.SIGINT)


def test_it_is_raised_at_the_end_and_the_handler_is_put_back():
    before, passed = signal.getsignal(signal.SIGINT), []

    def work():
        with deferred():
            press()
            passed.append(True)

    with pytest.raises(KeyboardInterrupt):
        work()
    assert passed
    assert signal.getsignal(signal.SIGINT) is before


def test_an_error_inside_is_not_hidden():
    def work():
        with deferred():
            press()
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        work()


def test_other_threads_are_left_alone():
    before, seen = signal.getsignal(signal.SIGINT), []

    def work():
        with deferred():
            seen.append(signal.getsignal(signal.SIGINT))

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert seen == [before]


def pressed_by_the_solver(monkeypatch):
    """Ctrl-C comes the moment that a solver is called."""
    from nocl.support import interrupt

    original = interrupt.deferred

    class Pressed:
        def __enter__(self):
            self.inner = original()
            self.inner.__enter__()
            press()

        def __exit__(self, *error):
            return self.inner.__exit__(*error)

    monkeypatch.setattr(interrupt, "deferred", Pressed)


def test_the_judge_stops(monkeypatch):
    ocp = cartpole.ocp()
    pressed_by_the_solver(monkeypatch)
    with pytest.raises(KeyboardInterrupt):
        simulate(ocp, np.zeros((1, 4, 1)), ocp.x_goal)
