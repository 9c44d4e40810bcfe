"""Tasks done here, in processes, or on a Dask cluster; outcomes streamed to a folder, for runs that resume.

A task has a name, unique in its run, a size (states), and `outcome(arrays)`, which gives back what an outcome's
`arrays()` kept; an outcome has name and size. Tasks, outcomes and jobs pickle.
"""

from __future__ import annotations

import io
import json
import logging
import os
import pickle
import signal
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from nocl.support.atomic import remove_parts, write_bytes
from nocl.support.checks import LARGEST, MALFORMED, shown
from nocl.support.fingerprint import sha256
from nocl.support.lock import alone
from nocl.support.progress import bar as progress_bar

Task = Any
Outcome = Any
CHUNK = 4  # tasks that a worker gets at a time, at most
PROBE = 4  # tasks done here first, to measure what one costs
START = 4.0  # seconds until the processes' first result, beyond building the solver
WORTH = 4.0  # seconds that processes must save, by measurement
CONNECT = 10.0  # seconds to wait for a scheduler, and for workers
POLL = 0.02  # seconds between two looks at what is done
LOOK = 1.0  # seconds between two looks at whether there still are workers
DIGEST = 64  # characters of SHA-256 behind an outcome: a damaged one is found again, not used
MANIFEST, TASKS = "manifest.json", "tasks"


@dataclass(frozen=True)
class Pool:
    """Where tasks are done.

    Parameters
    ----------
    workers : 1 (here), a number of processes, "auto" (processes where they pay, by the measured cost of the first
        tasks), or the address of a Dask scheduler, "tcp://..."
    """

    workers: int | str = "auto"

    def __post_init__(self) -> None:
        w = self.workers
        count = isinstance(w, (int, np.integer)) and not isinstance(w, bool) and 1 <= w <= LARGEST
        if not count and not (isinstance(w, str) and (w == "auto" or "://" in w)):
            raise ValueError(f"workers is {shown(w)}; expected a number >= 1, 'auto', or a Dask scheduler's 'tcp://...'")

    def outcomes(self, job: Any, tasks: Sequence[Task]) -> Iterator[Outcome]:
        """Each task's outcome once, in any order; `job(task)` does one, and pickles."""
        if not tasks:
            return
        if isinstance(self.workers, str) and self.workers != "auto":
            yield from _on_cluster(self.workers, job, tasks)
        elif self.workers == "auto":
            yield from _measured(job, tasks)
        elif len(tasks) > CHUNK and int(self.workers) > 1:
            yield from _in_processes(int(self.workers), job, tasks)
        else:
            yield from map(job, tasks)


def cores() -> int:
    """Processor cores that this process may use."""
    from joblib import cpu_count

    return int(cpu_count())


def _measured(job: Any, tasks: Sequence[Task]) -> Iterator[Outcome]:
    """The first tasks here; the rest in processes where that saves more than WORTH seconds."""
    begin = time.perf_counter()
    job.build()
    building = time.perf_counter() - begin
    begin = time.perf_counter()
    yield from map(job, tasks[:PROBE])
    rest, k = tasks[PROBE:], cores()
    here = (time.perf_counter() - begin) / PROBE * len(rest)
    if k > 1 and here * (1 - 1 / k) - START - building > WORTH:
        yield from _in_processes(k, job, rest)
    else:
        yield from map(job, rest)


def _chunks(tasks: Sequence[Task]) -> list[Sequence[Task]]:
    """CHUNK tasks each; those of many states alone."""
    n = CHUNK if tasks[0].size == 1 else 1
    return [tasks[i: i + n] for i in range(0, len(tasks), n)]


def _in_processes(k: int, job: Any, tasks: Sequence[Task]) -> Iterator[Outcome]:
    from joblib import Parallel, delayed

    data = pickle.dumps(job)
    work = Parallel(n_jobs=k, backend="loky", batch_size=1, pre_dispatch="2*n_jobs", return_as="generator_unordered")
    for outcomes in work(delayed(_work)(data, chunk, os.getpid()) for chunk in _chunks(tasks)):
        yield from outcomes


