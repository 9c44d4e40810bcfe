"""A structure with its controls taken out of the networks: xdot = a(x) + B(x) u where that is stated, or was tried."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import casadi as ca
import numpy as np

from nocl.sysid.structure import Expansion, Group, Split, Structure, Variables, describe, with_jacobian


def affine_in_controls(found: Structure) -> Structure | None:
    """The structure, its entries rows of xdot, with one more coefficient for each control of a row; None where it has
    no network that sees controls, or one that sees nothing else."""
    box = found.split.box
    w = sorted({k for g in found.groups for k in g.variables if k >= box.nx})
    whole_rows = not found.split.affine and len(found.expansions) == 1 and not found.expansions[0].variables
    if not w or not whole_rows or any(set(g.variables) <= set(w) for g in found.groups):
        return None
    split, z, groups, own = split_at(box, w), ca.SX.sym("z", box.nz), [], list[int]()
    for group in found.groups:
        columns = [0, *(1 + w.index(k) for k in group.variables if k in w)]
        members = [found.expansions[0].entries[c] * split.columns + j for c in group.coefficients for j in columns]
        groups.append(Group(tuple(k for k in group.variables if k not in w),
                            tuple(range(len(own), len(own) + len(members)))))
        own += members
    known = with_jacobian(z, _known(found, split, z))
    structure = Structure(split, known, (Expansion(box, tuple(own)),), with_jacobian(z, [ca.SX(0)] * len(own)),
                          tuple(groups), "", found.labels)
    return replace(structure, words=describe(structure))


def stated_affine(found: Structure) -> Structure | None:
    """The structure where the controls are stated to be affine; None where networks would see controls alone.

    ValueError where a closed form that the labels show contradicts the statement.
    """
    box = found.split.box
    z = ca.SX.sym("z", box.nz)
    for name, row in zip(box.names, ca.vertsplit(found.linear(z)[0]), strict=False):
        if ca.jacobian(ca.jacobian(row, z[box.nx:]), z[box.nx:]).nnz():
            raise ValueError(f"identify: the labels show that d {name}/dt is not affine in the controls; expected "
                             "xdot = a(x) + B(x) u: leave control_affine out")
    sees_controls = any(k >= box.nx for group in found.groups for k in group.variables)
    return affine_in_controls(found) if sees_controls else found


def split_at(box: Variables, w: Sequence[int]) -> Split:
    """The split by these affine controls, each from the point nearest to 0 to the farther end of its bounds."""
    w0 = np.clip(0.0, box.lb[list(w)], box.ub[list(w)])
    up, down = box.ub[list(w)] - w0, box.lb[list(w)] - w0
    return Split(box, tuple(w), w0, np.where(up >= -down, up, down))


def _known(found: Structure, split: Split, z: ca.SX) -> list[ca.SX]:
    """The known entries of the new split: those of learned rows are linear, and come apart; the others stay whole."""
    learned, entries = set(found.expansions[0].entries), []
    for i, row in enumerate(ca.vertsplit(found.linear(z)[0])):
        if i not in learned:
            entries += [row, *[ca.SX(0)] * len(split.affine)]
            continue
        w = ca.vertcat(*(z[k] for k in split.affine))
        entries += [ca.substitute(row, w, ca.DM(split.w0)),
                    *(ca.jacobian(row, z[k]) * h for k, h in zip(split.affine, split.h, strict=True))]
    return entries
