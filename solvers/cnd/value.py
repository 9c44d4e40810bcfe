"""The value function V(x, t): a sum of squares, fitted to optimal costs-to-go and costates where the policy is at home.

V = floor + |y|^2 with a network y(x, t) of nx + 1 outputs: for a linear-quadratic problem y is linear in x, at the
horizon V = G is one where G is a sum of squares, and V never falls below what costs can be.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import cast

import casadi as ca
import numpy as np
import torch
from torch import Tensor

from nocl.data import Solution
from nocl.definition.ocp import OCP
from nocl.nets import MLP, FeatureNet
from nocl.solvers.cnd.loss_kernel import ValueKernel
from nocl.solvers.cnd.regression.features import features
from nocl.solvers.cnd.regression.in_torch import InTorch
from nocl.solvers.cnd.regression.labels import Policy, Problems, answered, kicked_states, tube_states
from nocl.solvers.cnd.regression.regress import LossFunction
from nocl.solvers.cnd.validate import Fine, refined
from nocl.solvers.ddp.bank import SolutionBank
from nocl.solvers.ddp.solver import DDP
from nocl.support.checks import Array
from nocl.support.compiler import NoCompilerError
from nocl.translate.arguments import Arguments
from nocl.translate.torch_functions import to_torch

SMALL = 0.02  # of the median: labels below count as if they were that large in relative errors
ROUND = 0.01  # relative errors above it count by their size, not their square: few labels are hard, or not global
PIECE = 2000  # problems solved on the fine grid at a time
CHUNK = 20_000  # labels whose features are computed at a time


@dataclass(frozen=True, eq=False)
class ValueLabels:
    """Costs-to-go and costates."""

    x: Array  # [n, nx]
    t: Array  # [n]
    p: Array  # [n, np]
    V: Array  # [n]
    V_x: Array  # [n, nx]

    def __len__(self) -> int:
        return len(self.V)

    @staticmethod
    def of(solutions: Iterable[Solution]) -> ValueLabels:
        """Start, end and nodes at doubling distances between them: later nodes have drawn together and tell little."""
        parts = []
        for s in (every[every.success] for every in solutions):
            K = s.u.shape[1]
            doubling = 2 ** np.arange(int(np.log2(max(K - 1, 1))) + 1)
            nodes = np.unique(np.concatenate([[0, K], doubling[doubling < K]]))
            if len(s):
                x, t, V, V_x = (np.concatenate(value[:, nodes]) for value in (s.x, s.t, s.V, s.V_x))
                parts.append(ValueLabels(x, t, np.repeat(s.parameters, len(nodes), axis=0), V, V_x))
        return ValueLabels.join(parts)


    @staticmethod
    def join(parts: Iterable[ValueLabels]) -> ValueLabels:
        parts = list(parts)
        return ValueLabels(*(np.concatenate([getattr(p, n) for p in parts]) for n in ValueLabels.__dataclass_fields__))


def value_tails(ddp: DDP, bank: SolutionBank, policy: Policy, torch_ocp: InTorch, *, initial: int, tails: int,
                visits: int, width: float, kick: float, rng: np.random.Generator) -> Solution:
    """Solutions from initial states, and tails from states of the tube and from those that the policy visits under
    kicks."""
    start = Problems.initial(ddp.ocp, initial, rng)
    _, near = tube_states(ddp.ocp, bank, tails, width, rng)
    kicked = kicked_states(bank, policy, torch_ocp, visits, kick, rng, ddp.substeps)
    return answered(ddp, bank, policy, torch_ocp, Problems.join([start, near, kicked]))


def on_fine_grid(fine: Fine, coarse: Solution) -> Iterator[Solution]:
    """The solutions that succeeded on both grids: a held control costs O(h^2) more than a continuous one. Piece by
    piece, since they take much memory."""
    for start in range(0, len(coarse), PIECE):
        yield refined(fine, coarse[start:start + PIECE])


def value_net(ocp: OCP, labels: ValueLabels, sizes: tuple[int, ...], own: ca.Function | None = None) -> FeatureNet:
    """(x, t[, p]) -> V = floor + unit |y|^2; the floor is 0 where all labels are positive, else below them.

    own: further features.
    """
    s, at = ocp.system, ocp.functions.feedback()
    phi = features(ocp, labels, plain=True, own=own)
    y, floor = ca.SX.sym("y", s.nx + 1), _floor(labels)
    unit = float(np.median(labels.V - floor))
    V = at.function("value", {"V": floor + unit * ca.sumsqr(y)}, y=y)
    return FeatureNet(phi, [MLP([phi.numel_out(0), *sizes, s.nx + 1], skip=True)], V)


def _floor(labels: ValueLabels) -> float:
    least = float(labels.V.min())
    return 0.0 if least >= 0 else least - float(labels.V.std())


def value_loss(net: FeatureNet, labels: ValueLabels, scale: Array, slope_weight: float = 0.1, *,
               compiled: bool = True) -> LossFunction:
    """Mean norm of the relative errors of V - floor and of its gradient, states in units of `scale` [nx].

    Relative, because V and its gradient differ by orders of magnitude between the start and the end of a horizon. In C;
    in torch without `compiled`, or (with a warning) without a C compiler: the same to rounding.
    """
    kind, (floor, unit) = next(net.parameters()).dtype, _units(net)
    phi, slope, rows_of, columns = _features_and_slopes(net, labels, scale)
    V = torch.from_numpy((labels.V - floor) / unit)[:, None]
    V_x = torch.from_numpy(labels.V_x * scale / unit)
    per_V, per_slope = (1 / (a + SMALL * a.median()) for a in (V.clamp(min=0), V_x.square().sum(1, keepdim=True)))
    parts = [phi, slope, V_x, V, per_V, slope_weight * per_slope]
    phi, slope, V_x, V, per_V, per_slope = (part.to(kind) for part in parts)
    mlp = cast(MLP, net.nets[0])
    if compiled:
        try:
            return ValueKernel(mlp, phi, slope, rows_of, columns, V_x, V, per_V, per_slope, ROUND)
        except NoCompilerError as error:
            warnings.warn(f"V is fitted in torch, several times slower: {error}", stacklevel=2)

    def loss(rows: Tensor) -> Tensor:
        p = phi[rows].requires_grad_(True)
        answer = mlp(p).square().sum(1, keepdim=True)
        (by_phi,) = torch.autograd.grad(answer.sum(), p, create_graph=True)
        gradient = torch.zeros_like(V_x[rows]).index_add(1, columns, by_phi[:, rows_of] * slope[rows])
        off = (gradient - V_x[rows]).square().sum(1, keepdim=True) * per_slope[rows]
        square = ((answer - V[rows]) * per_V[rows]).square() + off
        return (square + ROUND**2).sqrt().mean()

    return loss


def _units(net: FeatureNet) -> tuple[float, float]:
    """(floor, unit) of a value network: V = floor + unit |y|^2."""
    *sizes, outputs = (net.outputs.size1_in(i) for i in range(net.outputs.n_in()))
    given, y = [np.zeros(n) for n in sizes], np.eye(outputs)[0]
    floor, above = (float(net.outputs(*given, at)) for at in (0 * y, y))
    return floor, above - floor


def _features_and_slopes(net: FeatureNet, labels: ValueLabels, scale: Array) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """phi [n, F] of all labels, and d phi / d (x / scale) as nonzeros [n, nz] with their rows, columns."""
    at = Arguments.of(net.inputs)
    phi = at.call(net.inputs)
    J = ca.jacobian(phi, at["x"])
    rows, columns = (torch.tensor(i) for i in J.sparsity().get_triplet())
    both = to_torch(at.function("both", {"phi": ca.densify(phi), "slopes": J.nz[:]}))
    known = {"x": labels.x, "t": labels.t[:, None], "p": labels.p}
    given = [torch.from_numpy(known[name]) for name in at.names]
    with torch.no_grad():
        parts = [both(*(z[i:i + CHUNK] for z in given)) for i in range(0, len(labels), CHUNK)]
    values, slopes = (torch.cat([p[i] for p in parts]) for i in range(2))
    return values, slopes * torch.from_numpy(scale)[columns], rows, columns
