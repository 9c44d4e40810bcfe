"""What tells one training from another: a checkpoint is taken up by the very same call only."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import torch

from nocl.nets import FeatureNet
from nocl.ocp import OCP
from nocl.support.fingerprint import fingerprint, json_text
from nocl.translate.instructions import to_data


def identity(ocp: OCP, settings: Any, seed: int, f: Any, **more: str) -> str:
    """Problem, settings, seed and dynamics as text; f: the torch dynamics that training uses."""
    return json_text([ocp.to_data(), asdict(settings), seed, _dynamics(f), more])


def _dynamics(f: Any) -> str:
    """A fingerprint of a network's maps and weights; the name of the function where f is none, as the exact f."""
    net = getattr(f, "net", f)
    if not isinstance(net, torch.nn.Module):
        return "exact" if net is f else type(net).__name__
    maps = [to_data(net.inputs), to_data(net.outputs)] if isinstance(net, FeatureNet) else [type(net).__name__]
    return fingerprint(maps, *(parameter.detach().double().cpu().numpy() for parameter in net.parameters()))
