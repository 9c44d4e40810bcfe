"""Budgets and sizes of system identification, checked on construction."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar

from nocl.nets import ACTIVATIONS
from nocl.support.fields import Checked, Scaled, choice, count, flag, nonnegative, positive


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
        """Of one plain network of many variables with Jacobian labels (nocl.sysid.plain), one to two minutes."""
        return Budget(96 if variables <= 6 else 128, 15_000, 512, 0, 512)


BY_SIZE = "by the number of its variables"


@dataclass(frozen=True)
class Settings(Scaled):
    """Of methods "default" and "mlp". None: by the number of a network's variables, as in Budget.of."""

    EFFORT: ClassVar[Mapping[str, Mapping[str, Any]]] = {
        "quick": {"iterations": 300, "polish": 10},
        "best": {"polish": 200}}

    # where labels are fewer than two for each weight, networks are narrower than this, and polished for longer
    width: int | None = count(None, "of a network's two hidden layers", none=BY_SIZE)
    iterations: int | None = count(None, "of SOAP", least=0, none=BY_SIZE)
    batch: int | None = count(None, "labels in a step of SOAP", none=BY_SIZE)
    polish: int | None = count(None, "Levenberg-Marquardt steps; none for networks of more than 2,600 parameters",
                               least=0, none=BY_SIZE)
    polish_batch: int | None = count(None, "labels in each of those", none=BY_SIZE)
    lr: float = positive(4e-3, "of SOAP, cosine schedule")
    samples: int = count(200_000, "labels of f to draw (with data: all of it is used, and no more)")
    gradient_weight: float = nonnegative(1.0, "of derivatives beside values, each in units of its own spread")
    structure: bool = flag(True, "read the structure off the Jacobian labels first")
    features: bool = flag(True, "look for polynomials in variables and sin, cos of angles")
    angles: bool = flag(True, "networks see angles as sin and cos")
    probes: int = count(64, "points at which the structure is looked for, for each variable")
    minutes: float | None = positive(None, "of wall-clock time that the networks' fits are made to end in",
                                     none="as long as they take")

    def budget(self, variables: int, plain: bool = False) -> Budget:
        """The budget of a network of so many variables."""
        own = {name: getattr(self, name) for name in Budget.__dataclass_fields__}
        default = Budget.plain(variables) if plain else Budget.of(variables)
        return replace(default, **{name: value for name, value in own.items() if value is not None})


@dataclass(frozen=True)
class LogSettings(Scaled):
    """Of identification from logged trajectories."""

    EFFORT: ClassVar[Mapping[str, Mapping[str, Any]]] = {
        "quick": {"width": 12, "iterations": 60, "steps": 3, "window": 20},
        "best": {"iterations": 600, "steps": 60, "windows": 3000}}

    width: int = count(32, "of the two hidden layers")
    iterations: int = count(300, "of L-BFGS on derivatives", least=0)
    steps: int = count(20, "Gauss-Newton steps on simulation error, at most, for each length of windows; 0: "
                       "derivatives alone", least=0)
    window: int = count(40, "steps that are simulated in one go in the end: windows start with 2, and grow")
    windows: int = count(1000, "of that length, at most, drawn at random beyond")
    substeps: int | None = count(None, "RK4 steps between two samples", none="1, or as many as the fit turns out to "
                                 "need; the card says how many")
    ridge: float | None = nonnegative(None, "times the sum of squared weights, beside the mean of squared residuals",
                                      none="one over the number of residuals, the most probable weights where those of "
                                      "a standard normal distribution are expected")
    angles: bool = flag(True, "networks see angles as sin and cos")


@dataclass(frozen=True)
class PaperSettings(Checked):
    """Of method "paper": a three-layer MLP (two hidden layers), Adam, exponentially decaying rate."""

    width: int = count(128, "of the hidden layers")
    layers: int = count(3, "of weights", least=2)
    activation: str = choice("sine", "of the hidden layers", ACTIVATIONS)
    iterations: int = count(50_000, "of Adam")
    batch: int = count(256, "labels in a step of Adam")
    lr: float = positive(0.01, "of Adam, at the start")
    final_lr: float = positive(1e-5, "of Adam, at the end")
    samples: int = count(200_000, "labels of f to draw")
    frequency: float = positive(6.0, "standard deviation of angles as inputs, in which f oscillates; of others, and "
                                "outputs: 1")
