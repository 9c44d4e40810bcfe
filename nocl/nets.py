"""Networks: plain layers in torch, between an input and an output map that are written once, in SX."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import casadi as ca
import torch
from torch import Tensor, nn

from nocl.translate.torch_functions import to_torch


class Sine(nn.Module):
    """sin(x), elementwise."""

    def forward(self, x: Tensor) -> Tensor:
        return torch.sin(x)


ACTIVATIONS: dict[str, type[nn.Module]] = {"sine": Sine, "tanh": nn.Tanh, "relu": nn.ReLU, "silu": nn.SiLU}


class MLP(nn.Module):
    """y = W_out a(... a(W_1 x + b_1) ...) + b_out, plus W_skip x where `skip` is set."""

    def __init__(self, sizes: Sequence[int], activation: str = "tanh", skip: bool = False) -> None:
        super().__init__()
        if activation not in ACTIVATIONS:
            raise ValueError(f"activation is {activation!r}; expected one of {', '.join(ACTIVATIONS)}")
        self.sizes, self.activation = tuple(sizes), activation
        layers: list[nn.Module] = []
        for n_in, n_out in pairwise(sizes[:-1]):
            layers += [nn.Linear(n_in, n_out), ACTIVATIONS[activation]()]
        self.body = nn.Sequential(*layers, nn.Linear(sizes[-2], sizes[-1]))
        self.skip = nn.Linear(sizes[0], sizes[-1], bias=False) if skip else None

    def forward(self, x: Tensor) -> Tensor:
        y = self.body(x)
        return y if self.skip is None else y + self.skip(x)


class FeatureNet(nn.Module):
    """args -> output(args, y_1, ..., y_G), y_g = net_g(phi_g), (phi_1, ..., phi_G) = inputs(args).

    The maps at both ends are CasADi SX Functions: features, angles, scaling, limits and known equations stand there
    in physical units, so that torch, CasADi and C get the very same ones. Controllers, values and learned dynamics
    are all of this form. Tensors are rows [B, n].
    """

    def __init__(self, inputs: ca.Function, nets: Sequence[MLP], outputs: ca.Function) -> None:
        super().__init__()
        if inputs.n_out() != len(nets) or outputs.n_in() != inputs.n_in() + len(nets):
            raise ValueError(f"FeatureNet: {inputs.n_out()} feature vectors, {len(nets)} networks and {outputs.n_in()} "
                             f"inputs of the output map do not fit together")
        self.inputs, self.outputs = inputs, outputs
        self.nets = nn.ModuleList(nets)
        self._features, self._combine = to_torch(inputs), to_torch(outputs)

    def features(self, *args: Tensor) -> tuple[Tensor, ...]:
        """(phi_1, ..., phi_G) at args."""
        phi = self._features(*args)
        return phi if isinstance(phi, tuple) else (phi,)

    def combine(self, args: Sequence[Tensor], y: Sequence[Tensor]) -> Tensor:
        """The output for given network answers y."""
        return self._combine(*args, *y)

    def forward(self, *args: Tensor) -> Tensor:
        y = [net(phi) for net, phi in zip(self.nets, self.features(*args), strict=True)]
        return self.combine(args, y)
