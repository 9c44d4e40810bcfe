"""CND as its paper has it: u and V trained together by Adam on rollouts, by the four losses of `nocl.hjb`, no labels.

Control with Neural Dynamics, section "Method": the controller is an MLP u(x) whose tanh output is rescaled to U,
V(x, t) an MLP with tanh and a skip connection, both initialised uniformly at random; the loss is L_cost + L_HJB + 0.01
L_final + 0.01 L_hamil; Adam from 0.01 with exponential decay. What is decided here because the paper leaves it open, or
departs from it because the plain recipe fails, is a field of `PaperSettings`, and can be undone:

- clip: gradients through a swing-up reach norms of 10^3 at random controllers; unclipped, training throws them away.
- race: from one random start the swing-up is a matter of luck; several start side by side on L_cost, the best goes on.
- sin_cos: angles go in as sin and cos too, so that u is periodic where it should be.
- rollouts are RK4 with the controller inside the ODE. With hold=True they are nocl's discretisation for NMPC, several
  times as fast (the race's always are), but then the controller is one for that control rate: trained at 12.5 Hz to
  cost 0.106, cart-pole's has 0.67 in continuous time; trained inside the ODE, 0.147 in a quarter of the iterations.
  step="euler" with hold=True is the published code.

Without clip, race and sin_cos cart-pole's cost is 4.5 after 600 iterations (it does not swing up; one seed).
"""

from __future__ import annotations

import copy
import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import casadi as ca
import numpy as np
import torch
from torch import Tensor
from torch.func import functional_call, stack_module_state
from tqdm import tqdm

from nocl import hjb
from nocl.fused import FusedStep
from nocl.integrate import rk4_cost
from nocl.nets import ACTIVATIONS, MLP, FeatureNet
from nocl.ocp import OCP
from nocl.to_torch import to_torch

STEPS: dict[str, hjb.Step] = {"rk4": rk4_cost, "euler": hjb.euler_cost}
TERMS = ("cost", "hjb", "final", "hamil")
CHECKS = 40  # times that L_cost is measured on held-out initial states, the best networks kept
HELD_OUT = 128  # initial states for that
BAD_STEPS = 10  # updates in a row that may be skipped for a gradient that overflowed
LAST = 20  # iterations that a race is judged by


