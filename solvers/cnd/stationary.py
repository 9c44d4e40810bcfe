"""Laws for problems without an end: u(x), from the initial states to the goal pair, and there for ever.

Solutions over a time T end in LQR's cost to go, and T is long enough for all of them to get where that is right. Each
of their nodes is a label. Afterwards the law gets what it lacks of LQR at the goal, which it has exactly there:
u = net(x) + exp(-V_lqr / c) (du + dK (x - x*)).
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, cast

import casadi as ca
import numpy as np
import torch
from numpy.typing import NDArray

from nocl.data import Solution
from nocl.definition.ocp import OCP
from nocl.definition.sampling import own_numbers
from nocl.definition.substeps import FINE, RADAU
from nocl.judge.simulation import simulate
from nocl.nets import MLP, FeatureNet
from nocl.solvers.cnd.laws import FAR, LawTraining
from nocl.solvers.cnd.regression.in_torch import InTorch
from nocl.solvers.cnd.regression.labels import Labels, Problems, continuous_run
from nocl.solvers.cnd.settings import TrainSettings
from nocl.solvers.cnd.validate import over, summary
from nocl.solvers.ddp.bank import better
from nocl.solvers.ddp.global_search import solve_globally
from nocl.solvers.ddp.solver import DDP, substeps_for
from nocl.solvers.ddp.stationary_bank import StationaryBank, pruned
from nocl.solvers.lqr import LQR, ended
from nocl.support.checks import Array
from nocl.translate.arguments import Arguments

ACCURATE = 0.05  # LQR costs what V_lqr says to within this
TRIED = 64  # states of an ellipsoid, that this is tried from
HALVINGS = 20  # of the level at which LQR's controls leave U, at most
ENDED = 0.05  # of the level: where solutions have to end
THERE = 1e-3  # of the level: states so near the goal are not asked for
FIRST = 6.0  # time constants of the slowest mode under LQR, the first T
LATER = 1.3  # times when the last solution gets there
GROWN, GROWTHS = 1.5, 8  # T, where some do not; so often at most
FLOOR = 0.1  # of a usual cost, that errors are told against near the goal
SMALL = 0.02  # of a usual cost: the largest V_lqr that LQR's correction reaches to


def check_stationary(ocp: OCP, dynamics: Any, settings: TrainSettings) -> None:
    """ValueError where a stationary law is not to be had."""
    name = ocp.system.name
    if dynamics is not None:
        raise ValueError(f"train: the problem on {name!r} has an INFINITE horizon, and such laws are trained on the "
                         "exact f; expected no dynamics")
    if ocp.constraint_names:
        raise ValueError(f"train: the problem on {name!r} has an INFINITE horizon and the constraints "
                         f"{', '.join(ocp.constraint_names)}; expected U alone: give it a number as horizon, or leave "
                         "them out, ocp.unconstrained")
    ocp.refuse_parameters("train on an INFINITE horizon")
    if settings.integrator == RADAU:
        raise ValueError(f"train: the problem on {name!r} has an INFINITE horizon, and its law is trained by "
                         "Runge-Kutta steps; expected integrator='auto' or 'rk4'")
    if settings.minutes is not None or settings.control_dt or settings.branches > 1:
        raise ValueError("train: minutes, control_dt and branches are for problems whose horizon is a number; expected "
                         "none of them: fewer iterations, tails and visits take less time")


def accurate_level(ocp: OCP, lqr: LQR) -> float:
    """The largest level of V_lqr = x' P x / 2 below which LQR stays in U and costs what V_lqr says, tried by runs."""
    s = ocp.system
    P, K = lqr.P(), lqr.K()
    room = np.minimum(s.ubu - ocp.u_goal, ocp.u_goal - s.lbu)
    level = float(np.min(room**2 / (2 * np.einsum("ij,jk,ik->i", K, np.linalg.inv(P), K)).clip(1e-300)))
    way = np.random.default_rng(0).standard_normal((TRIED, s.nx))
    root = np.linalg.cholesky(np.linalg.inv(P))
    on = (way / np.linalg.norm(way, axis=1, keepdims=True)) @ root.T * math.sqrt(2)  # where V_lqr is 1
    slowest = -1 / np.linalg.eigvals(lqr.A - lqr.B @ K).real.max()
    for _ in range(HALVINGS):
        run = simulate(ocp, lqr, ocp.x_goal + math.sqrt(level) * on, nodes=2, duration=FIRST * slowest)
        if run.success.all() and (np.abs(run.cost / level - 1) < ACCURATE).all():
            return level
        level /= 2
    raise ValueError(f"train: LQR of {s.name!r} does not cost what its own value says however near the goal; expected "
                     "a goal pair with room to the bounds of U, and f smooth there")


