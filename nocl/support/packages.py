"""Optional packages, imported where they are used."""

from __future__ import annotations

from importlib import import_module
from typing import Any


def package(name: str, distribution: str | None = None) -> Any:
    """An optional package; ValueError that says how to install it."""
    try:
        return import_module(name)
    except ImportError as error:
        what = distribution or "nocl[interop]"
        raise ValueError(f"{name} cannot be imported ({error}): pip install {what!r}") from None
