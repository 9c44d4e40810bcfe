"""The networks of a structure: their features and normalised samples, their training, and f_theta put together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import cast

import casadi as ca
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from nocl.definition.system import System
from nocl.nets import MLP, FeatureNet
from nocl.support.checks import Array
from nocl.sysid import fitting
from nocl.sysid.labels import LabelPool, Source, draw_pool, labelled
from nocl.sysid.plain import train as train_plain
from nocl.sysid.progress import Checkpoint, Progress
from nocl.sysid.settings import Budget, Settings
from nocl.sysid.structure import Group, Structure, Variables
from nocl.translate.arguments import Arguments

MAX_POLISHED = 2600  # parameters: beyond, a Levenberg-Marquardt step costs more than it gives
PROBES = 256  # rows at which the frequencies of the first layer are measured
SHARE, LEAST = 0.7, 0.5  # of the measured frequencies, as first weights; and the least of these
FULL_JACOBIAN = 6  # variables up to which every derivative is supervised, beyond it random directions
PLAIN = 4  # variables beyond which a network without sines and cosines of angles is a plain one
PER_WEIGHT = 4  # labels in a batch of Levenberg-Marquardt, at least: it would meet fewer of them and nothing between
NARROWEST = 8  # wide, however few the labels
SMOOTH = 0.5  # times the hidden layers' usual first weights, where labels are few
DESCENT = 0.4  # of a network's time, for SOAP before Levenberg-Marquardt
LONGER = 3  # times as many Levenberg-Marquardt steps there: each is cheap, and they go on to gain


def fit_groups(source: Source, parts: Structure, settings: Settings, seed: int, bar: Progress,
                checkpoint: Checkpoint) -> list[fitting.Weights]:
    """The weights of each group's network, in the units of its entries."""
    if not parts.groups:
        return []
    pool = draw_pool(source, parts, settings, np.random.default_rng((seed, 1)))
    found = None
    if source.oracle is not None and source.gradients and not settings.angles:
        found = frequencies(source, parts, pool.z[:PROBES])
    weights = []
    work = [_work(settings.budget(len(group.variables)), len(group.coefficients)) for group in parts.groups]
    for i in range(len(parts.groups)):
        done = checkpoint.get(i)
        if done is None:
            share = bar.part(work[i] / max(sum(work[i:]), 1e-300))
            done = fit_group(parts, pool, i, settings, seed, share, None, found)
            checkpoint.put(i, done)
        weights.append(done)
    return weights


def _work(budget: Budget, outputs: int) -> float:
    """Of one network's fit, beside others'."""
    return budget.batch * (budget.iterations + budget.polish * budget.width) * budget.width * (budget.width + outputs)


def fit_group(parts: Structure, pool: LabelPool, index: int, settings: Settings, seed: int,
              bar: Progress, old: fitting.Weights | None = None,
              frequency: list[Tensor] | None = None) -> fitting.Weights:
    """Train one network, from `old` weights without SOAP's large steps; its weights in the units of its labels."""
    group = parts.groups[index]
    samples, mean, spread = samples_of(parts, pool, index, settings.angles)
    draws = Draws(samples, settings.gradient_weight, torch.Generator().manual_seed(seed * 1000 + index))
    angles = settings.angles and set(group.variables) & set(parts.split.box.angles)
    plain = draws.variables > PLAIN and not angles and samples.mix is None
    budget = settings.budget(len(group.variables), plain)
    widest = widest_net(samples.phi.shape[1], samples.outputs, draws.labels)
    few = widest < budget.width
    if few:
        budget = replace(budget, width=widest, polish=LONGER * budget.polish)
    own = None if old is None else [old[0], old[1], _scaled(old, -mean / spread, 1 / spread)]
    first, title = None if frequency is None else frequency[index], f"network {index + 1}/{len(parts.groups)}"
    lr = settings.lr if old is None else settings.lr / 4
    if plain:
        with bar.stage(f"{title}, SOAP", budget.iterations) as report:
            weights = train_plain(samples, budget, lr, settings.gradient_weight, draws.generator, report, first,
                                        own, bar.time)
    elif own is None:
        start = fitting.initial(samples.phi.shape[1], budget.width, samples, draws.generator, first)
        start = [SMOOTH * start[0], SMOOTH * start[1], start[2]] if few else start
        weights = _trained(start, draws, budget, lr, title, bar)
    else:
        polished = budget.polish and _can_be_polished(own)
        weights = _trained(own, draws, replace(budget, iterations=0) if polished else budget, lr, title, bar)
    return [*weights[:2], _scaled(weights, mean, spread)]