@dataclass(frozen=True)
class PaperSettings:
    """Settings of method="paper"; the defaults are the paper's wherever it says."""

    hidden: Sequence[int] = (64, 64)  # widths of the controller's hidden layers
    value_hidden: Sequence[int] = (64, 64)  # widths of the value function's
    activation: str = "tanh"
    time_input: bool = False  # True: u(x, t), which the optimum of a finite horizon needs; the paper has u(x)
    sin_cos: bool = True  # sin and cos of declared angles as inputs, beside their values
    intervals: int = 40  # K: steps of a rollout
    step: str = "rk4"  # or "euler", as published
    hold: bool = False  # False: feedback inside RK4's stages, as in a neural ODE; True: held over intervals
    fused: bool = True  # held RK4 steps of the exact f as compiled C on the CPU; False: in torch, same gradients
    iterations: int = 1000  # of Adam, after the race
    batch: int = 64  # initial states an iteration
    learning_rate: float = 0.01
    decay: float = 0.01  # the learning rate falls exponentially, to this share of its start
    weights: tuple[float, float, float, float] = (1.0, 1.0, 0.01, 0.01)  # of L_cost, L_HJB, L_final, L_hamil
    clip: float | None = 1.0  # the gradient's norm, of u and of V each; None: not clipped
    detach: bool = False  # True: L_HJB, L_final, L_hamil see the trajectory's states as constants
    race: int = 8  # random initial controllers that start side by side; 1: no race
    race_iterations: int = 200  # of L_cost alone, for each of them
    race_batch: int = 16  # initial states an iteration, for each of them

    def __post_init__(self) -> None:
        for name in ("hidden", "value_hidden"):
            widths = tuple(getattr(self, name))
            if not widths or not all(_is_count(w) for w in widths):
                raise ValueError(f"PaperSettings: {name} is {widths}; expected widths of hidden layers, like (64, 64)")
            object.__setattr__(self, name, widths)
        for name in ("intervals", "iterations", "batch", "race", "race_iterations", "race_batch"):
            if not _is_count(getattr(self, name)):
                raise ValueError(f"PaperSettings: {name} is {getattr(self, name)!r}; expected an integer >= 1")
        self._check_numbers()
        for name in ("time_input", "sin_cos", "hold", "fused", "detach"):
            if not isinstance(getattr(self, name), bool):
                raise ValueError(f"PaperSettings: {name} is {getattr(self, name)!r}; expected True or False")
        if not self.hold and self.step != "rk4":
            raise ValueError(f"PaperSettings: step is {self.step!r} with hold=False; expected step='rk4', which "
                             "feedback in continuous time is integrated by")
        for name, known in (("activation", ACTIVATIONS), ("step", STEPS)):
            if getattr(self, name) not in known:
                raise ValueError(f"PaperSettings: {name} is {getattr(self, name)!r}; expected {', '.join(known)}")

    def _check_numbers(self) -> None:
        for name in ("learning_rate", "decay", "clip"):
            value = getattr(self, name)
            if not (value is None and name == "clip") and not (_is_number(value) and value > 0):
                raise ValueError(f"PaperSettings: {name} is {value!r}; expected a finite number > 0"
                                 + (", or None for no clipping" if name == "clip" else ""))
        if self.decay > 1:
            raise ValueError(f"PaperSettings: decay is {self.decay!r}; expected at most 1, which is no decay")
        weights: Any = tuple(self.weights) if isinstance(self.weights, (tuple, list)) else (self.weights,)
        if len(weights) != 4 or not all(_is_number(w) and w >= 0 for w in weights) or weights[0] == 0:
            raise ValueError(f"PaperSettings: weights is {weights}; expected four numbers >= 0, of L_cost (not 0), "
                             "L_HJB, L_final, L_hamil: the paper's are (1, 1, 0.01, 0.01)")
        object.__setattr__(self, "weights", weights)


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)


def _is_count(value: Any) -> bool:
    return isinstance(value, (int, np.integer)) and not isinstance(value, bool) and bool(value >= 1)


def controller_net(ocp: OCP, settings: PaperSettings) -> FeatureNet:
    """u(x) or u(x, t) = middle + half width * tanh(MLP): inside U by construction. Weights: torch's seed."""
    s, x, t = ocp.system, ocp.system.x, ca.SX.sym("t")
    phi = _features(ocp, t if settings.time_input else None, settings.sin_cos)
    y = ca.SX.sym("y", s.nu)
    u = ca.DM((s.lbu + s.ubu) / 2) + ca.DM((s.ubu - s.lbu) / 2) * ca.tanh(y)
    return FeatureNet(ca.Function("controller_inputs", [x, t], [phi], ["x", "t"], ["phi"]),
                      [MLP((phi.numel(), *settings.hidden, s.nu), settings.activation)],
                      ca.Function("controller_output", [x, t, y], [u], ["x", "t", "y"], ["u"]))


def value_net(ocp: OCP, settings: PaperSettings) -> FeatureNet:
    """V(x, t), an MLP with a linear skip connection."""
    x, t, y = ocp.system.x, ca.SX.sym("t"), ca.SX.sym("y")
    phi = _features(ocp, t, settings.sin_cos)
    return FeatureNet(ca.Function("value_inputs", [x, t], [phi], ["x", "t"], ["phi"]),
                      [MLP((phi.numel(), *settings.value_hidden, 1), settings.activation, skip=True)],
                      ca.Function("value_output", [x, t, y], [y], ["x", "t", "y"], ["V"]))


def _features(ocp: OCP, t: ca.SX | None, sin_cos: bool) -> ca.SX:
    """The state scaled by its box, sin and cos of its angles, 2 t / T - 1."""
    s = ocp.system
    phi = [(s.x - ca.DM((s.lbx + s.ubx) / 2)) / ca.DM((s.ubx - s.lbx) / 2)]
    phi += [v for i in s.angle_indices if sin_cos for v in (ca.sin(s.x[i]), ca.cos(s.x[i]))]
    return ca.vertcat(*phi, *([] if t is None else [2 * t / ocp.horizon - 1]))


