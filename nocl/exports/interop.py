"""Systems and problems for other tools: python-control, gymnasium, do-mpc, acados, all optional."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from nocl.ocp import OCP
from nocl.support import checks
from nocl.support.checks import Array
from nocl.support.packages import package
from nocl.system import System

EDGE = 1e-9  # of an interval: how long a held control takes to become the next


def to_control(system: System, x: ArrayLike | None = None, u: ArrayLike | None = None) -> Any:
    """python-control's NonlinearIOSystem: inputs u (not clipped to U), outputs x; with (x, u) the StateSpace there.

    Held controls, such as NMPC's, go through `held_inputs`.
    """
    system.refuse_parameters("to_control")
    if (x is None) != (u is None):
        raise ValueError(f"to_control({system.name}): got one of x and u; expected both, or neither")
    if x is not None and u is not None:
        return _statespace(system, x, u)
    control, f = package("control"), system.f

    def update(t: float, x: Array, u: Array, params: Any) -> Array:
        return f(x, u).full().ravel()

    return control.NonlinearIOSystem(update, None, inputs=list(system.control_names), outputs=list(system.state_names),
                                     states=list(system.state_names), name=system.name)


def held_inputs(t: ArrayLike, u: ArrayLike) -> tuple[Array, Array]:
    """(T [2 K], U [nu, 2 K]) of controls u [K, nu] held between times t [K+1], for python-control.

    Its input_output_response joins samples by straight lines: here each control has one at either end of its interval.
    Give solve_ivp_kwargs={"max_step": the shortest interval, "rtol": 1e-8} too, or its steps may pass over intervals.
    """
    times, controls = checks.real(t), checks.real(u)
    if times.ndim != 1 or controls.ndim != 2 or len(times) != len(controls) + 1 or len(times) < 2:
        raise ValueError(f"held_inputs: t has shape {times.shape}, u {controls.shape}; expected [K+1] and [K, nu]: "
                         "of a Solution s row 0 is held_inputs(s.t[0], s.u[0])")
    if not (np.isfinite(times).all() and np.isfinite(controls).all() and (np.diff(times) > 0).all()):
        raise ValueError("held_inputs: expected finite numbers, and times that rise: leave out rows without a solution")
    ends = times[1:] - EDGE * np.diff(times)
    ends[-1] = times[-1]
    return np.c_[times[:-1], ends].ravel(), np.repeat(controls, 2, axis=0).T


def _statespace(system: System, x: ArrayLike, u: ArrayLike) -> Any:
    """python-control's StateSpace of the linearisation at (x, u): A, B exact, C = I."""
    A, B = system.linearize(x, u)
    return package("control").StateSpace(A, B, np.eye(system.nx), np.zeros((system.nx, system.nu)),
                                         inputs=list(system.control_names), outputs=list(system.state_names),
                                         states=list(system.state_names), name=system.name)


def to_do_mpc(system: System) -> Any:
    """do-mpc's continuous Model of the system, set up; states and controls under their names."""
    system.refuse_parameters("to_do_mpc")
    model = package("do_mpc", "do-mpc").model.Model("continuous", "SX")
    x = ca.vertcat(*(model.set_variable("_x", n) for n in system.state_names))
    u = ca.vertcat(*(model.set_variable("_u", n) for n in system.control_names))
    for name, rate in zip(system.state_names, ca.vertsplit(system.f(x, u)), strict=True):
        model.set_rhs(name, rate)
    model.setup()
    return model


def to_acados(system: System) -> Any:
    """acados' AcadosModel of the system: x, u, xdot, explicit and implicit equations, in SX."""
    system.refuse_parameters("to_acados")
    try:
        model = package("acados_template").AcadosModel()
    except ValueError as error:
        raise ValueError(f"{error}, or acados' own interfaces/acados_template") from None
    model.name, (model.x, model.u) = system.name, (ca.SX(v) for v in system.arguments.inputs)
    model.xdot = ca.SX.sym("xdot", system.nx)
    model.f_expl_expr = system.f(model.x, model.u)
    model.f_impl_expr = model.xdot - model.f_expl_expr
    return model


