"""`nocl ...`: the top floor, imported by nobody."""

from __future__ import annotations

from nocl.cli.commands import main

__all__ = ["main"]
