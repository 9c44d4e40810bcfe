"""Logged trajectories: what users have of a real plant. Samples (t, x, u), perhaps xdot, in one or more runs.

A control holds from its sample to the next one. A missing state (NaN, an empty cell) leaves a hole that the fit steps
over; a missing control, or a step in time longer than `max_gap` times the usual one, ends a piece and starts another.
Angles may be logged on a circle: they are unwrapped, so between two samples they must turn by less than pi.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from nocl.support.checks import Array
from nocl.sysid.logs.files import Table, read_table, write_table
from nocl.sysid.logs.smoothing import Smooth, smooth
from nocl.system import System, counted

TIME, RUN = "t", "run"
LEAST = 5  # samples of a piece: fewer have no smoothed derivative


@dataclass(frozen=True, eq=False)
class Recording:
    """A recording without gaps in time or control; `run` says which recording it is a piece of."""

    run: str
    t: Array  # [K+1], rising
    x: Array  # [K+1, nx], NaN where a sample is missing; angles unwrapped
    u: Array  # [K, nu], held over [t_k, t_{k+1})
    xdot: Array | None = None  # [K+1, nx], where it was logged

    def __len__(self) -> int:
        return len(self.t)

    @cached_property
    def smooth(self) -> Smooth:
        """Smoothed states and derivatives (nocl.sysid.logs.smoothing)."""
        return smooth(self.t, self.x)


@dataclass(frozen=True, eq=False, repr=False)
class Log:
    """Logged trajectories of a system's states and controls."""

    states: tuple[str, ...]
    controls: tuple[str, ...]
    runs: tuple[Recording, ...]
    left_out: int = 0  # samples in pieces too short to use

    @staticmethod
    def of(system: System, t: ArrayLike, x: ArrayLike, u: ArrayLike, *, xdot: ArrayLike | None = None,
           run: ArrayLike | None = None, max_gap: float = 1.5) -> Log:
        """The log of arrays t [N], x [N, nx], u [N, nu], xdot [N, nx]; `run` [N] tells recordings apart (default: one).

        Raises ValueError for wrong shapes, times that do not rise within a run, and logs without a usable piece.
        """
        if not isinstance(system, System):
            raise ValueError(f"Log: system is a {type(system).__name__}; expected a nocl.System")
        owner = f"log of {system.name!r}"
        times = _rows(t, None, "t", owner)
        n = len(times)
        arrays = {"x": _rows(x, (n, system.nx), "x", owner), "u": _rows(u, (n, system.nu), "u", owner)}
        if xdot is not None:
            arrays["xdot"] = _rows(xdot, (n, system.nx), "xdot", owner)
        labels = np.zeros(n, dtype=int) if run is None else np.asarray(run)
        if labels.shape != (n,):
            raise ValueError(f"{owner}: run has shape {labels.shape}; expected ({n},), a label for each sample")
        if not (np.isfinite(max_gap) and max_gap > 1):
            raise ValueError(f"{owner}: max_gap is {max_gap!r}; expected a number > 1, in usual steps of time")
        pieces, left_out = _pieces(system, times, arrays, labels, max_gap, owner)
        if not pieces:
            raise ValueError(f"{owner}: no piece of the {n} samples has {LEAST} in a row; expected longer runs: log "
                             "at regular times, or raise max_gap")
        return Log(system.state_names, system.control_names, tuple(pieces), left_out)

    @staticmethod
    def read(path: str | Path, system: System, *, max_gap: float = 1.5) -> Log:
        """A CSV or Parquet file with the columns `t`, the system's states and controls, and perhaps `run`, `dNAME/dt`.

        Other columns are left aside. Parquet takes pyarrow: pip install 'nocl[data]'. ValueError for what is missing.
        """
        table = read_table(Path(path))
        needed = [TIME, *system.names]
        missing = [name for name in needed if name not in table]
        if missing:
            raise ValueError(f"{path}: no column {', '.join(missing)} (there: {', '.join(table) or 'none'}); expected "
                             f"{', '.join(needed)}, and {RUN} where there are several runs: rename the columns")
        numbers = {name: _numbers(table[name], name, path) for name in needed}
        rates = [f"d{name}/dt" for name in system.state_names]
        there = [name for name in rates if name in table]
        if there and len(there) < len(rates):
            raise ValueError(f"{path}: has the derivative(s) {', '.join(there)} only; expected all of "
                             f"{', '.join(rates)}, or none: they are then found by smoothing")
        xdot = np.column_stack([_numbers(table[name], name, path) for name in rates]) if there else None
        x, u = (np.column_stack([numbers[name] for name in names])
                for names in (system.state_names, system.control_names))
        runs = [str(label) for label in table[RUN]] if RUN in table else None
        return Log.of(system, numbers[TIME], x, u, xdot=xdot, run=runs, max_gap=max_gap)

    def write(self, path: str | Path) -> Path:
        """Write a CSV or Parquet file that `read` reads; a run's last sample repeats its last control."""
        columns: Table = {RUN: np.concatenate([[f"{r.run}"] * len(r) for r in self.runs]),
                          TIME: np.concatenate([r.t for r in self.runs])}
        x = np.concatenate([r.x for r in self.runs])
        u = np.concatenate([np.vstack([r.u, r.u[-1:]]) for r in self.runs])
        columns |= {name: x[:, i] for i, name in enumerate(self.states)}
        columns |= {name: u[:, i] for i, name in enumerate(self.controls)}
        if all(r.xdot is not None for r in self.runs):
            xdot = np.concatenate([r.xdot for r in self.runs if r.xdot is not None])
            columns |= {f"d{name}/dt": xdot[:, i] for i, name in enumerate(self.states)}
        return write_table(Path(path), columns)

    def split(self, share: float = 0.2, seed: int = 0) -> tuple[Log, Log]:
        """(training, test): whole recordings, about `share` of them at random for the test, at least one in each."""
        names = sorted({r.run for r in self.runs})
        if len(names) < 2:
            raise ValueError(f"the log has {counted(len(names), 'recording')}; expected 2 or more to split by "
                             "recording: name them by `run`")
        if not 0 < share < 1:
            raise ValueError(f"share is {share!r}; expected a number between 0 and 1")
        n = min(max(round(share * len(names)), 1), len(names) - 1)
        test = {names[i] for i in np.random.default_rng(seed).permutation(len(names))[:n]}
        train, held = [r for r in self.runs if r.run not in test], [r for r in self.runs if r.run in test]
        return replace(self, runs=tuple(train), left_out=0), replace(self, runs=tuple(held), left_out=0)

    def check(self, system: System) -> None:
        """ValueError where the log is of other states and controls than the system's."""
        if (self.states, self.controls) != (system.state_names, system.control_names):
            raise ValueError(f"the log has {', '.join(self.states + self.controls)}; {system.name!r} has "
                             f"{', '.join(system.names)}: read the log for this system")

    def __len__(self) -> int:
        return sum(map(len, self.runs))

    def __iter__(self) -> Iterator[Recording]:
        return iter(self.runs)

    def __repr__(self) -> str:
        missing = sum(int(np.isnan(r.x).any(axis=1).sum()) for r in self.runs)
        step = np.median(np.concatenate([np.diff(r.t) for r in self.runs]))
        return (f"Log of {', '.join(self.states)}; {', '.join(self.controls)}: {len(self)} samples in "
                f"{counted(len(self.runs), 'piece')} of {counted(len({r.run for r in self.runs}), 'recording')}, every "
                f"{step:.4g}, {missing} with a state missing, {self.left_out} left out")


