"""From CasADi instructions to torch, JAX and C, and the one discretisation that they share."""

from __future__ import annotations

from nocl.support.lazy import hand_on

__getattr__, __dir__ = hand_on(__name__, {})
