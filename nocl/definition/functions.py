"""The one door to a problem's functions: f, L, L_soft, h, G, constraints and what is derived from them, by name.

A stage is one moment of a problem: f and L stand there as functions of (x, u). A node is where path constraints hold,
h(x), and the end is where G(x) does. What acts on the problem, a policy or a value, is a function of (x, t). Each of
these four is an `Arguments`, and all that is built from the problem anywhere is built on them. A problem whose f, L or
h holds the time has t in its stage and node; one with parameters has p, all of them, in all four, the last: stage
(x, u, t, p), node (x, t, p), end (x, p), feedback (x, t, p). f has them all, too, also where it uses only some.

    at = ocp.functions.stage
    ocp.functions.f, .jacobian, .L, .L_soft, .h, .G, .L_derivatives ...   # ready CasADi functions
    at.xdot, at.L, at.L_soft, at.interval(h)                              # expressions in the stage's symbols
    at.function("H_u", {"H_u": ca.gradient(H, at.u)}, costate=costate)    # of (x, u, costate)
    ocp.functions.on(f_theta.to_casadi())                                 # the same problem under another f
    ocp.functions.rows, .c, .end_rows, .c_end                             # all constraints, scaled: c >= 0, or c = 0

h is the inequalities of (x, t, p) alone, in their own units. All constraints stand in `rows` (along a trajectory) and
`end_rows` (at its end), which say of each row whose it is, its side, whether it is an equation and whether it holds u;
c and c_end are their values as shares of each constraint's scale.

So an argument that f or L gains is written here, and where callers have its data.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import casadi as ca

from nocl.definition.constraints import PATH, Measure, Rows
from nocl.definition.parameters import TIME, time
from nocl.definition.substeps import RADAU, RK4
from nocl.definition.system import System
from nocl.support import checks
from nocl.support.checks import Array
from nocl.translate import radau
from nocl.translate.arguments import Arguments
from nocl.translate.rk4 import map_cost, rk4_cost


@dataclass(frozen=True, eq=False)
class Functions:
    """Those of one problem; made by OCP.functions, from expressions in the system's own symbols."""

    system: System
    running: ca.SX  # L(x, u)
    rows: Rows  # constraints along a trajectory, of (x, u)
    end_rows: Rows  # ... at its end, of x
    terminal: ca.SX  # G(x)
    measured: Measure  # the scales of both kinds of rows
    penalty: float  # of L_soft, and its margin
    penalty_margin: float
    dynamics: ca.Function | None = None  # (x, u[, t][, p of the system]) -> xdot in place of the system's own f
    p: ca.SX = field(default_factory=lambda: ca.SX(0, 1))  # the problem's own parameters

    def on(self, dynamics: ca.Function) -> Functions:
        """The same problem under another f."""
        known = self.dynamics is not None or self.system.xdot is not None
        return self if known and dynamics is self.f else replace(self, dynamics=dynamics)

    @cached_property
    def timed(self) -> bool:
        """Whether f, L or a constraint holds the time."""
        return self.system.uses_time or bool(ca.depends_on(ca.vertcat(self.running, self.rows.column), time()))

    @cached_property
    def arguments(self) -> Arguments:
        """(x, u[, t][, p]), in the system's and the problem's own symbols: what holds at one moment."""
        own, p = self.system.arguments, self.p
        if not p.numel() and (not self.timed or TIME in own.names):
            return own
        every = ca.vertcat(own["p"], p) if "p" in own.names else p
        more = {**({TIME: time()} if self.timed else {}), **({"p": every} if every.numel() else {})}
        return own.but(TIME, "p").given(**more)

    @cached_property
    def stage(self) -> Stage:
        """(x, u[, t][, p]): in SX, or in MX where f is."""
        if self.dynamics is None or self.dynamics.is_a("SXFunction"):
            return Stage(self.arguments.symbols, self)
        return self.stage_in_MX

    @cached_property
    def stage_in_MX(self) -> Stage:
        """(x, u[, t][, p]) as new symbols in MX."""
        sizes = {n: s.numel() for n, s in self.arguments.symbols.items()}
        return Stage(Arguments.new(ca.MX, **sizes).symbols, self)

    def stage_of(self, integrator: str) -> Stage:
        """The stage that steps of a kind are expressions in: implicit ones call a root finder, which SX cannot."""
        return self.stage_in_MX if integrator == RADAU else self.stage

    @cached_property
    def scales(self) -> Array:
        """What each of `rows` is measured by [m] > 0."""
        return self.measured()[0]

    @cached_property
    def end_scales(self) -> Array:
        """What each of `end_rows` is measured by [m] > 0."""
        return self.measured()[1]

    @cached_property
    def constraints(self) -> ca.SX:
        """h(x), a column, in the users' own units."""
        return self.rows.column[:self.rows.n_h, :]

    @cached_property
    def penalised(self) -> list[ca.SX]:
        """h(x), one by one, as `penalty_margin` is meant: path constraints in their own unit, others in their scale."""
        h = ca.vertsplit(self.constraints) if self.rows.n_h else []
        return [one if of.kind == PATH else one / float(self.scales[i])
                for i, (of, one) in enumerate(zip(self.rows.of, h, strict=False))]

    @cached_property
    def soft(self) -> ca.SX:
        """L_soft(x, u)"""
        soft = self.running
        for h in self.penalised:
            soft = soft + self.penalty * ca.fmax(self.penalty_margin - h, 0) ** 2
        return soft

    @property
    def node(self) -> Arguments:
        """(x[, t][, p]), in SX: what `constraints` is an expression in."""
        return self.arguments.but("u")

    @property
    def end(self) -> Arguments:
        """(x[, p]), in SX: what `terminal` is an expression in."""
        return self.arguments.but("u", TIME)

    @property
    def np(self) -> int:
        """How many parameters there are, the system's and the problem's own."""
        return self.arguments["p"].numel() if "p" in self.arguments.names else 0

    def feedback(self, kind: Any = ca.SX) -> Arguments:
        """(x, t[, p]), new symbols of a kind, ca.SX or ca.MX: what policies and values are functions of."""
        p = {"p": self.np} if self.np else {}
        return Arguments.new(kind, x=self.system.nx, t=1, **p)

    def of_feedback(self, name: str, column: ca.SX) -> ca.Function:
        """(x, t[, p]) -> an expression in the system's and the problem's own symbols; ValueError for others."""
        own = {"x": self.system.x, "t": time(), "p": ca.vertcat(self.system.p, self.p)}
        checks.expression(column, column.numel(), ca.vertcat(own["x"], own["p"]), name, self.system.name, time=time())
        names = self.feedback().names
        return ca.Function(name, [own[n] for n in names], [column], names, [name])

    @cached_property
    def f(self) -> ca.Function:
        """(x, u[, t][, p]) -> xdot."""
        f, own = self.dynamics, self.system.arguments
        if f is None:
            f = self.system.f
        if f.name_in() == self.arguments.names and (not self.np or f.numel_in("p") == self.np):
            return f
        kind = ca.SX if f.is_a("SXFunction") else ca.MX
        at = Arguments.new(kind, **{n: s.numel() for n, s in self.arguments.symbols.items()})
        values = of_system(self.system, at)
        named = all(name in own.names for name in f.name_in())
        given = [values[name] for name in (f.name_in() if named else own.names[:f.n_in()])]
        return at.function(f.name(), {"xdot": f(*given)})

    @cached_property
    def jacobian(self) -> ca.Function:
        """(x, u[, t][, p]) -> (A [nx, nx] = df/dx, B [nx, nu] = df/du), dense."""
        if self.dynamics is None and self.arguments.names == self.system.arguments.names and not self.p.numel():
            return self.system.jacobian
        at = self.stage
        return at.function("jacobian", {"A": ca.densify(ca.jacobian(at.xdot, at.x)),
                                        "B": ca.densify(ca.jacobian(at.xdot, at.u))})

    @cached_property
    def L(self) -> ca.Function:
        """(x, u[, t][, p]) -> running cost, a scalar."""
        return self.arguments.function("L", {"L": self.running})

    @cached_property
    def L_soft(self) -> ca.Function:
        """(x, u[, t][, p]) -> running cost with the penalty of the path constraints."""
        return self.arguments.function("L_soft", {"L": self.soft})

    @cached_property
    def h(self) -> ca.Function:
        """(x[, t][, p]) -> inequalities of these alone [number of them], each >= 0 where it holds, in its own unit."""
        return self.node.function("h", {"h": self.constraints})

    @cached_property
    def c_of_x(self) -> ca.Function:
        """(x[, t][, p]) -> the rows of these alone, in their own units: h, then equations."""
        n = self.rows.n_x
        return self.h if n == self.rows.n_h else self.node.function("c_of_x", {"c": self.rows.column[:n, :]})

    @cached_property
    def c_of_u(self) -> ca.Function:
        """(x, u[, t][, p]) -> the rows that hold the control, in their own units."""
        return self.arguments.function("c_of_u", {"c": self.rows.column[self.rows.n_x:, :]})

    @cached_property
    def c_at_end(self) -> ca.Function:
        """(x[, p]) -> the rows at the end, in their own units."""
        return self.end.function("c_at_end", {"c": self.end_rows.column})

    @cached_property
    def c(self) -> ca.Function:
        """(x, u[, t][, p]) -> all rows along a trajectory, as shares of their scales: >= 0, or = 0 (`rows.equal`)."""
        return self.arguments.function("c", {"c": ca.densify(self.rows.column / ca.DM(self.scales))})

    @cached_property
    def c_end(self) -> ca.Function:
        """(x[, p]) -> all rows at the end, as shares of their scales."""
        return self.end.function("c_end", {"c": ca.densify(self.end_rows.column / ca.DM(self.end_scales))})

    @cached_property
    def G(self) -> ca.Function:
        """(x[, p]) -> terminal cost, a scalar."""
        return self.end.function("G", {"G": self.terminal})

    @cached_property
    def L_derivatives(self) -> ca.Function:
        """(x, u[, t][, p]) -> (L, L_z [nz], L_zz [nz, nz]), z = (x, u), dense; without the penalty."""
        own = self.arguments
        H, g = ca.hessian(self.running, ca.vertcat(own["x"], own["u"]))
        return own.function("L_derivatives", _dense({"L": self.running, "L_z": g, "L_zz": H}))

    @cached_property
    def G_derivatives(self) -> ca.Function:
        """(x[, p]) -> (G, G_x [nx], G_xx [nx, nx]), dense."""
        H, g = ca.hessian(self.terminal, self.end["x"])
        return self.end.function("G_derivatives", _dense({"G": self.terminal, "G_x": g, "G_xx": H}))

    @cached_property
    def h_derivatives(self) -> ca.Function:
        """(x[, t][, p], mu) -> (h, h_x [n, nx], the Hessian of mu'h [nx, nx]), h_x with its own zeros."""
        h, x = self.constraints, self.node["x"]
        mu = ca.SX.sym("mu", h.numel())
        H = ca.densify(ca.hessian(ca.dot(mu, h), x)[0])
        return self.node.function("h_derivatives", {"h": h, "h_x": ca.jacobian(h, x), "h_xx": H}, mu=mu)

    def step(self, *, soft: bool = True, substeps: int = 1, integrator: str = RK4) -> ca.Function:
        """(x, u[, t][, p], h) -> (end, cost) of an interval from t to t + h with u held; see Stage.interval."""
        at = self.stage_of(integrator)
        h = at.sym("h")
        end, cost = at.interval(h, soft=soft, substeps=substeps, integrator=integrator)
        return at.function("step", {"end": end, "cost": cost}, h=h)

    @cached_property
    def sample(self) -> ca.Function:
        """(x, u[, t][, p]) -> (x+, dt L) of a step of a system in discrete time, F as it was written."""
        F = self.system.F  # refuses those in continuous time
        after = F(*self.stage.of_system)
        return self.arguments.function("sample", {"x_next": after, "cost": (self.system.dt or 0.0) * self.running})

    def collocated(self, *, soft: bool = True, substeps: int = 1) -> ca.Function:
        """(x, u[, t][, p], h, z [substeps s nx]) -> (end, cost, residual [substeps s nx]) of an interval by Radau steps
        with stages z: the true ones where the residual is 0.
        """
        at = self.stage
        h, z = at.sym("h"), at.sym("z", substeps * radau.STAGES * self.system.nx)
        parts, t = iter(ca.vertsplit(z, z.numel() // substeps)), at.symbols.get(TIME)
        gaps: list[Any] = []

        def given(x: Any, u: Any, *now: Any) -> Any:
            part = next(parts)
            gaps.append(radau.residual(at.moments("f"), part, x, u, h / substeps, *now))
            return part

        end, cost = radau.radau_cost(given, at.moments("L_soft" if soft else "L"), at.x, at.u, h, substeps, t)
        return at.function("collocated", {"end": end, "cost": cost, "residual": ca.vertcat(*gaps)}, h=h, z=z)

    def radau_path(self, substeps: int = 1) -> ca.Function:
        """(x, u[, t][, p], h) -> z [substeps s nx], the stages of an interval's steps; NaN where none are found."""
        at = self.stage_in_MX
        h, found = at.sym("h"), list[Any]()
        solve = at.radau_stages(h / substeps)

        def kept(*values: Any) -> Any:
            found.append(solve(*values))
            return found[-1]

        radau.radau_cost(kept, at.moments("L"), at.x, at.u, h, substeps, at.symbols.get(TIME))
        return at.function("path", {"z": ca.vertcat(*found)}, h=h)

    @cached_property
    def radau_residual(self) -> ca.Function:
        """(z [s nx], x, u[, t][, p], h) -> 0 where x + z are the states at the stages of a Radau step of length h."""
        at = self.stage
        z, h = at.sym("z", radau.STAGES * self.system.nx), at.sym("h")
        residual = radau.residual(at.moments("f"), z, at.x, at.u, h, at.symbols.get(TIME))
        return Arguments({"z": z}).given(**at.symbols).function("residual", {"residual": residual}, h=h)

    @cached_property
    def radau_stages(self) -> ca.Function:
        """(x, u[, t][, p], h) -> z [s nx], found by Newton's method; NaN where that does not converge."""
        at, unit = self.stage_in_MX, (self.system.ubx - self.system.lbx) / 2
        h = at.sym("h")
        return at.function("stages", {"z": radau.stages(self.radau_residual, unit, [*at.inputs, h])}, h=h)


class Stage(Arguments):
    """One moment of a problem under an f: x and u (t, p) as symbols, and what stands there as expressions in them."""

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

    def interval(self, h: Any, *, soft: bool = True, substeps: int = 1, integrator: str = RK4) -> tuple[Any, Any]:
        """(x after a time h with u held, the integral of L or L_soft over it), by RK4 steps, whose stages are at t,
        t + h / 2 and t + h, or by Radau's (nocl/translate/radau.py), for which this is a stage in MX. Of a
        discrete-time system it is the step of its own, with h L for its cost.
        """
        L, t = self.moments("L_soft" if soft else "L"), self.symbols.get(TIME)
        if self.functions.system.is_discrete:
            return map_cost(self.moments("f"), L, self.x, self.u, h, t)
        if integrator == RADAU:
            return radau.radau_cost(self.radau_stages(h / substeps), L, self.x, self.u, h, substeps, t)
        return rk4_cost(self.moments("f"), L, self.x, self.u, h, substeps, t)

    def moments(self, name: str) -> Callable[..., Any]:
        """A function of the problem's by its name, as one of (x, u[, t]), p being the stage's."""
        function, names = getattr(self.functions, name), ["x", "u", *([TIME] if TIME in self.names else [])]
        return lambda *values: self.given(**dict(zip(names, values, strict=True))).call(function)

    def radau_stages(self, h: Any) -> Callable[..., Any]:
        """(x, u[, t]) -> z of a Radau step of length h."""
        names = ["x", "u", *([TIME] if TIME in self.names else [])]
        solve = self.functions.radau_stages
        return lambda *values: self.given(**dict(zip(names, values, strict=True)), h=h).call(solve)

    @property
    def of_system(self) -> list[Any]:
        """What the system's own f is a function of, in its order."""
        values = of_system(self.functions.system, self)
        return [values[name] for name in self.functions.system.arguments.names]


def of_system(system: System, at: Arguments) -> dict[str, Any]:
    """The values of a system's own arguments among those of a problem on it: of p the first part."""
    values = {name: at[name] for name in system.arguments.names}
    return {**values, "p": values["p"][:system.np]} if "p" in values else values


def _dense(outputs: Mapping[str, Any]) -> dict[str, Any]:
    return {name: ca.densify(value) for name, value in outputs.items()}
