"""Data-only files, written atomically: networks and functions, checkpoints, JSON. Nothing here can run code.

A network, or a set of them with their functions and card, is one safetensors file: the weights as they are, bit by
bit, and the structure (sizes, SX maps as instruction lists) as JSON in its header, under one SHA-256. One file, so
that weights never stand beside the structure of another save. Every write goes to a temporary file in the same folder
and is then renamed: an interrupted save leaves the former file as it was.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import uuid
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import safetensors
import safetensors.torch
import torch
from torch import Tensor

from nocl.nets import MLP, FeatureNet
from nocl.translate.instructions import from_data, to_data

FORMAT = 1  # raised when an older nocl could misread what is written
SUFFIX = ".safetensors"


@dataclass(frozen=True)
class Record:
    """What `save` wrote: networks and functions by name, and a card of plain JSON data."""

    nets: Mapping[str, FeatureNet]
    functions: Mapping[str, ca.Function]
    card: Mapping[str, Any]


def save(folder: str | Path, kind: str, *, nets: Mapping[str, FeatureNet],
         functions: Mapping[str, ca.Function] | None = None, card: Mapping[str, Any] | None = None) -> Path:
    """Write folder/KIND.safetensors, the whole record in one atomic file; a folder that is missing is made."""
    tensors = {f"{name}.{key}": value for name, net in nets.items() for key, value in net.state_dict().items()}
    structure = {"nets": {name: _net_data(net, f"{kind}: {name}") for name, net in nets.items()},
                 "functions": {name: to_data(f) for name, f in (functions or {}).items()}, "card": dict(card or {})}
    path = _file(folder, kind)
    _write_tensors(path, kind, tensors, structure)
    return path


def load(folder: str | Path, kind: str) -> Record:
    """What `save` wrote, bit by bit; ValueError for a missing, truncated, altered or foreign file."""
    path = _existing(folder, kind)
    tensors, structure = _read_tensors(path, kind)
    try:
        nets = {name: _build_net(data, _below(name, tensors), f"{path}: {name}")
                for name, data in structure["nets"].items()}
        functions = {name: from_data(data) for name, data in structure["functions"].items()}
        return Record(nets, functions, structure["card"])
    except (KeyError, TypeError, AttributeError) as error:
        raise ValueError(f"{path}: {type(error).__name__} {error} in its structure; expected a {kind!r} record: "
                         "save it again") from error


def save_net(folder: str | Path, name: str, net: FeatureNet) -> Path:
    """Write folder/NAME.safetensors, one network."""
    return save(folder, name, nets={"net": net})


def load_net(folder: str | Path, name: str) -> FeatureNet:
    """The network that save_net wrote; errors as in `load`."""
    nets = load(folder, name).nets
    if set(nets) != {"net"}:
        raise ValueError(f"{_file(folder, name)} holds {', '.join(nets) or 'no network'}; expected one network "
                         "of save_net's: use nocl.support.store.load")
    return nets["net"]


def save_checkpoint(path: str | Path, state: Any, meta: Mapping[str, Any] | None = None) -> Path:
    """Write a resumable state atomically: nested dicts, lists, tuples of tensors, arrays, numbers, strings and None.

    Optimizer and random generator states (`state_dict()`, `bit_generator.state`) are of this form. The tensors may be
    on any device; they come back on the CPU. `meta` is plain JSON data (seed, iteration, settings).
    """
    tensors: dict[str, Tensor] = {}
    tree = _flatten(state, "state", tensors)
    path = Path(path)
    _write_tensors(path, "checkpoint", tensors, {"tree": tree, "meta": dict(meta or {})})
    return path


def load_checkpoint(path: str | Path) -> tuple[Any, dict[str, Any]]:
    """(state, meta) of save_checkpoint, bit by bit; ValueError for a missing, truncated, altered or foreign file."""
    path = Path(path)
    if not path.is_file():
        raise ValueError(f"{path} does not exist; expected a checkpoint: start without resuming, or name its file")
    tensors, structure = _read_tensors(path, "checkpoint")
    return _unflatten(structure["tree"], tensors), structure["meta"]


def write_json(path: str | Path, data: Any) -> Path:
    """Write JSON atomically; numpy arrays become lists, and NaN, inf (JSON has none) 'nan', 'inf', '-inf'."""
    path = Path(path)
    _replace(path, (json.dumps(_plain(data, path.name), indent=2, allow_nan=False) + "\n").encode())
    return path


def read_json(path: str | Path) -> Any:
    """The data of a JSON file; ValueError for a missing or broken one."""
    path = Path(path)
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ValueError(f"{path} cannot be read ({error.strerror}); expected a JSON file that nocl wrote: "
                         "check the folder") from error
    except ValueError as error:
        raise ValueError(f"{path} is not JSON ({error}); expected a file that nocl wrote: it was cut off or edited, "
                         "write it again") from error


def write_text(path: str | Path, text: str) -> Path:
    """Write a text file atomically."""
    return write_bytes(path, text.encode())


def write_bytes(path: str | Path, content: bytes) -> Path:
    """Write a file atomically."""
    path = Path(path)
    _replace(path, content)
    return path


def _replace(path: Path, content: bytes) -> None:
    """Put `content` at `path`, all or nothing."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        part = path.with_name(f".{path.name}.{uuid.uuid4().hex}.part")
    except OSError as error:
        raise ValueError(f"{path.parent} cannot be made ({error.strerror}); expected a folder to write to: "
                         "name another one") from error
    try:
        with open(part, "xb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(part, path)
    except OSError as error:
        raise ValueError(f"{path} cannot be written ({error.strerror}); nothing was changed: make room or name "
                         "another folder") from error
    finally:
        part.unlink(missing_ok=True)


def _file(folder: str | Path, kind: str) -> Path:
    if not kind or kind.startswith(".") or not all(c.isalnum() or c in "_.-" for c in kind):
        raise ValueError(f"the name of a record is {kind!r}; expected letters, digits, _ and -: it names a file")
    return Path(folder) / (kind + SUFFIX)


def _existing(folder: str | Path, kind: str) -> Path:
    path, folder = _file(folder, kind), Path(folder)
    if not folder.is_dir():
        raise ValueError(f"{folder} is not a folder; expected one that holds {path.name}: check the path")
    if not path.is_file():
        there = ", ".join(sorted(p.name for p in folder.glob("*" + SUFFIX))) or "none"
        raise ValueError(f"{folder} holds no {path.name} (records there: {there}); expected a folder that a save of "
                         f"{kind!r} wrote: check the path")
    return path


def _write_tensors(path: Path, kind: str, tensors: Mapping[str, Tensor], structure: Mapping[str, Any]) -> None:
    own = {key: value.detach().cpu().clone(memory_format=torch.contiguous_format) for key, value in tensors.items()}
    try:
        text = json.dumps(structure)
    except TypeError as error:
        raise ValueError(f"{path.name}: {error}; expected plain data (numbers, strings, lists, dicts) in its card or "
                         "meta: convert it first") from error
    header = {"nocl": kind, "format": str(FORMAT), "structure": text, "sha256": _digest(own, kind, text)}
    _replace(path, safetensors.torch.save(own, header))


def _read_tensors(path: Path, kind: str) -> tuple[dict[str, Tensor], dict[str, Any]]:
    try:
        with safetensors.safe_open(path, framework="pt") as file:
            header = file.metadata() or {}
            tensors = {key: file.get_tensor(key).clone() for key in file.keys()}  # noqa: SIM118 (not a mapping)
    except (OSError, safetensors.SafetensorError) as error:
        raise ValueError(f"{path} cannot be read ({error}); expected a whole file that nocl wrote: it was cut off "
                         "or is of another kind, take a copy or save it again") from error
    if header.get("nocl") != kind:
        raise ValueError(f"{path} is {_what(header)}; expected a {kind!r} that nocl saved: name the right file")
    if header.get("format") != str(FORMAT):
        raise ValueError(f"{path} has format {header.get('format')}, this nocl reads {FORMAT}: update nocl, or save it "
                         "again")
    text = header.get("structure", "")
    if header.get("sha256") != _digest(tensors, kind, text):
        raise ValueError(f"{path} was altered after it was saved (its SHA-256 does not fit); expected the file as "
                         "written: take a copy or save it again")
    return tensors, json.loads(text)


def _what(header: Mapping[str, str]) -> str:
    return f"a {header['nocl']!r} of nocl's" if "nocl" in header else "a safetensors file that nocl did not write"


def _digest(tensors: Mapping[str, Tensor], kind: str, structure: str) -> str:
    """SHA-256 over names, shapes, types and bytes of all tensors, the kind and the structure."""
    sha = hashlib.sha256(f"{kind}\n{structure}\n".encode())
    for key in sorted(tensors):
        value = tensors[key]
        sha.update(f"{key} {value.dtype} {tuple(value.shape)}\n".encode())
        sha.update(value.reshape(-1).view(torch.uint8).numpy().tobytes())
    return sha.hexdigest()


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
    net.load_state_dict(dict(weights), assign=True)
    return net.train(bool(data["training"]))


def _flatten(value: Any, key: str, tensors: dict[str, Tensor]) -> Any:
    """`value` as JSON data, its tensors put aside under their keys."""
    if isinstance(value, Tensor):
        tensors[key] = value
        return {"tensor": key}
    if isinstance(value, (np.ndarray, np.generic)):
        tensors[key] = torch.from_numpy(np.array(value))
        return {"array": key} if isinstance(value, np.ndarray) else {"scalar": key}
    if isinstance(value, Mapping):
        return {"dict": [[_flatten(k, f"{key}.key", tensors), _flatten(v, f"{key}.{k}", tensors)]
                         for k, v in value.items()]}
    if isinstance(value, (list, tuple)):
        parts = [_flatten(v, f"{key}.{i}", tensors) for i, v in enumerate(value)]
        return {"tuple" if isinstance(value, tuple) else "list": parts}
    if isinstance(value, float):
        return {"float": value.hex()}
    if value is None or isinstance(value, (bool, int, str)):
        return value
    raise ValueError(f"checkpoint: {key} is a {type(value).__name__}; expected tensors, arrays, numbers, strings, "
                     "None, or dicts, lists and tuples of them: convert it first")


def _unflatten(node: Any, tensors: Mapping[str, Tensor]) -> Any:
    if not isinstance(node, dict):
        return node
    (tag, value), = node.items()
    match tag:
        case "tensor":
            return tensors[value]
        case "array":
            return tensors[value].numpy()
        case "scalar":
            return tensors[value].numpy()[()]
        case "dict":
            return {_unflatten(k, tensors): _unflatten(v, tensors) for k, v in value}
        case "float":
            return float.fromhex(value)
        case _:
            parts = [_unflatten(v, tensors) for v in value]
            return tuple(parts) if tag == "tuple" else parts


def _plain(value: Any, key: str) -> Any:
    """`value` as standard JSON data."""
    if isinstance(value, (np.ndarray, np.generic)):
        value = value.tolist()
    if isinstance(value, Mapping):
        return {str(k): _plain(v, f"{key}: {k}") for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(v, key) for v in value]
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    raise ValueError(f"{key} is a {type(value).__name__}; expected numbers, strings, lists or dicts: convert it first")
