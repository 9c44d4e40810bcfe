"""How far ahead a learned model predicts: errors of simulations from logged states, against the horizon."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from nocl.support.checks import Array
from nocl.support.threads import one_thread
from nocl.sysid.logs.log import Log, Recording
from nocl.translate.rk4 import rk4_interval

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Field = Callable[[torch.Tensor, torch.Tensor], torch.Tensor]  # (x, u) -> xdot, rows
HORIZONS = (1, 2, 5, 10, 20, 50, 100)  # in steps


@dataclass(frozen=True, eq=False, repr=False)
class Validation:
    """Errors of k-step simulations, k in `steps`, from every `every`-th sample of a log.

    Simulations start at logged states or at smoothed ones, whichever predict one step better, and are compared with
    logged ones: noise is part of the error. `still` is the error of the prediction that nothing moves.
    """

    states: tuple[str, ...]
    steps: tuple[int, ...]  # k
    seconds: Array  # [H], the usual length of k steps, in the log's unit of time
    rms: Array  # [H, nx], root mean square of simulated - logged
    still: Array  # [H, nx]
    spread: Array  # [nx], standard deviation of the logged states
    n: Array  # [H], number of simulations
    blown: Array  # [H], of those, how many were not finite: they do not count in rms
    start: str  # "logged" or "smoothed"

    @property
    def relative(self) -> Array:
        """The error of each horizon in units of the states' spread, root mean square over states [H]."""
        return np.sqrt(np.square(self.rms / self.spread).mean(axis=1))

    @property
    def still_relative(self) -> Array:
        """The same of the prediction that nothing moves [H]."""
        return np.sqrt(np.square(self.still / self.spread).mean(axis=1))

    def __str__(self) -> str:
        head = ["steps", "time", *self.states, "of spread", "standing still"]
        rows = [[f"{k}", f"{s:.3g}", *(f"{e:.3g}" for e in rms), f"{100 * r:.3g} %", f"{100 * q:.3g} %"]
                for k, s, rms, r, q in zip(self.steps, self.seconds, self.rms, self.relative, self.still_relative,
                                           strict=True)]
        widths = [max(map(len, column)) for column in zip(head, *rows, strict=True)]
        lines = ["  ".join(cell.rjust(w) for cell, w in zip(row, widths, strict=True)) for row in (head, *rows)]
        if self.blown.any():
            lines.append(f"simulations that blew up: {', '.join(map(str, self.blown))}")
        return "\n".join(lines)

    __repr__ = __str__

    def to_data(self) -> dict[str, Any]:
        """The numbers as plain JSON data."""
        return {"states": list(self.states), "steps": list(self.steps), "seconds": self.seconds.tolist(),
                "rms": self.rms.tolist(), "still": self.still.tolist(), "spread": self.spread.tolist(),
                "relative": self.relative.tolist(), "n": self.n.tolist(), "blown": self.blown.tolist(),
                "start": self.start}

    def plot(self) -> Figure:
        """Error against the horizon, a line for each state, in units of its spread; dashed: standing still."""
        from matplotlib.figure import Figure

        figure = Figure(figsize=(6.4, 4.0), layout="constrained")
        axes = figure.subplots()
        for i, name in enumerate(self.states):
            line, = axes.loglog(self.seconds, self.rms[:, i] / self.spread[i], "o-", label=name)
            axes.loglog(self.seconds, self.still[:, i] / self.spread[i], "--", color=line.get_color(), alpha=0.5)
        axes.set(xlabel="horizon", ylabel="error / spread of the state", title="simulation (dashed: nothing moves)")
        axes.legend()
        axes.grid(True, which="both", alpha=0.3)
        return figure


@one_thread()
def validate(f: Field, log: Log, steps: Sequence[int] = HORIZONS, every: int | None = None,
             substeps: int = 1) -> Validation:
    """Simulate f by RK4 from every `every`-th sample (default: about 2,000 of the log's), k steps on, k in `steps`.

    Horizons that are longer than every run are left out; ValueError where none is left.
    """
    longest = max(map(len, log)) - 1
    wanted = tuple(sorted({int(k) for k in steps if 1 <= k <= longest}))
    if not wanted:
        raise ValueError(f"steps is {tuple(steps)}; expected numbers of steps from 1 to {longest}, the longest run's")
    stride = max(len(log) // 2000, 1) if every is None else every
    starts = {"logged": [r.x for r in log], "smoothed": [r.smooth.x for r in log]}
    single = {name: _errors(f, log, x, (wanted[0],), stride, substeps) for name, x in starts.items()}
    chosen = min(single, key=lambda name: float(np.square(_rms(single[name].errors[0]) / _spread(log)).sum()))
    found = _errors(f, log, starts[chosen], wanted, stride, substeps)
    rms, still = (np.array([_rms(e) for e in parts]) for parts in (found.errors, found.moves))
    blown = np.array([int(np.isinf(e).any(axis=1).sum()) for e in found.errors])
    seconds = np.array([float(np.median(t)) for t in found.times])
    return Validation(log.states, wanted, seconds, rms, still, _spread(log), np.array(list(map(len, found.errors))),
                      blown, chosen)


def _spread(log: Log) -> Array:
    spread: Array = np.nanstd(np.concatenate([r.x for r in log]), axis=0)
    return np.where(spread > 0, spread, 1.0)


def _rms(errors: Array) -> Array:
    """Root mean square of what is there and finite [nx]; inf where nothing is."""
    good = np.isfinite(errors)
    total = np.where(good, errors, 0.0)
    n = good.sum(axis=0)
    return np.where(n > 0, np.sqrt(np.square(total).sum(axis=0) / np.maximum(n, 1)), np.inf)


@dataclass(frozen=True, eq=False)
class _Errors:
    """For each horizon, a row for each simulation."""

    errors: list[Array]  # [n, nx] simulated - logged: NaN where not logged, inf where it blew up
    moves: list[Array]  # [n, nx] logged - start
    times: list[Array]  # [n]


def _errors(f: Field, log: Log, starts: Sequence[Array], wanted: Sequence[int], stride: int, substeps: int) -> _Errors:
    parts = [_run_errors(f, run, x, wanted, stride, substeps) for run, x in zip(log, starts, strict=True)]
    return _Errors(*([np.concatenate([part[k][which] for part in parts if k in part]) for k in wanted]
                     for which in range(3)))


def _run_errors(f: Field, run: Recording, states: Array, wanted: Sequence[int], stride: int,
                substeps: int) -> dict[int, tuple[Array, Array, Array]]:
    """(errors, moves, times) of one run, by horizon; starts are the whole states among every stride-th."""
    found, h = {}, np.diff(run.t)
    now = np.arange(0, len(run) - 1, stride)
    now = now[np.isfinite(states[now]).all(axis=1)]
    first, x = states[now], torch.from_numpy(states[now])
    with torch.no_grad():
        for k in range(1, min(wanted[-1], len(run) - 1) + 1):
            inside = now + k < len(run)
            now, first, x = now[inside], first[inside], x[torch.from_numpy(inside)]
            at = now + k - 1
            x = rk4_interval(f, x, torch.from_numpy(run.u[at]), torch.from_numpy(h[at])[:, None], substeps)
            if k in wanted:
                there = np.isfinite(x.numpy()).all(axis=1, keepdims=True)
                error = np.where(there, x.numpy() - run.x[now + k], np.inf)
                found[k] = (error, run.x[now + k] - first, run.t[now + k] - run.t[now])
    return found
