"""The batched DDP: beside NMPC and others, its share of global optima, time and memory by batch size and by states.

    python benchmarks/ddp.py --others /path/to/venv/bin/python    # with do-mpc, rockit-meco and casadi in that venv
    python benchmarks/ddp.py --sections share --problems dubins   # the other sections' results stay as they are

speed    problems a second of CPU time: DDP on a batch, NMPC and the others state by state (nmpc.py), all on one core;
         DDP on all cores by the clock
share    solve_globally against the best known: DDP with 3 times the starts from another seed, and NMPC on a subset
learned  200 tails in a tube, on the exact f and on a learned one (nocl.identify), one core, CPU time
batch    cart-pole, cold from u*: 1 to 100,000 states, each size in a process of its own
states   4 to 48 states: cart-poles side by side, their carts joined by springs, the goal held by feedback at first

Results go to benchmarks/results/ddp.json, a provenance for each section; figures to docs/ddp_scaling.png.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import casadi as ca
import nmpc as others
import numpy as np
import provenance

import nocl
from nocl.solvers import NMPC
from nocl.solvers.cnd.regression.labels import tube_states
from nocl.solvers.ddp.bank import SolutionBank
from nocl.solvers.ddp.global_search import solve_globally
from nocl.solvers.ddp.solver import DDP
from nocl.support import store

FIGURE = provenance.RESULTS.parents[1] / "docs" / "ddp_scaling.png"
SECTIONS = ("speed", "share", "learned", "batch", "states")
PROBLEMS = ("cartpole", "acrobot", "quadrotor", "dubins")
BUNDLED = (*PROBLEMS, "pendulum", "van_der_pol", "double_integrator", "cartpole, wide box")
SIZES = (1, 10, 100, 1000, 10_000, 100_000)
POLES = (1, 2, 3, 6, 12)
TAILS = 200  # of the section learned
SAME = 1e-3  # relative: costs this close are the same optimum


GOALS = {"cartpole-goals": 2.0, "quadrotor-goals": 3.5}  # m, how far away goals lie


def problem(name: str) -> nocl.OCP:
    if name in GOALS:
        return nocl.load_ocp(name.removesuffix("-goals"), goals=GOALS[name])
    if name != "cartpole, wide box":
        return nocl.load_ocp(name)
    box = nocl.Uniform(lb=[-2, -3, -np.pi, -5], ub=[2, 3, np.pi, 5])
    return replace(nocl.load_ocp("cartpole"), initial_states=box)


def timed(run, repeat: int = 3, clock=time.perf_counter):
    """(result, least seconds)."""
    least = np.inf
    for _ in range(repeat):
        begin = clock()
        result = run()
        least = min(least, clock() - begin)
    return result, least


def speed(args: argparse.Namespace, name: str) -> dict:
    """Problems solved a second; warm: from the solution of a state nearby, as far as nmpc.py's."""
    ocp = problem(name)
    x0, rng = ocp.initial_states.sample(args.many, args.seed), np.random.default_rng(args.seed)
    near = x0 + others.KICK * x0.std(axis=0) * rng.standard_normal(x0.shape)
    rows: dict = {}
    for threads in dict.fromkeys((1, os.cpu_count() or 1)):
        ddp, built = timed(lambda t=threads: DDP(ocp, intervals=args.intervals, threads=t), 1)
        clock = time.process_time if threads == 1 else time.perf_counter
        cold, seconds = timed(lambda d=ddp: d.solve(x0), 3, clock)
        warm, quick = timed(lambda d=ddp, c=cold: d.solve(near, u=c.u, x=c.x, gain=c.gain), 5, clock)
        rows[f"DDP, {threads} threads"] = {
            "build s": built, "cold a second": len(x0) / seconds, "warm a second": len(x0) / quick,
            "cold solved": float(cold.success.mean()), "warm solved": float(warm.success.mean())}
    few = argparse.Namespace(states=args.states, intervals=args.intervals, seed=args.seed, timeout=200.0, acados=None,
                             tools=("nocl fatrop", "nocl fatrop compiled", "nocl ipopt", *others.OTHERS),
                             others=args.others)
    data = others.problem_data(name, few.states, few.intervals, few.seed)
    mine = solve_globally(DDP(ocp, intervals=args.intervals), data["x0"], progress=False)
    again = DDP(ocp, intervals=args.intervals).solve(data["warm"], u=mine.u, x=mine.x, gain=mine.gain)
    for tool, row in others.tools(few, name)["tools"].items():
        if "warm ms median" in row:
            rows[tool] = {f"{kind} a second": 1e3 / row[f"{kind} cpu ms median"] for kind in ("cold", "warm")} | {
                "share at best": row["share at best"], "solved": row["solved"]}
        elif "skipped" in row:
            rows[tool] = row
    best = max(row["warm a second"] for tool, row in rows.items() if tool.startswith("nocl") and "warm a second" in row)
    nlp = NMPC(ocp, args.intervals, constraints="soft").solve(data["warm"][:4], (again.x[:4], again.u[:4]))
    return {"rows": rows, "DDP's optimum over NMPC's from there, largest relative difference": float(
        np.abs(again.cost[:4] / nlp.cost - 1).max()),
        "warm over NMPC's best": {f"{t}": rows[t]["warm a second"] / best for t in rows if t.startswith("DDP")}}


