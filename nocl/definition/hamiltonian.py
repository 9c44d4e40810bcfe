"""The Hamiltonian's minimiser over the box U, derived from an OCP's own symbols: u*(x, p) = argmin L(x, u) + p'f(x, u),
p the costate.

Where H is quadratic in u (f affine or bilinear in u, L quadratic) the minimum over the box is known exactly, convex or
not: it lies at the stationary point of one of the box's faces (a corner, an edge, ..., the inside), and with H
separable in u each control is found by itself. The answer is one SX function, so that CasADi, JAX and torch share it.
"""

from __future__ import annotations

import itertools
from typing import Any

import casadi as ca

from nocl.definition.ocp import OCP

FACES = 4  # most controls that are coupled in H for all 3^nu faces to be written out


def hamiltonian(ocp: OCP) -> ca.Function:
    """(x, u, costate) -> H = L + costate'f with path constraints as OCP.L_soft has them, a scalar."""
    ocp.refuse_constraints("hamiltonian")
    at, costate = ocp.functions.stage, ca.SX.sym("costate", ocp.system.nx)
    return at.function("hamiltonian", {"H": at.hamiltonian(costate)}, costate=costate)


def minimiser(ocp: OCP) -> ca.Function | None:
    """(x, costate) -> (u*, H there), exact; None where H is not quadratic in u, or couples more than FACES controls."""
    ocp.refuse_constraints("minimiser")
    s, at, costate = ocp.system, ocp.functions.stage, ca.SX.sym("costate", ocp.system.nx)
    H: Any = at.hamiltonian(costate)
    Q, g = ca.hessian(H, at.u)
    if ca.depends_on(Q, at.u):
        return None
    rest, g = (ca.substitute(e, at.u, ca.SX.zeros(s.nu)) for e in (H, g))
    quadratic = _Quadratic(ca.densify(Q), ca.densify(g), s.lbu, s.ubu)
    if not Q.sparsity().is_diag():
        if s.nu > FACES:
            return None
        u = quadratic.over_faces()
    else:
        u = ca.vertcat(*map(quadratic.alone, range(s.nu)))
    return at.but("u").function("minimiser", {"u": u, "H": rest + quadratic.value(u)}, costate=costate)


class _Quadratic:
    """g'u + u'Qu / 2 on the box."""

    def __init__(self, Q: Any, g: Any, lb: ca.DM, ub: ca.DM) -> None:
        self.Q, self.g, self.lb, self.ub = Q, g, ca.DM(lb), ca.DM(ub)

    def value(self, u: ca.SX) -> ca.SX:
        return ca.dot(self.g + ca.mtimes(self.Q, u) / 2, u)

    def alone(self, i: int) -> ca.SX:
        """The i-th control where no other one is coupled to it: the clipped vertex of a parabola, or the better end."""
        q, g, lb, ub = self.Q[i, i], self.g[i], self.lb[i], self.ub[i]
        convex = q > 0
        vertex = ca.fmin(ca.fmax(-g / ca.if_else(convex, q, 1.0), lb), ub)
        if q.is_constant():
            return vertex if float(q) > 0 else self._end(i)
        return ca.if_else(convex, vertex, self._end(i))

    def _end(self, i: int) -> ca.SX:
        q, g, lb, ub = self.Q[i, i], self.g[i], self.lb[i], self.ub[i]
        return ca.if_else((g + q * (ub + lb) / 2) * (ub - lb) > 0, lb, ub)

    def over_faces(self) -> ca.SX:
        """The best of the faces' stationary points, each clipped into the box (so that a point of no use does no harm).

        Where the controls that are free on a face have a singular Q, the minimum is also taken on a smaller face.
        """
        n = self.g.numel()
        best, lowest = ca.SX(self.lb), self.value(ca.SX(self.lb))
        for face in itertools.product("lu-", repeat=n):
            if all(side == "l" for side in face):
                continue
            u = self._stationary(face)
            H = self.value(u)
            better = ca.lt(H, lowest)
            best = ca.vertcat(*(ca.if_else(better, u[i], best[i]) for i in range(n)))
            lowest = ca.if_else(better, H, lowest)
        return best

    def _stationary(self, face: tuple[str, ...]) -> ca.SX:
        free = [i for i, side in enumerate(face) if side == "-"]
        ends = {"l": self.lb, "u": self.ub, "-": ca.DM.zeros(len(face))}
        u = ca.SX(ca.vertcat(*(ends[side][i] for i, side in enumerate(face))))
        if free:
            slope = self.g[free] + ca.mtimes(self.Q[free, :], u)
            u[free] = -ca.mtimes(ca.inv_minor(self.Q[free, free]), slope)
        return ca.fmin(ca.fmax(u, self.lb), self.ub)
