"""The simulation error of f_theta on logged windows, and its minimum over weights and starts by Gauss-Newton.

Each run is cut into windows of m steps. f_theta is simulated through a window by RK4, controls held, from a start that
is fitted with the weights ("multiple shooting" without continuity; Bock 1981). The residuals are

    r = (simulated - logged) / noise      at every sample of the window, the first one too,

nothing where a sample is missing. For normal noise the least sum of squares is the maximum likelihood estimate, as far
as a window reaches. The starts are projected out of each Gauss-Newton step (variable projection, Golub and Pereyra
1973): only the weights' normal equations are left, damped as Levenberg and Marquardt do.

Shapes: W windows, m steps, P parameters, theta in units that the caller chooses.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor
from torch.func import functional_call

from nocl.nets import FeatureNet
from nocl.support.checks import Array
from nocl.sysid.logs.derivatives import noise
from nocl.sysid.logs.log import Log, Recording
from nocl.sysid.logs.slopes import Slopes
from nocl.translate.rk4 import rk4_interval

NOISE_FLOOR = 1e-3  # of a state's spread: logs without noise would weigh rounding
HELD = 2**23  # numbers of sensitivities that are held at a time
REJECTIONS = 12  # of a step, before it is given up
SHORTEST = 2  # steps of the first windows
PATIENCE = 3  # steps that together have to take off this share of the loss: of windows to grow yet, of the last
ENOUGH, LAST = 0.05, 0.01


@dataclass(frozen=True, eq=False)
class Windows:
    """Pieces of runs of m steps; short ones are filled up with steps of length 0 that count for nothing."""

    at: Sequence[tuple[int, int]]  # [W] of (run, sample), where in the log each one starts
    start: Tensor  # [W, nx], where simulations start at first
    x: Tensor  # [W, m+1, nx], logged, 0 where missing
    there: Tensor  # [W, m+1, nx], 1 where logged
    u: Tensor  # [W, m, nu]
    h: Tensor  # [W, m, 1]
    noise: Tensor  # [nx], what residuals are measured in

    @staticmethod
    def of(log: Log, states: Sequence[Array], m: int, most: int, rng: np.random.Generator, sigma: Array) -> Windows:
        """All windows of m steps of a log, or `most` of them at random; starts are from each run's states [K+1, nx]."""
        at = [(i, k) for i, run in enumerate(log) for k in range(0, len(run) - 1, m)]
        if len(at) > most:
            at = [at[i] for i in rng.permutation(len(at))[:most]]
        pieces = [_window(log.runs[i], k, m) for i, k in at]
        x, u, h = (np.stack(p) for p in zip(*pieces, strict=True))
        start, there = np.stack([states[i][k] for i, k in at]), np.isfinite(x)
        arrays = (start, np.where(there, x, 0.0), there.astype(float), u, h[..., None], sigma)
        tensors = [torch.from_numpy(np.ascontiguousarray(a)) for a in arrays]
        return Windows(tuple(at), *tensors)

    def __getitem__(self, rows: slice) -> Windows:
        return Windows(self.at[rows], self.start[rows], self.x[rows], self.there[rows], self.u[rows], self.h[rows],
                       self.noise)

    def __len__(self) -> int:
        return len(self.start)

    def paths(self, f: Callable[[Tensor, Tensor], Tensor], start: Tensor, substeps: int) -> Tensor:
        """Simulations from start [W, nx]: [W, m+1, nx]."""
        x, path = start, [start]
        for k in range(self.u.shape[1]):
            x = rk4_interval(f, x, self.u[:, k], self.h[:, k], substeps)
            path.append(x)
        return torch.stack(path, 1)

    def residuals(self, paths: Tensor) -> Tensor:
        """r [W, m+1, nx] of simulations."""
        return (paths - self.x) * self.there / self.noise


def spread_of(values: Array) -> Array:
    """Standard deviations [n], 1 where nothing varies."""
    spread = values.std(axis=0)
    return np.where(spread > 1e-12 * np.abs(values).max(axis=0), spread, 1.0)


def first_noise(log: Log) -> Array:
    """What smoothing took away of each state, and at least NOISE_FLOOR [nx]."""
    return np.hypot(noise(log), _floor(log))


def _floor(log: Log) -> Array:
    return NOISE_FLOOR * spread_of(np.concatenate([r.smooth.x for r in log]))


def _window(run: Recording, k: int, m: int) -> tuple[Array, Array, Array]:
    """(logged states, controls, steps) of the window from sample k on, filled up to m steps."""
    n = min(m, len(run) - 1 - k)
    states, controls, h = np.full((m + 1, run.x.shape[1]), np.nan), np.zeros((m, run.u.shape[1])), np.zeros(m)
    states[: n + 1], controls[:n], h[:n] = run.x[k: k + n + 1], run.u[k: k + n], np.diff(run.t[k: k + n + 1])
    controls[n:] = run.u[k + n - 1]
    return states, controls, h


