"""Safeguards: what a law answers is taken only where its plan is known to stay within what is held, and to arrive."""

from __future__ import annotations

from nocl.support.lazy import hand_on

_LAZY = {"Safeguard": "nocl.solvers.safeguard.guarded"}
__all__ = list(_LAZY)
__getattr__, __dir__ = hand_on(__name__, _LAZY)
