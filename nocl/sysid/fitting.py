"""Fitting one small network to values and derivatives: SOAP on batches, then Levenberg-Marquardt.

The network has two hidden sine layers and a linear skip; a bias is a weight of a constant input, so that three
matrices W1 [h, F+1], W2 [h, h+1], W3 [m, h+1+F] hold everything. Its derivatives along k directions are propagated
beside the value ("tangents"): a row of a batch is the value and k tangents, 1 + k rows of every matrix product.
Shapes: N samples, B rows of a batch, F features, m outputs, k directions of the v variables, P parameters.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from scipy.linalg.blas import ssyrk
from torch import Tensor

from nocl.support.budget import ENDLESS, Budget

Weights = list[Tensor]  # W1, W2, W3
LEAST = 50  # steps of SOAP, however small the budget
OnStep = Callable[[float], None]  # called once a step with the root mean square of the scaled residuals


@dataclass(frozen=True, eq=False)
class Batch:
    """Features and the labels to meet, each as value and k tangents."""

    phi: Tensor  # [1+k, B, F]
    y: Tensor  # [1+k, B, m]
    mix: Tensor | None = None  # [1+k, B, m, C]


@dataclass(frozen=True, eq=False)
class Mix:
    """Labels that are sums of the network's C outputs with known weights: m functions sum_c place[m, c] w(z) y_c(z)."""

    weights: Tensor  # [N, J], of which each output has one
    place: Tensor  # [m, C, J], 1 where output c with weight j belongs to label m
    rate: Tensor  # [J, v], d weights_j / d variable: constant

    def to(self, dtype: torch.dtype) -> Mix:
        return Mix(self.weights.to(dtype), self.place.to(dtype), self.rate.to(dtype))

    def batch(self, rows: Tensor, q: Tensor) -> Tensor:
        """[1+k, B, m, C] along directions q [k, v]."""
        first = torch.einsum("bj,mcj->bmc", self.weights[rows], self.place)
        if not len(q):
            return first[None]
        tangents = torch.einsum("kv,jv,mcj->kmc", q, self.rate, self.place)
        return torch.cat([first[None], tangents[:, None].expand(-1, *first.shape)])


@dataclass(frozen=True, eq=False)
class Samples:
    """Labelled samples; feature f depends on variable owner[f] alone, with the given slope. dy None: values only."""

    phi: Tensor  # [N, F]
    slope: Tensor  # [N, F], d phi_f / d variable owner[f]
    owner: Tensor  # [F]
    y: Tensor  # [N, m]
    dy: Tensor | None  # [N, m, v]
    mix: Mix | None = None  # None: the labels are the network's outputs

    def __len__(self) -> int:
        return len(self.y)

    @property
    def outputs(self) -> int:
        """Of the network."""
        return self.y.shape[1] if self.mix is None else self.mix.place.shape[1]

    def to(self, dtype: torch.dtype) -> Samples:
        dy, mix = None if self.dy is None else self.dy.to(dtype), None if self.mix is None else self.mix.to(dtype)
        return Samples(self.phi.to(dtype), self.slope.to(dtype), self.owner, self.y.to(dtype), dy, mix)

    def batch(self, rows: Tensor, directions: Tensor) -> Batch:
        """The samples at these rows, with tangents along directions [k, v]."""
        phi, y = self.phi[rows], self.y[rows]
        if self.dy is None:
            directions = directions[:0]
        q = directions.to(phi.dtype)
        mix = None if self.mix is None else self.mix.batch(rows, q)
        if self.dy is None or not len(q):
            return Batch(phi[None], y[None], mix)
        tangents = self.slope[rows] * q[:, None, self.owner]  # [k, B, F]
        derivatives = torch.einsum("bmv,kv->kbm", self.dy[rows], q)
        return Batch(torch.cat([phi[None], tangents]), torch.cat([y[None], derivatives]), mix)


