"""Fields of settings: each has a default, a line of doc and a rule that its value must meet.

    @dataclass(frozen=True)
    class FitSettings(Checked):
        steps: int = count(200, "of the descent")
        rate: float = positive(4e-3, "of learning")

`FitSettings(steps=0)` raises "FitSettings: steps is 0; expected an integer >= 1 (of the descent)".
"""

from __future__ import annotations

import math
import numbers
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, fields
from typing import Any, ClassVar, Self

from nocl.support import checks
from nocl.support.checks import LARGEST

RULE = "nocl rule"  # of a field's metadata
EFFORTS = ("quick", "normal", "best")


@dataclass(frozen=True)
class Rule:
    """What a field may be."""

    doc: str
    expected: str
    holds: Callable[[Any], bool]
    kept: Callable[[Any], Any]  # the value as it is kept: a plain Python one, that JSON has


class Checked:
    """A base of frozen dataclasses of settings: every field with a rule is checked on construction."""

    def __post_init__(self) -> None:
        for f in fields(self):  # type: ignore[arg-type]  # of dataclasses alone
            rule: Rule | None = f.metadata.get(RULE)
            if rule is None:
                continue
            value = getattr(self, f.name)
            if not rule.holds(value):
                raise ValueError(f"{type(self).__name__}: {f.name} is {checks.shown(value)}; expected {rule.expected} "
                                 f"({rule.doc})")
            object.__setattr__(self, f.name, rule.kept(value))


class Scaled(Checked):
    """Settings that one word scales: "quick" shows whether all works, "normal" is the default, "best" takes longest."""

    EFFORT: ClassVar[Mapping[str, Mapping[str, Any]]]  # of "quick" and "best": what differs from the defaults

    @classmethod
    def of(cls, effort: str, **changes: Any) -> Self:
        """The settings of an effort, "quick", "normal" or "best", with changes of single fields."""
        return cls(**{**cls.EFFORT.get(checked_effort(effort, cls.__name__), {}), **changes})


def checked_effort(effort: Any, owner: str) -> str:
    """An effort's word; ValueError for another."""
    return checks.word(effort, EFFORTS, "effort", owner)


def count(default: int | None, doc: str, *, least: int = 1, none: str = "") -> Any:
    """An integer >= least; with `none`, also None, which means that."""
    return _field(default, doc, f"an integer >= {least}", lambda v: _is_whole(v) and least <= v <= LARGEST, int, none)


def positive(default: float | None, doc: str, *, most: float = math.inf, none: str = "") -> Any:
    """A finite number > 0, at most `most`; with `none`, also None, which means that."""
    limit = "" if most == math.inf else f", at most {most:g}"
    return _field(default, doc, f"a finite number > 0{limit}", lambda v: _is_real(v) and 0 < v <= most, float, none)


def nonnegative(default: float | None, doc: str, *, none: str = "") -> Any:
    """A finite number >= 0; with `none`, also None, which means that."""
    return _field(default, doc, "a finite number >= 0", lambda v: _is_real(v) and v >= 0, float, none)


def flag(default: bool, doc: str) -> Any:
    """True or False."""
    return _field(default, doc, "True or False", lambda v: isinstance(v, bool), bool)


def choice(default: str, doc: str, among: Iterable[str]) -> Any:
    """One of some words."""
    words = tuple(among)
    return _field(default, doc, f"one of {', '.join(words)}", lambda v: isinstance(v, str) and v in words, str)


def widths(default: tuple[int, ...], doc: str) -> Any:
    """Widths of hidden layers, one at least."""
    def holds(v: Any) -> bool:
        return isinstance(v, (tuple, list)) and len(v) > 0 and all(_is_whole(h) and h > 0 for h in v)

    return _field(default, doc, "widths of hidden layers such as (64, 64)", holds, lambda v: tuple(map(int, v)))


def coefficients(default: tuple[float, ...], doc: str, *, nonzero: int = 0) -> Any:
    """As many numbers >= 0 as the default has, the first `nonzero` of them > 0."""
    def holds(v: Any) -> bool:
        numbers_ = isinstance(v, (tuple, list)) and len(v) == len(default) and all(_is_real(w) and w >= 0 for w in v)
        return numbers_ and all(w > 0 for w in v[:nonzero])

    expected = f"{len(default)} numbers >= 0" + (", the first > 0" if nonzero else "") + f", such as {default}"
    return _field(default, doc, expected, holds, lambda v: tuple(map(float, v)))


def _field(default: Any, doc: str, expected: str, holds: Callable[[Any], bool], kept: Callable[[Any], Any],
           none: str = "") -> Any:
    if none:
        rule = Rule(doc, f"{expected}, or None: {none}", lambda v: v is None or holds(v),
                    lambda v: None if v is None else kept(v))
    else:
        rule = Rule(doc, expected, holds, kept)
    return field(default=default, metadata={RULE: rule})


def _is_whole(value: Any) -> bool:
    return isinstance(value, numbers.Integral) and not isinstance(value, bool)


def _is_real(value: Any) -> bool:
    return checks.finite(value) is not None
