"""What the networks of a controller and a value see and say, as SX maps in physical units, scaled by the labels.

Features of (x, t): the state in units of its spread at that time about its mean at that time (both polynomials in t),
sine and cosine of angles, time, the logarithm of the time to go, and the distance to the goal over the time to go: the
optimal gain grows like 1 / (T - t). Of an angle that the problem is periodic in nothing but sines and cosines is seen,
so that all images of a state have one answer. With parameters, (x, t, p): p itself, the distance to the goal that
depends on p in the same units as the state, and the path constraints, which tell where obstacles are.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Protocol, cast

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from nocl.definition.ocp import OCP
from nocl.definition.scales import usual_sizes
from nocl.nets import MLP, FeatureNet
from nocl.solvers.cnd.regression.barrier import braked
from nocl.solvers.cnd.regression.projection import retracted
from nocl.support import checks
from nocl.support.checks import Array
from nocl.translate.arguments import Arguments

if TYPE_CHECKING:
    from nocl.solvers.cnd.regression.labels import Labels

DEGREE = 6  # of the polynomials in time
CONSTANT = 1e-6  # of its usual size: what varies less is as good as constant
NEAR = 0.01  # of a usual size: distances that small are told apart
SHARP = 0.1  # of the numbers of branches: differences within which they share
BEGINS, BESIDE = 64, 0.2  # where a turn of a direction may begin; rad, the width of what counts as there
LEAST_TIME = 0.025  # of the horizon: time to go is never counted as less
Part = tuple[ca.SX, Array | float]  # features [k], and the usual size of each


class Places(Protocol):
    """Where labels are: x [n, nx], t [n], p [n, np]."""

    @property
    def x(self) -> Array: ...
    @property
    def t(self) -> Array: ...
    @property
    def p(self) -> Array: ...


def own_features(ocp: OCP, given: Any) -> ca.Function | None:
    """A user's features, SX expressions in states, parameters and time, as a function of (x, t[, p]); None for none.

    Raises ValueError for anything else.
    """
    if given is None:
        return None
    owner = f"train({ocp.system.name}): features"
    column = checks.column(given)
    if not isinstance(column, ca.SX) or not column.numel():
        raise ValueError(f"{owner} is {checks.shown(given)}; expected SX expressions in the states, parameters and "
                         "nocl.time(), like [ca.sin(x[0] - goal)]")
    own = ocp.functions.of_feedback("features", column)
    _check_images(ocp, own, owner)
    return own


def _check_images(ocp: OCP, own: ca.Function, owner: str) -> None:
    """ValueError where features tell images of a state apart that the problem does not."""
    n, s = 32, ocp.system
    x = np.random.default_rng(0).uniform(s.lbx, s.ubx, (n, s.nx))
    turned = x + 2 * np.pi * np.isin(np.arange(s.nx), list(ocp.periodic))
    a, b = (own(*ocp.functions.feedback().columns(x=rows, **ocp.moments(n))).full() for rows in (x, turned))
    bad = np.flatnonzero(~np.isclose(a, b, rtol=1e-6, atol=1e-9, equal_nan=True).all(axis=1))
    if bad.size:
        names = ", ".join(s.state_names[i] for i in ocp.periodic)
        raise ValueError(f"{owner}: number {bad[0]} changes with a whole turn of {names}, and the problem does not; "
                         "expected sines and cosines of such angles")


def features(ocp: OCP, labels: Places, dt: Array | None = None, *, plain: bool = False,
             own: ca.Function | None = None) -> ca.Function:
    """(x, t[, p]) -> phi, each feature with mean 0 and standard deviation 1 over the labels' x, t, p.

    With dt [n] it is (x, t[, p], dt) -> phi: the clock then stands at the middle of the time that a control is held
    for. `plain` adds the state in units that do not change with time; `own` are a user's, of (x, t[, p]).
    """
    s, at, (x, t) = ocp.system, ocp.functions.feedback(), (labels.x, labels.t)
    if dt is not None:
        at = at.given(dt=ca.SX.sym("dt"))
    state, time = at["x"], at["t"] if dt is None else at["t"] + at["dt"] / 2
    tau, moment = 2 * time / ocp.horizon - 1, 2 * (t if dt is None else t + dt / 2) / ocp.horizon - 1
    to_go = ca.fmax(ocp.horizon - time, 0)
    half = usual_sizes(ocp).x
    once = [i for i in range(s.nx) if i not in ocp.periodic]  # the others have many images: sines and cosines only
    angles = [g(state[i]) for i in s.angle_indices for g in (ca.sin, ca.cos)]
    off = state - (ocp.goal(at["p"])[0] if ocp.goal_varies else ca.DM(ocp.x_goal))
    left = ca.vertcat(*(ca.sin(off[i]) if i in ocp.periodic else off[i] for i in range(s.nx)))
    rush = left / (to_go + LEAST_TIME * ocp.horizon)
    clock = ca.vertcat(tau, ca.log(to_go / ocp.horizon + LEAST_TIME) / 2)
    parts: list[Part] = [(_standard(state, x, tau, moment, half)[once, :], 1.0), (ca.vertcat(*angles, clock), 1.0),
                         *([(rush, np.array([1.0 if i in ocp.periodic else half[i] for i in range(s.nx)]))]
                           if ocp.has_goal else []),
                         *([(state[once, :], half[once])] if plain else []),
                         *_of_parameters(ocp, at, off, labels, tau, moment),
                         *([] if own is None else [(at.but("dt").call(own), 0.0)]),
                         *([] if dt is None else [(at["dt"], ocp.horizon)])]
    return _scaled(ocp, at, parts, at.columns(x=x, t=t, p=labels.p, dt=dt))


def _scaled(ocp: OCP, at: Arguments, parts: list[Part], given: list[Array]) -> ca.Function:
    """The features with mean 0 and standard deviation 1 over labels `given`, a column each."""
    raw = ca.vertcat(*(e for e, _ in parts))
    usual = np.concatenate([np.broadcast_to(size, e.numel()) for e, size in parts])
    some = slice(None, None, -(-given[0].shape[1] // 20_000))  # of every kind of label
    values = at.function("raw", {"raw": raw})(*(a[:, some] for a in given)).full()
    if not np.isfinite(values).all():
        raise ValueError(f"features of {ocp.system.name!r} are NaN or inf at some labels; expected expressions "
                         "that are finite all over X")
    usual = np.where(usual > 0, usual, np.abs(values).max(axis=1, initial=1e-300))
    centre, width = values.mean(axis=1), values.std(axis=1) + CONSTANT * usual
    return at.function("features", {"phi": (raw - ca.DM(centre)) / ca.DM(width)})


def without_clock(ocp: OCP, labels: Places, own: ca.Function | None = None) -> ca.Function:
    """(x, t[, p]) -> phi of a law that knows no time: the state, and its distance from the goal on a scale that tells
    small ones apart too, asinh of it in units of NEAR of a usual size."""
    s, at = ocp.system, ocp.functions.feedback()
    state, half = at["x"], usual_sizes(ocp).x
    once = [i for i in range(s.nx) if i not in ocp.periodic]
    off = state - (ocp.goal(at["p"])[0] if ocp.goal_varies else ca.DM(ocp.x_goal))
    left = ca.vertcat(*(ca.sin(off[i]) if i in ocp.periodic else off[i] for i in range(s.nx)))
    angles = [g(state[i]) for i in s.angle_indices for g in (ca.sin, ca.cos)]
    parts: list[Part] = [(state[once, :], half[once]), (ca.vertcat(*angles), 1.0),
                         (ca.asinh(left / (NEAR * half)), 1.0), *([] if own is None else [(at.call(own), 0.0)])]
    if ocp.np:
        low, high = ocp.parameter_box
        parts.append((at["p"], np.where(high > low, (high - low) / 2, 1.0)))
    return _scaled(ocp, at, parts, at.columns(x=labels.x, t=labels.t, p=labels.p))


def _standard(e: ca.SX, values: Array, tau: ca.SX, moment: Array, half: Array) -> ca.SX:
    """e [k] about its mean at the time, in units of its spread then, over values [n, k] at times tau = moment [n].

    half : usual sizes of e [k]
    """
    mean, spread = _moments_in_time(values, moment, half)
    return (e - _polynomial(mean, tau)) / ca.exp(_polynomial(spread, tau))


def _of_parameters(ocp: OCP, at: Arguments, off: ca.SX, labels: Places, tau: ca.SX,
                   moment: Array) -> list[Part]:
    """The features that a problem with parameters has beside those of its state."""
    if not ocp.np:
        return []
    low, high = ocp.parameter_box
    moves = [i for i in range(ocp.system.nx) if ocp.goal_varies and ca.depends_on(off[i], at["p"])]
    turning, plain = ([i for i in moves if (i in ocp.periodic) == periodic] for periodic in (True, False))
    parts: list[Part] = [(at["p"], np.where(high > low, (high - low) / 2, 1.0)),
                         *((g(off[i]), 1.0) for i in turning for g in (ca.sin, ca.cos))]
    if plain:
        away, half = ocp.from_goal(labels.x, labels.p)[:, plain], usual_sizes(ocp).x[plain]
        parts.append((_standard(off[plain], away, tau, moment, half), 1.0))
    if ocp.h_titles:
        parts.append((at.but("dt").call(ocp.functions.h), ocp.constraint_scales))
    return parts


def _moments_in_time(x: Array, tau: Array, half: Array) -> tuple[Array, Array]:
    """Chebyshev coefficients [nx, DEGREE+1] of the mean and of the log standard deviation of x at tau in [-1, 1].

    half : usual sizes of x [nx]
    """
    bins = np.clip(((tau + 1) * 10).astype(int), 0, 19)
    filled = [bins == b for b in range(20) if (bins == b).sum() > 8] or [bins >= 0]
    centres, groups = [tau[b].mean() for b in filled], [x[b] for b in filled]
    floor = 0.05 * x.std(axis=0) + CONSTANT * half
    degree = min(DEGREE, max(len(centres) - 1, 0))
    mean = np.polynomial.chebyshev.chebfit(centres, [g.mean(axis=0) for g in groups], degree)
    spread = np.polynomial.chebyshev.chebfit(centres, [np.log(g.std(axis=0) + floor) for g in groups], degree)
    return mean.T, spread.T


def _polynomial(coefficients: Array, tau: ca.SX) -> ca.SX:
    basis = [ca.SX(1), tau]
    while len(basis) < coefficients.shape[1]:
        basis.append(2 * tau * basis[-1] - basis[-2])
    return ca.DM(coefficients) @ ca.vertcat(*basis[: coefficients.shape[1]])


def policy_net(ocp: OCP, labels: Labels, sizes: tuple[int, ...], control_dt: bool = False,
               own: ca.Function | None = None, branches: int = 1,
               held: NDArray[np.bool_] | None = None) -> tuple[FeatureNet, ca.Function]:
    """(u = clip(mean + spread * y, U), y a tanh network of the features; and its inverse inside U, u -> y and the y of
    its image that labels have, see _image). Constraints of u are held on top (projection.py), and those rows of states
    that are `held` (barrier.py).

    control_dt: (x, t[, p], dt) -> u in place of (x, t[, p]) -> u. own: further features. With `branches` > 1 the
    network says as many y, and a number for each: that with the largest number is taken.
    """
    return net_on(ocp, features(ocp, labels, labels.dt if control_dt else None, own=own), labels, sizes, branches,
                  held)


def net_on(ocp: OCP, phi: ca.Function, labels: Labels, sizes: tuple[int, ...], branches: int = 1,
           held: NDArray[np.bool_] | None = None, lasting: float | None = None) -> tuple[FeatureNet, ca.Function]:
    """The same on features phi. lasting : how long a run is; None: the problem's horizon."""
    s = ocp.system
    image = ca.Function("image", [u := ca.SX.sym("u", s.nu)], [_image(ocp, u, labels)])
    known = np.ascontiguousarray(image(labels.u.T).full().T)
    mean, spread = ca.DM(known.mean(axis=0)), ca.DM(known.std(axis=0) + 1e-9 * usual_sizes(ocp).u)
    said = branches * (s.nu + 1) if branches > 1 else s.nu
    y = ca.SX.sym("y", said)

    def clipped(own: ca.SX) -> ca.SX:
        return ca.fmin(ca.fmax(mean + spread * own, ca.DM(s.lbu)), ca.DM(s.ubu))

    said_u = _blended(y, s.nu, branches, clipped)
    at = Arguments.of(phi)
    held_u = said_u if held is None else braked(ocp, at, said_u, lasting or ocp.longest, held)
    outputs = at.function("controls", {"u": retracted(ocp, held_u)}, y=y)
    net = FeatureNet(phi, [MLP([phi.numel_out(0), *sizes, said])], outputs)
    return net, ca.Function("inverse", [u], [(u - mean) / spread, (image(u) - mean) / spread], ["u"], ["y", "of_label"])


