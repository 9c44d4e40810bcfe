"""The systems and problems that come with nocl: one short file each, with system(**constants) and ocp(**options).

Nothing is imported until it is asked for: `nocl.load_ocp("cartpole")` or `from nocl.systems import cartpole`.
"""

from __future__ import annotations

import difflib
import importlib
import inspect
import os
import sys
import traceback
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any

from nocl.definition.ocp import OCP
from nocl.support import checks
from nocl.support.lazy import hand_on

NAMES = ("cartpole", "acrobot", "quadrotor", "dubins", "pendulum", "double_integrator", "van_der_pol")
__all__ = ["NAMES", "load_ocp"]
__getattr__, __dir__ = hand_on(__name__, {})
_OCP = "ocp = nocl.OCP(...), or a function ocp() that returns one"


def load_ocp(name_or_path: str | os.PathLike[str], **options: Any) -> OCP:
    """The problem of a bundled name, or of a user's .py file that defines `ocp` (an OCP or a function returning one).

    `options` go to that function; a bundled problem's are its horizon, weights, ... and its system's constants.
    A user's file may import its neighbours; nothing is written beside it, and sys.path and sys.modules stay as they
    were. Raises ValueError, in one line, for whatever keeps the problem from being loaded.
    """
    if not isinstance(name_or_path, (str, os.PathLike)):
        raise ValueError(f"load_ocp got a {type(name_or_path).__name__}; expected a name ({', '.join(NAMES)}) "
                         "or the path of a .py file")
    text = os.fsdecode(name_or_path)
    return _bundled(text, options) if text in NAMES else _from_file(_user_file(text), text, options)


def _bundled(name: str, options: Mapping[str, Any]) -> OCP:
    module = importlib.import_module(f"nocl.systems.{name}")
    known = [p.name for function in (module.ocp, module.system) for p in inspect.signature(function).parameters.values()
             if p.kind is p.KEYWORD_ONLY]
    for option in options:
        if option not in known:
            hint = _did_you_mean(option, known)
            raise ValueError(f"{name} has no option {option!r}{hint}; expected {', '.join(known)}")
    try:
        problem: OCP = module.ocp(**options)
    except (TypeError, NotImplementedError) as error:  # what arithmetic raises on a value that is no number
        raise ValueError(f"{name}: {_one_line(error)}; expected numbers as options, got {dict(options)}") from error
    return problem


def _user_file(text: str) -> Path:
    """The file that `text` names; ValueError unless it is a Python file."""
    path = checks.folder(text, "the file", "load_ocp")
    remedy = f"expected a Python file that defines `ocp`, or one of {', '.join(NAMES)}"
    if path.suffix == ".py":
        if not path.is_file():
            raise ValueError(f"there is no file {text}; {remedy}")
        return path.resolve()
    if path.exists() or len(path.parts) > 1:
        raise ValueError(f"{text} is not a .py file; {remedy}")
    guesses = [*NAMES, *(p.name for p in Path().glob("*.py"))]
    raise ValueError(f"there is no problem {text!r}{_did_you_mean(text, guesses)}; {remedy}")


def _did_you_mean(name: str, known: Iterable[str]) -> str:
    close = difflib.get_close_matches(name, list(known), n=2, cutoff=0.6)
    return f", did you mean {' or '.join(map(repr, close))}?" if close else ""


def _from_file(path: Path, shown: str, options: Mapping[str, Any]) -> OCP:
    """The OCP that `ocp` in the file is or returns; errors name the file, its line and what was raised there."""
    module = ModuleType(f"nocl_user_file_{path.stem}")
    module.__file__ = str(path)
    with _importing(module, path.parent):
        try:
            exec(compile(path.read_bytes(), str(path), "exec"), module.__dict__)
            value = getattr(module, "ocp", None)
            if callable(value):
                value = value(**options)
                options = {}
        except (Exception, SystemExit) as error:
            raise ValueError(f"{_place(error, path, shown)}: {_one_line(error)}") from error
    if not hasattr(module, "ocp"):
        raise ValueError(f"{shown} defines no `ocp`; expected {_OCP}")
    if not isinstance(value, OCP):
        raise ValueError(f"{shown}: `ocp` is a {type(value).__name__}; expected {_OCP}")
    if options:
        raise ValueError(f"{shown}: `ocp` is no function, so it takes no options (got {', '.join(options)}); "
                         "expected none, or def ocp(...) in the file")
    return value


@contextmanager
def _importing(module: ModuleType, folder: Path) -> Iterator[None]:
    """While it lasts, `module` can be imported from, and so can its neighbours in `folder`, without a trace."""
    path, modules, silent = list(sys.path), set(sys.modules), sys.dont_write_bytecode
    neighbours = {p.stem for p in folder.iterdir() if p.suffix == ".py" or (p / "__init__.py").is_file()} - modules
    sys.modules[module.__name__] = module  # dataclasses look their own module up
    sys.path.insert(0, str(folder))
    sys.dont_write_bytecode = True
    importlib.invalidate_caches()
    try:
        yield
    finally:
        sys.path[:], sys.dont_write_bytecode = path, silent
        for name in set(sys.modules) - modules:
            if name == module.__name__ or name.partition(".")[0] in neighbours:
                del sys.modules[name]


def _place(error: BaseException, path: Path, shown: str) -> str:
    """The innermost line of the user's file (or of a neighbour) that led to the error."""
    if isinstance(error, SyntaxError) and error.filename:
        return f"{shown if error.filename == str(path) else error.filename}, line {error.lineno}"
    frames = [f for f in traceback.extract_tb(error.__traceback__) if Path(f.filename).parent == path.parent]
    if not frames:
        return shown
    return f"{shown if frames[-1].filename == str(path) else frames[-1].filename}, line {frames[-1].lineno}"


def _one_line(error: BaseException) -> str:
    message = error.msg if isinstance(error, SyntaxError) else str(error)
    return f"{type(error).__name__}: {' '.join(message.split())}"
