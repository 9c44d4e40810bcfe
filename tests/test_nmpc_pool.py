"""Many states: the same solutions here, in processes and on a cluster; an interrupted run resumes, nothing twice."""

import json
import os
import signal
import subprocess
import sys
import time
from contextlib import contextmanager

import numpy as np
import pytest

import nocl
from nocl.solvers import NMPC
from nocl.support import pool as pools
from nocl.support.pool import Journal, Pool

FIELDS = ("cost", "x", "u", "costate", "starts", "hits", "iterations", "success")


def problem():
    ocp = nocl.load_ocp("pendulum")
    return NMPC(ocp, 20, starts=3, passes=2), ocp.initial_states.sample(12, 0)


def assert_same(a, b):
    for name in FIELDS:
        assert np.array_equal(getattr(a, name), getattr(b, name), equal_nan=name not in ("success",)), name
    assert a.message.tolist() == b.message.tolist()
    assert np.array_equal(a.tried, b.tried, equal_nan=True)


def test_processes_give_what_one_does():
    nmpc, x0 = problem()
    assert_same(nmpc.solve(x0, workers=2), nmpc.solve(x0, workers=1))


def test_guesses_and_learned_dynamics_travel_to_processes():
    import casadi as ca

    nmpc, x0 = problem()
    x, u = ca.MX.sym("x", 2), ca.MX.sym("u", 1)
    f = ca.Function("f", [x, u], [nmpc.ocp.system.f(x, u)])
    learned = NMPC(nmpc.ocp, 20, dynamics=f, terminal=ca.Function("V", [x], [ca.sumsqr(x)]))
    guess = nmpc.solve(x0, starts=1)
    assert_same(learned.solve(x0, guess, workers=2), learned.solve(x0, guess, workers=1))


@pytest.mark.parametrize(("cores", "expected"), [(1, 0), (8, 1)])
def test_auto_takes_processes_where_they_pay(monkeypatch, cores, expected):
    """Slow tasks on eight cores go to processes; with one core, or where tasks are quick, they stay here."""
    used = []

    class Job:
        seconds = 0.02

        def build(self):
            pass

        def __call__(self, task):
            time.sleep(self.seconds)
            return task

    monkeypatch.setattr(pools, "cores", lambda: cores)
    monkeypatch.setattr(pools, "START", 0.0)
    monkeypatch.setattr(pools, "WORTH", 0.1)
    monkeypatch.setattr(pools, "_in_processes", lambda k, job, tasks: used.append(k) or map(job, tasks))
    assert list(Pool("auto").outcomes(Job(), range(30))) == list(range(30))
    assert len(used) == expected
    Job.seconds = 0.0
    assert list(Pool("auto").outcomes(Job(), range(30))) == list(range(30))
    assert len(used) == expected


def test_an_interrupted_run_resumes(tmp_path, monkeypatch):
    """What was done is read, not done again; the result is that of a run in one go."""
    nmpc, x0 = problem()
    whole = nmpc.solve(x0)
    done = []
    write = Journal.write

    def interrupted(self, outcome):
        write(self, outcome)
        done.append(outcome.name)
        if len(done) == 17:
            raise KeyboardInterrupt

    with monkeypatch.context() as m:
        m.setattr(Journal, "write", interrupted)
        with pytest.raises(KeyboardInterrupt):
            nmpc.solve(x0, out=tmp_path / "run")
    first, done[:] = list(done), []
    with monkeypatch.context() as m:
        m.setattr(Journal, "write", lambda self, outcome: (write(self, outcome), done.append(outcome.name)))
        resumed = nmpc.solve(x0, out=tmp_path / "run")
    assert len(first) == 17
    assert not set(first) & set(done)
    assert_same(resumed, whole)
    assert resumed.seconds.sum() > 0
    again = nmpc.solve(x0, out=tmp_path / "run")
    assert (again.seconds == resumed.seconds).all()  # nothing was solved again


def test_failed_states_resume_too(tmp_path):
    from test_nmpc import walled

    nmpc, x0 = NMPC(walled(u_max=0.1), 15, starts=2), [[1.0, -3.0], [1.0, 0.0], [-0.7, 0.0]]
    first = nmpc.solve(x0, out=tmp_path / "run")
    assert_same(nmpc.solve(x0, out=tmp_path / "run"), first)
    assert first.success.tolist() == [False, True, False]


def test_files_are_data_only_and_another_run_is_refused(tmp_path):
    nmpc, x0 = problem()
    nmpc.solve(x0[:3], out=tmp_path / "run")
    assert json.loads((tmp_path / "run" / "manifest.json").read_text())["kind"] == "nocl NMPC run"
    for file in (tmp_path / "run" / "tasks").iterdir():
        with np.load(file, allow_pickle=False) as data:
            assert all(data[name].dtype.kind in "fiubU" for name in data.files)
    with pytest.raises(ValueError, match="another run"):
        nmpc.solve(x0[:4], out=tmp_path / "run")
    with pytest.raises(ValueError, match="another run"):
        NMPC(nmpc.ocp, 21).solve(x0[:3], out=tmp_path / "run")
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "thesis.tex").write_text("mine")
    with pytest.raises(ValueError, match="not empty"):
        nmpc.solve(x0[:3], out=tmp_path / "full")
    assert [p.name for p in (tmp_path / "full").iterdir()] == ["thesis.tex"]