def to_gymnasium(ocp: OCP, *, steps: int = 80, integrator: str = "rk4", observe_time: bool = True) -> Any:
    """A gymnasium.Env of the problem: `steps` equal intervals over the horizon, controls held and clipped to U.

    Observations are x, then t (unless observe_time is False), float64; actions are u in U; the reward of a step is
    minus the integral of L over it, in the last step also minus G(x(T)): the return is minus the cost. Episodes are
    terminated at the horizon, with a reward of the step's cost at the last finite state where the state blows up.
    reset(options={"x0": x}) starts at a given state. info has "cost", the cost so far, and "clearance", the least path
    constraint at the state. integrator: "rk4", the discretisation of NMPC, or "cvodes", the judge's. Path constraints
    are reported, and not in the reward.
    """
    ocp.refuse_parameters("to_gymnasium")
    if isinstance(steps, bool) or not isinstance(steps, (int, np.integer)) or steps < 1:
        raise ValueError(f"to_gymnasium: steps is {steps!r}; expected an integer >= 1")
    if integrator not in ("rk4", "cvodes"):
        raise ValueError(f"to_gymnasium: integrator is {integrator!r}; expected 'rk4' or 'cvodes'")
    gymnasium = package("gymnasium")
    step = _step(ocp, ocp.horizon / steps, integrator)
    return _environment(gymnasium, ocp, int(steps), step, observe_time)


def _step(ocp: OCP, h: float, integrator: str) -> Callable[[Array, Array], tuple[Array, float]]:
    """(x, u) -> (x after h, the integral of L)."""
    if integrator == "rk4":
        function = ocp.functions.step(soft=False)

        def rk4(x: Array, u: Array) -> tuple[Array, float]:
            after, cost = function(x, u, h)
            return after.full().ravel(), float(cost)

        return rk4
    at = ocp.functions.stage
    z, ode = ca.vertcat(at.x, at.sym("cost")), ca.vertcat(at.xdot, at.L)
    judge = ca.integrator("step", "cvodes", {"x": z, "p": at.u, "ode": ode}, 0.0, h, {"reltol": 1e-9, "abstol": 1e-10})

    def cvodes(x: Array, u: Array) -> tuple[Array, float]:
        end = judge(x0=np.r_[x, 0.0], p=u)["xf"].full().ravel()
        return end[:-1], float(end[-1])

    return cvodes


def _environment(gymnasium: Any, ocp: OCP, steps: int, step: Callable[[Array, Array], tuple[Array, float]],
                 observe_time: bool) -> Any:
    s, box = ocp.system, gymnasium.spaces.Box
    free, time = np.full(s.nx, np.inf), [ocp.horizon] if observe_time else []

    class Environment(gymnasium.Env):  # type: ignore[misc]
        metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012 (gymnasium's own)

        def __init__(self) -> None:
            self.ocp, self.render_mode = ocp, None
            self.observation_space = box(np.r_[-free, 0 * np.array(time)], np.r_[free, time], dtype=np.float64)
            self.action_space = box(s.lbu, s.ubu, dtype=np.float64)
            self.k, self.x, self.cost = steps, np.array(ocp.x_goal), 0.0

        def reset(self, *, seed: int | None = None,
                  options: dict[str, Any] | None = None) -> tuple[Array, dict[str, Any]]:
            super().reset(seed=seed)
            given = (options or {}).get("x0")
            x0 = ocp.initial_states.sample(1, self.np_random)[0] if given is None else given
            self.k, self.x, self.cost = 0, checks.vector(x0, s.nx, "x0", f"environment of {s.name}").copy(), 0.0
            return self._observation(), self._info()

        def step(self, action: ArrayLike) -> tuple[Array, float, bool, bool, dict[str, Any]]:
            if self.k >= steps:
                raise ValueError("the episode is over; expected reset() before another step")
            u = np.clip(checks.vector(action, s.nu, "action", f"environment of {s.name}"), s.lbu, s.ubu)
            x, cost = step(self.x, u)
            blown = not (np.isfinite(x).all() and np.isfinite(cost))
            self.k = steps if blown else self.k + 1
            if blown:
                cost = float(ocp.L(self.x, u)) * ocp.horizon / steps
            else:
                self.x = x
            cost += float(ocp.G(self.x)) if self.k == steps else 0.0
            self.cost += cost
            return self._observation(), -cost, self.k == steps, False, self._info()

        def _observation(self) -> Array:
            time = min(self.k * ocp.horizon / steps, ocp.horizon)  # not the last digit above it
            return np.r_[self.x, time] if observe_time else self.x.copy()

        def _info(self) -> dict[str, Any]:
            h = ocp.h(self.x).full().ravel()
            return {"cost": self.cost, "clearance": float(h.min(initial=np.inf))}

    return Environment()
