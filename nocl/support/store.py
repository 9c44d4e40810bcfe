"""Data-only files, written atomically: tensors with their structure, checkpoints, JSON. Nothing here can run code.

Tensors are one safetensors file: the numbers as they are, bit by bit, and their structure as JSON in its header, under
one SHA-256. One file, so that tensors never stand beside the structure of another save. Every write goes to a
temporary file in the same folder and is then renamed: an interrupted save leaves the former file as it was.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import safetensors
import safetensors.torch
import torch
from torch import Tensor

from nocl.support.atomic import write_bytes
from nocl.support.checks import MALFORMED
from nocl.support.fingerprint import sha256

FORMAT = 1  # raised when an older nocl could misread what is written
SUFFIX = ".safetensors"


def save_checkpoint(path: str | Path, state: Any, meta: Mapping[str, Any] | None = None) -> Path:
    """Write a resumable state atomically: nested dicts, lists, tuples of tensors, arrays, numbers, strings and None.

    Optimizer and random generator states (`state_dict()`, `bit_generator.state`) are of this form. The tensors may be
    on any device; they come back on the CPU. `meta` is plain JSON data (seed, iteration, settings).
    """
    tensors: dict[str, Tensor] = {}
    tree = _flatten(state, "state", tensors)
    path = Path(path)
    write_tensors(path, "checkpoint", tensors, {"tree": tree, "meta": dict(meta or {})})
    return path


def load_checkpoint(path: str | Path) -> tuple[Any, dict[str, Any]]:
    """(state, meta) of save_checkpoint, bit by bit; ValueError for a missing, truncated, altered or foreign file."""
    path = Path(path)
    if not path.is_file():
        raise ValueError(f"{path} does not exist; expected a checkpoint: start without resuming, or name its file")
    tensors, structure = read_tensors(path, "checkpoint")
    with reading(path, "a checkpoint"):
        return _unflatten(structure["tree"], tensors), structure["meta"]


@contextmanager
def reading(path: str | os.PathLike[str], what: str) -> Iterator[None]:
    """A ValueError that names the file, for all that data of another form than expected raises inside."""
    try:
        yield
    except (*MALFORMED, ValueError) as error:
        said = str(error).strip().partition("\n")[0]  # CasADi lists all its overloads
        if isinstance(error, ValueError) and str(path) in said:
            raise
        kind = "" if isinstance(error, (KeyError, ValueError)) else f"{type(error).__name__}: "
        said += " is missing" if isinstance(error, KeyError) else ""
        raise ValueError(f"{path}: {kind}{said}, in its structure; expected {what} that nocl wrote: save it again"
                         ) from error


def write_json(path: str | Path, data: Any) -> Path:
    """Write JSON atomically; numpy arrays become lists, and NaN, inf (JSON has none) 'nan', 'inf', '-inf'."""
    path = Path(path)
    return write_bytes(path, (json.dumps(_plain(data, path.name), indent=2, allow_nan=False) + "\n").encode())


def read_json(path: str | Path) -> Any:
    """The data of a JSON file; ValueError for a missing or broken one."""
    path = Path(path)
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ValueError(f"{path} cannot be read ({error.strerror}); expected a JSON file that nocl wrote: "
                         "check the folder") from error
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path} is not JSON ({error}); expected a file that nocl wrote: it was cut off or edited, "
                         "write it again") from error


def write_text(path: str | Path, text: str) -> Path:
    """Write a text file atomically."""
    return write_bytes(path, text.encode())


def write_tensors(path: Path, kind: str, tensors: Mapping[str, Tensor], structure: Mapping[str, Any]) -> None:
    """Write tensors by name and a JSON structure as one file of a kind."""
    own = {key: value.detach().cpu().clone(memory_format=torch.contiguous_format) for key, value in tensors.items()}
    try:
        text = json.dumps(structure)
    except TypeError as error:
        raise ValueError(f"{path.name}: {error}; expected plain data (numbers, strings, lists, dicts) in its card or "
                         "meta: convert it first") from error
    header = {"nocl": kind, "format": str(FORMAT), "structure": text, "sha256": _digest(own, kind, text)}
    write_bytes(path, safetensors.torch.save(own, header))


def read_tensors(path: Path, kind: str) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """What write_tensors wrote; ValueError for a truncated, altered or foreign file."""
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
    try:
        structure = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path}: its structure is not JSON ({error}): save it again") from error
    if not isinstance(structure, dict):
        raise ValueError(f"{path}: its structure is a {type(structure).__name__}, expected a dict: save it again")
    return tensors, structure


def _what(header: Mapping[str, str]) -> str:
    return f"a {header['nocl']!r} of nocl's" if "nocl" in header else "a safetensors file that nocl did not write"


def _digest(tensors: Mapping[str, Tensor], kind: str, structure: str) -> str:
    """SHA-256 over names, shapes, types and bytes of all tensors, the kind and the structure.

    Format 1 fixes these bytes: files that were saved with them must load.
    """
    chunks: list[bytes | str] = [f"{kind}\n{structure}\n"]
    for key in sorted(tensors):
        value = tensors[key]
        chunks.append(f"{key} {value.dtype} {tuple(value.shape)}\n")
        chunks.append(value.reshape(-1).view(torch.uint8).numpy().tobytes())
    return sha256(*chunks)


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
