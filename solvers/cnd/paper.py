"""CND as its paper has it: u and V trained together by Adam on rollouts, by the four losses of `nocl.hjb`, no labels.

Control with Neural Dynamics, section "Method": the controller is an MLP u(x) whose tanh output is rescaled to U,
V(x, t) an MLP with tanh and a skip connection, both initialised uniformly at random; the loss is L_cost + L_HJB + 0.01
L_final + 0.01 L_hamil; Adam from 0.01 with exponential decay. What is decided here because the paper leaves it open, or
departs from it because the plain recipe fails, is a field of `PaperSettings`, and can be undone:

- clip: gradients through a swing-up reach norms of 10^3 at random controllers; unclipped, training throws them away.
- race: from one random start the swing-up is a matter of luck; several start side by side on L_cost, the best goes on.
- near_goal (off): on the quadrotor, U = [-100, 100]^4, random controllers spin the body up within the horizon: costs
  of 10^5 and gradients that point nowhere. Started at u*, with a smaller learning rate, it learns to fly.
- sin_cos: angles go in as sin and cos too, so that u is periodic where it should be.
- rollouts are RK4, or implicit steps where f is stiff, with the controller inside the ODE. With hold=True they are
  nocl's discretisation for NMPC, several times as fast (the race's always are), but then the controller is one for that
  control rate: trained at 12.5 Hz to cost 0.106, cart-pole's has 0.67 in continuous time; trained inside the ODE, 0.147
  in a quarter of the iterations.
  step="euler" with hold=True is the published code.

Without clip, race and sin_cos cart-pole's cost is 4.5 after 600 iterations (it does not swing up; one seed).
"""

from __future__ import annotations

import copy
import math
import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import torch
from torch import Tensor
from torch.func import functional_call, stack_module_state

from nocl import hjb
from nocl.definition.ocp import OCP
from nocl.definition.scales import usual_sizes
from nocl.definition.substeps import RADAU, RK4, STABLE
from nocl.nets import MLP, FeatureNet
from nocl.solvers.cnd.lifted import Lifted
from nocl.solvers.cnd.settings import AUTO, STEPS, PaperSettings, identity
from nocl.solvers.grid import fastest_at_start
from nocl.support import store
from nocl.support.checks import Array
from nocl.support.progress import bar as progress_bar
from nocl.translate.arguments import Arguments
from nocl.translate.fused import FusedStep
from nocl.translate.implicit import RadauStep
from nocl.translate.radau import STAGES
from nocl.translate.torch_functions import to_torch

__all__ = ["PaperSettings", "train_paper"]
TERMS = ("cost", "hjb", "final", "hamil")
CHECKS = 40  # times that L_cost is measured on held-out initial states, the best networks kept
HELD_OUT = 128  # initial states for that
BAD_STEPS = 10  # updates in a row that may be skipped for a gradient that overflowed
LAST = 20  # iterations that a race is judged by


def controller_net(ocp: OCP, settings: PaperSettings) -> FeatureNet:
    """u(x) or u(x, t) = middle + half width * tanh(MLP): inside U by construction. Weights: torch's seed."""
    s, at = ocp.system, ocp.functions.feedback()
    phi = _features(ocp, at if settings.time_input else at.but("t"), settings.sin_cos)
    y = ca.SX.sym("y", s.nu)
    u = ca.DM((s.lbu + s.ubu) / 2) + ca.DM((s.ubu - s.lbu) / 2) * ca.tanh(y)
    net = MLP((phi.numel(), *settings.hidden, s.nu), settings.activation)
    if settings.near_goal is not None:
        _start_near_goal(ocp, net, settings.near_goal)
    return FeatureNet(at.function("controller_inputs", {"phi": phi}), [net],
                      at.function("controller_output", {"u": u}, y=y))


