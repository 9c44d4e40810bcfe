"""The numerical scheme of level sets: upwind differences by the control that they belong to, and stretched axes.

At a node, with the left and right differences p- and p+ of V, the Hamiltonian is

    min_{u in U} L(x, u) + sum_i max(f_i(x, u), 0) p+_i + min(f_i(x, u), 0) p-_i:

each control is judged by the differences on the side that it drives to. With differences of first order this is the
monotone scheme of Kushner and Dupuis, Numerical methods for stochastic control problems in continuous time (2001);
Lax-Friedrichs' dissipation, max_u |f_i| (p+ - p-) / 2, is many times larger where the optimal u is gentle. Differences
by WENO and TVD Runge-Kutta steps as hj-reachability has them.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import hj_reachability as hj
import jax
import jax.numpy as jnp
import numpy as np

from nocl.definition.hamiltonian import hamiltonian, minimiser
from nocl.definition.ocp import OCP
from nocl.support.checks import Array
from nocl.translate.jax_functions import to_jax

REFINEMENTS = 12  # halvings of the search for a sampled minimum
SAFETY = 1.05  # on max |f_i| that was found by sampling
SAMPLED = 4096  # nodes at which the signs of f are looked at
BISECTIONS = 14  # of the slope at which a state stands still
STILL = 1e-12  # |f_i| below it: not driven to that side


@dataclass(frozen=True, eq=False)
class Axis:
    """Nodes x = goal + width sinh(y), y uniform: cells of width dy near the goal, in proportion to the distance far
    from it. An infinite width: uniform in x."""

    nodes: Array
    spacing: float  # in y
    goal: float
    width: float

    @property
    def y(self) -> Array:
        if np.isinf(self.width):
            return self.nodes
        return np.asarray(np.arcsinh((self.nodes - self.goal) / self.width))

    def slope(self, x: Any) -> Any:
        """dx/dy."""
        return jnp.ones_like(x) if np.isinf(self.width) else jnp.sqrt(self.width**2 + (x - self.goal) ** 2)


def axis(lower: float, upper: float, n: int, goal: float, width: float, periodic: bool) -> Axis:
    """n nodes over [lower, upper]; stretched ones have the goal on a node, and may pass an end by up to a cell."""
    if np.isinf(width):
        nodes = np.linspace(lower, upper, n, endpoint=not periodic)
        return Axis(nodes, float(nodes[1] - nodes[0]), goal, width)
    low, high = np.arcsinh((np.array([lower, upper]) - goal) / width)
    k = round(-low / (high - low) * (n - 1))
    k = min(max(k, int(low < 0)), n - 1 - int(high > 0))
    spacing = max(-low / k if k else 0.0, high / (n - 1 - k) if k < n - 1 else 0.0)
    return Axis(goal + width * np.sinh((np.arange(n) - k) * spacing), float(spacing), goal, width)


class Dynamics(hj.dynamics.Dynamics):
    """What hj-reachability asks of a problem, and the scheme's Hamiltonian."""

    def __init__(self, ocp: OCP, minimise: Minimiser, axes: tuple[Axis, ...], samples: int) -> None:
        self.minimise, self.axes = minimise, axes
        self.f, self.L = to_jax(ocp.functions.f), to_jax(ocp.L_soft)
        self.controls, self.safety = _extremes(ocp, samples)
        low, high = self._ends(jnp.asarray(_some(axes)))
        both = (low < -STILL) & (high > STILL)
        self.undecided = [i for i in range(len(axes)) if bool(both[..., i].any())]

    def __call__(self, state: Any, control: Any, disturbance: Any, time: Any) -> Any:
        return self.f(state, control)

    def optimal_control_and_disturbance(self, state: Any, time: Any, grad_value: Any) -> Any:
        return self.minimise.traced(state, grad_value)[0], None

    def partial_max_magnitudes(self, state: Any, time: Any, value: Any, grad_value_box: Any) -> Any:
        low, high = self._ends(state)
        return self.safety * jnp.maximum(-low, high)

    def upwind(self, states: Any, left: Any, right: Any) -> Any:
        """The Hamiltonian [...] of the differences in y [..., nx].

        Each axis along which all controls of a node drive to one side has the difference on that side; along the
        others the minimisers for the left one, the right one, and of those between them that nearest to 0 and that
        which holds the state still along the axis are tried, and the best is taken.
        """
        slopes = self._slopes(states)
        left, right = left / slopes, right / slopes
        nearest = jnp.clip(0.0, jnp.minimum(left, right), jnp.maximum(left, right))
        upwind = jnp.where(self._ends(states)[1] > STILL, right, left)
        best = jnp.full(states.shape[:-1], jnp.inf)
        for sides in itertools.product((left, right, nearest, None), repeat=len(self.undecided)):
            p = upwind
            for i, side in zip(self.undecided, sides, strict=True):
                p = p.at[..., i].set((left + right)[..., i] / 2 if side is None else side[..., i])
            for i, side in zip(self.undecided, sides, strict=True):
                p = p if side is not None else self._still(states, p, i, left, right)
            u = self.minimise.traced(states, p)[0]
            f = self.f(states, u)
            H = self.L(states, u)[..., 0] + jnp.sum(jnp.maximum(f, 0) * right + jnp.minimum(f, 0) * left, -1)
            best = jnp.minimum(best, H)
        return best

    def _still(self, states: Any, p: Any, i: int, left: Any, right: Any) -> Any:
        """p with its i-th entry between left and right where the minimiser drives along axis i neither way, by
        bisection: f_i at the minimiser of L + p'f falls as p_i rises. An end, where there is none."""
        low, high = jnp.minimum(left, right)[..., i], jnp.maximum(left, right)[..., i]
        for _ in range(BISECTIONS):
            middle = (low + high) / 2
            f = self.f(states, self.minimise.traced(states, p.at[..., i].set(middle))[0])[..., i]
            low, high = jnp.where(f > 0, middle, low), jnp.where(f > 0, high, middle)
        return p.at[..., i].set((low + high) / 2)

    def rate(self, states: Any) -> Any:
        """The most cells that a control crosses in a second, at any of the nodes."""
        low, high = self._ends(states)
        fastest = self.safety * jnp.maximum(-low, high) / self._slopes(states)
        return jnp.max(jnp.sum(fastest / jnp.array([a.spacing for a in self.axes]), -1))

    def _slopes(self, states: Any) -> Any:
        return jnp.stack([a.slope(states[..., i]) for i, a in enumerate(self.axes)], -1)

    def _ends(self, states: Any) -> tuple[Any, Any]:
        """(min_u f, max_u f) [..., nx]."""
        low, high = jnp.full(states.shape, jnp.inf), jnp.full(states.shape, -jnp.inf)
        for u in self.controls:
            f = self.f(states, jnp.broadcast_to(u, (*states.shape[:-1], len(u))))
            low, high = jnp.minimum(low, f), jnp.maximum(high, f)
        return low, high


