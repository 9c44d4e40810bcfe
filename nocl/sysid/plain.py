"""One plain network of many variables, from values and full Jacobians: SOAP on the compiled loss.

What is linear is kept out of the network: its skip is the mean Jacobian, inputs in which every derivative is constant
have first weights of zero, and outputs that the skip meets have no hidden weights. The rest, at the frequencies that
the labels show, is trained on the squared norms of csrc/paper_loss.h, several times faster than autograd.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import torch
from torch import Tensor

from nocl.support.budget import ENDLESS
from nocl.support.budget import Budget as Time
from nocl.sysid import fitting
from nocl.sysid.loss import Loss
from nocl.sysid.settings import Budget

LINEAR = 1e-9  # spread of normalised derivatives and residuals that is none


@dataclass(frozen=True, eq=False)
class Linear:
    """What the skip takes, in normalised units, and what is left to the hidden layers."""

    skip: Tensor  # [m, F]
    offset: Tensor  # [m]
    inputs: Tensor  # those of F that the first layer sees
    outputs: Tensor  # those of m that the hidden layers reach
    unit: Tensor  # [outputs], root mean square of what is left of them

    @staticmethod
    def of(samples: fitting.Samples, old: fitting.Weights | None) -> Linear:
        """By the labels; from `old` weights the skip and offset, and all inputs that these weights see."""
        assert samples.dy is not None
        curved = samples.dy.std(dim=0).amax(dim=0) > LINEAR  # [F]
        if old is None:
            skip = samples.dy.mean(dim=0)
            offset = (samples.y - samples.phi @ skip.T).mean(dim=0)
        else:
            h, curved = old[0].shape[0], curved | (old[0][:, :-1] != 0).any(dim=0)
            skip, offset = old[2][:, h + 1:].double(), old[2][:, h].double()
        unit = (samples.y - samples.phi @ skip.T - offset).square().mean(dim=0).sqrt()
        outputs = torch.where(unit > LINEAR)[0]
        return Linear(skip, offset, torch.where(curved)[0], outputs, unit[outputs])

    def left(self, samples: fitting.Samples) -> tuple[Tensor, Tensor, Tensor]:
        """(inputs, values, Jacobians) of what is left, normalised anew."""
        assert samples.dy is not None
        y = (samples.y - samples.phi @ self.skip.T - self.offset)[:, self.outputs] / self.unit
        dy = (samples.dy - self.skip)[:, self.outputs][:, :, self.inputs] / self.unit[:, None]
        return samples.phi[:, self.inputs], y, dy

    def hidden(self, old: fitting.Weights) -> fitting.Weights:
        """What `join` makes whole, of old weights; their offset is the linear part's."""
        h, columns = len(old[0]), torch.cat([self.inputs, torch.tensor([old[0].shape[1] - 1])])
        last = old[2][self.outputs, :h + 1] / self.unit[:, None]
        last[:, h] = 0.0
        return [old[0][:, columns], old[1], last]

    def join(self, weights: fitting.Weights) -> fitting.Weights:
        """The whole network's weights from those of what is left, [h, inputs+1], [h, h+1] and [outputs, h+1]."""
        W1, W2, W3 = (w.double() for w in weights)
        (m, F), h = self.skip.shape, len(W1)
        first, last = torch.zeros(h, F + 1).double(), torch.zeros(m, h + 1 + F).double()
        first[:, self.inputs], first[:, F] = W1[:, :-1], W1[:, -1]
        last[:, h], last[:, h + 1:] = self.offset, self.skip
        last[self.outputs, :h + 1] += W3 * self.unit[:, None]
        return [first, W2, last]


def train(samples: fitting.Samples, budget: Budget, lr: float, weight: float, generator: torch.Generator,
          report: fitting.OnStep, frequency: Tensor | None = None,
          old: fitting.Weights | None = None, time: Time = ENDLESS) -> fitting.Weights:
    """Weights of a network whose features are the variables; float64.

    weight: of Jacobians beside values, both relative to their spread. frequency [F]: of the first weights.
    """
    linear = Linear.of(samples, old)
    own = _start(linear, budget.width, frequency, generator) if old is None else linear.hidden(old)
    if len(linear.outputs):
        z, y, dy = linear.left(samples)
        loss = _loss([z.shape[1], len(own[0]), len(own[0]), y.shape[1]], z, y, dy, weight)
        own = _soap(own, loss, len(z), budget, lr, generator, report, time)
    return linear.join(own)


def _start(linear: Linear, width: int, frequency: Tensor | None, generator: torch.Generator) -> fitting.Weights:
    """Random hidden layers, an output of zero."""
    n = len(linear.inputs)
    W1, W2 = fitting.hidden(n, width, generator, None if frequency is None else frequency[linear.inputs])
    return [W1, W2, torch.zeros(len(linear.outputs), width + 1)]


def _loss(sizes: list[int], z: Tensor, y: Tensor, dy: Tensor, weight: float) -> Loss:
    """Of squared norms, Jacobians relative to their spread; compiled, or with a warning in torch."""
    m, v = dy.shape[1:]
    scale = weight * m**0.5 / float(dy.std(dim=0).norm())
    scales = torch.cat([torch.ones(m, 1), torch.full((m, v), scale)], 1)
    labels = [a.float().contiguous() for a in (z, y, dy)]
    try:
        return Loss(sizes, "sine", *labels, compiled=True, scale=scales, squared=True)
    except ValueError as error:
        warnings.warn(f"identify: trains in torch, several times slower: {error}", stacklevel=5)
    return Loss(sizes, "sine", *labels, compiled=False, scale=scales, squared=True)


def _soap(weights: fitting.Weights, loss: Loss, n: int, budget: Budget, lr: float, generator: torch.Generator,
          report: fitting.OnStep, time: Time) -> fitting.Weights:
    """fitting.soap's optimiser and schedule, on random batches of n labels."""
    own = [w.float().clone().requires_grad_() for w in weights]
    theta = torch.empty(sum(w.numel() for w in own))
    gradient = torch.empty_like(theta)
    inner, slopes = loss.weights(theta), loss.weights(gradient)

    def value_and_gradients() -> tuple[float, list[Tensor]]:
        for i, w in enumerate(own):
            inner[2 * i].copy_(w.detach()[:, :-1])
            inner[2 * i + 1].copy_(w.detach()[:, -1])
        value = loss(torch.randint(n, (budget.batch,), generator=generator), theta, gradient)
        return value, [torch.cat([W, b[:, None]], 1) for W, b in zip(slopes[::2], slopes[1::2], strict=True)]

    return fitting.soap_steps(own, value_and_gradients, iterations=budget.iterations, lr=lr, report=report,
                              budget=time)
