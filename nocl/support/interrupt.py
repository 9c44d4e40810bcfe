"""Ctrl-C round CasADi's solvers, which take it for a failure of the solve and go on."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType


@contextmanager
def kept() -> Iterator[None]:
    """A Ctrl-C while it lasts ends the solver at once, and is raised at the end where the solver has swallowed it.

    Keep it round one call of a solver. Only the main thread gets Ctrl-C, and only Python's handlers can be put aside:
    elsewhere this does nothing.
    """
    if threading.current_thread() is not threading.main_thread() or not callable(signal.getsignal(signal.SIGINT)):
        yield
        return
    got: list[FrameType | None] = []

    def press(_: int, frame: FrameType | None) -> None:
        got.append(frame)
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGINT, press)
    try:
        yield
    except RuntimeError:  # what solvers make of it
        if not got:
            raise
    finally:
        signal.signal(signal.SIGINT, before)
    if got:
        raise KeyboardInterrupt
