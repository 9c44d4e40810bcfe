"""Calls that never come back, by harmless stand-ins that sleep or end their process: others go on, nothing is lost."""

import os
import signal
import subprocess
import sys
import textwrap
import threading
import time
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

import nocl
from nocl.solvers import NMPC
from nocl.solvers.nmpc.solver import shared_program
from nocl.solvers.nmpc.transcription import Transcription
from nocl.support import guard
from nocl.support.guard import Guarded, NoAnswerError
from nocl.systems import pendulum


def twice(a):
    return 2 * a


def refuse():
    raise ValueError("expected something else")


def test_answers_and_errors_come_back():
    a = np.arange(6.0).reshape(2, 3)
    np.testing.assert_array_equal(Guarded(twice)(60.0, a), 2 * a)
    with pytest.raises(ValueError, match="expected something else"):
        Guarded(refuse)(60.0)


def test_what_does_not_come_back_is_ended_and_the_next_call_answers():
    for stuck, args, said in ((time.sleep, (3600.0,), "within 0.2 s"), (os._exit, (3,), "exit code 3"),
                              (signal.raise_signal, (signal.SIGKILL,), "SIGKILL")):
        with pytest.raises(NoAnswerError, match=said):
            Guarded(stuck)(0.2 if stuck is time.sleep else 60.0, *args)
        assert Guarded(twice)(60.0, 21) == 42


def test_ctrl_c_ends_it_at_once():
    stuck = Guarded(time.sleep)
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    timer = threading.Timer(0.3, os.kill, (os.getpid(), signal.SIGINT))
    timer.start()
    begin = time.monotonic()
    try:
        with pytest.raises(KeyboardInterrupt):
            stuck(3600.0, 3600.0)
    finally:
        signal.signal(signal.SIGINT, before)
    assert time.monotonic() - begin < 60.0  # not the hour
    assert Guarded(twice)(60.0, 1) == 2


def runs(pid):
    try:
        return "Z" not in Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2]
    except FileNotFoundError:
        return False


def test_no_copy_outlives_its_process():
    """Neither an idle one nor one that is stuck, whatever ends the process."""
    code = textwrap.dedent("""
        import sys, time
        from nocl.support import guard
        guard.Guarded(abs)(60.0, 1)
        print(guard._COPIES[0].pid, flush=True)
        if sys.argv[1] == "stuck":
            guard.Guarded(time.sleep)(3600.0, 3600.0)
        sys.stdin.read()
    """)
    for state in ("idle", "stuck"):
        process = subprocess.Popen([sys.executable, "-c", code, state], stdin=subprocess.PIPE, stdout=subprocess.PIPE,
                                   text=True)
        copy = int(process.stdout.readline())
        time.sleep(0.2)
        process.kill()
        process.wait()
        for _ in range(200):
            if not runs(copy):
                break
            time.sleep(0.05)
        else:
            pytest.fail("it lives on")


def test_threads_get_their_own_answers():
    answers = {}

    def ask(i):
        answers[i] = [Guarded(twice)(60.0, i) for _ in range(20)]

    threads = [threading.Thread(target=ask, args=(i,)) for i in range(4)]
    for t in threads:
        t.start()
    for t in threads:
        t.join()
    assert answers == {i: [2 * i] * 20 for i in range(4)}
    Guarded(twice)(60.0, 0)
    time.sleep(0.1)
    Guarded(twice)(60.0, 0)
    assert len(guard._COPIES) == 1  # those of the threads went with them


def test_a_copy_is_ended_while_another_thread_asks_whether_it_lives(monkeypatch):
    """Its pipe is closed, so it ends by itself too; where somebody waits for it before the kill, its number is gone."""
    Guarded(twice)(60.0, 0)
    copy, kill = guard._COPIES[-1], os.kill

    def later(pid, number):
        time.sleep(0.2)
        other = threading.Thread(target=copy.lives)
        other.start()
        time.sleep(0.2)
        kill(pid, number)

    monkeypatch.setattr(guard.os, "kill", later)
    copy.end()
    assert not copy.lives()


def test_a_copy_that_inherits_a_locked_lock_is_made_anew():
    """As a fork beside threads may, which catches one of them inside a library."""
    lock = threading.Lock()

    def locked(x):
        with lock:
            return 2 * x

    lock.acquire()
    timer = threading.Timer(0.3, lock.release)
    timer.start()
    assert Guarded(locked, lambda: locked(0))(60.0, 21) == 42
    timer.join()