def _start_near_goal(ocp: OCP, net: MLP, share: float) -> None:
    """The last layer's weights times `share`, its bias such that u = u* where they add nothing."""
    s = ocp.system
    last: Any = net.body[-1]
    inside = np.clip((2 * ocp.u_goal - s.lbu - s.ubu) / (s.ubu - s.lbu), -0.99, 0.99)  # a bound itself has no slope
    with torch.no_grad():
        last.weight.mul_(share)
        last.bias.copy_(torch.as_tensor(np.arctanh(inside)))


def value_net(ocp: OCP, settings: PaperSettings) -> FeatureNet:
    """V(x, t), an MLP with a linear skip connection."""
    at, y = ocp.functions.feedback(), ca.SX.sym("y")
    phi = _features(ocp, at, settings.sin_cos)
    return FeatureNet(at.function("value_inputs", {"phi": phi}),
                      [MLP((phi.numel(), *settings.value_hidden, 1), settings.activation, skip=True)],
                      at.function("value_output", {"V": y}, y=y))


def _features(ocp: OCP, at: Arguments, sin_cos: bool) -> ca.SX:
    """The state scaled by its box, sin and cos of its angles, and 2 t / T - 1 where t is among the arguments."""
    s, x = ocp.system, at["x"]
    phi = [(x - ca.DM((s.lbx + s.ubx) / 2)) / ca.DM((s.ubx - s.lbx) / 2)]
    phi += [v for i in s.angle_indices if sin_cos for v in (ca.sin(x[i]), ca.cos(x[i]))]
    return ca.vertcat(*phi, *([2 * at["t"] / ocp.horizon - 1] if "t" in at.names else []))


def train_paper(ocp: OCP, dynamics: Any = None, settings: PaperSettings | None = None, seed: int = 0, *,
                progress: bool | None = True, device: str | torch.device = "cpu", dtype: torch.dtype = torch.float32,
                callback: Callable[[int, Mapping[str, float]], None] | None = None,
                checkpoint: Path | None = None) -> tuple[FeatureNet, FeatureNet, dict[str, Any]]:
    """(controller u(x, t), value V(x, t), card) by the paper's method; both networks in float64 on the CPU.

    Parameters
    ----------
    dynamics : None for the exact f, a LearnedDynamics, or any torch callable (x [B, nx], u [B, nu][, p]) -> xdot
    seed : of initial networks and initial states; the caller's own generators are left alone
    progress : the loss terms and the time left, on stderr
    callback : called as callback(iteration, terms) after each iteration of the joint training
    checkpoint : a file that is written at each of 40 checks; the same call goes on from it, to the same result; plain
        callables are known by name

    The card holds settings, seed, seconds, evaluations of the dynamics, the race and the terms' history: data only.
    Raises ValueError where training diverges, naming the iteration and what to try.
    """
    settings = settings or PaperSettings()
    of = Lifted(ocp) if ocp.np or ocp.uses_time else None
    trainer = Trainer(ocp, dynamics, settings, seed, progress, device, dtype) if of is None else \
        Trainer(of.ocp, of.dynamics(dynamics), settings, seed, progress, device, dtype, of.sample)
    named = f"{type(dynamics)}{getattr(dynamics, '__qualname__', '')}"  # of a plain callable its name alone is known
    key = identity(ocp, settings, seed, trainer.f, dtype=str(dtype), dynamics=named)
    run = _Training.resumed(trainer, checkpoint, key) or _Training.raced(trainer)
    run.train(callback, None if checkpoint is None else lambda: run.save(checkpoint, key))
    policy, value = run.best.networks(settings)
    if of is not None:
        policy, value = of.lowered(policy), of.lowered(value)
    card = {"method": "paper", "settings": asdict(settings), "seed": seed, "dtype": str(dtype).removeprefix("torch."),
            "dynamics": "exact" if dynamics is None else "learned", "race": run.race, "race_seconds": run.race_seconds,
            "seconds": run.seconds, "dynamics_evaluations": trainer.evaluations, "iterations": len(run.rows),
            "step": trainer.kind,
            "history": {name: [row[i] for row in run.rows] for i, name in enumerate(TERMS)},
            "best_iteration": run.best.iteration, "held_out_cost": run.best.cost}
    return policy.to("cpu", torch.float64).eval(), value.to("cpu", torch.float64).eval(), card


