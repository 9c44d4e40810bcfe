"""Errors of a learned f_theta on exact labels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from nocl.checks import Array
from nocl.data import Dataset
from nocl.nets import FeatureNet


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