def share(args: argparse.Namespace, name: str) -> dict:
    """How often solve_globally is within 0.1 % of the best that is known."""
    ocp = problem(name)
    x0, ddp = ocp.initial_states.sample(args.many, args.seed + 5), DDP(ocp, intervals=args.intervals)
    ours, seconds = timed(lambda: solve_globally(ddp, x0, seed=args.seed, progress=False), 1)
    cpu = time.process_time()
    reference = solve_globally(ddp, x0, starts=48, neighbours=6, rounds=12, seed=args.seed + 4711, progress=False)
    cpu = time.process_time() - cpu
    best = np.minimum(ours.cost, reference.cost)
    nlp = NMPC(ocp, args.intervals, constraints="soft").solve(x0[:args.states], workers=1, progress=False)
    best[:args.states] = np.minimum(best[:args.states], nlp.cost)
    within = ours.cost <= best + np.maximum(SAME * np.abs(best), 1e-10)
    again = reference.cost <= best + np.maximum(SAME * np.abs(best), 1e-10)
    beaten = nlp.cost < ours.cost[:args.states] - np.maximum(SAME * np.abs(nlp.cost), 1e-10)
    return {"states": args.many, "share at the best known": float(within.mean()), "solved": float(
        ours.success.mean()), "reference's share": float(again.mean()), "NMPC better, of": [
        int(beaten.sum()), args.states], "starts a state": float(ours.starts.mean()), "seconds": seconds,
        "reference's cpu seconds": cpu, "optima a state": float(np.mean([len(o) for o in ours.optima]))}


def learned(args: argparse.Namespace, name: str) -> dict:
    """What tails on a learned f cost beside the same ones on the exact f."""
    ocp, rng = problem(name), np.random.default_rng(args.seed)
    exact = DDP(ocp, intervals=args.intervals, threads=1)
    bank = SolutionBank.of(exact, solve_globally(exact, ocp.initial_states.sample(20, args.seed), progress=False))
    rows, at = tube_states(ocp, bank, TAILS, 0.2, rng)
    guess = bank.guess(rows, at.t)
    result = {}
    for what, model in (("exact", None), ("learned", nocl.identify(ocp.system, seed=args.seed, progress=False))):
        ddp, built = timed(lambda m=model: DDP(ocp, intervals=args.intervals, dynamics=m, threads=1), 1)
        found, seconds = timed(lambda d=ddp: d.solve(at.x, at.t, **guess), 9, time.process_time)
        result[what] = {"build s": built, "ms": 1e3 * seconds, "solved": float(found.success.mean()),
                        "iterations": float(found.iterations.mean()), "mean cost": float(found.cost.mean())}
    return result | {"tails": TAILS, "ratio": result["learned"]["ms"] / result["exact"]["ms"]}


def poles(n: int) -> nocl.OCP:
    """n cart-poles side by side, their carts joined by springs of 1 N/m."""
    one = nocl.load_ocp("cartpole")
    s, x, u = one.system, ca.SX.sym("x", 4 * n), ca.SX.sym("u", n)
    xdot, names = [], [f"{name}{i}" for i in range(n) for name in s.state_names]
    for i in range(n):
        f = s.f(x[4 * i:4 * i + 4], u[i])
        left, right = (x[4 * j] - x[4 * i] if 0 <= j < n else 0 for j in (i - 1, i + 1))
        f[1] += left + right
        xdot.append(f)
    x_, u_ = (ca.vertcat(*map(ca.SX.sym, some)) for some in (names, [f"u{i}" for i in range(n)]))
    xdot = ca.substitute(ca.vertcat(*xdot), ca.vertcat(x, u), ca.vertcat(x_, u_))
    chain = nocl.System("poles", x=x_, u=u_, xdot=xdot,
                        lbu=np.tile(s.lbu, n), ubu=np.tile(s.ubu, n), lbx=np.tile(s.lbx, n), ubx=np.tile(s.ubx, n))
    box = nocl.Uniform(lb=np.full(4 * n, -0.6), ub=np.full(4 * n, 0.6))
    return nocl.OCP.quadratic(chain, horizon=4.0, R=0.01, P=1.0, x_goal=np.zeros(4 * n), u_goal=np.zeros(n),
                              initial_states=box)


