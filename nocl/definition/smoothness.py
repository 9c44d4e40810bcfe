"""Where an expression is not smooth, and what to write instead: kinks break solvers that use second derivatives.

An expression can only kink where one of its operations switches: |a| at a = 0, max(a, b) at a = b, a condition a < b
at a = b. Points there are found by bisection between samples of the box; a kink is told from a smooth bend by its
slopes on both sides, whose difference does not shrink with the distance. max(0, a)^2 has no kink.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from nocl.definition import pretty
from nocl.definition.system import System
from nocl.support import checks
from nocl.support.checks import Array
from nocl.translate.instructions import Instruction, instructions

SAMPLES = 256  # points of the box
BISECTIONS = 60
STEP = 1e-4  # from a switching point to either side, in units of the way between two samples; and a hundredth of it
FALLS = 0.5  # a smooth bend's slopes differ a hundred times less a hundred times nearer, a kink's as much
TINY = 1e-150  # a width whose square is not 0
LEAST = 1e-6  # of the largest slope in the box: less is no kink
ROUNDED = ("OP_FABS", "OP_FMAX", "OP_FMIN")


@dataclass(frozen=True)
class Kink:
    """A place where a scalar expression jumps or bends sharply."""

    what: str  # "kink" or "jump"
    where: str  # the switching expression, as text: it is zero there
    at: Array  # [n], the point

    def __str__(self) -> str:
        return f"a {self.what} where {self.where} = 0"


def kinks(expression: ca.SX, z: ca.SX, lower: Array, upper: Array, of: ca.SX | None = None) -> list[Kink]:
    """The kinks and jumps of a scalar expression in z [n] that lie in the box [lower, upper], one a switching term.

    of : those of z in which they count (x and u, not p and t); default: all
    """
    names = [e for e in _switches(expression, z) if ca.depends_on(e, z if of is None else of)]
    if not names:
        return []
    rng = np.random.default_rng(0)
    points = rng.uniform(lower, upper, (SAMPLES, len(lower)))
    sides = ca.Function("sides", [z], [expression, ca.densify(ca.gradient(expression, z))])
    return [found for switch in names if (found := _kink(switch, sides, z, points)) is not None]


def _switches(expression: ca.SX, z: ca.SX) -> Iterator[ca.SX]:
    """What changes sign where an operation of the expression switches, each once."""
    function = ca.Function("expression", [z], [expression])
    work: dict[int, ca.SX] = {}
    seen: set[str] = set()
    for step in instructions(function):
        if step.op == "OP_OUTPUT":
            continue
        args = [work[a] for a in step.args] if step.op not in ("OP_INPUT", "OP_CONST") else []
        for switch in _switch(step.op, args):
            if not switch.is_constant() and str(switch) not in seen:
                seen.add(str(switch))
                yield switch
        work[step.out[0]] = _value(step, args, z)


def _switch(op: str, args: Sequence[ca.SX]) -> list[ca.SX]:
    if op in ("OP_FABS", "OP_SIGN"):
        return [args[0]]
    if op in ("OP_FMIN", "OP_FMAX", "OP_LT", "OP_LE", "OP_EQ", "OP_NE"):
        return [args[0] - args[1]]
    return [args[1]] if op == "OP_COPYSIGN" else []


def _value(step: Instruction, args: Sequence[ca.SX], z: ca.SX) -> ca.SX:
    if step.op == "OP_INPUT":
        return z.nz[step.args[1]]
    if step.op == "OP_CONST":
        return ca.SX(step.value)
    code = getattr(ca, step.op)
    return ca.SX.unary(code, args[0]) if len(args) == 1 else ca.SX.binary(code, args[0], args[1])


def _kink(switch: ca.SX, sides: ca.Function, z: ca.SX, points: Array) -> Kink | None:
    """The kink at a point where the switch changes sign; None where it does not, or all is smooth there."""
    s = ca.Function("switch", [z], [switch])
    values = s(points.T).full().ravel()
    low, high = points[values < 0], points[values > 0]
    if not len(low) or not len(high):
        return None
    a, b = low[0].copy(), high[0].copy()
    way = b - a
    for _ in range(BISECTIONS):
        middle = (a + b) / 2
        a, b = (middle, b) if float(s(middle)) < 0 else (a, middle)
    value, slope = sides(points.T)
    usual = [np.abs(value.full()).max(), np.abs(slope.full()).max()]
    far, near = (_differences(sides, (a + b) / 2, step * way) for step in (STEP, STEP / 100))
    for what, d_far, d_near, scale in zip(("jump", "kink"), far, near, usual, strict=True):
        if d_near > max(FALLS * d_far, LEAST * scale):
            return Kink(what, pretty.lines(switch, z)[0][0], (a + b) / 2)
    return None


def _differences(sides: ca.Function, at: Array, step: Array) -> tuple[float, float]:
    """How much the value and its gradient differ between at - step and at + step."""
    (v0, g0), (v1, g1) = (sides(at + sign * step) for sign in (-1, 1))
    return float(ca.fabs(v1 - v0)), float(ca.norm_inf(g1 - g0))


def linear_controls(running: ca.SX, xdot: ca.SX, u: ca.SX) -> list[str]:
    """The controls that the Hamiltonian L + V_x' f is linear in, whatever V_x is: its minimum is at their bounds."""
    second = ca.jacobian(ca.jacobian(ca.vertcat(running, xdot), u), u)  # rows of d2(.)/du_i du_j, by i in blocks
    n, m = 1 + xdot.numel(), u.numel()
    rows = [second[i * n:(i + 1) * n, :] for i in range(m)]
    return [s.name() for s, row in zip(ca.vertsplit(u), rows, strict=True) if row.nnz() == 0 or row.is_zero()]


