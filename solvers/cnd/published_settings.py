"""Settings of method="paper"."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from nocl import hjb
from nocl.nets import ACTIVATIONS
from nocl.translate.rk4 import rk4_cost

STEPS: dict[str, hjb.Step] = {"rk4": rk4_cost, "euler": hjb.euler_cost}


@dataclass(frozen=True)
class PaperSettings:
    """Settings of method="paper"; the defaults are the paper's wherever it says."""

    hidden: Sequence[int] = (64, 64)  # widths of the controller's hidden layers
    value_hidden: Sequence[int] = (64, 64)  # widths of the value function's
    activation: str = "tanh"
    time_input: bool = False  # True: u(x, t), which the optimum of a finite horizon needs; the paper has u(x)
    near_goal: float | None = None  # the controller starts at u*, its last layer's random weights times this; None: off
    sin_cos: bool = True  # sin and cos of declared angles as inputs, beside their values
    intervals: int = 40  # K: steps of a rollout
    step: str = "rk4"  # or "euler", as published
    hold: bool = False  # False: feedback inside RK4's stages, as in a neural ODE; True: held over intervals
    fused: bool = True  # held RK4 steps of the exact f as compiled C on the CPU; False: in torch, same gradients
    iterations: int = 1000  # of Adam, after the race
    batch: int = 64  # initial states an iteration
    learning_rate: float = 0.01
    decay: float = 0.01  # the learning rate falls exponentially, to this share of its start
    weights: tuple[float, float, float, float] = (1.0, 1.0, 0.01, 0.01)  # of L_cost, L_HJB, L_final, L_hamil
    clip: float | None = 1.0  # the gradient's norm, of u and of V each; None: not clipped
    detach: bool = False  # True: L_HJB, L_final, L_hamil see the trajectory's states as constants
    race: int = 8  # random initial controllers that start side by side; 1: no race
    race_iterations: int = 200  # of L_cost alone, for each of them
    race_batch: int = 16  # initial states an iteration, for each of them
    patience: int | None = None  # stop after so many of the 40 checks without a lower held-out cost; None: never

    def __post_init__(self) -> None:
        for name in ("hidden", "value_hidden"):
            widths = tuple(getattr(self, name))
            if not widths or not all(_is_count(w) for w in widths):
                raise ValueError(f"PaperSettings: {name} is {widths}; expected widths of hidden layers, like (64, 64)")
            object.__setattr__(self, name, widths)
        for name in ("intervals", "iterations", "batch", "race", "race_iterations", "race_batch"):
            if not _is_count(getattr(self, name)):
                raise ValueError(f"PaperSettings: {name} is {getattr(self, name)!r}; expected an integer >= 1")
        if self.patience is not None and not _is_count(self.patience):
            raise ValueError(f"PaperSettings: patience is {self.patience!r}; expected an integer >= 1, or None")
        self._check_numbers()
        for name in ("time_input", "sin_cos", "hold", "fused", "detach"):
            if not isinstance(getattr(self, name), bool):
                raise ValueError(f"PaperSettings: {name} is {getattr(self, name)!r}; expected True or False")
        if not self.hold and self.step != "rk4":
            raise ValueError(f"PaperSettings: step is {self.step!r} with hold=False; expected step='rk4', which "
                             "feedback in continuous time is integrated by")
        for name, known in (("activation", ACTIVATIONS), ("step", STEPS)):
            if getattr(self, name) not in known:
                raise ValueError(f"PaperSettings: {name} is {getattr(self, name)!r}; expected {', '.join(known)}")

    def _check_numbers(self) -> None:
        for name in ("learning_rate", "decay", "clip", "near_goal"):
            value = getattr(self, name)
            if not (value is None and name in ("clip", "near_goal")) and not (_is_number(value) and value > 0):
                raise ValueError(f"PaperSettings: {name} is {value!r}; expected a finite number > 0"
                                 + {"clip": ", or None for no clipping",
                                    "near_goal": ", or None for weights as random as the others"}.get(name, ""))
        if self.decay > 1:
            raise ValueError(f"PaperSettings: decay is {self.decay!r}; expected at most 1, which is no decay")
        weights: Any = tuple(self.weights) if isinstance(self.weights, (tuple, list)) else (self.weights,)
        if len(weights) != 4 or not all(_is_number(w) and w >= 0 for w in weights) or weights[0] == 0:
            raise ValueError(f"PaperSettings: weights is {weights}; expected four numbers >= 0, of L_cost (not 0), "
                             "L_HJB, L_final, L_hamil: the paper's are (1, 1, 0.01, 0.01)")
        object.__setattr__(self, "weights", weights)


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)


def _is_count(value: Any) -> bool:
    return isinstance(value, (int, np.integer)) and not isinstance(value, bool) and bool(value >= 1)
