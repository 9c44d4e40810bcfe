"""Where the labels of system identification come from: the system as a black box, or given data."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np

from nocl.data import Dataset
from nocl.definition.sampling import Distribution, open_box
from nocl.definition.system import System
from nocl.support.checks import Array
from nocl.support.fingerprint import fingerprint
from nocl.sysid import structure as structures
from nocl.sysid.affine import stated_affine
from nocl.sysid.settings import Settings
from nocl.sysid.stated import Stated
from nocl.sysid.structure import Oracle, Structure, Variables

CHUNK = 100_000  # labels of f held at a time
MIN_ROWS = 2048  # of labels, however many labels of f one takes


def widened(system: System, parameters: Distribution | None) -> System:
    """The system with its parameters after its controls, in the box of their distribution; itself where it has none."""
    return system if parameters is None else system.with_inputs(*open_box(parameters))


def box_of(system: System) -> Variables:
    lb, ub = np.r_[system.lbx, system.lbu], np.r_[system.ubx, system.ubu]
    return Variables(system.names, lb, ub, system.nx, system.angle_indices)


@dataclass(eq=False)
class Source:
    """Where labels come from: the system as a black box, or given data."""

    box: Variables
    gradients: bool
    oracle: Oracle | None  # counts what it is asked
    data: tuple[Array, Array, Array | None] | None  # z, f, df/dz
    labels: int = 0

    @property
    def digest(self) -> str:
        """A fingerprint of the given data; empty where labels are drawn."""
        return fingerprint(*self.data) if self.data else ""

    @staticmethod
    def of(system: System, data: Dataset | None, gradients: bool) -> Source:
        if data is not None:
            z, value, gradient = _checked_data(system, data)
            return Source(data_box(system, z), gradients and gradient is not None, None,
                           (z, value, gradient if gradients else None), len(z))
        source = Source(box_of(system), gradients, None, None)

        def oracle(x: Array, u: Array) -> Dataset:
            source.labels += len(x)
            return Dataset.label(system, x, u)

        source.oracle = oracle
        return source


def _checked_data(system: System, data: Dataset) -> tuple[Array, Array, Array | None]:
    """(z [N, nz], xdot [N, nx], Jacobians [N, nx, nz] or None) of a Dataset; ValueError where it is of other sizes."""
    if not isinstance(data, Dataset):
        raise ValueError(f"identify: data is a {type(data).__name__}; expected a nocl.Dataset(x, u, xdot, A, B)")
    n = len(data)
    if n < 2:
        raise ValueError(f"identify: data has {n} samples; expected at least 2, better thousands")
    if (data.A is None) != (data.B is None):
        raise ValueError("identify: data has only one of the Jacobians A and B; expected both or neither")
    for name, array, columns in (("x", data.x, system.nx), ("u", data.u, system.nu)):
        if array.shape[1] != columns:
            raise ValueError(f"identify: data.{name} has shape {array.shape}; expected {(n, columns)} for "
                             f"{system.name!r}")
    z = np.hstack([data.x, data.u])
    return z, data.xdot, None if data.A is None or data.B is None else np.concatenate([data.A, data.B], axis=2)


def data_box(system: System, z: Array) -> Variables:
    """The box that the data fill; the system's where they do not vary."""
    box, lb, ub = box_of(system), z.min(axis=0), z.max(axis=0)
    still = ub - lb <= 1e-9 * box.width
    return replace(box, lb=np.where(still, box.lb, lb), ub=np.where(still, box.ub, ub))


