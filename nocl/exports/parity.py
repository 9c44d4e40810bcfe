"""Is the export the trained one? Values and first derivatives of every backend against torch in float64, by numbers.

Samples: corners of the box and uniform points inside, rounded to float32, so that all backends get the same numbers.
An error in a value is relative to the largest of that value over the samples, and to what a change of inputs, relative
to their own sizes, makes of it, since no code is better than the digits of its numbers; so is an error in a derivative,
each times the size of its input. Nothing depends on units.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import torch
from torch import Tensor

from nocl.exports.c_code import to_c
from nocl.nets import FeatureNet
from nocl.support.checks import Array

LIMITS = {"float64": 1e-12, "float32": 1e-5}
TRIALS, STEP = 4, 1e-7  # of relative changes of the inputs
Rows = Callable[[Array], Array]  # z [N, n] -> values [N, m] or derivatives [N, m, n]


@dataclass(frozen=True, eq=False)
class ExportPart:
    """One function that is exported, and what it has to equal."""

    name: str
    casadi: ca.Function  # native, columns
    torch: Callable[..., Tensor]  # rows in float64; a matrix answer as its rows, one after the other
    bounds: Mapping[str, Any]  # (lower, upper) of each input, which samples are drawn from
    labels: Mapping[str, Sequence[str]] = field(default_factory=dict)
    net: FeatureNet | None = None  # itself a network: other formats take it as it is
    lean: ca.Function | None = None  # `column` with less workspace, for C

    @property
    def column(self) -> ca.Function:
        """The native function with its answer as a column, a matrix row by row."""
        f = self.casadi
        if f.size2_out(0) == 1:
            return f
        args = f.mx_in()
        return ca.Function(f.name(), args, [ca.vec(f(*args).T)], f.name_in(), f.name_out())

    @property
    def sizes(self) -> list[int]:
        return [self.casadi.size1_in(i) for i in range(self.casadi.n_in())]

    def to_c(self, folder: Path, prefix: str, *, dtype: str, note: str = "") -> Path:
        """C99 in `folder`, as PREFIX_NAME."""
        return to_c(self.lean or self.column, folder, f"{prefix}_{self.name}", bounds=self.bounds, labels=self.labels,
                    dtype=dtype, note=note)


@dataclass(frozen=True)
class Finding:
    """The largest error of one backend on one function."""

    part: str
    backend: str
    dtype: str
    of: str  # "value" or "first derivatives"
    error: float
    limit: float
    at: Mapping[str, Any]  # the inputs where it is largest

    @property
    def ok(self) -> bool:
        return self.error <= self.limit  # NaN is not

    def __str__(self) -> str:
        return (f"{self.part}: {self.backend} ({self.dtype}) differs from torch (float64) in its {self.of} by "
                f"{self.error:.3g}, limit {self.limit:g}, at {dict(self.at)}")


@dataclass(frozen=True)
class Certificate:
    """What was compared, on how many points, what was left out and why, and what was not written, since it differs."""

    findings: Sequence[Finding]
    points: int
    left_out: Mapping[str, str] = field(default_factory=dict)
    inputs: Mapping[str, Sequence[str]] = field(default_factory=dict)  # what stands in each, with its unit
    refused: Mapping[str, str] = field(default_factory=dict)  # by the folder's name of a form

    @property
    def ok(self) -> bool:
        """Whether all that was compared is equal."""
        return all(f.ok for f in self.findings) and not self.refused

    def __str__(self) -> str:
        worst: dict[str, Finding] = {}
        for f in self.findings:
            key = f"{f.backend} {f.dtype}"
            if key not in worst or not f.error <= worst[key].error:
                worst[key] = f
        figures = ", ".join(f"{key} {f.error:.1e}" for key, f in worst.items())
        parts = ", ".join(dict.fromkeys(f.part for f in self.findings))
        missing = f"; not compared: {', '.join(self.left_out)}" if self.left_out else ""
        refused = "".join(f"; NOT written: {form} ({why})" for form, why in self.refused.items())
        return (f"parity {'ok' if self.ok else 'in part'}: {parts} against torch float64 on {self.points} points, "
                f"largest error: {figures}{missing}{refused}")

    def to_data(self) -> dict[str, Any]:
        """As plain JSON data."""
        rows = [{**vars(f), "at": dict(f.at), "ok": f.ok} for f in self.findings]
        inputs = {name: list(labels) for name, labels in self.inputs.items()}
        return {"summary": str(self), "ok": self.ok, "points": self.points, "left_out": dict(self.left_out),
                "refused": dict(self.refused), "limits": LIMITS, "inputs": inputs, "findings": rows}


def samples(part: ExportPart, n: int = 192, corners: int = 64, seed: int = 0) -> Array:
    """Corners of the part's box (all, where they are few) and n uniform points in it, [N, inputs]."""
    boxes = [[np.broadcast_to(b, size) for b in part.bounds[name]]
             for name, size in zip(part.casadi.name_in(), part.sizes, strict=True)]
    lower, upper = (np.hstack([box[i] for box in boxes]) for i in (0, 1))
    rng, d = np.random.default_rng(seed), len(lower)
    at = np.array([[i >> k & 1 for k in range(d)] for i in range(2**d)]) if 2**d <= corners else \
        rng.integers(0, 2, (corners, d))
    z = np.vstack([lower + at * (upper - lower), rng.uniform(lower, upper, (n, d))])
    return np.clip(z.astype(np.float32).astype(np.float64), lower, upper)