def initial(n_features: int, width: int, samples: Samples, generator: torch.Generator,
            frequency: Tensor | None = None) -> Weights:
    """Random hidden layers, the linear skip and the offset by least squares, nothing else in the output. float32

    frequency [F] is the standard deviation of each feature's first weights; those of 0 reach the skip alone.
    """
    h = width
    W1, W2 = hidden(n_features, h, generator, frequency)
    some = slice(0, 20_000)
    phi = torch.cat([samples.phi[some], torch.ones(len(samples.phi[some]), 1, dtype=samples.phi.dtype)], 1).double()
    y = samples.y[some].double()
    if samples.mix is None:
        c = torch.linalg.lstsq(phi, y, driver="gelsd").solution.T.float()
    else:
        c = torch.zeros(samples.outputs, phi.shape[1])
        for m, place in enumerate(samples.mix.place):
            own, column = place.nonzero(as_tuple=True)
            basis = (samples.mix.weights[some][:, column, None] * phi[:, None]).flatten(1).double()
            c[own] = torch.linalg.lstsq(basis, y[:, m:m + 1], driver="gelsd").solution.view(len(own), -1).float()
    return [W1, W2, torch.cat([torch.zeros(len(c), h), c[:, -1:], c[:, :-1]], 1)]


def hidden(n_features: int, width: int, generator: torch.Generator,
           frequency: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """Random W1, W2 of `initial`."""
    W1 = torch.randn(width, n_features + 1, generator=generator)
    W1 *= 1.5 / math.sqrt(n_features) if frequency is None else torch.cat([frequency, torch.full((1,), 1.5)]).float()
    return W1, torch.randn(width, width + 1, generator=generator) / math.sqrt(width)


def forward(weights: Sequence[Tensor], phi: Tensor) -> Tensor:
    """Value and tangents [1+k, B, m] of the network from those of its features [1+k, B, F]."""
    W1, W2, W3 = weights
    F, h = phi.shape[-1], W1.shape[0]
    a = _sine(phi @ W1[:, :F].T, W1[:, F])
    a = _sine(a @ W2[:, :h].T, W2[:, h])
    y = a @ W3[:, :h].T + phi @ W3[:, h + 1:].T
    return torch.cat([y[:1] + W3[:, h], y[1:]])


def _sine(z: Tensor, bias: Tensor) -> Tensor:
    first = z[:1] + bias
    return torch.cat([torch.sin(first), torch.cos(first) * z[1:]])


def mixed(y: Tensor, mix: Tensor | None) -> Tensor:
    """Value and tangents [1+k, B, m] of the labelled functions from those of the outputs [1+k, B, C]."""
    if mix is None:
        return y
    own = torch.einsum("bmc,kbc->kbm", mix[0], y)
    return torch.cat([own[:1], own[1:] + torch.einsum("kbmc,bc->kbm", mix[1:], y[0])])


def loss(weights: Sequence[Tensor], batch: Batch, scale: Tensor) -> Tensor:
    """Sum over value and tangents and outputs of the mean square of (residual * scale [1+k, 1, m])."""
    return ((mixed(forward(weights, batch.phi), batch.mix) - batch.y) * scale).square().mean(dim=1).sum()


Draw = Callable[[int], tuple[Batch, Tensor]]  # batch size -> a fresh batch and the scale of its residuals


def soap(weights: Weights, draw: Draw, *, iterations: int, batch: int, lr: float, report: OnStep,
         budget: Budget = ENDLESS) -> Weights:
    """Adam in Shampoo's eigenbases (Vyas et al. 2024), cosine schedule with 50 steps of warm-up; new weights."""
    own = [w.detach().clone().requires_grad_() for w in weights]

    def value_and_gradients() -> tuple[float, Sequence[Tensor]]:
        value = loss(own, *draw(batch))
        return float(value.detach()), torch.autograd.grad(value, own)

    return soap_steps(own, value_and_gradients, iterations=iterations, lr=lr, report=report, budget=budget)


def soap_steps(weights: Weights, value_and_gradients: Callable[[], tuple[float, Sequence[Tensor]]], *, iterations: int,
               lr: float, report: OnStep, budget: Budget = ENDLESS) -> Weights:
    """`soap` on the loss and its gradients at these weights, which are changed in place; the result is detached.

    Where the budget is spent sooner, it is the schedule: the rate falls with the share of it that is spent.
    """
    from pytorch_optimizer import SOAP

    if not iterations:
        return [w.detach() for w in weights]
    optimizer = SOAP(weights, lr=lr, weight_decay=0.0)
    for i in range(iterations):
        done = max(i / iterations, budget.share)
        if done >= 1 and i >= LEAST:
            break
        optimizer.param_groups[0]["lr"] = lr * min(1.0, (i + 1) / 50) * _cosine(done)
        value, gradients = value_and_gradients()
        for w, g in zip(weights, gradients, strict=True):
            w.grad = g
        optimizer.step()
        report(value ** 0.5)
    return [w.detach() for w in weights]


def _cosine(progress: float) -> float:
    return 0.5 * (1 + math.cos(math.pi * progress)) + 1e-3


def levenberg_marquardt(weights: Weights, draw: Draw, *, steps: int, batch: int, report: OnStep,
                        budget: Budget = ENDLESS) -> Weights:
    """Damped Gauss-Newton steps, all on one batch, each kept only if it lowers the loss; float64 weights.

    The damping is in units of the diagonal of J'J: x 0.2 on success, x 4 on failure. Fresh batches would keep it up:
    what one step gains, the next batch does not see. No step begins once the budget is spent.
    """
    weights, damping, (now, scale) = [w.detach().double() for w in weights], 1e-4, draw(batch)
    for _ in range(steps):
        if budget.share >= 1:
            break
        JJ, Jr, before = gauss_newton(weights, now, scale)
        for _ in range(8):
            candidate = _step(weights, JJ, Jr, damping)
            after = float(loss(candidate, now, scale)) if candidate is not None else math.inf
            if candidate is not None and after < before:
                weights, before, damping = candidate, after, max(0.2 * damping, 1e-12)
                break
            damping = min(4 * damping, 1e6)
        report(before ** 0.5)
    return weights


def _step(weights: Weights, JJ: Tensor, Jr: Tensor, damping: float) -> Weights | None:
    """The weights after one damped step, or None where the damped J'J is not positive definite in float64."""
    damped = JJ.clone()
    diagonal = JJ.diagonal()
    damped.diagonal().add_(damping * (diagonal + 1e-9 * diagonal.max()))
    factor, info = torch.linalg.cholesky_ex(damped)
    if int(info):
        return None
    delta = torch.cholesky_solve(Jr[:, None], factor)[:, 0]
    parts = delta.split([w.numel() for w in weights])
    return [w - d.view_as(w) for w, d in zip(weights, parts, strict=True)]


def gauss_newton(weights: Sequence[Tensor], batch: Batch, scale: Tensor,
                 chunk: int = 512) -> tuple[Tensor, Tensor, float]:
    """(J'J [P, P], J'r [P], r'r) over the batch, divided by B: J in float32, the residual r and the sums in float64."""
    mix = None if batch.mix is None else batch.mix.double()
    r = (mixed(forward([w.double() for w in weights], batch.phi.double()), mix) - batch.y) * scale  # [1+k, B, m]
    single, P, B = [w.float() for w in weights], sum(w.numel() for w in weights), r.shape[1]
    JJ, Jr = torch.zeros(P, P, dtype=torch.float64), torch.zeros(P, dtype=torch.float64)
    for start in range(0, B, chunk):
        rows = slice(start, start + chunk)
        J = parameter_jacobian(single, batch.phi[:, rows].float())  # [C, 1+k, B, hidden + own]
        if batch.mix is not None:
            _add_mixed(JJ, Jr, J, batch.mix[:, rows].float(), r[:, rows], scale.float(), single[2].shape[1])
            continue
        J *= scale.float().permute(2, 0, 1)[..., None]
        _add(JJ, Jr, J, r[:, rows], single[2].shape[1])
    JJ = JJ.triu() + JJ.triu(1).T
    return JJ / B, Jr / B, float(r.square().sum() / B)


def _add(JJ: Tensor, Jr: Tensor, J: Tensor, r: Tensor, own: int) -> None:
    """An output's residuals see only their own row of W3, so the products are taken output by output."""
    hidden = J.shape[3] - own
    for o, Jo in enumerate(J.flatten(1, 2)):
        last = slice(hidden + o * own, hidden + (o + 1) * own)
        square = _upper(Jo)
        JJ[:hidden, :hidden] += square[:hidden, :hidden]
        JJ[:hidden, last] += square[:hidden, hidden:]
        JJ[last, last] += square[hidden:, hidden:]
        product = (Jo.T @ r[:, :, o].reshape(-1).float()).double()
        Jr[:hidden] += product[:hidden]
        Jr[last] += product[hidden:]


def _add_mixed(JJ: Tensor, Jr: Tensor, J: Tensor, mix: Tensor, r: Tensor, scale: Tensor, own: int) -> None:
    """A label's residuals see the rows of W3 of its own outputs, with the weights of mix [1+k, B, m, C]."""
    hidden = J.shape[3] - own
    for m in range(mix.shape[2]):
        outputs = mix[:, :, m].abs().amax(dim=(0, 1)).nonzero()[:, 0]
        each = mix[0, :, m, outputs].T[:, None, :, None] * J[outputs]  # [own outputs, 1+k, B, .]
        each[:, 1:] += mix[1:, :, m, outputs].permute(2, 0, 1)[..., None] * J[outputs, :1]
        row = torch.cat([each[..., :hidden].sum(dim=0), each[..., hidden:].permute(1, 2, 0, 3).flatten(2)], 2)
        row = (row * scale[:, :, m, None]).flatten(0, 1)
        place = torch.cat([torch.arange(hidden), (hidden + own * outputs[:, None] + torch.arange(own)).flatten()])
        JJ[place[:, None], place] += _upper(row)
        Jr[place] += (row.T @ r[:, :, m].reshape(-1).float()).double()


def _upper(J: Tensor) -> Tensor:
    """The upper triangle of J'J: half of the work of the product."""
    return torch.from_numpy(ssyrk(1.0, J.numpy().T))


def parameter_jacobian(weights: Sequence[Tensor], phi: Tensor) -> Tensor:
    """d forward[..., o] / d(W1, W2, W3[o]), flattened by rows: [m, 1+k, B, .], by reverse mode written out."""
    W1, W2, W3 = weights
    (D, B, F), h, m = phi.shape, W1.shape[0], W3.shape[0]
    one = torch.zeros(D, B, 1, dtype=phi.dtype)
    one[0] = 1
    t1 = phi @ W1[:, :F].T
    s1, c1 = torch.sin(t1[0] + W1[:, F]), torch.cos(t1[0] + W1[:, F])
    a1 = torch.cat([s1[None], c1 * t1[1:]])  # [D, B, h], the tangents' last
    t2 = a1 @ W2[:, :h].T
    s2, c2 = torch.sin(t2[0] + W2[:, h]), torch.cos(t2[0] + W2[:, h])
    a2 = torch.cat([s2[None], c2 * t2[1:]])
    in1, in2 = torch.cat([phi, one], 2)[:, :, None, :], torch.cat([a1, one], 2)[:, :, None, :]
    sizes = [W1.numel(), W2.numel(), W3.shape[1]]
    J = torch.empty(m, D, B, sum(sizes), dtype=phi.dtype)
    J1, J2, J3 = J.split(sizes, dim=3)
    J1, J2 = J1.view(m, D, B, h, F + 1), J2.view(m, D, B, h, h + 1)
    J3[:] = torch.cat([a2, one, phi], 2)
    for o in range(m):
        mu2 = W3[o, :h] * c2  # adjoint of what enters the second sine, value and tangents alike
        back = mu2 @ W2[:, :h]
        J1[o] = (back * c1)[:, :, None] * in1
        J2[o] = mu2[:, :, None] * in2
        nu2 = -W3[o, :h] * s2 * t2[1:]  # a tangent's residual moves with the value before each sine as well
        nu1 = (nu2 @ W2[:, :h]) * c1 - back * s1 * t1[1:]
        J1[o, 1:] += nu1[..., None] * in1[0]
        J2[o, 1:] += nu2[..., None] * in2[0]
    return J
