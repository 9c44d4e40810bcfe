"""Multiple shooting: the reference, per initial state."""

from __future__ import annotations

from nocl.support.lazy import hand_on

_LAZY = {"NMPC": "nocl.solvers.nmpc.solver", "Loop": "nocl.solvers.nmpc.loop"}
__all__ = list(_LAZY)
__getattr__, __dir__ = hand_on(__name__, _LAZY)
