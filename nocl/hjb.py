"""The Hamilton-Jacobi-Bellman equation along trajectories, and the four losses of CND, in torch.

min of int_0^T L(x, u) dt + G(x(T)) has the value V(x, t), with time running forward,

    V_t + H = 0,   H = L(x, u) + V_x' f(x, u),   dH/du = 0,   V(x, T) = G(x)

(dH/du = 0 where the optimal u lies inside U). Rows: x [N, nx], u [N, nu], t [N, 1], V, L, G [N, 1]; N = B, or all nodes
of a trajectory at once, B * (K+1). The functions given are `policy(x, t) -> u`, `value(x, t) -> V`,
`dynamics(x, u) -> xdot`, `L(x, u)` and `G(x)`: torch modules, or translations by `nocl.to_torch`. Any float dtype.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from nocl.translate.implicit import RadauStep
from nocl.translate.rk4 import rk4, rk4_cost

Map = Callable[..., Tensor]  # of one or two tensors of rows
Step = Callable[..., tuple[Any, Any]]  # (f, L, x, u, h) -> (x after h with u held, integral of L)
SMOOTH = 1e-6  # sqrt(|g|^2 + SMOOTH^2) - SMOOTH stands for |g|: its gradient is 0 at g = 0, not NaN


@dataclass(frozen=True, eq=False)
class Rollout:
    """B trajectories under a policy, K steps long."""

    t: Tensor  # [K+1]
    x: Tensor  # [B, K+1, nx]
    u: Tensor  # [B, K, nu], at the first K nodes
    running: Tensor  # [B, 1], integral of L


@dataclass(frozen=True, eq=False)
class Losses:
    """The four terms of CND, scalars; `total` weighs them."""

    cost: Tensor  # E[int L dt + G(x(T))]
    hjb: Tensor  # mean |V_t + H| over nodes and trajectories
    final: Tensor  # mean |V(x(T), T) - G(x(T))|
    hamil: Tensor  # mean ||dH/du||_2 over nodes and trajectories

    def terms(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        return self.cost, self.hjb, self.final, self.hamil

    def total(self, weights: tuple[float, float, float, float] = (1.0, 1.0, 0.01, 0.01)) -> Tensor:
        """sum of weight * term; the default weights are the paper's."""
        return sum((w * term for w, term in zip(weights, self.terms(), strict=True) if w), torch.zeros_like(self.cost))


def euler_cost(f: Map, L: Map, x: Any, u: Any, h: Any) -> tuple[Any, Any]:
    """(x + h f(x, u), h L(x, u)): the step of CND's published code, first order; `rk4_cost` is nocl's."""
    return x + h * f(x, u), h * L(x, u)


def rollout(policy: Map, dynamics: Map, L: Map, x0: Tensor, T: float, K: int, *, t0: float = 0.0,
            step: Step = rk4_cost, hold: bool = True) -> Rollout:
    """Trajectories from x0 [B, nx] over [t0, T] in K equal steps.

    With `hold` the policy is asked at each node and held over the step, which `step` makes. Without, it is feedback in
    continuous time: it stands inside the ODE, which RK4 solves, or a RadauStep where that is the step, and is asked at
    each stage.
    Differentiable in whatever policy, dynamics, L and x0 depend on. More batch dimensions may stand in place of B.
    """
    h, x, column = (T - t0) / K, x0, (*x0.shape[:-1], 1)
    states, controls, running = [x0], [], x0.new_zeros(column)
    for k in range(K):
        t = x0.new_full(column, t0 + k * h)
        u = policy(x, t)
        if hold:
            x, cost = step(dynamics, L, x, u, h)
        elif isinstance(step, RadauStep):
            x, cost = step.fed_back(policy, dynamics, L, x, t, h)
        else:
            x, cost = _feedback_step(policy, dynamics, L, x, u, t, h)
        running = running + cost
        states.append(x)
        controls.append(u)
    nodes = torch.linspace(t0, T, K + 1, dtype=x0.dtype, device=x0.device)
    return Rollout(nodes, torch.stack(states, -2), torch.stack(controls, -2), running)


def _feedback_step(policy: Map, dynamics: Map, L: Map, x: Tensor, u: Tensor, t: Tensor, h: float,
                   ) -> tuple[Tensor, Tensor]:
    """RK4 on z = (x, t, integral of L) with u = policy(x, t) inside; u is its known answer at the first stage."""
    first = [u]

    def field(z: Tensor, _: None) -> Tensor:
        x, t = z[..., :-2], z[..., -2:-1]
        u = first.pop() if first else policy(x, t)
        return torch.cat([dynamics(x, u), torch.ones_like(t), L(x, u)], -1)

    z = rk4(field, torch.cat([x, t, torch.zeros_like(t)], -1), None, h)
    return z[..., :-2], z[..., -1:]


