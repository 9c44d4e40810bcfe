"""users_view.py in a fresh process, L4CasADi and C included, and what its lines promise of what they make."""

from __future__ import annotations

import math
from pathlib import Path

from processes import python, run, table

VIEW = Path(__file__).parent / "users_view.py"

AFTER = f"""
import json, runpy
import numpy as np, torch
n = runpy.run_path({str(VIEW)!r})
nocl, x0, model = n["nocl"], n["x0"], n["model"]
cnd = nocl.CND.load("runs/pendulum")  # `cnd` itself names another one by now
tau = np.linspace(-5, 5, 8)[:, None]


def apart(a, b):
    return float(np.abs(np.asarray(a) - np.asarray(b)).max())


def rows(function, *columns):  # of a CasADi Function, on rows
    return function(*[np.asarray(c).T for c in columns]).full().T


s, t = n["solution"], np.zeros((8, 1))
print(json.dumps({{
    "shapes": [list(n[name].shape) for name in ("u", "V", "dVdx")],
    "one state": [list(cnd(x0[0], t=0.0).shape), list(np.shape(cnd.value(x0[0], t=0.0)))],
    "names": [[f.name(), f.name_in(), f.name_out()] for f in (n["policy"], n["V_fun"], n["f_theta"])],
    "reloaded": apart(cnd(x0, t=0.0), n["u"]),
    "policy": apart(rows(n["policy"], x0, t), n["u"]),
    "policy_l4c": apart(rows(n["policy_l4c"], x0, t), n["u"]),
    "V_fun": apart(rows(n["V_fun"], x0, t)[:, 0], n["V"]),
    "f_theta": apart(rows(n["f_theta"], x0, tau), model(torch.as_tensor(x0), torch.as_tensor(tau)).detach()),
    "f": model.score().mean,
    "solved": bool(s.success.all()),
    "solution": [list(a.shape) for a in (s.cost, s.x, s.u, s.costate)],
    "V": apart(n["V"] / s.cost, 1),
    "summary": [{{k: row[k] for k in ("method", "failures")}} for row in n["report"].summary()],
    "rows": len(n["report"].rows()),
    "gaps": np.percentile(n["report"].gap, [50, 95], axis=1).tolist(),
    "f_torch": apart(n["f_torch"](torch.ones(5, 4).double(), torch.ones(5, 1).double()),
                     rows(n["ocp"].system.f, np.ones((5, 4)), np.ones((5, 1)))),
}}))
"""


def test_the_lines_keep_what_they_promise(tmp_path):
    """One test, so that the lines run once, whatever processes tests are shared out to."""
    facts = python(AFTER, tmp_path)
    shapes_and_names_are_those_that_are_promised(facts)
    every_form_is_the_same_controller(facts)
    what_is_learned_is_near_optimal_on_the_exact_dynamics(facts)
    compare_has_a_row_per_method_and_state(facts, tmp_path)
    files_are_where_they_were_asked_for(tmp_path)
    the_c_code_compiles_without_a_warning_and_passes_its_self_tests(tmp_path)


def shapes_and_names_are_those_that_are_promised(facts):
    assert facts["shapes"] == [[8, 1], [8], [8, 2]]
    assert facts["one state"] == [[1], []]
    assert facts["names"] == [["policy", ["x", "t"], ["u"]], ["value", ["x", "t"], ["V"]], ["f", ["x", "u"], ["xdot"]]]
    assert facts["solution"] == [[8], [8, 81, 2], [8, 80, 1], [8, 81, 2]]


def every_form_is_the_same_controller(facts):
    assert facts["reloaded"] == 0
    assert max(facts[name] for name in ("policy", "V_fun", "f_theta", "f_torch")) < 1e-11
    assert facts["policy_l4c"] < 1e-4  # in float32, of controls up to 5


def what_is_learned_is_near_optimal_on_the_exact_dynamics(facts):
    assert facts["solved"]
    assert facts["f"] < 1e-3
    assert facts["V"] < 0.02
    (median, _), (p95, _) = facts["gaps"]  # per cent; of CND, of NMPC
    assert median < 1
    assert p95 < 5


def compare_has_a_row_per_method_and_state(facts, folder):
    assert [row["method"] for row in facts["summary"]] == ["CND", "NMPC"]
    assert facts["rows"] == 200
    rows = table(folder / "runs/pendulum/report/rows.csv")
    assert [(r["method"], r["state"]) for r in rows] == [(m, str(i)) for m in ("CND", "NMPC") for i in range(100)]
    assert all(math.isfinite(float(r["cost"])) and math.isfinite(float(r["gap"])) for r in rows)
    starts = [name for name in rows[0] if name.startswith("x0")]
    assert len(starts) == 2
    assert [[a[c] for c in starts] for a in rows[:100]] == [[b[c] for c in starts] for b in rows[100:]]


def files_are_where_they_were_asked_for(folder):
    assert {p.name for p in folder.iterdir()} == {"runs", "build"}
    assert (folder / "runs/pendulum/report/report.html").stat().st_size > 10_000


def the_c_code_compiles_without_a_warning_and_passes_its_self_tests(folder):
    said = run(["make", "check"], folder / "build/pendulum").splitlines()
    passed = {line.split(":")[0] for line in said if line.endswith(": ok")}
    assert passed == {f"pendulum_{name}" for name in ("policy", "gain", "value", "value_gradient")}
