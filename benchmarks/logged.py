"""Dynamics from logged trajectories alone: how far ahead they predict, and what a controller trained on them does.

    python benchmarks/logged.py acrobot|options|pendulum|unstable

acrobot   recordings of the simulated acrobot, 50 Hz, random controls, normal noise of 0.01 rad and 0.01 rad/s
options   the simulated pendulum with noise of 0.02, by what is stated and how it is fitted
pendulum  Gymnasium's Pendulum-v1 as the plant: its observations are logged, its equations are never shown; a controller
          is trained on what was learned, and run on it
unstable  recordings of Gymnasium's InvertedPendulum-v5 in tests/data, no noise, forces that jump at every sample
"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).parent))
import provenance
from learned_optimum import FINE, lost, optimum

import nocl
from nocl.judge import simulate
from nocl.solvers.cnd import TrainSettings
from nocl.solvers.ddp.global_search import solve_globally
from nocl.solvers.ddp.solver import DDP
from nocl.support.checks import Array
from nocl.sysid.identification import LearnedDynamics, LogSettings, identify
from nocl.sysid.logs.log import Log
from nocl.systems import acrobot, pendulum
from nocl.translate.rk4 import rk4_interval

STEPS = (1, 5, 10, 25, 50, 100)


def waves(rng: np.random.Generator, runs: int, t: Array, nu: int, size: float) -> Array:
    """Random controls [runs, len(t), nu]: sums of four sines of 0.1 to 1 Hz."""
    f, phase = rng.uniform(0.1, 1.0, (runs, 1, 4, nu)), rng.uniform(0, 2 * np.pi, (runs, 1, 4, nu))
    return size / 2 * (rng.standard_normal((runs, 1, 4, nu)) * np.sin(2 * np.pi * f * t[None, :, None, None] + phase)
                       ).sum(axis=2)


def recordings(system: nocl.System, runs: int, sigma: float, seed: int = 0, K: int = 150, h: float = 0.02,
               size: float = 3.0) -> Log:
    """From random states (angles anywhere, rates up to 2), controls held, exact between samples but for the noise."""
    rng, f = np.random.default_rng(seed), nocl.to_torch(system.f)
    t = h * np.arange(K + 1)
    u = np.clip(waves(rng, runs, t, system.nu, size), system.lbu, system.ubu)
    widest = np.where(np.isin(np.arange(system.nx), system.angle_indices), np.pi, 2.0)
    x = [torch.from_numpy(rng.uniform(-widest, widest, (runs, system.nx)))]
    for k in range(K):
        x.append(rk4_interval(f, x[-1], torch.from_numpy(u[:, k]), h, 10))
    states = torch.stack(x, 1).numpy()
    states = states + sigma * rng.standard_normal(states.shape)
    return Log.of(system, np.tile(t, runs), states.reshape(-1, system.nx), u.reshape(-1, system.nu),
                  run=np.repeat(np.arange(runs), K + 1))


def error_at(model: LearnedDynamics, log: Log, system: nocl.System) -> float:
    """Mean ||f_theta - f|| over a log's states and controls."""
    x = np.concatenate([r.x[:-1] for r in log])
    u = np.concatenate([r.u for r in log])
    with torch.no_grad():
        learned = model(torch.from_numpy(x), torch.from_numpy(u)).numpy()
    return float(np.linalg.norm(learned - system.f(x.T, u.T).full().T, axis=1).mean())


def learned(system: nocl.System, log: Log, test: Log, exact: nocl.System | None, clean: Log | None = None,
            **options: Any) -> tuple[LearnedDynamics, dict[str, Any]]:
    model = identify(system, data=log, progress=False, **options)
    row: dict[str, Any] = {"samples": len(log), "seconds": model.card["seconds"], "structure": model.structure,
                           "validation": model.validate(test, STEPS).to_data()}
    if exact is not None and clean is not None:
        row["error"] = error_at(model, clean, exact)
    print(options, row["seconds"], row.get("error"), model.validate(test, STEPS), sep="\n", flush=True)
    return model, row


