"""Algebraic variables of a semi-explicit DAE: z from 0 = g(x, z, u, t, p), as expressions of (x, u, t, p).

Once they stand in the equations xdot = f(x, z, u, t, p), all else has an explicit system. Where g is linear in z the
linear equations are solved in symbols. Elsewhere z is what a few steps of Newton's method, written out, make of a
polynomial that is fitted to solutions in the box: as many as that takes, and two more, after which first and second
derivatives are those of the implicit function theorem too. Where they do not converge, beyond the box, say, z is NaN,
never a number that does not solve the equations.

Solutions in the box are continued from each other, beginning in its middle, by steps in which Newton's method contracts
at once, so that they belong to one branch: det(dg/dz) is nowhere 0 (the DAE has index 1) and nowhere of another sign.
A pole that is far narrower than the box is not seen: pH, not the ions' concentration, is a variable for Newton.
All is done in units of z and of the equations in which the entries of dg/dz are about 1.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from itertools import combinations_with_replacement

import casadi as ca
import numpy as np

from nocl.support.checks import Array

PROBES = 512  # points of the box that a start is fitted to, and as many that it is tried at
FIRST = 8  # of them, the nearest to the middle of the box, are solved first; then twice as many, and so on
BALANCED = 8  # rounds in which rows and columns of dg/dz get units
ITERATIONS, HALVINGS = 60, 30  # of Newton's method at the first point, and of each of its steps
CONVERGED = 1e-12  # a step, as a share of usual z: what is left is its square
PIECES, SHORTEST = 300, 2.0**-10  # of the way from a point to the next, tried, and the shortest
CONTRACTS = 0.25  # of a step the next one is no longer, on the branch
STEPS = 8  # of a piece
NEAR = 1e-6  # a step from which on two more are exact
ROUNDING = 1e-10  # a step that need not get shorter
WIDE = 1e-5  # of the largest z: where a twentieth of them are smaller, no step is small for all
HIGHEST, TERMS = 8, 64  # degree of a fitted polynomial, and terms
BEYOND = 1.25  # shares of the box at which it ends
SOON = 4  # steps, of which no higher degree makes fewer that count
MOST = 10  # steps that are written out
LOST = 1e-6  # a last step, as a share of usual z, from which on z is NaN
SOLVED = 1e-8  # ... of linear equations, as they are found
REGULAR = 1e-13  # condition of dg/dz in its units: less is singular
UNSEEN = 1e-200  # what a guard is multiplied by: finite, it changes nothing; NaN, it is NaN


class Box:
    """What z is a function of, and points where it is looked for.

    symbols : columns by name; low, high : of all their entries [n]; NaN where nothing is known
    """

    def __init__(self, symbols: Mapping[str, ca.SX], low: Array, high: Array) -> None:
        self.column = ca.vertcat(*symbols.values())
        self.parts = ca.vertsplit(self.column)
        self.unknown = [s for s, value in zip(self.parts, low, strict=True) if np.isnan(value)]
        self.low, self.high = np.nan_to_num(low), np.nan_to_num(high)

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
        return ", ".join(f"{s.name()} = {value:.4g}" for s, value, width in
                         zip(self.parts, v, self.high - self.low, strict=True) if width > 0)


def solved(z: ca.SX, g: ca.SX, guess: ca.SX, box: Box, owner: str) -> ca.SX:
    """z [nz] as expressions of the inputs; ValueError where g(z) = 0 has no solution in the box, or not one."""
    J = ca.jacobian(g, z)
    if ca.sprank(J) < z.numel():
        raise ValueError(f"{owner}: the equations alg do not determine {_names(z)}, whatever the values: dalg/dz has "
                         f"rank {ca.sprank(J)} (index 2 or more); expected as many independent equations in z as "
                         "there are z: differentiate a constraint that holds no z, and use the result in its place")
    unknown = [s.name() for s in box.unknown if ca.depends_on(g, s)]
    with np.errstate(all="ignore"):  # what is not finite is no solution
        if not ca.depends_on(J, z):
            return _linear(z, g, box, owner, checked=not unknown)
        if unknown:
            raise ValueError(f"{owner}: alg holds {', '.join(unknown)}, of which no value is known; expected one, "
                             "nocl.parameter(name, nominal=...): z is solved for near it")
        return _by_newton(z, g, guess, box, owner)


def changes(g: ca.SX, z: ca.SX, inputs: ca.SX) -> bool:
    """Whether the solution of equations that are not linear in z hangs on some inputs: where they lie counts."""
    return bool(inputs.numel() and ca.depends_on(g, inputs) and ca.depends_on(ca.jacobian(g, z), z))


class Equations:
    """g(z) = 0 at many points v at once, z and g in units of their own: z = c y, d g(c y) = 0 for y."""

    def __init__(self, z: ca.SX, g: ca.SX, box: Box, owner: str) -> None:
        self.z, self.g, self.box, self.owner, self.n = z, g, box, owner, z.numel()
        self.moving = [i for i, s in enumerate(box.parts) if box.high[i] > box.low[i] and ca.depends_on(g, s)]
        self._in_units(np.ones(self.n), np.ones(self.n))

    def _in_units(self, rows: Array, columns: Array) -> None:
        self.rows, self.unit, y = rows, columns, ca.SX.sym("y", self.n)
        g = ca.DM(rows) * ca.substitute(self.g, self.z, ca.DM(columns) * y)
        self.both = ca.Function("alg", [y, self.box.column], [ca.densify(g), ca.jacobian(g, y)])

    def balance(self, y: Array, v: Array) -> Array:
        """Take units in which dg/dz at y [B, n] is about 1; y in these."""
        J = np.abs(self.at(y, v)[1])
        usual = np.nan_to_num(np.where(np.isfinite(J), J, 0.0).max(axis=0))
        rows, columns = _units(usual)
        self._in_units(self.rows * rows, self.unit * columns)
        return y / columns

    def at(self, y: Array, v: Array) -> tuple[Array, Array]:
        """d g [B, n] and its Jacobian by y [B, n, n]."""
        g, J = self.both(y.T, v.T)
        return g.full().T, J.full().reshape(self.n, len(v), self.n).transpose(1, 0, 2)

    def values_of(self, e: ca.SX, v: Array) -> Array:
        """An expression of the inputs at points [B, n], as z is: in units of y."""
        return ca.Function("e", [self.box.column], [e])(v.T).full().T / self.unit

    def step(self, y: Array, v: Array) -> Array:
        """Newton's [B, n]; NaN where the Jacobian is singular."""
        g, J = self.at(y, v)
        return _times(_inverses(J), g)

    def solve(self, y: Array, v: Array) -> Array:
        """y [1, n] by damped steps; NaN where they lead nowhere."""
        for _ in range(ITERATIONS):
            g, J = self.at(y, v)
            inverse = _inverses(J)
            step = _times(inverse, g)
            size, before = _sizes(y), _large(step, _sizes(y))
            if not before > CONVERGED:
                break
            for _ in range(HALVINGS):
                tried = y - step
                left = _large(_times(inverse, self.at(tried, v)[0]), size)
                if left < before or max(left, before) < ROUNDING:
                    break
                step = step / 2
            else:
                return np.full_like(y, np.nan)
            y = tried
        return y if _large(self.step(y, v), _sizes(y)) < NEAR else np.full_like(y, np.nan)

    def contracted(self, y: Array, v: Array, usual: Array) -> Array:
        """y [B, n] by steps each of which is far shorter than the one before; NaN where they are not."""
        before = np.full(len(y), np.inf)
        for _ in range(STEPS):
            step = self.step(y, v)
            beyond = np.abs(step) - CONVERGED * usual
            now = (beyond.clip(min=0) / np.maximum(np.abs(y), WIDE * usual)).max(axis=1)
            y = np.where(((now <= CONTRACTS * before) | (now <= ROUNDING))[:, None], y - step, np.nan)
            before = now
            if not (now > ROUNDING).any():
                break
        y[~(before <= NEAR)] = np.nan
        return y

    def follow(self, y: Array, begin: Array, end: Array, guess: ca.Function) -> Array:
        """Solutions y [B, n] at points `begin` [B, m], continued to `end`; NaN where the branch ends."""
        y, gone, piece = y.copy(), np.zeros(len(y)), np.ones(len(y))
        usual = _sizes(y)
        for _ in range(PIECES):
            rows = np.flatnonzero((gone < 1) & (piece >= SHORTEST))
            if not len(rows):
                break
            aim = np.minimum(gone[rows] + piece[rows], 1.0)
            here, there = (begin[rows] + share[:, None] * (end - begin)[rows] for share in (gone[rows], aim))
            moved = (guess(there.T).full() - guess(here.T).full()).T / self.unit
            found = self.contracted(y[rows] + moved, there, usual)
            good = np.isfinite(found).all(axis=1)
            y[rows[good]], gone[rows[good]] = found[good], aim[good]
            piece[rows] *= np.where(good, 2.0, 0.5)
        y[gone < 1] = np.nan
        return y

    def check(self, v: Array, y: Array, linear: bool = False) -> None:
        """ValueError where there are no solutions y [B, n], or dg/dz is singular there, or of another sign."""
        signs = np.array([_sign(j) for j in self.at(np.nan_to_num(y), v)[1]])
        found = np.isfinite(y).all(axis=1) & np.isfinite(signs)
        lost = ~found & ~(linear & (signs == 0))
        if lost.any():
            k = int(np.flatnonzero(lost)[0])
            raise ValueError(f"{self.owner}: no {_names(self.z)} solve 0 = alg at {self.box.said(v[k])}, or none that "
                             "is continued smoothly from the middle of the box; expected a solution all over the box: "
                             "change the equations, shrink lbx, ubx, or give z_guess, numbers or expressions of x, u "
                             "and p near the solution")
        for bad, what in ((signs == 0, "are singular in z (index 2 or more)"),
                          (signs != signs[0], "have solutions on another branch, beyond a singular point,")):
            if bad.any():
                k = int(np.flatnonzero(bad)[0])
                raise ValueError(f"{self.owner}: the equations alg {what} at {self.box.said(v[k])}{self._said(y[k])}; "
                                 "expected one smooth solution all over the box: shrink lbx, ubx, or give z_guess on "
                                 "the branch that is meant")

    def check_width(self, y: Array) -> None:
        """ValueError where z is of so many sizes that no step is small for all."""
        size, small = np.abs(y).max(axis=0), np.quantile(np.abs(y), 0.05, axis=0)
        for i in np.flatnonzero((small > 0) & (small < WIDE * size)):
            raise ValueError(f"{self.owner}: {ca.vertsplit(self.z)[i].name()} is {size[i] * self.unit[i]:.3g} in one "
                             f"part of the box and below {small[i] * self.unit[i]:.3g} in another; expected values of "
                             "a few decades: make its logarithm the algebraic variable")

    def _said(self, y: Array) -> str:
        if not np.isfinite(y).all():
            return ""
        return "".join(f", {s.name()} = {value:.4g}"
                       for s, value in zip(ca.vertsplit(self.z), y * self.unit, strict=True))


