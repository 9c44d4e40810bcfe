"""f_theta from logged trajectories: derivatives first, then what a simulation of f_theta gets wrong.

1. Smoothed (or logged) derivatives give a first f_theta: least squares by L-BFGS (scipy). Smoothing leaves a bias.
2. The simulation error on windows of the log as it is, noise and all, by Gauss-Newton (nocl.sysid.logs.shooting).
"""

from __future__ import annotations

import copy
import warnings
from collections.abc import Callable

import numpy as np
import torch
from scipy.optimize import minimize
from torch import Tensor
from torch.func import jacrev, vmap

from nocl.definition.substeps import FINEST, Grid, grid_of
from nocl.nets import MLP, FeatureNet
from nocl.support.checks import Array
from nocl.sysid import fitting
from nocl.sysid.logs.derivatives import labels
from nocl.sysid.logs.log import Log, Recording
from nocl.sysid.logs.shooting import WindowFit, fit_simulation, lengths, spread_of
from nocl.sysid.networks import assemble
from nocl.sysid.progress import Progress
from nocl.sysid.settings import LogSettings
from nocl.sysid.structure import Structure
from nocl.translate.rk4 import rk4_interval

MEMORY = 30  # of L-BFGS
MOST = 8  # steps that are chosen: each costs as much as one
SAMPLES = 1000  # of a log, about, that the length of steps is judged on


def fit_log(log: Log, parts: Structure, settings: LogSettings, seed: int,
            bar: Progress) -> tuple[FeatureNet, list[WindowFit], int]:
    """f_theta of the given structure, fitted to a log, how the simulation error went down, and RK4 steps between two
    samples, with which it was fitted.

    Raises ValueError where no finite weights were found.
    """
    x, u, xdot = (np.concatenate(a) for a in zip(*map(labels, log), strict=True))
    net = assemble(parts, initial(parts, settings, seed), settings.angles)
    if not parts.groups:
        return net, [], settings.substeps or 1
    unit = output_units(parts, net, xdot)
    fit_derivatives(net, unit, x, u, xdot, settings, bar)
    stages, substeps = _fit_simulation(net, unit, log, settings, seed, bar)
    if not all(torch.isfinite(p).all() for p in net.parameters()):
        raise ValueError("identify: the fit to the log is not finite; expected numbers of ordinary size: look for "
                         "outliers, or scale states, controls and time")
    return net.requires_grad_(False), stages, substeps


def _fit_simulation(net: FeatureNet, unit: Array, log: Log, settings: LogSettings, seed: int,
                    bar: Progress) -> tuple[list[WindowFit], int]:
    """Fits the network to the log by simulation, by as many RK4 steps as the fit turns out to need."""
    first, stages = copy.deepcopy(net.state_dict()), list[WindowFit]()

    def ask(substeps: int) -> Grid:
        net.load_state_dict(first)
        if settings.steps:
            with bar.stage("simulation error", settings.steps * len(lengths(settings.window, log))) as report:
                stages[:] = fit_simulation(net, unit, log, window=settings.window, windows=settings.windows,
                                           steps=settings.steps, substeps=substeps, ridge=settings.ridge,
                                           rng=np.random.default_rng((seed, 3)), report=report)
        return steps_of(net, log, substeps)

    grid = ask(settings.substeps or 1)
    again = grid.needed if grid.coarse and settings.substeps is None else None
    if grid.coarse:
        warnings.warn(f"identify: {grid}{', so it is fitted again' if again else ''}", stacklevel=6)
    if again:
        grid = ask(again := min(again, MOST))
    return stages, again or grid.substeps


