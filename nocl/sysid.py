"""System identification: f_theta, a network that answers like xdot = f(x, u), from labels of f and its Jacobians.

The default recipe reads the structure off the Jacobian labels first (nocl.structure): what is exactly known is kept
in closed form, and each group of entries with the same variables gets one small network, fitted to values and
derivatives (nocl.fit). Where there is no structure to find, one network of all variables learns everything.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor
from tqdm import tqdm

from nocl import checks, fit, store
from nocl import structure as structures
from nocl.checks import Array
from nocl.data import Dataset
from nocl.nets import ACTIVATIONS, MLP, FeatureNet
from nocl.sampling import Seed
from nocl.structure import Box, Expansion, Group, Oracle, Split, Structure
from nocl.system import System
from nocl.threads import one_thread
from nocl.to_casadi import to_casadi

METHODS = ("default", "mlp", "paper")
KIND = "dynamics"
CHUNK = 100_000  # labels of f held at a time
MIN_ROWS = 2048  # of labels, however many labels of f one takes
MAX_POLISHED = 2600  # parameters: beyond, a Levenberg-Marquardt step costs more than it gives
FULL_JACOBIAN = 4  # variables up to which every derivative is supervised, beyond it random directions


@dataclass(frozen=True)
class Budget:
    """Of one network; more for functions of more variables."""

    width: int  # of its two hidden layers
    iterations: int  # of SOAP
    batch: int
    polish: int  # Levenberg-Marquardt steps
    polish_batch: int

    @staticmethod
    def of(variables: int) -> Budget:
        """What was enough for bundled systems: functions of one variable take seconds, of four about two minutes."""
        if variables <= 1:
            return Budget(16, 500, 256, 60, 512)
        if variables <= 2:
            return Budget(24, 2000, 1024, 40, 1024)
        if variables <= 4:
            return Budget(32, 3000, 1024, 60, 1024)
        return Budget(48 if variables <= 6 else 96, 6000, 1024, 40, 1024)


@dataclass(frozen=True)
class Settings:
    """Of methods "default" and "mlp". None: by the number of a network's variables, as in Budget.of."""

    width: int | None = None
    iterations: int | None = None
    batch: int | None = None
    polish: int | None = None  # Levenberg-Marquardt steps; none for networks of more than 2,600 parameters
    polish_batch: int | None = None
    lr: float = 4e-3  # of SOAP, cosine schedule
    samples: int = 200_000  # labels of f to draw (with data: all of it is used, and no more)
    gradient_weight: float = 1.0  # of derivatives beside values, each in units of its own spread
    structure: bool = True  # read the structure off the Jacobian labels first
    features: bool = True  # look for polynomials in variables and sin, cos of angles
    angles: bool = True  # networks see angles as sin and cos
    probes: int = 64  # points at which the structure is looked for, for each variable

    def __post_init__(self) -> None:
        given = [n for n in ("width", "batch", "polish_batch") if getattr(self, n) is not None]
        _positive(self, (*given, "samples", "probes"), integer=True)
        _positive(self, [n for n in ("iterations", "polish") if getattr(self, n) is not None], integer=True, zero=True)
        _positive(self, ("lr",))
        _positive(self, ("gradient_weight",), zero=True)

    def budget(self, variables: int) -> Budget:
        """The budget of a network of so many variables."""
        own = {name: getattr(self, name) for name in Budget.__dataclass_fields__}
        return replace(Budget.of(variables), **{name: value for name, value in own.items() if value is not None})


@dataclass(frozen=True)
class PaperSettings:
    """Of method "paper": a three-layer MLP (two hidden layers), Adam, exponentially decaying rate."""

    width: int = 64
    layers: int = 3  # of weights
    activation: str = "sine"
    iterations: int = 50_000
    batch: int = 1024
    lr: float = 0.01
    final_lr: float = 1e-5
    samples: int = 200_000

    def __post_init__(self) -> None:
        _positive(self, ("width", "iterations", "batch", "samples"), integer=True)
        _positive(self, ("lr", "final_lr"))
        if not isinstance(self.layers, int) or self.layers < 2:
            raise ValueError(f"PaperSettings: layers is {self.layers!r}; expected an integer >= 2")
        if self.activation not in ACTIVATIONS:
            raise ValueError(f"PaperSettings: activation is {self.activation!r}; "
                             f"expected one of {', '.join(ACTIVATIONS)}")


