"""NeuralOC: the value function as a network, u its Hamiltonian's minimiser, trained through rollouts of the exact f.

    V(x, t) / scale = w'N(s) + s'(A'A)s / 2 + b's + c,   s = (x, t),
    N(s) = r_M,   r_0 = sigma(K_0 s + k_0),   r_i = r_{i-1} + sigma(K_i r_{i-1} + k_i) / M,   sigma' = tanh,
    u(x, t) = argmin over U of L(x, u) + V_x'f(x, u),

    loss = mean of int_0^T L dt + G(x(T)) + c_HJt int_0^T |V_t + H(x, V_x)| dt
                   + c_HJfin |V(x(T), T) - G(x(T))| + c_HJgrad ||V_x(x(T), T) - G_x(x(T))||_1.

Onken, Nurbekyan, Li, Wu Fung, Osher, Ruthotto, "A Neural Network Approach for High-Dimensional Optimal Control",
arXiv 2104.03270; settings: their published code. As everywhere in nocl V_t + min_u (L + V_x'f) = 0 and V(x, T) = G(x).
Departures: u comes from the problem's own symbols (`nocl.definition.hamiltonian`), with the box U; the weight of G is
the problem's; and `scale`, half the mean curvature of L in u, is theirs only where L = ||u||^2 + ..., as in their
problems: with it a fresh network's controls are of order one whatever the units of the cost.
"""

from __future__ import annotations

import copy
import math
import os
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor, nn

from nocl.definition.hamiltonian import minimiser
from nocl.definition.ocp import OCP
from nocl.support import checks, store
from nocl.support.checks import Array
from nocl.support.fields import Checked, coefficients, count, flag, positive
from nocl.support.progress import bar as progress_bar
from nocl.support.threads import one_thread
from nocl.translate.arguments import Arguments
from nocl.translate.fused import FusedFunction
from nocl.translate.rk4 import rk4
from nocl.translate.torch_functions import to_torch

__all__ = ["NeuralOC", "NeuralOCSettings", "train_neural_oc"]
FILE = "neural_oc.safetensors"
TERMS = ("running", "terminal", "hjb", "final", "gradient")  # of the loss, each without its weight


@dataclass(frozen=True)
class NeuralOCSettings(Checked):
    """Settings of `train_neural_oc`; the defaults are those published for the quadcopter."""

    width: int = count(128, "of the ResNet")
    layers: int = count(2, "of the ResNet: the opening one, and residual ones", least=2)
    rank: int = count(10, "rows of A, at most nx + 1 of them")
    steps: int = count(26, "of RK4 in a rollout")
    iterations: int = count(6000, "of Adam")
    batch: int = count(1024, "initial states, and as many held-out ones")
    learning_rate: float = positive(0.01, "of Adam")
    drop: float = positive(0.5, "factor of the learning rate after `drop_every` iterations; 1: no drop", most=1)
    drop_every: int = count(1200, "iterations, which then go on from the best network so far")
    resample_every: int = count(25, "iterations on the same initial states")
    check_every: int = count(50, "iterations between looks at the held-out states; the best network is kept")
    weights: tuple[float, float, float] = coefficients((0.1, 0.0, 0.0), "c_HJt, c_HJfin, c_HJgrad")
    fused: bool = flag(True, "f, L, H and their gradients as compiled C; False: in torch, the same to rounding")