def steps_of(net: FeatureNet, log: Log, substeps: int) -> Grid:
    """Whether steps between the samples of a log are short enough for f_theta, from one sample to the next."""
    x, u, h = (np.concatenate(a) for a in zip(*((r.smooth.x[:-1], r.u[:len(r) - 1], np.diff(r.t)) for r in log),
                                              strict=True))
    rows = np.flatnonzero(np.isfinite(x).all(axis=1) & np.isfinite(u).all(axis=1))
    rows = rows[:: max(len(rows) // SAMPLES, 1)]
    X, U, H = (torch.from_numpy(np.ascontiguousarray(a[rows])) for a in (x, u, h[:, None]))
    spread = spread_of(x[rows])

    def after(n: int) -> Array:
        with torch.no_grad():
            return np.asarray(rk4_interval(net, X, U, H, n).numpy())

    true = after(FINEST)

    def error(n: int) -> float:
        with np.errstate(all="ignore"):
            worst = float((np.abs(after(n) - true) / spread).max(initial=0.0))
        return worst if np.isfinite(worst) else np.inf

    A = jacrev(lambda x, u: net(x[None], u[None])[0])
    slopes = vmap(A)(X, U).detach().numpy()
    rate = np.abs(np.linalg.eigvals(slopes[np.isfinite(slopes).all(axis=(1, 2))]).real).max(initial=0.0)
    return grid_of(float(np.median(h[rows])), substeps, error, 1 / rate if rate > 0 else np.inf,
                   "its simulation and its equations")


def first_states(log: Log) -> list[tuple[Array, Recording]]:
    """Each run with its smoothed states at all samples but the last."""
    return [(run.smooth.x[:-1], run) for run in log]


def initial(parts: Structure, settings: LogSettings, seed: int) -> list[fitting.Weights]:
    """Random hidden layers, outputs zero."""
    generator, h, angles = torch.Generator().manual_seed(seed), settings.width, parts.split.box.angles
    weights: list[fitting.Weights] = []
    for group in parts.groups:
        F, m = len(group.variables) + sum(k in angles for k in group.variables if settings.angles), \
            len(group.coefficients)
        W1 = torch.randn(h, F + 1, generator=generator, dtype=torch.float64) / F**0.5
        W2 = torch.randn(h, h + 1, generator=generator, dtype=torch.float64) / h**0.5
        weights.append([W1, W2, torch.zeros(m, h + 1 + F, dtype=torch.float64)])
    return weights


def output_units(parts: Structure, net: FeatureNet, xdot: Array) -> Array:
    """What each parameter is measured in: the spread of its row of xdot in an output layer, 1 elsewhere."""
    spread = spread_of(xdot)
    entries = [e for expansion in parts.expansions for e in expansion.entries]
    units = []
    for group, mlp in zip(parts.groups, net.nets, strict=True):
        assert isinstance(mlp, MLP)
        own = spread[[entries[c] // parts.split.columns for c in group.coefficients]]
        for name, p in mlp.named_parameters():
            last = name.startswith(("body.4", "skip"))
            units.append(np.repeat(own, p.numel() // len(own)) if last else np.ones(p.numel()))
    return np.concatenate(units)


def fit_derivatives(net: FeatureNet, unit: Array, x: Array, u: Array, xdot: Array, settings: LogSettings,
                    bar: Progress) -> None:
    """Least squares of f_theta(x, u) - xdot, each row in units of its spread; changes the network."""
    X, U, Y = (torch.from_numpy(np.ascontiguousarray(a)) for a in (x, u, xdot))
    scale = torch.from_numpy(1 / spread_of(xdot))

    ridge = 1 / Y.numel() if settings.ridge is None else settings.ridge
    with bar.stage("derivatives", settings.iterations) as report:
        _descend(net, unit, lambda: ((net(X, U) - Y) * scale).square().mean(), settings.iterations, ridge, report)


def _descend(net: FeatureNet, unit: Array, loss: Callable[[], Tensor], iterations: int, ridge: float,
             report: Callable[[float], None]) -> None:
    """Minimise loss() + ridge * |theta|^2 over the network's parameters, theta = parameters / unit, by L-BFGS."""
    parameters = [p.requires_grad_() for p in net.parameters()]
    first = torch.nn.utils.parameters_to_vector(parameters).detach().numpy() / unit

    def put(theta: Array) -> None:
        with torch.no_grad():
            torch.nn.utils.vector_to_parameters(torch.from_numpy(theta * unit), parameters)

    def value_and_gradient(theta: Array) -> tuple[float, Array]:
        put(theta)
        value = loss()
        gradient = np.concatenate([g.numpy().ravel() for g in torch.autograd.grad(value, parameters)])
        return float(value.detach()) + ridge * float(theta @ theta), gradient * unit + 2 * ridge * theta

    result = minimize(value_and_gradient, first, jac=True, method="L-BFGS-B",
                      callback=lambda intermediate_result: report(intermediate_result.fun**0.5),
                      options={"maxiter": iterations, "maxfun": 2 * iterations, "maxcor": MEMORY, "ftol": 1e-12,
                               "gtol": 1e-9})
    put(result.x)
