"""Fitting a policy or value network to labels by SOAP (Vyas et al. 2024), float32, cosine schedule."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np
import torch
from torch import Tensor

from nocl.definition.ocp import OCP
from nocl.nets import FeatureNet
from nocl.solvers.cnd.regression.labels import Labels
from nocl.support.budget import ENDLESS, Budget
from nocl.translate.torch_functions import to_torch

LEAST = 50  # iterations, however small the budget
SAME = 0.1  # squared error, in units of the controls' variance, within which a branch is taken for a label's own
LossFunction = Callable[[Tensor], Tensor]  # row numbers of the labels -> a scalar
OnStep = Callable[[float], Any]  # called once an iteration with the loss


def fit_net(net: FeatureNet, loss: LossFunction, rows: int, *, iterations: int, batch: int, lr: float, seed: int,
            report: OnStep = lambda _: None, budget: Budget = ENDLESS) -> None:
    """Train net in place on random batches of row numbers; raises ValueError where the loss is not finite.

    Where the budget is spent before the iterations are, it is the schedule: the rate falls with the share of it that is
    spent, and at its end, after LEAST iterations, training ends.
    """
    from pytorch_optimizer import SOAP

    generator = torch.Generator().manual_seed(seed)
    net.float().train().requires_grad_(True)
    parameters = list(net.parameters())
    optimizer = SOAP(parameters, lr=lr, betas=(0.95, 0.95), weight_decay=0.0, precondition_frequency=10)
    for i in range(iterations):
        done = max(i / iterations, budget.share)
        if done >= 1 and i >= LEAST:
            break
        optimizer.param_groups[0]["lr"] = lr * min(1.0, (i + 1) / 50) * _cosine(done)
        value = loss(torch.randint(rows, (batch,), generator=generator))
        if i % 100 == 0 and not torch.isfinite(value):
            raise ValueError(f"the loss is {value.item()} at iteration {i}: lower the learning rate (lr is {lr:g})")
        optimizer.zero_grad()
        value.backward()
        optimizer.step()
        report(float(value.detach()))
    net.double().eval().requires_grad_(False)


def _cosine(progress: float) -> float:
    return 0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * progress))


def policy_loss(ocp: OCP, net: FeatureNet, inverse: ca.Function, labels: Labels) -> LossFunction:
    """Mean of w (u - u*)' R (u - u*), R from L, w the label's weight: an interval's length over its solution's cost.

    For control-affine problems that is the cost lost along the labelled paths, as a share of what they cost. Answers
    beyond a bound that is active in the label cost nothing: they are clipped to it.

    Of a network with branches it is SAME times -log of the likelihood of a mixture: Gaussians about the branches, with
    such squared errors of SAME, and shares that are the softmax of their numbers (mixture density networks, Bishop
    1994). Each label pulls at the branch that is near it, and at the numbers.
    """
    to_y = to_torch(inverse)
    target = to_y(torch.from_numpy(labels.u))[1].float()
    low, high = (to_y(torch.from_numpy(np.array(b))[None])[0].float() for b in (ocp.system.lbu, ocp.system.ubu))
    lowest, highest = target <= low + 1e-4, target >= high - 1e-4
    nu = target.shape[1]
    each = _control_weights(ocp, low, high)
    of_label = torch.from_numpy(labels.weight / labels.weight.mean()).float()[:, None]
    weight = of_label * each
    phi = _features(net, labels)

    def loss(rows: Tensor) -> Tensor:
        y, wanted = net.nets[0](phi[rows]), target[rows]
        if y.shape[1] == nu:
            return (weight[rows] * _off(y, wanted, lowest[rows], highest[rows])).mean()
        branches, numbers = torch.split(y, [y.shape[1] * nu // (nu + 1), y.shape[1] // (nu + 1)], dim=1)
        off = torch.stack([(each * _off(branch, wanted, lowest[rows], highest[rows])).mean(dim=1)
                           for branch in torch.split(branches, nu, dim=1)], dim=1)
        likely = torch.logsumexp(torch.log_softmax(numbers, dim=1) - off / SAME, dim=1)
        return -(of_label[rows, 0] * SAME * likely).mean()

    return loss


def _off(y: Tensor, wanted: Tensor, lowest: Tensor, highest: Tensor) -> Tensor:
    """Squared errors [n, nu]; 0 beyond a bound that is active in the label."""
    free = ~((lowest & (y < wanted)) | (highest & (y > wanted)))
    return free * (y - wanted) ** 2


def _control_weights(ocp: OCP, low: Tensor, high: Tensor) -> Tensor:
    """The diagonal of L_uu at the goal in the network's units [1, nu], mean 1; equal where it is not positive."""
    s = ocp.system
    at_goal = ocp.functions.arguments.columns(x=ocp.x_goal, u=ocp.u_goal, t=0.0, p=ocp.nominal)
    L_zz = ocp.functions.L_derivatives(*at_goal)[2].full()
    H = torch.from_numpy(np.diag(L_zz)[None, s.nx:].copy()).float()
    unit = torch.from_numpy(np.asarray(s.ubu) - s.lbu).float() / (high - low)  # u for one unit of y
    weights = H * unit**2 if bool((H > 0).all()) else torch.ones(1, s.nu)
    return weights / weights.mean()


def _features(net: FeatureNet, labels: Labels) -> Tensor:
    """The features of all labels [n, F], in float32."""
    known = {"x": labels.x, "t": labels.t[:, None], "p": labels.p, "dt": labels.dt[:, None]}
    return net.features(*(torch.from_numpy(known[name]) for name in net.inputs.name_in()))[0].float()
