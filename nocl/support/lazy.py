"""Public names handed on from the modules that define them, each imported when it is first used."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from importlib import import_module
from importlib.util import find_spec
from pkgutil import iter_modules
from typing import Any


def hand_on(package: str, names: Mapping[str, str]) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """(__getattr__, __dir__) of a package whose public `names` stand in other modules: name -> full module name.

    Its modules are there by their names, too: after `import nocl`, nocl.exports.c_code needs no import of its own.
    """

    def known() -> list[str]:
        module = sys.modules[package]
        modules = [m.name for m in iter_modules(module.__path__) if not m.name.startswith("_")]
        return sorted({*vars(module).get("__all__", ()), *names, *modules})

    def get(name: str) -> Any:
        if name in names:
            return getattr(import_module(names[name]), name)
        if not name.startswith("_") and find_spec(f"{package}.{name}"):
            return import_module(f"{package}.{name}")
        raise AttributeError(f"module {package!r} has no attribute {name!r}; it has "
                             f"{', '.join(known())}")

    return get, known
