"""The paper's system identification: one MLP of all variables, its loss, Adam."""

from __future__ import annotations

import casadi as ca
import numpy as np
import torch
from torch import Tensor

from nocl import structure as structures
from nocl.nets import MLP, FeatureNet
from nocl.sysid_labels import Source
from nocl.sysid_progress import Progress
from nocl.sysid_settings import PaperSettings


def train(source: Source, settings: PaperSettings, seed: int, bar: Progress) -> FeatureNet:
    """The paper's f_theta: z -> MLP, sum of ||f_theta - f|| and ||grad f_theta - grad f|| over a batch, Adam."""
    z, value, gradient = _raw_labels(source, settings, seed)
    sizes = [z.shape[1], *[settings.width] * (settings.layers - 1), value.shape[1]]
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        mlp = MLP(sizes, settings.activation)
    generator = torch.Generator().manual_seed(seed)
    optimizer = torch.optim.Adam(mlp.parameters(), lr=settings.lr)
    decay = (settings.final_lr / settings.lr) ** (1 / settings.iterations)
    schedule = torch.optim.lr_scheduler.ExponentialLR(optimizer, decay)
    with bar.stage("Adam", settings.iterations) as report:
        for _ in range(settings.iterations):
            rows = torch.randint(len(z), (settings.batch,), generator=generator)
            value_of = loss(mlp, z[rows], value[rows], None if gradient is None else gradient[rows])
            optimizer.zero_grad()
            value_of.backward()
            optimizer.step()
            schedule.step()
            report(float(value_of.detach()))
    x, u = ca.SX.sym("x", source.box.nx), ca.SX.sym("u", source.box.nz - source.box.nx)
    y = ca.SX.sym("y", source.box.nx)
    inputs = ca.Function("features", [x, u], [ca.vertcat(x, u)], ["x", "u"], ["z"])
    return FeatureNet(inputs, [mlp.double()], ca.Function("xdot", [x, u, y], [y], ["x", "u", "y"], ["xdot"])).eval()


def _raw_labels(source: Source, settings: PaperSettings, seed: int) -> tuple[Tensor, Tensor, Tensor | None]:
    """z, f and, where wanted, df/dz as float32 tensors."""
    if source.data is not None:
        z, value, gradient = source.data
    else:
        assert source.oracle is not None
        z = source.box.sample(settings.samples, np.random.default_rng((seed, 1)))
        value, gradient = structures.label(source.oracle, z, source.box.nx)
    tensors = [torch.from_numpy(np.ascontiguousarray(a)).float() for a in (z, value)]
    wanted = source.gradients and gradient is not None
    return tensors[0], tensors[1], torch.from_numpy(np.ascontiguousarray(gradient)).float() if wanted else None


def loss(mlp: MLP, z: Tensor, value: Tensor, gradient: Tensor | None) -> Tensor:
    """Mean over the batch of ||f_theta - f||_2 + ||grad f_theta - grad f||_F."""
    error = torch.linalg.vector_norm(mlp(z) - value, dim=1).mean()
    if gradient is None:
        return error
    jacobian = torch.func.vmap(torch.func.jacrev(mlp))(z)
    return error + torch.linalg.vector_norm(jacobian - gradient, dim=(1, 2)).mean()
