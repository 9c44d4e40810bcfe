"""System identification, measured: training speed, errors against the number of labels, Table I kept.

    python benchmarks/sysid.py speed      # samples per second beside plain PyTorch -> results/sysid_speed.json
    python benchmarks/sysid.py samples    # error by labels -> results/sysid_samples.json, docs/sysid_samples.png
    python benchmarks/sysid.py drawn      # the same of labels that nocl draws itself, kept beside them
    python benchmarks/sysid.py table RUN  # the cells of `nocl reproduce sysid --out RUN` -> results/sysid.json
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict
from itertools import pairwise, product
from pathlib import Path
from typing import Any

import numpy as np
import provenance
import torch
from torch import Tensor

from nocl.comparisons.reproduce import sysid
from nocl.data import Dataset
from nocl.nets import MLP
from nocl.support import store
from nocl.sysid.identification import LearnedDynamics, Settings, identify
from nocl.sysid.loss import Loss
from nocl.systems import load_ocp

BATCH, WIDTH, ROWS = 1024, 64, 100_000
DOCS = Path(__file__).resolve().parents[1] / "docs"
LABELS = (100, 300, 1000, 10_000, 1_000_000)
DRAWN = (10, 200_000, 1_000_000)  # labels for the networks, at least 2,048 rows; those of the structure come beside
# the same at every number of labels, with and without gradients
BUDGETS = {"default": Settings(width=32, iterations=3000, batch=512, polish=100, polish_batch=512),
           "mlp": Settings(width=64, iterations=4000, batch=512, polish=0)}
WAYS = {"default": ("default", True), "default-values": ("default", False), "mlp": ("mlp", True),
        "mlp-values": ("mlp", False)}  # method, with Jacobians

Step = Callable[[], None]


def speed(rounds: int, steps: int) -> None:
    """One training step, all with Adam and one thread: interleaved, the median over rounds."""
    torch.set_num_threads(1)
    rows = []
    for name in sysid.SYSTEMS:
        steppers = dict(contestants(name))
        for step in steppers.values():
            step()
        seconds: dict[str, list[float]] = {key: [] for key in steppers}
        for _ in range(rounds):
            for key, step in steppers.items():
                start = time.process_time()  # of one thread: other users of the machine do not count
                for _ in range(steps):
                    step()
                seconds[key].append((time.process_time() - start) / steps)
        per_second = {key: round(BATCH / float(np.median(s))) for key, s in seconds.items()}
        best = max(per_second["eager, vmap(jacrev)"], per_second["eager, autograd.grad a row"])
        rows.append({"system": name, "samples_per_second": per_second, "times": round(per_second["nocl"] / best, 2)})
        print(rows[-1], flush=True)
    provenance.write("sysid_speed", rows, batch=BATCH, width=WIDTH, rounds=rounds, steps=steps, threads=1,
                     clock="CPU time", loss="|f_theta - f| + |grad f_theta - grad f|, full Jacobian, sine, 3 layers")


def contestants(name: str) -> Iterator[tuple[str, Step]]:
    """Training steps on the same labels: ours, and eager PyTorch in the two ways that people write."""
    data = Dataset.sample(load_ocp(name).system, ROWS, 0)
    assert data.A is not None
    assert data.B is not None
    arrays = (np.hstack([data.x, data.u]), data.xdot, np.concatenate([data.A, data.B], axis=2))
    z, f, jacobian = (torch.from_numpy(a).float() for a in arrays)
    sizes = [z.shape[1], WIDTH, WIDTH, f.shape[1]]
    theta = torch.nn.utils.parameters_to_vector(MLP(sizes, "sine").parameters()).detach()
    loss = Loss(sizes, "sine", z, f, jacobian, compiled=True)
    theta.grad = torch.zeros_like(theta)
    optimizer = torch.optim.Adam([theta], lr=1e-3, fused=True)

    def ours() -> None:
        assert theta.grad is not None
        loss(torch.randint(ROWS, (BATCH,)), theta, theta.grad)
        optimizer.step()

    yield "nocl", ours
    for title, jacobian_of in (("eager, vmap(jacrev)", _vmap), ("eager, autograd.grad a row", _loop)):
        yield title, _eager(MLP(sizes, "sine"), jacobian_of, z, f, jacobian)


def _eager(mlp: MLP, jacobian_of: Callable[[MLP, Tensor], tuple[Tensor, Tensor]], z: Tensor, f: Tensor,
           jacobian: Tensor) -> Step:
    optimizer = torch.optim.Adam(mlp.parameters(), lr=1e-3)

    def step() -> None:
        rows = torch.randint(ROWS, (BATCH,))
        value, slope = jacobian_of(mlp, z[rows])
        loss = (value - f[rows]).norm(dim=1).mean() + (slope - jacobian[rows]).flatten(1).norm(dim=1).mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()

    return step


def _vmap(mlp: MLP, z: Tensor) -> tuple[Tensor, Tensor]:
    return mlp(z), torch.func.vmap(torch.func.jacrev(mlp))(z)


def _loop(mlp: MLP, z: Tensor) -> tuple[Tensor, Tensor]:
    z = z.requires_grad_()
    y = mlp(z)
    rows = [torch.autograd.grad(y[:, i].sum(), z, create_graph=True)[0] for i in range(y.shape[1])]
    return y, torch.stack(rows, 1)


def samples(systems: list[str], labels: list[int], ways: list[str]) -> None:
    """Mean error of nocl's recipe and of the plain network, with and without Jacobian labels, on the same rows."""
    anew = list(product(systems, labels, (WAYS[way] for way in ways)))
    rows = [r for r in kept_samples() if (r["system"], r["labels"], (r["method"], r["gradients"])) not in anew]
    for name, n in product(systems, labels):
        system = load_ocp(name).system
        data = Dataset.sample(system, n, 7)
        for method, gradients in (WAYS[way] for way in ways):
            model = identify(system, data=data, method=method, gradients=gradients, settings=BUDGETS[method],
                             progress=False)
            rows.append(errors(model, n, method, gradients))
        keep_samples(rows)


