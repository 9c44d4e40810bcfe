"""Distributions of states: seeded, frozen, rows [n, nx]."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from nocl.checks import Array, Vector, vector

Seed = int | np.random.Generator


def _length(value: Vector, name: str, owner: str) -> int:
    shape = np.shape(value)
    if len(shape) != 1 or shape[0] == 0:
        raise ValueError(f"{owner}: {name} has shape {shape}, expected a vector: pass one number per state")
    return int(shape[0])


@dataclass(frozen=True, eq=False)
class Gaussian:
    """Independent normal coordinates: x_i ~ N(mean_i, std_i^2); std_i = 0 holds a coordinate fixed."""

    mean: Vector
    std: Vector

    def __post_init__(self) -> None:
        n = _length(self.mean, "mean", "Gaussian")
        object.__setattr__(self, "mean", vector(self.mean, n, "mean", "Gaussian"))
        object.__setattr__(self, "std", vector(self.std, n, "std", "Gaussian"))
        if (self.std < 0).any() or not np.isfinite([self.mean, self.std]).all():
            raise ValueError(f"Gaussian: std is {self.std.tolist()}; expected finite mean and finite std >= 0")

    @property
    def n(self) -> int:
        return len(self.mean)

    @property
    def centre(self) -> Array:
        return self.mean

    def sample(self, n: int, seed: Seed = 0) -> Array:
        """n independent states [n, nx]; the same seed gives the same states."""
        rng = np.random.default_rng(seed)
        return self.mean + self.std * rng.standard_normal((n, self.n))


@dataclass(frozen=True, eq=False)
class Uniform:
    """Independent uniform coordinates: x_i ~ U[lb_i, ub_i]; lb_i = ub_i holds a coordinate fixed."""

    lb: Vector
    ub: Vector

    def __post_init__(self) -> None:
        n = _length(self.lb, "lb", "Uniform")
        object.__setattr__(self, "lb", vector(self.lb, n, "lb", "Uniform"))
        object.__setattr__(self, "ub", vector(self.ub, n, "ub", "Uniform"))
        if (self.ub < self.lb).any() or not np.isfinite([self.lb, self.ub]).all():
            raise ValueError(f"Uniform: lb is {self.lb.tolist()}, ub is {self.ub.tolist()}; "
                             "expected finite lb <= ub")

    @property
    def n(self) -> int:
        return len(self.lb)

    @property
    def centre(self) -> Array:
        return (self.lb + self.ub) / 2

    def sample(self, n: int, seed: Seed = 0) -> Array:
        """n independent states [n, nx]; the same seed gives the same states."""
        rng = np.random.default_rng(seed)
        return rng.uniform(self.lb, self.ub, (n, self.n))


Distribution = Gaussian | Uniform
