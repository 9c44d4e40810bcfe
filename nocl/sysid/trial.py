"""Whether labels that are given are affine in the controls, xdot = a(x) + B(x) u: scattered rows do not show it.

Where the labels are nocl's to choose, structure.find moves the controls alone. No two given rows share all else, so it
is tried on some of them: two fits, one with and one without, and the smaller error of Jacobians on rows kept apart,
each row of xdot in units of its own. All controls or none: one that is not affine keeps the others in.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from nocl.support.checks import Array
from nocl.sysid.affine import affine_in_controls
from nocl.sysid.labels import Source
from nocl.sysid.networks import LONGER, assemble, fit_groups
from nocl.sysid.progress import Checkpoint, Progress
from nocl.sysid.score import value_and_jacobian
from nocl.sysid.settings import Settings
from nocl.sysid.structure import Structure

ROWS, KEPT = 500, 0.2  # of the trial, at most; the share of them that is kept apart
LEAST = 20  # rows for a trial
WORSE = 1.5  # times the error of any one row of xdot, at most


def better_affine(source: Source, found: Structure, settings: Settings, seed: int, bar: Progress) -> Structure:
    """`found`, or the same with all its controls affine, whichever is nearer to rows that neither was fitted to."""
    candidate = affine_in_controls(found)
    z, value, gradient = source.data or (np.zeros((0, 0)), np.zeros((0, 0)), None)
    if candidate is None or gradient is None or len(z) < LEAST:
        return found
    order = np.random.default_rng((seed, 4)).permutation(len(z))[:ROWS]
    kept, rest = np.split(order, [round(KEPT * len(order))])
    part = replace(source, data=(z[rest], value[rest], gradient[rest]))
    short = replace(settings, polish=settings.budget(source.box.nz).polish // LONGER)
    rows = sorted({i for group in found.groups for i in found.rows(group)})
    unit, errors = _size(gradient, source.box.width), []
    for parts, title in ((found, "trial"), (candidate, "trial, affine in the controls")):
        weights = fit_groups(part, parts, short, seed, bar.trial(title), Checkpoint(None, {}))
        x, u = (torch.from_numpy(a) for a in np.split(z[kept], [source.box.nx], axis=1))
        slope = value_and_jacobian(assemble(parts, weights, settings.angles), x, u)[1]
        wrong = (slope - gradient[kept]) * source.box.width
        errors.append(np.square(wrong).mean(axis=(0, 2))[rows] / unit[rows])
    before, after = errors
    better = after.sum() < before.sum() and bool((after <= WORSE**2 * before).all())
    return candidate if better else found


def _size(gradient: Array, width: Array) -> Array:
    """Mean square of each row's derivatives about their means, each times the width of its variable. [nx]"""
    size: Array = np.square((gradient - gradient.mean(axis=0)) * width).mean(axis=(0, 2))
    return size