@pytest.fixture
def stuck_from(monkeypatch):
    """NMPC's fatrop sleeps where the guess begins beyond `limit` in the first state."""
    def make(limit, backends=("fatrop",)):
        original = Transcription._solve

        def solve(self, x0, t, x, u, p, *more):
            if self.backend in backends and x0[0] > limit:
                time.sleep(3600.0)
            return original(self, x0, t, x, u, p, *more)

        monkeypatch.setattr(Transcription, "_solve", solve)
        shared_program.cache_clear()

    yield make
    shared_program.cache_clear()


def test_a_state_whose_solver_is_stuck_gets_ipopts_answer(stuck_from):
    ocp = pendulum.ocp()
    x0 = np.array([[3.0, 0.0], [3.2, 0.1], [3.1, 0.0]])
    right = NMPC(ocp, 20, starts=1, passes=0).solve(x0, workers=1)
    stuck_from(3.15)
    solution = NMPC(ocp, 20, starts=1, passes=0, time_limit=0.5).solve(x0, workers=1)
    assert solution.success.all()
    np.testing.assert_allclose(solution.cost, right.cost, rtol=1e-6)
    assert "by IPOPT after fatrop: fatrop was given up: it did not come back within 0.5 s" in solution.message[1]


def test_an_error_of_the_library_fails_one_start_and_not_the_batch():
    ocp = pendulum.ocp()
    x0 = np.array([[3.0, 0.0], [0.0, 0.0]])
    given = {"starts": 2, "passes": 0, "options": {"error_on_fail": True, "ipopt.max_iter": 12}}
    solution = NMPC(ocp, 20, solver="ipopt", **given).solve(x0, workers=1)
    assert solution.success.tolist() == [False, True]
    assert "ipopt ended with an error: " in solution.message[0]
    assert "another solver" in solution.message[0]


def test_a_state_whose_solvers_are_stuck_fails_and_the_others_go_on(stuck_from):
    ocp = pendulum.ocp()
    x0 = np.array([[3.0, 0.0], [3.2, 0.1], [3.1, 0.0]])
    stuck_from(3.15, ("fatrop", "ipopt"))
    nmpc = NMPC(ocp, 20, starts=2, passes=1, time_limit=0.3)
    solution = nmpc.solve(x0, workers="auto")
    assert solution.success.tolist() == [True, False, True]
    assert "did not come back within 0.3 s" in solution.message[1]
    assert "time_limit" in solution.message[1]
    assert np.isinf(solution.cost[1])


def test_feedback_holds_the_last_plan_where_its_solver_is_stuck(stuck_from):
    ocp = pendulum.ocp()
    stuck_from(3.15, ("fatrop", "ipopt"))
    loop = NMPC(ocp, 20, starts=1, passes=0, time_limit=0.3).controller()
    assert np.isfinite(loop(np.array([3.1, 0.0]), 0.0)).all()
    u = loop(np.array([3.2, 0.0]), 0.15)
    assert np.isfinite(u).all()
    assert loop.failures == 1
    assert loop.stats[-1]["source"][0] == "last plan"


def test_a_time_limit_is_checked():
    for wrong in (0.0, -1.0, np.inf, np.nan, "1"):
        with pytest.raises((ValueError, TypeError), match="time_limit"):
            NMPC(pendulum.ocp(), 10, time_limit=wrong)


def test_patience_grows_with_what_solves_take():
    program = NMPC(pendulum.ocp(), 11, starts=1, passes=0).program
    assert program.patience >= 10.0
    program._took[0] = 7.0
    assert program.patience >= 140.0


def test_a_cost_that_is_not_finite_is_not_solved():
    """fatrop says "solved" where the cost is NaN on every way from the state."""
    p, v, u = ca.SX.sym("p"), ca.SX.sym("v"), ca.SX.sym("u")
    s = nocl.System("mass", x=ca.vertcat(p, v), u=u, xdot=ca.vertcat(v, u), lbu=[-1], ubu=[1], lbx=[-5, -5], ubx=[5, 5])
    ocp = nocl.OCP(s, horizon=3.0, running=u**2 + ca.log(4 + p), terminal=p**2 + v**2, x_goal=[0, 0], u_goal=[0],
                   initial_states=nocl.Gaussian([0.5, 0], [0.1, 0.1]))
    found = NMPC(ocp, 20, starts=2, passes=0).solve([-4.5, -2.0], workers=1)
    assert not found.success[0]
    assert np.isinf(found.cost[0])
    assert "not finite" in found.message[0] or "NaN" in found.message[0]
