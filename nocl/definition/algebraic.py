"""Algebraic variables of a semi-explicit DAE: z from 0 = g(x, z, u, t, p), as expressions of (x, u, t, p).

Once they stand in the equations xdot = f(x, z, u, t, p), all else has an explicit system. Where g is linear in z the
linear equations are solved in symbols. Elsewhere z is what a few steps of Newton's method, written out, make of a
polynomial that is fitted to solutions in the box: as many as that takes, and two more, after which first and second
derivatives are those of the implicit function theorem too. Where they do not converge, beyond the box, say, z is NaN,
never a number that does not solve the equations.

Solutions in the box are found from each other, beginning in its middle, and must belong to one branch: det(dg/dz) is
nowhere 0 (the DAE has index 1) and nowhere of another sign.
"""

from __future__ import annotations

import math
from itertools import combinations_with_replacement

import casadi as ca
import numpy as np

from nocl.support.checks import Array

PROBES = 512  # points of the box that a start is fitted to, and as many that it is tried at
SPREAD = 0.8, 1.2  # of the nominal parameters, in the box
FIRST = 8  # of them, the nearest to the middle of the box, are solved first; then twice as many, and so on
ITERATIONS, HALVINGS = 60, 30  # of Newton's method at points of the box, and of each of its steps
CONVERGED = 1e-12  # a step, as a share of usual z: what is left is its square
NEAR = 1e-6  # a step from which on two more are exact
HIGHEST, TERMS = 8, 64  # degree of a fitted polynomial, and terms
BEYOND = 1.25  # shares of the box at which it ends
DEARER = 2  # steps more than the fewest are worth a lower degree
MOST = 10  # steps that are written out
LOST = 1e-6  # a last step, as a share of usual z, from which on z is NaN
REGULAR = 1e-13  # condition of dg/dz, its rows and columns scaled: less is singular
UNSEEN = 1e-200  # what a guard is multiplied by: finite, it changes nothing; NaN, it is NaN


def solved(z: ca.SX, g: ca.SX, guess: ca.SX, inputs: Box, owner: str) -> ca.SX:
    """z [nz] as expressions of the inputs; ValueError where g(z) = 0 has no solution in the box, or not one."""
    J = ca.jacobian(g, z)
    if ca.sprank(J) < z.numel():
        raise ValueError(f"{owner}: the equations alg do not determine {_names(z)}, whatever the values: dalg/dz has "
                         f"rank {ca.sprank(J)} (index 2 or more); expected as many independent equations in z as "
                         "there are z: differentiate a constraint that holds no z, and use the result in its place")
    equations = Equations(z, g, J, inputs, owner)
    unknown = [s.name() for s in inputs.unknown if ca.depends_on(g, s)]
    if not equations.linear:
        if unknown:
            raise ValueError(f"{owner}: alg holds {', '.join(unknown)}, of which no value is known; expected one, "
                             "nocl.parameter(name, nominal=...): z is solved for near it")
        return _by_newton(equations, guess)
    found = ca.densify(ca.solve(J, -ca.substitute(g, z, ca.DM.zeros(z.numel()))))
    if not unknown:
        equations.check_index(inputs.probes(0), equations.values_of(found, inputs.probes(0)))
    return found


class Box:
    """What z is a function of, and points where it is looked for: the box of x and u, times and values of p.

    symbols : columns by name; low, high [n] of x and u; nominal [np]
    """

    def __init__(self, symbols: dict[str, ca.SX], low: Array, high: Array, nominal: Array) -> None:
        self.symbols, self.column = symbols, ca.vertcat(*symbols.values())
        about = [np.nan_to_num(nominal) * share for share in SPREAD]
        self.low, self.high = np.r_[low, 0.0, np.minimum(*about)], np.r_[high, 0.0, np.maximum(*about)]
        self.unknown = [s for s, value in zip(ca.vertsplit(symbols["p"]), nominal, strict=True) if np.isnan(value)]
        self.names = [s.name() for s in ca.vertsplit(self.column)]

    def probes(self, seed: int) -> Array:
        """[PROBES, n], the middle first."""
        v = np.random.default_rng(seed).uniform(self.low, self.high, (PROBES, len(self.low)))
        v[0] = (self.low + self.high) / 2
        return v

    def shares(self, v: Array) -> Array:
        """Points as shares of the box, -1 to 1, which has no width where a value is known."""
        half = (self.high - self.low) / 2
        return (v - (self.low + self.high) / 2) / np.where(half > 0, half, 1.0)

    def said(self, v: Array) -> str:
        """A point in words, without what is the same everywhere."""
        return ", ".join(f"{name} = {value:.4g}" for name, value, width in
                         zip(self.names, v, self.high - self.low, strict=True) if width > 0)


