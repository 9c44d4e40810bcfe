"""A moving picture of methods side by side from one initial state, as GIF: the system above, its controls below."""

from __future__ import annotations

import io
from collections.abc import Callable, Sequence
from typing import Any

import matplotlib
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from nocl.comparisons.report.drawings import Draw, drawing, is_spatial
from nocl.comparisons.report.explain import worst_states
from nocl.comparisons.report.results import REFERENCE, Results, number
from nocl.comparisons.report.style import COLOURS, STYLE, plain
from nocl.support.checks import Array

SIDE_BY_SIDE = 2  # methods, unless others are named
RATE = 15  # frames a second
LAST = 1000  # ms that the last frame stands
DPI = 90
PALETTE = 64  # colours


def animate(report: Results, state: int | None = None, methods: Sequence[str] | None = None, draw: Draw | None = None,
            seconds: float = 4.0) -> bytes:
    """The GIF's bytes.

    Parameters
    ----------
    state : which initial state; default: the one with the median gap
    methods : names; default: the first two that are no reference
    draw : (ax, ocp, visited [n, nx]) -> frame, frame(x so far [k, nx], u [nu], t) -> artists; default: the system's own
        (nocl.comparisons.report.drawings), a phase portrait for systems that do not come with nocl

    Raises ValueError for names or states that are not in the report, or where no run can be shown.
    """
    chosen = _chosen(report, methods)
    i = _state(report, state, chosen)
    with matplotlib.rc_context({**STYLE, "axes.grid": False}):
        figure, frame = _set_up(report, i, chosen, draw or drawing(report.ocp))
        images = _images(figure, frame, np.linspace(0.0, _until(report, i, chosen), max(2, round(seconds * RATE))))
    return _gif(images)


def can_animate(report: Results) -> bool:
    """Whether there is a state that the shown methods all ran from."""
    return any(_shown(report, _chosen(report, None)))


def _shown(report: Results, chosen: Sequence[int]) -> list[bool]:
    """[B], whether every chosen method has a run from a state."""
    runs = [np.isfinite(report.judged[m].simulation.x).all(axis=(1, 2)) for m in chosen]
    return np.all(runs, axis=0).tolist()


def _chosen(report: Results, methods: Sequence[str] | None) -> list[int]:
    names = [j.name for j in report.judged]
    if methods is None:
        own = [m for m, name in enumerate(names) if name != REFERENCE] or list(range(len(names)))
        return own[:SIDE_BY_SIDE]
    for name in methods:
        if name not in names:
            raise ValueError(f"there is no method {name!r} in the report; expected some of {', '.join(names)}")
    return [names.index(name) for name in methods]


