"""Ctrl-C round CasADi's solvers, which take it for a failure of the solve and go on."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType


@contextmanager
def deferred() -> Iterator[None]:
    """A Ctrl-C while it lasts is raised, as KeyboardInterrupt, at its end: keep it round one call of a solver.

    Only the main thread gets Ctrl-C, and only Python's handlers can be put aside: elsewhere this does nothing.
    """
    if threading.current_thread() is not threading.main_thread() or not callable(signal.getsignal(signal.SIGINT)):
        yield
        return
    got: list[FrameType | None] = []
    before = signal.signal(signal.SIGINT, lambda _, frame: got.append(frame))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
    if got:
        raise KeyboardInterrupt
