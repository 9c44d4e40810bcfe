"""Systems and problems for other tools: python-control, gymnasium, do-mpc, acados, all optional."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from nocl.definition import discrete, parameters
from nocl.definition.ocp import OCP
from nocl.definition.system import System
from nocl.support import checks
from nocl.support.checks import Array
from nocl.support.packages import package

Step = Callable[[Array, Array, float, Array], tuple[Array, float]]  # (x, u, t, p) -> (x after it, its cost)
EDGE = 1e-9  # of an interval: how long a held control takes to become the next


def to_control(system: System, x: ArrayLike | None = None, u: ArrayLike | None = None, *, t: float = 0.0,
               p: Any = None) -> Any:
    """python-control's NonlinearIOSystem: inputs u (not clipped to U), outputs x; with (x, u[, t][, p]) the StateSpace
    there.

    Parameters are its `params`, by name, with their nominal values where they have some. Held controls, such as NMPC's,
    go through `held_inputs`. A system in discrete time is one there too, with its dt.
    """
    if (x is None) != (u is None):
        raise ValueError(f"to_control({system.name}): got one of x and u; expected both, or neither")
    if x is not None and u is not None:
        return _statespace(system, x, u, t, p)
    control, names = package("control"), system.parameter_names
    f = system.F if system.is_discrete else system.f

    def update(t: float, x: Array, u: Array, params: Any) -> Array:
        given = parameters.rows({n: params[n] for n in names if n in params}, names, 1, f"{system.name}: params")
        return f(*system.arguments.columns(x=x, u=u, t=t, p=given)).full().ravel()

    nominal = {n: value for n, value in zip(names, system.nominal.tolist(), strict=True) if np.isfinite(value)}
    return control.NonlinearIOSystem(update, None, inputs=list(system.control_names), outputs=list(system.state_names),
                                     states=list(system.state_names), name=system.name, params=nominal,
                                     **_sampling(system))


def _sampling(system: System) -> dict[str, Any]:
    """python-control's word for the time between two samples; nothing in continuous time."""
    return {"dt": system.dt} if system.is_discrete else {}


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


def _statespace(system: System, x: ArrayLike, u: ArrayLike, t: float, p: Any) -> Any:
    """python-control's StateSpace of the linearisation at (x, u, t, p): A, B exact, C = I."""
    A, B = system.linearize(x, u, t, p)
    return package("control").StateSpace(A, B, np.eye(system.nx), np.zeros((system.nx, system.nu)),
                                         inputs=list(system.control_names), outputs=list(system.state_names),
                                         states=list(system.state_names), name=system.name, **_sampling(system))


def to_do_mpc(system: System) -> Any:
    """do-mpc's continuous Model of the system, set up; states, controls and parameters (_p) under their names.

    Raises ValueError for an f that holds the time: do-mpc's models have none.
    """
    system.refuse_discrete("to_do_mpc", "one with xdot, or a do-mpc model of your own, Model('discrete')")
    if system.uses_time:
        raise ValueError(f"to_do_mpc: f of {system.name!r} holds the time; expected f(x, u, p): make it a state, with "
                         "derivative 1")
    model = package("do_mpc", "do-mpc").model.Model("continuous", "SX")
    x = ca.vertcat(*(model.set_variable("_x", n) for n in system.state_names))
    u = ca.vertcat(*(model.set_variable("_u", n) for n in system.control_names))
    p = ca.vertcat(*(model.set_variable("_p", n) for n in system.parameter_names))
    for name, rate in zip(system.state_names, ca.vertsplit(system.f(x, u, *[p] * bool(system.np))), strict=True):
        model.set_rhs(name, rate)
    model.setup()
    return model


def to_acados(system: System) -> Any:
    """acados' AcadosModel of the system: x, u, xdot (t, p), explicit and implicit equations, in SX."""
    system.refuse_discrete("to_acados", "one with xdot, or a model of your own with disc_dyn_expr")
    try:
        model = package("acados_template").AcadosModel()
    except ValueError as error:
        raise ValueError(f"{error}, or acados' own interfaces/acados_template") from None
    model.name, at = system.name, {name: ca.SX(v) for name, v in system.arguments.symbols.items()}
    for name, symbol in at.items():
        setattr(model, name, symbol)
    model.xdot = ca.SX.sym("xdot", system.nx)
    model.f_expl_expr = system.f(*at.values())
    model.f_impl_expr = model.xdot - model.f_expl_expr
    return model


