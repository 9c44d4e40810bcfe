"""A nonlinear program's functions as compiled C, kept in a folder from one process to the next."""

from __future__ import annotations

import hashlib
import os
import platform
import shutil
import subprocess
import tempfile
from functools import lru_cache
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

CACHE_VARIABLE = "NOCL_CACHE"  # names a folder for compiled code; without it it lives as long as the process
FLAGS = ("-O2", "-march=native", "-fPIC", "-shared")
PLAIN = ("SXFunction", "MXFunction", "Map", "BSplineInterpolant", "LinearInterpolant")  # Functions that C has all of


def folder_of(compiled: bool | str | os.PathLike[str]) -> str:
    """The folder for compiled code: the one that is named, NOCL_CACHE, or one that lives as long as the process."""
    if not isinstance(compiled, bool):
        return os.fspath(compiled)
    return os.environ.get(CACHE_VARIABLE) or _own_folder().name


@lru_cache
def _own_folder() -> tempfile.TemporaryDirectory[str]:
    return tempfile.TemporaryDirectory(prefix="nocl-programs-")


def target(folder: str, key: str) -> Path:
    """Where the library of the program with this key is, or will be: for this compiler, machine and CasADi alone."""
    return Path(folder) / f"nlp-{fingerprint(key, ca.CasadiMeta.version(), _compiler(), _processor(), FLAGS)}.so"


@lru_cache
def _compiler() -> tuple[str, str]:
    """(path, version) of the C compiler: $CC, gcc or cc."""
    for name in (os.environ.get("CC"), "gcc", "cc"):
        path = shutil.which(name) if name else None
        if path:
            return path, subprocess.run([path, "--version"], capture_output=True, text=True, check=False).stdout
    raise ValueError("NMPC: no C compiler found (looked for $CC, gcc, cc): install gcc, or leave `compiled` out")


@lru_cache
def _processor() -> str:
    """What -march=native means here: code for one processor must not be loaded on another."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        return platform.machine() + next(line for line in lines if line.startswith(("flags", "Features")))
    except (OSError, StopIteration):
        return platform.machine() + platform.processor()


def build(solver: ca.Function, library: Path) -> None:
    """Compile the functions that a solver calls; two builders of one library do not collide."""
    library.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=library.parent) as scratch:
        code, part = Path(scratch, "nlp.c"), Path(scratch, "nlp.so")
        _generate(solver, scratch, code.name)
        command = [_compiler()[0], *FLAGS, str(code), "-o", str(part), "-lm"]
        result = subprocess.run(command, capture_output=True, text=True, check=False)
        if result.returncode:
            raise RuntimeError(f"{command[0]} could not compile the program of NMPC:\n{result.stderr[-2000:]}")
        os.replace(part, library)


def _generate(solver: ca.Function, folder: str, name: str) -> None:
    """C source of the functions that a solver calls; its generate_dependencies can write to the working folder only."""
    generator = ca.CodeGenerator(name)
    for function in (solver.oracle(), *(solver.get_function(part) for part in solver.get_function())):
        generator.add(function)
    generator.generate(folder + os.sep)


def fingerprint(*parts: Any) -> str:
    """A hash of bytes, strings, numbers, arrays and Functions."""
    total = hashlib.sha256()
    for part in parts:
        part = _text(part) if isinstance(part, ca.Function) else part
        data = part if isinstance(part, bytes) else np.ascontiguousarray(part).tobytes() if isinstance(
            part, np.ndarray) else repr(part).encode()
        total.update(f"{len(data)}:".encode() + data)
    return total.hexdigest()[:32]


def _text(function: ca.Function) -> str:
    """What a Function is: its C, where C has all of it, else its serialisation.

    A serialisation changes with use: a spline in it keeps its derivative once that was asked for.
    """
    if all(part.class_name() in PLAIN for part in (function, *function.find_functions())):
        generator = ca.CodeGenerator("function")
        generator.add(function)
        return str(generator.dump())
    return str(function.serialize())
