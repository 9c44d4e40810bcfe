"""The certificate tells what differs and where; an export that is not the trained one leaves nothing behind."""

from __future__ import annotations

import copy
import dataclasses
import importlib.util
import json
import re
import subprocess
import sys

import casadi as ca
import numpy as np
import pytest
import torch
from test_export import STATES, TIMES, untrained

import nocl
from nocl.cli import main
from nocl.exports import parity
from nocl.exports.bundle import export
from nocl.exports.c_code import load

CONTROLLER = untrained()


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    folder = tmp_path_factory.mktemp("export") / "run"
    return folder, export(CONTROLLER, folder, ("casadi", "c"), against=())


def test_the_certificate_covers_every_part_backend_and_derivative(exported):
    folder, certificate = exported
    assert certificate.ok
    found = {(f.part, f.backend, f.dtype, f.of) for f in certificate.findings}
    for part in ("policy", "gain", "closed_loop", "value", "value_gradient"):
        assert (part, "native CasADi", "float64", "first derivatives") in found
        assert {(part, "C", "float64", "value"), (part, "C", "float32", "value")} <= found
    for part in ("policy", "value"):
        assert (part, "C", "float64", "first derivatives") in found
    written = json.loads((folder / "parity.json").read_text())
    assert written["ok"] is True
    assert written["summary"] == str(certificate)
    assert len(written["findings"]) == len(certificate.findings)
    assert set(written["findings"][0]["at"]) == {"x", "t"}
    assert "parity ok: policy, gain" in str(certificate)
    assert "\n" not in str(certificate)


def test_the_files_are_the_controller(exported):
    folder, _ = exported
    assert sorted(p.name for p in folder.iterdir()) == [
        "c", "c_float32", "closed_loop.casadi", "gain.casadi", "parity.json", "policy.casadi", "value.casadi",
        "value_gradient.casadi"]
    assert [p.name for p in folder.parent.iterdir()] == ["run"]
    policy = ca.Function.load(str(folder / "policy.casadi"))
    np.testing.assert_allclose(policy.map(7)(STATES.T, TIMES[None]).full().T, CONTROLLER(STATES, TIMES), atol=1e-12)
    for name, tolerance in (("c", 1e-12), ("c_float32", 1e-5)):
        law = load(folder / name, "cartpole_policy")
        np.testing.assert_allclose(law(STATES, TIMES), CONTROLLER(STATES, TIMES), atol=tolerance)
        np.testing.assert_allclose(law(STATES[0], TIMES[0]), CONTROLLER(STATES[0], TIMES[0]), atol=tolerance)
        costate = load(folder / name, "cartpole_value_gradient")
        expected = CONTROLLER.value_gradient(STATES, TIMES)
        np.testing.assert_allclose(costate(STATES, TIMES), expected, rtol=tolerance, atol=tolerance * 100)
        gain = load(folder / name, "cartpole_gain")(STATES[0], TIMES[0])
        exact = CONTROLLER.gain_to_casadi()(STATES[0], TIMES[0]).full()[0]
        np.testing.assert_allclose(gain, exact, rtol=tolerance, atol=tolerance)
    text = (folder / "c" / "README.md").read_text()
    assert all(f"`cartpole_{p}.h`" in text for p in ("policy", "gain", "value", "value_gradient"))


class Off:
    """A controller whose export is off: its torch is not what its CasADi Function is."""

    def __init__(self, shift: float, only: str) -> None:
        self.shift, self.only, self.ocp = shift, only, CONTROLLER.ocp

    def export_parts(self) -> list[parity.ExportPart]:
        return [dataclasses.replace(p, torch=lambda x, t, p=p: p.torch(x, t) + self.shift * x[:, :1] ** 2)
                if p.name == self.only else p for p in CONTROLLER.export_parts()]


@pytest.mark.parametrize("only", ["policy", "value_gradient"])
def test_an_export_that_differs_fails_and_leaves_nothing(tmp_path, only):
    with pytest.raises(ValueError, match=rf"{only}: native CasADi \(float64\) differs from torch .* at .*'x'.*nothing"):
        export(Off(1e-9, only), tmp_path / "run", ("casadi",), against=())
    assert not list(tmp_path.iterdir())


