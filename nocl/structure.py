"""Structure of xdot = f(x, u) read off labels: which controls enter affinely, which entries are known exactly.

Only label *values* are used, never the equations: f is a black box that answers z = (x, u) with f(z) and df/dz.

Notation: w are the controls of the affine set S (the largest set whose Jacobian columns do not depend on S), w0 the
point of [lb, ub] nearest to 0, h_j the longest step from there inside the box, r the other variables. Then

    f(z) = E_0(r) + sum_j E_j(r) (w_j - w0_j) / h_j,    E_0 = f(r, w0),    E_j = f(r, w0 + h_j e_j) - E_0,

and the labels of the entries E (nx (1 + |S|) functions of r, in the units of xdot) are differences of labels of f.
An entry's variables are those that change it; one whose slope is the same everywhere is split off as an exact linear
term; what is a polynomial in the other variables and the sines and cosines of angles is found by least squares and
kept if it holds at fresh points; the rest is grouped by its variables, and left to one network a group.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, combinations_with_replacement

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from nocl.checks import Array
from nocl.data import Dataset

Oracle = Callable[[Array, Array], Dataset]  # x [N, nx], u [N, nu] -> labels with Jacobians
Draw = Callable[[int], tuple[Array, Array]]  # n -> fresh rows z [n, nz] and their entries [n, E]

TOLERANCE = 1e-9  # of the largest |f_i|: above rounding, far below anything that matters
MAX_TERMS = 400  # of a polynomial in features
MAX_DEGREE = 4


@dataclass(frozen=True, eq=False)
class Box:
    """The variables z = (x, u): names, bounds, which are angles; the first nx are states."""

    names: tuple[str, ...]
    lb: Array  # [nz]
    ub: Array  # [nz]
    nx: int
    angles: tuple[int, ...] = ()

    @property
    def nz(self) -> int:
        return len(self.names)

    @property
    def width(self) -> Array:
        return self.ub - self.lb

    def sample(self, n: int, rng: np.random.Generator) -> Array:
        """n uniform rows z [n, nz]."""
        return rng.uniform(self.lb, self.ub, (n, self.nz))


@dataclass(frozen=True, eq=False)
class Split:
    """f(z) = E_0(r) + sum_j E_j(r) (w_j - w0_j) / h_j; entry e = i (1 + |S|) + j is row i of E_j."""

    box: Box
    affine: tuple[int, ...]  # S, as indices into z
    w0: Array  # [|S|]
    h: Array  # [|S|]

    @property
    def columns(self) -> int:
        return 1 + len(self.affine)

    @property
    def n_entries(self) -> int:
        return self.box.nx * self.columns

    @property
    def rest(self) -> tuple[int, ...]:
        """r, as indices into z."""
        return tuple(k for k in range(self.box.nz) if k not in self.affine)

    def labels(self, oracle: Oracle, z: Array) -> tuple[Array, Array]:
        """Entries [N, E] and their gradients in z [N, E, nz] (zero in w) at rows z; 1 + |S| labels of f a row."""
        w = list(self.affine)
        corners = np.repeat(z[None], self.columns, axis=0)  # [1+|S|, N, nz]
        corners[:, :, w] = self.w0
        for j, k in enumerate(w):
            corners[1 + j, :, k] += self.h[j]
        value, gradient = label(oracle, corners.reshape(-1, self.box.nz), self.box.nx)
        value = value.reshape(self.columns, len(z), -1).transpose(1, 2, 0)  # [N, nx, 1+|S|]
        gradient = gradient.reshape(self.columns, len(z), self.box.nx, -1).transpose(1, 2, 0, 3)
        value[:, :, 1:] -= value[:, :, :1]
        gradient[:, :, 1:] -= gradient[:, :, :1]
        gradient[..., w] = 0.0
        return value.reshape(len(z), -1), gradient.reshape(len(z), self.n_entries, -1)

    def weights(self, z: ca.SX) -> list[ca.SX]:
        """What the columns of the entries are multiplied by: 1, (w_j - w0_j) / h_j, ..."""
        return [ca.SX(1), *((z[k] - w) / h for k, w, h in zip(self.affine, self.w0, self.h, strict=True))]

    def combine(self, entries: Sequence[ca.SX], z: ca.SX) -> ca.SX:
        """xdot [nx] from the entries [E]."""
        weights, rows = self.weights(z), range(self.box.nx)
        return ca.vertcat(*(sum(entries[i * self.columns + j] * w for j, w in enumerate(weights)) for i in rows))

    def scale(self, value: Array) -> Array:
        """The largest |f_i| that the entries [N, E] make, one number an entry: what its rounding goes with. [E]"""
        rows = np.abs(value).max(axis=0).reshape(self.box.nx, -1).max(axis=1)
        return np.repeat(np.maximum(rows, np.finfo(np.float64).tiny), self.columns)


@dataclass(frozen=True)
class Group:
    """Entries that are functions of the same variables, to be learned by one network."""

    variables: tuple[int, ...]  # indices into z
    entries: tuple[int, ...]


@dataclass(frozen=True, eq=False)
class Structure:
    """What the labels say about f: E(z) = known(z) + what the groups' networks must learn."""

    split: Split
    known: ca.Function  # z [nz] -> (entries [E], their Jacobian [E, nz]), SX
    groups: tuple[Group, ...]
    words: str
    labels: int  # of f, that were used

    @property
    def found(self) -> bool:
        """False where f is left as it is, to one network of all variables."""
        box = self.split.box
        return bool(self.split.affine) or self.groups != (Group(tuple(range(box.nz)), tuple(range(box.nx))),)

    def residual(self, oracle: Oracle, z: Array) -> tuple[Array, Array]:
        """Entries [N, E] and gradients [N, E, nz] at rows z, less the known part: the networks' labels."""
        value, gradient = self.split.labels(oracle, z)
        known, slope = evaluate(self.known, z)
        return value - known, gradient - slope


