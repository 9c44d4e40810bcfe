"""The paper's identification loss and its gradient, written out: an MLP's values and full Jacobians, no autograd.

For a batch of B rows, with t_l = W_l a_{l-1} + b_l and a_l = s(t_l) in the hidden layers l = 1, ..., L, y = W a_L + b:

    loss = mean_b |S (y - f)|_2 + mean_b |S_J * (J - df/dz)|_F,   J = W D_L W_L ... D_1 W_1,   D_l = diag s'(t_l)

or the same with squared norms. S [nx] and, entry by entry, S_J [nx, nz] weigh residuals: of normalised labels in
physical units.

J is built from the output down (a system has fewer equations than variables), its gradient from the input up. `Loss`
does this for three layers as compiled C (csrc/paper_loss.h), for others in torch, to rounding the same. In torch, rows
go through in blocks that stay in the cache, and the top two layers of all rows are one product, W D_L W_L = s'(t_L) M
with M[j, (o, k)] = W[o, j] W_L[j, k], which saves an array of B x nx x h numbers and its passes through memory.

Shapes: z [B, nz], f [B, nx], df/dz [B, nx, nz]; weights W_1, b_1, ..., W, b as in torch's Linear, W_l [h, h].
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from nocl.translate.kernels import Kernel

Curve = tuple[Tensor, Tensor, Tensor | None]  # s(t), s'(t), s''(t); None: zero everywhere
BLOCK = 2**17  # numbers of a block's largest array: half a megabyte


def _sine(t: Tensor) -> Curve:
    s = torch.sin(t)
    return s, torch.cos(t), -s


def _tanh(t: Tensor) -> Curve:
    s = torch.tanh(t)
    d = 1 - s * s
    return s, d, -2 * s * d


def _relu(t: Tensor) -> Curve:
    d = (t > 0).to(t.dtype)
    return t * d, d, None


def _silu(t: Tensor) -> Curve:
    s = torch.sigmoid(t)
    d = s * (1 - s)
    return t * s, s + t * d, d * (2 + t * (1 - 2 * s))


CURVES: dict[str, Callable[[Tensor], Curve]] = {"sine": _sine, "tanh": _tanh, "relu": _relu, "silu": _silu}


class Loss:
    """The loss over given labels (tensors of one float type, float32 or float64) and its gradient, for one MLP.

    theta [P] are its weights, W_1, b_1, ..., W, b by rows in one vector; scale [nx, 1 + nz] is S beside S_J, ones if
    None; squared: norms are. `compiled`: in C, for three layers of weights; raises ValueError where there is no C
    compiler.
    """

    def __init__(self, sizes: Sequence[int], activation: str, z: Tensor, f: Tensor, jacobian: Tensor | None, *,
                 compiled: bool, scale: Tensor | None = None, squared: bool = False) -> None:
        self.activation, self.squared = activation, squared
        self.scale = torch.ones(sizes[-1], 1 + sizes[0], dtype=z.dtype) if scale is None else scale.to(z.dtype)
        self.shapes = [s for n, m in pairwise(sizes) for s in ((m, n), (m,))]
        self.labels = None if compiled else (z, f, jacobian)
        self._compiled = _Compiled(sizes, activation, squared, z, f, jacobian, self.scale) if compiled else None

    def __call__(self, rows: Tensor, theta: Tensor, gradient: Tensor) -> float:
        """The mean of the loss over the labels' `rows` [B]; its gradient [P] is written into `gradient`."""
        if self._compiled is not None:
            return self._compiled(rows.numpy(), theta.numpy(), gradient.numpy())
        assert self.labels is not None
        z, f = (a[rows] for a in self.labels[:2])
        jacobian = None if self.labels[2] is None else self.labels[2][rows]
        value, parts = loss_and_gradient(self.weights(theta), self.activation, z, f, jacobian, self.scale,
                                         self.squared)
        torch.cat([p.flatten() for p in parts], out=gradient)
        return value

    def weights(self, theta: Tensor) -> list[Tensor]:
        """W_1, b_1, ..., W, b as views of theta."""
        parts = theta.split([int(np.prod(s)) for s in self.shapes])
        return [p.view(s) for p, s in zip(parts, self.shapes, strict=True)]


