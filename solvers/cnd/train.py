"""nocl.train: from an optimal control problem to a checked feedback controller.

The default method regresses the controller on optimal answers, and never differentiates through a rollout:

1. a few global optima (cold starts), and from them those of many initial states;
2. optimal tails from a tube about these trajectories, all by batched DDP on the dynamics that training uses;
3. regression of u(x, t) on the middle of every interval, so that the controller is feedback in continuous time;
4. rounds: the states that the controller visits under kicks are solved too and added (DAgger, Ross et al. 2011), until
   it meets the wanted gap on held-out initial states (after two rounds at least) or the rounds are used up;
5. V(x, t) by regression on the costs-to-go and their gradients, the costates.
"""

from __future__ import annotations

import hashlib
import json
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from tqdm import tqdm

from nocl import store
from nocl.checks import Array
from nocl.nets import FeatureNet
from nocl.ocp import OCP
from nocl.solvers.bank import SolutionBank, extend, solve_globally
from nocl.solvers.cnd.controller import CND
from nocl.solvers.cnd.features import policy_net
from nocl.solvers.cnd.labels import Labels, continuous_cost, tube, visited
from nocl.solvers.cnd.regress import fit, policy_loss
from nocl.solvers.cnd.value import ValueLabels, value_loss, value_net, value_solutions
from nocl.solvers.ddp import DDP
from nocl.symbolic import to_data
from nocl.threads import one_thread
from nocl.to_torch import to_torch

if TYPE_CHECKING:
    from nocl.solvers.cnd.paper import PaperSettings
    from nocl.sysid import LearnedDynamics

CHECKPOINT = "training.safetensors"
STREAM = 0x6E6F636C  # training's own random numbers: never those of initial_states.sample(n, seed), whatever the seeds


@dataclass(frozen=True)
class TrainSettings:
    """The default method's settings."""

    intervals: int = 80  # RK4 steps and held controls of each labelled solution
    seeds: int = 20  # initial states solved globally, from cold starts
    starts: int = 16  # cold starts of each
    states: int = 400  # further initial states, solved from their neighbours
    tails: int = 3000  # optimal tails from the tube
    width: float = 0.25  # of the tube, in units of each state's spread along the solutions
    visits: int = 2000  # visited states solved in each round
    kick: float = 0.1  # pushes on the visiting policy, in units of each state's spread
    rounds: int = 3  # of visited states, at most
    least_rounds: int = 2  # and at least: the gap is met sooner than under disturbances
    iterations: int = 2000  # of each regression; twice as many from the round on that may be the last
    batch: int = 1024
    lr: float = 4e-3
    hidden: tuple[int, ...] = (64, 64, 64)
    value: bool = True  # whether to train V(x, t) too
    value_tails: int = 3000  # solved for V, from the tube and from the policy's own answers
    value_iterations: int = 3000
    held_out: int = 64  # initial states that tell when to stop
    gap_median: float = 2e-4  # stop once both are met: (J - J*) / J*, median over the held-out states,
    gap_p95: float = 1e-3  # and its 95th percentile

    def __post_init__(self) -> None:
        for f in fields(self):
            value, least = getattr(self, f.name), 0 if f.name in ("rounds", "least_rounds", "states", "tails") else 1
            if f.type == "int" and (isinstance(value, bool) or not isinstance(value, int) or value < least):
                raise ValueError(f"TrainSettings: {f.name} is {value!r}; expected a whole number of at least {least}")
            if f.type == "float" and not (isinstance(value, (int, float)) and 0 < value < float("inf")):
                raise ValueError(f"TrainSettings: {f.name} is {value!r}; expected a positive number")
        if not self.hidden or not all(isinstance(h, int) and h > 0 for h in self.hidden):
            raise ValueError(f"TrainSettings: hidden is {self.hidden!r}; expected widths such as (64, 64, 64)")


def train(ocp: OCP, dynamics: LearnedDynamics | None = None, *, method: str = "default",
          settings: TrainSettings | PaperSettings | None = None, seed: int = 0,
          out: str | os.PathLike[str] | None = None, progress: bool | None = None) -> CND:
    """Train a controller and a value function for all of an OCP's initial states.

    Parameters
    ----------
    ocp : OCP
    dynamics : LearnedDynamics, optional
        f_theta in place of the exact f; the exact one is then not used anywhere.
    method : "default" or "paper"
        "paper" is CND as published: HJB losses through ODE rollouts, see nocl.solvers.cnd.paper.
    settings : TrainSettings, or PaperSettings with method="paper"
    seed : int
        The same seed gives the same controller on the same machine.
    out : folder, optional
        Where checkpoints go: a call with the same arguments goes on from the last one. The default method only.
    progress : bool, optional
        Whether to show progress; by default where the terminal is one.
    """
    _check(ocp, dynamics, seed, out)
    if method == "paper":
        from nocl.solvers.cnd.paper import PaperSettings, train_paper

        chosen = _expect(settings, PaperSettings)
        policy, value, card = train_paper(ocp, dynamics, chosen, seed=seed, progress=progress)
        return CND(ocp, policy, value, card)
    if method != "default":
        raise ValueError(f"train: method is {method!r}; expected 'default' or 'paper'")
    return _Training(ocp, dynamics, _expect(settings, TrainSettings), seed, out, progress).run()


