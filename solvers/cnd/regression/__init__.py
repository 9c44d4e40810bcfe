"""What controllers are fitted to, and what networks see and say: labels, features, output maps, fits."""

from __future__ import annotations

from nocl.support.lazy import hand_on

__all__: list[str] = []
__getattr__, __dir__ = hand_on(__name__, {})