def _on_cluster(address: str, job: Any, tasks: Sequence[Task]) -> Iterator[Outcome]:
    """A task of a worker that dies is given to another by the scheduler; each outcome is taken once."""
    try:
        from distributed import Client
    except ImportError as error:
        raise ValueError(f"workers={address!r} needs Dask: pip install 'nocl[cluster]'") from error
    with _connected(Client, address) as client:
        data = pickle.dumps(job)  # with each chunk: scattered data would be lost with the worker that holds it
        waiting = {client.submit(_unpacked, data, pickle.dumps(chunk), pure=False) for chunk in _chunks(tasks)}
        while waiting:
            done = _next_done(client, waiting, address)
            waiting -= done
            for future in done:
                yield from _result(future, address)
                future.release()


@contextmanager
def _connected(Client: Any, address: str) -> Iterator[Any]:
    """A client of a scheduler that has workers; ValueError, in one line, where there are none, or they are lost."""
    for name in ("client", "core", "utils"):  # their tracebacks say at length what the error here says in a line
        logging.getLogger(f"distributed.{name}").setLevel(logging.CRITICAL)
    try:
        client = Client(address, timeout=CONNECT, set_as_default=False)
    except OSError as error:
        raise ValueError(f"no Dask scheduler answers at {address} within {CONNECT:g} s: {error}; start one with "
                         "`dask scheduler`") from error
    with client:
        try:
            client.wait_for_workers(1, timeout=CONNECT)
        except TimeoutError:
            raise ValueError(f"the Dask scheduler at {address} has no workers, and none joined within {CONNECT:g} s: "
                             f"start some with `dask worker {address}`") from None
        yield client


def _next_done(client: Any, waiting: set[Any], address: str) -> set[Any]:
    """Futures that are done, at least one; ValueError where scheduler or workers have been gone for CONNECT seconds."""
    alone_since, looked = None, time.monotonic()
    while not (done := {future for future in waiting if future.done()}):
        time.sleep(POLL)
        if time.monotonic() - looked < LOOK:
            continue
        looked = time.monotonic()
        if client.status != "running":
            raise ValueError(f"the Dask scheduler at {address} was lost; what was done is kept where `out` names a "
                             "folder: start it again and repeat the call")
        if client.scheduler_info(n_workers=-1)["workers"]:
            alone_since = None
            continue
        alone_since = alone_since or time.monotonic()
        if time.monotonic() - alone_since > CONNECT:
            raise ValueError(f"all workers of the Dask scheduler at {address} were lost, and none came back within "
                             f"{CONNECT:g} s; what was done is kept where `out` names a folder: start workers and "
                             "repeat the call")
    return done


def _result(future: Any, address: str) -> list[Outcome]:
    """What a worker made of a chunk; ValueError where it has no nocl, or the task was lost."""
    try:
        outcomes: list[Outcome] = future.result()
    except Exception as error:
        if isinstance(error, ImportError) or (isinstance(error, RuntimeError) and "deserialization" in str(error)):
            raise ValueError(f"a Dask worker at {address} cannot import what it needs ({_said(error)}); install this "
                             "version of nocl, and your own modules that it uses, where workers run") from None
        if future.status in ("cancelled", "lost") or type(error).__module__.startswith("distributed"):
            raise ValueError(f"the Dask cluster at {address} was lost: {_said(error)}; what was done is kept where "
                             "`out` names a folder: start it again and repeat the call") from None
        raise
    return outcomes


def _said(error: Exception) -> str:
    return f"{type(error).__name__}: {' '.join(str(error).split())}"


@lru_cache(maxsize=2)
def _job(data: bytes) -> Any:
    """The job of this worker process, unpickled once, so that its solver is built once."""
    return pickle.loads(data)


@lru_cache(maxsize=1)
def _end_with(parent: int) -> None:
    """Ends this worker once its parent is gone: where that was killed, joblib's workers wait on for minutes."""
    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(LOOK)
        os.kill(os.getpid(), signal.SIGKILL)

    threading.Thread(target=watch, daemon=True).start()