def train_paper(ocp: OCP, dynamics: Any = None, settings: PaperSettings | None = None, seed: int = 0, *,
                progress: bool | None = True, device: str | torch.device = "cpu", dtype: torch.dtype = torch.float32,
                callback: Callable[[int, Mapping[str, float]], None] | None = None,
                ) -> tuple[FeatureNet, FeatureNet, dict[str, Any]]:
    """(controller u(x, t), value V(x, t), card) by the paper's method; both networks in float64 on the CPU.

    Parameters
    ----------
    dynamics : None for the exact f, a LearnedDynamics, or any torch callable (x [B, nx], u [B, nu]) -> xdot
    seed : of initial networks and initial states; the caller's own generators are left alone
    progress : a bar with the loss terms and the time left; None: where the terminal is one
    callback : called as callback(iteration, terms) after each iteration of the joint training

    The card holds settings, seed, seconds, evaluations of the dynamics, the race and the terms' history: data only.
    Raises ValueError where training diverges, naming the iteration and what to try.
    """
    settings = settings or PaperSettings()
    trainer = _Trainer(ocp, dynamics, settings, seed, progress, device, dtype)
    start = time.perf_counter()
    policy, race = trainer.race()
    raced = time.perf_counter()
    policy, value, history = trainer.joint(policy, callback)
    card = {"method": "paper", "settings": asdict(settings), "seed": seed, "dtype": str(dtype).removeprefix("torch."),
            "dynamics": "exact" if dynamics is None else "learned", "race": race, "race_seconds": raced - start,
            "seconds": time.perf_counter() - start, "dynamics_evaluations": trainer.evaluations, **history}
    return policy.to("cpu", torch.float64).eval(), value.to("cpu", torch.float64).eval(), card


