"""What the networks of a controller and a value see and say, as SX maps in physical units, scaled by the labels.

Features of (x, t): the state in units of its spread at that time about its mean at that time (both polynomials in t),
sine and cosine of angles, time, the logarithm of the time to go, and the distance to the goal over the time to go: the
optimal gain grows like 1 / (T - t). Of an angle that the problem is periodic in nothing but sines and cosines is seen,
so that all images of a state have one answer.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, cast

import casadi as ca
import numpy as np

from nocl.nets import MLP, FeatureNet
from nocl.ocp import OCP
from nocl.scales import usual_sizes
from nocl.support.checks import Array
from nocl.translate.arguments import Arguments

if TYPE_CHECKING:
    from nocl.solvers.cnd.labels import Labels

DEGREE = 6  # of the polynomials in time
CONSTANT = 1e-6  # of its usual size: what varies less is as good as constant
LEAST_TIME = 0.025  # of the horizon: time to go is never counted as less


def features(ocp: OCP, x: Array, t: Array, dt: Array | None = None, *, plain: bool = False) -> ca.Function:
    """(x, t) -> phi, each feature with mean 0 and standard deviation 1 over the labels x [n, nx], t [n].

    With dt [n] it is (x, t, dt) -> phi: the clock then stands at the middle of the time that a control is held for.
    `plain` adds the state in units that do not change with time.
    """
    s, at = ocp.system, ocp.functions.feedback()
    if dt is not None:
        at = at.given(dt=ca.SX.sym("dt"))
    state, time = at["x"], at["t"] if dt is None else at["t"] + at["dt"] / 2
    tau = 2 * time / ocp.horizon - 1
    to_go = ca.fmax(ocp.horizon - time, 0)
    half = usual_sizes(ocp).x
    mean, spread = _moments_in_time(x, 2 * (t if dt is None else t + dt / 2) / ocp.horizon - 1, half)
    standard = (state - _polynomial(mean, tau)) / ca.exp(_polynomial(spread, tau))
    once = [i for i in range(s.nx) if i not in ocp.periodic]  # the others have many images: sines and cosines only
    angles = [g(state[i]) for i in s.angle_indices for g in (ca.sin, ca.cos)]
    off = state - ca.DM(ocp.x_goal)
    left = ca.vertcat(*(ca.sin(off[i]) if i in ocp.periodic else off[i] for i in range(s.nx)))
    rush = left / (to_go + LEAST_TIME * ocp.horizon)
    clock = ca.vertcat(tau, ca.log(to_go / ocp.horizon + LEAST_TIME) / 2)
    more = [state[once]] if plain else []
    raw = ca.vertcat(standard[once], *angles, clock, rush, *more, *([] if dt is None else [at["dt"]]))
    given = [x, t] if dt is None else [x, t, dt]
    some = slice(None, None, -(-len(t) // 20_000))  # of every kind of label
    values = at.function("raw", {"raw": raw})(*(np.atleast_2d(a[some].T) for a in given)).full()
    rates = [1.0 if i in ocp.periodic else half[i] for i in range(s.nx)]
    one = np.r_[np.ones(len(once) + len(angles) + clock.numel()), rates, half[once] if plain else [],
                [] if dt is None else [ocp.horizon]]
    centre, width = values.mean(axis=1), values.std(axis=1) + CONSTANT * one
    return at.function("features", {"phi": (raw - ca.DM(centre)) / ca.DM(width)})


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


def policy_net(ocp: OCP, labels: Labels, sizes: tuple[int, ...],
               control_dt: bool = False) -> tuple[FeatureNet, ca.Function]:
    """(u = clip(mean + spread * y, U), y a tanh network of the features; and u -> y, its inverse inside U).

    control_dt: (x, t, dt) -> u in place of (x, t) -> u.
    """
    s = ocp.system
    phi = features(ocp, labels.x, labels.t, labels.dt if control_dt else None)
    mean, spread = ca.DM(labels.u.mean(axis=0)), ca.DM(labels.u.std(axis=0) + 1e-9 * usual_sizes(ocp).u)
    y, u = ca.SX.sym("y", s.nu), ca.SX.sym("u", s.nu)
    clipped = ca.fmin(ca.fmax(mean + spread * y, ca.DM(s.lbu)), ca.DM(s.ubu))
    outputs = Arguments.of(phi).function("controls", {"u": clipped}, y=y)
    net = FeatureNet(phi, [MLP([phi.numel_out(0), *sizes, s.nu])], outputs)
    return net, ca.Function("inverse", [u], [(u - mean) / spread], ["u"], ["y"])


def at_rate(net: FeatureNet, dt: float) -> FeatureNet:
    """(x, t) -> u of a network (x, t, dt) -> u at one dt; the layers are shared."""
    at = Arguments.of(net.outputs).but("dt")
    phi = at.but("y").function("features", {"phi": at.given(dt=dt).call(net.inputs)})
    outputs = at.function("controls", {"u": at.given(dt=dt).call(net.outputs)})
    return FeatureNet(phi, [cast(MLP, layers) for layers in net.nets], outputs)
