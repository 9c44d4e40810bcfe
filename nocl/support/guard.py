"""Calls that may never come back, made in a copy of this process: it can be ended, and this one waits and is free.

A library may loop for ever where none of its own limits reaches, and ignore Ctrl-C there; it may also end its
process. The copy (a fork) has everything that was built here until then, so nothing is built or sent twice; it answers
one call after the other, and is made anew after it was ended, or where something new is to be called. Each thread has
its own.

Where other threads are at work, a fork may catch one of them inside a library that holds a lock, which then stays
locked in the copy for ever. So a new copy first rehearses what it is for; one that does not come back from that is
ended, and another one made.
"""

from __future__ import annotations

import atexit
import ctypes
import gc
import itertools
import os
import signal
import sys
import threading
import warnings
from collections.abc import Callable
from contextlib import suppress
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from typing import Any
from weakref import WeakValueDictionary

DEATH_SIGNAL = 1  # prctl's PR_SET_PDEATHSIG: what the copy gets when the thread that made it ends
REHEARSALS = (1.0, 4.0, 16.0, 16.0, 16.0)  # seconds that a new copy has to rehearse, one after the other
STANDARD = 3  # file descriptors of input, output and errors


class NoAnswerError(Exception):
    """A call did not come back: it took too long, or ended its process."""


class Guarded:
    """`function(*args)`, called in the copy; arguments and results pickle. What it needs is best built before.

    rehearse : takes the locks that the function takes, in little time; it is called in each new copy
    """

    def __init__(self, function: Callable[..., Any], rehearse: Callable[[], Any] = lambda: None) -> None:
        self.function, self.rehearse = function, rehearse
        with _LOCK:
            self.number = next(_NUMBERS)
            _FUNCTIONS[self.number] = self

    def __call__(self, limit: float, *args: Any) -> Any:
        """What the function returns or raises; NoAnswerError where it does not within `limit` seconds."""
        return _copy_for(self.number).ask(limit, (self.number, args))


class _Copy:
    """A forked process that answers calls of the functions that existed when it was made."""

    def __init__(self) -> None:
        self.owner = os.getpid()
        self.status: int | None = None  # once it has ended
        self.waiting = threading.Lock()  # held by who waits for it or ends it: any thread may ask whether it lives
        self.pipe, theirs = Pipe()
        with _LOCK:  # nobody registers a function meanwhile
            self.newest = max(_FUNCTIONS, default=-1)
            self.pid = _fork(theirs)
        theirs.close()

    def knows(self, number: int) -> bool:
        return self.owner == os.getpid() and number <= self.newest and self.lives()

    def lives(self) -> bool:
        """It has not ended."""
        with self.waiting:
            return self._lives()

    def _lives(self) -> bool:
        if self.status is None:
            self._wait(os.WNOHANG)
        return self.status is None

    def _wait(self, how: int = 0) -> None:
        try:
            pid, status = os.waitpid(self.pid, how)
        except ChildProcessError:  # others have waited for it
            pid, status = self.pid, 0
        if pid:
            self.status = os.waitstatus_to_exitcode(status)

    def ask(self, limit: float, call: Call) -> Any:
        try:
            self.pipe.send(call)
            if not self.pipe.poll(limit):
                raise NoAnswerError(f"it did not come back within {limit:.3g} s")
            fine, answer = self.pipe.recv()
        except (EOFError, ConnectionError):
            raise NoAnswerError(f"it ended its process ({self.end()})") from None
        except BaseException:  # Ctrl-C among them: the answer would be taken for the next call's
            self.end()
            raise
        if fine:
            return answer
        raise answer

    def end(self) -> str:
        """The process is gone afterwards; what ended it."""
        if self.owner != os.getpid():
            return ""
        self.pipe.close()
        with self.waiting:  # its number is its own until somebody has waited for it
            if self._lives():
                os.kill(self.pid, signal.SIGKILL)
                self._wait()
        status = self.status or 0
        return signal.Signals(-status).name if status < 0 else f"exit code {status}"


Call = tuple[int, tuple[Any, ...] | None]  # a function's number and its arguments; None: the rehearsal
_NUMBERS = itertools.count()
_FUNCTIONS: WeakValueDictionary[int, Guarded] = WeakValueDictionary()
_LOCK = threading.Lock()
_COPIES: list[_Copy] = []  # of all threads
_OWN = threading.local()  # `copy`, this thread's: it ends with its thread, so no two threads share one


def _copy_for(number: int) -> _Copy:
    copy: _Copy | None = getattr(_OWN, "copy", None)
    if copy is None or not copy.knows(number):
        end()
        copy = _OWN.copy = _new_copy(number)
        _COPIES[:] = [c for c in _COPIES if c.owner == os.getpid() and c.lives()] + [copy]
    return copy


def _new_copy(number: int) -> _Copy:
    """A copy that has rehearsed the function of this number; NoAnswerError where none does."""
    for limit in REHEARSALS:
        copy = _Copy()
        try:
            copy.ask(limit, (number, None))
        except NoAnswerError:
            copy.end()
        else:
            return copy
    raise NoAnswerError("no copy of this process can call it: its threads are too busy")


@atexit.register
def end() -> None:
    """This thread's copy is gone afterwards; the next call makes one."""
    copy: _Copy | None = getattr(_OWN, "copy", None)
    if copy is not None:
        copy.end()
        _OWN.copy = None


def _fork(pipe: Connection) -> int:
    """The copy's number; the copy itself never leaves this function."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        with warnings.catch_warnings():  # of forks beside threads: the copy calls none of what they were busy with
            warnings.simplefilter("ignore")
            pid = os.fork()
        if not pid:
            _answer(pipe)
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
    return pid


def _answer(pipe: Connection) -> None:
    """The copy's life: calls and answers until the other side is gone, and no clean-up of what is not its own."""
    try:
        _settle(pipe)
        while True:
            number, args = pipe.recv()
            pipe.send(_outcome(number, args))
    finally:
        os._exit(0)


def _outcome(number: int, args: tuple[Any, ...] | None) -> tuple[bool, Any]:
    try:
        guarded = _FUNCTIONS[number]
        return (True, guarded.function(*args)) if args is not None else (True, guarded.rehearse() and None)
    except Exception as error:
        return False, error


def _settle(pipe: Connection) -> None:
    """Nothing of what the other process holds is held here: signals, files and locks, threads."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(DEATH_SIGNAL, signal.SIGKILL)
    for descriptor in map(int, os.listdir("/dev/fd")):
        if descriptor >= STANDARD and descriptor != pipe.fileno():
            with suppress(OSError):  # that of the list itself
                os.close(descriptor)
    gc.freeze()
    if "torch" in sys.modules:
        sys.modules["torch"].set_num_threads(1)  # its threads stayed in the other process
