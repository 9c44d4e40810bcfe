"""Drawings of systems that move: one function each, by the name of the system and of its states.

A drawing is `draw(ax, ocp, visited) -> frame`: it sets the axes up for the states `visited` [n, nx] and returns
`frame(x, u, t)`, which moves its artists to the last of the states so far x [k, nx] and returns them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from matplotlib.patches import Polygon, Rectangle

from nocl.definition.ocp import OCP
from nocl.support.checks import Array

Frame = Callable[[Array, Array, float], Sequence[Any]]
Draw = Callable[[Any, OCP, Array], Frame]
BODY, LIGHT, GOAL, TRAIL = "#24476b", "#9fb4c7", "#3a9a5b", "#d55e00"


def drawing(ocp: OCP) -> Draw:
    """The drawing of a system that comes with nocl, else its phase portrait."""
    known = {("cartpole", ("p", "v", "theta", "omega")): cartpole, ("acrobot", ("th1", "th2", "w1", "w2")): acrobot,
             ("pendulum", ("theta", "omega")): pendulum, ("dubins", ("px", "py", "psi")): dubins}
    s = ocp.system
    if s.name == "quadrotor" and s.state_names[:6] == ("px", "py", "pz", "psi", "theta", "phi"):
        return quadrotor
    return known.get((s.name, s.state_names), phase)


def is_spatial(draw: Draw) -> bool:
    """Whether it needs axes in three dimensions."""
    return bool(getattr(draw, "spatial", False))


def _scene(ax: Any, x: tuple[float, float], y: tuple[float, float]) -> None:
    ax.set(xlim=x, ylim=y, xticks=[], yticks=[])
    ax.set_aspect("equal")
    ax.grid(False)
    for spine in ax.spines.values():
        spine.set_visible(False)


def cartpole(ax: Any, ocp: OCP, visited: Array) -> Frame:
    """The cart on its track, the pole (2 m, 0 is upright, clockwise is positive), the force as a bar."""
    low, high = visited[:, 0].min() - 2.2, visited[:, 0].max() + 2.2
    _scene(ax, (low, high), (-2.3, 2.3))
    ax.axhline(-0.16, color=LIGHT, linewidth=1)
    ax.plot([ocp.x_goal[0]] * 2, [-0.3, 2.1], ":", color=GOAL, linewidth=1)
    cart = ax.add_patch(Rectangle((0, -0.16), 0.6, 0.32, color=BODY))
    (force,) = ax.plot([], [], color=TRAIL, linewidth=3)
    (pole,) = ax.plot([], [], color=BODY, linewidth=4, solid_capstyle="round")
    (trail,) = ax.plot([], [], color=TRAIL, linewidth=0.8, alpha=0.7)

    def frame(x: Array, u: Array, t: float) -> Sequence[Any]:
        p, theta = x[-1, 0], x[-1, 2]
        cart.set_x(p - 0.3)
        force.set_data([p, p + 0.5 * u[0]], [0, 0])
        pole.set_data([p, p + 2 * np.sin(theta)], [0, 2 * np.cos(theta)])
        trail.set_data(x[:, 0] + 2 * np.sin(x[:, 2]), 2 * np.cos(x[:, 2]))
        return trail, force, cart, pole

    return frame


def acrobot(ax: Any, ocp: OCP, visited: Array) -> Frame:
    """Two links of 1 m from a fixed joint; th1 = 0 hangs down, th2 is relative to the first."""
    _scene(ax, (-2.2, 2.2), (-2.2, 2.2))
    ax.plot(*_links(ocp.x_goal[None]), "o:", color=GOAL, linewidth=1.5, markersize=4)
    (links,) = ax.plot([], [], "o-", color=BODY, linewidth=4, markersize=7, solid_capstyle="round")
    (trail,) = ax.plot([], [], color=TRAIL, linewidth=0.8, alpha=0.7)

    def frame(x: Array, u: Array, t: float) -> Sequence[Any]:
        links.set_data(*_links(x[-1:]))
        tips = np.array([[c[-1] for c in _links(row[None])] for row in x])
        trail.set_data(tips[:, 0], tips[:, 1])
        return trail, links

    return frame


def _links(x: Array) -> tuple[Array, Array]:
    """Joint, elbow and tip."""
    angles = np.cumsum(x[0, :2])
    return np.r_[0, np.cumsum(np.sin(angles))], np.r_[0, -np.cumsum(np.cos(angles))]


def pendulum(ax: Any, ocp: OCP, visited: Array) -> Frame:
    """A rod with a point mass; theta = 0 is upright, clockwise is positive."""
    _scene(ax, (-1.3, 1.3), (-1.3, 1.3))
    ax.plot([0, np.sin(ocp.x_goal[0])], [0, np.cos(ocp.x_goal[0])], ":", color=GOAL, linewidth=1.5)
    (rod,) = ax.plot([], [], color=BODY, linewidth=4, solid_capstyle="round")
    (mass,) = ax.plot([], [], "o", color=BODY, markersize=14)
    (trail,) = ax.plot([], [], color=TRAIL, linewidth=0.8, alpha=0.7)

    def frame(x: Array, u: Array, t: float) -> Sequence[Any]:
        tip = [np.sin(x[-1, 0])], [np.cos(x[-1, 0])]
        rod.set_data([0, *tip[0]], [0, *tip[1]])
        mass.set_data(*tip)
        trail.set_data(np.sin(x[:, 0]), np.cos(x[:, 0]))
        return trail, rod, mass

    return frame


def dubins(ax: Any, ocp: OCP, visited: Array) -> Frame:
    """The car from above, its way, its obstacle and where it is to go."""
    low, high = visited[:, :2].min(axis=0) - 0.5, visited[:, :2].max(axis=0) + 0.5
    low, high = np.minimum(low, [-2.0, -1.0]), np.maximum(high, [0.5, 1.0])
    _scene(ax, (low[0], high[0]), (low[1], high[1]))
    _forbidden(ax, ocp, low, high)
    ax.add_patch(Polygon(_car(ocp.x_goal), fill=False, edgecolor=GOAL, linestyle=":", linewidth=1.5))
    car = ax.add_patch(Polygon(_car(visited[0]), color=BODY))
    (trail,) = ax.plot([], [], color=TRAIL, linewidth=1.2)

    def frame(x: Array, u: Array, t: float) -> Sequence[Any]:
        car.set_xy(_car(x[-1]))
        trail.set_data(x[:, 0], x[:, 1])
        return trail, car

    return frame


def _car(x: Array) -> Array:
    """Corners [5, 2] of the car at (px, py, psi), its nose in front."""
    outline = np.array([[-0.2, -0.12], [0.12, -0.12], [0.24, 0.0], [0.12, 0.12], [-0.2, 0.12]])
    c, s = np.cos(x[2]), np.sin(x[2])
    return np.asarray(x[:2] + outline @ np.array([[c, s], [-s, c]]))


def _forbidden(ax: Any, ocp: OCP, low: Array, high: Array) -> None:
    """Where a constraint on the first two coordinates is violated, the others at the goal."""
    if not ocp.h_titles:
        return
    a, b = (np.linspace(low[c], high[c], 160) for c in (0, 1))
    x = np.tile(ocp.x_goal, (a.size * b.size, 1))
    x[:, 0], x[:, 1] = (v.ravel() for v in np.meshgrid(a, b))
    given = ocp.functions.node.columns(x=x, t=np.zeros(len(x)))  # where the obstacles move, as they begin
    h = ocp.h(*given).full().min(axis=0).reshape(b.size, a.size)
    ax.contourf(a, b, h, levels=[-np.inf, 0.0], colors=[LIGHT])


def quadrotor(ax: Any, ocp: OCP, visited: Array) -> Frame:
    """Two arms and the thrust in space, its way and its shadow."""
    x = np.vstack([visited[:, :3], ocp.x_goal[None, :3]])
    middle, half = (x.max(axis=0) + x.min(axis=0)) / 2, max(1.0, float(np.ptp(x, axis=0).max()) / 2 + 0.4)
    for axis, m, name in zip("xyz", middle, ocp.system.state_names, strict=False):
        getattr(ax, f"set_{axis}lim")(m - half, m + half)
        getattr(ax, f"set_{axis}label")(name, fontsize=7, labelpad=-10)
        getattr(ax, f"set_{axis}ticklabels")([])
    ax.set_box_aspect(None, zoom=1.2)
    floor = middle[2] - half
    ax.plot(*ocp.x_goal[:3, None], "*", color=GOAL, markersize=12)
    (trail,) = ax.plot([], [], [], color=TRAIL, linewidth=1.2)
    (shadow,) = ax.plot([], [], [], color=LIGHT, linewidth=1.0)
    arms = [ax.plot([], [], [], "o-", color=BODY, linewidth=2.5, markersize=4)[0] for _ in range(2)]
    (thrust,) = ax.plot([], [], [], color=TRAIL, linewidth=2)
    size = 0.22 * half

    def frame(x: Array, u: Array, t: float) -> Sequence[Any]:
        at, R = x[-1, :3], _rotation(*x[-1, 3:6])
        for arm, axis in zip(arms, R.T[:2], strict=True):
            arm.set_data_3d(*np.array([at - size * axis, at + size * axis]).T)
        thrust.set_data_3d(*np.array([at, at + size * R[:, 2] * np.clip(u[0] / ocp.u_goal[0], -2, 2)]).T)
        trail.set_data_3d(*x[:, :3].T)
        shadow.set_data_3d(x[:, 0], x[:, 1], np.full(len(x), floor))
        return shadow, trail, thrust, *arms

    return frame


quadrotor.spatial = True  # type: ignore[attr-defined]


def _rotation(psi: float, theta: float, phi: float) -> Array:
    """Rz(psi) Ry(theta) Rx(phi): its last column is the thrust's direction in the quadrotor's equations."""
    (cz, sz), (cy, sy), (cx, sx) = ((np.cos(a), np.sin(a)) for a in (psi, theta, phi))
    z = np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]])
    y = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
    return np.asarray(z @ y @ np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]]))


def phase(ax: Any, ocp: OCP, visited: Array) -> Frame:
    """Any system: the phase portrait of the two coordinates that move most; one state alone against time."""
    s = ocp.system
    if s.nx == 1:
        return _against_time(ax, ocp, visited)
    span = np.ptp(visited, axis=0) / (s.ubx - s.lbx)
    i, k = sorted(np.argsort(-span, kind="stable")[:2])
    low, high = (edge(np.vstack([visited, ocp.x_goal[None]]), axis=0) for edge in (np.min, np.max))
    room = 0.08 * np.where(high > low, high - low, 1.0)
    ax.set(xlim=(low[i] - room[i], high[i] + room[i]), ylim=(low[k] - room[k], high[k] + room[k]))
    ax.set_xlabel(s.unit(s.state_names[i]).replace("$", r"\$"))
    ax.set_ylabel(s.unit(s.state_names[k]).replace("$", r"\$"))
    if ocp.has_goal:
        ax.plot(ocp.x_goal[i], ocp.x_goal[k], "*", color=GOAL, markersize=12)
    (trail,) = ax.plot([], [], color=TRAIL, linewidth=1.5)
    (now,) = ax.plot([], [], "o", color=BODY, markersize=8)

    def frame(x: Array, u: Array, t: float) -> Sequence[Any]:
        trail.set_data(x[:, i], x[:, k])
        now.set_data(x[-1:, i], x[-1:, k])
        return trail, now

    return frame


def _against_time(ax: Any, ocp: OCP, visited: Array) -> Frame:
    low, high = min(visited.min(), ocp.x_goal[0]), max(visited.max(), ocp.x_goal[0])
    room = 0.08 * (high - low or 1.0)
    ax.set(xlim=(0, ocp.longest), ylim=(low - room, high + room))
    ax.set_xlabel("t")
    ax.set_ylabel(ocp.system.unit(ocp.system.state_names[0]).replace("$", r"\$"))
    if ocp.has_goal:
        ax.axhline(ocp.x_goal[0], color=GOAL, linestyle=":")
    (trail,) = ax.plot([], [], color=TRAIL, linewidth=1.5)

    def frame(x: Array, u: Array, t: float) -> Sequence[Any]:
        trail.set_data(np.linspace(0, t, len(x)), x[:, 0])
        return (trail,)

    return frame