def _work(data: bytes, tasks: Sequence[Task], parent: int | None = None) -> list[Outcome]:
    if parent is not None:
        _end_with(parent)
    return [_job(data)(task) for task in tasks]


def _unpacked(data: bytes, tasks: bytes) -> list[Outcome]:
    """Work whose tasks are unpickled by the worker: what it lacks for that is then said by the task, not by Dask."""
    return _work(data, pickle.loads(tasks))


@dataclass(frozen=True)
class Journal:
    """Outcomes in a folder, a data-only file each, written whole or not at all.

    Raises ValueError where the folder holds another run, or something else.
    """

    folder: Path | None
    key: str = ""
    solver: str = "NMPC"

    def __post_init__(self) -> None:
        if self.folder is None:
            return
        manifest = self.folder / MANIFEST
        if manifest.exists():
            if self._key_of(manifest) != self.key:
                raise ValueError(f"{self.folder} holds another run of nocl (other states, problem, settings or "
                                 f"versions); expected the same one of {self.solver}, or a new folder: change `out`")
        elif self.folder.exists() and any(self.folder.iterdir()):
            raise ValueError(f"{self.folder} is not empty and holds no run of {self.solver}; expected a new folder: "
                             "change `out`")
        (self.folder / TASKS).mkdir(parents=True, exist_ok=True)
        remove_parts(self.folder / TASKS)
        write_bytes(manifest, json.dumps({"kind": f"nocl {self.solver} run", "key": self.key}).encode())

    def _key_of(self, manifest: Path) -> Any:
        """What a manifest says of its run."""
        try:
            return json.loads(manifest.read_text(encoding="utf-8"))["key"]
        except (OSError, ValueError, *MALFORMED) as error:
            raise ValueError(f"{manifest} cannot be read ({type(error).__name__}: {error}); expected the manifest of a "
                             f"run of {self.solver}, as nocl wrote it: name another folder, or empty this"
                             ) from None

    def file(self, name: str) -> Path:
        assert self.folder is not None
        return self.folder / TASKS / f"{name}.npz"

    def read(self, task: Task) -> Outcome | None:
        """What was found before; None where there is nothing, or not as it was written: it is to be done again."""
        if self.folder is None or not self.file(task.name).is_file():
            return None
        content = self.file(task.name).read_bytes()
        body, digest = content[:-DIGEST], content[-DIGEST:]
        if sha256(body).encode() != digest:
            return None
        with np.load(io.BytesIO(body), allow_pickle=False) as data:
            return task.outcome({name: data[name] for name in data.files})

    def write(self, outcome: Outcome) -> None:
        if self.folder is None:
            return
        content = io.BytesIO()
        np.savez(content, **outcome.arrays())
        body = content.getvalue()
        write_bytes(self.file(outcome.name), body + sha256(body).encode(), durable=False)


def stream(job: Any, tasks: Sequence[Task], pool: Pool, journal: Journal, show: bool, what: str) -> Iterator[Outcome]:
    """The outcome of each task, in any order: those of the journal first, the others done now and written at once.

    ValueError where another run is at work in the journal's folder.
    """
    with alone(journal.folder):
        yield from _streamed(job, tasks, pool, journal, show, what)


def _streamed(job: Any, tasks: Sequence[Task], pool: Pool, journal: Journal, show: bool,
              what: str) -> Iterator[Outcome]:
    known = {task.name for task in tasks if journal.read(task) is not None}
    todo = [task for task in tasks if task.name not in known]
    total = sum(task.size for task in tasks)
    with progress_bar(total, what, show and len(todo) > 1, unit="state", delay=3.0, leave=False,
                      initial=total - sum(task.size for task in todo)) as bar:
        for task in tasks:
            if task.name in known:
                yield journal.read(task)
        for outcome in pool.outcomes(job, todo):
            journal.write(outcome)
            bar.update(outcome.size)
            yield outcome


def do(job: Any, tasks: Sequence[Task], pool: Pool, journal: Journal, show: bool, what: str) -> list[Outcome]:
    """The outcomes of all tasks, in their order."""
    done = {outcome.name: outcome for outcome in stream(job, tasks, pool, journal, show, what)}
    return [done[task.name] for task in tasks]