def _linear(z: ca.SX, g: ca.SX, box: Box, owner: str, checked: bool) -> ca.SX:
    """z of equations that are linear in it."""
    equations, v = Equations(z, g, box, owner), box.probes(0)
    equations.balance(np.zeros((len(v), z.numel())), v)
    rest, J = equations.both(ca.DM.zeros(z.numel()), box.column)
    found = ca.densify(ca.DM(equations.unit) * ca.solve(J, -rest))
    if checked:
        y = equations.values_of(found, v)
        equations.check(v, y, linear=True)
        if not (np.abs(equations.step(y, v)) <= SOLVED * _sizes(y)).all():
            raise ValueError(f"{owner}: alg is linear in {_names(z)}, and too close to singular to be solved; expected "
                             "equations whose scales differ less: give z and alg units in which they are about 1")
    return found


def _by_newton(z: ca.SX, g: ca.SX, guess: ca.SX, box: Box, owner: str) -> ca.SX:
    """z by a fitted start and a few steps."""
    equations, v, fresh = Equations(z, g, box, owner), box.probes(0), box.probes(1)
    equations.balance(equations.values_of(guess, v), v)
    y = _branch(equations, guess, v)
    equations.check(v, y)
    y = equations.balance(y, v)
    truth = _branch(equations, guess, fresh)
    equations.check(fresh, truth)
    equations.check_width(truth)
    left = y - equations.values_of(guess, v)
    best, start = MOST + 1, ca.SX()
    for degree in (d for d in range(HIGHEST + 1) if math.comb(len(equations.moving) + d, d) <= TERMS):
        tried = guess / ca.DM(equations.unit) + _polynomial(equations, degree, v, left)
        count = _needed(equations, tried, fresh, truth)
        if count < best:
            best, start = count, tried
        if best <= SOON:
            break
    if best > MOST:
        raise ValueError(f"{owner}: {_names(z)} are not found by {MOST} steps of Newton's method from a polynomial "
                         "fitted to solutions in the box; expected equations that are less bent in z: write them in "
                         "other variables (a logarithm), shrink lbx, ubx, or give z_guess, expressions of x, u and p "
                         "near the solution")
    return _written_out(equations, start, best, _sizes(truth))


