"""A log as labels: its states, controls and derivatives, logged or smoothed."""

from __future__ import annotations

import numpy as np

from nocl.data import Dataset
from nocl.support.checks import Array
from nocl.sysid.logs.log import Log, Recording


def noise(log: Log) -> Array:
    """The root mean square of what smoothing took away, for each state [nx]."""
    return np.sqrt(np.nanmean(np.square(np.concatenate([r.smooth.residual for r in log])), axis=0))


def dataset(log: Log) -> Dataset:
    """The log as labels without Jacobians: logged derivatives where there are any, else smoothed ones."""
    x, u, xdot = zip(*map(labels, log), strict=True)
    return Dataset(np.concatenate(x), np.concatenate(u), np.concatenate(xdot))


def labels(run: Recording) -> tuple[Array, Array, Array]:
    """(x, u, xdot) of one run, a row for each label."""
    if run.xdot is None:
        return run.smooth.middle, run.u, run.smooth.xdot
    there = np.isfinite(run.xdot[:-1]).all(axis=1) & np.isfinite(run.x[:-1]).all(axis=1)
    return run.x[:-1][there], run.u[there], run.xdot[:-1][there]
