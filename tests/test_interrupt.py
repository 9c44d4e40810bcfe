"""Ctrl-C inside a solver of CasADi's ends the work, and is never taken for a failed solve."""

import os
import signal
import threading
from contextlib import suppress

import casadi as ca
import numpy as np
import pytest

from nocl.judge import simulate
from nocl.support.interrupt import kept
from nocl.systems import cartpole


@pytest.fixture(autouse=True)
def ctrl_c_counts():
    """Jobs in the background of a shell inherit that it is ignored."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def press():
    os.kill(os.getpid(), signal.SIGINT)


def test_it_is_raised_at_the_end_where_it_was_swallowed_and_the_handler_is_put_back():
    before, passed = signal.getsignal(signal.SIGINT), []

    def work():
        with kept():
            with suppress(KeyboardInterrupt):
                press()
            passed.append(True)

    with pytest.raises(KeyboardInterrupt):
        work()
    assert passed
    assert signal.getsignal(signal.SIGINT) is before


def test_an_error_inside_is_not_hidden():
    def work():
        with kept():
            with suppress(KeyboardInterrupt):
                press()
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        work()


def test_other_threads_are_left_alone():
    before, seen = signal.getsignal(signal.SIGINT), []

    def work():
        with kept():
            seen.append(signal.getsignal(signal.SIGINT))

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert seen == [before]


def pressed_by_the_solver(monkeypatch):
    """Ctrl-C comes the moment that a solver is called."""
    from nocl.support import interrupt

    original = interrupt.kept

    class Pressed:
        def __enter__(self):
            self.inner = original()
            self.inner.__enter__()
            with suppress(KeyboardInterrupt):  # as solvers do
                press()

        def __exit__(self, *error):
            return self.inner.__exit__(*error)

    monkeypatch.setattr(interrupt, "kept", Pressed)


def test_the_judge_stops(monkeypatch):
    ocp = cartpole.ocp()
    pressed_by_the_solver(monkeypatch)
    with pytest.raises(KeyboardInterrupt):
        simulate(ocp, np.zeros((1, 4, 1)), ocp.x_goal)


def test_it_ends_a_solver_that_is_at_work():
    """A state that turns 100,000 times a second keeps CVODES busy for minutes, inside one call."""
    x = ca.SX.sym("x", 2)
    spin = ca.integrator("spin", "cvodes", {"x": x, "ode": 1e6 * ca.vertcat(x[1], -x[0])}, 0, 1.0,
                         {"max_num_steps": 10**9, "reltol": 1e-9})
    done = []

    def work():
        with kept():
            spin(x0=[1, 0])
            done.append(True)

    timer = threading.Timer(0.5, press)
    timer.start()
    with pytest.raises(KeyboardInterrupt):
        work()
    timer.join()
    assert not done


def test_an_error_of_a_solver_is_no_ctrl_c():
    def work():
        with kept():
            raise RuntimeError

    with pytest.raises(RuntimeError):
        work()