def _positive(settings: Any, names: Sequence[str], *, integer: bool = False, zero: bool = False) -> None:
    for name in names:
        value = getattr(settings, name)
        kind = int if integer else (int, float)
        good = isinstance(value, kind) and not isinstance(value, bool) and np.isfinite(value)
        if not good or value < 0 or (value == 0 and not zero):
            what = f"{'an integer' if integer else 'a number'} {'>= 0' if zero else '> 0'}"
            raise ValueError(f"{type(settings).__name__}: {name} is {value!r}; expected {what}")


@dataclass(frozen=True)
class Score:
    """Errors of f_theta on held-out samples of the box, in the units of xdot."""

    mean: float  # of ||f_theta - f||_2
    std: float
    median: float
    iqr: float
    jacobian: float  # mean Frobenius norm of the Jacobian's error
    n: int

    def __str__(self) -> str:
        return (f"||f_theta - f|| = {self.mean:.3g} +- {self.std:.2g}, median {self.median:.3g} (iqr {self.iqr:.2g}), "
                f"Jacobian {self.jacobian:.3g}, on {self.n} samples")


@dataclass(frozen=True, eq=False, repr=False)
class LearnedDynamics:
    """xdot = f_theta(x, u): torch rows x [B, nx], u [B, nu] in float64 -> [B, nx].

    The system gives names, boxes and, in `score` and `refine` only, the exact f to compare with or to ask for labels.
    """

    system: System
    net: FeatureNet
    structure: str  # what was found, in words
    card: Mapping[str, Any] = field(default_factory=dict)  # how it was made: method, seed, settings, labels, score
    parts: Structure | None = None  # the structure itself; None for a network that learned everything

    def __call__(self, x: Tensor, u: Tensor) -> Tensor:
        return self.net(x, u)

    def to_casadi(self) -> ca.Function:
        """f:(x, u)->(xdot), native MX, equal to torch to rounding."""
        return to_casadi(self.net, name="f", in_names=["x", "u"], out_names=["xdot"])

    def score(self, n: int = 2000, seed: Seed = 1_000_003) -> Score:
        """Errors against the exact f at n fresh uniform samples of the box X x U."""
        return _score(self.net, Dataset.sample(self.system, n, seed))

    def refine(self, states: ArrayLike, controls: ArrayLike, *, spread: float = 0.05, share: float = 0.7, seed: int = 0,
               settings: Settings | None = None, progress: bool = True) -> LearnedDynamics:
        """More training where solutions go: `share` of the samples near rows (states [N, nx], controls [N, nu]).

        Near: normal noise of `spread` times the width of the box; the other samples fill the box. The networks
        go on from their weights; the structure stays. Asks the system for labels. Raises ValueError for rows that do
        not fit, and for a model with nothing to train.
        """
        return _refined(self, states, controls, spread, share, seed, settings or Settings(), progress)

    def save(self, folder: str | Path) -> Path:
        """Write folder/dynamics.safetensors: weights, maps, the system's equations and the card, as data."""
        parts = None if self.parts is None else _structure_data(self.parts)
        card = {"system": self.system.to_data(), "structure": self.structure, "card": dict(self.card), "parts": parts}
        known = {} if self.parts is None else {"linear": self.parts.linear, "exact": self.parts.exact}
        return store.save(folder, KIND, nets={"f": self.net}, functions=known, card=card)

    @staticmethod
    def load(folder: str | Path) -> LearnedDynamics:
        """What `save` wrote, bit by bit; ValueError for a missing, altered or foreign file."""
        record = store.load(folder, KIND)
        system = System.from_data(record.card["system"])
        parts = _structure_from(record.card["parts"], record.functions, _box(system))
        return LearnedDynamics(system, record.nets["f"].eval(), record.card["structure"], record.card["card"], parts)

    def __repr__(self) -> str:
        nets = [net for net in self.net.nets if isinstance(net, MLP)]
        sizes = ", ".join("-".join(map(str, net.sizes)) for net in nets) or "none: all in closed form"
        return (f"LearnedDynamics of {self.system.name!r} ({self.card.get('method', '?')})\n  {self.structure}\n"
                f"  networks: {sizes}\n  {self.card.get('score', 'not scored')}")


