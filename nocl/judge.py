"""The judge: any controller on the exact f under CVODES, the cost as an extra state. B is the batch, K the intervals.

Three kinds of control are judged alike:

- continuous feedback, where the controller is a CasADi Function policy:(x, t) -> u or has `to_casadi()`: the policy
  stands inside the ODE;
- sampled feedback, where it is any callable (x [B, nx], t) -> u [B, nu], or with `hold=K`: asked at the start of each
  of K equal intervals, its answer held;
- open loop, where it is an array u [B, K, nu]: held.

On a problem with parameters they are functions of (x, t, p), p [B, np]; those of a problem without, of (x, t).

The judge clips every control to U, and starts CVODES anew wherever a control or a state jumps. Constraints are judged
between the nodes too, at BETWEEN times in each interval, those that hold the control under the one that acts there.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from nocl.constraints import TOLERANCE
from nocl.ocp import OCP
from nocl.scales import units
from nocl.smoothness import kinks
from nocl.support import checks, interrupt
from nocl.support.checks import Array
from nocl.translate.arguments import Arguments

Kicks = Sequence[tuple[float, ArrayLike]]
MULTISTEP = ("adams", "bdf")  # the second, for stiff loops, where the first gives up; same tolerances
BETWEEN = 8  # times in an interval that constraints are judged at
AT_BOUND = 1e-9  # of the width of U: closer than this counts as saturated


@dataclass(frozen=True, eq=False)
class Simulation:
    """B closed or open loops from t0 to the horizon; one that fails has success False and says why.

    A run fails that does not get to the horizon (`reached` False, the cost infinite), or that violates a constraint by
    more than the tolerance: what it cost is told, and counts in no comparison.
    """

    t: Array  # [K+1] nodes
    x: Array  # [B, K+1, nx], NaN after a failure; a kick at a node is included
    u: Array  # [B, K+1, nu], clipped to U; a held control stands for [t_k, t_{k+1}), the last one twice
    cost: Array  # [B], running + terminal, inf where the horizon was not reached
    running_cost: Array  # [B], integral of L, exact (no penalty)
    terminal_cost: Array  # [B], G(x(T))
    terminal_error: Array  # [B], ||x(T) - x*||_2, x* the nearest image of the goal (OCP.from_goal); NaN without a goal
    control_magnitude: Array  # [B], mean of ||u||_2 over time
    saturation: Array  # [B], share of time with a control at a bound
    clearance: Array  # [B], min of all constraints, at and between nodes, and at the end, in units of their scales; of
    # a problem with path constraints alone in their own units; inf if there are none
    violation: Array  # [B], the largest of any, as a share of that constraint's own scale (OCP.violation); 0: none
    success: NDArray[np.bool_]  # [B], whether it reached the horizon with all constraints held
    message: Sequence[str]  # [B], "" or what failed, at which time and state; or what is violated, and by how much
    reached: NDArray[np.bool_]  # [B], whether it reached the horizon
    worst: NDArray[np.int64]  # [B], which row of OCP.shares is violated most; -1: none is


def simulate(ocp: OCP, controller: Any, x0: ArrayLike, *, f: Any = None, hold: int | None = None, nodes: int = 81,
             kicks: Kicks | None = None, delay: float = 0.0, t0: float = 0.0, p: Any = None, rtol: float = 1e-9,
             atol: float = 1e-10, tolerance: float = TOLERANCE) -> Simulation:
    """Run and score a controller on an OCP from states x0 [nx] or [B, nx].

    Parameters
    ----------
    controller : policy:(x, t[, p]) -> u as a casadi.Function or by `to_casadi()`, callable, or controls [B, K, nu]
    p : parameters, where the problem has them: [np] for all, [B, np], or by name (OCP.parameters_of)
    f : casadi.Function (x, u[, t][, p]) -> xdot, or an object with `to_casadi()`
        Another plant than the exact one.
    hold : K, sample the feedback at K equal intervals; default: continuous where it can be, else nodes - 1
    nodes : number of nodes that continuous feedback is recorded at
    kicks : (time, dx [nx] or [B, nx]), added to the state at that time
    delay : time from a sample of the state to its control, at most an interval; the last control acts meanwhile. The
        first control is there at once: where a run starts is known before it does
    t0 : start, so that a tail of the horizon can be judged
    tolerance : a run that violates a constraint by more than this share of its scale has failed

    Raises ValueError for shapes that do not fit, and for a problem whose horizon is free. A state that blows up or a
    NaN control is a row with success False.
    """
    checks.problem(ocp, "simulate")
    ocp.refuse_free("simulate")
    check_made_for(ocp, controller, "the controller")
    rows, _ = checks.states(x0, ocp.system.nx, ocp.system.name)
    t0 = _check_options(ocp, hold, nodes, t0)
    for name, value in (("rtol", rtol), ("atol", atol)):
        checks.number(value, name, "simulate", positive=True)
    most = checks.number(tolerance, "tolerance", "simulate")
    values = ocp.parameters_of(p, len(rows), "simulate")
    judge = _Judge(ocp, dynamics_function(ocp, f), values, float(rtol), float(atol), most)
    jumps = _jumps(ocp, kicks, len(rows), t0)
    policy = policy_function(ocp, controller)
    if policy is not None and hold is None:
        _check_delay(delay, 0.0, "continuous feedback: give `hold`")
        return judge.continuous(policy, rows, np.linspace(t0, ocp.horizon, nodes), jumps)
    if isinstance(controller, (np.ndarray, list, tuple)):
        ask, K = _open_loop(ocp, controller, len(rows), hold, t0)
        _check_delay(delay, 0.0, "open loop, which samples nothing")
    else:
        ask, K = _feedback(ocp, controller, policy, values), hold or nodes - 1
        _check_delay(delay, (ocp.horizon - t0) / K, f"feedback that is sampled {K} times: sample it less often")
    return judge.held(ask, rows, np.linspace(t0, ocp.horizon, K + 1), jumps, delay)


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


def _check_options(ocp: OCP, hold: int | None, nodes: int, t0: float) -> float:
    """t0, a float; ValueError where one of them is wrong."""
    if hold is not None:
        checks.whole(hold, "hold", "simulate (None: continuous feedback)", 1)
    checks.whole(nodes, "nodes", "simulate", 2)
    return checks.start_time(t0, ocp.horizon)


def _check_delay(delay: float, most: float, of: str) -> None:
    found = checks.finite(delay)
    if found is None or not 0 <= found <= most * (1 + 1e-9):
        raise ValueError(f"delay is {delay!r}; expected 0 <= delay <= {most:g} for {of}")


def _jumps(ocp: OCP, kicks: Kicks | None, B: int, t0: float) -> list[tuple[float, Array]]:
    """The kicks in order of time, as rows [B, nx]."""
    jumps = []
    if not isinstance(kicks, (list, tuple, type(None))) or \
            not all(isinstance(kick, (list, tuple)) and len(kick) == 2 for kick in kicks or ()):
        raise ValueError(f"simulate: kicks is {checks.shown(kicks)}; expected a list of pairs (time, dx [nx] or "
                         "[B, nx])")
    for when, dx in kicks or ():
        time = checks.between(when, -np.inf, np.inf, "the time of a kick", "simulate")
        what, expected = f"the kick at t = {time:g}", f"finite ({ocp.system.nx},) or ({B}, {ocp.system.nx})"
        d = checks.numeric(dx, what, "simulate", expected)
        if d.shape not in ((ocp.system.nx,), (B, ocp.system.nx)) or not np.isfinite(d).all():
            raise ValueError(f"{what} has shape {d.shape}; expected {expected}")
        if not t0 <= time <= ocp.horizon:
            raise ValueError(f"a kick at t = {time:g}; expected a time in [{t0:g}, {ocp.horizon:g}]")
        jumps.append((time, np.broadcast_to(d, (B, ocp.system.nx))))
    return sorted(jumps, key=lambda jump: jump[0])


Ask = Callable[[Array, float, int], Array]  # (x [B, nx], t, interval) -> u [B, nu]


def _open_loop(ocp: OCP, controls: ArrayLike, B: int, hold: int | None, t0: float) -> tuple[Ask, int]:
    u = checks.numeric(controls, "the controls", "simulate", f"[B, K, nu] = [{B}, K, {ocp.system.nu}]")
    if u.ndim == 2 and B == 1:
        u = u[None]
    if u.ndim != 3 or u.shape[0] != B or u.shape[2] != ocp.system.nu or u.shape[1] < 1:
        raise ValueError(f"controls have shape {np.shape(controls)}; expected [B, K, nu] = [{B}, K, {ocp.system.nu}]: "
                         "one row of K held controls for each x0")
    if hold not in (None, u.shape[1]):
        raise ValueError(f"hold is {hold}, but the controls have K = {u.shape[1]} intervals; expected these: leave "
                         "hold out")
    return (lambda x, t, k: u[:, k]), u.shape[1]


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


def _feedback(ocp: OCP, controller: Any, policy: ca.Function | None, p: Array) -> Ask:
    nu = ocp.system.nu
    if policy is None and not callable(controller):
        raise ValueError(f"the controller is a {type(controller).__name__}; expected a callable (x, t) -> u, "
                         "a casadi.Function, an object with to_casadi(), or controls [B, K, nu]")
    more = [p] if takes_p(ocp, controller) else []
    if policy is None:
        check_takes_p(ocp, controller)
    columns = [p.T] if ocp.np else []

    def ask(x: Array, t: float, k: int) -> Array:
        answer = answer_of(controller, x, t, *more) if policy is None else policy(x.T, t, *columns).full().T
        u = checks.numeric(answer, "the controller's answer", "simulate", f"[B, nu] = [{len(x)}, {nu}]")
        if u.shape != (len(x), nu):
            raise ValueError(f"the controller answered with shape {u.shape} at t = {t:g}; expected [B, nu] = "
                             f"[{len(x)}, {nu}] for x of shape {x.shape}")
        return u

    return ask


def answer_of(controller: Any, x: Array, t: float, *p: Array | None) -> Any:
    """A callable's answer; ValueError where it does not take (x, t), or (x, t, p)."""
    try:
        return controller(x, t, *p)
    except TypeError as error:
        form = "(x [B, nx], t, p [B, np])" if p else "(x [B, nx], t)"
        raise ValueError(f"the controller raised {error} at t = {t:g}; expected a callable {form} -> u [B, nu]"
                         ) from error


