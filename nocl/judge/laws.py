"""What is run: laws and plants in the forms that the judge takes, and whether they are for this problem."""

from __future__ import annotations

import inspect
from collections.abc import Sequence
from typing import Any

import casadi as ca

from nocl.definition.ocp import OCP
from nocl.support.checks import Array

WHOLE = 1e-9  # relative, by which a duration may miss whole numbers of dt


def check_made_for(ocp: OCP, thing: Any, what: str) -> None:
    """ValueError where `thing` (a controller, a value function) was made for a problem on another system.

    Other names of states and controls are refused of everything that has an `ocp`, and other parameters of what was
    made for some. Other equations are refused of what was trained and may have been loaded (it has a card); a law that
    is built on a model on the spot, like LQR, may be tried on the plant, and one for given parameters on others.
    """
    made_for = getattr(thing, "ocp", None)
    if not isinstance(made_for, OCP):
        return
    names, own = made_for.parameter_names, ocp.parameter_names
    differ = ocp.system.difference(made_for.system, equations=hasattr(thing, "card") and names == own)
    if not differ and names and names != own:
        differ = f"its parameters are {', '.join(names)}, not {', '.join(own) or 'none'}"
    if differ:
        raise ValueError(f"{what} was made for {made_for.system.name!r}, which is another system than this problem's "
                         f"{ocp.system.name!r}: {differ}; expected one made for it (to try a controller on another "
                         "plant, keep its problem and pass the plant's equations, simulate(..., f=))")


def dynamics_function(ocp: OCP, f: Any) -> ca.Function:
    """f as a casadi.Function (x, u[, t][, p]) -> xdot, its inputs under these names: the exact one for None, a
    Function, or what `to_casadi()` returns; either is of (x, u), or of all that the system's own f is a function of."""
    s = ocp.system
    if f is None:
        return ocp.functions.f
    s.refuse_discrete("a plant or model that is given as f or dynamics, (x, u) -> xdot,", "a problem on the other "
                      "system, dataclasses.replace(ocp, system=ocp.system.under(F)), F: (x, u) -> x_next")
    g = f if isinstance(f, ca.Function) else _converted(f)
    if g is None:
        raise ValueError(f"the dynamics are a {type(f).__name__}; expected a casadi.Function (x, u) -> xdot, "
                         "an object with to_casadi(), or None for the exact f")
    of = ocp.functions
    forms = [(s.nx, s.nu), *(tuple(v.numel() for v in a.inputs) for a in (s.arguments, of.arguments))]
    return of.on(_with_sizes(g, forms, s.nx, "the dynamics", "(x, u) -> xdot", s.name)).f


def policy_function(ocp: OCP, controller: Any) -> ca.Function | None:
    """The policy (x, t[, p]) -> u as a casadi.Function, or None where the controller has none; one of x alone, or of
    (x, t), gets the rest.
    """
    s = ocp.system
    g = controller if isinstance(controller, ca.Function) else _converted(controller)
    if g is not None and g.n_out() != 1:
        raise ValueError(f"the policy {g.name()} returns {', '.join(g.name_out())}; {s.name} needs one output, u: pick "
                         "it (of an ONNX file with from_onnx(path, outputs=[...]))")
    at = ocp.functions.feedback(ca.MX)
    every = [v.numel() for v in at.inputs]
    sizes = [] if g is None else [g.numel_in(i) for i in range(g.n_in())]
    if g is not None and sizes in (every[:1], every[:2]) and sizes != every:
        x = at["x"] if g.size2_in(0) == 1 else at["x"].T
        g = at.function(g.name(), {"u": g(*[x, at["t"]][:len(sizes)])})
    form = "(x, t) -> u" if not ocp.np else "(x, t, p) -> u"
    return g if g is None else _with_sizes(g, [tuple(every)], s.nu, "the policy", form, s.name)


def _converted(thing: Any) -> ca.Function | None:
    return thing.to_casadi() if hasattr(thing, "to_casadi") else None


def _with_sizes(g: ca.Function, forms: Sequence[tuple[int, ...]], n_out: int, what: str, form: str,
                owner: str) -> ca.Function:
    got = [g.numel_in(i) for i in range(g.n_in())]
    if tuple(got) not in forms or g.numel_out(0) != n_out:
        lengths = " or ".join(dict.fromkeys(str(list(sizes)) for sizes in forms))
        raise ValueError(f"{what} {g.name()} takes vectors of length {got} and returns {g.numel_out(0)}; {owner} needs "
                         f"{form} with lengths {lengths} -> {n_out}")
    return g


def own_holds(controller: Any, duration: float) -> int | None:
    """How many controls are held in a while by a controller that says how long it holds one, by its `control_dt`; None
    for others.

    Raises ValueError where that is no whole number.
    """
    dt = getattr(controller, "control_dt", None)
    if not isinstance(dt, float):
        return None
    K = round(duration / dt)
    if abs(duration / dt - K) > WHOLE * max(K, 1) or K < 1:
        raise ValueError(f"the controller holds each control for dt = {dt:g}, which does not fit into {duration:g}; "
                         f"expected a whole number of them, like {max(K, 1) * dt:g}")
    return K


def takes_p(ocp: OCP, controller: Any) -> bool:
    """Whether a callable controller is one of (x, t, p): on a problem with parameters, unless made for one without."""
    made_for = getattr(controller, "ocp", None)
    return bool(ocp.np) and not (isinstance(made_for, OCP) and not made_for.np)


def check_takes_p(ocp: OCP, controller: Any) -> None:
    """ValueError where a callable controller is one of (x, t) and should be one of (x, t, p)."""
    if not takes_p(ocp, controller):
        return
    try:
        inspect.signature(controller).bind(None, 0.0, None)
    except TypeError:
        raise ValueError(f"the controller does not take (x, t, p), as those of a problem with the parameters "
                         f"{', '.join(ocp.parameter_names)} do: expected a third argument, p [B, {ocp.np}]; where it "
                         "needs none, lambda x, t, p: controller(x, t)") from None
    except ValueError:  # a builtin without a signature
        return


def answer_of(controller: Any, x: Array, t: float, *p: Array | None) -> Any:
    """A callable's answer; ValueError where it does not take (x, t), or (x, t, p)."""
    try:
        return controller(x, t, *p)
    except TypeError as error:
        form = "(x [B, nx], t, p [B, np])" if p else "(x [B, nx], t)"
        raise ValueError(f"the controller raised {error} at t = {t:g}; expected a callable {form} -> u [B, nu]"
                         ) from error
