"""do-mpc's side of benchmarks/approx_mpc.py, which calls it: python benchmarks/do_mpc_side.py FOLDER

FOLDER/task.json and the two functions beside it are the problem; FOLDER/law.json is what ApproxMPC has learned.
It needs do-mpc alone, not nocl: pip install "do-mpc[full]==5.1.2".
"""

from __future__ import annotations

import json
import pickle
import sys
import time
from importlib.metadata import version
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

try:
    import do_mpc
    import torch
    from do_mpc.approximateMPC import AMPCSampler, ApproxMPC, Trainer
except ImportError as error:
    sys.exit(f"do-mpc is missing here ({error}): pip install \"do-mpc[full]==5.1.2\" and name its Python by --python")

SAMPLING = 0.5  # of the minutes; the rest is training's
TRIED = 16  # solves that say how long one takes
EPOCHS_TRIED = 200  # that say how long one takes
STATES = ("x", "left", "paid")
PLATEAU = 0.05  # of the epochs, that the learning rate waits for; so its falls take up all of training


def controller(task: dict[str, Any], folder: Path) -> do_mpc.controller.MPC:
    """The whole rest of the horizon from any (x, time to go): the time is counted in shares of what is left."""
    rate, terminal = (ca.Function.load(str(folder / f"{name}.casadi")) for name in ("rate", "terminal"))
    model = do_mpc.model.Model("continuous", "SX")
    x, left, paid = (model.set_variable("_x", name, (n, 1)) for name, n in zip(STATES, (task["nx"], 1, 1), strict=True))
    u = model.set_variable("_u", "u", (task["nu"], 1))
    dx, L = rate(x, u)
    model.set_rhs("x", left * dx)
    model.set_rhs("left", ca.SX.zeros(1))
    model.set_rhs("paid", left * L)
    model.setup()
    mpc = do_mpc.controller.MPC(model)
    mpc.settings.n_horizon, mpc.settings.t_step = task["intervals"], 1 / task["intervals"]
    mpc.settings.supress_ipopt_output()
    mpc.settings.nlpsol_opts.update({"ipopt.max_iter": 100})
    mpc.settings.store_lagr_multiplier = False
    mpc.set_objective(mterm=(paid + terminal(x)) / task["usual cost"], lterm=ca.SX.zeros(1))
    bounded(mpc, task)
    mpc.setup()
    return mpc


def bounded(mpc: do_mpc.controller.MPC, task: dict[str, Any]) -> None:
    """Scales, the box of controls, and bounds of states along the way and, if there are more, at the end."""
    for kind, name, size in (("_x", "x", task["size"]), ("_x", "left", task["T"]), ("_x", "paid", task["usual cost"]),
                             ("_u", "u", task["size of u"])):
        mpc.scaling[kind, name] = np.array(size)
    for side, name in (("lower", "low"), ("upper", "high")):
        mpc.bounds[side, "_u", "u"] = np.array(task[f"{name} u"])
        mpc.bounds[side, "_x", "x"] = np.array(task[f"{name} x"])
        mpc.terminal_bounds[side, "x"] = np.array(task[f"{name} end"])


def box(task: dict[str, Any]) -> tuple[np.ndarray, np.ndarray]:
    """Of (x, time to go, paid) [n, 1]; nothing is paid at first."""
    low, high = ([*task[side], share * task["T"], 0.0] for side, share in (("low", task["least"]), ("high", 1.0)))
    return np.array(low)[:, None], np.array(high)[:, None]


def sample(mpc: do_mpc.controller.MPC, task: dict[str, Any], folder: Path, name: str, n: int) -> int:
    """n solves by AMPCSampler, of states of the box, or of those given; how many were solved."""
    sampler = AMPCSampler(mpc)
    of = sampler.settings
    of.n_samples, of.dataset_name, of.data_dir = n, name, str(folder)
    of.lbx, of.ubx = box(task)
    of.lbu, of.ubu = (np.array(task[f"{side} u"])[:, None] for side in ("low", "high"))
    sampler.setup()
    sampler.approx_mpc_sampling_plan_box()
    if task["way"] == "tube":
        about(folder / name / f"sampling_plan_{name}.pkl", np.array(task["tube"]))
    sampler.approx_mpc_open_loop_sampling()
    return len(pickle.loads((folder / name / f"data_{name}_opt.pkl").read_bytes()))