def unknown(system: nocl.System) -> nocl.System:
    """Names and boxes alone."""
    return nocl.System(system.name, x=system.x, u=system.u, xdot=None, lbu=system.lbu, ubu=system.ubu, lbx=system.lbx,
                       ubx=system.ubx, angles=system.angles, units=system.units)


def run_acrobot() -> None:
    """Learn, validate on other recordings, then the learned optimum as feedback on the exact acrobot."""
    exact, ocp = acrobot.system(), acrobot.ocp()
    log, clean = recordings(exact, 50, 0.01), recordings(exact, 10, 0.0, seed=1)
    train, test = log.split(0.2)
    known = {"th1": "w1", "th2": "w2"}
    model, row = learned(unknown(exact), train, test, exact, clean, known=known, control_affine=True)
    model.validate(test, STEPS).plot().savefig(Path(__file__).parent.parent / "docs" / "logged.png", dpi=80)
    x0 = ocp.initial_states.sample(20, 1)
    row["outside"] = int(model.outside(x0).sum())
    J = simulate(ocp, optimum(ocp, None, x0).feedback, x0, hold=FINE).cost
    solution = optimum(ocp, model, x0)
    row["states outside"] = float(model.outside(solution.x[solution.success].reshape(-1, 4)).mean())
    row["lost"] = lost(ocp, model, x0, J)
    print(row["outside"], row["states outside"], row["lost"], flush=True)
    provenance.write("logged_acrobot", [row])


def run_options() -> None:
    """The simulated pendulum: its box is small enough that 16 recordings fill it."""
    exact = pendulum.system()
    log, clean = recordings(exact, 20, 0.02, K=100), recordings(exact, 20, 0.0, seed=1, K=100)
    train, test = log.split(0.2)
    size = LogSettings(width=16, window=25, steps=10)
    known: dict[str, Any] = {"known": {"theta": "omega"}}
    affine = {"control_affine": True}
    cases: dict[str, dict[str, Any]] = {
        "nothing": {}, "known row": known, "control-affine": affine, "both": known | affine,
        "both, angles as they are": known | affine | {"settings": replace(size, angles=False)},
        "both, derivatives only": known | affine | {"settings": replace(size, steps=0)}}
    rows = []
    for name, options in cases.items():
        _, row = learned(unknown(exact), train, test, exact, clean, **{"settings": size, **options})
        rows.append({"stated": name, **row})
        provenance.write("logged_options", rows)


def gym_logs(system: nocl.System, episodes: int, steps: int, seed: int = 0) -> Log:
    """Pendulum-v1 from its own resets, random torques held for 1 to 10 samples; angles from its observations."""
    import gymnasium

    env, rng, rows = gymnasium.make("Pendulum-v1"), np.random.default_rng(seed), []
    for episode in range(episodes):
        seen, _ = env.reset(seed=1000 * seed + episode)
        left = 0
        for k in range(steps + 1):
            if not left:
                torque, left = rng.uniform(-2, 2), int(rng.integers(1, 11))
            rows.append([episode, 0.05 * k, np.arctan2(seen[1], seen[0]), seen[2], torque])
            seen, *_ = env.step(np.array([torque], dtype=np.float32))
            left -= 1
    run, t, theta, omega, u = np.array(rows).T
    return Log.of(system, t, np.column_stack([theta, omega]), u[:, None], run=run.astype(int))


def on_gym(controllers: list[Any], x0: Array, steps: int, L: ca.Function, G: ca.Function) -> tuple[Array, Array]:
    """(cost [B], last state [B, 2]) on Pendulum-v1 of controllers (x [1, 2], t) -> u, one a start, every 0.05 s."""
    import gymnasium

    env, costs, ends = gymnasium.make("Pendulum-v1", max_episode_steps=10_000), [], []
    for controller, start in zip(controllers, x0, strict=True):
        env.reset(seed=0)
        env.unwrapped.state = np.array(start)  # a real one would be let hang
        x, cost = np.array(start), 0.0
        for k in range(steps):
            u = np.clip(controller(x[None], 0.05 * k)[0], -2, 2)
            before = x
            seen, *_ = env.step(u.astype(np.float32))
            turned = np.arctan2(seen[1], seen[0])
            x = np.array([before[0] + (turned - before[0] + np.pi) % (2 * np.pi) - np.pi, seen[2]])
            cost += 0.05 * float(L(before, u) + L(x, u)) / 2
        costs.append(cost + float(G(x)))
        ends.append(x)
    return np.array(costs), np.array(ends)


