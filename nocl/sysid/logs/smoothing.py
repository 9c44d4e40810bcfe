"""Smoothed states and derivatives of logged runs: cubic smoothing splines, as smooth as the data themselves say.

scipy.interpolate.make_smoothing_spline (Wahba's penalised regression spline), its smoothing by generalised
cross-validation, one spline for each state of each run. Since a control jumps at each sample, the derivative is taken
in the middle between two samples, where it belongs to the one control held there.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import make_smoothing_spline

from nocl.support.checks import Array


@dataclass(frozen=True, eq=False)
class Smooth:
    """A run's smoothed states at the samples, and states and derivatives in the middle of its steps."""

    x: Array  # [K+1, nx]
    middle: Array  # [K, nx]
    xdot: Array  # [K, nx]
    residual: Array  # [K+1, nx], logged minus smoothed, NaN where a sample is missing


def smooth(t: Array, x: Array) -> Smooth:
    """State by state: t [K+1], x [K+1, nx], NaN where a sample is missing. `Recording.smooth` keeps the answer."""
    middle = (t[:-1] + t[1:]) / 2
    columns = [_spline(t, x[:, i], middle) for i in range(x.shape[1])]
    states, mid, xdot = (np.column_stack([c[k] for c in columns]) for k in range(3))
    return Smooth(states, mid, xdot, x - states)


def _spline(t: Array, x: Array, middle: Array) -> tuple[Array, Array, Array]:
    """(x at t, x and dx/dt at the middles). Time is in units of the usual step: scipy searches lambda on (0, n)."""
    there = np.isfinite(x)
    unit = float(np.median(np.diff(t)))
    scale = max(float(np.ptp(x[there])), np.finfo(np.float64).tiny)
    spline = make_smoothing_spline((t[there] - t[0]) / unit, (x[there] - x[there][0]) / scale)
    at, mid = (t - t[0]) / unit, (middle - t[0]) / unit
    offset = x[there][0]
    return offset + scale * spline(at), offset + scale * spline(mid), scale / unit * spline.derivative()(mid)