def hamiltonian(dynamics: Map, L: Map, x: Tensor, u: Tensor, costate: Tensor) -> Tensor:
    """H = L(x, u) + costate' f(x, u), [N, 1], at the given u: no minimum over u is taken."""
    return L(x, u) + (costate * dynamics(x, u)).sum(-1, keepdim=True)


def value_gradients(value: Map, x: Tensor, t: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """(V [N, 1], V_x [N, nx], V_t [N, 1]) as partial derivatives: how x and t came about plays no part in them.

    They stay differentiable, in the parameters of V and in x and t.
    """
    with torch.enable_grad():
        x, t = _leaf(x), _leaf(t)
        V = value(x, t)
        V_x, V_t = torch.autograd.grad(V.sum(), (x, t), create_graph=True, materialize_grads=True)
    return V, V_x, V_t


def _leaf(z: Tensor) -> Tensor:
    """An alias of z to differentiate by: its own node of the graph, so that the caller's tensor is left alone."""
    return z.view_as(z) if z.requires_grad else z.detach().requires_grad_()


def hjb_residual(value: Map, dynamics: Map, L: Map, x: Tensor, u: Tensor, t: Tensor) -> Tensor:
    """V_t + L(x, u) + V_x' f(x, u), [N, 1]: zero for the optimal V and u. Time runs forward."""
    _, V_x, V_t = value_gradients(value, x, t)
    return V_t + hamiltonian(dynamics, L, x, u, V_x)


def terminal_residual(value: Map, G: Map, x: Tensor, T: float | Tensor) -> Tensor:
    """V(x, T) - G(x), [N, 1]: zero for the optimal V; T a number or a tensor of one."""
    return value(x, torch.as_tensor(T, dtype=x.dtype, device=x.device).expand(*x.shape[:-1], 1)) - G(x)


def hamiltonian_gradient(value: Map, dynamics: Map, L: Map, x: Tensor, u: Tensor, t: Tensor) -> Tensor:
    """dH/du = L_u + f_u' V_x, [N, nu], with x, t and V_x held: zero where the optimal u lies inside U.

    It stays differentiable in everything, the parameters of V among them, as in the paper; give a value whose
    parameters are frozen to train the policy only.
    """
    _, V_x, _ = value_gradients(value, x, t)
    return _gradient_in_u(dynamics, L, x, u, V_x)


def _gradient_in_u(dynamics: Map, L: Map, x: Tensor, u: Tensor, V_x: Tensor) -> Tensor:
    with torch.enable_grad():
        u = _leaf(u)
        H = hamiltonian(dynamics, L, x, u, V_x)
        return torch.autograd.grad(H.sum(), u, create_graph=True, materialize_grads=True)[0]


def smooth_norm(g: Tensor) -> Tensor:
    """||g||_2 of each row [N], with gradient 0 at g = 0."""
    return (g.square().sum(-1) + SMOOTH**2).sqrt() - SMOOTH


def losses(policy: Map, value: Map, dynamics: Map, L: Map, G: Map, x0: Tensor, T: float, K: int, *, t0: float = 0.0,
           step: Step = rk4_cost, hold: bool = True, detach: bool = False) -> Losses:
    """The losses of CND on trajectories from x0 [B, nx] over [t0, T] in K steps; step, hold: see `rollout`.

    The HJB residual and dH/du are taken at the first K nodes, with the policy's u there. As in the paper
    everything is trained through everything. With `detach` the states of the trajectory are constants in all but
    L_cost: V is fitted where the policy goes, and the policy does not change its course to make V's fit look better.
    """
    path = rollout(policy, dynamics, L, x0, T, K, t0=t0, step=step, hold=hold)
    return path_losses(path, policy, value, dynamics, L, G, detach=detach)


def path_losses(path: Rollout, policy: Map, value: Map, dynamics: Map, L: Map, G: Map, *,
                detach: bool = False) -> Losses:
    """The losses of CND on given trajectories; see `losses`."""
    B, K, nu = path.u.shape
    x, t = path.x[:, :-1].reshape(B * K, -1), path.t[:-1].repeat(B)[:, None]
    x_T, T = path.x[:, -1], path.t[-1]  # no number of it is asked: on a GPU that would wait
    cost = (path.running + G(x_T)).mean()
    if detach:
        x, x_T = x.detach(), x_T.detach()
        u = policy(x, t)
    else:
        u = path.u.reshape(B * K, nu)
    _, V_x, V_t = value_gradients(value, x, t)
    residual = V_t + hamiltonian(dynamics, L, x, u, V_x)
    return Losses(cost=cost, hjb=residual.abs().mean(), final=terminal_residual(value, G, x_T, T).abs().mean(),
                  hamil=smooth_norm(_gradient_in_u(dynamics, L, x, u, V_x)).mean())
