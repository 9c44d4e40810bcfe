"""f_theta at rows with its derivatives by theta and x, written out: no automatic differentiation, so no overhead.

    f = combine(x, u, y_1, ..., y_G),   y_g = W_out a(... a(W_1 phi_g + b_1) ...) + b_out + W_skip phi_g,   a = sin

The maps at both ends, combine and phi, are CasADi's, and so are their Jacobians; between them the chain rule goes
backwards through the layers, one row of df/dy at a time for all rows of xdot together.
"""

from __future__ import annotations

from collections.abc import Sequence

import casadi as ca
import torch
from torch import Tensor

from nocl.nets import MLP, FeatureNet
from nocl.translate.torch_functions import TorchFunction, to_torch


class Slopes:
    """(parameters, x [w, nx], u [w, nu]) -> f [w, nx], df/dtheta [w, nx, P], df/dx [w, nx, nx].

    `parameters` are as `net.parameters()` has them, and so are the columns of df/dtheta.
    """

    def __init__(self, net: FeatureNet) -> None:
        x, u = (ca.SX.sym(name, net.inputs.size1_in(i)) for i, name in enumerate("xu"))
        phi = net.inputs.call([x, u])
        y = [ca.SX.sym(f"y{i}", net.outputs.size1_in(2 + i)) for i in range(len(phi))]
        xdot = net.outputs.call([x, u, *y])[0]
        self.inputs = _with_jacobians("inputs", [x, u], phi, phi, [x] * len(phi))
        self.outputs = _with_jacobians("outputs", [x, u, *y], [xdot], [xdot] * (1 + len(y)), [x, *y])
        self.sizes = []  # how many parameters each network has
        for mlp in net.nets:
            assert isinstance(mlp, MLP)
            assert mlp.activation == "sine"
            self.sizes.append(len(list(mlp.parameters())))

    def __call__(self, parameters: Sequence[Tensor], x: Tensor, u: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        w, nx = x.shape
        found, own, at = self.inputs(x, u), [], 0
        phi, phi_x = found[: len(self.sizes)], found[len(self.sizes):]
        for size, p in zip(self.sizes, phi, strict=True):
            own.append(_Layers(parameters[at: at + size], p))
            at += size
        f, f_x, *f_y = self.outputs(x, u, *(layers.y for layers in own))
        f_x, by_theta = f_x.reshape(w, nx, nx), []
        for layers, slope, p_x in zip(own, f_y, phi_x, strict=True):
            columns, f_phi = layers.backwards(slope.reshape(w, nx, -1))
            by_theta += columns
            f_x = f_x + f_phi @ p_x.reshape(w, -1, nx)
        return f, torch.cat(by_theta, 2), f_x


class _Layers:
    """One network's answer y [w, m] at features phi [w, F], and what its derivatives take."""

    def __init__(self, parameters: Sequence[Tensor], phi: Tensor) -> None:
        *layers, self.skip = parameters  # W_1, b_1, ..., W_out, b_out, W_skip
        self.weights, biases = layers[::2], layers[1::2]
        self.before, self.cosines = [phi], []  # what each layer is given, and the slope of what gave it
        for W, b in zip(self.weights[:-1], biases[:-1], strict=True):
            z = torch.addmm(b, self.before[-1], W.T)
            self.before.append(z.sin())
            self.cosines.append(z.cos())
        self.y = torch.addmm(biases[-1], self.before[-1], self.weights[-1].T) + phi @ self.skip.T

    def backwards(self, slope: Tensor) -> tuple[list[Tensor], Tensor]:
        """From g(y) with dg/dy [w, r, m]: dg by each parameter, [w, r, size] in order, and dg/dphi [w, r, F]."""
        columns, by_phi = [_outer(slope, self.before[0])], slope @ self.skip
        for i in reversed(range(len(self.weights))):
            columns = [_outer(slope, self.before[i]), slope, *columns]
            slope = slope @ self.weights[i]
            if i:
                slope = slope * self.cosines[i - 1][:, None]
        return columns, by_phi + slope


def _outer(slope: Tensor, given: Tensor) -> Tensor:
    """d/dW of W given: [w, r, m] and [w, n] to [w, r, m n]."""
    return (slope[..., None] * given[:, None, None]).flatten(2)


def _with_jacobians(name: str, args: list[ca.SX], values: list[ca.SX], of: list[ca.SX],
                    by: list[ca.SX]) -> TorchFunction:
    slopes = [ca.densify(ca.jacobian(a, b)) for a, b in zip(of, by, strict=True)]
    return to_torch(ca.Function(name, args, [*values, *slopes]))