def label(oracle: Oracle, z: Array, nx: int) -> tuple[Array, Array]:
    """f [N, nx] and df/dz [N, nx, nz] at rows z; labels that are not finite or lack Jacobians raise ValueError."""
    data = oracle(z[:, :nx], z[:, nx:])
    if data.A is None or data.B is None:
        raise ValueError("the labels have no Jacobians; expected A and B, from which the structure is read: "
                         "pass gradients=False to learn from values alone")
    value, gradient = np.array(data.xdot), np.concatenate([data.A, data.B], axis=2)
    good = np.isfinite(value).all(axis=1) & np.isfinite(gradient).all(axis=(1, 2))
    if not good.all():
        raise ValueError(f"the label at (x, u) = {z[~good][0].tolist()} is not finite; expected numbers all over the "
                         "box: shrink lbx, ubx or repair the labels")
    return value, gradient


def evaluate(function: ca.Function, z: Array) -> tuple[Array, Array]:
    """(value [N, r], Jacobian [N, r, nz]) of an SX function z -> (value, Jacobian) at rows z."""
    value, slope = (m.full() for m in function(z.T))
    rows = function.size1_out(0)
    return value.T.reshape(len(z), rows), slope.reshape(rows, len(z), -1).transpose(1, 0, 2)


def _with_jacobian(z: ca.SX, expressions: Sequence[ca.SX]) -> ca.Function:
    column = ca.densify(ca.vertcat(*expressions))
    return ca.Function("known", [z], [column, ca.densify(ca.jacobian(column, z))], ["z"], ["value", "jacobian"])


def plain(box: Box, words: str = "no structure used: one network of all variables") -> Structure:
    """One network z -> f, nothing known."""
    split = Split(box, (), np.zeros(0), np.zeros(0))
    group = Group(tuple(range(box.nz)), tuple(range(box.nx)))
    return Structure(split, _with_jacobian(ca.SX.sym("z", box.nz), [ca.SX(0)] * box.nx), (group,), words, 0)