def drawn(systems: list[str]) -> None:
    """Mean error of nocl's recipe where it draws the labels itself, with its own budgets: it picks where f is asked."""
    rows = [r for r in kept_samples() if r["method"] != "drawn" or r["system"] not in systems]
    for name, samples in product(systems, DRAWN):
        model = identify(load_ocp(name).system, settings=Settings(samples=samples), progress=False)
        labels = model.card["labels"]  # of a closed form always the same
        rows = [r for r in rows if (r["system"], r["method"], r["labels"]) != (name, "drawn", labels)]
        rows.append(errors(model, labels, "drawn", True))
        keep_samples(rows)


def kept_samples() -> list[dict[str, Any]]:
    path = provenance.RESULTS / "sysid_samples.json"
    return store.read_json(path)["rows"] if path.exists() else []


def errors(model: LearnedDynamics, labels: int, method: str, gradients: bool) -> dict[str, Any]:
    score = model.score(5000)
    row = {"system": model.system.name, "labels": labels, "method": method, "gradients": gradients, "mean": score.mean,
           "median": score.median, "jacobian": score.jacobian, "seconds": model.card["seconds"]}
    print(row, flush=True)
    return row


def keep_samples(rows: list[dict[str, Any]]) -> None:
    """All rows so far, what Jacobians save, and the figure."""
    rows.sort(key=lambda r: (r["system"], r["labels"]))
    savings = [s for pair in sorted({(r["system"], r["method"]) for r in rows}) for s in saved(rows, *pair)]
    provenance.write("sysid_samples", rows, savings=savings, settings={k: asdict(s) for k, s in BUDGETS.items()})
    draw(rows, DOCS / "sysid_samples.png")


