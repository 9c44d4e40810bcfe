"""The tables of the paper, made again: one module a table, its published numbers beside ours."""

from __future__ import annotations

from nocl.support.lazy import hand_on

__getattr__, __dir__ = hand_on(__name__, {})
