"""Finished cells of the paper's tables, as files."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TypeVar

import numpy as np

from nocl.support import store

Cell = TypeVar("Cell")


def read_cell(path: Path, kind: type[Cell], table: str, numbers: Sequence[str]) -> Cell:
    """The cell of a file; `numbers` names its fields of numbers or lists of them ('inf' and 'nan' are text in JSON).

    Raises ValueError where the file is no cell of the table.
    """
    data = store.read_json(path)
    try:
        return kind(**{**data, **{name: np.asarray(data[name], dtype=float).tolist() for name in numbers}})
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{path} is no cell of {table} ({error}); delete it") from error