class StationaryTraining(LawTraining):
    """One run, for u(x)."""

    def __init__(self, ocp: OCP, settings: TrainSettings, seed: int, progress: bool | None,
                 own: ca.Function | None) -> None:
        self.ocp, self.settings, self.seed, self.own, self.switches = ocp, settings, seed, own, False
        self.progress, self.lqr = progress, LQR(ocp)
        self.level = accurate_level(ocp, self.lqr)
        self.slowest = float(-1 / np.linalg.eigvals(self.lqr.A - self.lqr.B @ self.lqr.K()).real.max())
        self.round, self.seconds, self.history = 0, 0.0, list[dict[str, Any]]()

    def _over(self, T: float) -> None:
        """Solutions take T from now on."""
        s, self.posed = self.settings, ended(self.ocp, T)
        substeps = s.substeps or substeps_for(self.posed, None, s.grid, FINE)
        self.ddp = DDP(self.posed, intervals=s.grid, substeps=substeps)
        self.loose = DDP(self.posed, intervals=4 * s.grid, substeps=-(-substeps // 4))
        self.in_torch = InTorch(self.posed)

    def _arrival(self, s: Solution) -> tuple[NDArray[np.bool_], Array]:
        """(whether they end where LQR is right, when they got below the level for good) [B]."""
        V = self._value(s.x)
        outside = self.level < V
        last = np.where(outside.any(axis=1), V.shape[1] - 1 - outside[:, ::-1].argmax(axis=1), 0)
        return s.success & (V[:, -1] < ENDED * self.level), s.t[np.arange(len(s)), last]

    def _value(self, x: Array) -> Array:
        """V_lqr [...] of x [..., nx]."""
        return np.asarray(self.lqr.value(x.reshape(-1, x.shape[-1]))).reshape(x.shape[:-1])

    def _seeds(self, x: Array, rng: np.random.Generator) -> Solution:
        """Global optima of initial states, over a T that is long enough for all of them."""
        T, s = FIRST * self.slowest, self.settings
        for _ in range(GROWTHS):
            self._over(T)
            found = solve_globally(self.ddp, x, starts=s.starts, seed=rng, progress=False)
            found = pruned(self.ddp, found, self.lqr, self.level)
            arrived, when = self._arrival(found)
            if arrived.all() and LATER * when.max() <= T:
                return found
            T = LATER * float(when.max()) + 2 * self.slowest if arrived.all() else GROWN * T
        if not arrived.any():
            raise ValueError(f"train: no plan of {self.ocp.system.name!r} gets from initial states to the goal within "
                             f"{T:.3g}; expected some to: widen U, or move initial_states nearer")
        return found[arrived]

    def _first_labels(self) -> None:
        s, rng = self.settings, own_numbers(self.seed, 0)
        with self._stage("labels", 3) as bar:
            seeds = self._seeds(Problems.initial(self.ocp, s.seeds, rng).x, rng)
            self.bank: StationaryBank = StationaryBank(self.posed, seeds, self.lqr, self.level)
            bar.update()
            if s.states:
                further = Problems.initial(self.ocp, s.states, rng)
                self.bank = self.bank.add(self.bank.solve(self.ddp, further.x, further.p))
            self.bank = self.bank.cleaned(self.ddp, 4)
            bar.update()
            self.labels = self._labels(self.bank.solution)
            if s.tails:
                self._learn(self.bank.solve(self.ddp, *self.bank.around(s.tails, s.width, rng)))
            bar.update()

    def _labels(self, solution: Solution) -> Labels:
        """Of solutions that arrive, all of their nodes; errors count against what is still to pay."""
        s = solution[self._arrival(solution)[0]]
        unit = self._unit()
        labels = Labels.of(s, self.in_torch, unit, self.ddp.substeps)
        h, V = float(s.t[0, 1] - s.t[0, 0]), s.V[:, :-1].ravel()
        return replace(labels, t=np.zeros(len(labels)), weight=h / (np.abs(V) + FLOOR * unit))

    def _under_way(self, states: Array, p: Array) -> Array:
        """[B, steps+1], whether states are not yet at the goal, and not far out of X."""
        far = FAR * np.maximum(np.abs(self.ocp.system.lbx), np.abs(self.ocp.system.ubx))
        return (self._value(states) > THERE * self.level) & (np.abs(states) < far).all(axis=2)

    def _validate(self) -> None:
        """The gap of runs over T, with V_lqr where they end, to the optimum."""
        s, rng = self.settings, own_numbers(self.seed, 1_000_000)
        with self._stage("held-out states", 1) as bar:
            fresh = Problems.initial(self.ocp, s.held_out, rng)
            best = self.bank.solve(self.loose, fresh.x, fresh.p, 4)
            law = self._finished()
            J, x, _ = continuous_run(law, self.in_torch, fresh, 4 * s.grid)
            own = self.loose.solve(fresh.x, u=_held(law, x), progress=False)
            best = better(best, pruned(self.loose, own, self.lqr, self.level))
            arrived = self._value(x[:, -1]) < self.level
            gap = over(np.where(arrived, J, np.inf), best)
            bar.update()
        self.history.append({"round": self.round, "labels": len(self.labels), "unsolved": int((~best.success).sum()),
                             "arrived": float(arrived.mean()), **summary(gap, "gap")})

    def _card(self) -> dict[str, Any]:
        return {**super()._card(), "arrives_in": float(self.posed.horizon)}  # in which all solutions get there

    def _finished(self) -> FeatureNet:
        """The law with LQR's equilibrium and gain at the goal."""
        net, ocp = self.net, self.ocp
        at, y = Arguments.of(net.inputs), ca.SX.sym("y", int(net.outputs.numel_in(net.inputs.n_in())))
        goal = torch.from_numpy(np.array(ocp.x_goal))[None]
        t = torch.zeros(1, 1, dtype=goal.dtype)
        u = net(goal, t)[0].detach().numpy()
        slope = torch.autograd.functional.jacobian(lambda x: net(x, t)[0], goal)[:, 0].numpy()
        d = ocp.from_goal(at["x"])
        V = ca.substitute(self.posed.functions.terminal, self.posed.functions.arguments["x"], at["x"])
        reach = min(self.level, SMALL * self._unit())
        more = ca.exp(-V / reach) * (ca.DM(ocp.u_goal - u) + ca.DM(-self.lqr.K() - slope) @ d)
        said = net.outputs(*at.inputs, y) + more
        s = ocp.system
        inside = ca.fmin(ca.fmax(said, ca.DM(s.lbu)), ca.DM(s.ubu))
        exact = FeatureNet(net.inputs, cast(list[MLP], list(net.nets)), at.function("controls", {"u": inside}, y=y))
        return exact.double().eval().requires_grad_(False)


def _held(law: FeatureNet, x: Array) -> Array:
    """What a law answers along runs x [B, K+1, nx], [B, K, nu]."""
    B, nodes, nx = x.shape
    with torch.no_grad():
        u = law(torch.from_numpy(x[:, :-1].reshape(-1, nx)), torch.zeros(B * (nodes - 1), 1, dtype=torch.float64))
    return np.ascontiguousarray(u.numpy().reshape(B, nodes - 1, -1))