class _Judge:
    """CVODES on one problem and plant; z = [x, integral of L]. p [B, np] are the parameters of each row."""

    def __init__(self, ocp: OCP, f: ca.Function, p: Array, rtol: float, atol: float, tolerance: float) -> None:
        self.ocp, self.f, self.p, self.tolerance = ocp, f, p, tolerance
        self.options = {"reltol": rtol, "abstol": atol, "quad_err_con": True, "disable_internal_warnings": True,
                        "show_eval_warnings": False, "max_num_steps": 20000}

    @cached_property
    def jumps(self) -> str:
        """Where f jumps in X x U, in words; "" where it does not, or is no SX."""
        at, box = self.ocp.functions.on(self.f).stage, self.ocp.stage_box
        if not isinstance(at.x, ca.SX):
            return ""
        found = [kink for row in ca.vertsplit(at.xdot) for kink in kinks(row, ca.vertcat(*at.inputs), *box)]
        return ", ".join(dict.fromkeys(f"{kink.where} = 0" for kink in found if kink.what == "jump"))

    def blow_up(self, t: float, x: Array, until: float, what: str = "the state blows up") -> str:
        """Why CVODES did not get from x at t to `until`: beside a jump of f a state that stays in X did not blow up."""
        s = self.ocp.system
        if self.jumps and (np.abs(x - (s.lbx + s.ubx) / 2) <= s.ubx - s.lbx).all():
            what = f"the integrator gave up, chattering where f jumps ({self.jumps}; try tanh(e / width) for sign(e)),"
        return _failure(what, t, x, until)

    def integrator(self, dae: dict[str, Any], grid: Array, method: str) -> ca.Function:
        """From 0 to the times in `grid`."""
        options: dict[str, Any] = {**self.options, "linear_multistep_method": method}
        return ca.integrator("judge", "cvodes", dae, 0.0, list(grid), options)

    def feedback_dae(self, policy: ca.Function) -> dict[str, Any]:
        """dz/dtau = scale * (f, L)(x, clip(policy(x, t))), t = start + scale * tau; the quadrature is of ||u||.

        Its parameters are (start, scale, p).
        """
        nx, n = self.ocp.system.nx, self.ocp.np
        z, tau, p = ca.MX.sym("z", nx + 1), ca.MX.sym("tau"), ca.MX.sym("p", 2 + n)
        x, t = self.sized(z)[:nx], p[0] + p[1] * tau
        u = self.clip(policy(x, t, *([p[2:]] if n else [])))
        ode = self.rates(x, u, t, p[2:])
        return {"x": z, "t": tau, "p": p, "ode": p[1] * self.scaled(ode), "quad": p[1] * ca.norm_2(u)}

    def held_dae(self) -> dict[str, Any]:
        """dz/dtau = scale * (f, L)(x, u), u held: an interval of any length is tau in [0, 1].

        Its parameters are (u, p, start, scale), `start` where the problem holds the time.
        """
        s, n, timed = self.ocp.system, self.ocp.np, self.ocp.uses_time
        sym: Any = ca.SX if self.f.is_a("SXFunction") else ca.MX
        z, p = sym.sym("z", s.nx + 1), sym.sym("p", s.nu + n + timed + 1)
        x, u, scale = self.sized(z)[:-1], p[:s.nu], p[-1]
        if not timed:
            return {"x": z, "p": p, "ode": scale * self.scaled(self.rates(x, u, 0.0, p[s.nu:-1]))}
        tau = sym.sym("tau")
        ode = self.rates(x, u, p[-2] + scale * tau, p[s.nu:-2])
        return {"x": z, "t": tau, "p": p, "ode": scale * self.scaled(ode)}

    def rates(self, x: Any, u: Any, t: Any, p: Any) -> Any:
        """(f, L) at one moment."""
        at = Arguments({"x": x, "u": u, "t": t, "p": p})
        return ca.vertcat(at.call(self.f), at.call(self.ocp.L))

    @cached_property
    def unit(self) -> Array:
        """What 1 stands for in each of z, for CVODES' absolute tolerance; 1 in ordinary problems."""
        of = units(self.ocp)
        return np.r_[of.x, of.cost]

    def sized(self, z: Any) -> Any:
        return z if (self.unit == 1).all() else z * self.unit

    def scaled(self, z: Any) -> Any:
        return z if (self.unit == 1).all() else z / self.unit

    def integrate(self, solver: ca.Function, z: Array, p: Any) -> tuple[Array | None, float]:
        """(states at the solver's times, last quadrature), or None where CVODES fails or yields NaN."""
        try:
            with interrupt.kept():
                result = solver(x0=z / self.unit, p=p)
        except RuntimeError:
            return None, np.nan
        end, quad = result["xf"].full() * self.unit[:, None], result["qf"].full()
        if not np.isfinite(end).all():
            return None, np.nan
        return end, float(quad[0, -1]) if quad.size else 0.0

    def clip(self, u: Any) -> Any:
        """u in U; written so that NaN stays NaN (fmin and fmax would hide it)."""
        s = self.ocp.system
        return u - ca.fmax(u - s.ubu, 0) + ca.fmax(s.lbu - u, 0)

    def continuous(self, policy: ca.Function, x0: Array, t: Array, jumps: list[tuple[float, Array]]) -> Simulation:
        dae, B, nx, nodes, m = self.feedback_dae(policy), len(x0), x0.shape[1], t, self.between
        t = np.interp(np.arange((len(nodes) - 1) * m + 1) / m, np.arange(len(nodes)), nodes)  # m times an interval
        x = np.full((B, len(t), nx), np.nan)
        z, magnitude, message = np.c_[x0, np.zeros(B)], np.zeros(B), [""] * B
        edges = np.unique(np.r_[t[0], [time for time, _ in jumps], t[-1]])
        for a, b in pairwise(edges):
            z[:, :nx] += sum(dx for time, dx in jumps if time == a)
            x[:, t == a] = z[:, None, :nx]
            inside = (t > a) & (t < b)
            segment = _Segment(self, dae, a, np.r_[t[inside], b])
            for i in range(B):
                if not message[i]:
                    path, magnitude_i, message[i] = segment.run(z[i], self.p[i])
                    x[i, inside], z[i] = path[:-1, :nx], path[-1]
                    magnitude[i] += magnitude_i
        z[:, :nx] += sum(dx for time, dx in jumps if time == t[-1])
        x[:, -1] = z[:, :nx]
        if self.ocp.states_only:
            least = self.ocp.least(x, t, self.p)
        else:
            least = self.ocp.least_held(x, self.answers(policy, x, t), t, self.p)
        x, t = x[:, ::m].copy(), nodes
        u = self.answers(policy, x, t)
        weight = np.gradient(t) * np.r_[0.5, np.ones(len(t) - 2), 0.5] if len(t) > 2 else np.diff(t).repeat(2) / 2
        saturation = self.at_bound(u) @ (weight / weight.sum())
        return self.score(t, x, u, z[:, -1], magnitude / (t[-1] - t[0]), saturation, least, message)

    def answers(self, policy: ca.Function, x: Array, t: Array) -> Array:
        """The policy's controls [B, n, nu] at states x [B, n, nx] of times t [n], in U."""
        B, s = len(x), self.ocp.system
        p = [np.repeat(self.p, len(t), axis=0).T] if self.ocp.np else []
        u = policy(x.reshape(-1, s.nx).T, np.tile(t, B)[None], *p).full().T.reshape(B, len(t), -1)
        return np.clip(u, s.lbu, s.ubu)

    def held(self, ask: Ask, x0: Array, t: Array, jumps: list[tuple[float, Array]], delay: float = 0.0) -> Simulation:
        B, nx, K, nu = len(x0), x0.shape[1], len(t) - 1, self.ocp.system.nu
        step, least = _Step(self), np.full((B, len(self.ocp.functions.rows)), np.inf)
        x, u = np.full((B, K + 1, nx), np.nan), np.full((B, K + 1, nu), np.nan)
        z, message = np.c_[x0, np.zeros(B)], [""] * B
        for k in range(K):
            z[:, :nx] += sum(dx for time, dx in jumps if time == t[k])
            u[:, k] = np.clip(ask(z[:, :nx].copy(), float(t[k]), k), self.ocp.system.lbu, self.ocp.system.ubu)
            alive = np.array([not m for m in message])
            x[alive, k] = z[alive, :nx]
            for i in np.flatnonzero(alive & ~np.isfinite(u[:, k]).all(axis=1)):
                message[i] = _failure("the control is NaN", t[k], z[i, :nx])
            middle = [jump for jump in jumps if t[k] < jump[0] < t[k + 1]]
            late = t[k] + (delay if k else 0.0)
            edges = np.unique(np.r_[t[k], [time for time, _ in middle], min(late, t[k + 1]), t[k + 1]])
            for a, b in pairwise(edges):
                z[:, :nx] += sum(dx for time, dx in middle if time == a)
                acts, start = u[:, k - 1] if a < late else u[:, k], z[:, None, :nx].copy()
                path = step.run(z, acts, a, b, message)
                least = np.minimum(least, self.under(acts, start, path, a + (b - a) * np.r_[0.0, step.grid]))
        z[:, :nx] += sum(dx for time, dx in jumps if time == t[-1])
        x[:, -1], u[:, -1] = z[:, :nx], u[:, -2]
        magnitude = np.linalg.norm(u[:, :-1], axis=2).mean(axis=1)
        least = np.minimum(least, self.at_nodes(x, u, t))
        return self.score(t, x, u, z[:, -1], magnitude, self.at_bound(u[:, :-1]).mean(axis=1), least, message)

    def under(self, u: Array, start: Array, path: Array, t: Array) -> Array:
        """Least values of the constraints on the way from `start` [B, 1, nx] along `path` [B, m, nx] under u [B, nu];
        t [m + 1] are the times of both."""
        if self.ocp.states_only:
            return self.ocp.least(path, t[1:], self.p)
        x = np.concatenate([start, path], axis=1)
        return self.ocp.least_held(x, np.repeat(u[:, None], len(t), axis=1), t, self.p)

    def at_nodes(self, x: Array, u: Array, t: Array) -> Array:
        """Those at the nodes; constraints that hold the control were looked at on the way."""
        if self.ocp.states_only:
            return self.ocp.least(x, t, self.p)
        return self.ocp.least_held(x, u[:, :0], t, self.p)

    def at_bound(self, u: Array) -> Array:
        """Whether any control is at a bound, [B, K], as 0 or 1."""
        s = self.ocp.system
        near = AT_BOUND * (s.ubu - s.lbu)
        return ((u <= s.lbu + near) | (u >= s.ubu - near)).any(axis=2).astype(float)

    @property
    def between(self) -> int:
        """Times in an interval that the state is recorded at."""
        return BETWEEN if self.ocp.held else 1

    def score(self, t: Array, x: Array, u: Array, running: Array, magnitude: Array, saturation: Array,
              least: Array, message: list[str]) -> Simulation:
        reached, ocp = np.array([not m for m in message]), self.ocp
        x[~reached, -1] = np.nan
        end = ocp.functions.end.columns(x=x[:, -1], p=self.p)
        terminal = np.where(reached, ocp.G(*end).full().ravel(), np.inf)
        running = np.where(reached, running, np.inf)
        off = np.linalg.norm(ocp.from_goal(x[:, -1], self.p), axis=1) if ocp.has_goal else np.nan
        error = np.where(reached, off, np.inf)
        u[~np.isfinite(x).all(axis=2)] = np.nan
        at_end = ocp.least_at_end(x[:, -1], self.p)
        violation, worst = ocp.violation(least, at_end), self.worst(ocp.shares(least, at_end))
        beyond = reached & (violation > self.tolerance)
        for i in np.flatnonzero(beyond):
            name, much = ocp.excess(worst[i], violation[i])
            message[i] = f"violates {name!r} by {much}"
        return Simulation(t, x, u, running + terminal, running, terminal, error, np.where(reached, magnitude, np.nan),
                          np.where(reached, saturation, np.nan), ocp.nearest(least, at_end), violation,
                          reached & ~beyond, message, reached, worst)

    @staticmethod
    def worst(shares: Array) -> NDArray[np.int64]:
        """[B], the row that is violated most, -1 where none is."""
        found = np.c_[np.zeros(len(shares)), shares].argmax(axis=1) - 1
        return np.asarray(found, dtype=np.int64)