def _state(report: Results, state: int | None, chosen: Sequence[int]) -> int:
    """The state that is shown."""
    B = len(report.x0)
    if state is not None and not 0 <= state < B:
        raise ValueError(f"state is {state!r}; expected one of the {B} initial states, 0 to {B - 1}")
    shown = _shown(report, chosen)
    if state is not None:
        if not shown[state]:
            raise ValueError(f"a method failed from state {state}; expected one that all of them ran from")
        return state
    able = [i for i in worst_states(report, chosen[0]) if shown[i]]
    if not able:
        raise ValueError("there is no initial state that all methods ran from: choose methods that did")
    return able[len(able) // 2]


def _set_up(report: Results, i: int, chosen: Sequence[int], draw: Draw) -> tuple[Figure, Callable[[float], list[Any]]]:
    ocp, n = report.at(i), len(chosen)
    figure = Figure(figsize=(4.1 * n, 4.6), dpi=DPI)
    FigureCanvasAgg(figure)
    grid = figure.add_gridspec(2, n, height_ratios=[3.2, 1], left=0.17 / n, right=1 - 0.06 / n, top=0.86, bottom=0.11,
                               hspace=0.28, wspace=0.22)
    visited = np.concatenate([report.judged[m].simulation.x[i] for m in chosen])
    limits = _limits(np.concatenate([report.judged[m].simulation.u[i] for m in chosen]))
    until = _until(report, i, chosen)
    clock = figure.text(0.5, 0.955, "", ha="center", fontsize=10)
    parts = []
    for column, m in enumerate(chosen):
        ax = figure.add_subplot(grid[0, column], projection="3d" if is_spatial(draw) else None)
        ax.set_title(plain(f"{report.judged[m].name}: cost {number(report.cost[m, i])}"), fontsize=9,
                     color=COLOURS[m % len(COLOURS)])
        parts.append((m, draw(ax, ocp, visited), _controls(figure.add_subplot(grid[1, column]), ocp, limits, until)))

    def frame(t: float) -> list[Any]:
        clock.set_text(plain(f"{ocp.system.name}, initial state {i}, t = {t:.2f}"))
        artists = [clock]
        for m, move, plot in parts:
            s, held = report.judged[m].simulation, report.judged[m].held
            x, u = so_far(s.times[i], s.x[i], t), so_far(s.times[i], s.u[i], t, held)
            artists += [*move(x, u[-1], min(t, s.times[i, -1])), *plot(s.times[i], u, t, held)]
        return artists

    return figure, frame


def _until(report: Results, i: int, chosen: Sequence[int]) -> float:
    """When the last of the runs from a state ends."""
    return max(float(report.judged[m].simulation.times[i, -1]) for m in chosen)


def so_far(t: Array, values: Array, now: float, held: bool = False) -> Array:
    """The rows of values [K, n] at the nodes before `now`, and the one then: between nodes linear, or held."""
    k = min(int(np.searchsorted(t, now * (1 + 1e-12), side="right")), len(t) - 1)
    share = 0.0 if held else min(1.0, (now - t[k - 1]) / (t[k] - t[k - 1]))
    return np.vstack([values[:k], values[k - 1] + share * (values[k] - values[k - 1])])


def _limits(u: Array) -> tuple[float, float]:
    low, high = float(u.min()), float(u.max())
    room = 0.08 * (high - low or 1.0)
    return low - room, high + room


def _controls(ax: Any, ocp: Any, limits: tuple[float, float],
              until: float) -> Callable[[Array, Array, float, bool], list[Any]]:
    """The controls against time, as far as they have come."""
    s = ocp.system
    ax.set(xlim=(0, until), ylim=limits)
    ax.set_xlabel("t", labelpad=1)
    ax.set_ylabel(plain(s.unit(s.control_names[0])) if s.nu == 1 else "u", labelpad=1)
    ax.tick_params(labelsize=7)
    lines = [ax.plot([], [], linewidth=1.2, color=("#24476b", "#d55e00", "#3a9a5b", "#8a6d00")[k % 4],
                     label=plain(name))[0] for k, name in enumerate(s.control_names)]
    if s.nu > 1:
        ax.legend(fontsize=6, loc="upper right", ncols=s.nu, borderpad=0.1, handlelength=1)

    def plot(t: Array, u: Array, now: float, held: bool) -> list[Any]:
        times = np.r_[t[: len(u) - 1], min(now, t[-1])]
        for k, line in enumerate(lines):
            line.set_drawstyle("steps-post" if held else "default")
            line.set_data(times, u[:, k])
        return lines

    return plot


def _images(figure: Figure, frame: Callable[[float], list[Any]], times: Array) -> list[Array]:
    """RGB frames; what does not move is drawn once."""
    canvas: Any = figure.canvas
    artists = frame(float(times[0]))
    for artist in artists:
        artist.set_animated(True)
    canvas.draw()
    still = canvas.copy_from_bbox(figure.bbox)
    images = []
    for t in times:
        canvas.restore_region(still)
        for artist in frame(float(t)):
            (figure if artist.axes is None else artist.axes).draw_artist(artist)
        images.append(np.asarray(canvas.buffer_rgba())[..., :3].copy())
    return images


def _gif(images: Sequence[Array]) -> bytes:
    from PIL import Image

    frames = [Image.fromarray(image) for image in images]
    some = np.concatenate([images[0], images[len(images) // 2], images[-1]])  # all that is drawn is in one of them
    palette = Image.fromarray(some).quantize(PALETTE, dither=Image.Dither.NONE)
    flat = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    file = io.BytesIO()
    flat[0].save(file, "GIF", save_all=True, append_images=flat[1:], loop=0, optimize=False,
                 duration=[1000 // RATE] * (len(flat) - 1) + [LAST])
    return file.getvalue()