@one_thread()
def identify(system: System, *, data: Dataset | None = None, method: str = "default", gradients: bool = True,
             seed: int = 0, settings: Settings | PaperSettings | None = None, progress: bool = True,
             checkpoint: str | Path | None = None) -> LearnedDynamics:
    """f_theta ~ f on the box X x U, learned from labels of f: values and, with `gradients`, Jacobians.

    Parameters
    ----------
    system : System
        Answers for labels at samples of its box; its equations are never read. With `data`, training takes names, boxes
        and angles from it only; the score on the card always compares with its f.
    data : Dataset
        Labels to learn from instead; without Jacobians A, B, from values alone.
    method : "default", "mlp" or "paper"
        Structure first; one plain sine network; the paper's network, loss and optimiser.
    settings : Settings or (method "paper") PaperSettings
        Budgets and sizes.
    checkpoint : folder
        Finished networks are kept there, and not trained again when the same call is repeated ("paper": unused).

    Raises
    ------
    ValueError
        For settings, data or labels that cannot be used, with the remedy.
    """
    settings = _check_arguments(system, method, settings, seed)
    source = _Source.of(system, data, gradients)
    start = time.perf_counter()
    bar = _Progress(system.name, progress)
    if isinstance(settings, PaperSettings):
        net, words, parts = _paper(source, settings, seed, bar), "one network of all variables, as in the paper", None
    else:
        if method == "mlp":
            settings = replace(settings, structure=False, angles=False)
        parts = _find_structure(source, settings, seed)
        weights = _fit_groups(source, parts, settings, seed, bar, _Checkpoint.at(checkpoint, system, seed, settings))
        net, words = _assemble(parts, weights, settings.angles), parts.words
    card = {"method": method, "gradients": source.gradients, "seed": seed, "settings": asdict(settings),
            "labels": source.labels, "seconds": round(time.perf_counter() - start, 3), "torch": torch.__version__}
    card["score"] = str(_score(net, Dataset.sample(system, 2000, 1_000_003)))
    return LearnedDynamics(system, net, words, card, parts)


def _check_arguments(system: System, method: str, settings: Settings | PaperSettings | None,
                     seed: int) -> Settings | PaperSettings:
    if not isinstance(system, System):
        raise ValueError(f"identify: system is a {type(system).__name__}; expected a nocl.System: "
                         "of an OCP, pass ocp.system")
    if method not in METHODS:
        raise ValueError(f"identify: method is {method!r}; expected one of {', '.join(METHODS)}")
    if isinstance(seed, bool) or not isinstance(seed, int) or seed < 0:
        raise ValueError(f"identify: seed is {seed!r}; expected an integer >= 0")
    expected = PaperSettings if method == "paper" else Settings
    if settings is None:
        return expected()
    if not isinstance(settings, expected):
        raise ValueError(f"identify: settings is a {type(settings).__name__}; method {method!r} takes "
                         f"{expected.__name__}: pass nocl.sysid.{expected.__name__}(...)")
    return settings


def _box(system: System) -> Box:
    lb, ub = np.r_[system.lbx, system.lbu], np.r_[system.ubx, system.ubu]
    return Box(system.names, lb, ub, system.nx, system.angle_indices)


@dataclass(eq=False)
class _Source:
    """Where labels come from: the system as a black box, or given data."""

    box: Box
    gradients: bool
    oracle: Oracle | None  # counts what it is asked
    data: tuple[Array, Array, Array | None] | None  # z, f, df/dz
    labels: int = 0

    @staticmethod
    def of(system: System, data: Dataset | None, gradients: bool) -> _Source:
        if data is not None:
            z, value, gradient = _checked_data(system, data)
            return _Source(_data_box(system, z), gradients and gradient is not None, None,
                           (z, value, gradient if gradients else None), len(z))
        source = _Source(_box(system), gradients, None, None)

        def oracle(x: Array, u: Array) -> Dataset:
            source.labels += len(x)
            return Dataset.label(system, x, u)

        source.oracle = oracle
        return source


