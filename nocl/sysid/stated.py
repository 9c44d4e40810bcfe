"""What a user states about the equations: some rows of xdot, and whether the controls enter affinely."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np

from nocl.data import Dataset
from nocl.definition.system import System
from nocl.support import checks
from nocl.sysid import structure as structures
from nocl.sysid.affine import split_at
from nocl.sysid.structure import Expansion, Group, Oracle, Split, Structure, Variables

Known = Mapping[str, Any] | Iterable[str]


@dataclass(frozen=True, eq=False)
class Stated:
    """Stated rows of xdot as expressions in z = (x, u), and the control-affine form xdot = a(x) + B(x) u."""

    z: ca.SX  # [nz] symbols
    rows: Mapping[int, ca.SX]
    control_affine: bool

    @staticmethod
    def of(system: System, known: Known | None, control_affine: bool) -> Stated:
        """`known` maps states to derivatives: SX in the system's symbols, numbers, names of states or controls.

        Names of states alone stand for the system's own equations. Raises ValueError for anything else.
        """
        z, rows = ca.vertcat(*system.arguments.inputs), {}
        for name, value in _items(system, known).items():
            if name not in system.state_names:
                raise ValueError(f"identify: known has {name!r}; expected names of states "
                                 f"({', '.join(system.state_names)}), each with its derivative")
            if isinstance(value, str):
                value = _named(system, name, value)
            rows[system.state_names.index(name)] = checks.expression(value, 1, z, f"known[{name!r}]", "identify")
        checks.flag(control_affine, "control_affine", "identify")
        return Stated(z, rows, control_affine)

    def __bool__(self) -> bool:
        return bool(self.rows) or self.control_affine

    def plain(self, box: Variables, words: str = "") -> Structure:
        """The structure that is stated and nothing else: one network of all variables that are left, for all rows."""
        split = Split(box, (), np.zeros(0), np.zeros(0))
        if self.control_affine:
            split = split_at(box, range(box.nx, box.nz))
        open_entries = tuple(e for e in range(split.n_entries) if e // split.columns not in self.rows)
        expansions = (Expansion(box, open_entries),) if open_entries else ()
        groups = (Group(split.rest, tuple(range(len(open_entries)))),) if open_entries else ()
        none = structures.with_jacobian(self.z, [ca.SX(0)] * len(open_entries))
        structure = Structure(split, structures.with_jacobian(self.z, [ca.SX(0)] * split.n_entries), expansions, none,
                              groups, "", 0)
        said = "; ".join(filter(None, [self.words(box), words])) or "no structure used: one network of all variables"
        return replace(self.add(structure), words=said)

    def add(self, structure: Structure) -> Structure:
        """A structure of what is left, `residual`'s, with the stated rows in it again."""
        if not self.rows:
            return structure
        entries = ca.vertsplit(structure.linear(self.z)[0])
        for i, value in self.rows.items():
            entries[i * structure.split.columns] = value
            for j in range(1, structure.split.columns):
                entries[i * structure.split.columns + j] = ca.SX(0)
        return replace(structure, linear=structures.with_jacobian(self.z, entries))

    def residual(self, oracle: Oracle, nx: int) -> Oracle:
        """The oracle with 0 for the stated rows, values and Jacobians: nothing is left to find there."""
        rows = list(self.rows)

        def left(x: checks.Array, u: checks.Array) -> Dataset:
            data = oracle(x, u)
            xdot = data.xdot.copy()
            xdot[:, rows] = 0.0
            A, B = (None if j is None else j.copy() for j in (data.A, data.B))
            for j in (A, B):
                if j is not None:
                    j[:, rows] = 0.0
            return Dataset(data.x, data.u, xdot, A, B)

        return left if rows else oracle

    def words(self, box: Variables) -> str:
        """'stated: d theta/dt = omega; affine in the controls'."""
        said = [f"d {box.names[i]}/dt = {e}" for i, e in self.rows.items()]
        said += ["affine in the controls"] if self.control_affine else []
        left = [f"d {box.names[i]}/dt" for i in range(box.nx) if i not in self.rows]
        return f"stated: {'; '.join(said)}; learned: {', '.join(left) or 'nothing'}" if said else ""


def _items(system: System, known: Known | None) -> dict[str, Any]:
    if known is None:
        return {}
    if isinstance(known, Mapping):
        return dict(known)
    names = [known] if isinstance(known, str) else checks.words(known, "known (or a dict from states to derivatives)",
                                                                "identify")
    bad = [n for n in names if n not in system.state_names]
    if bad:
        raise ValueError(f"identify: known has {bad[0]!r}; expected names of states ({', '.join(system.state_names)}), "
                         "or a dict from them to their derivatives")
    rows = ca.vertsplit(system.equations)
    return {n: rows[system.state_names.index(n)] for n in names}


def _named(system: System, name: str, value: str) -> ca.SX:
    if value not in system.names:
        raise ValueError(f"identify: known[{name!r}] is {value!r}; expected the name of a state or control "
                         f"({', '.join(system.names)}), or an SX expression")
    return ca.vertcat(*system.arguments.inputs)[system.names.index(value)]