class Equations:
    """g(z) = 0 and dg/dz at many points v at once."""

    def __init__(self, z: ca.SX, g: ca.SX, J: ca.SX, inputs: Box, owner: str) -> None:
        self.z, self.inputs, self.owner, self.n = z, inputs, owner, z.numel()
        self.linear = not ca.depends_on(J, z)
        self.moving = [i for i, s in enumerate(ca.vertsplit(inputs.column))
                       if inputs.high[i] > inputs.low[i] and ca.depends_on(g, s)]
        self.both = ca.Function("alg", [z, inputs.column], [ca.densify(g), ca.densify(J)])

    def at(self, z: Array, v: Array) -> tuple[Array, Array]:
        """g [B, n] and dg/dz [B, n, n]."""
        g, J = self.both(z.T, v.T)
        return g.full().T, J.full().reshape(self.n, len(v), self.n).transpose(1, 0, 2)

    def values_of(self, e: ca.SX, v: Array) -> Array:
        """An expression of the inputs at points [B, n]."""
        return ca.Function("e", [self.inputs.column], [e])(v.T).full().T

    def step(self, z: Array, v: Array) -> Array:
        """Newton's [B, n]; NaN where dg/dz is singular."""
        g, J = self.at(z, v)
        return _times(_inverses(J), g)

    def solve(self, z: Array, v: Array) -> Array:
        """z [B, n] by damped steps; NaN where they lead nowhere."""
        z = z.copy()
        for _ in range(ITERATIONS):
            g, J = self.at(z, v)
            inverse = _inverses(J)
            step = _times(inverse, g)
            moves = (np.abs(step) / _sizes(z)).max(axis=1) > CONVERGED
            if not moves.any():
                break
            z[moves] = self._shortened(z[moves], step[moves], inverse[moves], v[moves])
        z[~((np.abs(self.step(z, v)) / _sizes(z)).max(axis=1) < NEAR)] = np.nan
        return z

    def _shortened(self, z: Array, step: Array, inverse: Array, v: Array) -> Array:
        """z less as much of a step as brings g down, in the measure of dg/dz at z; NaN where no part of it does."""
        share, found, todo = np.ones(len(z)), np.full_like(z, np.nan), np.arange(len(z))
        before = np.abs(step).max(axis=1)
        rounding = CONVERGED * _sizes(z).min()
        for _ in range(HALVINGS):
            tried = z[todo] - share[todo, None] * step[todo]
            left = np.abs(_times(inverse[todo], self.at(tried, v[todo])[0])).max(axis=1)
            good = left <= (1 - share[todo] / 4) * before[todo] + rounding
            found[todo[good]], todo = tried[good], todo[~good]
            share[todo] /= 2
            if not len(todo):
                break
        return found

    def _said(self, z: Array) -> str:
        return ", ".join(f"{s.name()} = {value:.4g}" for s, value in zip(ca.vertsplit(self.z), z, strict=True))

    def check_index(self, v: Array, z: Array) -> None:
        """ValueError where dg/dz is singular, or of another sign than elsewhere, at solutions z [B, n]."""
        _, J = self.at(np.nan_to_num(z), v)
        signs = np.array([_sign(j) for j in J])
        lost = ~np.isfinite(z).all(axis=1) & ~(self.linear & (signs == 0))
        if lost.any():
            k = int(np.flatnonzero(lost)[0])
            raise ValueError(f"{self.owner}: no {_names(self.z)} solve 0 = alg at {self.inputs.said(v[k])}; expected a "
                             "solution all over the box: change the equations, shrink lbx, ubx, or give z_guess, "
                             "numbers or expressions of x, u and p near the solution")
        for bad, what in ((signs == 0, "are singular in z (index 2 or more)"),
                          (signs != signs[0], "have solutions on another branch, beyond a singular point,")):
            if bad.any():
                k = int(np.flatnonzero(bad)[0])
                raise ValueError(f"{self.owner}: the equations alg {what} at {self.inputs.said(v[k])}, "
                                 f"{self._said(z[k])}; expected one smooth solution all over the box: shrink lbx, "
                                 "ubx, or give z_guess on the branch that is meant")


def _by_newton(equations: Equations, guess: ca.SX) -> ca.SX:
    """z by a fitted start and a few steps."""
    box = equations.inputs
    v, fresh = box.probes(0), box.probes(1)
    z = _branch(equations, guess, v)
    equations.check_index(v, z)
    truth = _branch(equations, guess, fresh)
    equations.check_index(fresh, truth)
    n, left = len(equations.moving), z - equations.values_of(guess, v)
    degrees = [d for d in range(HIGHEST + 1) if math.comb(n + d, d) <= TERMS]
    starts = [guess + _polynomial(equations, d, v, left) for d in degrees]
    counts = [_needed(equations, start, fresh, truth) for start in starts]
    if min(counts) > MOST:
        raise ValueError(f"{equations.owner}: {_names(equations.z)} are not found by {MOST} steps of Newton's method "
                         "from a polynomial fitted to solutions in the box; expected equations that are less bent in "
                         "z: write them in other variables (a logarithm), shrink lbx, ubx, or give z_guess, "
                         "expressions of x, u and p near the solution")
    chosen = next(i for i, count in enumerate(counts) if count <= min(counts) + DEARER)
    return _written_out(equations, starts[chosen], counts[chosen], _sizes(z))