class Trainer:
    """One training: the problem in torch, and its random numbers."""

    def __init__(self, ocp: OCP, dynamics: Any, settings: PaperSettings, seed: int, progress: bool | None,
                 device: str | torch.device, dtype: torch.dtype,
                 draw: Callable[[int, np.random.Generator], Array] | None = None) -> None:
        self.draw = draw or ocp.initial_states.sample
        self.ocp, self.settings, self.device, self.dtype = ocp, settings, device, dtype
        self.progress = progress
        self.f = _torch_dynamics(ocp, dynamics, device, dtype)
        self.L, self.G = to_torch(ocp.L_soft), to_torch(ocp.G)
        self.kind = _kind(ocp, dynamics, settings)
        fused = settings.fused and self.kind == RK4 and dynamics is None and torch.device(device).type == "cpu"
        self.step = _fused(ocp) if fused else RadauStep(usual_sizes(ocp).x) if self.kind == RADAU else STEPS[self.kind]
        self.rng = np.random.default_rng(seed)
        self.evaluations = 0  # of f, one for each state and control
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(int(self.rng.integers(2**31)))
            self.starts = [controller_net(ocp, settings).to(device, dtype) for _ in range(settings.race)]
            self.value = value_net(ocp, settings).to(device, dtype)

    def states(self, *batch: int) -> Tensor:
        """Fresh initial states [*batch, nx]."""
        x0 = self.draw(math.prod(batch), self.rng).reshape(*batch, -1)
        return torch.as_tensor(x0, dtype=self.dtype, device=self.device)

    def rollout(self, policy: hjb.Map, x0: Tensor, hold: bool) -> hjb.Rollout:
        K, T, step = self.settings.intervals, self.ocp.horizon, self.step
        before = step.evaluations if isinstance(step, RadauStep) else 0
        path = hjb.rollout(policy, self.f, self.L, x0, T, K, step=step, hold=hold)
        self.evaluations += step.evaluations - before if isinstance(step, RadauStep) else \
            math.prod(x0.shape[:-1]) * K * (1 if self.kind == "euler" else 4)
        return path

    def costs(self, policy: hjb.Map, x0: Tensor, hold: bool) -> Tensor:
        """The cost of each trajectory."""
        path = self.rollout(policy, x0, hold)
        return (path.running + self.G(path.x[..., -1, :]))[..., 0]

    def race(self) -> tuple[FeatureNet, list[float]]:
        """The controller that L_cost brings furthest from several random ones, and the mean cost of each at the end."""
        s = self.settings
        if s.race == 1:
            return self.starts[0], []
        policy, parameters = side_by_side(self.starts)
        adam = torch.optim.Adam(parameters.values(), lr=s.learning_rate)
        recent: list[Tensor] = []
        with progress_bar(s.race_iterations, f"{s.race} random controllers", self.progress) as bar:
            for _ in range(s.race_iterations):
                J = self.costs(policy, self.states(s.race, s.race_batch), hold=True).mean(1)
                gradients = torch.autograd.grad(J.sum(), list(parameters.values()))
                _step(adam, list(parameters.values()), _clip_each(gradients, s.clip))
                recent = [*recent, J.detach()][-LAST:]
                bar.set_postfix_str(f"cost={float(J.detach().nan_to_num(math.inf).min()):.3g}", refresh=False)
                bar.update()
        scores = torch.stack(recent).mean(0).nan_to_num(math.inf, posinf=math.inf)
        if not torch.isfinite(scores).any():
            raise ValueError(f"training diverged: all {s.race} random controllers have an infinite cost after "
                             f"{s.race_iterations} iterations; expected a finite one: {_remedy(s)}")
        best = int(scores.argmin())
        winner = self.starts[best]
        winner.nets[0].load_state_dict({name: p.detach()[best] for name, p in parameters.items()})
        return winner, [float(v) for v in scores]

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
        self.cost, self.iteration, self.waited = math.inf, 0, 0
        self.pair: tuple[FeatureNet, FeatureNet] | None = None

    def offer(self, cost: float, iteration: int, policy: FeatureNet, value: FeatureNet) -> None:
        self.waited += 1
        if cost < self.cost:
            self.cost, self.iteration, self.waited = cost, iteration, 0
            self.pair = copy.deepcopy((policy, value))

    def networks(self, settings: PaperSettings) -> tuple[FeatureNet, FeatureNet]:
        if self.pair is None:
            raise ValueError("training diverged: the controller has an infinite cost on held-out initial states at "
                             f"every check; expected a finite one: {_remedy(settings)}")
        return self.pair