Reference = tuple[Array, Array, Array]  # values [N, m], first derivatives [N, m, n], how they change [N, m, n]


def reference_of(part: ExportPart, z: Array) -> Reference:
    """Values and derivatives by torch in float64, and what changes of z, relative to the box, make of the latter."""
    y, J = of_torch(part, z)
    signs = np.random.default_rng(1).choice([-1.0, 1.0], (TRIALS, z.shape[1]))
    size = _sizes(z)
    change = [np.abs(of_torch(part, np.clip(z + STEP * size * s, z.min(axis=0), z.max(axis=0)))[1] - J) / STEP
              for s in signs]
    return y, J, np.max(change, axis=0)


def of_torch(part: ExportPart, z: Array) -> tuple[Array, Array]:
    """Values [N, m] and first derivatives [N, m, n] by torch, in float64."""
    rows = torch.from_numpy(z.copy()).requires_grad_(True)
    y = part.torch(*torch.split(rows, part.sizes, dim=1))
    slopes = [torch.autograd.grad(y[:, i].sum(), rows, retain_graph=True, allow_unused=True)[0]
              for i in range(y.shape[1])]
    return y.detach().numpy(), np.stack([(torch.zeros_like(rows) if s is None else s).numpy() for s in slopes], 1)


def of_casadi(function: ca.Function) -> tuple[Rows, Rows]:
    """Values and first derivatives of a Function with a column answer, as functions of rows."""
    sizes = [function.size1_in(i) for i in range(function.n_in())]
    z = ca.MX.sym("z", sum(sizes))
    y = function(*ca.vertsplit(z, [0, *np.cumsum(sizes).tolist()]))
    m, n = function.size1_out(0), sum(sizes)
    value = ca.Function("value", [z], [ca.densify(y)])
    slope = ca.Function("slope", [z], [ca.densify(ca.jacobian(y, z))])

    def values(rows: Array) -> Array:
        return value.map(len(rows))(rows.T).full().T

    def slopes(rows: Array) -> Array:
        return slope.map(len(rows))(rows.T).full().reshape(m, len(rows), n).transpose(1, 0, 2)

    return values, slopes


def findings(part: ExportPart, backend: str, dtype: str, z: Array, values: Rows, slopes: Rows | None = None,
             reference: Reference | None = None) -> list[Finding]:
    """A backend's largest errors in values, and in first derivatives where it has them."""
    (y, J, change), size = reference or reference_of(part, z), _sizes(z)
    scale = np.maximum(np.abs(y).max(axis=0), _finite(np.abs(J) @ size))
    found = [_finding(part, backend, dtype, "value", z, values(z) - y, scale)]
    if slopes is not None:
        J, off, bent = J * size, (slopes(z) - J) * size, change * size
        scale = np.maximum(_finite(np.abs(J)).max(axis=(0, 2), keepdims=True)[0].T, _finite(bent.max(axis=2)))
        found.append(_finding(part, backend, dtype, "first derivatives", z, off, scale[..., None]))
    return found


def _finite(size: Array) -> Array:
    """A kink or a pole says nothing of how large errors may be."""
    return np.where(np.isfinite(size), size, 0.0)


def _sizes(z: Array) -> Array:
    """[n], what inputs z [N, n] are in size; 1 of one that is 0 throughout."""
    size: Array = np.abs(z).max(axis=0)
    return np.where(size > 0, size, 1.0)


def _finding(part: ExportPart, backend: str, dtype: str, of: str, z: Array, difference: Array, scale: Array) -> Finding:
    error = (np.abs(difference) / np.where(scale > 0, scale, 1.0)).reshape(len(z), -1).max(axis=1)
    worst = int(np.argmax(np.where(np.isnan(error), np.inf, error)))
    parts = np.split(z[worst], np.cumsum(part.sizes)[:-1])
    at = {name: v.tolist() if len(v) > 1 else float(v[0]) for name, v in zip(part.casadi.name_in(), parts, strict=True)}
    return Finding(part.name, backend, dtype, of, float(error[worst]), LIMITS[dtype], at)
