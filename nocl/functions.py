"""The one door to a problem's functions: f, L, L_soft, h, G and what is derived from them, by name.

A stage is one moment of a problem: f and L stand there as functions of (x, u). A node is where path constraints hold,
h(x), and the end is where G(x) does. What acts on the problem, a policy or a value, is a function of (x, t). Each of
these four is an `Arguments`, and all that is built from the problem anywhere is built on them:

    at = ocp.functions.stage
    ocp.functions.f, .jacobian, .L, .L_soft, .h, .G, .L_derivatives ...   # ready CasADi functions
    at.xdot, at.L, at.L_soft, at.interval(h)                              # expressions in the stage's symbols
    at.function("H_u", {"H_u": ca.gradient(H, at.u)}, costate=costate)    # of (x, u, costate)
    ocp.functions.on(f_theta.to_casadi())                                 # the same problem under another f

So an argument that f or L gains is written here, and where callers have its data.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import casadi as ca

from nocl.system import System
from nocl.translate.arguments import Arguments
from nocl.translate.rk4 import rk4_cost


@dataclass(frozen=True, eq=False)
class Functions:
    """Those of one problem; made by OCP.functions, from expressions in the system's own symbols."""

    system: System
    running: ca.SX  # L(x, u)
    soft: ca.SX  # L_soft(x, u)
    constraints: ca.SX  # h(x), a column
    terminal: ca.SX  # G(x)
    dynamics: ca.Function | None = None  # (x, u) -> xdot in place of the system's own f

    def on(self, dynamics: ca.Function) -> Functions:
        """The same problem under another f."""
        known = self.dynamics is not None or self.system.xdot is not None
        return self if known and dynamics is self.f else replace(self, dynamics=dynamics)

    @cached_property
    def stage(self) -> Stage:
        """(x, u): in SX, or in MX where f is."""
        own = self.system.arguments
        if self.dynamics is None or self.dynamics.is_a("SXFunction"):
            return Stage(own.symbols, self)
        return Stage(Arguments.new(ca.MX, **{n: s.numel() for n, s in own.symbols.items()}).symbols, self)

    @property
    def node(self) -> Arguments:
        """x, in SX: what `constraints` is an expression in."""
        return self.system.arguments.but("u")

    @property
    def end(self) -> Arguments:
        """x, in SX: what `terminal` is an expression in."""
        return self.system.arguments.but("u")

    def feedback(self, kind: Any = ca.SX) -> Arguments:
        """(x, t), new symbols of a kind, ca.SX or ca.MX: what policies and values are functions of."""
        return Arguments.new(kind, x=self.system.nx, t=1)

    @cached_property
    def f(self) -> ca.Function:
        """(x, u) -> xdot."""
        own, f = self.system.arguments, self.dynamics
        if f is None or f.name_in() == own.names:
            return self.system.f if f is None else f
        given = Arguments.of(f).inputs
        return Arguments(dict(zip(own.names, given, strict=True))).function(f.name(), {"xdot": f(*given)})

    @cached_property
    def jacobian(self) -> ca.Function:
        """(x, u) -> (A [nx, nx] = df/dx, B [nx, nu] = df/du), dense."""
        if self.dynamics is None:
            return self.system.jacobian
        at = self.stage
        return at.function("jacobian", {"A": ca.densify(ca.jacobian(at.xdot, at.x)),
                                        "B": ca.densify(ca.jacobian(at.xdot, at.u))})

    @cached_property
    def L(self) -> ca.Function:
        """(x, u) -> running cost, a scalar."""
        return self.system.arguments.function("L", {"L": self.running})

    @cached_property
    def L_soft(self) -> ca.Function:
        """(x, u) -> running cost with the penalty of the path constraints."""
        return self.system.arguments.function("L_soft", {"L": self.soft})

    @cached_property
    def h(self) -> ca.Function:
        """x -> path constraints [number of them], each >= 0 where it holds."""
        return self.node.function("h", {"h": self.constraints})

    @cached_property
    def G(self) -> ca.Function:
        """x -> terminal cost, a scalar."""
        return self.end.function("G", {"G": self.terminal})

    @cached_property
    def L_derivatives(self) -> ca.Function:
        """(x, u) -> (L, L_z [nz], L_zz [nz, nz]), z = (x, u), dense; without the penalty."""
        own = self.system.arguments
        H, g = ca.hessian(self.running, ca.vertcat(own["x"], own["u"]))
        return own.function("L_derivatives", _dense({"L": self.running, "L_z": g, "L_zz": H}))

    @cached_property
    def G_derivatives(self) -> ca.Function:
        """x -> (G, G_x [nx], G_xx [nx, nx]), dense."""
        H, g = ca.hessian(self.terminal, self.end["x"])
        return self.end.function("G_derivatives", _dense({"G": self.terminal, "G_x": g, "G_xx": H}))

    @cached_property
    def h_derivatives(self) -> ca.Function:
        """(x, mu) -> (h, h_x [n, nx], the Hessian of mu'h [nx, nx]), h_x with its own zeros."""
        h, x = self.constraints, self.node["x"]
        mu = ca.SX.sym("mu", h.numel())
        H = ca.densify(ca.hessian(ca.dot(mu, h), x)[0])
        return self.node.function("h_derivatives", {"h": h, "h_x": ca.jacobian(h, x), "h_xx": H}, mu=mu)

    def step(self, *, soft: bool = True, substeps: int = 1) -> ca.Function:
        """(x, u, h) -> (end, cost) of an interval of length h with u held, by RK4; see Stage.interval."""
        at = self.stage
        h = at.sym("h")
        end, cost = at.interval(h, soft=soft, substeps=substeps)
        return at.function("step", {"end": end, "cost": cost}, h=h)


class Stage(Arguments):
    """One moment of a problem under an f: x and u as symbols, and what stands there as expressions in them."""

    def __init__(self, symbols: Mapping[str, Any], functions: Functions) -> None:
        super().__init__(symbols)
        self.functions = functions
        self.x, self.u = self["x"], self["u"]
        self.z = ca.vertcat(self.x, self.u)

    def sym(self, name: str, size: int = 1) -> Any:
        """A symbol of the stage's kind, for another argument."""
        return (ca.SX if isinstance(self.x, ca.SX) else ca.MX).sym(name, size)

    @cached_property
    def xdot(self) -> Any:
        """f; ValueError where it is not known."""
        of = self.functions
        return of.system.equations if of.dynamics is None else self.call(of.f)

    @property
    def L(self) -> Any:
        return self.functions.running if isinstance(self.x, ca.SX) else self.call(self.functions.L)

    @property
    def L_soft(self) -> Any:
        return self.functions.soft if isinstance(self.x, ca.SX) else self.call(self.functions.L_soft)

    def hamiltonian(self, costate: Any, *, soft: bool = True) -> Any:
        """L + costate'f."""
        return (self.L_soft if soft else self.L) + ca.dot(costate, self.xdot)

    def interval(self, h: Any, *, soft: bool = True, substeps: int = 1) -> tuple[Any, Any]:
        """(x after a time h with u held, the integral of L or L_soft over it), by RK4 steps."""
        of = self.functions
        L = of.L_soft if soft else of.L
        return rk4_cost(lambda x, u: self.given(x=x, u=u).call(of.f), lambda x, u: self.given(x=x, u=u).call(L),
                        self.x, self.u, h, substeps)


def _dense(outputs: Mapping[str, Any]) -> dict[str, Any]:
    return {name: ca.densify(value) for name, value in outputs.items()}