def _check(ocp: OCP, dynamics: LearnedDynamics | None, seed: int, out: str | os.PathLike[str] | None) -> None:
    if not isinstance(ocp, OCP):
        raise ValueError(f"train: ocp is a {type(ocp).__name__}; expected a nocl.OCP")
    if isinstance(seed, bool) or not isinstance(seed, int) or not 0 <= seed < 2**62:
        raise ValueError(f"train: seed is {seed!r}; expected a whole number from 0 to 2**62")
    if out is not None and Path(out).exists() and not Path(out).is_dir():
        raise ValueError(f"train: out is the file {out}; expected a folder for checkpoints")
    if dynamics is not None and not hasattr(dynamics, "system"):
        raise ValueError(f"train: dynamics is a {type(dynamics).__name__}; expected what nocl.identify returns, or "
                         "None for the exact f")
    if dynamics is not None and (dynamics.system.nx, dynamics.system.nu) != (ocp.system.nx, ocp.system.nu):
        raise ValueError(f"train: dynamics has {dynamics.system.nx} states and {dynamics.system.nu} controls, "
                         f"{ocp.system.name} has {ocp.system.nx} and {ocp.system.nu}: identify that system")


def _expect(settings: Any, kind: Any) -> Any:
    if settings is not None and not isinstance(settings, kind):
        raise ValueError(f"train: settings is a {type(settings).__name__}; this method takes {kind.__name__}")
    return settings or kind()