class _Segment:
    """Continuous feedback from time a to each of `times`, built once and run state by state."""

    def __init__(self, judge: _Judge, dae: dict[str, Any], a: float, times: Array) -> None:
        self.judge, self.dae, self.a, self.times = judge, dae, float(a), times
        self.solvers = {MULTISTEP[0]: judge.integrator(dae, times - a, MULTISTEP[0])}

    def run(self, z: Array, p: Array) -> tuple[Array, float, str]:
        """(z at the times [len(times), nx + 1], integral of ||u||, message) with the parameters p."""
        for method in MULTISTEP:
            if method not in self.solvers:
                self.solvers[method] = self.judge.integrator(self.dae, self.times - self.a, method)
            path, magnitude = self.judge.integrate(self.solvers[method], z, np.r_[self.a, 1.0, p])
            if path is not None:
                return path.T, magnitude, ""
        return self.locate(z, p)

    def locate(self, z: Array, p: Array) -> tuple[Array, float, str]:
        """Run again interval by interval, to say where it failed."""
        path = np.full((len(self.times), len(z)), np.nan)
        each = [self.judge.integrator(self.dae, np.array([1.0]), method) for method in MULTISTEP]
        a = self.a
        for k, b in enumerate(self.times):
            ends = (self.judge.integrate(step, z, np.r_[a, b - a, p])[0] for step in each)
            end = next((e for e in ends if e is not None), None)
            if end is None:
                return path, np.nan, self.judge.blow_up(a, z[:-1], float(b), "the state blows up or the control is NaN")
            path[k] = z = end[:, -1]
            a = float(b)
        return path, np.nan, _failure("CVODES did not reach the end", self.a, z[:-1], a)