def find(oracle: Oracle, box: Box, *, seed: int = 0, probes: int = 64, features: bool = True) -> Structure:
    """The structure of the black box f on its box, from about (2 + nz) (1 + |S|) `probes` labels.

    With `features`, polynomials in the variables and in sin, cos of angles count as known once they hold at fresh
    points. Labels without Jacobians and labels that are not finite raise ValueError.
    """
    rng, counter = np.random.default_rng(seed), _Counter(oracle)
    split = affine_split(counter, box, rng, probes)
    slopes = _slopes(counter, split, rng, probes)

    def draw(n: int) -> tuple[Array, Array]:
        z = box.sample(n, rng)
        return z, split.labels(counter, z)[0]

    structure = _build(split, slopes, draw, features)
    return replace(structure, labels=counter.n)


def read(z: Array, value: Array, gradient: Array, box: Box, *, features: bool = True) -> Structure:
    """The structure that given labels show: rows z [N, nz], f [N, nx], df/dz [N, nx, nz]; constant slopes, polynomials.

    What is affine in the controls cannot be told from scattered samples, and is not looked for.
    """
    split = Split(box, (), np.zeros(0), np.zeros(0))
    tolerance = TOLERANCE * split.scale(value)[:, None]
    slopes = np.median(gradient, axis=0)  # [nx, nz]
    slopes[np.abs(slopes) * box.width <= tolerance] = 0.0
    slopes[np.abs(gradient - slopes).max(axis=0) * box.width > tolerance] = np.nan
    order = np.random.default_rng(0).permutation(len(z))

    def draw(n: int) -> tuple[Array, Array]:
        nonlocal order
        order = np.roll(order, -n)  # the next rows, so that a fit and its test share none while 2 n <= N
        return z[order[:n]], value[order[:n]]

    return _build(split, slopes, draw, features and len(z) >= 40)


def _build(split: Split, slopes: Array, draw: Draw, features: bool) -> Structure:
    """Known parts and groups from the constant slopes [E, nz] and, for what else is exact, from fresh samples."""
    z = ca.SX.sym("z", split.box.nz)
    known = [_linear(row, z) for row in slopes]
    learned = []
    for group in _grouped((e, np.flatnonzero(np.isnan(row))) for e, row in enumerate(slopes)):
        found = _polynomials(draw, split, group, known, z) if features or not group.variables else {}
        for e, expression in found.items():
            known[e] = known[e] + expression
        left = tuple(e for e in group.entries if e not in found)
        learned += [Group(group.variables, left)] if left else []
    structure = Structure(split, _with_jacobian(z, known), tuple(learned), "", 0)
    return replace(structure, words=describe(structure, known, z))


class _Counter:
    """An oracle that counts its labels."""

    def __init__(self, oracle: Oracle) -> None:
        self.oracle, self.n = oracle, 0

    def __call__(self, x: Array, u: Array) -> Dataset:
        self.n += len(x)
        return self.oracle(x, u)


def affine_split(oracle: Oracle, box: Box, rng: np.random.Generator, probes: int = 64) -> Split:
    """The largest set of controls whose columns of df/dz do not change with any control of the set."""
    base = box.sample(probes, rng)
    _, J = label(oracle, base, box.nx)
    tolerance = TOLERANCE * np.maximum((np.abs(J) * box.width).max(axis=(0, 2)), np.finfo(np.float64).tiny)  # [nx]
    conflict = np.zeros((box.nz, box.nz), dtype=bool)  # [l, k]: column l changes with k
    for k in range(box.nx, box.nz):
        _, moved = label(oracle, _moved(base, box, k, rng), box.nx)
        change = np.abs(moved - J).max(axis=0) * box.width  # [nx, nz]
        conflict[:, k] = (change > tolerance[:, None]).any(axis=0)
    conflict |= conflict.T
    affine = _largest_free(conflict, [k for k in range(box.nx, box.nz) if not conflict[k, k]])
    w = list(affine)
    w0 = np.clip(0.0, box.lb[w], box.ub[w])
    up, down = box.ub[w] - w0, box.lb[w] - w0
    return Split(box, affine, w0, np.where(up >= -down, up, down))