class _Training:
    """The joint training, from the race's winner or from a checkpoint; what it holds is what a checkpoint keeps."""

    def __init__(self, trainer: Trainer, policy: FeatureNet, race: list[float], race_seconds: float) -> None:
        self.trainer, self.policy, self.value = trainer, policy, trainer.value
        self.race, self.race_seconds, self.seconds = race, race_seconds, race_seconds
        self.groups = [list(policy.parameters()), list(self.value.parameters())]
        self.adam = torch.optim.Adam([p for g in self.groups for p in g], lr=trainer.settings.learning_rate)
        self.held_out = trainer.states(HELD_OUT)
        self.best, self.bad = _Best(), 0
        self.rows: list[list[float]] = []

    @classmethod
    def raced(cls, trainer: Trainer) -> _Training:
        start = time.perf_counter()
        policy, race = trainer.race()
        return cls(trainer, policy, race, time.perf_counter() - start)

    def train(self, callback: Callable[[int, Mapping[str, float]], None] | None,
              save: Callable[[], Any] | None) -> None:
        """All iterations that are left."""
        s, every = self.trainer.settings, max(1, self.trainer.settings.iterations // CHECKS)
        before, start = self.seconds, time.perf_counter()
        with progress_bar(s.iterations, f"CND on {self.trainer.ocp.system.name}", self.trainer.progress,
                          initial=len(self.rows)) as bar:
            while len(self.rows) < s.iterations and not (s.patience and self.best.waited >= s.patience):
                named = self.iteration()
                bar.set_postfix_str(", ".join(f"{name}={v:.3g}" for name, v in named.items()), refresh=False)
                bar.update()
                if callback is not None:
                    callback(len(self.rows) - 1, named)
                if len(self.rows) % every == 0 or len(self.rows) == s.iterations:
                    self.check()
                    self.seconds = before + time.perf_counter() - start
                    if save is not None:
                        save()

    def iteration(self) -> dict[str, float]:
        """One step of Adam on fresh trajectories; the four terms."""
        s, k, n = self.trainer.settings, len(self.rows), len(self.groups[0])
        terms = self.trainer.losses(self.policy, self.value)
        parameters = self.groups[0] + self.groups[1]
        gradients = torch.autograd.grad(terms.total(s.weights), parameters, materialize_grads=True)
        self.rows.append([float(v.detach()) for v in terms.terms()])
        self.bad = 0 if _finite(self.rows[-1], gradients) else self.bad + 1
        if self.bad >= BAD_STEPS:
            raise ValueError(_diverged(k, self.rows[-1], s))
        if not self.bad:
            self.adam.param_groups[0]["lr"] = s.learning_rate * s.decay ** (k / s.iterations)
            _step(self.adam, parameters, [*_clip(gradients[:n], s.clip), *_clip(gradients[n:], s.clip)])
        return dict(zip(TERMS, self.rows[-1], strict=True))

    def check(self) -> None:
        """The cost on held-out initial states; the best networks are kept."""
        with torch.no_grad():
            cost = float(self.trainer.costs(self.policy, self.held_out, self.trainer.settings.hold).mean())
        self.best.offer(cost, len(self.rows), self.policy, self.value)

    def save(self, path: Path, key: str) -> None:
        """Everything that the rest of the run depends on."""
        pair = None if self.best.pair is None else [net.state_dict() for net in self.best.pair]
        state = {"policy": self.policy.state_dict(), "value": self.value.state_dict(), "adam": self.adam.state_dict(),
                 "best": pair, "held_out": self.held_out, "rows": torch.tensor(self.rows, dtype=torch.float64),
                 "generator": self.trainer.rng.bit_generator.state}
        meta = {"identity": key, "race": self.race, "race_seconds": self.race_seconds, "seconds": self.seconds,
                "bad": self.bad, "evaluations": self.trainer.evaluations,
                "best": [self.best.cost, self.best.iteration, self.best.waited]}
        store.save_checkpoint(path, state, meta)

    @classmethod
    def resumed(cls, trainer: Trainer, path: Path | None, key: str) -> _Training | None:
        """The run that a checkpoint of the same call holds; another call's is left aside and overwritten."""
        if path is None or not path.exists():
            return None
        state, meta = store.load_checkpoint(path)
        if meta.get("identity") != key:
            return None
        run = cls(trainer, trainer.starts[0], meta["race"], meta["race_seconds"])
        run.policy.load_state_dict(state["policy"])
        run.value.load_state_dict(state["value"])
        run.adam.load_state_dict(state["adam"])
        run.held_out = state["held_out"].to(trainer.device, trainer.dtype)
        run.rows, run.bad, run.seconds = state["rows"].tolist(), meta["bad"], meta["seconds"]
        run.best.cost, run.best.iteration, run.best.waited = meta["best"]
        if state["best"] is not None:
            run.best.pair = copy.deepcopy((run.policy, run.value))
            for net, weights in zip(run.best.pair, state["best"], strict=True):
                net.load_state_dict(weights)
        trainer.rng.bit_generator.state, trainer.evaluations = state["generator"], meta["evaluations"]
        return run


def _torch_dynamics(ocp: OCP, dynamics: Any, device: str | torch.device, dtype: torch.dtype) -> hjb.Map:
    """f in torch: exact, or a copy of the learned one whose parameters stay as they are."""
    if dynamics is None:
        return to_torch(ocp.functions.f)
    net = getattr(dynamics, "net", dynamics)
    if isinstance(net, torch.nn.Module):
        return copy.deepcopy(net).to(device, dtype).requires_grad_(False)
    if not callable(net):
        raise ValueError(f"dynamics is a {type(dynamics).__name__}; expected None (the exact f), a LearnedDynamics, or "
                         "a torch callable (x [B, nx], u [B, nu]) -> xdot [B, nx]")
    return net


def _kind(ocp: OCP, dynamics: Any, settings: PaperSettings) -> str:
    """Of the steps of rollouts. Told where they are implicit without having been asked for."""
    if settings.step != AUTO:
        return settings.step
    known = dynamics is None and ocp.system.xdot is not None
    if not known and not hasattr(dynamics, "to_casadi"):
        return RK4
    step = ocp.horizon / settings.intervals
    shortest = fastest_at_start(ocp, ocp.functions if dynamics is None else ocp.functions.on(dynamics.to_casadi()))
    if step <= STABLE * shortest:
        return RK4
    warnings.warn(f"{ocp.system.name}: fastest mode {shortest:.3g} s, step {step:.3g} s: implicit Radau, {STAGES} "
                  "stages, in rollouts; PaperSettings(step=) decides it", stacklevel=4)
    return RADAU


def _fused(ocp: OCP) -> hjb.Step:
    try:
        return FusedStep(ocp.functions.step())
    except ValueError as error:
        raise ValueError(f"{error}; or set fused=False, which is slower") from None


def side_by_side(nets: Sequence[FeatureNet]) -> tuple[hjb.Map, dict[str, Tensor]]:
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
