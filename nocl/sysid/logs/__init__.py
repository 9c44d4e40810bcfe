"""Logged trajectories of a real plant: files, smoothing, simulation errors, where the log has been."""

from __future__ import annotations

from nocl.support.lazy import hand_on

__getattr__, __dir__ = hand_on(__name__, {})
