"""Records: networks, CasADi functions and a card of plain data as one file, data only (see nocl.support.store).

The structure (sizes, SX maps as instruction lists) is JSON, so that a record needs neither pickle nor the user's file,
and loads in any version of CasADi.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import casadi as ca
import torch
from torch import Tensor

from nocl.nets import MLP, FeatureNet
from nocl.support import checks
from nocl.support.store import SUFFIX, read_tensors, reading, write_tensors
from nocl.translate.instructions import from_data, to_data


@dataclass(frozen=True)
class Record:
    """What `save` wrote: networks and functions by name, and a card of plain JSON data."""

    nets: Mapping[str, FeatureNet]
    functions: Mapping[str, ca.Function]
    card: Mapping[str, Any]


def save(folder: str | os.PathLike[str], kind: str, *, nets: Mapping[str, FeatureNet],
         functions: Mapping[str, ca.Function] | None = None, card: Mapping[str, Any] | None = None) -> Path:
    """Write folder/KIND.safetensors, the whole record in one atomic file; a folder that is missing is made."""
    tensors = {f"{name}.{key}": value for name, net in nets.items() for key, value in net.state_dict().items()}
    structure = {"nets": {name: _net_data(net, f"{kind}: {name}") for name, net in nets.items()},
                 "functions": {name: to_data(f) for name, f in (functions or {}).items()}, "card": dict(card or {})}
    path = _file(folder, kind)
    write_tensors(path, kind, tensors, structure)
    return path


def load(folder: str | os.PathLike[str], kind: str) -> Record:
    """What `save` wrote, bit by bit; ValueError for a missing, truncated, altered or foreign file."""
    path = _existing(folder, kind)
    tensors, structure = read_tensors(path, kind)
    with reading(path, f"a {kind!r} record"):
        nets = {name: _build_net(data, _below(name, tensors), f"{path}: {name}")
                for name, data in structure["nets"].items()}
        functions = {name: from_data(data) for name, data in structure["functions"].items()}
        return Record(nets, functions, structure["card"])


def save_net(folder: str | os.PathLike[str], name: str, net: FeatureNet) -> Path:
    """Write folder/NAME.safetensors, one network."""
    return save(folder, name, nets={"net": net})


def load_net(folder: str | os.PathLike[str], name: str) -> FeatureNet:
    """The network that save_net wrote; errors as in `load`."""
    nets = load(folder, name).nets
    if set(nets) != {"net"}:
        raise ValueError(f"{_file(folder, name)} holds {', '.join(nets) or 'no network'}; expected one network "
                         "of save_net's: use nocl.records.load")
    return nets["net"]


def _file(folder: str | os.PathLike[str], kind: str) -> Path:
    if not kind or kind.startswith(".") or not all(c.isalnum() or c in "_.-" for c in kind):
        raise ValueError(f"the name of a record is {kind!r}; expected letters, digits, _ and -: it names a file")
    return checks.folder(folder, "folder", kind) / (kind + SUFFIX)


def _existing(folder: str | os.PathLike[str], kind: str) -> Path:
    path = _file(folder, kind)
    folder = path.parent
    if not folder.is_dir():
        raise ValueError(f"{folder} is not a folder; expected one that holds {path.name}: check the path")
    if not path.is_file():
        there = ", ".join(sorted(p.name for p in folder.glob("*" + SUFFIX))) or "none"
        raise ValueError(f"{folder} holds no {path.name} (records there: {there}); expected a folder that a save of "
                         f"{kind!r} wrote: check the path")
    return path


def _below(name: str, tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    return {key[len(name) + 1:]: value for key, value in tensors.items() if key.startswith(name + ".")}


def _net_data(net: FeatureNet, owner: str) -> dict[str, Any]:
    if type(net) is not FeatureNet:
        raise ValueError(f"{owner} is a {type(net).__name__}; expected a nocl.nets.FeatureNet: only these are "
                         "stored as data")
    for i, mlp in enumerate(net.nets):
        if type(mlp) is not MLP:
            raise ValueError(f"{owner}: network {i} is a {type(mlp).__name__}; expected a nocl.nets.MLP")
    return {"inputs": to_data(net.inputs), "outputs": to_data(net.outputs), "training": net.training,
            "nets": [_mlp_data(mlp) for mlp in net.nets if isinstance(mlp, MLP)]}


def _mlp_data(mlp: MLP) -> dict[str, Any]:
    return {"sizes": list(mlp.sizes), "activation": mlp.activation, "skip": mlp.skip is not None}


def _build_net(data: Mapping[str, Any], weights: Mapping[str, Tensor], owner: str) -> FeatureNet:
    with torch.device("meta"):  # no memory, and the caller's random generator is left alone
        nets = [MLP(m["sizes"], m["activation"], m["skip"]) for m in data["nets"]]
    net = FeatureNet(from_data(data["inputs"]), nets, from_data(data["outputs"]))
    expected = {key: tuple(value.shape) for key, value in net.state_dict().items()}
    got = {key: tuple(value.shape) for key, value in weights.items()}
    if got != expected:
        key = sorted(k for k in got.keys() | expected.keys() if got.get(k) != expected.get(k))[0]
        raise ValueError(f"{owner}: the tensor {key} has shape {got.get(key, 'missing')}, expected "
                         f"{expected.get(key, 'no such tensor')}: the file does not fit its own structure, save it "
                         "again")
    for key, value in weights.items():
        if not value.is_floating_point():
            raise ValueError(f"{owner}: the tensor {key} is {value.dtype}; expected real weights: save it again")
        if not torch.isfinite(value).all():
            raise ValueError(f"{owner}: the tensor {key} holds NaN or inf; expected finite weights: what was saved is "
                             "of no use, train it again")
    net.load_state_dict(dict(weights), assign=True)
    return net.train(bool(data["training"]))
