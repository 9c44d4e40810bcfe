"""Structure of xdot = f(x, u) read off labels: which controls enter affinely, which entries are known exactly.

Only label *values* are used, never the equations: f is a black box that answers z = (x, u) with f(z) and df/dz.

Notation: w are the controls of the affine set S (the largest set whose Jacobian columns do not depend on S), w0 the
point of [lb, ub] nearest to 0, h_j the longest step from there inside the box, r the other variables. Then

    f(z) = E_0(r) + sum_j E_j(r) (w_j - w0_j) / h_j,    E_0 = f(r, w0),    E_j = f(r, w0 + h_j e_j) - E_0,

and the labels of the entries E (nx (1 + |S|) functions of r, in the units of xdot) are differences of labels of f.
An entry's variables are those that change it; one whose slope is the same everywhere is split off as an exact linear
term; what is a polynomial in the other variables and the sines and cosines of angles is found by least squares and
kept if it holds at fresh points. An entry that is such a polynomial in *some* of its variables is expanded,

    E(r) = known(r) + sum_t C_t(the others) M_t(those),

with labels of the coefficients C_t by interpolation between labels of f, and the coefficients are treated as entries
were. What is left is grouped by its variables, one network a group: cart-pole is left with six functions of theta.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial, reduce
from itertools import combinations, combinations_with_replacement, product
from operator import mul

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from nocl.data import Dataset
from nocl.definition import pretty
from nocl.support.checks import Array
from nocl.translate.arguments import Arguments

Oracle = Callable[[Array, Array], Dataset]  # x [N, nx], u [N, nu] -> labels with Jacobians
LabelFunction = Callable[[Array], tuple[Array, Array]]  # z [N, nz] -> values [N, E] and gradients [N, E, nz]
Draw = Callable[[int], tuple[Array, Array]]  # n -> fresh rows z [n, nz] and their entries [n, E]

TOLERANCE = 1e-9  # of the largest |f_i|: above rounding, far below anything that matters
MAX_TERMS = 400  # of a polynomial in features
MAX_DEGREE = 4
MAX_EXPANDED = 81  # monomials of an expansion


@dataclass(frozen=True, eq=False)
class Variables:
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

    def arguments(self) -> Arguments:
        """(x, u), new SX symbols: what f is a function of."""
        return Arguments.new(ca.SX, x=self.nx, u=self.nz - self.nx)

    def sample(self, n: int, rng: np.random.Generator) -> Array:
        """n uniform rows z [n, nz]."""
        return rng.uniform(self.lb, self.ub, (n, self.nz))


@dataclass(frozen=True, eq=False)
class Split:
    """f(z) = E_0(r) + sum_j E_j(r) (w_j - w0_j) / h_j; entry e = i (1 + |S|) + j is row i of E_j."""

    box: Variables
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
class Expansion:
    """Entries that are polynomials in some variables: E = known + sum_t C_t(the others) M_t(these), t = 0, ..., T-1.

    Coefficient c = e T + t is C_t of the e-th entry. Without variables, T = 1 and the coefficients are the entries.
    """

    box: Variables
    entries: tuple[int, ...]
    variables: tuple[int, ...] = ()  # indices into z
    degrees: tuple[int, ...] = ()  # of each variable; angles: 1, in sin and cos

    @property
    def terms(self) -> int:
        """T"""
        return math.prod(len(_nodes(self.box, k, d)) for k, d in zip(self.variables, self.degrees, strict=True))

    def monomials(self, z: ca.SX) -> list[ca.SX]:
        """M_t, T products of powers of z_k / max |z_k|, or of sin and cos of angles."""
        parts = [_powers(self.box, k, d, z) for k, d in zip(self.variables, self.degrees, strict=True)]
        return [_product(factors) for factors in product(*parts)]

    def labels(self, entries: LabelFunction, z: Array) -> tuple[Array, Array]:
        """Coefficients [N, n T] and their gradients [N, n T, nz] at rows z, from T labels of the entries a row."""
        axes = [_nodes(self.box, k, d) for k, d in zip(self.variables, self.degrees, strict=True)]
        nodes = np.array(list(product(*axes)))  # [T, |variables|]
        T, own, p = len(nodes), list(self.entries), list(self.variables)
        rows = np.repeat(z[None], T, axis=0)  # [T, N, nz]
        rows[:, :, p] = nodes[:, None, :]
        value, gradient = entries(rows.reshape(-1, self.box.nz))
        value = value[:, own].reshape(T, len(z), len(own))
        gradient = gradient[:, own].reshape(T, len(z), len(own), -1)
        symbol = ca.SX.sym("z", self.box.nz)
        basis = evaluate(with_jacobian(symbol, self.monomials(symbol)), rows[:, 0])[0]  # [T nodes, T terms]
        interpolate = np.linalg.inv(basis)  # [T terms, T nodes]
        value = np.einsum("ts,sne->net", interpolate, value)
        gradient = np.einsum("ts,snek->netk", interpolate, gradient)
        gradient[..., p] = 0.0
        return value.reshape(len(z), -1), gradient.reshape(len(z), len(own) * T, -1)


def _nodes(box: Variables, k: int, degree: int) -> Array:
    """Values of variable k that determine a polynomial of this degree; of an angle, a sine and a cosine."""
    centre, half = (box.lb[k] + box.ub[k]) / 2, box.width[k] / 2
    if k in box.angles:
        return centre + np.array([-1.0, 0.0, 1.0]) * min(2 * half, 2 * np.pi) / 3
    return centre + half * np.cos(np.pi * np.arange(degree + 1) / max(degree, 1))[::-1]


def _powers(box: Variables, k: int, degree: int, z: ca.SX) -> list[ca.SX]:
    if k in box.angles:
        return [ca.SX(1), ca.sin(z[k]), ca.cos(z[k])]
    unit = z[k] / max(abs(box.lb[k]), abs(box.ub[k]))
    return [unit**d for d in range(degree + 1)]


@dataclass(frozen=True)
class Group:
    """Coefficients that are functions of the same variables, to be learned by one network."""

    variables: tuple[int, ...]  # indices into z
    coefficients: tuple[int, ...]  # numbered through all expansions


@dataclass(frozen=True, eq=False)
class Structure:
    """What the labels say about f: E(z) = known(z) + sum over coefficients of M(z) times what a network must learn."""

    split: Split
    linear: ca.Function  # z -> (entries' linear and polynomial parts [E], Jacobian), SX: what expansions start from
    expansions: tuple[Expansion, ...]
    exact: ca.Function  # z -> (the coefficients' exact parts [C], Jacobian), SX
    groups: tuple[Group, ...]
    words: str
    labels: int  # of f, that were used

    @property
    def found(self) -> bool:
        """False where f is left as it is, to one network of all variables."""
        box = self.split.box
        return bool(self.split.affine) or self.expansions != (Expansion(box, tuple(range(box.nx))),) \
            or self.groups != (Group(tuple(range(box.nz)), tuple(range(box.nx))),)

    @property
    def cost(self) -> int:
        """Labels of f that one row of coefficient labels takes."""
        return self.split.columns * sum(expansion.terms for expansion in self.expansions)

    def rows(self, group: Group) -> tuple[int, ...]:
        """The rows of xdot that the group's coefficients are in."""
        own = self.owners()
        return tuple(sorted({own[c] // self.split.columns for c in group.coefficients}))

    def controls(self, group: Group) -> tuple[int, ...]:
        """The affine controls that the group's coefficients are multiplied by, as indices into z."""
        own, columns = self.owners(), self.split.columns
        return tuple(sorted({self.split.affine[j - 1] for c in group.coefficients if (j := own[c] % columns)}))

    def owners(self) -> list[int]:
        """The entry that each coefficient belongs to."""
        return [e for expansion in self.expansions for e in expansion.entries for _ in range(expansion.terms)]

    def residual(self, oracle: Oracle, z: Array) -> tuple[Array, Array]:
        """The networks' labels: coefficients [N, C] and gradients [N, C, nz] at rows z, less their exact parts."""
        if not self.expansions:
            return np.zeros((len(z), 0)), np.zeros((len(z), 0, self.split.box.nz))
        entries = _less(partial(self.split.labels, oracle), self.linear)
        parts = [expansion.labels(entries, z) for expansion in self.expansions]
        exact, slope = evaluate(self.exact, z)
        value, gradient = (np.concatenate(p, axis=1) for p in zip(*parts, strict=True))
        return value - exact, gradient - slope

    def xdot(self, learned: Mapping[int, ca.SX], z: ca.SX) -> ca.SX:
        """xdot [nx] from the networks' answers, by coefficient."""
        entries = ca.vertsplit(self.linear(z)[0])
        values = ca.vertsplit(self.exact(z)[0]) if self.expansions else []
        c = 0
        for expansion in self.expansions:
            monomials = expansion.monomials(z)
            for e in expansion.entries:
                for monomial in monomials:
                    entries[e] = entries[e] + (values[c] + learned.get(c, ca.SX(0))) * monomial
                    c += 1
        return self.split.combine(entries, z)


def _less(labels: LabelFunction, known: ca.Function) -> LabelFunction:
    """Labels less a known part."""
    def residual(z: Array) -> tuple[Array, Array]:
        (value, gradient), (known_value, slope) = labels(z), evaluate(known, z)
        return value - known_value, gradient - slope

    return residual


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
    return value.T.reshape(len(z), rows), slope.reshape(rows, len(z), z.shape[1]).transpose(1, 0, 2)


def with_jacobian(z: ca.SX, expressions: Sequence[ca.SX]) -> ca.Function:
    column = ca.densify(ca.vertcat(*expressions)) if expressions else ca.SX(0, 1)
    return ca.Function("known", [z], [column, ca.densify(ca.jacobian(column, z))], ["z"], ["value", "jacobian"])


def plain(box: Variables, words: str = "no structure used: one network of all variables") -> Structure:
    """One network z -> f, nothing known."""
    z, zero = ca.SX.sym("z", box.nz), [ca.SX(0)] * box.nx
    group = Group(tuple(range(box.nz)), tuple(range(box.nx)))
    return Structure(Split(box, (), np.zeros(0), np.zeros(0)), with_jacobian(z, zero),
                     (Expansion(box, tuple(range(box.nx))),), with_jacobian(z, zero), (group,), words, 0)


def find(oracle: Oracle, box: Variables, *, seed: int = 0, probes: int = 64, features: bool = True) -> Structure:
    """The structure of the black box f on its box, from some thousand labels.

    With `features`, polynomials in the variables and in sin, cos of angles count as known once they hold at fresh
    points, and entries are expanded where they are such polynomials in some of their variables. Labels without
    Jacobians and labels that are not finite raise ValueError.
    """
    rng, counter = np.random.default_rng(seed), _Counter(oracle)
    split = affine_split(counter, box, rng, probes)
    first = _Pass(box, partial(split.labels, counter), split.scale, split.rest, rng, probes)
    known, left = first.exact(features)
    linear = with_jacobian(first.z, known)
    entries, scale = _less(first.labels, linear), first.size()
    if features:
        expansions = _expansions(box, entries, scale, left, rng, probes)
    else:
        expansions = (Expansion(box, tuple(left)),) if left else ()
    exact: list[ca.SX] = []
    learned: dict[int, tuple[int, ...]] = {}
    for expansion in expansions:
        size = scale[list(expansion.entries)].repeat(expansion.terms)
        rest = tuple(k for k in split.rest if k not in expansion.variables)
        stage = _Pass(box, partial(expansion.labels, entries), _constant(size), rest, rng, probes, first.z)
        found, variables = stage.exact(features)
        learned |= {len(exact) + c: v for c, v in variables.items()}
        exact += found
    structure = Structure(split, linear, expansions, with_jacobian(first.z, exact), _grouped(learned), "", counter.n)
    return replace(structure, words=describe(structure))


def _constant(size: Array) -> Callable[[Array], Array]:
    return lambda _: size


def read(z: Array, value: Array, gradient: Array, box: Variables, *, features: bool = True) -> Structure:
    """The structure that given labels show: rows z [N, nz], f [N, nx], df/dz [N, nx, nz]; constant slopes, polynomials.

    What is affine in the controls cannot be told from scattered samples; see nocl.sysid.affine.
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

    symbol = ca.SX.sym("z", box.nz)
    known, left = _known(box, slopes, draw, split.scale, symbol, range(box.nz), features and len(z) >= 40)
    expansions = (Expansion(box, tuple(left)),) if left else ()
    learned = {c: left[e] for c, e in enumerate(left)}
    structure = Structure(split, with_jacobian(symbol, known), expansions,
                          with_jacobian(symbol, [ca.SX(0)] * len(left)), _grouped(learned), "", len(z))
    return replace(structure, words=describe(structure))


class _Pass:
    """Finds what is exact in a family of functions of z that can be labelled anywhere in the box."""

    def __init__(self, box: Variables, labels: LabelFunction, scale: Callable[[Array], Array], rest: tuple[int, ...],
                 rng: np.random.Generator, probes: int, z: ca.SX | None = None) -> None:
        self.box, self.labels, self.scale, self.rest, self.rng, self.probes = box, labels, scale, rest, rng, probes
        self.z = ca.SX.sym("z", box.nz) if z is None else z

    def size(self) -> Array:
        """What rounding goes with, a number for each function."""
        return self.scale(self.labels(self.box.sample(self.probes, self.rng))[0])

    def draw(self, n: int) -> tuple[Array, Array]:
        z = self.box.sample(n, self.rng)
        return z, self.labels(z)[0]

    def exact(self, features: bool) -> tuple[list[ca.SX], dict[int, tuple[int, ...]]]:
        """(each function's exact part, the variables of those that have more to them)."""
        slopes = _slopes(self.labels, self.scale, self.box, self.rest, self.rng, self.probes)
        return _known(self.box, slopes, self.draw, self.scale, self.z, self.rest, features)


def _known(box: Variables, slopes: Array, draw: Draw, scale: Callable[[Array], Array], z: ca.SX,
           rest: Sequence[int], features: bool) -> tuple[list[ca.SX], dict[int, tuple[int, ...]]]:
    """(exact parts, variables of the others) from constant slopes [E, nz] and, for polynomials, fresh samples."""
    known = [_linear(row, z) for row in slopes]
    variables = {e: tuple(int(k) for k in np.flatnonzero(np.isnan(row))) for e, row in enumerate(slopes)}
    for group in _grouped(variables):
        if features or not group.variables:
            for e, expression in _polynomials(box, draw, scale, group, known, z).items():
                known[e] = known[e] + expression
                del variables[e]
    for e, own in variables.items():
        if not own:  # looked linear at the probes, but is not at fresh points
            known[e], variables[e] = ca.SX(0), tuple(rest)
    return known, variables


def _grouped(variables: Mapping[int, tuple[int, ...]]) -> tuple[Group, ...]:
    """What is a function of the same variables, in the order of the first member."""
    groups: dict[tuple[int, ...], list[int]] = {}
    for c, v in variables.items():
        groups.setdefault(v, []).append(c)
    return tuple(Group(v, tuple(members)) for v, members in groups.items())


def _expansions(box: Variables, entries: LabelFunction, scale: Array, variables: Mapping[int, tuple[int, ...]],
                rng: np.random.Generator, probes: int) -> tuple[Expansion, ...]:
    """The entries by the variables in which they are polynomials of a low degree."""
    union = sorted({k for v in variables.values() for k in v})
    degree = {k: _degrees(box, entries, scale, k, rng, probes) for k in union}
    kinds: dict[tuple[tuple[int, int], ...], list[int]] = {}
    for e, own in variables.items():
        chosen = [(k, int(degree[k][e])) for k in own if degree[k][e] > 0]
        while Expansion(box, (e,), *_columns(chosen)).terms > MAX_EXPANDED:
            chosen.remove(max(chosen, key=lambda c: c[1]))
        kinds.setdefault(tuple(chosen), []).append(e)
    return tuple(Expansion(box, tuple(members), *_columns(chosen)) for chosen, members in kinds.items())


def _columns(pairs: Sequence[tuple[int, int]]) -> tuple[tuple[int, ...], tuple[int, ...]]:
    return tuple(k for k, _ in pairs), tuple(d for _, d in pairs)


def _degrees(box: Variables, entries: LabelFunction, scale: Array, k: int, rng: np.random.Generator,
             probes: int) -> NDArray[np.int_]:
    """The lowest degree up to 3 of each entry in variable k (angles: 1, in sin and cos); 0 where there is none. [E]"""
    z = box.sample(probes, rng)
    values = box.lb[k] + box.width[k] * (np.arange(9) + rng.uniform(0.2, 0.8, 9)) / 9
    rows = np.repeat(z[None], len(values), axis=0)
    rows[:, :, k] = values[:, None]
    labels = entries(rows.reshape(-1, box.nz))[0].reshape(len(values), -1)  # [9, N E]
    symbol = ca.SX.sym("z", box.nz)
    degrees = np.zeros(len(scale), dtype=int)
    for degree in (1,) if k in box.angles else (3, 2, 1):
        basis = evaluate(with_jacobian(symbol, _powers(box, k, degree, symbol)), rows[:, 0])[0]
        error = basis @ np.linalg.lstsq(basis, labels, rcond=None)[0] - labels
        fits = np.abs(error).reshape(-1, len(scale)).max(axis=0) <= TOLERANCE * scale
        degrees[fits] = degree
    return degrees


class _Counter:
    """An oracle that counts its labels."""

    def __init__(self, oracle: Oracle) -> None:
        self.oracle, self.n = oracle, 0

    def __call__(self, x: Array, u: Array) -> Dataset:
        self.n += len(x)
        return self.oracle(x, u)


def affine_split(oracle: Oracle, box: Variables, rng: np.random.Generator, probes: int = 64) -> Split:
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


def _moved(z: Array, box: Variables, k: int, rng: np.random.Generator) -> Array:
    """z with variable k moved by 1/5 to 4/5 of its range, cyclically."""
    moved = z.copy()
    moved[:, k] = box.lb[k] + (z[:, k] - box.lb[k] + box.width[k] * rng.uniform(0.2, 0.8, len(z))) % box.width[k]
    return moved


def _slopes(labels: LabelFunction, scale: Callable[[Array], Array], box: Variables, rest: Sequence[int],
            rng: np.random.Generator, probes: int) -> Array:
    """Each function's constant slope in each variable: 0 where it does not enter, NaN where the slope varies. [E, nz]

    Both the values under one-at-a-time moves and the gradients must agree, so that steps and dead zones are seen.
    """
    z = box.sample(probes, rng)
    value, gradient = labels(z)
    slopes = np.zeros(gradient.shape[1:])
    for k in rest:
        moved = _moved(z, box, k, rng)
        value_k, gradient_k = labels(moved)
        tolerance = TOLERANCE * scale(np.concatenate([value, value_k]))
        every = np.concatenate([gradient[:, :, k], gradient_k[:, :, k]])  # [2 N, E]
        slope = np.median(every, axis=0)
        slope[np.abs(slope) * box.width[k] <= tolerance] = 0.0
        surprise = np.abs(value_k - value - slope * (moved - z)[:, k, None]).max(axis=0)
        varies = (np.abs(every - slope).max(axis=0) * box.width[k] > tolerance) | (surprise > tolerance)
        slopes[:, k] = np.where(varies, np.nan, slope)
    return slopes


def _linear(slopes: Array, z: ca.SX) -> ca.SX:
    return sum((float(s) * z[k] for k, s in enumerate(slopes) if np.isfinite(s) and s != 0), ca.SX(0))


def _polynomials(box: Variables, draw: Draw, scale: Callable[[Array], Array], group: Group, known: Sequence[ca.SX],
                 z: ca.SX) -> dict[int, ca.SX]:
    """Those of a group that are polynomials in features, of the lowest degree that holds at fresh points."""
    found: dict[int, ca.SX] = {}
    for degree in range(MAX_DEGREE + 1 if group.variables else 1):
        terms = _monomials(box, group.variables, z, degree)
        left = [e for e in group.coefficients if e not in found]
        if len(terms) > MAX_TERMS or not left:
            break
        (fit, fit_value), (test, test_value) = draw(2 * len(terms) + 20), draw(2 * len(terms) + 20)
        if len(fit) < len(terms) + 20:  # data ran out
            break
        linear, basis = with_jacobian(z, [known[e] for e in left]), with_jacobian(z, terms)
        fit_target = fit_value[:, left] - evaluate(linear, fit)[0]
        test_target = test_value[:, left] - evaluate(linear, test)[0]
        fit_basis, test_basis = evaluate(basis, fit)[0], evaluate(basis, test)[0]
        tolerance = TOLERANCE * scale(np.concatenate([fit_value, test_value]))[left]
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


def _monomials(box: Variables, variables: Sequence[int], z: ca.SX, degree: int) -> list[ca.SX]:
    """Products of at most `degree` features: the variables, and sin and cos of angles (sin^2 = 1 - cos^2 left out)."""
    features: list[tuple[ca.SX, int | None]] = []  # (expression, index of the angle whose sine it is)
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
    return reduce(mul, factors) if factors else ca.SX(1)


def describe(structure: Structure) -> str:
    """The structure in words: what enters affinely, which equations are exact, what is learned of which variables."""
    if not structure.found:
        return "no structure found: one network of all variables"
    split, box = structure.split, structure.split.box
    words = [f"affine in {_and(box.names[k] for k in split.affine)}"] if split.affine else []
    learned = {c for group in structure.groups for c in group.coefficients}
    rows = {i for g in structure.groups for i in structure.rows(g)}
    polynomial, c = [], 0
    for expansion in structure.expansions:
        n = expansion.terms
        open_entries = [e for j, e in enumerate(expansion.entries) if learned & set(range(c + j * n, c + (j + 1) * n))]
        if open_entries and expansion.variables:
            polynomial.append(_polynomial_words(expansion, split, open_entries))
        c += n * len(expansion.entries)
    words += [f"{_derivative(box, i)} = {_formula(structure, i)} exact" for i in range(box.nx) if i not in rows]
    words += polynomial
    for g in structure.groups:
        of, by = _and(_derivative(box, i) for i in structure.rows(g)), _and(box.names[k] for k in g.variables)
        words.append(f"{_count(len(g.coefficients))} of {of} learned as functions of {by}")
    return "; ".join(words)


def _polynomial_words(expansion: Expansion, split: Split, entries: Sequence[int]) -> str:
    box, how = split.box, {1: "linear", 2: "quadratic", 3: "cubic"}
    kinds = [f"linear in sin and cos of {box.names[k]}" if k in box.angles else f"{how[d]} in {box.names[k]}"
             for k, d in zip(expansion.variables, expansion.degrees, strict=True)]
    return f"{_and(_derivative(box, i) for i in sorted({e // split.columns for e in entries}))} {_and(kinds)}"


def _derivative(box: Variables, i: int) -> str:
    return f"d {box.names[i]}/dt"


def _and(names: Iterable[str]) -> str:
    *most, last = names 
    return f"{', '.join(most)} and {last}" if most else last


def _count(n: int) -> str:
    return "1 coefficient" if n == 1 else f"{n} coefficients"


def _formula(structure: Structure, i: int, length: int = 60) -> str:
    """Row i of xdot where nothing is learned, as text if it is short."""
    z = ca.vertcat(*(ca.SX.sym(name) for name in structure.split.box.names))
    rows, shared = pretty.lines(ca.simplify(structure.xdot({}, z)[i]), z)
    return rows[0] if not shared and len(rows[0]) <= length else "a closed form"
