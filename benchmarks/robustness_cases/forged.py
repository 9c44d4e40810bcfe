"""Files that were damaged or forged: a ValueError, or an answer that is as if they were not there; never a crash."""

from __future__ import annotations

import json
import struct
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch

import nocl
from nocl.solvers import DDP, NMPC
from nocl.support import store
from nocl.sysid import Settings, identify

Case = tuple[str, Callable[[], str]]
CUTS, FLIPS = 6, 10
OURS = ("expected", "outside its box", "save it again", "take a copy")  # in every message of nocl's
CHILD = """
import sys
import numpy as np
from nocl.solvers import DDP
import nocl
ocp = nocl.load_ocp("double_integrator")
print(repr(float(DDP(ocp, intervals=8, threads=1, cache=sys.argv[1]).solve([1.0, 0.0], workers=1).cost[0])))
"""


def refused(load: Callable[[], Any]) -> str:
    """"" where loading raises a ValueError with a message of ours."""
    try:
        load()
    except ValueError as error:
        text = str(error)
        return "" if any(said in text for said in OURS) else f"raw: {text}"
    except BaseException as error:
        return f"{type(error).__name__}: {error}"
    return "was loaded"


def damages(content: bytes, rng: np.random.Generator) -> Iterator[tuple[str, bytes]]:
    """Cut and flipped bytes of any file."""
    yield from ((f"cut at {n}", content[:n]) for n in (0, 1, 7, *rng.integers(8, len(content), CUTS)))
    for at, bit in zip(rng.integers(0, len(content), FLIPS), rng.integers(0, 8, FLIPS), strict=True):
        yield f"bit {bit} of byte {at}", content[:at] + bytes([content[at] ^ (1 << bit)]) + content[at + 1:]
    yield "zeros", bytes(len(content))
    yield "text", b"hello " * 50
    yield "a byte more", content + b"\\0"


def headers(content: bytes) -> Iterator[tuple[str, bytes]]:
    """Other headers of a safetensors file: huge shapes, wrong types, deep nesting."""
    n = struct.unpack("<Q", content[:8])[0]
    header, body = json.loads(content[8: 8 + n]), content[8 + n:]
    key = next(k for k in header if k != "__metadata__")

    def packed(text: bytes) -> bytes:
        return struct.pack("<Q", len(text)) + text + body

    for name, entry in {"huge shape": {"dtype": "F64", "shape": [2**40, 2**20], "data_offsets": [0, 2**63]},
                        "negative shape": {"dtype": "F64", "shape": [-4], "data_offsets": [0, 32]},
                        "no such type": {"dtype": "F7", "shape": [4], "data_offsets": [0, 32]},
                        "offsets beyond the file": {"dtype": "F64", "shape": [10**6], "data_offsets": [0, 8 * 10**6]},
                        "a list": [], "a number": 3, "text": "x"}.items():
        yield name, packed(json.dumps({**header, key: entry}).encode())
    yield "deep header", packed(b"[" * 20_000 + b"]" * 20_000)
    yield "a header of 2^62 bytes", struct.pack("<Q", 2**62) + content[8:]
    yield "no metadata", packed(json.dumps({k: v for k, v in header.items() if k != "__metadata__"}).encode())
    yield "metadata of numbers", packed(json.dumps({**header, "__metadata__": {"nocl": 3}}).encode())


def nested(depth: int) -> Any:
    value: Any = []
    for _ in range(depth):
        value = [value]
    return value


def changes(data: Any, rng: np.random.Generator, n: int) -> Iterator[tuple[str, Any]]:
    """JSON data with something missing, or of another kind, at random places."""
    odd = [None, [], {}, "x", -1, 1e308, "nan", True, nested(50), [[1, 2]], 2**70]
    for k in range(n):
        copy = json.loads(json.dumps(data))
        place, at = copy, []
        while isinstance(place, (dict, list)) and place and (not at or rng.random() < 0.75):
            parent, key = place, list(place)[rng.integers(len(place))] if isinstance(place, dict) else \
                int(rng.integers(len(place)))
            at, place = [*at, key], parent[key]
        if k % 3 == 0 and isinstance(parent, dict):
            del parent[key]
        else:
            parent[key] = odd[int(rng.integers(len(odd)))]
        yield f"{'/'.join(map(str, at[:6]))} ({k})", copy