def _some(axes: tuple[Axis, ...]) -> Array:
    """States [SAMPLED, nx] among the nodes."""
    rng = np.random.default_rng(0)
    return np.stack([rng.choice(a.nodes, SAMPLED) for a in axes], -1)


def integrator(order: int) -> Callable[..., Any]:
    """A TVD Runge-Kutta step of order 1 or 3 backwards in time, in the form of hj-reachability's time integrators."""

    def step(settings: Any, dynamics: Dynamics, grid: Any, time: Any, V: Any, target: Any) -> tuple[Any, Any]:
        h = jnp.minimum(settings.CFL_number / dynamics.rate(grid.states), time - target)

        def euler(V: Any) -> Any:
            return V + h * dynamics.upwind(grid.states, *grid.upwind_grad_values(settings.upwind_scheme, V))

        end = jnp.where(h < time - target, time - h, target)
        if order == 1:
            return end, euler(V)
        return end, V / 3 + 2 / 3 * euler(3 / 4 * V + euler(euler(V)) / 4)

    return step


INTEGRATORS = {1: integrator(1), 3: integrator(3)}


def lattice(axes: tuple[Axis, ...], periodic: Array) -> Any:
    """The grid: uniform in y, its states x."""
    edges = tuple(hj.boundary_conditions.periodic if p else _rising for p in periodic)
    grid = hj.Grid.from_lattice_parameters_and_boundary_conditions(
        hj.sets.Box(jnp.array([a.y[0] for a in axes]),
                    jnp.array([a.y[0] + a.spacing * (len(a.nodes) - (not p)) for a, p
                               in zip(axes, periodic, strict=True)])),
        tuple(len(a.nodes) for a in axes), boundary_conditions=edges)
    states = jnp.stack(jnp.meshgrid(*(jnp.asarray(a.nodes) for a in axes), indexing="ij"), -1)
    return grid.replace(states=states)