def test_a_failed_export_leaves_a_former_one_as_it_was(exported, tmp_path):
    folder = tmp_path / "run"
    export(CONTROLLER, folder, ("casadi",), against=())
    before = {p.name: p.read_bytes() for p in folder.iterdir()}
    with pytest.raises(ValueError, match="nothing was written"):
        export(Off(1e-3, "policy"), folder, ("casadi", "c"), against=())
    assert {p.name: p.read_bytes() for p in folder.iterdir()} == before


def without_single(monkeypatch):
    """No float32 form is good enough."""
    monkeypatch.setitem(parity.LIMITS, "float32", 1e-14)


def test_a_form_that_differs_is_left_out_and_explained_and_the_others_are_written(exported, tmp_path, monkeypatch):
    folder = tmp_path / "run"
    export(CONTROLLER, folder, ("casadi", "c"), against=())
    assert (folder / "c_float32" / "cartpole_policy.h").exists()
    without_single(monkeypatch)
    certificate = export(CONTROLLER, folder, ("casadi", "c"), against=())
    assert not certificate.ok
    assert list(certificate.refused) == ["c_float32"]
    assert re.match(r"policy: C \(float32\) differs from torch .* limit 1e-14, at", certificate.refused["c_float32"])
    assert "parity in part" in str(certificate)
    assert "NOT written: c_float32 (policy: C (float32) differs" in str(certificate)
    assert all(f.ok for f in certificate.findings)
    assert {f.dtype for f in certificate.findings} == {"float64"}
    assert not list((folder / "c_float32").glob("cartpole_*"))  # nor a former one kept beside another's certificate
    law = load(folder / "c", "cartpole_policy")
    np.testing.assert_allclose(law(STATES, TIMES), CONTROLLER(STATES, TIMES), atol=1e-12)
    assert json.loads((folder / "parity.json").read_text())["refused"] == dict(certificate.refused)


def test_strict_is_all_or_nothing(tmp_path, monkeypatch):
    without_single(monkeypatch)
    with pytest.raises(ValueError, match=r"C \(float32\) differs .*nothing was written"):
        export(CONTROLLER, tmp_path / "run", ("casadi", "c"), against=(), strict=True)
    assert not list(tmp_path.iterdir())


def test_the_command_line_goes_on_without_a_form_unless_it_is_strict(tmp_path, monkeypatch, capsys):
    without_single(monkeypatch)
    CONTROLLER.save(tmp_path / "cnd")
    command = ["export", str(tmp_path), "--to", "c", "--against", "c"]
    assert main([*command, "--strict"]) != 0
    assert not (tmp_path / "export").exists()
    assert main(command) == 0
    assert "NOT written: c_float32" in capsys.readouterr().out
    assert (tmp_path / "export" / "c" / "cartpole_policy.h").exists()


@pytest.mark.parametrize("unit", [1e-6, 1e6])
def test_limits_do_not_depend_on_units(unit):
    """The same law of a state in other units, whose answer is in other units: the same errors, in values and slopes."""
    def part(size: float) -> parity.ExportPart:
        x = ca.MX.sym("x", 2)
        law = ca.Function("law", [x], [size * ca.vertcat(ca.sin(x[0] / size), x[1] * x[0] / size**2)], ["x"], ["u"])

        def rows(x: torch.Tensor) -> torch.Tensor:
            u = torch.sin(x[:, :1] / size), x[:, 1:] * x[:, :1] / size**2
            return size * torch.cat(u, dim=1) * (1 + 1e-9)
        return parity.ExportPart("law", law, rows, {"x": ([-2 * size, -size], [2 * size, size])})

    errors = [[f.error for f in parity.findings(one, "native", "float64", parity.samples(one),
                                                *parity.of_casadi(one.column))] for one in (part(1.0), part(unit))]
    np.testing.assert_allclose(errors[1], errors[0], rtol=1e-3)
    assert min(errors[0]) > 1e-10


