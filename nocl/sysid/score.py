"""Errors of a learned f_theta on exact labels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from nocl.data import Dataset
from nocl.nets import FeatureNet
from nocl.support.checks import Array
from nocl.sysid.stated import Stated
from nocl.sysid.structure import Variables

MISSED, BENT = 0.05, 0.3  # of their spread: what known rows, and slopes in affine controls, may miss the labels by


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


def contradictions(net: FeatureNet, box: Variables, stated: Stated, z: Array, value: Array,
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