def _rising(V: Any, width: int) -> Any:
    """V along an axis with `width` more nodes at both ends, rising outwards with the slope at the end, up or down.

    Extrapolated as it is, a V that falls towards an edge falls beyond it without end: below 0, and then inside too.
    """
    k = jnp.arange(1, width + 1)
    return jnp.concatenate([V[0] + jnp.abs(V[1] - V[0]) * k[::-1], V, V[-1] + jnp.abs(V[-1] - V[-2]) * k])


def eased(ocp: OCP, slope: float) -> OCP:
    """The OCP with penalties that rise in proportion to depth where penalty * depth^2 is steeper than `slope`.

    Its V is nowhere above the OCP's, and equal where its optimum does not go that deep: a slope that makes a
    shortcut dearer than the way round is enough.
    """
    if ocp.penalty == 0:
        return ocp
    added = ca.SX(0)
    for h in ocp.functions.penalised:
        depth = ca.fmax(ocp.penalty_margin - h, 0)
        bent = ca.fmin(depth, slope / (2 * ocp.penalty))
        added += ocp.penalty * bent**2 + slope * (depth - bent)
    return replace(ocp.unconstrained, running=ocp.functions.running + added)


def _extremes(ocp: OCP, samples: int) -> tuple[Array, float]:
    """Controls among which |f_i| is largest, and a safety factor: U's corners, exact where f is affine in each u_i."""
    s, at = ocp.system, ocp.functions.stage
    bent = [ca.jacobian(ca.jacobian(at.xdot, at.u[i]), at.u[i]).nnz() for i in range(s.nu)]
    n, safety = (samples, SAFETY) if any(bent) else (2, 1.0)
    ends = [np.linspace(low, high, n) for low, high in zip(s.lbu, s.ubu, strict=True)]
    return np.array(list(itertools.product(*ends))), safety


@dataclass(frozen=True, eq=False)
class Minimiser:
    """argmin_u H: `traced` on JAX arrays, (x [..., nx], p) -> (u [..., nu], H [...]); `rows` on numpy's, -> u."""

    traced: Callable[[Any, Any], tuple[Any, Any]]
    rows: Callable[[Array, Array], Array]


def exact_minimiser(ocp: OCP) -> Minimiser | None:
    """In closed form, or None."""
    best = minimiser(ocp)
    if best is None:
        return None
    translated = to_jax(best)

    def traced(x: Any, p: Any) -> tuple[Any, Any]:
        u, H = translated(x, p)
        return u, H[..., 0]

    return Minimiser(traced, lambda x, p: np.asarray(best(x.T, p.T)[0].full().T, dtype=np.float64))


def sampled_minimiser(ocp: OCP, samples: int) -> Minimiser:
    """The best of samples^nu controls, then of the 3^nu round it, REFINEMENTS times at half the distance."""
    H, s = to_jax(hamiltonian(ocp)), ocp.system
    lb, ub = np.asarray(s.lbu), np.asarray(s.ubu)
    first = np.array(list(itertools.product(np.linspace(0.0, 1.0, samples), repeat=s.nu))) * (ub - lb) + lb
    around = np.array(list(itertools.product((-1.0, 0.0, 1.0), repeat=s.nu)))

    def traced(x: Any, p: Any) -> tuple[Any, Any]:
        batch = x.shape[:-1]

        def better(u: Any, best: tuple[Any, Any]) -> tuple[Any, Any]:
            value = H(x, u, p)[..., 0]
            return jnp.where((value < best[1])[..., None], u, best[0]), jnp.minimum(value, best[1])

        def sample(k: Any, best: tuple[Any, Any]) -> tuple[Any, Any]:
            return better(jnp.broadcast_to(jnp.asarray(first)[k], (*batch, s.nu)), best)

        def closer(k: Any, best: tuple[Any, Any]) -> tuple[Any, Any]:
            centre, width = best[0], (ub - lb) / (samples - 1) * 0.5 ** (k + 1)
            for direction in around:
                best = better(jnp.clip(centre + direction * width, lb, ub), best)
            return best

        nothing = jnp.zeros((*batch, s.nu)), jnp.full(batch, jnp.inf)
        return jax.lax.fori_loop(0, REFINEMENTS, closer, jax.lax.fori_loop(0, len(first), sample, nothing))

    compiled = jax.jit(traced)

    def rows(x: Array, p: Array) -> Array:
        with jax.enable_x64(True):
            return np.asarray(compiled(x, p)[0], dtype=np.float64)

    return Minimiser(traced, rows)
