"""Exports of a controller u(x, t, p) and a value V(x, t, p): one function in every form, proven on drawn p."""

from __future__ import annotations

import json
import shutil
import subprocess
from importlib.util import find_spec

import casadi as ca
import numpy as np
import pytest
import torch
from movers import law_of_mass

import nocl
from nocl.exports.c_code import load
from nocl.exports.onnx_writer import Session

RNG = np.random.default_rng(0)
X, T = RNG.uniform(-1, 1, (9, 2)), RNG.uniform(0, 2, 9)
P = RNG.uniform([0.8, -1], [1.2, 1], (9, 2))  # (mass, goal)


@pytest.fixture(scope="module")
def law() -> nocl.CND:
    return law_of_mass()


@pytest.fixture(scope="module")
def exported(law, tmp_path_factory):
    folder = tmp_path_factory.mktemp("export") / "mover"
    forms = [form for form, package in (("casadi", "casadi"), ("onnx", "onnxruntime")) if find_spec(package)]
    return folder, law.export(folder, [*forms, "c"], against=[*forms, "c"])


def test_the_certificate_is_about_p(law, exported):
    folder, certificate = exported
    assert certificate.ok
    assert {f.part for f in certificate.findings} == {"policy", "gain", "closed_loop", "value", "value_gradient"}
    low, high = law.ocp.parameter_box
    for finding in certificate.findings:
        assert set(finding.at) == {"x", "t", "p"}
        assert ((low <= finding.at["p"]) & (finding.at["p"] <= high)).all()
    assert len({tuple(f.at["p"]) for f in certificate.findings}) > 1  # p is drawn, too
    kept = json.loads((folder / "parity.json").read_text())
    assert all(set(row["at"]) == {"x", "t", "p"} for row in kept["findings"])
    assert kept["inputs"] == {"x": ["pos", "v"], "p": ["mass [kg]", "goal [m]"]}


def test_casadi_and_c_are_torch(law, exported):
    folder, _ = exported
    expected = {"policy": law(X, T, P), "value": law.value(X, T, P)[:, None],
                "value_gradient": law.value_gradient(X, T, P)}
    for name, values in expected.items():
        f = ca.Function.load(str(folder / f"{name}.casadi"))
        assert f.name_in() == ["x", "t", "p"]
        np.testing.assert_allclose(f(X.T, T[None], P.T).full().T, values, rtol=1e-12, atol=1e-12)
        compiled = load(folder / "c", f"mover_{name}")
        assert compiled.inputs == {"x": 2, "t": 1, "p": 2}
        np.testing.assert_allclose(compiled(X, T, P), values, rtol=1e-12, atol=1e-12)
        single = load(folder / "c_float32", f"mover_{name}")
        np.testing.assert_allclose(single(X, T, P), values, rtol=0, atol=2e-5 * np.abs(values).max())


def test_the_gain_is_that_of_differences_at_each_p(law, exported):
    compiled, h = load(exported[0] / "c", "mover_gain"), 1e-6
    for i, step in enumerate(h * np.eye(2)):
        slope = (law(X + step, T, P) - law(X - step, T, P)) / (2 * h)
        np.testing.assert_allclose(compiled(X, T, P)[:, [i]], slope, atol=1e-7)


def test_the_header_says_which_parameters_in_which_units(exported):
    folder = exported[0] / "c"
    header = (folder / "mover_policy.h").read_text()
    assert "int mover_policy(const double *x, double t, const double *p, double *u);" in header
    assert "#define MOVER_POLICY_N_P 2" in header
    lines = [line.split() for line in header.splitlines()]
    assert ["*", "p[0]", "mass", "[kg]", "in", "[0.8,", "1.2]"] in lines
    assert ["*", "p[1]", "goal", "[m]", "in", "[-1,", "1]"] in lines
    readme = (folder / "README.md").read_text()
    assert "const double *x, double t, const double *p, double *u);`, with p = (mass [kg], goal [m])" in readme
    first = (folder / "mover_policy_vectors.csv").read_text().splitlines()
    assert first[1] == "x[0],x[1],t,p[0],p[1],u"
    drawn = np.array([[float(v) for v in line.split(",")] for line in first[2:]])[:, 3:5]
    assert len(np.unique(drawn, axis=0)) > 60


@pytest.mark.skipif(shutil.which("make") is None, reason="no make here")
def test_its_self_test_passes(exported):
    done = subprocess.run(["make", "check"], cwd=exported[0] / "c", capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count(": ok") == 5


@pytest.mark.skipif(find_spec("onnxruntime") is None, reason="no onnxruntime here")
def test_onnx_is_torch(law, exported):
    session = Session(exported[0] / "onnx" / "policy.onnx")
    assert session.names == ["x", "t", "p"]
    np.testing.assert_allclose(session(X, T[:, None], P), law(X, T, P), rtol=0, atol=2e-5 * np.abs(law(X, T, P)).max())


@pytest.mark.slow
@pytest.mark.skipif(find_spec("l4casadi") is None, reason="no l4casadi here")
def test_l4casadi_is_torch(law, tmp_path):
    f = law.to_casadi(backend="l4casadi", build_dir=tmp_path)
    assert f.name_in() == ["x", "t", "p"]
    got = np.array([f(x, t, p).full().ravel() for x, t, p in zip(X, T, P, strict=True)])
    np.testing.assert_allclose(got, law(X, T, P), rtol=0, atol=2e-5 * np.abs(law(X, T, P)).max())


def test_with_p_folded_in_nothing_is_left_of_it(law, tmp_path):
    p = P[0]
    own = law.at(p)
    own.to_c(tmp_path, only=["policy"])
    compiled = load(tmp_path, "mover_policy")
    assert compiled.inputs == {"x": 2, "t": 1}
    np.testing.assert_allclose(compiled(X, T), law(X, T, p), rtol=1e-12, atol=1e-12)


def test_extrapolation_is_told_once(law):
    with pytest.warns(UserWarning, match="extrapolation: mass = 2 is outside") as told:
        law.at([2.0, 0.0])
    assert len(told) == 1


def test_weights_are_not_changed_by_an_export(law, exported):
    again = law_of_mass()
    for one, other in zip(law.policy.parameters(), again.policy.parameters(), strict=True):
        assert torch.equal(one, other)
