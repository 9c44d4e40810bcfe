"""The paper's system identification: one MLP of all variables, its loss, Adam."""

from __future__ import annotations

import warnings
from collections.abc import Sequence

import casadi as ca
import numpy as np
import torch
from torch import Tensor
from torch.nn.utils import parameters_to_vector, vector_to_parameters

from nocl.nets import MLP, FeatureNet
from nocl.support.checks import Array
from nocl.sysid import structure as structures
from nocl.sysid.labels import Source
from nocl.sysid.loss import Loss
from nocl.sysid.progress import Progress
from nocl.sysid.settings import PaperSettings


def train(source: Source, settings: PaperSettings, seed: int, bar: Progress) -> FeatureNet:
    """The paper's f_theta: z -> MLP, sum of ||f_theta - f|| and ||grad f_theta - grad f|| over a batch, Adam.

    The network's inputs and outputs are normalised; the loss is that of physical units, as in the paper.
    """
    z, value, gradient = _raw_labels(source, settings, seed)
    box, mean, spread = source.box, value.mean(axis=0), value.std(axis=0)
    centre, unit = (box.lb + box.ub) / 2, box.width / np.sqrt(12)
    unit[list(box.angles)] /= settings.frequency
    spread = np.where(spread > 1e-12 * np.abs(value).max(axis=0), spread, 1.0)
    ratio = spread[:, None] / unit  # of a derivative in physical units to that of the network
    labels = _single((z - centre) / unit), _single((value - mean) / spread), \
        None if gradient is None else _single(gradient / ratio)
    sizes = [z.shape[1], *[settings.width] * (settings.layers - 1), value.shape[1]]
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        mlp = MLP(sizes, settings.activation)
    loss = _loss(sizes, settings, labels, torch.from_numpy(np.c_[spread, ratio]))
    theta = parameters_to_vector(mlp.parameters()).detach().clone()
    vector_to_parameters(_adam(theta, loss, settings, len(z), seed, bar), mlp.parameters())
    at, y = box.arguments(), ca.SX.sym("y", box.nx)
    inputs = at.function("features", {"z": (ca.vertcat(*at.inputs) - ca.DM(centre)) / ca.DM(unit)})
    outputs = at.function("xdot", {"xdot": ca.DM(mean) + ca.DM(spread) * y}, y=y)
    return FeatureNet(inputs, [mlp.double()], outputs).eval()


def _single(a: Array) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(a, dtype=np.float32))


def _loss(sizes: Sequence[int], settings: PaperSettings, labels: tuple[Tensor, Tensor, Tensor | None],
          scale: Tensor) -> Loss:
    """Compiled where it can be; a warning where there is no compiler."""
    if settings.layers == 3:
        try:
            return Loss(sizes, settings.activation, *labels, compiled=True, scale=scale)
        except ValueError as error:
            warnings.warn(f"identify: method 'paper' trains in torch, several times slower: {error}", stacklevel=3)
    return Loss(sizes, settings.activation, *labels, compiled=False, scale=scale)


def _adam(theta: Tensor, loss: Loss, settings: PaperSettings, n: int, seed: int, bar: Progress) -> Tensor:
    """Adam with an exponentially decaying rate, on random batches of n labels; theta is changed in place."""
    generator = torch.Generator().manual_seed(seed)
    theta.grad = torch.zeros_like(theta)
    optimizer = torch.optim.Adam([theta], lr=settings.lr, fused=True)
    decay = (settings.final_lr / settings.lr) ** (1 / settings.iterations)
    with bar.stage("Adam", settings.iterations) as report:
        for i in range(settings.iterations):
            optimizer.param_groups[0]["lr"] = settings.lr * decay**i
            report(loss(torch.randint(n, (settings.batch,), generator=generator), theta, theta.grad))
            optimizer.step()
    theta.grad = None
    return theta


def _raw_labels(source: Source, settings: PaperSettings, seed: int) -> tuple[Array, Array, Array | None]:
    """z, f and, where wanted, df/dz."""
    if source.data is not None:
        z, value, gradient = source.data
    else:
        assert source.oracle is not None
        z = source.box.sample(settings.samples, np.random.default_rng((seed, 1)))
        value, gradient = structures.label(source.oracle, z, source.box.nx)
    return z, value, gradient if source.gradients else None