def child(kind: str, count: int, args: argparse.Namespace) -> None:
    """One size, in this process: JSON on stdout."""
    ocp, n = (nocl.load_ocp("cartpole"), count) if kind == "batch" else (poles(count), args.batch)
    begin = time.perf_counter()
    ddp = DDP(ocp, intervals=args.intervals)
    built = time.perf_counter() - begin
    x0, start = ocp.initial_states.sample(n, args.seed), {}
    if kind == "states":  # poles that hang over fall apart in open loop: from the goal held by feedback
        x, u = np.tile(ocp.x_goal, (1, args.intervals + 1, 1)), np.tile(ocp.u_goal, (1, args.intervals, 1))
        start = {k: np.repeat(v, n, axis=0) for k, v in {"x": x, "u": u, "gain": ddp.feedback(x, u)}.items()}
    Path("/proc/self/clear_refs").write_text("5")  # Linux: the peak from here on
    empty = memory()
    solution, seconds = timed(lambda: ddp.solve(x0, **start, progress=False), 3 if n <= 1000 else 1)
    print(json.dumps({"states": ocp.system.nx, "batch": n, "build s": built, "seconds": seconds, "ms each":
                      1e3 * seconds / n, "iterations": float(solution.iterations.mean()), "us each iteration":
                      1e6 * seconds / float(solution.iterations.sum()), "solved": float(solution.success.mean()),
                      "MB over the empty process": memory() - empty}))


def memory() -> float:
    """The most that this process has taken, MB."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmHWM")) / 1024


def sizes(args: argparse.Namespace, kind: str) -> None:
    rows: list[dict] = []
    for count in SIZES if kind == "batch" else POLES:
        command = [sys.executable, __file__, "--child", kind, str(count), "--intervals", str(args.intervals),
                   "--seed", str(args.seed), "--batch", str(args.batch)]
        run = subprocess.run(command, capture_output=True, text=True, check=False)
        rows.append(json.loads(run.stdout) if run.returncode == 0 else {"count": count, "failed": run.stderr[-400:]})
        print(f"  {rows[-1]}", flush=True)
        keep(kind, {"made": provenance.made(), "rows": rows})


def figure(result: dict) -> None:
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    _, axes = plt.subplots(1, 4, figsize=(13, 3.2), layout="constrained")
    plans = [("batch", "batch", "ms each"), ("batch", "batch", "MB over the empty process"),
             ("states", "states", "us each iteration"), ("states", "states", "build s")]
    for ax, (section, x, y) in zip(axes, plans, strict=True):
        rows = [row for row in result.get(section, {}).get("rows", []) if y in row]
        ax.loglog([row[x] for row in rows], [row[y] for row in rows], "o-", color="#0b5394")
        ax.set(xlabel="batch size (cart-pole)" if x == "batch" else "states n (cart-poles side by side)", ylabel=y)
        ax.grid(True, which="both", alpha=0.25)
    plt.savefig(FIGURE, dpi=110)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sections", nargs="+", default=list(SECTIONS), choices=SECTIONS)
    parser.add_argument("--problems", nargs="+", default=list(BUNDLED), choices=BUNDLED)
    parser.add_argument("--others", help="a Python that has do-mpc, rockit-meco and casadi")
    parser.add_argument("--states", type=int, default=10, help="that NMPC and the others solve")
    parser.add_argument("--many", type=int, default=1000, help="states that DDP solves")
    parser.add_argument("--batch", type=int, default=64, help="of the section states")
    parser.add_argument("--intervals", type=int, default=80)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--child", nargs=2, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.child:
        child(args.child[0], int(args.child[1]), args)
        return
    for section in args.sections:
        print(section, flush=True)
        if section in ("batch", "states"):
            sizes(args, section)
            continue
        for name in args.problems:
            if section == "share" or name in PROBLEMS:
                run = {"share": share, "speed": speed, "learned": learned}[section]
                row = {"made": provenance.made(), **run(args, name)}
                print(f"  {name}: {json.dumps(row, indent=1)}", flush=True)
                keep(section, {name: row})


def keep(section: str, found: dict) -> None:
    """Add to the results on disk, and draw the figure again."""
    path = provenance.RESULTS / "ddp.json"
    result = json.loads(path.read_text()) if path.exists() else {}
    result.setdefault(section, {}).update(found)
    store.write_text(path, json.dumps(result, indent=1) + "\n")
    figure(result)


if __name__ == "__main__":
    main()