def find_structure(source: Source, settings: Settings, seed: int, stated: Stated) -> Structure:
    """What the labels show, beside what is stated."""
    if not settings.structure:
        return stated.plain(source.box)
    if not source.gradients:
        return stated.plain(source.box, "without Jacobian labels no structure was looked for: "
                                        "one network of all variables")
    if source.oracle is not None:
        left = stated.residual(source.oracle, source.box.nx)
        found = structures.find(left, source.box, seed=seed, probes=settings.probes, features=settings.features)
        bent = [source.box.names[k] for k in range(source.box.nx, source.box.nz) if k not in found.split.affine]
        if stated.control_affine and bent:
            raise ValueError(f"identify: the labels show that xdot is not affine in {', '.join(bent)}; expected xdot = "
                             "a(x) + B(x) u: leave control_affine out")
    else:
        assert source.data is not None
        z, value, gradient = source.data
        assert gradient is not None
        value, gradient = value.copy(), gradient.copy()
        value[:, list(stated.rows)], gradient[:, list(stated.rows)] = 0.0, 0.0
        found = structures.read(z, value, gradient, source.box, features=settings.features)
        if stated.control_affine:
            affine = stated_affine(found)
            if affine is None:
                return stated.plain(source.box)
            found = affine
    if not stated.rows:
        return found
    whole = stated.add(found)
    return replace(whole, words=structures.describe(whole))


def some_labels(source: Source, n: int, seed: int) -> tuple[Array, Array, Array | None]:
    """(z, xdot, df/dz or None) at n rows: of the data, or drawn."""
    rng = np.random.default_rng((seed, 5))
    if source.data is not None:
        rows = rng.permutation(len(source.data[0]))[:n]
        z, value, gradient = source.data
        return z[rows], value[rows], None if gradient is None else gradient[rows]
    assert source.oracle is not None
    z = source.box.sample(n, rng)
    data = source.oracle(z[:, :source.box.nx], z[:, source.box.nx:])
    if not source.gradients or data.A is None or data.B is None:
        return z, data.xdot, None
    return z, data.xdot, np.concatenate([data.A, data.B], axis=2)


@dataclass(frozen=True, eq=False)
class LabelPool:
    """What the networks learn from: rows z, and by group labels of its coefficients, or (mixed) of its rows of xdot.

    Gradients are by the group's variables, those of mixed labels by its affine controls after them.
    """

    z: Array  # [N, nz]
    value: list[Array]  # per group [N, m]
    gradient: list[Array] | None  # per group [N, m, v]
    mixed: bool = False


def draw_pool(source: Source, parts: Structure, settings: Settings, rng: np.random.Generator) -> LabelPool:
    """Labels for every group: at fresh uniform samples of the box, or all of the data."""
    if source.data is not None:
        return _given(*source.data, parts)
    assert source.oracle is not None
    z = source.box.sample(rows_of(parts, settings), rng)
    return labelled(source, parts, z)


def _given(z: Array, value: Array, gradient: Array | None, parts: Structure) -> LabelPool:
    """Data less what is known: coefficients themselves where each has a row of xdot of its own."""
    symbol = ca.SX.sym("z", parts.split.box.nz)
    known, slope = structures.evaluate(structures.with_jacobian(symbol, [parts.xdot({}, symbol)]), z)
    values, slopes = [], []
    for group in parts.groups:
        rows, variables = list(parts.rows(group)), [*group.variables, *parts.controls(group)]
        values.append((value - known)[:, rows])
        if gradient is not None:
            slopes.append((gradient[:, rows] - slope[:, rows])[:, :, variables])
    return LabelPool(z, values, None if gradient is None else slopes, bool(parts.split.affine))


def rows_of(parts: Structure, settings: Settings) -> int:
    """How many rows the budget of labels buys."""
    return max(settings.samples // parts.cost, MIN_ROWS)


def labelled(source: Source, parts: Structure, z: Array) -> LabelPool:
    """The black box's labels at rows z."""
    assert source.oracle is not None
    chunks = ((r, *parts.residual(source.oracle, r)) for r in np.array_split(z, -(-len(z) * parts.cost // CHUNK)))
    return _collect(chunks, parts, source.gradients)


def _collect(chunks: Iterable[tuple[Array, Array, Array]], parts: Structure, gradients: bool) -> LabelPool:
    rows, values, slopes = [], [], []
    for z, value, gradient in chunks:
        rows.append(z)
        values.append([value[:, g.coefficients] for g in parts.groups])
        slopes.append([gradient[:, g.coefficients][:, :, g.variables] for g in parts.groups] if gradients else [])
    join = [[np.concatenate(part) for part in zip(*pieces, strict=True)] for pieces in (values, slopes)]
    return LabelPool(np.concatenate(rows), join[0], join[1] if gradients else None)
