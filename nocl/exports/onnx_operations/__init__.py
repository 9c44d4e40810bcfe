"""What ONNX's operations mean, on numbers that are known and on numbers that depend on the inputs."""

from __future__ import annotations

from nocl.support.lazy import hand_on

__getattr__, __dir__ = hand_on(__name__, {})
