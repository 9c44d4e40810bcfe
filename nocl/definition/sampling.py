"""Distributions of states and parameters: seeded, frozen, rows [n, nx]."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from nocl.support.checks import Array, Vector, generator, numeric, vector, whole

Seed = int | np.random.Generator
STREAM = 0x6E6F636C  # nocl's own random numbers: never those of sample(n, seed), whatever the seed


def _length(value: Vector, name: str, owner: str) -> int:
    shape = numeric(value, name, owner, "a vector: pass one number per state").shape
    if len(shape) != 1 or shape[0] == 0:
        raise ValueError(f"{owner}: {name} has shape {shape}, expected a vector: pass one number per state")
    return int(shape[0])


def own_numbers(*key: int) -> np.random.Generator:
    """Random numbers for what is no sample of the user's: the states of comparisons are never drawn."""
    return np.random.default_rng([*key, STREAM])


def short(vector: Array) -> str:
    """A vector as text, six digits."""
    return "[" + ", ".join(f"{v:.6g}" for v in vector) + "]"


@dataclass(frozen=True, eq=False, repr=False)
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
        rng = generator(seed, "Gaussian.sample")
        return self.mean + self.std * rng.standard_normal((whole(n, "n", "Gaussian.sample"), self.n))

    def __repr__(self) -> str:
        return f"Gaussian(mean={short(self.mean)}, std={short(self.std)})"


@dataclass(frozen=True, eq=False, repr=False)
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
        rng = generator(seed, "Uniform.sample")
        return rng.uniform(self.lb, self.ub, (whole(n, "n", "Uniform.sample"), self.n))

    def __repr__(self) -> str:
        return f"Uniform(lb={short(self.lb)}, ub={short(self.ub)})"


Distribution = Gaussian | Uniform
STILL = 1e-2  # how far to either side of a fixed coordinate, relative
BULK = 4.0  # standard deviations: one normal number in 16,000 is further from the mean


def box(distribution: Distribution) -> tuple[Array, Array]:
    """(lower, upper) of where nearly all of a distribution lies: a Uniform's bounds, BULK deviations of a Gaussian."""
    if isinstance(distribution, Uniform):
        return distribution.lb, distribution.ub
    return distribution.mean - BULK * distribution.std, distribution.mean + BULK * distribution.std


def open_box(distribution: Distribution) -> tuple[Array, Array]:
    """The same with an inside: a coordinate that is held fixed has STILL of its value, or of 1, on either side."""
    low, high = box(distribution)
    least = np.where(high > low, 0.0, STILL * np.where(low == 0, 1.0, np.abs(low)))
    return low - least, high + least


def to_data(distribution: Distribution) -> dict[str, Any]:
    """A distribution as plain JSON data."""
    fields = {"mean": distribution.mean, "std": distribution.std} if isinstance(distribution, Gaussian) else \
        {"lb": distribution.lb, "ub": distribution.ub}
    return {"kind": type(distribution).__name__, **{name: value.tolist() for name, value in fields.items()}}


def from_data(data: Mapping[str, Any]) -> Distribution:
    """The distribution that to_data wrote; ValueError for anything else."""
    kinds: dict[Any, Any] = {"Gaussian": Gaussian, "Uniform": Uniform}
    fields = dict(data)
    kind = fields.pop("kind", None)
    if kind not in kinds:
        raise ValueError(f"the kind of a distribution is {kind!r}; expected {' or '.join(kinds)}")
    distribution: Distribution = kinds[kind](**fields)
    return distribution
