"""CND, control with neural dynamics: a neural feedback controller and value function for a whole region of states."""

from __future__ import annotations

from nocl.solvers.cnd.controller import CND, pretrained
from nocl.solvers.cnd.settings import TrainSettings
from nocl.solvers.cnd.train import train

__all__ = ["CND", "TrainSettings", "pretrained", "train"]