def _branch(equations: Equations, guess: ca.SX, v: Array) -> Array:
    """Solutions at points v [B, m], each continued from the nearest known one, the first from the guess."""
    shares, of = equations.box.shares(v), ca.Function("guess", [equations.box.column], [guess])
    order = np.argsort((shares**2).sum(axis=1))
    y = np.full((len(v), equations.n), np.nan)
    first = order[:1]
    y[first] = equations.solve(equations.values_of(guess, v[first]), v[first])
    known, begin, many = first, 1, FIRST
    while begin < len(v) and np.isfinite(y[first]).all():
        these = order[begin:begin + many]
        near = known[((shares[these, None] - shares[None, known]) ** 2).sum(axis=2).argmin(axis=1)]
        y[these] = equations.follow(y[near], v[near], v[these], of)
        known = np.r_[known, these[np.isfinite(y[these]).all(axis=1)]]
        begin, many = begin + many, 2 * many
    return y


def _polynomial(equations: Equations, degree: int, v: Array, values: Array) -> ca.SX:
    """The least-squares polynomial, in the inputs that the equations hold, through values [B, n]."""
    box, moving = equations.box, equations.moving
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
    """Undamped steps from a start, in units of y, to the true solutions, and two more; more than MOST where they do not
    get there."""
    y, size = equations.values_of(ca.DM(equations.unit) * start, v), _sizes(truth)
    for count in range(MOST - 1):
        if (np.abs(y - truth) / size).max() < NEAR:
            return count + 2
        y = y - equations.step(y, v)
    return MOST + 1