def _trained(weights: fitting.Weights, draws: Draws, budget: Budget, lr: float, title: str,
             bar: Progress) -> fitting.Weights:
    """After SOAP and Levenberg-Marquardt; float64."""
    if budget.iterations:
        with bar.stage(f"{title}, SOAP", budget.iterations) as report:
            weights = fitting.soap([w.float() for w in weights], draws.to(torch.float32), iterations=budget.iterations,
                               batch=budget.batch, lr=lr, report=report, budget=bar.time.part(DESCENT))
    if budget.polish and _can_be_polished(weights):
        enough = -(-PER_WEIGHT * sum(w.numel() for w in weights) * len(draws.samples) // draws.labels)
        with bar.stage(f"{title}, Levenberg-Marquardt", budget.polish) as report:
            weights = fitting.levenberg_marquardt(weights, draws, steps=budget.polish,
                                              batch=max(budget.polish_batch, enough), report=report,
                                              budget=bar.time)
    return [w.double() for w in weights]


def _can_be_polished(weights: fitting.Weights) -> bool:
    return sum(w.numel() for w in weights) <= MAX_POLISHED


def widest_net(features: int, outputs: int, labels: int) -> int:
    """The width h of the hidden layers at which half as many weights as labels fit, or NARROWEST.

    h^2 + h (F + 2) + m (h + 1 + F) weights of F features and m outputs: networks with more of them swing between the
    samples, with Jacobians, too.
    """
    b = features + 2 + outputs
    return max(NARROWEST, int(np.sqrt(b**2 / 4 + max(labels / 2 - outputs * (1 + features), 0.0)) - b / 2))


def frequencies(source: Source, parts: Structure, z: Array) -> list[Tensor]:
    """First weights by how fast each group's entries change with each variable, in units of its spread. [v] each

    SHARE of the root mean square of d2f / dz2 over that of df / dz about its mean (w for sin(w z)), at least LEAST; 0
    for variables whose derivatives are constant: they enter linearly, which the skip does. 1 + nz labels a row.
    """
    box, found = source.box, []
    at, step = labelled(source, parts, z), 1e-3 * box.width
    assert at.gradient is not None
    moved = [labelled(source, parts, z + step * (np.arange(box.nz) == k)).gradient for k in range(box.nz)]
    for i, group in enumerate(parts.groups):
        own, first = list(group.variables), at.gradient[i]  # [N, m, v]
        weight = 1 / np.maximum(at.value[i].var(axis=0), np.finfo(np.float64).tiny)[:, None]  # entries count alike
        change = np.stack([other[i][:, :, j] for j, k in enumerate(own) if (other := moved[k]) is not None], axis=2)
        second = (weight * np.square((change - first) / step[own]).mean(axis=0)).sum(axis=0)
        varies = (weight * first.var(axis=0)).sum(axis=0)  # [v]
        unit = _spread(box)[own]
        linear = varies * unit**2 <= 1e-16
        ratio = SHARE * unit * np.sqrt(second / np.where(linear, 1.0, varies))
        found.append(torch.from_numpy(np.where(linear, 0.0, np.maximum(ratio, LEAST))))
    return found


def _scaled(weights: fitting.Weights, shift: Array, scale: Array) -> Tensor:
    """W3 of the network whose answers are shift + scale * those of this one."""
    W3 = weights[2].double() * torch.from_numpy(scale)[:, None]
    W3[:, weights[1].shape[0]] += torch.from_numpy(shift)
    return W3


def _features(box: Variables, group: Group, z: ca.SX, angles: bool) -> tuple[list[ca.SX], list[int]]:
    """(phi: sin and cos of angles and scaled others, the place in the group of the variable that each depends on)."""
    phi, owner = [], []
    for i, k in enumerate(group.variables):
        scaled = (z[k] - _centre(box)[k]) / _spread(box)[k]
        new = [ca.sin(z[k]), ca.cos(z[k])] if angles and k in box.angles else [scaled]
        phi += new
        owner += [i] * len(new)
    return phi, owner


def _centre(box: Variables) -> Array:
    return (box.lb + box.ub) / 2


def _spread(box: Variables) -> Array:
    """The standard deviation of uniform samples: the unit in which variables and derivatives are measured."""
    return box.width / np.sqrt(12)


def samples_of(parts: Structure, pool: LabelPool, index: int, angles: bool) -> tuple[fitting.Samples, Array, Array]:
    """(normalised samples of a group, the mean and spread that its network's outputs were normalised by)."""
    box, group, z = parts.split.box, parts.groups[index], ca.SX.sym("z", parts.split.box.nz)
    phi, owner = _features(box, group, z, angles)
    controls = parts.controls(group) if pool.mixed else ()
    unit = _spread(box)[[*group.variables, *controls]]
    slopes = [ca.jacobian(p, z[group.variables[i]]) * unit[i] for p, i in zip(phi, owner, strict=True)]
    value, slope = ca.Function("phi", [z], [ca.vertcat(*phi), ca.densify(ca.vertcat(*slopes))])(pool.z.T)
    y, dy = pool.value[index], None if pool.gradient is None else pool.gradient[index]
    mean = y.mean(axis=0)
    spread = np.sqrt(np.square(y - mean).mean(axis=0))
    spread = np.where(spread > 1e-12 * np.abs(y).max(axis=0), spread, 1.0)
    as_tensor = torch.from_numpy
    mix, of = _mix(parts, group, pool.z, unit) if pool.mixed else (None, None)
    samples = fitting.Samples(as_tensor(value.full().T), as_tensor(slope.full().T), torch.tensor(owner),
                          as_tensor((y - mean) / spread),
                          None if dy is None else as_tensor(dy * unit / spread[:, None]), mix)
    if of is not None:  # a row's mean is its first coefficient's, the only one whose weight is 1 everywhere
        row, column = of
        mean, spread = np.where(column == 0, mean[row], 0.0), spread[row]
    return samples, mean, spread


def _mix(parts: Structure, group: Group, z: Array,
         unit: Array) -> tuple[fitting.Mix, tuple[NDArray[np.intp], NDArray[np.intp]]]:
    """How coefficients make labels of rows of xdot, and each one's (row among the group's, column of the split)."""
    split, rows = parts.split, parts.rows(group)
    entries = np.array(parts.owners())[list(group.coefficients)]
    row, column = np.searchsorted(rows, entries // split.columns), entries % split.columns
    w = list(split.affine)
    weights = np.hstack([np.ones((len(z), 1)), (z[:, w] - split.w0) / split.h])
    place = np.zeros((len(rows), len(entries), split.columns))
    place[row, np.arange(len(entries)), column] = 1.0
    rate = np.zeros((split.columns, len(unit)))
    for i, k in enumerate(parts.controls(group), len(group.variables)):
        rate[1 + w.index(k), i] = unit[i] / split.h[w.index(k)]
    return fitting.Mix(*map(torch.from_numpy, (weights, place, rate))), (row, column)


class Draws:
    """Random batches of samples, all of them where there are no more than a batch holds, and the scale of each
    residual: value 1, derivatives in units of their spread."""

    def __init__(self, samples: fitting.Samples, weight: float, generator: torch.Generator) -> None:
        self.samples, self.generator = samples, generator
        self.variables = 0 if samples.dy is None or not weight else samples.dy.shape[2]
        m, dtype = samples.y.shape[1], samples.y.dtype
        self.scale = torch.ones(1, 1, m, dtype=dtype)
        if samples.dy is None or not weight:
            return
        rms = samples.dy.square().mean(dim=0).sqrt()  # [m, v]
        if self.variables <= FULL_JACOBIAN:
            each = weight / rms.clamp(min=0.05).T[:, None, :]  # [v, 1, m]
        else:
            each = (weight / rms.square().sum(dim=1).sqrt().clamp(min=0.05)).expand(2, 1, m)
        self.scale = torch.cat([self.scale, each])

    @property
    def labels(self) -> int:
        """Numbers to meet."""
        return self.samples.y.numel() * (1 + self.variables)

    def __call__(self, n: int) -> tuple[fitting.Batch, Tensor]:
        N = len(self.samples)
        rows = torch.arange(N) if n >= N else torch.randint(N, (n,), generator=self.generator)
        return self.samples.batch(rows, self._directions()), self.scale

    def _directions(self) -> Tensor:
        """The axes, or two random orthogonal directions of length sqrt(v)."""
        v = self.variables
        if v <= FULL_JACOBIAN:
            return torch.eye(v)
        return torch.linalg.qr(torch.randn(v, 2, generator=self.generator))[0].T * v**0.5

    def to(self, dtype: torch.dtype) -> Draws:
        copy = object.__new__(Draws)
        copy.__dict__ = dict(self.__dict__, samples=self.samples.to(dtype), scale=self.scale.to(dtype))
        return copy


def weights_of(mlp: MLP) -> fitting.Weights:
    """The three weight matrices of a network that `_mlp` made."""
    s = mlp.state_dict()
    return [torch.cat([s["body.0.weight"], s["body.0.bias"][:, None]], 1),
            torch.cat([s["body.2.weight"], s["body.2.bias"][:, None]], 1),
            torch.cat([s["body.4.weight"], s["body.4.bias"][:, None], s["skip.weight"]], 1)]


def _mlp(weights: fitting.Weights) -> MLP:
    """The network of three weight matrices as layers."""
    W1, W2, W3 = weights
    h, F = W1.shape[0], W1.shape[1] - 1
    with torch.device("meta"):  # leaves the caller's random generator alone
        mlp = MLP([F, h, h, W3.shape[0]], "sine", skip=True)
    state = {"body.0.weight": W1[:, :F], "body.0.bias": W1[:, F], "body.2.weight": W2[:, :h], "body.2.bias": W2[:, h],
             "body.4.weight": W3[:, :h], "body.4.bias": W3[:, h], "skip.weight": W3[:, h + 1:]}
    mlp.load_state_dict({k: v.double().contiguous().clone() for k, v in state.items()}, assign=True)
    return mlp


def assemble(parts: Structure, weights: Sequence[fitting.Weights], angles: bool) -> FeatureNet:
    """f_theta: features, the groups' networks, and the known part with the affine controls as the output map."""
    box = parts.split.box
    at = box.arguments()
    z = ca.vertcat(*at.inputs)
    phi = [ca.vertcat(*_features(box, g, z, angles)[0]) for g in parts.groups]
    y = {f"y{i}": ca.SX.sym(f"y{i}", len(g.coefficients)) for i, g in enumerate(parts.groups)}
    learned = {c: a[j] for g, a in zip(parts.groups, y.values(), strict=True) for j, c in enumerate(g.coefficients)}
    inputs = at.function("features", {f"phi{i}": p for i, p in enumerate(phi)})
    outputs = at.function("xdot", {"xdot": parts.xdot(learned, z)}, **y)
    return FeatureNet(inputs, [_mlp(w) for w in weights], outputs).eval()


def apart(net: FeatureNet, system: System) -> FeatureNet:
    """A network of (x, (u, p)) as one of (x, u, p), for a system with parameters."""
    at = system.arguments
    return _through(net, at, at.given(u=ca.vertcat(at["u"], at["p"])).but("p"))


def together(net: FeatureNet, system: System) -> FeatureNet:
    """A network of (x, u, p) as one of (x, (u, p))."""
    at = Arguments.new(ca.SX, x=system.nx, u=system.nu + system.np)
    return _through(net, at, at.given(u=at["u"][:system.nu], p=at["u"][system.nu:]))


def _through(net: FeatureNet, at: Arguments, given: Arguments) -> FeatureNet:
    """A network whose arguments are `at`, and stand in the old one's as `given` has them."""
    phi = net.inputs.call(given.inputs)
    y = {net.outputs.name_in(i): ca.SX.sym(net.outputs.name_in(i), net.outputs.numel_in(i))
         for i in range(net.inputs.n_in(), net.outputs.n_in())}
    inputs = at.function(net.inputs.name(), dict(zip(net.inputs.name_out(), phi, strict=True)))
    value = net.outputs(*given.inputs, *y.values())
    outputs = at.function(net.outputs.name(), {net.outputs.name_out(0): value}, **y)
    return FeatureNet(inputs, cast(Sequence[MLP], net.nets), outputs).eval()
