"""Logs with faults: refused, or told by a warning, never taken without a word; and files that are right, read exactly.

theta = sin 2 t, omega = 2 cos 2 t, and a control that jumps, in a box of 8.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

import nocl
from nocl.sysid import LogSettings, identify
from nocl.sysid.logs.log import Log

Case = tuple[str, Callable[[], str]]
FAST = LogSettings(width=4, iterations=10, steps=1, window=4)
N, H = 60, 0.05
T = H * np.arange(N)
X = np.c_[np.sin(2 * T), 2 * np.cos(2 * T)]
U = np.random.default_rng(0).uniform(-2, 2, (N, 1))


def plant(x: tuple[str, str] = ("theta", "omega"), angles: bool = True, wide: float = 1.0) -> nocl.System:
    symbols = ca.vertcat(*map(ca.SX.sym, x))
    return nocl.System("plant", x=symbols, u=ca.SX.sym("torque"), xdot=None, lbu=[-3], ubu=[3], lbx=[-8 * wide] * 2,
                       ubx=[8 * wide] * 2, angles=[x[0]] if angles else [])


def told(make: Callable[[], Any], known: bool = False) -> str:
    """"" where a ValueError or a UserWarning says what is wrong with it."""
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        try:
            log = make()
            if known:
                identify(plant(wide=100), data=log, known={"theta": "omega"}, settings=FAST, progress=False)
        except ValueError as error:
            text = str(error)
            return "" if "expected" in text or "is it in" in text or "name its symbol" in text else f"raw: {text}"
    return "" if any(issubclass(w.category, UserWarning) for w in said) else "taken without a word"


def same(make: Callable[[], Log], right: Log) -> str:
    """"" where a file is read without a word, as the log that it is."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        log = make()
    if len(log.runs) != len(right.runs):
        return f"{len(log.runs)} pieces instead of {len(right.runs)}"
    for a, b in zip(log, right, strict=True):
        for name in ("t", "x", "u"):
            if not np.allclose(getattr(a, name), getattr(b, name), rtol=0, atol=1e-9):
                return f"another {name}"
    return ""


def cells(rng: np.random.Generator) -> Iterator[Case]:
    """One impossible cell."""
    for value in (1e308, -1e308, 1.7e308, 1e200, -1e150, 1e30, 1e8, 3e4, np.inf, -np.inf):
        for place in ("t", "x", "u"):
            at = int(rng.integers(8, N - 8))
            t, x, u = T.copy(), X.copy(), U.copy()
            {"t": t, "x": x[:, int(rng.integers(2))], "u": u[:, 0]}[place][at] = value
            yield f"{value:g} in {place}[{at}]", lambda a=(t, x, u): told(lambda: Log.of(plant(), *a))


def scales() -> Iterator[Case]:
    """All of a column in an impossible unit, or time in another unit than the known row."""
    for k in (1e300, 1e150, 1e-300, 1e-160, 1e5):
        yield f"x times {k:g}", lambda k=k: told(lambda: Log.of(plant(), T, X * k, U))
    for k in (1e300, 1e-300, 1e-200, 1e160):
        yield f"t times {k:g}", lambda k=k: told(lambda: Log.of(plant(), T * k, X, U))
    for k in (1e3, 1e6, 1e9, 1 / 60, 1 / 3600, 60):
        yield f"t times {k:g}, known row", lambda k=k: told(lambda: Log.of(plant(wide=100), T * k, X, U), known=True)
    for k in (180 / np.pi, np.pi / 180, 30 / np.pi, -1, 3):
        yield f"rate times {k:g}", lambda k=k: told(lambda: Log.of(plant(wide=100), T, X * [1, k], U), known=True)


def degrees(rng: np.random.Generator) -> Iterator[Case]:
    for k in range(8):
        h, size, rate = rng.uniform(0.03, 0.1), rng.uniform(60, 170), rng.uniform(1, 3)
        t = h * np.arange(150)
        x = np.c_[size * np.sin(rate * t), size * rate * np.cos(rate * t)]
        yield f"degrees {k}", lambda t=t, x=x: told(lambda: Log.of(plant(wide=100), t, x, 0 * t))


def labels() -> Iterator[Case]:
    half = N // 2
    t = np.r_[T[:half], T[:half]]
    for name, run in {"NaN": [1.0] * half + [np.nan] * half, "None": ["a"] * half + [None] * half,
                      "empty": ["a"] * half + [""] * half, "mixed": [1] * half + ["1"] * half,
                      "nan as text": ["a"] * half + ["nan"] * half, "lists": [[1]] * N, "too few": ["a"] * 5,
                      "none at all": None}.items():
        yield f"labels {name}", lambda r=run: told(lambda: Log.of(plant(), t, X, U, run=r))


