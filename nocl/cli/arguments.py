"""What an argument may be: each function takes its text, and says in one line what is wrong with it."""

from __future__ import annotations

import argparse
import math
import os
from pathlib import Path
from typing import NoReturn

from nocl.solvers import registry

FORMS = ("casadi", "l4casadi", "onnx", "c")  # of exports
MOST = 1_000_000  # of anything counted on the command line
SEEDS = 2**62  # so that seeds made from one still fit in 64 bits


class Parser(argparse.ArgumentParser):
    """argparse with one line for an error."""

    def error(self, message: str) -> NoReturn:
        raise ValueError(f"{message} (see {self.prog} --help)")


def count(text: str) -> int:
    return whole(text, 1, MOST)


def minutes(text: str) -> float:
    """A time > 0."""
    number = _number(text)
    if number is None or number <= 0:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number of minutes > 0")
    return number


def workers(text: str) -> int | str:
    return text if text == "auto" or "://" in text else count(text)


def seed(text: str) -> int:
    return whole(text, 0, SEEDS - 1)


def whole(text: str, least: int, most: int) -> int:
    """A number of least to most in the digits 0 to 9; int() alone also takes signs, underscores and other scripts."""
    digits = text.isascii() and text.isdecimal() and len(text) <= len(str(most))
    if not digits or not least <= int(text) <= most:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number of at least {least} and at most {most}")
    return int(text)


def folder(text: str) -> Path:
    """A folder's name; a blank one, as of an unset variable, would be the current folder."""
    if not text.strip() or "\0" in text:
        raise argparse.ArgumentTypeError(f"{text!r} is no folder's name")
    return Path(text)


def grid(text: str) -> tuple[int, ...]:
    try:
        return tuple(int(part) for part in text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r}; expected numbers of nodes, like 41,81,81") from None


def known(text: str) -> dict[str, str | float]:
    """States and what their derivatives are, p=v,theta=omega."""
    found: dict[str, str | float] = {}
    for word in text.split(","):
        name, equal, value = (part.strip() for part in word.partition("="))
        if not (name and equal and value) or name in found:
            raise argparse.ArgumentTypeError(f"{text!r}; expected different states with their derivatives, like "
                                             "p=v,theta=omega")
        try:
            found[name] = float(value)
        except ValueError:
            found[name] = value
    return found


def parameters(text: str) -> dict[str, float]:
    """Parameters and their values, mass=1.2,goal=0.5."""
    found: dict[str, float] = {}
    for word in text.split(","):
        name, equal, value = (part.strip() for part in word.partition("="))
        number = _number(value)
        if not (name and equal) or number is None or name in found:
            raise argparse.ArgumentTypeError(f"{text!r}; expected different parameters with finite numbers, like "
                                             "mass=1.2,goal=0.5")
        found[name] = number
    return found


def _number(text: str) -> float | None:
    try:
        value = float(text)
    except ValueError:
        return None
    return value if math.isfinite(value) else None


def words(text: str) -> tuple[str, ...]:
    return tuple(word.strip() for word in text.split(","))


def holds(text: str) -> tuple[int | None, ...]:
    """Rates of feedback: continuous, and each number of intervals."""
    return (None, *(count(word.strip()) for word in text.split(",")))


def methods(text: str) -> tuple[str, ...]:
    """Names of the registry, in lower case."""
    names = tuple(word.strip().lower() for word in text.split(","))
    if not set(names) <= set(registry.METHODS) or len(set(names)) < len(names):
        raise argparse.ArgumentTypeError(f"{text!r} is not a list of different methods of "
                                         f"{', '.join(registry.METHODS)}")
    return names


def forms(text: str) -> tuple[str, ...]:
    names = tuple(word.strip().lower() for word in text.split(","))
    if not set(names) <= set(FORMS):
        raise argparse.ArgumentTypeError(f"{text!r} is not a list of {', '.join(FORMS)}")
    return names


def check_out(out: Path) -> None:
    """Whether files can be written under `out`, without writing any."""
    for path in (out, *out.absolute().parents):
        if path.exists():
            if not path.is_dir():
                raise ValueError(f"{path} is a file; expected a folder for the output: name another --out")
            if not os.access(path, os.W_OK | os.X_OK):
                raise ValueError(f"{path} cannot be written to; expected a folder of yours: name another --out")
            return
