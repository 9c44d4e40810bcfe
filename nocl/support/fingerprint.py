"""One hash for all of nocl: what tells one problem, program, model or file from another.

`fingerprint(...)` is of values, by what they are; `sha256(...)` is of bytes as they come, for files whose format says
which bytes are hashed.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping
from dataclasses import fields, is_dataclass
from pathlib import PurePath
from typing import Any

import casadi as ca
import numpy as np

LENGTH = 32  # hexadecimal digits of a fingerprint: 128 bits
# Functions that CasADi's C generator has all of
PLAIN = ("SXFunction", "MXFunction", "Map", "BSplineInterpolant", "LinearInterpolant")


def fingerprint(*parts: Any) -> str:
    """A hash of values in their order, 32 hexadecimal digits; the same in every process.

    parts: bytes, strings, numbers, None, paths, arrays, casadi.DM, casadi.Function, dataclasses of these, and lists,
    tuples and dicts of these, as in JSON data (dicts by sorted keys). ValueError for anything else: an object whose
    text is its address would differ from itself in the next process.
    """
    total = hashlib.sha256()
    for part in parts:
        for data in _pieces(part):
            total.update(f"{len(data)}:".encode() + data)  # with lengths: ("ab", "c") is not ("a", "bc")
    return total.hexdigest()[:LENGTH]


def sha256(*chunks: bytes | str) -> str:
    """SHA-256 of bytes, and of strings as UTF-8, one after the other: of files, and in formats that are saved."""
    total = hashlib.sha256()
    for chunk in chunks:
        total.update(chunk.encode() if isinstance(chunk, str) else chunk)
    return total.hexdigest()


def json_text(data: Any) -> str:
    """JSON data as one text, however its dicts are ordered."""
    return json.dumps(data, sort_keys=True)


def _pieces(part: Any) -> Iterator[bytes]:
    """What is hashed of a value: its kind, where another kind could have the same bytes, and its content."""
    if isinstance(part, np.generic):
        part = part.item()
    if isinstance(part, ca.DM):
        part = part.full()
    match part:
        case None | bool() | int() | float() | str():
            yield repr(part).encode()
        case bytes():
            yield b"bytes"
            yield part
        case PurePath():
            yield b"path"
            yield str(part).encode()
        case ca.Function():
            yield repr(_text(part)).encode()
        case np.ndarray() if part.dtype.kind in "biufcSU":
            yield f"array {part.dtype.str} {part.shape}".encode()
            yield np.ascontiguousarray(part).tobytes()
        case list() | tuple():
            yield f"list {len(part)}".encode()
            for one in part:
                yield from _pieces(one)
        case Mapping():
            yield f"dict {len(part)}".encode()
            for key in sorted(part, key=repr):
                yield from _pieces(key)
                yield from _pieces(part[key])
        case _ if is_dataclass(part) and not isinstance(part, type):
            yield f"dataclass {type(part).__name__}".encode()
            for f in fields(part):
                yield f.name.encode()
                yield from _pieces(getattr(part, f.name))
        case _:
            raise ValueError(f"a {type(part).__name__} has no fingerprint; expected numbers, strings, arrays, casadi "
                             "Functions, or lists, dicts and dataclasses of them: pass what it is made of")


def _text(function: ca.Function) -> str:
    """What a Function is: its C, where C has all of it, else its serialisation.

    A serialisation changes with use: a spline in it keeps its derivative once that was asked for.
    """
    if all(part.class_name() in PLAIN for part in (function, *function.find_functions())):
        generator = ca.CodeGenerator("function")
        generator.add(function)
        return str(generator.dump())
    return str(function.serialize())
