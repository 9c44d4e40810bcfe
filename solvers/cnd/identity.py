"""What tells one training from another: a checkpoint is taken up by the very same call only."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict
from typing import Any

import torch

from nocl.nets import FeatureNet
from nocl.ocp import OCP
from nocl.translate.instructions import to_data


def identity(ocp: OCP, settings: Any, seed: int, f: Any, **more: str) -> str:
    """Problem, settings, seed and dynamics as text; f: the torch dynamics that training uses."""
    return json.dumps([ocp.to_data(), asdict(settings), seed, fingerprint(f), more], sort_keys=True)


def fingerprint(f: Any) -> str:
    """SHA-256 of a network's maps and weights; the name of the function where f is none, as the exact f."""
    net = getattr(f, "net", f)
    if not isinstance(net, torch.nn.Module):
        return "exact" if net is f else type(net).__name__
    maps = [to_data(net.inputs), to_data(net.outputs)] if isinstance(net, FeatureNet) else [type(net).__name__]
    sha = hashlib.sha256(json.dumps(maps).encode())
    for parameter in net.parameters():
        sha.update(parameter.detach().double().cpu().numpy().tobytes())
    return sha.hexdigest()