def _image(ocp: OCP, u: ca.SX, labels: Labels) -> ca.SX:
    """u, each control that is a direction within one turn: two images would have their mean for an answer."""
    s, images = ocp.system, ca.SX(u)
    for i in ocp.periodic_controls:
        begin = _least_passed(labels.u[:, i], labels.t, np.linspace(s.lbu[i], s.ubu[i] - 2 * np.pi, BEGINS))
        images[i] = u[i] - 2 * np.pi * ca.floor((u[i] - begin) / (2 * np.pi))
    return images


def _least_passed(angle: Array, t: Array, begins: Array) -> float:
    """Of the directions `begins` that which fewest labels are beside, and fewest solutions turn through; labels of one
    stand behind each other in time."""
    few = slice(None, 20_000)
    a = angle[few, None]
    turn, to = (np.angle(np.exp(1j * d)) for d in (np.diff(a, axis=0), begins - a[:-1]))
    passed = (np.diff(t[few])[:, None] > 0) & (np.abs(to) <= np.abs(turn)) & (to * turn > 0)
    beside = np.exp((np.cos(a - begins) - 1) / BESIDE**2)
    return float(begins[(passed.mean(axis=0) + beside.mean(axis=0)).argmin()])


def _blended(y: ca.SX, nu: int, branches: int, answer: Callable[[ca.SX], ca.SX]) -> ca.SX:
    """The answers of y = (y_1, y_2, ..., numbers), each by its share: the softmax of the numbers over SHARP.

    That is one branch alone, but where another takes over: there the law is steep and continuous. One that jumps can
    hold a run where it jumps back and forth, which no integrator gets through.
    """
    if branches < 2:
        return answer(y)
    numbers = y[branches * nu:]
    share = ca.exp((numbers - ca.mmax(numbers)) / SHARP)
    return sum(share[k] * answer(y[k * nu:(k + 1) * nu]) for k in range(branches)) / ca.sum1(share)


def at_rate(net: FeatureNet, dt: float) -> FeatureNet:
    """(x, t[, p]) -> u of a network (x, t[, p], dt) -> u at one dt; the layers are shared."""
    return folded(net, dt=dt)


def folded(net: FeatureNet, **values: Any) -> FeatureNet:
    """A network with some of its arguments, by name, at constant values; the layers are shared."""
    at, out = Arguments.of(net.outputs).but(*values), net.outputs.name_out()[0]
    given = at.given(**{name: ca.SX(ca.DM(value)) for name, value in values.items()})
    phi = at.but("y").function("features", {"phi": given.call(net.inputs)})
    outputs = at.function(net.outputs.name(), {out: given.call(net.outputs)})
    return FeatureNet(phi, [cast(MLP, layers) for layers in net.nets], outputs)