def resealed(path: Path, kind: str, load: Callable[[], Any], rng: np.random.Generator) -> Iterator[Case]:
    """Files with a true digest over a false structure, or false tensors."""
    tensors, structure = store.read_tensors(path, kind)

    def case(tensors: dict[str, Any], structure: Any, must: bool = True) -> str:
        store.write_tensors(path, kind, tensors, structure)
        said = refused(load)
        return said if must or said != "was loaded" else ""  # a changed card is another one, and no fault

    for name, other in changes(structure, rng, 30):
        yield f"structure: {name}", lambda o=other: case(tensors, o, must=False)
    for name, value in {"NaN": np.nan, "inf": np.inf}.items():
        first = next(iter(tensors))
        bad = {**tensors, first: torch.full_like(tensors[first], value)}
        yield f"weights of {name}", lambda b=bad: case(b, structure)
    yield "a tensor is missing", lambda: case(dict(list(tensors.items())[1:]), structure)
    yield "a tensor of another shape", lambda: case({k: v.reshape(-1) for k, v in tensors.items()}, structure)
    yield "whole numbers", lambda: case({k: v.long() for k, v in tensors.items()}, structure)
    yield "complex numbers", lambda: case({k: v.to(torch.complex64) for k, v in tensors.items()}, structure)
    yield "deep structure", lambda: case(tensors, {"nets": nested(900), "functions": {}, "card": {}})


def of_file(path: Path, kind: str, load: Callable[[], Any], rng: np.random.Generator) -> Iterator[Case]:
    content = path.read_bytes()

    def case(damaged: bytes) -> str:
        path.write_bytes(damaged)
        return refused(load)

    for name, damaged in [*damages(content, rng), *headers(content)]:
        yield name, lambda d=damaged: case(d)
    path.write_bytes(content)
    yield from resealed(path, kind, load, rng)


def runs(folder: Path, rng: np.random.Generator, solver: str) -> Iterator[Case]:
    """A run's folder, of which one file was damaged: refused, or the same answer."""
    ocp, out = nocl.load_ocp("double_integrator"), folder / f"run-{solver}"
    made = NMPC(ocp, 10, starts=1, passes=0) if solver == "nmpc" else DDP(ocp, intervals=10, threads=1)
    x0 = ocp.initial_states.sample(3, 0)

    def solve() -> Any:
        return made.solve(x0, out=out, workers=1, progress=False)

    right = solve()
    whole = {path: path.read_bytes() for path in sorted(out.rglob("*")) if path.is_file()}

    def case(path: Path, damaged: bytes) -> str:
        for other, content in whole.items():
            other.write_bytes(content)
        path.write_bytes(damaged)
        try:
            found = solve()
        except ValueError as error:
            return "" if "expected" in str(error) else f"raw: {error}"
        return "" if np.array_equal(found.cost, right.cost) and np.array_equal(found.u, right.u) else "another answer"

    for path, content in whole.items():
        for name, damaged in list(damages(content, rng))[:: 1 if path.suffix == ".json" else 2]:
            yield f"{path.name}: {name}", lambda p=path, d=damaged: case(p, d)


def kernels(folder: Path, rng: np.random.Generator) -> Iterator[Case]:
    """A cache's library that was damaged is built again; in a process of its own, which a signal would end."""
    cache = folder / "cache"

    def answer() -> str:
        made = subprocess.run([sys.executable, "-c", CHILD, str(cache)], capture_output=True, text=True, check=False)
        return made.stdout.strip() if made.returncode == 0 else f"exit {made.returncode}: {made.stderr[-200:]}"

    right = answer()
    library, = cache.glob("*.so")
    content = library.read_bytes()

    def case(damaged: bytes) -> str:
        library.write_bytes(damaged)
        found, left = answer(), {p.read_bytes() for p in cache.iterdir()}
        return f"{found} instead of {right}" if found != right else "" if left == {content} else "the cache is damaged"

    for name, damaged in list(damages(content, rng))[2::4]:
        yield name, lambda d=damaged: case(d)


def kinds(rng: np.random.Generator, folder: Path) -> Iterator[tuple[str, list[Case]]]:
    nocl.pretrained("pendulum").save(folder)
    controller = folder / "cnd.safetensors"
    yield "controllers", list(of_file(controller, "cnd", lambda: nocl.CND.load(folder), rng))
    small = Settings(iterations=2, polish=0, samples=200, width=4, structure=False)
    system = nocl.load_ocp("pendulum").system
    identify(system, settings=small, progress=False).save(folder)
    model = folder / "dynamics.safetensors"
    yield "models", list(of_file(model, "dynamics", lambda: nocl.LearnedDynamics.load(folder), rng))
    state = {"step": 3, "weights": [torch.zeros(4), np.arange(3)], "rng": np.random.default_rng(0).bit_generator.state}
    path = store.save_checkpoint(folder / "c.safetensors", state, {"seed": 0})
    yield "checkpoints", [c for c in of_file(path, "checkpoint", lambda: store.load_checkpoint(path), rng)
                          if not c[0].startswith(("weights of", "a tensor of", "whole", "complex"))]
    yield "runs of NMPC", list(runs(folder, rng, "nmpc"))
    yield "runs of DDP", list(runs(folder, rng, "ddp"))
    yield "kernels", list(kernels(folder, rng))