class ValueNet(nn.Module):
    """V(x, t) [B, 1] of rows x [B, nx], t [B, 1], and its gradient in closed form. Weights: torch's seed."""

    def __init__(self, nx: int, width: int, layers: int, rank: int, scale: float) -> None:
        super().__init__()
        n, self.scale = nx + 1, scale
        self.opening = nn.Linear(n, width)
        self.residual = nn.ModuleList([nn.Linear(width, width) for _ in range(layers - 1)])
        self.w = nn.Parameter(torch.ones(width))
        self.A = nn.Parameter(nn.init.xavier_uniform_(torch.empty(min(rank, n), n)))
        self.b, self.c = nn.Parameter(torch.zeros(n)), nn.Parameter(torch.zeros(()))

    def forward(self, x: Tensor, t: Tensor) -> Tensor:
        s = torch.cat([x, t], -1)
        r, _ = self._sweep(s)
        V = r @ self.w + (s @ self.A.T).square().sum(-1) / 2 + s @ self.b + self.c
        return self.scale * V[..., None]

    def gradient(self, x: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
        """(V_x [B, nx], V_t [B, 1]), differentiable once more."""
        s = torch.cat([x, t], -1)
        _, slopes = self._sweep(s)
        z: Tensor = self.w
        for i in reversed(range(len(self.residual))):
            z = z + (slopes[i + 1] * z) @ self.get_parameter(f"residual.{i}.weight") / len(self.residual)
        g = self.scale * ((slopes[0] * z) @ self.opening.weight + (s @ self.A.T) @ self.A + self.b)
        return g[..., :-1], g[..., -1:]

    def _sweep(self, s: Tensor) -> tuple[Tensor, list[Tensor]]:
        """N(s) and tanh of each layer's argument, the slopes of sigma."""
        r, slope = _Sigma.apply(self.opening(s))
        slopes = [slope]
        for layer in self.residual:
            value, slope = _Sigma.apply(layer(r))
            r = r + value / len(self.residual)
            slopes.append(slope)
        return r, slopes

    def to_casadi(self) -> tuple[ca.Function, ca.Function]:
        """(value:(x, t) -> V, value_gradient:(x, t) -> V_x), native MX."""
        dm = {name: ca.DM(p.detach().double().numpy()) for name, p in self.named_parameters()}
        at = Arguments.new(ca.MX, x=self.opening.in_features - 1, t=1)
        s, share = ca.vertcat(*at.inputs), 1 / len(self.residual)
        a = [ca.mtimes(dm["opening.weight"], s) + dm["opening.bias"]]
        r = _sigma_mx(a[0])
        for i in range(len(self.residual)):
            a.append(ca.mtimes(dm[f"residual.{i}.weight"], r) + dm[f"residual.{i}.bias"])
            r = r + share * _sigma_mx(a[-1])
        As, z = ca.mtimes(dm["A"], s), ca.MX(dm["w"])
        V = ca.dot(dm["w"], r) + ca.sumsqr(As) / 2 + ca.dot(dm["b"], s) + dm["c"]
        for i in reversed(range(len(self.residual))):
            z = z + share * ca.mtimes(dm[f"residual.{i}.weight"].T, ca.tanh(a[i + 1]) * z)
        g = ca.mtimes(dm["opening.weight"].T, ca.tanh(a[0]) * z) + ca.mtimes(dm["A"].T, As) + dm["b"]
        return (at.function("value", {"V": self.scale * V}),
                at.function("value_gradient", {"V_x": self.scale * g[:-1]}))

    def sizes(self) -> dict[str, Any]:
        """What it was constructed with."""
        return {"nx": self.opening.in_features - 1, "width": self.opening.out_features,
                "layers": 1 + len(self.residual), "rank": len(self.A), "scale": self.scale}


class _Sigma(torch.autograd.Function):
    """(log(e^a + e^-a), tanh(a)), sharing one exponential."""

    @staticmethod
    def forward(ctx: Any, a: Tensor) -> tuple[Tensor, Tensor]:
        size = a.abs()
        e = (-2 * size).exp_()
        slope = torch.copysign((1 - e) / (1 + e), a)
        ctx.save_for_backward(slope)
        return size + e.add_(1).log_(), slope

    @staticmethod
    def backward(ctx: Any, bar: Tensor, bar_slope: Tensor) -> Tensor:
        (slope,) = ctx.saved_tensors
        return bar * slope + bar_slope * (1 - slope * slope)


def _sigma_mx(a: ca.MX) -> ca.MX:
    return ca.fabs(a) + ca.log1p(ca.exp(-2 * ca.fabs(a)))


class NeuralOC:
    """A feedback controller u(x, t) that minimises the Hamiltonian of its value function; made by `train_neural_oc`.

    Attributes
    ----------
    ocp, value_net : the problem, and V as a torch module in float64
    card : settings, seed, seconds, nfe (evaluations of the dynamics in its rollouts, one for each state and control),
        held_out (the loss of the network that was kept), history of the loss terms: plain JSON data
    """

    def __init__(self, ocp: OCP, value_net: ValueNet, card: Mapping[str, Any] | None = None) -> None:
        self.ocp, self.card = ocp, dict(card or {})
        self.value_net = value_net.double().eval().requires_grad_(False)
        self._minimiser = minimiser_of(ocp)
        self._u = to_torch(self._minimiser)

    def __call__(self, x: ArrayLike, t: ArrayLike = 0.0) -> Array:
        """u [nu] at a state [nx], or [B, nu] at [B, nx], and a time (one for all, or [B])."""
        rows, times, single = self._tensors(x, t)
        u: Array = self._u(rows, self.value_net.gradient(rows, times)[0]).numpy()
        return u[0] if single else u

    def value(self, x: ArrayLike, t: ArrayLike = 0.0) -> Array:
        """V(x, t), the cost-to-go: a number at [nx], or [B] at [B, nx]."""
        rows, times, single = self._tensors(x, t)
        V: Array = self.value_net(rows, times).numpy()[:, 0]
        return V[0] if single else V

    def value_gradient(self, x: ArrayLike, t: ArrayLike = 0.0) -> Array:
        """V_x, the costate: [nx] at [nx], or [B, nx] at [B, nx]."""
        rows, times, single = self._tensors(x, t)
        V_x: Array = self.value_net.gradient(rows, times)[0].numpy()
        return V_x[0] if single else V_x

    def to_casadi(self) -> ca.Function:
        """policy:(x [nx], t) -> (u [nu]), native MX."""
        at = self.ocp.functions.feedback(ca.MX)
        u = at.given(costate=at.call(self.value_net.to_casadi()[1])).call(self._minimiser)
        return at.function("policy", {"u": ca.densify(u)})

    def value_to_casadi(self) -> ca.Function:
        """value:(x [nx], t) -> (V), native MX."""
        return self.value_net.to_casadi()[0]

    def save(self, folder: str | os.PathLike[str]) -> Path:
        """Write network, problem and card as one data-only file in `folder`, all or nothing."""
        meta = {"solver": "neural_oc", "net": self.value_net.sizes(), "ocp": self.ocp.to_data(), "card": self.card}
        return store.save_checkpoint(Path(folder) / FILE, self.value_net.state_dict(), meta)

    @classmethod
    def load(cls, folder: str | os.PathLike[str]) -> NeuralOC:
        """What `save` wrote; raises ValueError for a missing, damaged or foreign file."""
        path = Path(folder) / FILE
        state, meta = store.load_checkpoint(path)
        with store.reading(path, "a controller"):
            if meta.get("solver") != "neural_oc":
                raise ValueError(f"{path} was not written by NeuralOC.save; expected a controller: name its folder")
            net = ValueNet(**meta["net"]).double()
            net.load_state_dict(state)
            if not all(torch.isfinite(p).all() for p in net.parameters()):
                raise ValueError(f"{path} holds weights of NaN or inf; expected finite ones: train it again")
            return cls(OCP.from_data(meta["ocp"]), net, meta["card"])

    def __repr__(self) -> str:
        facts = ", ".join(f"{k} {v:.4g}" for k, v in self.card.items() if isinstance(v, (int, float)))
        return f"NeuralOC on {self.ocp.system.name!r}: {facts or 'no card'}"

    def _tensors(self, x: ArrayLike, t: ArrayLike) -> tuple[Tensor, Tensor, bool]:
        rows, single = checks.states(x, self.ocp.system.nx, self.ocp.system.name, "x")
        times = checks.numeric(t, "t", self.ocp.system.name, f"one time or {len(rows)}")
        if times.shape not in ((), (len(rows),)) or not ((times >= 0) & (times <= self.ocp.horizon * (1 + 1e-9))).all():
            raise ValueError(f"t is {np.array2string(times, threshold=4)}; expected one time or {len(rows)}, "
                             f"each in [0, {self.ocp.horizon:g}]")
        times = np.broadcast_to(times, len(rows)).copy()[:, None]
        return torch.from_numpy(rows.copy()), torch.from_numpy(times), single


def train_neural_oc(ocp: OCP, settings: NeuralOCSettings | None = None, *, dynamics: None = None, seed: int = 0,
                    progress: bool | None = True) -> NeuralOC:
    """V(x, t) and its feedback for an OCP, on the exact f, in float32 on one core.

    Parameters
    ----------
    dynamics : None, the exact f: the method is published for known dynamics
    seed : of the initial network and the initial states; the caller's own generators are left alone
    progress : the terms of the loss and the time left, on stderr

    Path constraints enter as the OCP's penalty (OCP.L_soft). Nothing is written to disk. Raises ValueError for other
    dynamics; where H has no minimiser in closed form, or L is not strictly convex in u (u jumps then, and nothing is
    learned through it); and where training diverges, naming the iteration and what to try.
    """
    checks.problem(ocp, "train_neural_oc")
    ocp.refuse_parameters("train_neural_oc")
    ocp.refuse_constraints("train_neural_oc")
    if dynamics is not None:
        raise ValueError(f"train_neural_oc: dynamics is a {type(dynamics).__name__}; expected None: NeuralOC knows the "
                         "exact f, in closed form; for learned dynamics use nocl.train(ocp, dynamics=...)")
    settings = settings or NeuralOCSettings()
    with one_thread():
        start = time.perf_counter()
        trainer = Trainer(ocp, settings, seed)
        trainer.train(progress)
        seconds = time.perf_counter() - start
    if not math.isfinite(trainer.lowest):
        raise ValueError(f"NeuralOC on {ocp.system.name}: no network has a finite loss on held-out states; expected "
                         f"one: try a smaller learning_rate (is {settings.learning_rate:g}) or more steps (are "
                         f"{settings.steps})")
    net = trainer.net.double()
    net.load_state_dict(trainer.best)
    card = {"method": "NeuralOC", "settings": asdict(settings) | {"weights": list(settings.weights)}, "seed": seed,
            "seconds": seconds, "nfe": trainer.nfe, "held_out": trainer.lowest,
            "best_iteration": trainer.best_iteration,
            "history": {name: [row[i] for row in trainer.rows] for i, name in enumerate(TERMS)}}
    return NeuralOC(ocp, net, card)


def applicable(ocp: OCP) -> None:
    """ValueError, at once, for a problem that NeuralOC is not for: see train_neural_oc."""
    minimiser_of(ocp)
    _scale(ocp)


class Trainer:
    """One training: the problem in torch, its network and random numbers, the best network so far."""

    def __init__(self, ocp: OCP, settings: NeuralOCSettings, seed: int, dtype: torch.dtype = torch.float32) -> None:
        self.ocp, self.settings, self.dtype = ocp, settings, dtype
        field, self.final = characteristics(ocp), to_torch(_terminal(ocp))
        self.field = FusedFunction(field) if settings.fused else to_torch(field)
        self.rng = np.random.default_rng(seed)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(int(self.rng.integers(2**31)))
            self.net = ValueNet(ocp.system.nx, settings.width, settings.layers, settings.rank, _scale(ocp)).to(dtype)
        self.nfe, self.rows = 0, list[list[float]]()  # rows: the terms of each iteration
        self.adam = torch.optim.Adam(self.net.parameters(), lr=settings.learning_rate)
        self.held_out, self.x0 = self.states(), self.states()
        self.best, self.lowest, self.best_iteration = copy.deepcopy(self.net.state_dict()), math.inf, 0

    def states(self) -> Tensor:
        """Fresh initial states [batch, nx]."""
        return torch.as_tensor(self.ocp.initial_states.sample(self.settings.batch, self.rng), dtype=self.dtype)

    def terms(self, x0: Tensor) -> Tensor:
        """The five terms [5] on rollouts from x0 [B, nx], each a mean."""
        nx, K, T = self.ocp.system.nx, self.settings.steps, self.ocp.horizon

        def rate(z: Tensor, _: None) -> Tensor:  # z = (x, t, integral of L, integral of the HJB residual)
            V_x, V_t = self.net.gradient(z[:, :nx], z[:, nx: nx + 1])
            y = self.field(torch.cat([z[:, :nx], V_x], 1))
            return torch.cat([y[:, :nx], torch.ones_like(V_t), y[:, nx: nx + 1], (V_t + y[:, nx + 1:]).abs()], 1)

        z = nn.functional.pad(x0, (0, 3))
        for _ in range(K):
            z = rk4(rate, z, None, T / K)
        self.nfe += 4 * K * len(x0)
        x, t = z[:, :nx], torch.full_like(z[:, :1], T)
        G = self.final(x)
        V, V_x = self.net(x, t), self.net.gradient(x, t)[0]
        return torch.stack([z[:, nx + 1].mean(), G[:, 0].mean(), z[:, nx + 2].mean(), (V - G[:, :1]).abs().mean(),
                            (V_x - G[:, 1:]).abs().sum(1).mean()])

    def loss(self, terms: Tensor) -> Tensor:
        return terms @ torch.tensor([1.0, 1.0, *self.settings.weights], dtype=self.dtype)

    def train(self, progress: bool | None) -> None:
        """All iterations that are left."""
        todo = range(len(self.rows), self.settings.iterations)
        with progress_bar(len(todo), f"NeuralOC on {self.ocp.system.name}", progress) as bar:
            for _ in todo:
                self.iteration()
                said = ", ".join(f"{n}={v:.3g}" for n, v in zip(TERMS, self.rows[-1], strict=True))
                bar.set_postfix_str(said, refresh=False)
                bar.update()

    def iteration(self) -> None:
        """One step of Adam, and what is due after it."""
        s, terms = self.settings, self.terms(self.x0)
        self.adam.zero_grad()
        self.loss(terms).backward()
        self.rows.append(terms.tolist())
        self.check_finite()
        self.adam.step()
        k = len(self.rows)
        if k % s.check_every == 0 or k % s.drop_every == 0 or k == s.iterations:
            self.look(k)
        if k % s.drop_every == 0:
            self.net.load_state_dict(self.best)
            self.adam.param_groups[0]["lr"] *= s.drop
        if k % s.resample_every == 0:
            self.x0 = self.states()

    def look(self, iteration: int) -> None:
        """The loss on held-out states; the best network is kept."""
        with torch.no_grad():
            loss = float(self.loss(self.terms(self.held_out)))
        if loss < self.lowest:
            self.best, self.lowest, self.best_iteration = copy.deepcopy(self.net.state_dict()), loss, iteration

    def check_finite(self) -> None:
        gradients = [p.grad.sum() for p in self.net.parameters() if p.grad is not None]
        if not all(map(math.isfinite, self.rows[-1])) or not torch.isfinite(torch.stack(gradients)).all():
            shown = ", ".join(f"{n} {v:.3g}" for n, v in zip(TERMS, self.rows[-1], strict=True))
            raise ValueError(f"training diverged at iteration {len(self.rows)}: NaN or infinite losses or gradients "
                             f"({shown}); expected finite ones: try a smaller learning_rate (is "
                             f"{self.settings.learning_rate:g}), more steps (are {self.settings.steps}), or a shorter "
                             "horizon, narrower initial_states, tighter control bounds")


def minimiser_of(ocp: OCP) -> ca.Function:
    """(x, costate) -> u*, in SX."""
    function = minimiser(ocp)
    if function is None:
        raise ValueError(f"NeuralOC of {ocp.system.name!r}: its Hamiltonian L + p'f has no minimiser in closed form; "
                         "expected one quadratic in u that couples at most 4 controls: use nocl.train or NMPC")
    at = Arguments.of(function)
    return at.function("u", {"u": at.call(function)[0]})


def characteristics(ocp: OCP) -> ca.Function:
    """(x, costate) in one vector -> (f, L, H) at u*(x, costate)."""
    best = minimiser_of(ocp)
    at = Arguments.of(best)
    here = at.given(u=at.call(best))
    f, L = here.call(ocp.functions.f), here.call(ocp.functions.L_soft)
    return ca.Function("characteristics", [ca.vertcat(*at.inputs)], [ca.vertcat(f, L, L + ca.dot(at["costate"], f))])


def _terminal(ocp: OCP) -> ca.Function:
    """x -> (G, G_x)."""
    at = ocp.functions.end
    G, G_x, _ = at.call(ocp.functions.G_derivatives)
    return at.function("terminal", {"G": ca.vertcat(G, G_x)})


def _scale(ocp: OCP) -> float:
    """Half the mean curvature of L in u at the goal: the weight of ||u||^2."""
    s = ocp.system
    L_zz = ocp.functions.L_derivatives(ocp.x_goal, ocp.u_goal)[2].full()
    curvature = np.linalg.eigvalsh(L_zz[s.nx:, s.nx:])
    if curvature.min() <= 0:
        raise ValueError(f"NeuralOC of {s.name!r}: the Hessian of L in u has the eigenvalues {curvature.tolist()} at "
                         "the goal; expected > 0, or u* jumps and nothing is learned through it: add a cost on each "
                         "control, or use nocl.train")
    return float(curvature.mean() / 2)
