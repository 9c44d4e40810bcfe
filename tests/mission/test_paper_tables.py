"""`nocl reproduce TABLE --quick`: every table of the paper, with all of its rows, its numbers beside ours."""

from __future__ import annotations

import math

import pytest
from processes import nocl, table

SYSTEMS = ("dubins", "acrobot", "cartpole", "quadrotor")
SUPERVISED = [f"{kind}-{labels}" for kind in ("relu", "tanh", "sine", "mlp") for labels in ("values", "gradients")]
APPROACHES = ("double_integrator", "pendulum", "dubins", "cartpole", "acrobot", "quadrotor")
NOT_RUN = {"deep-pilco", "pets", "enode"}  # rivals of the paper's, beside nothing of ours yet
REFUSED = {"r0"}  # without a control cost nocl's default refuses, and says why
ROWS = {
    "sysid": [(system, way) for system in SYSTEMS for way in (*SUPERVISED, "nocl")],
    "gym": [(problem, way) for problem in ("acrobot", "cartpole") for way in ("cnd", "cnd-paper", "nmpc", *NOT_RUN)],
    "quadrotor": [("quadrotor", way) for way in ("cnd", "cnd-learned", "cnd-paper", "cnd-paper-learned", "r0-paper",
                                                 "r0", "nmpc", "lqr", "neural-oc")],
    "dubins": [("", way) for way in ("rrt-100", "rrt-200", "nmpc", "level-sets", "cnd-paper", "cnd", "cnd-learned",
                                     "optimum")],
    "approaches": [(problem, way) for problem in APPROACHES for way in ("level-sets", "nmpc", "cnd")],
}
MEASURED = {"sysid": "mean", "gym": "error", "quadrotor": "error", "dubins": "success"}


@pytest.mark.parametrize("name", ROWS)
def test_a_table_has_all_of_its_rows(name, tmp_path):
    nocl(f"reproduce {name} --quick --out made", tmp_path)
    rows = table(tmp_path / "made" / f"{name}.csv")
    found = {(r.get("system", r.get("problem", "")), r["way"]): r for r in rows}
    assert len(found) == len(rows)
    assert set(found) >= set(ROWS[name])
    if name in MEASURED:
        blank = {way for (_, way), r in found.items() if not math.isfinite(float(r[MEASURED[name]] or "nan"))}
        assert blank <= NOT_RUN | REFUSED
    written = {p.name for p in (tmp_path / "made").iterdir()}
    assert written >= {f"{name}.{form}" for form in ("md", "tex", "csv", "png")}
    published(name, found)


def published(name, found):
    """The paper's own numbers stand in its rows."""
    if name == "sysid":
        assert float(found["dubins", "sine-gradients"]["paper_mean"]) == 0.0008
        assert not found["dubins", "nocl"]["paper_mean"]
    elif name == "gym":
        assert float(found["acrobot", "cnd-paper"]["paper_error"]) == 1.071
        assert float(found["acrobot", "pets"]["paper_error"]) == 3.095
    elif name == "quadrotor":
        assert float(found["quadrotor", "cnd-paper"]["paper_error"]) == 0.0690
    elif name == "dubins":
        assert float(found["", "rrt-100"]["paper_success"]) == 0.889