@dataclass(eq=False)
class WindowProblem:
    """The windows, the network whose parameters are fitted, and what they are measured in."""

    net: FeatureNet
    unit: Tensor  # [P]
    windows: Windows
    substeps: int
    given_ridge: float | None  # times the sum of squared theta, beside the mean of squared residuals

    def __post_init__(self) -> None:
        self.names = [name for name, _ in self.net.named_parameters()]
        self.shapes = [p.shape for p in self.net.parameters()]
        self.count = float(self.windows.there.sum())
        self.ridge = 1 / self.count if self.given_ridge is None else self.given_ridge
        self.slopes = Slopes(self.net)

    def tensors(self, theta: Tensor) -> dict[str, Tensor]:
        sizes = [s.numel() for s in self.shapes]
        return {n: p.view(s) for n, p, s in zip(self.names, (theta * self.unit).split(sizes), self.shapes, strict=True)}

    def f(self, theta: Tensor) -> Callable[[Tensor, Tensor], Tensor]:
        tensors = self.tensors(theta)
        return lambda x, u: functional_call(self.net, tensors, (x, u))

    def loss(self, theta: Tensor, start: Tensor) -> float:
        """Mean square of r, plus the ridge."""
        with torch.no_grad():
            r = self.windows.residuals(self.windows.paths(self.f(theta), start, self.substeps))
            return float(r.square().sum()) / self.count + self.ridge * float(theta @ theta)

    def normal(self, theta: Tensor, start: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """(J'J [P, P], J'r [P]), starts projected out, and a [W, nx], A [W, nx, P]: starts move a + A dtheta."""
        JJ, Jr, a, A = torch.zeros(len(theta), len(theta), dtype=theta.dtype), torch.zeros_like(theta), [], []
        chunk = max(HELD // (self.windows.x[0].numel() * len(theta)), 1)
        for first, last in pairwise([*range(0, len(start), chunk), len(start)]):
            R, D, r = self.sensitivities(theta, self.windows[first:last], start[first:last])
            Q, T = torch.linalg.qr(D)  # [w, rows, nx], [w, nx, nx]
            QR, Qr = Q.transpose(1, 2) @ R, Q.transpose(1, 2) @ r[..., None]
            R -= Q @ QR
            own = r - (Q @ Qr)[..., 0]
            flat = R.reshape(-1, len(theta))
            single = flat.float()  # half the time, and damping covers its rounding
            JJ += (single.T @ single).double()
            Jr += flat.T @ own.reshape(-1)
            A.append(-torch.linalg.solve_triangular(T, QR, upper=True))
            a.append(-torch.linalg.solve_triangular(T, Qr, upper=True)[..., 0])
        return JJ / self.count, Jr / self.count, torch.cat(a), torch.cat(A)

    def sensitivities(self, theta: Tensor, windows: Windows, start: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """r [w, rows] of some windows, and dr/dtheta [w, rows, P], dr/dstart [w, rows, nx]; rows = (m+1) nx."""
        w, nx = start.shape
        x, S = start, torch.cat([torch.zeros(w, nx, len(theta), dtype=theta.dtype),
                                 torch.eye(nx, dtype=theta.dtype).expand(w, nx, nx)], 2)
        paths, slopes = [x], [S]
        for k in range(windows.u.shape[1]):
            h = windows.h[:, k] / self.substeps
            for _ in range(self.substeps):
                x, S = self._step(theta, x, windows.u[:, k], h, S)
            paths.append(x)
            slopes.append(S)
        weight = windows.there / windows.noise
        r = (torch.stack(paths, 1) - windows.x) * weight
        J = (torch.stack(slopes, 1) * weight[..., None]).reshape(w, -1, len(theta) + nx)
        return J[..., : len(theta)].clone(), J[..., len(theta):], r.reshape(w, -1)

    def _step(self, theta: Tensor, x: Tensor, u: Tensor, h: Tensor, S: Tensor) -> tuple[Tensor, Tensor]:
        """One RK4 step and its derivative by (theta, start)."""
        parameters, P, hh = list(self.tensors(theta).values()), len(theta), h[..., None]
        with torch.no_grad():
            k, dk, total, slope = torch.zeros_like(x), torch.zeros_like(S), torch.zeros_like(x), torch.zeros_like(S)
            for c, weight in ((0.0, 1.0), (0.5, 2.0), (0.5, 2.0), (1.0, 1.0)):
                at, moved = x + c * h * k, S + c * hh * dk
                k, by_theta, by_x = self.slopes(parameters, at, u)
                dk = by_x @ moved
                dk[..., :P] += by_theta * self.unit
                total, slope = total + weight * k, slope + weight * dk
            return x + h / 6 * total, S + hh / 6 * slope

    def minimise(self, theta: Tensor, steps: int, enough: float,
                 report: Callable[[float], None]) -> tuple[Tensor, Tensor, WindowFit]:
        """(theta, starts) after at most so many damped Gauss-Newton steps, until PATIENCE of them together take off
        less than a share of `enough`, or none helps."""
        start, damping = self.windows.start, 1e-3
        seen = [self.loss(theta, start)]
        while len(seen) <= steps:
            JJ, Jr, a, A = self.normal(theta, start)
            gradient = Jr + self.ridge * theta
            for _ in range(REJECTIONS):
                factor, info = torch.linalg.cholesky_ex(JJ + torch.diag(damping * JJ.diagonal() + self.ridge + 1e-14))
                if not int(info):
                    step = -torch.cholesky_solve(gradient[:, None], factor)[:, 0]
                    moved = theta + step, start + a + A @ step
                    after = self.loss(*moved)
                    if after < seen[-1]:
                        break
                damping *= 5
            else:
                break
            (theta, start), damping = moved, max(0.1 * damping, 1e-9)
            seen.append(after)
            report(after**0.5)
            if len(seen) > PATIENCE and after > (1 - enough) * seen[-1 - PATIENCE]:
                break
        return theta, start, WindowFit(self.windows.u.shape[1], seen[0]**0.5, seen[-1]**0.5, len(seen) - 1)

    def noise(self, theta: Tensor, start: Tensor) -> Array:
        """What the fit leaves of each state, with the degrees of freedom that starts took [nx]."""
        with torch.no_grad():
            r = self.windows.residuals(self.windows.paths(self.f(theta), start, self.substeps)) * self.windows.noise
        free = self.windows.there.sum(dim=(0, 1)) - self.windows.there.amax(dim=1).sum(dim=0)
        return (r.square().sum(dim=(0, 1)) / free.clamp(min=1)).sqrt().numpy()

    def put(self, states: Sequence[Array], theta: Tensor, start: Tensor) -> None:
        """Write the simulated states of the windows into each run's [K+1, nx]."""
        with torch.no_grad():
            paths = self.windows.paths(self.f(theta), start, self.substeps).numpy()
        for (run, k), path in zip(self.windows.at, paths, strict=True):
            own = states[run][k: k + len(path)]
            own[:] = path[: len(own)]


@dataclass(frozen=True)
class WindowFit:
    """What Gauss-Newton steps on windows of one length came to."""

    steps: int  # of a window
    first: float  # root mean square residual before
    last: float  # and after
    taken: int  # steps that lowered it

    @property
    def failed(self) -> bool:
        """No step helped, and the residuals are not down to the noise."""
        return not self.taken and not self.last <= 1


def lengths(window: int, log: Log) -> list[int]:
    """Windows of 2 steps, then twice as many at a time, up to `window` or the longest run."""
    longest = min(window, max(map(len, log)) - 1)
    halved = [longest]
    while halved[-1] >= 2 * SHORTEST:
        halved.append(halved[-1] // 2)
    return halved[::-1]


def fit_simulation(net: FeatureNet, unit: Array, log: Log, *, window: int, windows: int, steps: int, substeps: int,
                   ridge: float | None, rng: np.random.Generator, report: Callable[[float], None]) -> list[WindowFit]:
    """Gauss-Newton steps on windows that grow as long as they succeed; changes the network.

    A short window has a minimum that can be reached from afar, even where the plant is unstable or smoothing was poor;
    its minimum, weights and states, is where the next one starts. So is the noise that it leaves, where that is less
    than smoothing took away: where controls jump, smoothing takes away what is no noise. `report`: root mean square
    residual of each step.
    """
    scale, states = torch.from_numpy(unit), [run.smooth.x.copy() for run in log]
    theta = torch.nn.utils.parameters_to_vector(net.parameters()).detach() / scale
    stages: list[WindowFit] = []
    sigma, floor = first_noise(log), _floor(log)
    for m in (all_lengths := lengths(window, log)):
        most = windows * window // m  # as many samples
        problem = WindowProblem(net, scale, Windows.of(log, states, m, most, rng, sigma), substeps, ridge)
        theta, start, stage = problem.minimise(theta, steps, LAST if m == all_lengths[-1] else ENOUGH, report)
        stages.append(stage)
        if stage.failed:
            break
        problem.put(states, theta, start)
        sigma = np.minimum(sigma, np.hypot(problem.noise(theta, start), floor))
    torch.nn.utils.vector_to_parameters(theta * scale, net.parameters())
    return stages