def test_nan_is_no_parity():
    part = CONTROLLER.export_parts()[0]
    z = parity.samples(part)
    found = parity.findings(part, "broken", "float32", z, lambda z: np.full((len(z), 1), np.nan))
    assert not found[0].ok


def test_samples_hold_the_corners_of_the_box():
    part = CONTROLLER.export_parts()[0]
    z = parity.samples(part, n=10)
    s = CONTROLLER.ocp.system
    lower, upper = np.r_[s.lbx, 0], np.r_[s.ubx, 4]
    corner = ((z == lower) | (z == upper)).all(axis=1)
    assert corner.sum() == 32
    assert len(z) == 42
    assert ((z >= lower) & (z <= upper)).all()
    np.testing.assert_array_equal(z, z.astype(np.float32))


@pytest.mark.parametrize(("thing", "to", "message"), [
    (CONTROLLER, ("fortran",), "expected 'casadi', 'l4casadi', 'onnx' or 'c'"),
    (3, ("casadi",), "got a int; expected a CND, LearnedDynamics or a list"),
])
def test_refusals(tmp_path, thing, to, message):
    with pytest.raises(ValueError, match=message):
        export(thing, tmp_path / "run", to)
    assert not list(tmp_path.iterdir())


def test_the_controller_is_not_changed(tmp_path):
    controller = copy.deepcopy(CONTROLLER)
    before = {k: v.clone() for k, v in controller.policy.state_dict().items()}
    controller.export(tmp_path / "run", against=())
    assert all(v.equal(before[k]) for k, v in controller.policy.state_dict().items())


def test_what_load_refuses(exported, tmp_path):
    folder, _ = exported
    with pytest.raises(ValueError, match=r"holds cartpole_closed_loop, .*name one of them"):
        load(folder / "c")
    with pytest.raises(ValueError, match="no function of to_c"):
        load(tmp_path)
    law = load(folder / "c", "cartpole_policy")
    with pytest.raises(ValueError, match=r"shape \(3,\); expected \[4\]"):
        law(np.zeros(3), 0.0)
    with pytest.raises(ValueError, match="got 1 arguments; expected 2: x, t"):
        law(np.zeros(4))


def test_learned_dynamics_leave_too(tmp_path):
    ocp = nocl.load_ocp("double_integrator")
    model = nocl.identify(ocp.system, seed=0, progress=False)
    certificate = export(model, tmp_path / "run", ("casadi", "c"), against=())
    assert {f.part for f in certificate.findings} == {"dynamics"}
    f, z = load(tmp_path / "run" / "c"), np.array([[0.3, -0.4]])
    np.testing.assert_allclose(f(z, [[0.5]]), model.to_casadi()(z[0], 0.5).full().T, rtol=1e-12, atol=1e-14)
    assert ca.Function.load(str(tmp_path / "run" / "dynamics.casadi")).name_in() == ["x", "u"]


@pytest.mark.slow
@pytest.mark.skipif(importlib.util.find_spec("l4casadi") is None, reason="l4casadi is not installed")
def test_l4casadi_files_work_in_another_process_and_a_failure_leaves_none(tmp_path, monkeypatch):
    folder = tmp_path / "run"
    export(CONTROLLER, folder, ("l4casadi",), against=())
    command = (f"import casadi, l4casadi; f = casadi.Function.load({str(folder / 'l4casadi' / 'policy.casadi')!r}); "
               f"print(float(f({STATES[0].tolist()}, {TIMES[0]})))")
    out = subprocess.run([sys.executable, "-c", command], capture_output=True, text=True, check=True, cwd=tmp_path)
    assert float(out.stdout) == pytest.approx(CONTROLLER(STATES[0], TIMES[0])[0], abs=1e-5)
    before = sorted(folder.rglob("*"))
    monkeypatch.setitem(parity.LIMITS, "float32", 1e-12)  # passed once the library is built
    with pytest.raises(ValueError, match=r"L4CasADi \(float32\).*nothing was written"):
        export(CONTROLLER, folder, ("l4casadi",), against=())
    assert sorted(folder.rglob("*")) == before