def about(plan: Path, tube: np.ndarray) -> None:
    """Put states (x, time to go) of the tube, drawn at random, into a plan that AMPCSampler has written."""
    rows = pickle.loads(plan.read_bytes())
    for row in rows:
        row["x0"] = np.r_[tube[np.random.randint(len(tube))], 0.0][:, None]
    plan.write_bytes(pickle.dumps(rows))


def network(mpc: do_mpc.controller.MPC, task: dict[str, Any]) -> ApproxMPC:
    """Of default size, scaled by the box; what is paid, always nothing, by one."""
    law = ApproxMPC(mpc)
    low, high = box(task)
    high[-1] = 1.0
    law.settings.lbx, law.settings.ubx = torch.tensor(low), torch.tensor(high)
    law.settings.device = "cpu"
    law.setup()
    return law


def fit(law: ApproxMPC, folder: Path, name: str, epochs: int) -> Trainer:
    trainer = Trainer(law)
    of = trainer.settings
    of.dataset_name, of.data_dir, of.results_dir, of.n_epochs = name, str(folder), str(folder), epochs
    of.scheduler_flag, of.print_frequency = True, max(epochs // 20, 1)
    trainer.scheduler_settings.cooldown, trainer.scheduler_settings.patience = 0, max(int(PLATEAU * epochs), 10)
    trainer.setup()
    trainer.default_training()
    return trainer


def learned(task: dict[str, Any], folder: Path) -> dict[str, Any]:
    """The law, and what it was learned from, within the minutes of CPU of the task."""
    np.random.seed(task["seed"])
    torch.manual_seed(task["seed"])
    begin, seconds = time.process_time(), 60 * task["minutes"]
    mpc = controller(task, folder)
    law = network(mpc, task)
    start = time.process_time()
    sample(mpc, task, folder, "tried", TRIED)
    each = (time.process_time() - start) / TRIED
    n = max(int((SAMPLING * seconds - (time.process_time() - begin)) / each), 2 * TRIED)
    solved = sample(mpc, task, folder, "samples", n)
    fit(law, folder, "samples", EPOCHS_TRIED // 10)  # the first takes longer than others
    start = time.process_time()
    fit(law, folder, "samples", EPOCHS_TRIED)
    each = (time.process_time() - start) / EPOCHS_TRIED
    trainer = fit(law, folder, "samples", max(int((seconds - (time.process_time() - begin)) / each), EPOCHS_TRIED))
    history = trainer.history
    return {"cpu minutes": (time.process_time() - begin) / 60, "samples": n,
            "solved": solved, "epochs": len(history["epoch"]), "loss": history["train_loss"][-1],
            "validation loss": history["val_loss"][-1], "law": weights(law),
            "versions": {name: version(name) for name in ("do-mpc", "casadi", "torch", "numpy")},
            "check": checked(law, task)}


def weights(law: ApproxMPC) -> dict[str, Any]:
    layers = [layer for layer in law.net.layers if isinstance(layer, torch.nn.Linear)]
    return {"W": [layer.weight.tolist() for layer in layers], "b": [layer.bias.tolist() for layer in layers],
            **{name: getattr(law, name).flatten().tolist() for name in ("x_shift", "x_range", "y_shift", "y_range")}}


def checked(law: ApproxMPC, task: dict[str, Any]) -> list[Any]:
    """[z, u] as its own make_step has it, to check the law by."""
    low, high = box(task)
    z = low + 0.3 * (high - low)
    return [z.ravel().tolist(), law.make_step(z).ravel().tolist()]


def main() -> None:
    folder = Path(sys.argv[1])
    task = json.loads((folder / "task.json").read_text())
    (folder / "law.json").write_text(json.dumps(learned(task, folder)))


if __name__ == "__main__":
    main()