class _Compiled:
    """csrc/paper_loss.h over labels packed by rows, as it wants them: z, f, df/dz, zeros up to a multiple of 16."""

    def __init__(self, sizes: Sequence[int], activation: str, squared: bool, z: Tensor, f: Tensor,
                 jacobian: Tensor | None, scale: Tensor) -> None:
        self.kernel = Kernel(_source(sizes, activation, z.dtype, squared))
        parts = [z, f, *([] if jacobian is None else [jacobian.flatten(1)])]
        padding = -sum(p.shape[1] for p in parts) % 16
        self.labels = torch.cat([*parts, z.new_zeros(len(z), padding)], 1).numpy()
        self.jacobians = int(jacobian is not None)
        self.scale = torch.cat([scale[:, 0], scale[:, 1:].flatten()]).numpy()
        size = np.empty(1, np.int64)
        self.kernel("nocl_loss_work", size, size)
        self.work = np.empty(-(-int(size[0]) // 8))

    def __call__(self, rows: NDArray[np.int64], theta: NDArray[np.floating], gradient: NDArray[np.floating]) -> float:
        value = np.empty(1)
        self.kernel("nocl_loss", rows, len(rows), theta, self.labels, self.jacobians, self.scale, self.work, gradient,
                    value)
        if np.isnan(value[0]) and np.isfinite(theta).all():
            raise FloatingPointError("the loss is not a number though the weights are: look at the labels")
        return float(value[0])


def _source(sizes: Sequence[int], activation: str, dtype: torch.dtype, squared: bool) -> str:
    if len(sizes) != 4 or sizes[1] != sizes[2]:
        raise ValueError(f"the compiled loss is for three layers and one width; got sizes {list(sizes)}")
    values = {"SINGLE": int(dtype == torch.float32), "NZ": sizes[0], "NX": sizes[3], "H": sizes[1],
              "CURVE": activation.upper(), "SQUARED": int(squared)}
    return "".join(f"#define {k} {v}\n" for k, v in values.items()) + '#include "paper_loss.h"\n'


def loss_and_gradient(weights: Sequence[Tensor], activation: str, z: Tensor, f: Tensor, jacobian: Tensor | None,
                      scale: Tensor, squared: bool = False) -> tuple[float, list[Tensor]]:
    """(loss, its gradient in each of the weights); `jacobian` None: the loss of values alone; scale [nx, 1 + nz]."""
    rows = len(z) if jacobian is None else max(BLOCK // (f.shape[1] * weights[0].shape[0]), 16)
    total, gradient = 0.0, [torch.zeros_like(w) for w in weights]
    for at in range(0, len(z), rows):
        block = slice(at, at + rows)
        labels = (z[block], f[block], None if jacobian is None else jacobian[block])
        total += _block(weights, CURVES[activation], *labels, scale, squared, gradient)
    for g in gradient:
        g /= len(z)
    return total / len(z), gradient


def _block(weights: Sequence[Tensor], curve: Callable[[Tensor], Curve], z: Tensor, f: Tensor, jacobian: Tensor | None,
           scale: Tensor, squared: bool, gradient: list[Tensor]) -> float:
    """The sum of the loss over a block of rows; its gradient is added to `gradient`."""
    W, b = weights[::2], weights[1::2]
    a, slopes, curvatures = [z], [], []
    for Wl, bl in zip(W[:-1], b[:-1], strict=True):
        s, d, e = curve(torch.addmm(bl, a[-1], Wl.T))
        a.append(s)
        slopes.append(d)
        curvatures.append(e)
    error, y_bar = _unit(torch.addmm(b[-1], a[-1], W[-1].T) - f, scale[:, 0], squared)
    d_bar: list[Tensor | None] = [None] * len(slopes)
    if jacobian is not None:
        tape = _Jacobian(W, slopes)
        distance, J_bar = _unit((tape.value - jacobian).flatten(1), scale[:, 1:].flatten(), squared)
        error += distance
        d_bar = tape.backward(J_bar.view_as(jacobian), gradient[::2])
    _backward(W, a, slopes, curvatures, y_bar, d_bar, gradient)
    return error


def _unit(r: Tensor, scale: Tensor, squared: bool) -> tuple[float, Tensor]:
    """(sum over rows of |S r_b|, or its square, its gradient in the rows); zero for a row of zeros."""
    r = r * scale
    if squared:
        return float(r.square().sum()), 2 * r * scale
    norm = torch.linalg.vector_norm(r, dim=1, keepdim=True)
    return float(norm.sum()), r / norm.clamp(min=torch.finfo(r.dtype).tiny) * scale


def _backward(W: Sequence[Tensor], a: Sequence[Tensor], slopes: Sequence[Tensor], curvatures: Sequence[Tensor | None],
              bar: Tensor, d_bar: Sequence[Tensor | None], gradient: list[Tensor]) -> None:
    """Backpropagation of the values' part, with what the Jacobian hands to the slopes s'(t_l)."""
    for layer in range(len(W) - 1, -1, -1):
        gradient[2 * layer].addmm_(bar.T, a[layer])
        gradient[2 * layer + 1] += bar.sum(dim=0)
        if layer:
            bar = (bar @ W[layer]).mul_(slopes[layer - 1])
            curvature, slope_bar = curvatures[layer - 1], d_bar[layer - 1]
            if curvature is not None and slope_bar is not None:
                bar.addcmul_(slope_bar, curvature)


class _Jacobian:
    """dy/dz [B, nx, nz] of a block, and the products that its gradient needs again."""

    def __init__(self, W: Sequence[Tensor], slopes: Sequence[Tensor]) -> None:
        self.W, self.slopes = W, slopes
        self.M = (W[-1].T[:, :, None] * W[-2][:, None, :]).flatten(1)  # [h, nx * (h or nz)]
        top = (slopes[-1] @ self.M).view(len(slopes[-1]), W[-1].shape[0], -1)
        self.before, self.after = [top], []  # top down: dy/da_l, and dy/dt_l = dy/da_l * s'(t_l); [B, nx, h]
        for layer in range(len(slopes) - 2, -1, -1):
            self.after.append(self.before[-1] * slopes[layer][:, None, :])
            self.before.append(self.after[-1] @ W[layer])

    @property
    def value(self) -> Tensor:
        return self.before[-1]

    def backward(self, bar: Tensor, gradient: Sequence[Tensor]) -> list[Tensor | None]:
        """The gradient in each layer's slopes [B, h]; that in the weights is added to `gradient`."""
        slope_bars: list[Tensor | None] = []
        for layer in range(len(self.slopes) - 1):
            before, after = self.before[-2 - layer], self.after[-1 - layer]
            gradient[layer].addmm_(after.flatten(0, 1).T, bar.flatten(0, 1))
            bar = bar @ self.W[layer].T  # now of dy/dt
            slope_bars.append((bar * before).sum(dim=1))
            bar = bar.mul_(self.slopes[layer][:, None, :])
        flat = bar.flatten(1)
        M_bar = (self.slopes[-1].T @ flat).view(self.M.shape[0], bar.shape[1], -1)  # [h, nx, h or nz]
        gradient[-1].add_((M_bar * self.W[-2][:, None, :]).sum(dim=2).T)
        gradient[-2].add_((M_bar * self.W[-1].T[:, :, None]).sum(dim=1))
        return [*slope_bars, flat @ self.M.T]