def _checked_data(system: System, data: Dataset) -> tuple[Array, Array, Array | None]:
    """(z [N, nz], xdot [N, nx], Jacobians [N, nx, nz] or None) of a Dataset; wrong shapes and NaN raise ValueError."""
    if not isinstance(data, Dataset):
        raise ValueError(f"identify: data is a {type(data).__name__}; expected a nocl.Dataset(x, u, xdot, A, B)")
    nx, nu = system.nx, system.nu
    n = len(np.asarray(data.x))
    if n < 2:
        raise ValueError(f"identify: data has {n} samples; expected at least 2, better thousands")
    if (data.A is None) != (data.B is None):
        raise ValueError("identify: data has only one of the Jacobians A and B; expected both or neither")
    shapes = {"x": (n, nx), "u": (n, nu), "xdot": (n, nx), "A": (n, nx, nx), "B": (n, nx, nu)}
    arrays = {}
    for name, shape in shapes.items():
        if getattr(data, name) is None:
            continue
        arrays[name] = array = np.asarray(getattr(data, name), dtype=np.float64)
        if array.shape != shape:
            raise ValueError(f"identify: data.{name} has shape {array.shape}; expected {shape} for {system.name!r}")
        if not np.isfinite(array).all():
            row = int(np.argwhere(~np.isfinite(array))[0][0])
            raise ValueError(f"identify: data.{name}[{row}] is {array[row].tolist()}; expected finite numbers: "
                             "drop that sample")
    gradient = np.concatenate([arrays["A"], arrays["B"]], axis=2) if "A" in arrays else None
    return np.hstack([arrays["x"], arrays["u"]]), arrays["xdot"], gradient


def _data_box(system: System, z: Array) -> Box:
    """The box that the data fill; the system's where they do not vary."""
    box, lb, ub = _box(system), z.min(axis=0), z.max(axis=0)
    still = ub - lb <= 1e-9 * box.width
    return replace(box, lb=np.where(still, box.lb, lb), ub=np.where(still, box.ub, ub))


def _find_structure(source: _Source, settings: Settings, seed: int) -> Structure:
    if not settings.structure:
        return structures.plain(source.box)
    if not source.gradients:
        return structures.plain(source.box, "without Jacobian labels no structure was looked for: "
                                "one network of all variables")
    if source.oracle is not None:
        return structures.find(source.oracle, source.box, seed=seed, probes=settings.probes, features=settings.features)
    assert source.data is not None
    z, value, gradient = source.data
    assert gradient is not None
    return structures.read(z, value, gradient, source.box, features=settings.features)


@dataclass(frozen=True, eq=False)
class _Pool:
    """What the networks learn from: rows z, and the learned entries' labels by group."""

    z: Array  # [N, nz]
    value: list[Array]  # per group [N, m]
    gradient: list[Array] | None  # per group [N, m, v]


def _pool(source: _Source, parts: Structure, settings: Settings, rng: np.random.Generator) -> _Pool:
    """Labels for every group: at fresh uniform samples of the box, or all of the data."""
    if source.data is not None:
        z, value, gradient = source.data
        own = [e for expansion in parts.expansions for e in expansion.entries]  # without variables: entries of f
        jacobian = np.zeros((len(z), source.box.nx, source.box.nz)) if gradient is None else gradient
        known, slope = structures.evaluate(parts.linear, z)
        return _collect([(z, (value - known)[:, own], (jacobian - slope)[:, own])], parts, gradient is not None)
    assert source.oracle is not None
    z = source.box.sample(_rows(parts, settings), rng)
    return _labelled(source, parts, z)


