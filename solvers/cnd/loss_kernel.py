"""The loss of a value function and its gradient as compiled C (csrc/value_loss.h): what autograd gives, several times
faster."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from nocl.nets import MLP
from nocl.support.pool import cores
from nocl.translate.kernels import Kernel


class ValueKernel:
    """Mean over rows of sqrt((w (V - V*))^2 + v |V_x - V_x*|^2 + rounding^2), V = |y|^2, y a tanh MLP with a skip.

    Labels are rows, of one float type (float32 or float64): phi [n, F], the nonzeros of d phi / d x [n, nz] at
    `rows_of`, `columns` [nz], V_x* [n, nx], V* [n, 1], w [n, 1], v [n, 1]; V in units in which V = |y|^2. Raises
    ValueError where there is no C compiler.
    """

    def __init__(self, mlp: MLP, phi: Tensor, slope: Tensor, rows_of: Tensor, columns: Tensor, V_x: Tensor, V: Tensor,
                 w: Tensor, v: Tensor, rounding: float) -> None:
        if mlp.activation != "tanh" or mlp.skip is None:
            raise ValueError(f"ValueKernel: the network is of {mlp.activation}, skip {mlp.skip is not None}; expected "
                             "tanh and a skip")
        self.parameters = [*_layers(mlp.body), mlp.skip.weight]
        self.kernel = Kernel(_source(mlp.sizes, phi.dtype, V_x.shape[1], slope.shape[1], rounding))
        padding = -(phi.shape[1] + slope.shape[1] + V_x.shape[1] + 3) % 16
        self.labels = torch.cat([phi, slope, V_x, V, w, v, phi.new_zeros(len(phi), padding)], 1).numpy()
        self.slopes = [i.numpy().astype(np.int64) for i in (rows_of, columns)]
        size = np.empty(1, np.int64)
        self.kernel("nocl_value_work", size, size)
        self.bytes, self.work = int(size[0]), np.empty(0)
        self.threads = cores()

    def __call__(self, rows: Tensor) -> Tensor:
        """The loss of these rows [B], a scalar that autograd can go back from."""
        value: Tensor = _WithGradient.apply(self, rows, *self.parameters)  # type: ignore[no-untyped-call]
        return value

    def value_and_gradient(self, rows: NDArray[np.int64], theta: NDArray[Any]) -> tuple[float, NDArray[Any]]:
        """The loss, and its gradient [P] in the weights theta [P]."""
        if theta.dtype != self.labels.dtype:
            raise ValueError(f"the loss of V was made for weights in {self.labels.dtype}; got {theta.dtype}: make it "
                             "again after net.float() or net.double()")
        if len(rows) == 0 or rows.min() < 0 or rows.max() >= len(self.labels):
            raise IndexError(f"the loss of V has {len(self.labels)} labels; got {len(rows)} row numbers"
                             + (f" from {rows.min()} to {rows.max()}" if len(rows) else ""))
        blocks = -(-len(rows) // self.kernel.width)  # their sums are the same whatever the number of threads
        if 8 * len(self.work) < blocks * self.bytes:
            self.work = np.empty(-(-blocks * self.bytes // 8))
        value, gradient = np.empty(blocks), np.empty((blocks, len(theta)), theta.dtype)
        self.kernel("nocl_value_loss", rows, len(rows), theta, self.labels, *self.slopes, self.work, gradient, value,
                    threads=self.threads)
        return float(value.sum()), gradient.sum(0)


class _WithGradient(torch.autograd.Function):
    """The loss as an operation on the network's parameters; the gradient comes with the value."""

    @staticmethod
    def forward(ctx: Any, kernel: ValueKernel, rows: Tensor, *parameters: Tensor) -> Tensor:
        theta = torch.cat([p.detach().flatten() for p in parameters]).numpy()
        value, gradient = kernel.value_and_gradient(rows.numpy(), theta)
        pieces = torch.from_numpy(gradient).split([p.numel() for p in parameters])
        ctx.gradients = [piece.view_as(p) for piece, p in zip(pieces, parameters, strict=True)]
        return torch.tensor(value, dtype=parameters[0].dtype)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, bar: Tensor) -> Any:  # type: ignore[override]
        return (None, None, *(g * bar for g in ctx.gradients))


def _layers(body: nn.Sequential) -> list[Tensor]:
    """W_1, b_1, ..., W, b."""
    return [p for layer in body if isinstance(layer, nn.Linear) for p in (layer.weight, layer.bias)]


def _source(sizes: Sequence[int], dtype: torch.dtype, nx: int, nonzeros: int, rounding: float) -> str:
    values = {"SINGLE": int(dtype == torch.float32), "NF": sizes[0], "NX": nx, "NS": nonzeros,
              "LAYERS": len(sizes) - 1, "SIZES": "{" + ", ".join(map(str, sizes)) + "}", "WIDEST": max(sizes),
              "ROUND": repr(rounding)}
    return "".join(f"#define {k} {v}\n" for k, v in values.items()) + '#include "value_loss.h"\n'
