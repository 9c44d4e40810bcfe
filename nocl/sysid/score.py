"""Errors of a learned f_theta on exact labels, and what labels and logs say against what is stated."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import casadi as ca
import numpy as np
import torch
from torch import Tensor

from nocl.data import Dataset
from nocl.nets import FeatureNet
from nocl.support.checks import Array
from nocl.sysid.logs.log import Log
from nocl.sysid.logs.plausible import check_rate
from nocl.sysid.stated import Stated
from nocl.sysid.structure import Box

MISSED, BENT = 0.05, 0.3  # of their spread: what known rows, and slopes in affine controls, may miss the labels by
SIGMAS = 3.0  # times what noise explains
LARGEST = 1e100  # of a rate: squares must not overflow
COARSE = 0.25  # of how far a rate moves in a step: what the trapezoidal rule may miss, and no more than half


@dataclass(frozen=True)
class Score:
    """Errors of f_theta on held-out samples of the box, in the units of xdot."""

    mean: float  # of ||f_theta - f||_2
    std: float
    median: float
    iqr: float
    jacobian: float  # mean Frobenius norm of the Jacobian's error
    n: int

    def __str__(self) -> str:
        return (f"||f_theta - f|| = {self.mean:.3g} +- {self.std:.2g}, median {self.median:.3g} (iqr {self.iqr:.2g}), "
                f"Jacobian {self.jacobian:.3g}, on {self.n} samples")


def score_of(net: FeatureNet, data: Dataset) -> Score:
    """Errors of a network on exact labels."""
    x, u = (torch.from_numpy(np.ascontiguousarray(a)) for a in (data.x, data.u))
    value, gradient = value_and_jacobian(net, x, u)
    error = np.linalg.norm(value - data.xdot, axis=1)
    assert data.A is not None
    assert data.B is not None
    slope = gradient - np.concatenate([data.A, data.B], axis=2)
    q1, median, q3 = np.percentile(error, [25, 50, 75])
    return Score(float(error.mean()), float(error.std()), float(median), float(q3 - q1),
                 float(np.linalg.norm(slope, axis=(1, 2)).mean()), len(error))


def value_and_jacobian(net: FeatureNet, x: Tensor, u: Tensor) -> tuple[Array, Array]:
    """f_theta [N, nx] and its Jacobian [N, nx, nz] at rows, by reverse mode, an output at a time."""
    z = torch.cat([x, u], 1).requires_grad_()
    y = net(z[:, : x.shape[1]], z[:, x.shape[1]:])
    rows = [torch.autograd.grad(y[:, i].sum() + 0 * z.sum(), z, retain_graph=True)[0] for i in range(y.shape[1])]
    return y.detach().numpy(), torch.stack(rows, 1).numpy()


def contradictions(net: FeatureNet, box: Box, stated: Stated, z: Array, value: Array,
                   gradient: Array | None) -> list[str]:
    """What is stated and the labels speak against, in words: known rows, and slopes in affine controls."""
    x, u = (torch.from_numpy(np.ascontiguousarray(a)) for a in np.split(z, [box.nx], axis=1))
    answer, slope = value_and_jacobian(net, x, u)
    said = [f"d {box.names[i]}/dt as it is known misses the labels by {100 * miss:.2g} % of their spread"
            for i in stated.rows if (miss := _missed(answer[:, i], value[:, i])) > MISSED]
    if stated.control_affine and gradient is not None:
        said += [f"d {box.names[i]}/dt affine in the controls misses its slopes in {box.names[k]} by {100 * miss:.2g} "
                 "% of their spread" for i in range(box.nx) if i not in stated.rows for k in range(box.nx, box.nz)
                 if (miss := _missed(slope[:, i, k], gradient[:, i, k])) > BENT]
    return said


def _missed(answer: Array, label: Array) -> float:
    """Root mean square of what is missed, over that of the labels about their mean, or a tenth of theirs."""
    spread = max(float(label.std()), 0.1 * float(np.sqrt(np.square(label).mean())), np.finfo(np.float64).tiny)
    return float(np.sqrt(np.square(answer - label).mean())) / spread


def contradictions_of(log: Log, stated: Stated) -> list[str]:
    """What the log's own steps say against stated rows, in words.

    Raises ValueError where a row is right but for a factor: a unit is wrong then.
    """
    said = []
    for i, row in stated.rows.items():
        name, rate = log.states[i], _rows(ca.Function("row", [stated.z], [row]))
        x, t = [r.x[:, i] for r in log], [r.t for r in log]
        last = [np.vstack([r.u, r.u[-1:]]) for r in log]
        rates = [rate(r.x, u) for r, u in zip(log, last, strict=True)]
        _check_finite(log, rates, f"d {name}/dt = {row}")
        check_rate(x, rates, t, name, str(row), "identify: known")
        missed, size, allowed = _misses(log, i, rate)
        if missed > allowed:
            said.append(f"d {name}/dt = {row} misses the log's own steps by {missed:.3g} (rms; their mean rates: "
                        f"{size:.3g}), where noise and sampling explain {allowed:.3g}")
    return said


def _check_finite(log: Log, rates: list[Array], words: str) -> None:
    for r, values in zip(log, rates, strict=True):
        bad = np.flatnonzero(np.isfinite(r.x).all(axis=1) & ~(np.abs(values) < LARGEST))
        if bad.size:
            raise ValueError(f"identify: known: {words} is {values[bad[0]]:.4g} at t = {r.t[bad[0]]:g} of run {r.run}; "
                             "expected numbers of ordinary size wherever the log has been: correct the row")


def _misses(log: Log, i: int, rate: Callable[[Array, Array], Array]) -> tuple[float, float, float]:
    """Root mean squares over all steps: what a row misses of the mean rates, these, what noise and sampling explain.

    A mean rate is (x_{k+1} - x_k) / h, and by the trapezoidal rule half of the row's values at both ends. That misses
    less than half the difference of these values, which is what a simulator's Euler steps miss.
    """
    miss, mean, change, noise = [], [], [], []
    for r in log:
        h, x = np.diff(r.t), r.x[:, i]
        first, last = rate(r.x[:-1], r.u), rate(r.x[1:], r.u)
        rates, smooth = np.diff(x) / h, rate(r.smooth.x[:-1], r.u)
        miss.append(rates - (first + last) / 2)
        mean.append(rates)
        change.append(last - first)
        noise.append(np.hypot(np.hypot(r.smooth.residual[:-1, i], r.smooth.residual[1:, i]) / h,
                              (first - smooth) / 2**0.5))
    missed, size, coarse, random = (_rms(np.concatenate(parts)) for parts in (miss, mean, change, noise))
    tiny = 1e-9 * size  # rounding
    return missed, size, float(np.sqrt((SIGMAS * random) ** 2 + (COARSE * coarse) ** 2)) + tiny


def _rows(row: ca.Function) -> Callable[[Array, Array], Array]:
    """(x [n, nx], u [n, nu]) -> [n]"""
    return lambda x, u: row(np.hstack([x, u]).T).full().ravel()


def _rms(values: Array) -> float:
    there = values[np.isfinite(values)]
    return float(np.sqrt(np.square(there).mean())) if there.size else 0.0