def gaps() -> Iterator[Case]:
    sparse = np.full((N, 1), np.nan)
    sparse[::12] = U[::12]
    yield "a control logged when it changes", lambda: told(lambda: Log.of(plant(), T, X, sparse))
    late = np.where(np.arange(N)[:, None] < 45, np.nan, U)
    yield "controls of the last quarter alone", lambda: told(lambda: Log.of(plant(), T, X, late))
    yield "times that fall", lambda: told(lambda: Log.of(plant(), T[::-1], X, U))
    yield "times twice", lambda: told(lambda: Log.of(plant(), np.repeat(T[::2], 2), X, U))
    yield "no state known", lambda: told(lambda: Log.of(plant(), T, X * np.nan, U))


def names(folder: Path) -> Iterator[Case]:
    """States with the names of a file's own columns."""
    for name in ("t", "run", "run piece", "domega/dt", " v"):
        other = "omega" if name == "domega/dt" else "v"
        s = plant((name, other if other != name else "w"), angles=False)
        yield f"a state {name!r}", lambda s=s: told(lambda: Log.of(s, T, X, U).write(folder / "names.csv"))


def text(separator: str, comma: str, head: str = "", times: Any = T) -> str:
    rows = [["t", "theta", "omega", "torque"]]
    for t, x, u in zip(times, X, U, strict=True):
        numbers = [t if isinstance(t, str) else repr(float(t)), *(repr(float(v)) for v in (*x, *u))]
        rows.append([c if i == 0 and isinstance(t, str) else c.replace(".", comma) for i, c in enumerate(numbers)])
    return head + "\n".join(separator.join(row) for row in rows) + "\n"


def files(folder: Path) -> Iterator[Case]:
    """As spreadsheets and data loggers write, exact; and broken ones, refused."""
    right = Log.of(plant(), T, X, U)
    stamps = [datetime(2024, 5, 1, tzinfo=UTC) + timedelta(seconds=float(t)) for t in T]
    good = {"commas": text(",", "."), "semicolons": text(";", "."), "tabs": text("\t", "."),
            "decimal commas": text(";", ","), "tabs and decimal commas": text("\t", ","),
            "sep=": text(";", ",", "sep=;\n"), "a byte order mark": text(",", ".", "\ufeff"),
            "Windows lines": text(",", ".").replace("\n", "\r\n"),
            "timestamps": text(",", ".", times=[s.isoformat() for s in stamps])}

    def read(name: str, content: str) -> Log:
        (folder / f"{name}.csv").write_text(content, encoding="utf-8", newline="")
        return Log.read(folder / f"{name}.csv", plant())

    for name, content in good.items():
        yield name, lambda n=name, c=content: same(lambda: read(n, c), right)
    yield "Parquet timestamps", lambda: same(lambda: parquet(folder, stamps), right)
    for kind in ("csv", "parquet"):
        path = folder / f"round.{kind}"
        yield f"round trip {kind}", lambda p=path: same(lambda: Log.read(right.write(p), plant()), right)
    held = U.copy()
    held[25] = np.nan
    cut = Log.of(plant(), T, X, held)
    yield "round trip of a missing control", lambda: same(lambda: Log.read(cut.write(folder / "c.csv"), plant()), cut)
    broken = {"both commas": text(";", ",").replace(",", ".", 3), "a short line": text(",", ".") + "1,2\n",
              "units below the header": text(",", ".").replace("\n", "\ns,rad,rad/s,Nm\n", 1),
              "a column missing": text(",", ".").replace("omega", "speed"),
              "a column twice": text(",", ".").replace("torque", "omega"), "empty": "", "a header alone": "t,theta\n",
              "thousands": text(";", ",").replace("0,0;", "1.000,0;", 1), "not text": "\x00\x01\x02"}
    for name, content in broken.items():
        yield f"broken: {name}", lambda n=name, c=content: told(lambda: read(n, c))


def parquet(folder: Path, stamps: list[datetime]) -> Log:
    import pyarrow
    import pyarrow.parquet

    columns = {"t": stamps, "theta": X[:, 0], "omega": X[:, 1], "torque": U[:, 0]}
    pyarrow.parquet.write_table(pyarrow.table(columns), folder / "stamps.parquet")
    return Log.read(folder / "stamps.parquet", plant())


def kinds(rng: np.random.Generator, folder: Path) -> Iterator[tuple[str, list[Case]]]:
    yield "impossible cells", list(cells(rng))
    yield "units", list(scales())
    yield "degrees", list(degrees(rng))
    yield "labels", list(labels())
    yield "gaps", list(gaps())
    yield "names", list(names(folder))
    yield "files", list(files(folder))
