"""Random controllers, 1 to 12 states, 1 to 4 controls, with and without angles: every backend is the same function."""

from __future__ import annotations

import importlib.util
from types import SimpleNamespace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from test_to_casadi import feature_net

from nocl.exports import parity
from nocl.exports.bundle import export
from nocl.exports.casadi_forms import to_casadi
from nocl.nets import ACTIVATIONS

SHAPES = {"nx": st.integers(1, 12), "nu": st.integers(1, 4), "angles": st.integers(0, 3), "width": st.integers(1, 24),
          "activation": st.sampled_from(sorted(ACTIVATIONS)), "skip": st.booleans(), "seed": st.integers(0, 999)}


def agree(folder, forms, nx, nu, angles, width, activation, skip, seed) -> set[str]:
    """Compare by the certificate's own rules; it raises where a limit is passed. The names of the backends."""
    torch.manual_seed(seed)
    net = feature_net(nx, nu, min(angles, nx), width, activation, skip)
    function = to_casadi(net, name="policy", in_names=["x", "t"], out_names=["u"])
    part = parity.ExportPart("policy", function, net, {"x": (-3.0, 3.0), "t": (0.0, 5.0)}, net=net)
    network = SimpleNamespace(export_parts=lambda: [part], system=SimpleNamespace(name="fuzz"))
    certificate = export(network, folder / "out", forms, against=forms)
    assert certificate.ok
    return {f"{f.backend} {f.dtype} {f.of}" for f in certificate.findings}


@settings(max_examples=6, deadline=None, derandomize=True)
@given(**SHAPES)
def test_torch_native_onnx_and_c(tmp_path_factory, **shape):
    forms = ("casadi", "c") + (("onnx",) if importlib.util.find_spec("onnxruntime") else ())
    found = agree(tmp_path_factory.mktemp("fuzz"), forms, **shape)
    assert {"native CasADi float64 first derivatives", "C float64 first derivatives", "C float32 value"} <= found


@pytest.mark.slow
@pytest.mark.skipif(importlib.util.find_spec("l4casadi") is None, reason="l4casadi is not installed")
@settings(max_examples=5, deadline=None, derandomize=True)
@given(**SHAPES)
def test_l4casadi_too(tmp_path_factory, **shape):
    found = agree(tmp_path_factory.mktemp("fuzz"), ("l4casadi",), **shape)
    assert "L4CasADi float32 first derivatives" in found
