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

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor
from torch.func import functional_call, jacrev, vmap

from nocl.nets import FeatureNet
from nocl.support.checks import Array
from nocl.sysid.logs.derivatives import noise
from nocl.sysid.logs.log import Log
from nocl.translate.rk4 import rk4_interval

NOISE_FLOOR = 1e-3  # of a state's spread: logs without noise would weigh rounding
CHUNK = 50  # windows whose sensitivities are held at a time
REJECTIONS = 8  # of a step, before it is given up


@dataclass(frozen=True, eq=False)
class Windows:
    """Pieces of runs of m steps; short ones are filled up with steps of length 0 that count for nothing."""

    start: Tensor  # [W, nx], where simulations start: smoothed states at first
    x: Tensor  # [W, m+1, nx], logged, 0 where missing
    there: Tensor  # [W, m+1, nx], 1 where logged
    u: Tensor  # [W, m, nu]
    h: Tensor  # [W, m, 1]
    noise: Tensor  # [nx], what residuals are measured in

    @staticmethod
    def of(log: Log, m: int, most: int, rng: np.random.Generator) -> Windows:
        """All windows of m steps of a log, or `most` of them at random."""
        pieces = []
        for run in log:
            pieces += [_window(run.t, run.x, run.u, run.smooth.x, k, m) for k in range(0, len(run) - 1, m)]
        if len(pieces) > most:
            pieces = [pieces[i] for i in rng.permutation(len(pieces))[:most]]
        start, x, u, h = (np.stack(p) for p in zip(*pieces, strict=True))
        sigma = np.hypot(noise(log), NOISE_FLOOR * spread_of(np.concatenate([r.smooth.x for r in log])))
        there = np.isfinite(x)
        arrays = (start, np.where(there, x, 0.0), there.astype(float), u, h[..., None], sigma)
        return Windows(*(torch.from_numpy(np.ascontiguousarray(a)) for a in arrays))

    def __getitem__(self, rows: slice) -> Windows:
        return Windows(self.start[rows], self.x[rows], self.there[rows], self.u[rows], self.h[rows], self.noise)

    def __len__(self) -> int:
        return len(self.start)

    def residuals(self, f: Callable[[Tensor, Tensor], Tensor], start: Tensor, substeps: int) -> Tensor:
        """r [W, m+1, nx] of simulations from start [W, nx]."""
        x, path = start, [start]
        for k in range(self.u.shape[1]):
            x = rk4_interval(f, x, self.u[:, k], self.h[:, k], substeps)
            path.append(x)
        return (torch.stack(path, 1) - self.x) * self.there / self.noise


def spread_of(values: Array) -> Array:
    """Standard deviations [n], 1 where nothing varies."""
    spread = values.std(axis=0)
    return np.where(spread > 1e-12 * np.abs(values).max(axis=0), spread, 1.0)


def _window(t: Array, x: Array, u: Array, smoothed: Array, k: int, m: int) -> tuple[Array, Array, Array, Array]:
    """(start, logged states, controls, steps) of the window from sample k on, filled up to m steps."""
    n = min(m, len(t) - 1 - k)
    states, controls, h = np.full((m + 1, x.shape[1]), np.nan), np.zeros((m, u.shape[1])), np.zeros(m)
    states[: n + 1], controls[:n], h[:n] = x[k: k + n + 1], u[k: k + n], np.diff(t[k: k + n + 1])
    controls[n:] = u[k + n - 1]
    return smoothed[k], states, controls, h


@dataclass(eq=False)
class _Problem:
    """The windows, the network whose parameters are fitted, and what they are measured in."""

    net: FeatureNet
    unit: Tensor  # [P]
    windows: Windows
    substeps: int
    ridge: float  # times the sum of squared theta, beside the sum of squared residuals over their number

    def __post_init__(self) -> None:
        self.names = [name for name, _ in self.net.named_parameters()]
        self.shapes = [p.shape for p in self.net.parameters()]
        self.count = float(self.windows.there.sum())
        self.both = vmap(jacrev(self._one, argnums=(0, 1)), in_dims=(None, 0, 0))

    def tensors(self, theta: Tensor) -> dict[str, Tensor]:
        sizes = [s.numel() for s in self.shapes]
        return {n: p.view(s) for n, p, s in zip(self.names, (theta * self.unit).split(sizes), self.shapes, strict=True)}

    def f(self, theta: Tensor) -> Callable[[Tensor, Tensor], Tensor]:
        tensors = self.tensors(theta)
        return lambda x, u: functional_call(self.net, tensors, (x, u))

    def _one(self, theta: Tensor, x: Tensor, u: Tensor) -> Tensor:
        return functional_call(self.net, self.tensors(theta), (x[None], u[None]))[0]

    def loss(self, theta: Tensor, start: Tensor) -> float:
        """Mean square of r, plus the ridge."""
        with torch.no_grad():
            r = self.windows.residuals(self.f(theta), start, self.substeps)
            return float(r.square().sum()) / self.count + self.ridge * float(theta @ theta)

    def normal(self, theta: Tensor, start: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """(J'J [P, P], J'r [P]), starts projected out, and a [W, nx], A [W, nx, P]: starts move a + A dtheta."""
        JJ, Jr, a, A = torch.zeros(len(theta), len(theta), dtype=theta.dtype), torch.zeros_like(theta), [], []
        for first, last in pairwise([*range(0, len(start), CHUNK), len(start)]):
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
        f, P, hh = self.f(theta), len(theta), h[..., None]
        with torch.no_grad():
            k, dk, total, slope = torch.zeros_like(x), torch.zeros_like(S), torch.zeros_like(x), torch.zeros_like(S)
            for c, weight in ((0.0, 1.0), (0.5, 2.0), (0.5, 2.0), (1.0, 1.0)):
                at, moved = x + c * h * k, S + c * hh * dk
                by_theta, by_x = self.both(theta, at, u)
                k, dk = f(at, u), by_x @ moved
                dk[..., :P] += by_theta
                total, slope = total + weight * k, slope + weight * dk
            return x + h / 6 * total, S + hh / 6 * slope


def fit_simulation(net: FeatureNet, unit: Array, windows: Windows, *, steps: int, substeps: int, ridge: float,
                   report: Callable[[float], None]) -> None:
    """Gauss-Newton steps on the windows' residuals; changes the network. `report`: root mean square residual."""
    scale = torch.from_numpy(unit)
    theta = torch.nn.utils.parameters_to_vector(net.parameters()).detach() / scale
    problem = _Problem(net, scale, windows, substeps, ridge)
    start, damping = windows.start, 1e-3
    before = problem.loss(theta, start)
    for _ in range(steps):
        JJ, Jr, a, A = problem.normal(theta, start)
        gradient, former = Jr + ridge * theta, before
        for _ in range(REJECTIONS):
            factor, info = torch.linalg.cholesky_ex(JJ + torch.diag(damping * JJ.diagonal() + ridge + 1e-14))
            if not int(info):
                step = -torch.cholesky_solve(gradient[:, None], factor)[:, 0]
                moved = theta + step, start + a + A @ step
                after = problem.loss(*moved)
                if after < before:
                    (theta, start), before, damping = moved, after, max(0.1 * damping, 1e-9)
                    break
            damping = min(5 * damping, 1e6)
        report(before**0.5)
        if before > former * (1 - 1e-4):
            break
    torch.nn.utils.vector_to_parameters(theta * scale, net.parameters())