def _written_out(equations: Equations, start: ca.SX, steps: int, size: Array) -> ca.SX:
    """z by Newton's steps as an expression; NaN where the last one is not small."""
    y, at = start, equations.box.column
    step = ca.SX.zeros(equations.n)
    for _ in range(steps):
        g, J = equations.both(y, at)
        step = ca.solve(J, g)
        y = y - step
    return ca.densify(ca.DM(equations.unit) * (y + UNSEEN * ca.log(LOST**2 - ca.sumsqr(step / ca.DM(size)))))


def _units(entries: Array) -> tuple[Array, Array]:
    """(of rows, of columns), powers of 2, by which the largest entries of a matrix [n, n] become about 1."""
    rows, columns = np.ones(len(entries)), np.ones(len(entries))
    for _ in range(BALANCED):
        now = rows[:, None] * entries * columns
        rows /= _root(now.max(axis=1))
        now = rows[:, None] * entries * columns
        columns /= _root(now.max(axis=0))
    return np.exp2(np.round(np.log2(rows))), np.exp2(np.round(np.log2(columns)))


def _root(values: Array) -> Array:
    return np.where(values > 0, np.sqrt(values), 1.0)


def _sizes(y: Array) -> Array:
    """Usual values of each y [n], of those that are known."""
    usual = np.abs(np.where(np.isfinite(y), y, 0.0)).max(axis=0)
    return np.where(usual > 0, usual, max(usual.max(), 1e-300))


def _large(step: Array, size: Array) -> float:
    """The largest share; inf where it is NaN."""
    share = float((np.abs(step) / size).max())
    return share if math.isfinite(share) else math.inf


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
    """Of det J; 0 where it is singular, whatever the units of its rows and columns; NaN where J is not finite."""
    if not np.isfinite(J).all():
        return math.nan
    rows, columns = _units(np.abs(J))
    even = rows[:, None] * J * columns
    values = np.linalg.svd(even, compute_uv=False)
    return 0.0 if values[-1] <= REGULAR * values[0] else float(np.linalg.slogdet(even)[0])


def _names(z: ca.SX) -> str:
    return ", ".join(s.name() for s in ca.vertsplit(z))