class _Trainer:
    """One training: the problem in torch, and its random numbers."""

    def __init__(self, ocp: OCP, dynamics: Any, settings: PaperSettings, seed: int, progress: bool | None,
                 device: str | torch.device, dtype: torch.dtype) -> None:
        self.ocp, self.settings, self.device, self.dtype = ocp, settings, device, dtype
        self.hidden = None if progress is None else not progress  # None: where the terminal is none
        self.f = _torch_dynamics(ocp, dynamics, device, dtype)
        self.L, self.G = to_torch(ocp.L_soft), to_torch(ocp.G)
        fused = settings.fused and settings.step == "rk4" and dynamics is None and torch.device(device).type == "cpu"
        self.step = _fused(ocp) if fused else STEPS[settings.step]
        self.rng = np.random.default_rng(seed)
        self.evaluations = 0  # of f, one for each state and control
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(int(self.rng.integers(2**31)))
            self.starts = [controller_net(ocp, settings).to(device, dtype) for _ in range(settings.race)]
            self.value = value_net(ocp, settings).to(device, dtype)

    def states(self, *batch: int) -> Tensor:
        """Fresh initial states [*batch, nx]."""
        x0 = self.ocp.initial_states.sample(math.prod(batch), self.rng).reshape(*batch, -1)
        return torch.as_tensor(x0, dtype=self.dtype, device=self.device)

    def rollout(self, policy: hjb.Map, x0: Tensor, hold: bool) -> hjb.Rollout:
        K = self.settings.intervals
        self.evaluations += math.prod(x0.shape[:-1]) * K * (1 if self.settings.step == "euler" else 4)
        return hjb.rollout(policy, self.f, self.L, x0, self.ocp.horizon, K, step=self.step, hold=hold)

    def costs(self, policy: hjb.Map, x0: Tensor, hold: bool) -> Tensor:
        """The cost of each trajectory."""
        path = self.rollout(policy, x0, hold)
        return (path.running + self.G(path.x[..., -1, :]))[..., 0]

    def race(self) -> tuple[FeatureNet, list[float]]:
        """The controller that L_cost brings furthest from several random ones, and the mean cost of each at the end."""
        s = self.settings
        if s.race == 1:
            return self.starts[0], []
        policy, parameters = _side_by_side(self.starts)
        adam = torch.optim.Adam(parameters.values(), lr=s.learning_rate)
        recent: list[Tensor] = []
        for _ in (bar := tqdm(range(s.race_iterations), f"{s.race} random controllers", disable=self.hidden)):
            J = self.costs(policy, self.states(s.race, s.race_batch), hold=True).mean(1)
            gradients = torch.autograd.grad(J.sum(), list(parameters.values()))
            _step(adam, list(parameters.values()), _clip_each(gradients, s.clip))
            recent = [*recent, J.detach()][-LAST:]
            bar.set_postfix(cost=f"{float(J.detach().nan_to_num(math.inf).min()):.3g}")
        scores = torch.stack(recent).mean(0).nan_to_num(math.inf, posinf=math.inf)
        if not torch.isfinite(scores).any():
            raise ValueError(f"training diverged: all {s.race} random controllers have an infinite cost after "
                             f"{s.race_iterations} iterations; expected a finite one: {_remedy(s)}")
        best = int(scores.argmin())
        winner = self.starts[best]
        winner.nets[0].load_state_dict({name: p.detach()[best] for name, p in parameters.items()})
        return winner, [float(v) for v in scores]

    def joint(self, policy: FeatureNet, callback: Callable[[int, Mapping[str, float]], None] | None,
              ) -> tuple[FeatureNet, FeatureNet, dict[str, Any]]:
        """Controller and value after joint training by all four losses: those of the best check, and the history."""
        s, value = self.settings, self.value
        groups = [list(policy.parameters()), list(value.parameters())]
        adam = torch.optim.Adam([p for group in groups for p in group], lr=s.learning_rate)
        held_out, every = self.states(HELD_OUT), max(1, s.iterations // CHECKS)
        best, rows, bad = _Best(), [], 0
        for k in (bar := tqdm(range(s.iterations), f"CND on {self.ocp.system.name}", disable=self.hidden)):
            terms = self.losses(policy, value)
            gradients = torch.autograd.grad(terms.total(s.weights), groups[0] + groups[1], materialize_grads=True)
            rows.append([float(v.detach()) for v in terms.terms()])
            bad = 0 if _finite(rows[-1], gradients) else bad + 1
            if bad >= BAD_STEPS:
                raise ValueError(_diverged(k, rows[-1], s))
            if not bad:
                n, adam.param_groups[0]["lr"] = len(groups[0]), s.learning_rate * s.decay ** (k / s.iterations)
                _step(adam, groups[0] + groups[1], [*_clip(gradients[:n], s.clip), *_clip(gradients[n:], s.clip)])
            named = dict(zip(TERMS, rows[-1], strict=True))
            bar.set_postfix({name: f"{v:.3g}" for name, v in named.items()}, refresh=False)
            if callback is not None:
                callback(k, named)
            if (k + 1) % every == 0 or k + 1 == s.iterations:
                with torch.no_grad():
                    best.offer(float(self.costs(policy, held_out, s.hold).mean()), k + 1, policy, value)
        history = {"history": {name: [row[i] for row in rows] for i, name in enumerate(TERMS)},
                   "best_iteration": best.iteration, "held_out_cost": best.cost}
        return *best.networks(s), history

    def losses(self, policy: FeatureNet, value: FeatureNet) -> hjb.Losses:
        """The four terms on fresh trajectories; those of weight 0 are not computed."""
        s = self.settings
        path = self.rollout(policy, self.states(s.batch), s.hold)
        if not any(s.weights[1:]):
            cost = (path.running + self.G(path.x[:, -1])).mean()
            return hjb.Losses(cost, *[torch.zeros_like(cost)] * 3)
        return hjb.path_losses(path, policy, value, self.f, self.L, self.G, detach=s.detach)


class _Best:
    """The networks with the lowest cost on held-out initial states."""

    def __init__(self) -> None:
        self.cost, self.iteration = math.inf, 0
        self.pair: tuple[FeatureNet, FeatureNet] | None = None

    def offer(self, cost: float, iteration: int, policy: FeatureNet, value: FeatureNet) -> None:
        if cost < self.cost:
            self.cost, self.iteration, self.pair = cost, iteration, copy.deepcopy((policy, value))

    def networks(self, settings: PaperSettings) -> tuple[FeatureNet, FeatureNet]:
        if self.pair is None:
            raise ValueError("training diverged: the controller has an infinite cost on held-out initial states at "
                             f"every check; expected a finite one: {_remedy(settings)}")
        return self.pair


def _torch_dynamics(ocp: OCP, dynamics: Any, device: str | torch.device, dtype: torch.dtype) -> hjb.Map:
    """f in torch: exact, or a copy of the learned one whose parameters stay as they are."""
    if dynamics is None:
        return to_torch(ocp.system.f)
    net = getattr(dynamics, "net", dynamics)
    if isinstance(net, torch.nn.Module):
        return copy.deepcopy(net).to(device, dtype).requires_grad_(False)
    if not callable(net):
        raise ValueError(f"dynamics is a {type(dynamics).__name__}; expected None (the exact f), a LearnedDynamics, or "
                         "a torch callable (x [B, nx], u [B, nu]) -> xdot [B, nx]")
    return net


def _fused(ocp: OCP) -> hjb.Step:
    try:
        return FusedStep(ocp)
    except ValueError as error:
        raise ValueError(f"{error}; or set fused=False, which is slower") from None


def _side_by_side(nets: Sequence[FeatureNet]) -> tuple[hjb.Map, dict[str, Tensor]]:
    """Controllers of one form as a policy on x [M, B, nx], row m by the m-th, and their parameters [M, ...]."""
    parameters, _ = stack_module_state([net.nets[0] for net in nets])
    form, base = nets[0], copy.deepcopy(nets[0].nets[0]).to("meta")
    answer = torch.vmap(lambda p, phi: functional_call(base, p, (phi,)))

    def policy(x: Tensor, t: Tensor) -> Tensor:
        return form.combine((x, t), (answer(parameters, form.features(x, t)[0]),))

    return policy, parameters


def _step(adam: torch.optim.Optimizer, parameters: Sequence[Tensor], gradients: Sequence[Tensor]) -> None:
    for p, g in zip(parameters, gradients, strict=True):
        p.grad = g
    adam.step()
    adam.zero_grad(set_to_none=True)


def _clip(gradients: Sequence[Tensor], limit: float | None) -> list[Tensor]:
    """Gradients scaled so that their norm together is at most `limit`."""
    if limit is None:
        return list(gradients)
    norm = torch.linalg.vector_norm(torch.stack([torch.linalg.vector_norm(g) for g in gradients]))
    scale = (limit / norm.clamp(min=1e-12)).clamp(max=1.0)
    return [g * scale for g in gradients]


def _clip_each(gradients: Sequence[Tensor], limit: float | None) -> list[Tensor]:
    """The same for networks side by side [M, ...], each by its own norm; one that overflowed has no step."""
    norm = torch.stack([g.flatten(1).square().sum(1) for g in gradients]).sum(0).sqrt()
    scale = torch.ones_like(norm) if limit is None else (limit / norm.clamp(min=1e-12)).clamp(max=1.0)
    scale = torch.where(torch.isfinite(norm), scale, 0.0)
    return [g.nan_to_num(0.0, 0.0, 0.0) * scale.view(-1, *[1] * (g.ndim - 1)) for g in gradients]


def _finite(terms: Sequence[float], gradients: Sequence[Tensor]) -> bool:
    return all(map(math.isfinite, terms)) and all(bool(torch.isfinite(g.sum())) for g in gradients)


def _diverged(iteration: int, terms: Sequence[float], settings: PaperSettings) -> str:
    shown = ", ".join(f"{name} {v:.3g}" for name, v in zip(TERMS, terms, strict=True))
    return (f"training diverged at iteration {iteration}: NaN or infinite losses or gradients for {BAD_STEPS} "
            f"iterations in a row (last: {shown}); expected finite ones: {_remedy(settings)}")


def _remedy(settings: PaperSettings) -> str:
    """What to try, in order."""
    tips = [] if settings.clip is not None else ["set clip=1.0"]
    tips += [f"a smaller learning_rate (is {settings.learning_rate:g})", f"more intervals (are {settings.intervals})"]
    tips += ["a shorter horizon, narrower initial_states, or tighter control bounds"]
    return "try " + ", ".join(tips)