def saved(rows: list[dict[str, Any]], system: str, method: str) -> list[dict[str, Any]]:
    """For each number of labels with Jacobians, how many without reach the same error, in multiples of it.

    Log-interpolated between measured numbers of labels; `at_least` where the most that were tried do not reach it.
    Labels that nocl draws are compared with its recipe's on given rows.
    """
    with_, without = ([(r["labels"], r["mean"]) for r in rows if (r["system"], r["method"], r["gradients"]) ==
                       (system, name, gradients)] for name, gradients in
                      ((method, True), ("default" if method == "drawn" else method, False)))
    return [{"system": system, "method": method, "labels": n, "mean": error, "at_least": needed is None,
             "times": round((needed or without[-1][0]) / n, 2)}
            for n, error in with_ if without for needed in [_needed(without, error)]]


def _needed(curve: list[tuple[int, float]], error: float) -> float | None:
    """The first number of labels at which a curve of (labels, error) comes down to an error."""
    if curve[0][1] <= error:
        return curve[0][0]
    for (n, above), (m, below) in pairwise(curve):
        if below <= error:
            return float(n * (m / n) ** (np.log(above / error) / np.log(above / below)))
    return None


def draw(rows: list[dict[str, Any]], path: Path) -> None:
    """Mean error against labels, a panel for each system: filled with Jacobians, open without."""
    import matplotlib
    from matplotlib.figure import Figure

    from nocl.comparisons.report.style import COLOURS, STYLE, encode

    systems = list(dict.fromkeys(r["system"] for r in rows))
    with matplotlib.rc_context(STYLE):
        drawing = Figure(figsize=(4 * len(systems), 3.2), layout="constrained")
        panels = drawing.subplots(1, len(systems), squeeze=False)[0]
        for system, axes in zip(systems, panels, strict=True):
            for colour, method, title in ((COLOURS[0], "default", "structure first"), (COLOURS[1], "mlp", "plain")):
                for gradients in (True, False):
                    own = [r for r in rows if (r["system"], r["method"], r["gradients"]) == (system, method, gradients)]
                    axes.plot([r["labels"] for r in own], [r["mean"] for r in own], "o-" if gradients else "s--",
                              color=colour, ms=4, mfc=colour if gradients else "none",
                              label=f"{title}, {'with' if gradients else 'without'} Jacobians")
            own = [r for r in rows if (r["system"], r["method"]) == (system, "drawn")]
            axes.plot([r["labels"] for r in own], [r["mean"] for r in own], "*", color=COLOURS[0], ms=9,
                      label="structure first, labels drawn by nocl")
            axes.set(xscale="log", yscale="log", title=system, xlabel="labelled samples",
                     ylabel="mean of ||f_theta - f||")
        panels[0].legend(fontsize=7)
        store.write_bytes(path, encode(drawing, "png"))


def table(run: Path) -> None:
    """Finished cells, with what they were made with."""
    provenance.write("sysid", [asdict(cell) for cell in sysid.TABLE.finished(run)], held_out=sysid.HELD_OUT)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    commands = parser.add_subparsers(dest="command", required=True)
    one = commands.add_parser("speed")
    one.add_argument("--rounds", type=int, default=15)
    one.add_argument("--steps", type=int, default=10)
    one = commands.add_parser("samples")
    one.add_argument("--systems", nargs="+", default=["cartpole", "acrobot"])
    one.add_argument("--labels", nargs="+", type=int, default=LABELS)
    one.add_argument("--ways", nargs="+", choices=WAYS, default=list(WAYS))
    one = commands.add_parser("drawn")
    one.add_argument("--systems", nargs="+", default=list(sysid.SYSTEMS))
    commands.add_parser("table").add_argument("run", type=Path)
    args = parser.parse_args()
    if args.command == "speed":
        speed(args.rounds, args.steps)
    elif args.command == "samples":
        samples(args.systems, args.labels, args.ways)
    elif args.command == "drawn":
        drawn(args.systems)
    else:
        table(args.run)


if __name__ == "__main__":
    main()