class _Training:
    """One run of the default method; its state between rounds is what a checkpoint holds."""

    def __init__(self, ocp: OCP, dynamics: LearnedDynamics | None, settings: TrainSettings, seed: int,
                 out: str | os.PathLike[str] | None, progress: bool | None) -> None:
        self.ocp, self.settings, self.seed = ocp, settings, seed
        self.learned = dynamics is not None
        self.f = to_torch(ocp.system.f) if dynamics is None else dynamics
        self.ddp = DDP(ocp, intervals=settings.intervals, dynamics=dynamics)
        self.fine = DDP(ocp, intervals=4 * settings.intervals, dynamics=dynamics)
        self.checkpoint = None if out is None else Path(out) / CHECKPOINT
        self.hidden_progress = None if progress is None else not progress
        self.round, self.seconds = 0, 0.0
        self.history: list[dict[str, Any]] = []

    def run(self) -> CND:
        with one_thread():
            return self._run()

    def _run(self) -> CND:
        s = self.settings
        if not self._resume():
            self._first_labels()
            self._network()
        while self.round <= s.rounds and not self._good_enough():
            if self.round:
                self._visit()
            self._regress(s.iterations * (2 if self.round >= max(s.least_rounds, 1) else 1))
            self._validate()
            self.round += 1
            self._save()
        value = self._value() if s.value else None
        return CND(self.ocp, self.policy, value, self._card())

    def _first_labels(self) -> None:
        s, rng = self.settings, self._rng(0)
        with self._stage("labels", s.starts + 6) as bar:
            def report(what: str) -> None:
                bar.set_postfix_str(what, refresh=False)
                bar.update()

            seeds = solve_globally(self.ddp, self.ocp.initial_states.sample(s.seeds, rng), starts=s.starts, seed=rng,
                                   report=report).best
            self.bank = SolutionBank.of(self.ddp, seeds)
            if s.states:
                more = extend(self.ddp, self.bank, self.ocp.initial_states.sample(s.states, rng))
                self.bank = SolutionBank.of(self.ddp, type(more).join([seeds, more]))
            parts = [self.bank.solution] + ([tube(self.ddp, self.bank, s.tails, s.width, rng)] if s.tails else [])
            self.labels = Labels.join([Labels.of(p, self.f) for p in parts])
            self.first = len(self.labels)

    def _network(self) -> None:
        """The policy's networks, scaled by the first labels."""
        with _seeded(self.seed):
            self.policy, self.inverse = policy_net(self.ocp, self.labels[: self.first], self.settings.hidden)

    def _visit(self) -> None:
        s = self.settings
        with self._stage(f"round {self.round}: visited states", 1) as bar:
            solved = visited(self.ddp, self.bank, self.policy, self.f, s.visits, s.kick, self._rng(self.round))
            self.labels = Labels.join([self.labels, Labels.of(solved, self.f)])
            bar.update()

    def _regress(self, iterations: int) -> None:
        s = self.settings
        loss = policy_loss(self.ocp, self.policy, self.inverse, self.labels)
        with self._stage(f"round {self.round}: controller", iterations) as bar:
            fit(self.policy, loss, len(self.labels), iterations=iterations, batch=s.batch, lr=s.lr,
                seed=self.seed + self.round, report=_reporter(bar))

    def _validate(self) -> None:
        """The gap to the optimum as continuous-time feedback, on initial states that no label starts from."""
        x0 = self.ocp.initial_states.sample(self.settings.held_out, self._rng(1_000_000))
        with self._stage("held-out states", 1) as bar:
            coarse = extend(self.ddp, self.bank, x0)
            best = self.fine.solve(x0, u=np.repeat(coarse.u, 4, axis=1))
            J = continuous_cost(self.ocp, self.policy, self.f, x0, self.fine.intervals)
            gap = (J - best.cost)[best.success] / np.abs(best.cost[best.success])
            median, p95 = np.quantile(gap, [0.5, 0.95]) if len(gap) else (np.nan, np.nan)
            bar.set_postfix_str(f"gap {100 * median:.3f} %, p95 {100 * p95:.3f} %")
            bar.update()
        self.history.append({"round": self.round, "labels": len(self.labels), "gap_median": float(median),
                             "gap_p95": float(p95)})

    def _good_enough(self) -> bool:
        if self.round <= self.settings.least_rounds:
            return False
        last, s = self.history[-1], self.settings
        return bool(last["gap_median"] <= s.gap_median and last["gap_p95"] <= s.gap_p95)

    def _value(self) -> FeatureNet:
        s, rng = self.settings, self._rng(2_000_000)
        with self._stage("value labels", 1) as bar:
            labels = ValueLabels.of(value_solutions(self.ddp, self.fine, self.bank, self.policy, self.f, s.value_tails,
                                                    s.width, rng))
            bar.update()
        with _seeded(self.seed + 1):
            net = value_net(self.ocp, labels, s.hidden)
        loss = value_loss(net, labels, self.bank.scale)
        with self._stage("value function", s.value_iterations) as bar:
            fit(net, loss, len(labels), iterations=s.value_iterations, batch=s.batch // 2 or 1, lr=s.lr,
                seed=self.seed, report=_reporter(bar))
        return net

    def _card(self) -> dict[str, Any]:
        last = self.history[-1]
        return {"method": "default", "dynamics": "learned" if self.learned else "exact", "seed": self.seed,
                "gap_median": last["gap_median"], "gap_p95": last["gap_p95"], "seconds": round(self.seconds, 1),
                "settings": asdict(self.settings), "history": self.history}

    @contextmanager
    def _stage(self, name: str, total: int) -> Iterator[tqdm[Any]]:
        start = time.perf_counter()
        with tqdm(total=total, desc=name, disable=self.hidden_progress, leave=True) as bar:
            yield bar
        self.seconds += time.perf_counter() - start

    def _rng(self, stage: int) -> np.random.Generator:
        return np.random.default_rng([self.seed, stage, STREAM])

    def _identity(self) -> str:
        """What a checkpoint must have been made for."""
        return json.dumps([self.ocp.to_data(), asdict(self.settings), self.seed, _fingerprint(self.f)], sort_keys=True)

    def _save(self) -> None:
        if self.checkpoint is None:
            return
        state = {"policy": self.policy.state_dict(), "labels": _tensors(vars(self.labels)),
                 "bank": _tensors({k: v for k, v in vars(self.bank.solution).items() if k != "message"})}
        meta = {"identity": self._identity(), "round": self.round, "history": self.history, "seconds": self.seconds,
                "first": self.first}
        self.checkpoint.parent.mkdir(parents=True, exist_ok=True)
        store.save_checkpoint(self.checkpoint, state, meta)

    def _resume(self) -> bool:
        """Take up the checkpoint of the same run, where there is one; others are left aside and overwritten."""
        if self.checkpoint is None or not self.checkpoint.exists():
            return False
        state, meta = store.load_checkpoint(self.checkpoint)
        if meta["identity"] != self._identity():
            return False
        self.labels = Labels(**_arrays(state["labels"]))
        self.bank = SolutionBank.from_arrays(self.ddp, _arrays(state["bank"]))
        self.round, self.history, self.seconds, self.first = (meta[k] for k in ("round", "history", "seconds", "first"))
        self._network()
        self.policy.double().load_state_dict(state["policy"])
        self.policy.eval().requires_grad_(False)
        return True


def _reporter(bar: tqdm[Any]) -> Any:
    def report(loss: float) -> None:
        bar.update()
        if bar.n % 50 == 0:
            bar.set_postfix_str(f"loss {loss:.2e}", refresh=False)

    return report


@contextmanager
def _seeded(seed: int) -> Iterator[None]:
    """torch's own generator at a seed, and back to where it was afterwards."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        yield


def _fingerprint(f: Any) -> str:
    """What tells one model from another: the SHA-256 of a FeatureNet's maps and weights; "exact" for the exact f."""
    net = getattr(f, "net", None)
    if net is None:
        return "exact"
    sha = hashlib.sha256(json.dumps([to_data(net.inputs), to_data(net.outputs)]).encode())
    for parameter in net.parameters():
        sha.update(parameter.detach().double().cpu().numpy().tobytes())
    return sha.hexdigest()


def _tensors(arrays: dict[str, Any]) -> dict[str, torch.Tensor]:
    return {k: torch.from_numpy(np.ascontiguousarray(v)) for k, v in arrays.items() if v is not None}


def _arrays(tensors: dict[str, torch.Tensor]) -> dict[str, Array]:
    return {k: v.numpy() for k, v in tensors.items()}
