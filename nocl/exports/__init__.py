"""Ways out, CasADi, L4CasADi, ONNX, C and other toolboxes, and the proof that what went out is what was trained."""

from __future__ import annotations

from nocl.support.lazy import hand_on

__getattr__, __dir__ = hand_on(__name__, {})