def rounded(expression: ca.SX, z: ca.SX, u: ca.SX, width: ca.SX | float, lower: Array, upper: Array) -> ca.SX:
    """A scalar expression in z [n] with each |a|, max(a, b) and min(a, b) that holds u rounded off over about `width`
    of what its switch is in the box [lower, upper] of z; the expression itself where there is none.
    """
    function = ca.Function("expression", [z], [expression])
    points = np.random.default_rng(0).uniform(lower, upper, (SAMPLES, len(lower))).T
    work, sharp = dict[int, ca.SX](), dict[int, ca.SX]()  # values as they are rounded, and as they were
    value, none = expression, True
    for step in instructions(function):
        if step.op == "OP_OUTPUT":
            value = work[step.args[0]]
            continue
        args, were = ([of[a] for a in step.args] if step.op not in ("OP_INPUT", "OP_CONST") else []
                      for of in (work, sharp))
        work[step.out[0]], sharp[step.out[0]] = _value(step, args, z), _value(step, were, z)
        if step.op in ROUNDED and ca.depends_on(switch := _switch(step.op, were)[0], u):
            size = np.abs(ca.Function("switch", [z], [switch])(points).full()).max()
            work[step.out[0]], none = _round(step.op, args, width * float(size)), False
    return expression if none else value


def _round(op: str, args: Sequence[ca.SX], width: ca.SX | float) -> ca.SX:
    """|a|, max(a, b) or min(a, b); the last two are (a + b +- |a - b|) / 2."""
    switch = _switch(op, args)[0]
    size = ca.sqrt(switch**2 + width**2) - width
    return size if op == "OP_FABS" else (args[0] + args[1] + (size if op == "OP_FMAX" else -size)) / 2


def smooth_abs(e: ca.SX, width: float) -> ca.SX:
    """sqrt(e^2 + width^2) - width: |e| with its kink rounded off over about `width`, in the unit of e; 0 at e = 0."""
    (e,) = _scalars("smooth_abs", e=e)
    width = checks.between(width, TINY, checks.ORDINARY, "width", "smooth_abs")
    return ca.sqrt(e**2 + width**2) - width


def smooth_max(a: ca.SX, b: ca.SX, width: float) -> ca.SX:
    """max(a, b) with its kink rounded off over about `width`, in their unit; at most width / 2 above it."""
    (a, b) = _scalars("smooth_max", a=a, b=b)
    width = checks.between(width, TINY, checks.ORDINARY, "width", "smooth_max")
    return (a + b + ca.sqrt((a - b) ** 2 + width**2)) / 2


def _scalars(owner: str, **given: Any) -> list[Any]:
    """CasADi scalars of one kind, or numbers; ValueError otherwise."""
    found = [checks.finite(e) for e in given.values()]
    for (name, e), number in zip(given.items(), found, strict=True):
        if not (isinstance(e, (ca.SX, ca.MX)) and e.is_scalar() if number is None else abs(number) < checks.ORDINARY):
            raise ValueError(f"{owner}: {name} is {checks.shown(e)}; expected a scalar expression of CasADi, or a "
                             "number of ordinary size")
    if len({type(e) for e, number in zip(given.values(), found, strict=True) if number is None}) > 1:
        raise ValueError(f"{owner}: got SX and MX; expected expressions of one kind: use the system's own symbols")
    return [e if number is None else number for e, number in zip(given.values(), found, strict=True)]


def split_controls(system: System, names: Sequence[str]) -> System:
    """The system with each named control u as u_plus - u_minus, both >= 0: |u| is then u_plus + u_minus, smooth.

    Raises ValueError for names of no control, and for controls that cannot have both signs.
    """
    checks.instance(System, system, "system", "split_controls", "of an OCP, pass ocp.system")
    if not isinstance(names, (list, tuple)) or any(n not in system.control_names for n in names):
        raise ValueError(f"split_controls: got {names!r}; expected a list of names of controls "
                         f"({', '.join(system.control_names)})")
    parts, value, lb, ub, at = list[ca.SX](), list[ca.SX](), list[float](), list[float](), system.arguments
    for name, u, low, high in zip(system.control_names, ca.vertsplit(at["u"]), system.lbu, system.ubu, strict=True):
        if name not in names:
            parts, value, lb, ub = [*parts, u], [*value, u], [*lb, low], [*ub, high]
            continue
        if not low < 0 < high:
            raise ValueError(f"split_controls: {name} is in [{low:g}, {high:g}]; expected bounds on both sides of 0: "
                             "|u| has no kink there")
        plus, minus = ca.SX.sym(f"{name}_plus"), ca.SX.sym(f"{name}_minus")
        parts, value, lb, ub = [*parts, plus, minus], [*value, plus - minus], [*lb, 0.0, 0.0], [*ub, high, -low]
    units = {n: unit for n, unit in system.units.items() if n not in names}
    units |= {f"{n}_{side}": system.units[n] for n, side in itertools.product(names, ("plus", "minus"))
              if n in system.units}
    given = at.given(u=ca.vertcat(*value))
    right: dict[str, Any] = {"xdot": given.call(system.f)} if system.dt is None else \
        {"xdot": None, "x_next": given.call(system.F), "dt": system.dt}
    alg, guess = (e if e is None else ca.substitute(e, at["u"], ca.vertcat(*value))
                  for e in (system.alg, system.z_guess))
    return System(f"{system.name}_split", x=at["x"], u=ca.vertcat(*parts), **right, lbu=lb, ubu=ub, lbx=system.lbx,
                  ubx=system.ubx, p=at.symbols.get("p"), z=system.z, alg=alg, z_guess=guess, angles=system.angles,
                  units=units)