@pytest.mark.parametrize("workers", [0, -1, True, 1.5, "two", None])
def test_bad_workers(workers):
    nmpc, x0 = problem()
    with pytest.raises(ValueError, match="workers is"):
        nmpc.solve(x0, workers=workers)


def start(*command):
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    return subprocess.Popen([sys.executable, "-m", *command], env=environment, stdout=subprocess.DEVNULL,
                            stderr=subprocess.DEVNULL)


@contextmanager
def dask_cluster(folder):
    """A real scheduler and two worker processes: (address, [scheduler, worker, worker])."""
    distributed = pytest.importorskip("distributed")
    contact = folder / "scheduler.json"
    processes = [start("distributed.cli.dask_scheduler", "--port", "0", "--host", "127.0.0.1", "--no-dashboard",
                       "--scheduler-file", str(contact))]
    try:
        deadline = time.monotonic() + 60
        while not contact.exists() and time.monotonic() < deadline:
            time.sleep(0.2)
        address = json.loads(contact.read_text())["address"]
        processes += [start("distributed.cli.dask_worker", address, "--nthreads", "1", "--no-nanny", "--no-dashboard",
                            "--local-directory", str(folder / f"worker{i}")) for i in range(2)]
        with distributed.Client(address, set_as_default=False) as client:
            client.wait_for_workers(2, timeout=90)
        yield address, processes
    finally:
        for process in processes[::-1]:
            process.terminate()
            try:
                process.wait(10)
            except subprocess.TimeoutExpired:  # a worker whose scheduler is gone goes on looking for it
                process.kill()


@pytest.mark.slow
def test_a_dask_worker_killed_in_the_middle_loses_nothing(tmp_path, monkeypatch):
    """One of two is killed after a few outcomes have come in."""
    nmpc = NMPC(nocl.load_ocp("cartpole"), 40, starts=6, passes=2)
    x0, written, write = nmpc.ocp.initial_states.sample(48, 0), [], Journal.write
    with dask_cluster(tmp_path) as (address, processes):

        def killing(self, outcome):
            write(self, outcome)
            written.append(outcome.name)
            if len(written) == 9:
                processes[1].send_signal(signal.SIGKILL)

        monkeypatch.setattr(Journal, "write", killing)
        solution = nmpc.solve(x0, workers=address, out=tmp_path / "run")
        assert processes[1].wait(10) == -signal.SIGKILL
    assert len(written) == len(set(written))
    assert {f"start-{i:06d}" for i in range(48)} <= set(written)
    assert_same(solution, nmpc.solve(x0, workers=1))
    assert solution.success.all()


def test_no_scheduler_is_one_clear_error(monkeypatch):
    pytest.importorskip("distributed")
    monkeypatch.setattr(pools, "CONNECT", 0.5)
    nmpc, x0 = problem()
    with pytest.raises(ValueError, match=r"no Dask scheduler answers at tcp://127\.0\.0\.1:9"):
        nmpc.solve(x0[:2], workers="tcp://127.0.0.1:9")


@pytest.mark.slow
def test_a_cluster_without_workers_says_so_and_how_long_it_waited(tmp_path, monkeypatch):
    monkeypatch.setattr(pools, "CONNECT", 2.0)
    with dask_cluster(tmp_path) as (address, processes):
        for worker in processes[1:]:
            worker.terminate()
            worker.wait(30)
        with pytest.raises(ValueError, match=r"has no workers, and none joined within 2 s: start some with `dask wor"):
            list(pools.Pool(address).outcomes(time.sleep, [np.float64(0.0)]))


@pytest.mark.slow
@pytest.mark.parametrize(("lost", "match"), [(slice(1, 3), "all workers .* were lost"), (slice(0, 1), "was lost")])
def test_a_cluster_that_is_lost_in_the_middle_is_one_clear_error(tmp_path, monkeypatch, lost, match):
    monkeypatch.setattr(pools, "CONNECT", 3.0)
    with dask_cluster(tmp_path) as (address, processes):
        naps = [np.float64(seconds) for seconds in (*[0.0] * pools.CHUNK, *[60.0] * 8)]
        outcomes = pools.Pool(address).outcomes(time.sleep, naps)
        next(outcomes)
        for process in processes[lost]:
            process.kill()
            process.wait(30)
        with pytest.raises(ValueError, match=match):
            list(outcomes)


def own(task):
    """A job of this file, which no worker can import."""
    return task


@pytest.mark.slow
def test_a_worker_that_cannot_import_says_so(tmp_path):
    with dask_cluster(tmp_path) as (address, _), pytest.raises(ValueError, match="cannot import what it needs"):
        list(pools.Pool(address).outcomes(own, [np.float64(0.0)]))