def _branch(equations: Equations, guess: ca.SX, v: Array) -> Array:
    """Solutions at points v [B, n], each from the nearest known one, the first from the guess."""
    shares = equations.inputs.shares(v)
    order = np.argsort((shares**2).sum(axis=1))
    z = np.full((len(v), equations.n), np.nan)
    first = order[:1]
    z[first] = equations.solve(equations.values_of(guess, v[first]), v[first])
    known, begin, many = first, 1, FIRST
    while begin < len(v) and np.isfinite(z[first]).all():
        these = order[begin:begin + many]
        far = ((shares[these, None] - shares[None, known]) ** 2).sum(axis=2)
        z[these] = equations.solve(z[known[far.argmin(axis=1)]], v[these])
        known = np.r_[known, these[np.isfinite(z[these]).all(axis=1)]]
        begin, many = begin + many, 2 * many
    return z


def _polynomial(equations: Equations, degree: int, v: Array, values: Array) -> ca.SX:
    """The least-squares polynomial, in the inputs that the equations hold, through values [B, n]."""
    box, moving = equations.inputs, equations.moving
    half, middle = (box.high - box.low)[moving] / 2, (box.high + box.low)[moving] / 2
    where = (box.column[moving] - ca.DM(middle)) / ca.DM(half)
    symbols = ca.vertsplit(ca.fmin(ca.fmax(where, -BEYOND), BEYOND))  # Newton's steps forget where they began, and how
    powers = [p for d in range(degree + 1) for p in combinations_with_replacement(range(len(moving)), d)]
    shares = box.shares(v)[:, moving]
    columns = np.stack([shares[:, p].prod(axis=1) for p in powers], axis=1)
    terms = {p: ca.SX(1) for p in powers[:1]}
    for p in powers[1:]:
        terms[p] = terms[p[:-1]] * symbols[p[-1]]
    return ca.DM(np.linalg.lstsq(columns, values, rcond=None)[0].T) @ ca.vertcat(*terms.values())


def _needed(equations: Equations, start: ca.SX, v: Array, truth: Array) -> int:
    """Undamped steps from a start to the true solutions, and two more; more than MOST where they do not get there."""
    z, size = equations.values_of(start, v), _sizes(truth)
    for count in range(MOST + 1):
        if (np.abs(z - truth) / size).max() < NEAR:
            return count + 2
        z = z - equations.step(z, v)
    return MOST + 3


def _written_out(equations: Equations, start: ca.SX, steps: int, size: Array) -> ca.SX:
    """Newton's steps as an expression; NaN where the last one is not small."""
    z, at = start, equations.inputs.column
    step = ca.SX.zeros(equations.n)
    for _ in range(steps):
        g, J = equations.both(z, at)
        step = ca.solve(J, g)
        z = z - step
    return z + UNSEEN * ca.log(LOST**2 - ca.sumsqr(step / ca.DM(size)))


def _sizes(z: Array) -> Array:
    """Usual values of each z [n], of those that are known."""
    usual = np.nanmax(np.abs(np.where(np.isfinite(z), z, 0.0)), axis=0)
    return np.where(usual > 0, usual, max(usual.max(), 1e-300) if usual.size else 1.0)


def _inverses(J: Array) -> Array:
    """Of matrices [B, n, n]; NaN where there is none."""
    found = np.full_like(J, np.nan)
    whole = np.flatnonzero(np.isfinite(J).all(axis=(1, 2)))
    regular = whole[np.linalg.det(J[whole]) != 0]
    found[regular] = np.linalg.inv(J[regular])
    return found


def _times(matrices: Array, columns: Array) -> Array:
    """Matrices [B, n, n] times columns [B, n]."""
    return np.einsum("bij,bj->bi", matrices, columns)


def _sign(J: Array) -> float:
    """Of det J; 0 where it is singular, whatever the units of its rows and columns."""
    rows = J / np.maximum(np.abs(J).max(axis=1, keepdims=True), 1e-300)
    even = rows / np.maximum(np.abs(rows).max(axis=0, keepdims=True), 1e-300)
    values = np.linalg.svd(even, compute_uv=False)
    return 0.0 if values[-1] <= REGULAR * values[0] else float(np.linalg.slogdet(even)[0])


def _names(z: ca.SX) -> str:
    return ", ".join(s.name() for s in ca.vertsplit(z))
