"""Budgets and sizes of system identification, checked on construction."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from nocl.nets import ACTIVATIONS


@dataclass(frozen=True)
class Budget:
    """Of one network; more for functions of more variables."""

    width: int  # of its two hidden layers
    iterations: int  # of SOAP
    batch: int
    polish: int  # Levenberg-Marquardt steps
    polish_batch: int

    @staticmethod
    def of(variables: int) -> Budget:
        """What was enough for bundled systems: functions of one variable take seconds, of four about two minutes."""
        if variables <= 1:
            return Budget(12, 500, 256, 60, 512)
        if variables <= 2:
            return Budget(24, 2000, 1024, 40, 1024)
        if variables <= 4:
            return Budget(32, 3000, 1024, 60, 1024)
        return Budget(48 if variables <= 6 else 96, 6000, 1024, 40, 1024)


    @staticmethod
    def plain(variables: int) -> Budget:
        """Of one plain network of many variables with Jacobian labels (nocl.sysid_plain), one to two minutes."""
        return Budget(96 if variables <= 6 else 128, 15_000, 512, 0, 512)


@dataclass(frozen=True)
class Settings:
    """Of methods "default" and "mlp". None: by the number of a network's variables, as in Budget.of."""

    # where labels are fewer than two for each weight, networks are narrower than this, and polished for longer
    width: int | None = None
    iterations: int | None = None
    batch: int | None = None
    polish: int | None = None  # Levenberg-Marquardt steps; none for networks of more than 2,600 parameters
    polish_batch: int | None = None
    lr: float = 4e-3  # of SOAP, cosine schedule
    samples: int = 200_000  # labels of f to draw (with data: all of it is used, and no more)
    gradient_weight: float = 1.0  # of derivatives beside values, each in units of its own spread
    structure: bool = True  # read the structure off the Jacobian labels first
    features: bool = True  # look for polynomials in variables and sin, cos of angles
    angles: bool = True  # networks see angles as sin and cos
    probes: int = 64  # points at which the structure is looked for, for each variable

    def __post_init__(self) -> None:
        given = [n for n in ("width", "batch", "polish_batch") if getattr(self, n) is not None]
        _positive(self, (*given, "samples", "probes"), integer=True)
        _positive(self, [n for n in ("iterations", "polish") if getattr(self, n) is not None], integer=True, zero=True)
        _positive(self, ("lr",))
        _positive(self, ("gradient_weight",), zero=True)

    def budget(self, variables: int, plain: bool = False) -> Budget:
        """The budget of a network of so many variables."""
        own = {name: getattr(self, name) for name in Budget.__dataclass_fields__}
        default = Budget.plain(variables) if plain else Budget.of(variables)
        return replace(default, **{name: value for name, value in own.items() if value is not None})


@dataclass(frozen=True)
class LogSettings:
    """Of identification from logged trajectories."""

    width: int = 32  # of the two hidden layers
    iterations: int = 300  # of L-BFGS on derivatives
    steps: int = 20  # Gauss-Newton steps on simulation error, at most; 0: derivatives alone
    window: int = 40  # samples that are simulated in one go
    windows: int = 1000  # at most, drawn at random beyond
    substeps: int = 1  # RK4 steps between two samples
    ridge: float = 1e-6  # times the sum of squared weights, beside the mean of squared residuals
    angles: bool = True  # networks see angles as sin and cos

    def __post_init__(self) -> None:
        _positive(self, ("width", "window", "windows", "substeps"), integer=True)
        _positive(self, ("iterations", "steps"), integer=True, zero=True)
        _positive(self, ("ridge",), zero=True)


@dataclass(frozen=True)
class PaperSettings:
    """Of method "paper": a three-layer MLP (two hidden layers), Adam, exponentially decaying rate."""

    width: int = 128
    layers: int = 3  # of weights
    activation: str = "sine"
    iterations: int = 50_000
    batch: int = 256
    lr: float = 0.01
    final_lr: float = 1e-5
    samples: int = 200_000
    frequency: float = 6.0  # standard deviation of angles as inputs, in which f oscillates; of others, and outputs: 1

    def __post_init__(self) -> None:
        _positive(self, ("width", "iterations", "batch", "samples"), integer=True)
        _positive(self, ("lr", "final_lr", "frequency"))
        if not isinstance(self.layers, int) or self.layers < 2:
            raise ValueError(f"PaperSettings: layers is {self.layers!r}; expected an integer >= 2")
        if self.activation not in ACTIVATIONS:
            raise ValueError(f"PaperSettings: activation is {self.activation!r}; "
                             f"expected one of {', '.join(ACTIVATIONS)}")


def _positive(settings: Any, names: Sequence[str], *, integer: bool = False, zero: bool = False) -> None:
    for name in names:
        value = getattr(settings, name)
        kind = int if integer else (int, float)
        good = isinstance(value, kind) and not isinstance(value, bool) and np.isfinite(value)
        if not good or value < 0 or (value == 0 and not zero):
            what = f"{'an integer' if integer else 'a number'} {'>= 0' if zero else '> 0'}"
            raise ValueError(f"{type(settings).__name__}: {name} is {value!r}; expected {what}")
