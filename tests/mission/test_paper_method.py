"""method="paper" with its four losses, and the identification of Table I from exact Jacobians, in fresh processes."""

from __future__ import annotations

import math

import pytest
from processes import python

TERMS = ["cost", "hjb", "final", "hamil"]

TRAIN = """
import json, numpy as np, nocl
from nocl.solvers.cnd.settings import PaperSettings
ocp = nocl.load_ocp("pendulum")
cnd = nocl.train(ocp, method="paper", seed=0, settings=PaperSettings(iterations=400), progress=False)
x0 = ocp.initial_states.sample(20, seed=1)
idle = nocl.simulate(ocp, np.zeros((20, 80, 1)), x0).cost
run = nocl.simulate(ocp, cnd, x0)
print(json.dumps({"weights": cnd.card["settings"]["weights"], "history": cnd.card["history"],
                  "cost": run.cost.tolist(), "idle": idle.tolist(), "success": bool(run.success.all())}))
"""

IDENTIFY = """
import json, numpy as np, nocl
from nocl.sysid import PaperSettings
system = nocl.load_ocp({name!r}).system
scores = {{}}
for gradients in (False, True):
    settings = PaperSettings(iterations=1500, samples=20_000)
    model = nocl.identify(system, method="paper", gradients=gradients, seed=0, settings=settings, progress=False)
    scores[gradients] = model.score().jacobian
labels = nocl.Dataset.sample(system, 50, seed=3)
step, worst = 1e-6, 0.0
for M, columns, at in ((labels.A, system.nx, 0), (labels.B, system.nu, 1)):
    for i in range(columns):
        z = [labels.x.T.copy(), labels.u.T.copy()]
        z[at][i] += step
        ahead = system.f(*z).full().T
        z[at][i] -= 2 * step
        central = (ahead - system.f(*z).full().T) / (2 * step)
        worst = max(worst, float(np.abs(M[:, :, i] - central).max() / np.abs(M).max()))
print(json.dumps({{"values": scores[False], "gradients": scores[True], "labels": worst}}))
"""


def test_the_papers_method_trains_on_its_four_losses(tmp_path):
    made = python(TRAIN, tmp_path)
    assert made["weights"] == [1.0, 1.0, 0.01, 0.01]
    assert list(made["history"]) == TERMS
    for name in TERMS:
        values = made["history"][name]
        assert len(values) == 400
        assert all(math.isfinite(v) and v > 0 for v in values)
    first, last = (sum(made["history"]["cost"][part]) for part in (slice(20), slice(-20, None)))
    assert last < first
    assert made["success"]
    assert sum(made["cost"]) < 0.5 * sum(made["idle"])


@pytest.mark.parametrize("name", ["dubins", "acrobot", "cartpole", "quadrotor"])
def test_exact_jacobians_teach_the_jacobian(name, tmp_path):
    """Of Table I's sine networks the one that saw derivatives has the better ones; the labels are derivatives of f."""
    made = python(IDENTIFY.format(name=name), tmp_path)
    assert made["labels"] < 1e-6
    assert made["gradients"] < made["values"]
