"""Figures of a learned model."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from nocl.data import Dataset
from nocl.definition.system import System
from nocl.support.checks import Array

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Model = Callable[[Tensor, Tensor], Tensor]  # (x [B, nx], u [B, nu]) -> xdot [B, nx]
POINTS = 201
SAMPLES = 1000


def slices(s: System, model: Model) -> Figure:
    """Each derivative along each variable through the middle of the box: f_theta, and dashed the exact f.

    The last panel, where f is known: the share of samples of the box whose error is below a value.
    """
    from matplotlib.figure import Figure  # matplotlib is imported where pictures are drawn

    exact = s.xdot is not None
    panels = s.nx + exact
    columns = min(panels, 4)
    figure = Figure(figsize=(3.4 * columns, 2.6 * -(-panels // columns)), layout="constrained")
    axes = np.atleast_1d(figure.subplots(-(-panels // columns), columns, squeeze=False)).ravel()
    position = np.linspace(-1, 1, POINTS)
    for k, name in enumerate(s.names):
        z = _line(s, k, position)
        learned, true = _values(model, z, s.nx), s.f(z[:, : s.nx].T, z[:, s.nx:].T).full().T if exact else None
        for i in range(s.nx):
            line, = axes[i].plot(position, learned[:, i], label=name, lw=1.2)
            if true is not None:
                axes[i].plot(position, true[:, i], "--", color=line.get_color(), lw=2.4, alpha=0.4)
    for i, name in enumerate(s.state_names):
        axes[i].set_title(f"d {s.unit(name)}/dt", parse_math=False)
        axes[i].set_xlabel("place in the box")
    axes[0].legend(fontsize=7)
    if exact:
        _errors(s, model, axes[s.nx])
    for unused in axes[panels:]:
        unused.set_axis_off()
    return figure


def _line(s: System, k: int, position: Array) -> Array:
    """Rows z [n, nz]: the middle of the box, variable k from end to end."""
    lb, ub = np.r_[s.lbx, s.lbu], np.r_[s.ubx, s.ubu]
    z = np.repeat(((lb + ub) / 2)[None], len(position), axis=0)
    z[:, k] += position * (ub - lb)[k] / 2
    return z


def _values(model: Model, z: Array, nx: int) -> Array:
    with torch.no_grad():
        rows = torch.from_numpy(z)
        return model(rows[:, :nx], rows[:, nx:]).numpy()


def _errors(s: System, model: Model, axes: object) -> None:
    data = Dataset.sample(s, SAMPLES, 1_000_003)
    error = np.sort(np.linalg.norm(_values(model, np.hstack([data.x, data.u]), s.nx) - data.xdot, axis=1))
    axes.semilogx(np.maximum(error, 1e-17), np.linspace(0, 1, len(error)))  # type: ignore[attr-defined]
    axes.set(title="share of the box", xlabel="||f_theta - f|| below")  # type: ignore[attr-defined]
