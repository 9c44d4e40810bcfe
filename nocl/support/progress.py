"""What long work shows on stderr: bars on a terminal; elsewhere, as in a log, lines, one at least every EVERY seconds.

A line has all stages that are under way, the outermost first:
`labels: 3 of 22, cold start 3 of 16, 40 s, about 250 s left; DDP, cartpole: 1024 of 3000 state, 2 s, about 4 s left`.
"""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any, Protocol, Self

from tqdm import tqdm

SHORT = 1.0  # seconds that the outermost stage takes before anything is said of it
EVERY = 10.0  # seconds between two lines, at most, and what a stage takes at least to be told when it ends


class Bar(Protocol):
    """A stage under way, a context manager."""

    def __enter__(self) -> Any: ...
    def __exit__(self, *_: Any) -> Any: ...
    def update(self, n: float = 1, /) -> Any: ...
    def set_postfix_str(self, s: str = "", refresh: bool = True) -> Any: ...
    def close(self) -> Any: ...


_QUIET: ContextVar[bool] = ContextVar("quiet", default=False)


@contextmanager
def within(progress: bool | None) -> Iterator[None]:
    """What is asked for holds for all work within, where that asks for nothing itself."""
    before = _QUIET.set(_QUIET.get() if progress is None else not progress)
    try:
        yield
    finally:
        _QUIET.reset(before)


def shown(progress: bool | None) -> bool:
    """Whether progress is shown: where nothing is asked for, here or around, wherever there is a stderr."""
    return sys.stderr is not None and (not _QUIET.get() if progress is None else progress)


def bar(total: float, title: str, progress: bool | None = None, *, unit: str = "it", initial: float = 0,
        delay: float = 0.0, leave: bool = True) -> Bar:
    """A stage of `total` units of work, to be closed at its end.

    delay, leave : of a bar on a terminal: seconds until it is shown, and whether it stays
    """
    show = shown(progress)
    if show and not sys.stderr.isatty():
        return Stage(LOG, title, total, initial, unit)
    found: Bar = tqdm(total=total, desc=title, unit=unit, initial=initial, delay=delay, leave=leave,
                      disable=not show, mininterval=0.5)
    return found


def say(text: str, progress: bool | None = None) -> None:
    """A line of its own, above bars."""
    if shown(progress):
        tqdm.write(text, file=sys.stderr)
        sys.stderr.flush()


def in_words(seconds: float) -> str:
    """A length of time, to two digits at most: 8 s, 40 s, 3 min, 2.5 h."""
    for size, unit in ((3600.0, "h"), (60.0, "min")):
        if seconds >= 1.5 * size:
            return f"{seconds / size:.2g} {unit}"
    return f"{seconds:.0f} s" if seconds < 10 else f"{round(seconds, -1):.0f} s"


class Log:
    """The stages under way, and when a line was written last.

    A thread of its own writes where a stage is long without a word; it ends with the last stage.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic, write: Callable[[str], None] | None = None,
                 beats: bool = True) -> None:
        self.clock, self.write, self.beats = clock, write or _to_stderr, beats
        self.stages: list[Stage] = []
        self.last = self.closed = clock()
        self._busy, self._end = threading.Lock(), threading.Event()

    def opened(self, stage: Stage) -> None:
        now = self.clock()
        if not self.stages:
            if now - self.closed > EVERY:  # nothing was under way: the silence counts from now on
                self.last = now
            if self.beats:
                self._end = threading.Event()
                threading.Thread(target=self._beat, args=(self._end,), daemon=True).start()
        self.stages.append(stage)

    def ended(self, stage: Stage) -> None:
        self.stages.remove(stage)
        self.closed = self.clock()
        if not self.stages:
            self._end.set()

    def due(self) -> None:
        """A line, where the last was EVERY seconds ago."""
        now = self.clock()
        if now - self.last < EVERY or not self.stages or now - self.stages[0].begin < SHORT:
            return
        if not self._busy.acquire(blocking=False):
            return
        try:
            self.tell("; ".join(map(str, list(self.stages))))
        finally:
            self._busy.release()

    def tell(self, line: str) -> None:
        self.last = self.clock()
        self.write(line)

    def _beat(self, end: threading.Event) -> None:
        while not end.wait(min(max(self.last + EVERY - self.clock(), 0.1), EVERY)):
            self.due()


class Stage:
    """A stage as lines of a log."""

    def __init__(self, log: Log, title: str, total: float, initial: float = 0, unit: str = "it") -> None:
        self.log, self.title, self.total, self.done, self.first = log, title, total, initial, initial
        self.unit, self.said, self.begin, self.closed = "" if unit == "it" else f" {unit}", "", log.clock(), False
        log.opened(self)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: Any) -> None:
        self.close()

    def update(self, n: float = 1, /) -> None:
        self.done += n
        self.log.due()

    def set_postfix_str(self, s: str = "", refresh: bool = True) -> None:
        self.said = s

    def close(self) -> None:
        if self.closed:
            return
        self.closed = True
        if self.log.clock() - self.begin >= EVERY:
            self.log.tell(str(self))
        self.log.ended(self)

    def __str__(self) -> str:
        took, share = self.log.clock() - self.begin, self.done - self.first
        parts = [f"{self.done:g} of {self.total:g}{self.unit}", self.said, in_words(took)]
        if share > 0 and self.done < self.total:
            parts.append(f"about {in_words(took * (self.total - self.done) / share)} left")
        return f"{self.title}: {', '.join(part for part in parts if part)}"


def _to_stderr(line: str) -> None:
    print(line, file=sys.stderr, flush=True)


LOG = Log()
