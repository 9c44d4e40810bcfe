"""What control engineers ask for by a keyword that there is not: each is answered with the way there is."""

from __future__ import annotations

import difflib
import functools
import inspect
from collections.abc import Callable, Mapping
from typing import Any, TypeVar

C = TypeVar("C", bound=type)
_DELAY = ("f(x, u) has no delays: make a delayed control or measurement a few more states, each a first-order lag "
          "after the other; how a law bears a delay that it does not know: nocl.comparisons.study(..., robust=True)")
_INTEGER = ("controls are continuous in [lbu, ubu]: solve one problem for each mode and take the best, or let a "
            "callable round what the law answers, and have it judged by nocl.simulate")
_ALGEBRAIC = ("algebraic equations are semi-explicit, System(..., z=z, alg=...), 0 = alg(x, z, u, t, p) of index 1: "
              "make what multiplies xdot an equation for a z of its own, M z = f with xdot = z")
_DISCRETE = ("a system in discrete time is nocl.System.discrete(name, x=, u=, x_next=, dt=); in continuous time the "
             "solvers hold controls on `intervals`, and a law is sampled by nocl.simulate(..., hold=K)")
_OUTPUT = ("a law sees all states: put an observer before it, u = law(estimate, t), and have that callable judged by "
           "nocl.simulate")
_NOISE = ("f is deterministic; what noise, kicks and wrong models cost a law is in nocl.comparisons.study(..., "
          "robust=True)")
_RATES = 'nocl.limit_rates(system, {"force": 5.0}) makes the control a state, and its rate the control'
_STATES = ('bounds of trajectories are state_bounds={"v": (-2, 2)} of the OCP; lbx, ubx are the box that samples are '
           "drawn from")
ASKED: Mapping[str, tuple[str, str]] = {word: answer for words, answer in (
    (("delay", "delays", "dead_time", "lag"), ("delays", _DELAY)),
    (("integer", "integers", "integrality", "discrete_controls", "binary"), ("integer controls", _INTEGER)),
    (("algebraic", "constraints_alg", "M", "mass_matrix"), ("implicit equations", _ALGEBRAIC)),
    (("dt", "ts", "Ts", "sample_time", "discrete", "x_next"), ("sampling times", _DISCRETE)),
    (("y", "output", "outputs", "measurement", "measurements", "h"), ("measured outputs", _OUTPUT)),
    (("noise", "disturbance", "w", "stochastic"), ("noise", _NOISE)),
    (("du_max", "du_min", "rate", "rates", "rterm"), ("limits of rates", _RATES)),
    (("xmin", "xmax", "x_min", "x_max", "x_bounds"), ("bounds of states", _STATES))) for word in words}


def answered(cls: C) -> C:
    """A class whose construction answers keywords that it does not have, in place of Python's TypeError."""
    init: Callable[..., None] = cls.__init__  # type: ignore[misc]
    known = [name for name in inspect.signature(init).parameters if name != "self"]

    @functools.wraps(init)
    def construct(self: Any, *args: Any, **given: Any) -> None:
        unknown = next((name for name in given if name not in known), None)
        if unknown is not None:
            raise ValueError(f"{cls.__name__}: {_answer(unknown, known)}")
        init(self, *args, **given)

    cls.__init__ = construct  # type: ignore[misc]
    return cls


def _answer(name: str, known: list[str]) -> str:
    if name in ASKED:
        what, way = ASKED[name]
        return f"{name} is no argument, nocl has no {what} as such: {way}"
    near = difflib.get_close_matches(name, known, 1)
    return f"{name} is no argument; expected {', '.join(known)}" + (f": did you mean {near[0]}?" if near else "")