class _Step:
    """Held controls over one interval, state by state: a mapped call is a tenth faster, but fails for all at once."""

    def __init__(self, judge: _Judge) -> None:
        dae, self.m, self.judge = judge.held_dae(), judge.between, judge
        self.grid = np.arange(1, self.m + 1) / self.m
        self.solvers = [judge.integrator(dae, self.grid, method) for method in MULTISTEP]

    def run(self, z: Array, u: Array, a: float, b: float, message: list[str]) -> Array:
        """Advance the rows of z whose message is empty from time a to b; write a message where one fails.

        Returns the states on the way [B, m, nx], NaN where there are none.
        """
        start = [np.full(len(u), a)] if self.judge.ocp.uses_time else []
        p = np.column_stack([u, self.judge.p, *start, np.full(len(u), b - a)])
        path = np.full((len(z), self.m, z.shape[1] - 1), np.nan)
        for i in (i for i, m in enumerate(message) if not m):
            ends = (self.judge.integrate(solver, z[i], p[i])[0] for solver in self.solvers)
            end = next((e for e in ends if e is not None), None)
            if end is None:
                message[i] = self.judge.blow_up(a, z[i, :-1], b)
            else:
                path[i], z[i] = end[:-1].T, end[:, -1]
        return path


def _failure(what: str, t: float, x: Array, until: float | None = None) -> str:
    when = f"at t = {t:.4g}" if until is None else f"between t = {t:.4g} and {until:.4g}"
    return f"{what} {when}, after x = {np.array2string(x, precision=4, separator=', ')}"