def run_pendulum() -> None:
    """Log, learn, validate, train, run."""
    theta, omega, torque = (ca.SX.sym(n) for n in ("theta", "omega", "torque"))
    plant = nocl.System("gym_pendulum", x=ca.vertcat(theta, omega), u=torque, xdot=None, lbu=[-2], ubu=[2],
                        lbx=[-np.pi, -8], ubx=[np.pi, 8], angles=["theta"])
    train, test = gym_logs(plant, 30, 100).split(0.2)
    model, row = learned(plant, train, test, None, settings=LogSettings(width=20, window=10, steps=8))
    cost = (1 - ca.cos(theta)) + 0.05 * omega**2
    ocp = nocl.OCP(model.to_system(), horizon=5.0, running=cost + 0.01 * torque**2, terminal=10 * cost,
                   x_goal=[0, 0], u_goal=[0], initial_states=nocl.Gaussian(mean=[np.pi, 0], std=[0.1, 0.1]))
    start = time.perf_counter()
    settings = TrainSettings(intervals=100, seeds=8, starts=8, states=100, tails=600, visits=400, rounds=2,
                             iterations=1000, hidden=(64, 64), held_out=16, value=False)
    cnd = nocl.train(ocp, dynamics=model, settings=settings, seed=0, progress=False)
    row["seconds_train"] = round(time.perf_counter() - start, 1)
    x0 = ocp.initial_states.sample(30, 1)
    row["outside"] = int(model.outside(x0).sum())
    planned = solve_globally(DDP(ocp, intervals=100, dynamics=model), x0, starts=8, seed=0)
    row["n"] = len(x0)
    each = [planned[i].feedback for i in range(len(x0))]
    for name, controllers in (("CND", [cnd] * len(x0)), ("DDP", each)):
        costs, ends = on_gym(controllers, x0, 100, ocp.L, ocp.G)
        tilt = np.abs((ends[:, 0] + np.pi) % (2 * np.pi) - np.pi)
        row[name] = {"upright": int((tilt < 0.1).sum()), "tilt": float(np.median(tilt)),
                     "worst tilt": float(tilt.max()), "speed": float(np.abs(ends[:, 1]).max()),
                     "excess % over the plan": float(100 * np.median(costs / planned.cost - 1))}
    print({k: v for k, v in row.items() if k != "validation"}, flush=True)
    provenance.write("logged_pendulum", [row])


def run_unstable() -> None:
    """By what is stated and how it is fitted; the defaults otherwise."""
    names = ("x", "theta", "v", "omega")
    plant = nocl.System("inverted_pendulum", x=ca.vertcat(*map(ca.SX.sym, names)), u=ca.SX.sym("a"), xdot=None,
                        lbu=[-3], ubu=[3], lbx=[-1, -0.3, -4, -4], ubx=[1, 0.3, 4, 4], angles=["theta"])
    log = Log.read(Path(__file__).parent.parent / "tests" / "data" / "inverted_pendulum.csv", plant)
    train, test = log.split(0.2)
    both: dict[str, Any] = {"known": {"x": "v", "theta": "omega"}, "control_affine": True}
    rows = []
    for name, options in {"nothing": {}, "both": both,
                          "both, derivatives only": both | {"settings": LogSettings(steps=0)}}.items():
        model, row = learned(plant, train, test, None, **options)
        rows.append({"stated": name, "windows": model.card["windows"], **row})
        provenance.write("logged_unstable", rows)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("acrobot", "options", "pendulum", "unstable"))
    {"acrobot": run_acrobot, "options": run_options, "pendulum": run_pendulum,
     "unstable": run_unstable}[parser.parse_args().what]()