def _rows(parts: Structure, settings: Settings) -> int:
    """How many rows the budget of labels buys."""
    return max(settings.samples // parts.cost, MIN_ROWS)


def _labelled(source: _Source, parts: Structure, z: Array) -> _Pool:
    """The black box's labels at rows z."""
    assert source.oracle is not None
    chunks = ((r, *parts.residual(source.oracle, r)) for r in np.array_split(z, -(-len(z) * parts.cost // CHUNK)))
    return _collect(chunks, parts, source.gradients)


def _collect(chunks: Any, parts: Structure, gradients: bool) -> _Pool:
    rows, values, slopes = [], [], []
    for z, value, gradient in chunks:
        rows.append(z)
        values.append([value[:, g.coefficients] for g in parts.groups])
        slopes.append([gradient[:, g.coefficients][:, :, g.variables] for g in parts.groups] if gradients else [])
    join = [[np.concatenate(part) for part in zip(*pieces, strict=True)] for pieces in (values, slopes)]
    return _Pool(np.concatenate(rows), join[0], join[1] if gradients else None)


def _features(box: Box, group: Group, z: ca.SX, angles: bool) -> tuple[list[ca.SX], list[int]]:
    """(phi: sin and cos of angles and scaled others, the place in the group of the variable that each depends on)."""
    phi, owner = [], []
    for i, k in enumerate(group.variables):
        scaled = (z[k] - _centre(box)[k]) / _spread(box)[k]
        new = [ca.sin(z[k]), ca.cos(z[k])] if angles and k in box.angles else [scaled]
        phi += new
        owner += [i] * len(new)
    return phi, owner


def _centre(box: Box) -> Array:
    return (box.lb + box.ub) / 2


def _spread(box: Box) -> Array:
    """The standard deviation of uniform samples: the unit in which variables and derivatives are measured."""
    return box.width / np.sqrt(12)


def _samples(box: Box, group: Group, pool: _Pool, index: int, angles: bool) -> tuple[fit.Samples, Array, Array]:
    """(normalised samples of a group, the mean and spread that its labels were normalised by)."""
    z = ca.SX.sym("z", box.nz)
    phi, owner = _features(box, group, z, angles)
    unit = _spread(box)[list(group.variables)]
    slopes = [ca.jacobian(p, z[group.variables[i]]) * unit[i] for p, i in zip(phi, owner, strict=True)]
    value, slope = ca.Function("phi", [z], [ca.vertcat(*phi), ca.densify(ca.vertcat(*slopes))])(pool.z.T)
    y, dy = pool.value[index], None if pool.gradient is None else pool.gradient[index]
    mean = y.mean(axis=0)
    spread = np.sqrt(np.square(y - mean).mean(axis=0))
    spread = np.where(spread > 1e-12 * np.abs(y).max(axis=0), spread, 1.0)
    as_tensor = torch.from_numpy
    return (fit.Samples(as_tensor(value.full().T), as_tensor(slope.full().T), torch.tensor(owner),
                        as_tensor((y - mean) / spread),
                        None if dy is None else as_tensor(dy * unit / spread[:, None])), mean, spread)


class _Draws:
    """Random batches of samples, with the scale of each residual: value 1, derivatives in units of their spread."""

    def __init__(self, samples: fit.Samples, weight: float, generator: torch.Generator) -> None:
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

    def __call__(self, n: int) -> tuple[fit.Batch, Tensor]:
        rows = torch.randint(len(self.samples), (n,), generator=self.generator)
        return self.samples.batch(rows, self._directions()), self.scale

    def _directions(self) -> Tensor:
        """The axes, or two random orthogonal directions of length sqrt(v)."""
        v = self.variables
        if v <= FULL_JACOBIAN:
            return torch.eye(v)
        return torch.linalg.qr(torch.randn(v, 2, generator=self.generator))[0].T * v**0.5

    def to(self, dtype: torch.dtype) -> _Draws:
        copy = object.__new__(_Draws)
        copy.__dict__ = dict(self.__dict__, samples=self.samples.to(dtype), scale=self.scale.to(dtype))
        return copy


def _fit_groups(source: _Source, parts: Structure, settings: Settings, seed: int, bar: _Progress,
                checkpoint: _Checkpoint) -> list[fit.Weights]:
    """The weights of each group's network, in the units of its entries."""
    if not parts.groups:
        return []
    pool = _pool(source, parts, settings, np.random.default_rng((seed, 1)))
    weights = []
    for i in range(len(parts.groups)):
        done = checkpoint.get(i)
        weights.append(_fit_group(source.box, parts, pool, i, settings, seed, bar) if done is None else done)
        if done is None:
            checkpoint.put(i, weights[-1])
    return weights


def _fit_group(box: Box, parts: Structure, pool: _Pool, index: int, settings: Settings, seed: int,
               bar: _Progress, old: fit.Weights | None = None) -> fit.Weights:
    """Train one network, from `old` weights without SOAP's large steps; its weights in the units of its labels."""
    group = parts.groups[index]
    samples, mean, spread = _samples(box, group, pool, index, settings.angles)
    generator = torch.Generator().manual_seed(seed * 1000 + index)
    draws = _Draws(samples, settings.gradient_weight, generator)
    budget = settings.budget(len(group.variables))
    if old is None:
        weights = fit.initial(samples.phi.shape[1], budget.width, samples, generator)
    else:
        weights = [old[0], old[1], _scaled(old, -mean / spread, 1 / spread)]
    polish = budget.polish if sum(w.numel() for w in weights) <= MAX_POLISHED else 0
    iterations = 0 if old is not None and polish else budget.iterations
    title = f"network {index + 1}/{len(parts.groups)}"
    if iterations:
        with bar.stage(f"{title}, SOAP", iterations) as report:
            weights = fit.soap([w.float() for w in weights], draws.to(torch.float32), iterations=iterations,
                               batch=budget.batch, lr=settings.lr if old is None else settings.lr / 4, report=report)
    if polish:
        with bar.stage(f"{title}, Levenberg-Marquardt", polish) as report:
            weights = fit.levenberg_marquardt(weights, draws, steps=polish, batch=budget.polish_batch, report=report)
    weights = [w.double() for w in weights]
    return [*weights[:2], _scaled(weights, mean, spread)]


def _scaled(weights: fit.Weights, shift: Array, scale: Array) -> Tensor:
    """W3 of the network whose answers are shift + scale * those of this one."""
    W3 = weights[2].double() * torch.from_numpy(scale)[:, None]
    W3[:, weights[1].shape[0]] += torch.from_numpy(shift)
    return W3


def _refined(model: LearnedDynamics, states: ArrayLike, controls: ArrayLike, spread: float, share: float, seed: int,
             settings: Settings, progress: bool) -> LearnedDynamics:
    system, parts = model.system, model.parts
    if parts is None or not parts.groups:
        raise ValueError("refine: the model has no networks that could be trained; expected one of method 'default' or "
                         "'mlp' that is not all in closed form")
    if not (np.isfinite(spread) and spread > 0 and 0 < share <= 1):
        raise ValueError(f"refine: spread is {spread}, share is {share}; expected spread > 0 and 0 < share <= 1")
    near = np.hstack([checks.states(states, system.nx, system.name, "states")[0],
                      checks.states(controls, system.nu, system.name, "controls")[0]])
    rng, source, start = np.random.default_rng((seed, 2)), _Source.of(system, None, True), time.perf_counter()
    n, box = _rows(parts, settings), parts.split.box
    z = box.sample(n, rng)
    tube = rng.random(n) < share
    picked = near[rng.integers(len(near), size=int(tube.sum()))]
    z[tube] = picked + spread * box.width * rng.standard_normal(picked.shape)
    pool, bar = _labelled(source, parts, z), _Progress(system.name, progress)
    old = [_weights(net) for net in model.net.nets if isinstance(net, MLP)]
    angles = bool(model.card["settings"]["angles"])
    settings = replace(settings, angles=angles)
    weights = [_fit_group(box, parts, pool, i, settings, seed, bar, w) for i, w in enumerate(old)]
    net = _assemble(parts, weights, angles)
    card = {**model.card, "labels": model.card["labels"] + source.labels, "refined": model.card.get("refined", 0) + 1,
            "seconds": round(model.card["seconds"] + time.perf_counter() - start, 3),
            "score": str(_score(net, Dataset.sample(system, 2000, 1_000_003)))}
    return LearnedDynamics(system, net, model.structure, card, parts)


def _weights(mlp: MLP) -> fit.Weights:
    """The three weight matrices of a network that `_mlp` made."""
    s = mlp.state_dict()
    return [torch.cat([s["body.0.weight"], s["body.0.bias"][:, None]], 1),
            torch.cat([s["body.2.weight"], s["body.2.bias"][:, None]], 1),
            torch.cat([s["body.4.weight"], s["body.4.bias"][:, None], s["skip.weight"]], 1)]


def _mlp(weights: fit.Weights) -> MLP:
    """The network of three weight matrices as layers."""
    W1, W2, W3 = weights
    h, F = W1.shape[0], W1.shape[1] - 1
    with torch.device("meta"):  # leaves the caller's random generator alone
        mlp = MLP([F, h, h, W3.shape[0]], "sine", skip=True)
    state = {"body.0.weight": W1[:, :F], "body.0.bias": W1[:, F], "body.2.weight": W2[:, :h], "body.2.bias": W2[:, h],
             "body.4.weight": W3[:, :h], "body.4.bias": W3[:, h], "skip.weight": W3[:, h + 1:]}
    mlp.load_state_dict({k: v.double().contiguous().clone() for k, v in state.items()}, assign=True)
    return mlp


def _assemble(parts: Structure, weights: Sequence[fit.Weights], angles: bool) -> FeatureNet:
    """f_theta: features, the groups' networks, and the known part with the affine controls as the output map."""
    box = parts.split.box
    x, u = ca.SX.sym("x", box.nx), ca.SX.sym("u", box.nz - box.nx)
    z = ca.vertcat(x, u)
    phi = [ca.vertcat(*_features(box, g, z, angles)[0]) for g in parts.groups]
    y = [ca.SX.sym(f"y{i}", len(g.coefficients)) for i, g in enumerate(parts.groups)]
    learned = {c: a[j] for g, a in zip(parts.groups, y, strict=True) for j, c in enumerate(g.coefficients)}
    inputs = ca.Function("features", [x, u], phi, ["x", "u"], [f"phi{i}" for i in range(len(phi))])
    names = ["x", "u", *(f"y{i}" for i in range(len(y)))]
    outputs = ca.Function("xdot", [x, u, *y], [parts.xdot(learned, z)], names, ["xdot"])
    return FeatureNet(inputs, [_mlp(w) for w in weights], outputs).eval()


def _score(net: FeatureNet, data: Dataset) -> Score:
    """Errors of a network on exact labels."""
    x, u = (torch.from_numpy(np.ascontiguousarray(a)) for a in (data.x, data.u))
    value, gradient = _value_and_jacobian(net, x, u)
    error = np.linalg.norm(value - data.xdot, axis=1)
    assert data.A is not None
    assert data.B is not None
    slope = gradient - np.concatenate([data.A, data.B], axis=2)
    q1, median, q3 = np.percentile(error, [25, 50, 75])
    return Score(float(error.mean()), float(error.std()), float(median), float(q3 - q1),
                 float(np.linalg.norm(slope, axis=(1, 2)).mean()), len(error))


def _value_and_jacobian(net: FeatureNet, x: Tensor, u: Tensor) -> tuple[Array, Array]:
    """f_theta [N, nx] and its Jacobian [N, nx, nz] at rows, by reverse mode, an output at a time."""
    z = torch.cat([x, u], 1).requires_grad_()
    y = net(z[:, : x.shape[1]], z[:, x.shape[1]:])
    rows = [torch.autograd.grad(y[:, i].sum() + 0 * z.sum(), z, retain_graph=True)[0] for i in range(y.shape[1])]
    return y.detach().numpy(), torch.stack(rows, 1).numpy()


def _paper(source: _Source, settings: PaperSettings, seed: int, bar: _Progress) -> FeatureNet:
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
            value_of = _paper_loss(mlp, z[rows], value[rows], None if gradient is None else gradient[rows])
            optimizer.zero_grad()
            value_of.backward()
            optimizer.step()
            schedule.step()
            report(float(value_of.detach()))
    x, u = ca.SX.sym("x", source.box.nx), ca.SX.sym("u", source.box.nz - source.box.nx)
    y = ca.SX.sym("y", source.box.nx)
    inputs = ca.Function("features", [x, u], [ca.vertcat(x, u)], ["x", "u"], ["z"])
    return FeatureNet(inputs, [mlp.double()], ca.Function("xdot", [x, u, y], [y], ["x", "u", "y"], ["xdot"])).eval()


def _raw_labels(source: _Source, settings: PaperSettings, seed: int) -> tuple[Tensor, Tensor, Tensor | None]:
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


def _paper_loss(mlp: MLP, z: Tensor, value: Tensor, gradient: Tensor | None) -> Tensor:
    """Mean over the batch of ||f_theta - f||_2 + ||grad f_theta - grad f||_F."""
    error = torch.linalg.vector_norm(mlp(z) - value, dim=1).mean()
    if gradient is None:
        return error
    jacobian = torch.func.vmap(torch.func.jacrev(mlp))(z)
    return error + torch.linalg.vector_norm(jacobian - gradient, dim=(1, 2)).mean()


class _Progress:
    """One tqdm bar a stage, with the loss and the time left."""

    def __init__(self, name: str, show: bool) -> None:
        self.name, self.show = name, show

    def stage(self, title: str, total: int) -> _Stage:
        return _Stage(f"identify {self.name}: {title}", total, self.show and total > 0)


class _Stage:
    def __init__(self, title: str, total: int, show: bool) -> None:
        self.bar = tqdm(total=total, desc=title, disable=not show, mininterval=0.5)

    def __enter__(self) -> Callable[[float], None]:
        return self._report

    def _report(self, rms: float) -> None:
        if not self.bar.disable:
            self.bar.set_postfix(error=f"{rms:.2g}", refresh=False)
            self.bar.update()

    def __exit__(self, *_: object) -> None:
        self.bar.close()


@dataclass(frozen=True)
class _Checkpoint:
    """Finished networks in a folder, or nowhere."""

    folder: Path | None
    meta: Mapping[str, Any]

    @staticmethod
    def at(folder: str | Path | None, system: System, seed: int, settings: Settings) -> _Checkpoint:
        meta = {"system": system.to_data(), "seed": seed, "settings": asdict(settings)}
        return _Checkpoint(None if folder is None else Path(folder), meta)

    def _path(self, index: int) -> Path:
        assert self.folder is not None
        return self.folder / f"dynamics-{index}.safetensors"

    def get(self, index: int) -> fit.Weights | None:
        """The finished network, None where there is none; ValueError where it is of another call."""
        if self.folder is None or not self._path(index).is_file():
            return None
        state, meta = store.load_checkpoint(self._path(index))
        if meta != self.meta:
            raise ValueError(f"{self._path(index)} is of another system, seed or settings; expected the same call as "
                             "the one that is resumed: use another checkpoint folder")
        return list(state)

    def put(self, index: int, weights: fit.Weights) -> None:
        if self.folder is not None:
            store.save_checkpoint(self._path(index), list(weights), self.meta)


def _structure_data(parts: Structure) -> dict[str, Any]:
    split = parts.split
    return {"affine": list(split.affine), "w0": split.w0.tolist(), "h": split.h.tolist(), "words": parts.words,
            "labels": parts.labels, "groups": [[list(g.variables), list(g.coefficients)] for g in parts.groups],
            "expansions": [[list(e.entries), list(e.variables), list(e.degrees)] for e in parts.expansions],
            "lb": split.box.lb.tolist(), "ub": split.box.ub.tolist()}


def _structure_from(data: Mapping[str, Any] | None, functions: Mapping[str, ca.Function], box: Box) -> Structure | None:
    if data is None:
        return None
    box = replace(box, lb=np.array(data["lb"]), ub=np.array(data["ub"]))
    split = Split(box, tuple(data["affine"]), np.array(data["w0"]), np.array(data["h"]))
    expansions = tuple(Expansion(box, *map(tuple, parts)) for parts in data["expansions"])
    groups = tuple(Group(tuple(v), tuple(c)) for v, c in data["groups"])
    return Structure(split, functions["linear"], expansions, functions["exact"], groups, data["words"], data["labels"])