def _rows(value: ArrayLike, shape: tuple[int, int] | None, name: str, owner: str) -> Array:
    try:
        array = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        raise ValueError(f"{owner}: {name} is a {type(value).__name__} that is no array of numbers; expected one row "
                         "for each sample: join several runs and tell them apart by `run`") from None
    if shape is not None and array.ndim == 1 and shape[1] == 1:
        array = array[:, None]
    if (shape is None and array.ndim != 1) or (shape is not None and array.shape != shape):
        expected = "one time for each sample, [N]" if shape is None else f"{shape}, a row for each time"
        raise ValueError(f"{owner}: {name} has shape {array.shape}; expected {expected}")
    return array


def _numbers(column: Any, name: str, path: str | Path) -> Array:
    try:
        return np.array([np.nan if v is None or v == "" else float(v) for v in column])
    except (TypeError, ValueError) as error:
        raise ValueError(f"{path}: column {name!r} holds what is no number ({error}); expected numbers, and empty "
                         "cells where a sample is missing") from None


def _pieces(system: System, t: Array, arrays: dict[str, Array], labels: Any, max_gap: float,
            owner: str) -> tuple[list[Recording], int]:
    """(the pieces without gaps, the number of samples left out)."""
    pieces, left_out = [], 0
    _, first = np.unique(labels, return_index=True)
    for label in labels[np.sort(first)]:
        rows = np.flatnonzero(labels == label)
        _check_times(t[rows], rows, f"{owner}, run {label}")
        steps = np.diff(t[rows])
        usual = float(np.median(steps)) if len(steps) else 0.0
        known: Any = np.isfinite(arrays["u"][rows]).all(axis=1)  # the control of the last sample of a piece is not used
        end = np.r_[~known[:-1] | (steps > max_gap * usual), True]
        for part in np.split(rows, np.flatnonzero(end[:-1]) + 1):
            piece = _piece(system, str(label), t, arrays, part)
            if piece is None:
                left_out += len(part)
            else:
                pieces.append(piece)
    return pieces, left_out


def _check_times(t: Array, rows: Any, owner: str) -> None:
    bad = np.flatnonzero(~np.isfinite(t))
    if bad.size:
        raise ValueError(f"{owner}: the time of sample {rows[bad[0]]} is {t[bad[0]]}; expected a number: drop that "
                         "sample")
    back = np.flatnonzero(np.diff(t) <= 0)
    if back.size:
        raise ValueError(f"{owner}: time goes from {t[back[0]]:g} to {t[back[0] + 1]:g} at sample {rows[back[0] + 1]}; "
                         "expected rising times: sort the samples, or name several recordings by `run`")


def _piece(system: System, run: str, t: Array, arrays: dict[str, Array], rows: Any) -> Recording | None:
    """A piece, from its first to its last sample with a whole state; None where too little is left."""
    whole = np.flatnonzero(np.isfinite(arrays["x"][rows]).all(axis=1))
    if not len(whole):
        return None
    rows = rows[whole[0]: whole[-1] + 1]
    x, u = arrays["x"][rows].copy(), arrays["u"][rows[:-1]]
    if np.isfinite(x).sum(axis=0).min() < LEAST:
        return None
    x[~np.isfinite(x)] = np.nan
    for i in system.angle_indices:
        there = np.isfinite(x[:, i])
        x[there, i] = np.unwrap(x[there, i])
    xdot = arrays["xdot"][rows] if "xdot" in arrays else None
    return Recording(run, t[rows], x, u, xdot)