def _largest_free(conflict: NDArray[np.bool_], candidates: Sequence[int]) -> tuple[int, ...]:
    """The largest subset without a conflicting pair, the first of equals; beyond 12 candidates, a greedy one."""
    if len(candidates) > 12:
        chosen: list[int] = []
        for k in sorted(candidates, key=lambda k: int(conflict[k, candidates].sum())):
            chosen += [] if conflict[k, chosen].any() else [k]
        return tuple(sorted(chosen))
    for size in range(len(candidates), 0, -1):
        for subset in combinations(candidates, size):
            if not conflict[np.ix_(subset, subset)].any():
                return subset
    return ()


def _moved(z: Array, box: Box, k: int, rng: np.random.Generator) -> Array:
    """z with variable k moved by 1/5 to 4/5 of its range, cyclically."""
    moved = z.copy()
    moved[:, k] = box.lb[k] + (z[:, k] - box.lb[k] + box.width[k] * rng.uniform(0.2, 0.8, len(z))) % box.width[k]
    return moved


def _slopes(oracle: Oracle, split: Split, rng: np.random.Generator, probes: int) -> Array:
    """Each entry's constant slope in each variable: 0 where it does not enter, NaN where the slope varies. [E, nz]

    Both the values under one-at-a-time moves and the gradients must agree, so that steps and dead zones are seen.
    """
    box = split.box
    z = box.sample(probes, rng)
    value, gradient = split.labels(oracle, z)
    slopes = np.zeros((split.n_entries, box.nz))
    for k in split.rest:
        moved = _moved(z, box, k, rng)
        value_k, gradient_k = split.labels(oracle, moved)
        tolerance = TOLERANCE * split.scale(np.concatenate([value, value_k]))
        every = np.concatenate([gradient[:, :, k], gradient_k[:, :, k]])  # [2 N, E]
        slope = np.median(every, axis=0)
        slope[np.abs(slope) * box.width[k] <= tolerance] = 0.0
        surprise = np.abs(value_k - value - slope * (moved - z)[:, k, None]).max(axis=0)
        varies = (np.abs(every - slope).max(axis=0) * box.width[k] > tolerance) | (surprise > tolerance)
        slopes[:, k] = np.where(varies, np.nan, slope)
    return slopes


def _linear(slopes: Array, z: ca.SX) -> ca.SX:
    return sum((float(s) * z[k] for k, s in enumerate(slopes) if np.isfinite(s) and s != 0), ca.SX(0))


def _grouped(entries: Iterable[tuple[int, Array]]) -> list[Group]:
    """Entries by the variables in which they are not linear, in the order of their first entry."""
    groups: dict[tuple[int, ...], list[int]] = {}
    for e, variables in entries:
        groups.setdefault(tuple(int(k) for k in variables), []).append(e)
    return [Group(variables, tuple(members)) for variables, members in groups.items()]


def _polynomials(draw: Draw, split: Split, group: Group, known: Sequence[ca.SX], z: ca.SX) -> dict[int, ca.SX]:
    """The group's entries that are polynomials in features, of the lowest degree that holds at fresh points."""
    found: dict[int, ca.SX] = {}
    for degree in range(MAX_DEGREE + 1 if group.variables else 1):
        terms = _monomials(split.box, group.variables, z, degree)
        left = [e for e in group.entries if e not in found]
        if len(terms) > MAX_TERMS or not left:
            break
        (fit, fit_value), (test, test_value) = draw(2 * len(terms) + 20), draw(2 * len(terms) + 20)
        if len(fit) < len(terms) + 20:  # data ran out
            break
        linear, basis = _with_jacobian(z, [known[e] for e in left]), _with_jacobian(z, terms)
        fit_target = fit_value[:, left] - evaluate(linear, fit)[0]
        test_target = test_value[:, left] - evaluate(linear, test)[0]
        fit_basis, test_basis = evaluate(basis, fit)[0], evaluate(basis, test)[0]
        tolerance = TOLERANCE * split.scale(np.concatenate([fit_value, test_value]))[left]
        for i, e in enumerate(left):
            c = _sparse_fit(fit_basis, fit_target[:, i], float(tolerance[i]))
            if np.abs(test_basis @ c - test_target[:, i]).max() <= tolerance[i]:
                found[e] = sum((float(a) * t for a, t in zip(c, terms, strict=True) if a != 0), ca.SX(0))
    return found


