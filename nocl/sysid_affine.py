"""Whether labels that are given are affine in the controls, xdot = a(x) + B(x) u: scattered rows do not show it.

Where the labels are nocl's to choose, structure.find moves the controls alone. No two given rows share all else, so it
is tried on some of them: two fits, one with and one without, and the smaller error of Jacobians
on rows kept apart: there are more numbers in them than in values.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from nocl.affine import affine_in_controls
from nocl.data import Dataset
from nocl.structure import Structure
from nocl.sysid_labels import Source
from nocl.sysid_networks import assemble, fit_groups
from nocl.sysid_progress import Checkpoint, Progress
from nocl.sysid_score import score_of
from nocl.sysid_settings import Settings

ROWS, KEPT = 500, 0.2  # of the trial, at most; the share of them that is kept apart
LEAST = 20  # rows for a trial


def better_affine(source: Source, found: Structure, settings: Settings, seed: int, bar: Progress) -> Structure:
    """`found`, or the same affine in the controls, whichever is nearer to rows that neither was fitted to."""
    candidate = affine_in_controls(found)
    z, value, gradient = source.data or (np.zeros((0, 0)), np.zeros((0, 0)), None)
    if candidate is None or gradient is None or len(z) < LEAST:
        return found
    order = np.random.default_rng((seed, 4)).permutation(len(z))[:ROWS]
    kept, rest = np.split(order, [round(KEPT * len(order))])
    part, nx = replace(source, data=(z[rest], value[rest], gradient[rest])), source.box.nx
    apart = Dataset(z[kept, :nx], z[kept, nx:], value[kept], gradient[kept][:, :, :nx], gradient[kept][:, :, nx:])
    errors = []
    for parts in (found, candidate):
        weights = fit_groups(part, parts, settings, seed, bar, Checkpoint(None, {}))
        errors.append(score_of(assemble(parts, weights, settings.angles), apart).jacobian)
    return candidate if errors[1] < errors[0] else found
