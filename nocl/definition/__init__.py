"""What a user writes: a System and an OCP on it, parameters, constraints, where states lie; and their functions."""

from __future__ import annotations

from nocl.support.lazy import hand_on

__getattr__, __dir__ = hand_on(__name__, {})