def _sparse_fit(basis: Array, target: Array, tolerance: float) -> Array:
    """Least squares, then again on the terms that matter: coefficients [T], exactly zero elsewhere."""
    size = np.maximum(np.abs(basis).max(axis=0), np.finfo(np.float64).tiny)
    c = np.linalg.lstsq(basis / size, target, rcond=None)[0]
    keep = np.abs(c) > tolerance
    sparse = np.zeros(len(size))
    if keep.any():
        sparse[keep] = np.linalg.lstsq(basis[:, keep] / size[keep], target, rcond=None)[0]
    return sparse / size


def _monomials(box: Box, variables: Sequence[int], z: ca.SX, degree: int) -> list[ca.SX]:
    """Products of at most `degree` features: the variables, and sin and cos of angles (sin^2 = 1 - cos^2 left out)."""
    features = []  # (expression, index of the angle whose sine it is)
    for k in variables:
        features += [(ca.sin(z[k]), k), (ca.cos(z[k]), None)] if k in box.angles else [(z[k], None)]
    terms = []
    for d in range(degree + 1):
        for chosen in combinations_with_replacement(range(len(features)), d):
            sines = [features[c][1] for c in chosen if features[c][1] is not None]
            if len(set(sines)) == len(sines):
                terms.append(_product([features[c][0] for c in chosen]))
            if len(terms) > MAX_TERMS:
                return terms
    return terms


def _product(factors: Sequence[ca.SX]) -> ca.SX:
    product = ca.SX(1)
    for factor in factors:
        product = product * factor
    return product


def describe(structure: Structure, known: Sequence[ca.SX], z: ca.SX) -> str:
    """The structure in words: which controls are affine, which equations are exact, what is learned of which variables."""
    split, box = structure.split, structure.split.box
    if not structure.found:
        return "no structure found: one network of all variables"
    named = [ca.SX.sym(name) for name in box.names]
    learned = {e for group in structure.groups for e in group.entries}
    expressions = ca.substitute(list(known), [z], [ca.vertcat(*named)])
    words = [f"affine in {', '.join(box.names[k] for k in split.affine)}"] if split.affine else []
    exact = [i for i in range(box.nx) if not learned & set(range(i * split.columns, (i + 1) * split.columns))]
    for i in exact:
        row = split.combine([expressions[e] if e // split.columns == i else ca.SX(0) for e in range(split.n_entries)],
                            ca.vertcat(*named))[i]
        words.append(f"d {box.names[i]}/dt = {_short(row)} exact")
    for group in structure.groups:
        what = ", ".join(_entry(split, e) for e in group.entries)
        words.append(f"{what} learned as functions of ({', '.join(box.names[k] for k in group.variables)})")
    return "; ".join(words)


def _short(expression: ca.SX, length: int = 60) -> str:
    text = str(expression)
    return text if len(text) <= length and "@" not in text else "a closed form"


def _entry(split: Split, e: int) -> str:
    i, j = divmod(e, split.columns)
    row = f"d {split.box.names[i]}/dt"
    if not split.affine:
        return row
    at = ", ".join(f"{split.box.names[k]} = {w:g}" for k, w in zip(split.affine, split.w0, strict=True))
    return f"{row} at {at}" if j == 0 else f"the slope of {row} in {split.box.names[split.affine[j - 1]]}"
