"""Logged trajectories: what users have of a real plant. Samples (t, x, u), perhaps xdot, in one or more runs.

A control holds from its sample to the next one. A missing state (NaN, an empty cell) leaves a hole that the fit steps
over; a missing control, or a step in time longer than `max_gap` times the usual one, ends a piece and starts another.
Angles may be logged on a circle: they are unwrapped, so between two samples they must turn by less than pi.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from nocl.definition import parameters
from nocl.definition.system import System, counted
from nocl.support import checks
from nocl.support.checks import Array
from nocl.sysid.logs.columns import labels_of, numbers, rows_of, seconds
from nocl.sysid.logs.files import Columns, read_table, write_table
from nocl.sysid.logs.plausible import check_rate, check_rates, check_times, check_values, unwrapped
from nocl.sysid.logs.smoothing import Smooth, smooth

TIME, RUN, PIECE = "t", "run", "run piece"  # columns of a file; the last is written, so that pieces stay apart
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
    controls: tuple[str, ...]  # after them parameters, where the system has some
    runs: tuple[Recording, ...]
    left_out: int = 0  # samples in pieces too short to use

    @staticmethod
    def of(system: System, t: ArrayLike, x: ArrayLike, u: ArrayLike, *, xdot: ArrayLike | None = None, p: Any = None,
           run: ArrayLike | None = None, max_gap: float = 1.5, hold_controls: bool = False) -> Log:
        """The log of arrays t [N], x [N, nx], u [N, nu], xdot [N, nx]; `run` [N] tells recordings apart (default: one).

        p: the parameters, where the system has some: [np] for all samples, [N, np], or by name. t is in seconds, or
        timestamps. `hold_controls`: a missing control is its run's last one, as in logs that have it only when it
        changes.

        Raises ValueError for wrong shapes, times that do not rise within a run, values that cannot be (far outside the
        system's box, angles in degrees, times in another unit than derivatives), and logs without a usable piece.
        """
        checks.instance(System, system, "system", "Log", "of an OCP, pass ocp.system")
        owner = f"log of {system.name!r}"
        times = seconds(t, owner)
        n = len(times)
        inputs = rows_of(u, n, system.control_names, "u", owner)
        inputs = np.hstack([inputs, parameters.rows(p, system.parameter_names, n, owner)])
        samples = _Samples(times, rows_of(x, n, system.state_names, "x", owner),
                           inputs,
                           None if xdot is None else rows_of(xdot, n, system.state_names, "xdot", owner),
                           labels_of(run, n, owner))
        return _log(system, samples, max_gap, hold_controls, owner)

    @staticmethod
    def read(path: str | Path, system: System, *, max_gap: float = 1.5, hold_controls: bool = False) -> Log:
        """A CSV or Parquet file with the columns `t`, the system's states, controls and parameters.

        There may be columns `run` and `dNAME/dt`; others are left aside. t is in seconds, or timestamps (ISO 8601 in
        CSV). Parquet takes pyarrow: pip install 'nocl[data]'. ValueError for what is missing, and as in `of`.
        """
        checks.instance(System, system, "system", "Log", "of an OCP, pass ocp.system")
        _check_names(system.state_names, system.input_names)
        table = read_table(checks.folder(path, "path", "Log.read"))
        needed = [TIME, *system.state_names, *system.input_names]
        missing = [name for name in needed if name not in table]
        if missing:
            raise ValueError(f"{path}: no column {', '.join(missing)} (there: {', '.join(table) or 'none'}); expected "
                             f"{', '.join(needed)}, and {RUN} where there are several runs: rename the columns, and "
                             "remove lines above them")
        rates = [f"d{name}/dt" for name in system.state_names]
        there = [name for name in rates if name in table]
        if there and len(there) < len(rates):
            raise ValueError(f"{path}: has the derivative(s) {', '.join(there)} only; expected all of "
                             f"{', '.join(rates)}, or none: they are then found by smoothing")
        x, u, xdot = (np.column_stack([numbers(table[name], name, path) for name in names]) if names else None
                      for names in (system.state_names, system.input_names, there))
        assert x is not None
        assert u is not None
        times = seconds(table[TIME], str(path))
        samples = _Samples(times, x, u, xdot, labels_of(table.get(RUN), len(times), str(path)), table.get(PIECE))
        return _log(system, samples, max_gap, hold_controls, str(path))

    def write(self, path: str | Path) -> Path:
        """Write a CSV or Parquet file that `read` reads as the same log; a piece's last sample has no control."""
        _check_names(self.states, self.controls)
        number = [sum(other.run == r.run for other in self.runs[:i]) for i, r in enumerate(self.runs)]
        columns: Columns = {RUN: np.concatenate([[r.run] * len(r) for r in self.runs]),
                          PIECE: np.concatenate([[k] * len(r) for k, r in zip(number, self.runs, strict=True)]),
                          TIME: np.concatenate([r.t for r in self.runs])}
        x = np.concatenate([r.x for r in self.runs])
        u = np.concatenate([np.vstack([r.u, np.full((1, len(self.controls)), np.nan)]) for r in self.runs])
        columns |= {name: x[:, i] for i, name in enumerate(self.states)}
        columns |= {name: u[:, i] for i, name in enumerate(self.controls)}
        if all(r.xdot is not None for r in self.runs):
            xdot = np.concatenate([r.xdot for r in self.runs if r.xdot is not None])
            columns |= {f"d{name}/dt": xdot[:, i] for i, name in enumerate(self.states)}
        return write_table(checks.folder(path, "path", "Log.write"), columns)

    def split(self, share: float = 0.2, seed: int = 0) -> tuple[Log, Log]:
        """(training, test): whole recordings, about `share` of them at random for the test, at least one in each."""
        rng = checks.generator(seed, "Log.split")
        share = checks.between(share, 0.0, 1.0, "share", "Log.split")
        names = sorted({r.run for r in self.runs})
        if len(names) < 2:
            raise ValueError(f"the log has {counted(len(names), 'recording')}; expected 2 or more to split by "
                             "recording: name them by `run`")
        if not 0 < share < 1:
            raise ValueError(f"share is {share!r}; expected a number between 0 and 1")
        n = min(max(round(share * len(names)), 1), len(names) - 1)
        test = {names[i] for i in rng.permutation(len(names))[:n]}
        train, held = [r for r in self.runs if r.run not in test], [r for r in self.runs if r.run in test]
        return replace(self, runs=tuple(train), left_out=0), replace(self, runs=tuple(held), left_out=0)

    def check(self, system: System) -> None:
        """ValueError where the log is of other states and controls than the system's."""
        checks.instance(System, system, "system", "Log.check", "of an OCP, pass ocp.system")
        if (self.states, self.controls) != (system.state_names, system.input_names):
            raise ValueError(f"the log has {', '.join(self.states + self.controls)}; {system.name!r} has "
                             f"{', '.join(system.state_names + system.input_names)}: read the log for this system")

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


@dataclass(frozen=True, eq=False)
class _Samples:
    """All samples of a log, in their order."""

    t: Array  # [N]
    x: Array  # [N, nx], NaN where missing
    u: Array  # [N, nu]
    xdot: Array | None  # [N, nx]
    run: list[str]  # [N]
    piece: Any = None  # [N], where a file says to which piece of its run a sample belongs


def _check_names(states: tuple[str, ...], controls: tuple[str, ...]) -> None:
    """ValueError for names that a file's other columns have."""
    own = {TIME, RUN, PIECE, *(f"d{name}/dt" for name in states)}
    taken = [name for name in states + controls if name in own or name != name.strip()]
    if taken:
        raise ValueError(f"a file of logs has columns of its own by the name(s) {', '.join(sorted(own))}, or a system "
                         f"has blanks around a name; got a state or control {taken[0]!r}: name its symbol differently")


def _log(system: System, samples: _Samples, max_gap: float, hold_controls: bool, owner: str) -> Log:
    """The log of samples, after what can be checked of them as they are."""
    if not isinstance(hold_controls, bool):
        raise ValueError(f"{owner}: hold_controls is {hold_controls!r}; expected True or False")
    if not checks.number(max_gap, "max_gap", owner) > 1:
        raise ValueError(f"{owner}: max_gap is {max_gap!r}; expected a number > 1, in usual steps of time")
    for i, name in enumerate(system.state_names):
        check_values(samples.x[:, i], system.lbx[i], system.ubx[i], name, owner)
    for i, name in enumerate(system.control_names):
        check_values(samples.u[:, i], system.lbu[i], system.ubu[i], name, owner)
    n = len(samples.t)
    unknown = int((~np.isfinite(samples.u)).any(axis=1).sum())
    if hold_controls:
        samples = replace(samples, u=_held(samples.u, samples.run))
    pieces, left_out = _pieces(system, samples, max_gap, owner)
    remedy = _remedy(samples, unknown, hold_controls)
    if not pieces:
        raise ValueError(f"{owner}: no piece of the {n} samples has {LEAST} in a row; expected longer runs: {remedy}")
    if left_out > n / 2:
        warnings.warn(f"{owner}: {left_out} of {n} samples are left out, in pieces of fewer than {LEAST}: {remedy}",
                      UserWarning, stacklevel=3)
    log = Log(system.state_names, system.input_names, tuple(pieces), left_out)
    if samples.xdot is not None:
        _check_logged_rates(log, system, owner)
    return log


def _remedy(samples: _Samples, unknown: int, held: bool) -> str:
    """What makes pieces longer; `unknown` samples came without a control."""
    n, holes = len(samples.t), int(np.isnan(samples.x).any(axis=1).sum())
    if unknown > n / 4 and not held:
        return (f"a control is missing in {unknown} of them: where it is logged only when it changes, pass "
                "hold_controls=True (--hold-controls), else log it at every sample")
    if np.isnan(samples.u).all():
        return "no control is known: log it where it changes, and at the start"
    if holes > n / 4:
        return f"a state is missing in {holes} of them: log all states, or find the others by an observer first"
    return "log at regular times, or raise max_gap"


def _held(u: Array, run: list[str]) -> Array:
    """Controls [N, nu] with each run's last known one in place of missing ones; missing before the first."""
    found, last, before = u.copy(), np.full(u.shape[1], np.nan), ""
    for k, label in enumerate(run):
        last = np.where(np.isfinite(u[k]) | (label != before), u[k], last)
        found[k], before = last, label
    return found


def _pieces(system: System, samples: _Samples, max_gap: float, owner: str) -> tuple[list[Recording], int]:
    """(the pieces without gaps, the number of samples left out)."""
    pieces, left_out = [], 0
    labels = np.array(samples.run)
    for label in dict.fromkeys(samples.run):
        rows = np.flatnonzero(labels == label)
        _check_rising(samples.t[rows], rows, f"{owner}, run {label}")
        for part in np.split(rows, _ends(samples, rows, max_gap, f"{owner}, run {label}")):
            piece = _piece(system, label, samples, part, owner)
            if piece is None:
                left_out += len(part)
            else:
                pieces.append(piece)
    return pieces, left_out


def _ends(samples: _Samples, rows: Any, max_gap: float, owner: str) -> Any:
    """Where a run's next piece begins: after a missing control (the last one of a piece is not used) or a gap."""
    steps = np.diff(samples.t[rows])
    if not len(steps):
        return []
    usual = float(np.median(steps))
    check_times(samples.t[rows], usual, owner)
    apart = steps > max_gap * usual
    if samples.piece is not None:  # written by nocl: gaps are known
        piece = [samples.piece[k] for k in rows]
        apart = np.array([a != b for a, b in pairwise(piece)])
    known = np.isfinite(samples.u[rows[:-1]]).all(axis=1)
    return np.flatnonzero(apart | ~known) + 1


def _check_rising(t: Array, rows: Any, owner: str) -> None:
    bad = np.flatnonzero(~np.isfinite(t))
    if bad.size:
        raise ValueError(f"{owner}: the time of sample {rows[bad[0]]} is {t[bad[0]]}; expected a number: drop that "
                         "sample")
    back = np.flatnonzero(np.diff(t) <= 0)
    if back.size:
        raise ValueError(f"{owner}: time goes from {t[back[0]]:g} to {t[back[0] + 1]:g} at sample {rows[back[0] + 1]}; "
                         "expected rising times: sort the samples, or name several recordings by `run`")


def _piece(system: System, run: str, samples: _Samples, rows: Any, owner: str) -> Recording | None:
    """A piece, from its first to its last sample with a whole state; None where too little is left."""
    whole = np.flatnonzero(np.isfinite(samples.x[rows]).all(axis=1))
    if not len(whole):
        return None
    rows = rows[whole[0]: whole[-1] + 1]
    x = samples.x[rows].copy()
    if np.isfinite(x).sum(axis=0).min() < LEAST:
        return None
    for i in system.angle_indices:
        x[:, i] = unwrapped(x[:, i], rows, system.state_names[i], f"{owner}, run {run}")
    xdot = None if samples.xdot is None else samples.xdot[rows]
    return Recording(run, samples.t[rows], x, samples.u[rows[:-1]], xdot)


def _check_logged_rates(log: Log, system: System, owner: str) -> None:
    """ValueError where logged derivatives are in other units than the states, or than time."""
    for i, name in enumerate(log.states):
        rates = [r.xdot[:, i] for r in log if r.xdot is not None]
        for r, rate in zip(log, rates, strict=True):
            check_rates(rate, r.t, system.lbx[i], system.ubx[i], name, owner)
        check_rate([r.x[:, i] for r in log], rates, [r.t for r in log], name, f"its column d{name}/dt", owner)