def to_gymnasium(ocp: OCP, *, steps: int | None = None, integrator: str = "rk4", observe_time: bool = True) -> Any:
    """A gymnasium.Env of the problem: `steps` equal intervals over the horizon (default 80; in discrete time its own
    steps, and no other number), controls held and clipped to U.

    Observations are x, then t (unless observe_time is False), then p, float64; on a problem with parameters each
    episode has its own. Actions are u in U; the reward of a step is minus the integral of L over it, in the last step
    also minus G(x(T)): the return is minus the cost. Episodes are terminated at the horizon, with a reward of the
    step's cost at the last finite state where the state blows up. reset(options={"x0": x, "p": p}) starts at a given
    state and parameters. info has "cost", the cost so far, and "clearance", the least path constraint at the state.
    integrator: "rk4", the discretisation of NMPC, or "cvodes", the judge's. Path constraints are reported, and not in
    the reward.
    """
    if steps is not None and (isinstance(steps, bool) or not isinstance(steps, (int, np.integer)) or steps < 1):
        raise ValueError(f"to_gymnasium: steps is {steps!r}; expected an integer >= 1")
    if integrator not in ("rk4", "cvodes"):
        raise ValueError(f"to_gymnasium: integrator is {integrator!r}; expected 'rk4' or 'cvodes'")
    if integrator == "cvodes":
        ocp.system.refuse_discrete("to_gymnasium with integrator='cvodes'", "none: leave it out, steps are F itself")
    ocp.refuse_constraints("to_gymnasium", "put a penalty for them into the running cost, which the reward is made of")
    gymnasium = package("gymnasium")
    steps = discrete.intervals_of(ocp, steps, "to_gymnasium")
    step = _step(ocp, ocp.system.dt or ocp.horizon / steps, integrator)
    return _environment(gymnasium, ocp, int(steps), step, observe_time)


def _step(ocp: OCP, h: float, integrator: str) -> Step:
    """(x, u, t, p) -> (x after h, the integral of L)."""
    at = ocp.functions.stage
    if integrator == "rk4":
        function = ocp.functions.step(soft=False)

        def rk4(x: Array, u: Array, t: float, p: Array) -> tuple[Array, float]:
            after, cost = function(*at.columns(x=x, u=u, t=t, p=p), h)
            return after.full().ravel(), float(cost)

        return rk4
    time = [at["t"]] if "t" in at.names else []
    z, ode = ca.vertcat(at.x, at.sym("cost"), *time), ca.vertcat(at.xdot, at.L, *[1] * len(time))
    held = ca.vertcat(*(at[name] for name in ("u", "p") if name in at.names))
    judge = ca.integrator("step", "cvodes", {"x": z, "p": held, "ode": ode}, 0.0, h, {"reltol": 1e-9, "abstol": 1e-10})

    def cvodes(x: Array, u: Array, t: float, p: Array) -> tuple[Array, float]:
        end = judge(x0=np.r_[x, 0.0, [t] * len(time)], p=np.r_[u, p])["xf"].full().ravel()
        return end[:len(x)], float(end[len(x)])

    return cvodes


def _environment(gymnasium: Any, ocp: OCP, steps: int, step: Step, observe_time: bool) -> Any:
    s, of, box = ocp.system, ocp.functions, gymnasium.spaces.Box
    free, time = np.full(s.nx, np.inf), [ocp.horizon] if observe_time else []

    class Environment(gymnasium.Env):  # type: ignore[misc]
        metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012 (gymnasium's own)

        def __init__(self) -> None:
            self.ocp, self.render_mode = ocp, None
            any_p = np.full(ocp.np, np.inf)
            self.observation_space = box(np.r_[-free, 0 * np.array(time), -any_p], np.r_[free, time, any_p],
                                         dtype=np.float64)
            self.action_space = box(s.lbu, s.ubu, dtype=np.float64)
            self.k, self.x, self.cost, self.p = steps, np.array(ocp.x_goal), 0.0, ocp.nominal

        def reset(self, *, seed: int | None = None,
                  options: dict[str, Any] | None = None) -> tuple[Array, dict[str, Any]]:
            super().reset(seed=seed)
            given, p = ((options or {}).get(name) for name in ("x0", "p"))
            x0 = ocp.initial_states.sample(1, self.np_random)[0] if given is None else given
            self.p = (ocp.sample_parameters(1, self.np_random) if p is None else
                      ocp.parameters_of(p, 1, f"environment of {s.name}"))[0]
            self.k, self.x, self.cost = 0, checks.vector(x0, s.nx, "x0", f"environment of {s.name}").copy(), 0.0
            return self._observation(), self._info()

        def step(self, action: ArrayLike) -> tuple[Array, float, bool, bool, dict[str, Any]]:
            if self.k >= steps:
                raise ValueError("the episode is over; expected reset() before another step")
            u = np.clip(checks.vector(action, s.nu, "action", f"environment of {s.name}"), s.lbu, s.ubu)
            t = self._time()
            x, cost = step(self.x, u, t, self.p)
            blown = not (np.isfinite(x).all() and np.isfinite(cost))
            self.k = steps if blown else self.k + 1
            if blown:
                cost = float(ocp.L(*of.arguments.columns(x=self.x, u=u, t=t, p=self.p))) * ocp.horizon / steps
            else:
                self.x = x
            cost += float(ocp.G(*of.end.columns(x=self.x, p=self.p))) if self.k == steps else 0.0
            self.cost += cost
            return self._observation(), -cost, self.k == steps, False, self._info()

        def _time(self) -> float:
            return float(min(self.k * ocp.horizon / steps, ocp.horizon))  # not the last digit above it

        def _observation(self) -> Array:
            return np.r_[self.x, [self._time()] if observe_time else [], self.p]

        def _info(self) -> dict[str, Any]:
            h = ocp.h(*of.node.columns(x=self.x, t=self._time(), p=self.p)).full().ravel()
            return {"cost": self.cost, "clearance": float(h.min(initial=np.inf))}

    return Environment()
