"""Tables of columns on disk: CSV by the standard library, Parquet by pyarrow."""

from __future__ import annotations

import csv
import io
import re
from pathlib import Path
from typing import Any

import numpy as np

from nocl.support.packages import package
from nocl.support.store import write_bytes

Columns = dict[str, Any]  # column name -> its cells, in order
KINDS = (".csv", ".parquet")
SEPARATORS = ",;\t"
COMMA, POINT = re.compile(r"[-+]?\d*,\d+([eE][-+]?\d+)?"), re.compile(r"[-+]?\d*\.\d+([eE][-+]?\d+)?")


def read_table(path: Path) -> Columns:
    """The columns of a CSV file with a header line, or of a Parquet file; ValueError for anything else."""
    if path.suffix.lower() not in KINDS:
        raise ValueError(f"{path} is no {' or '.join(KINDS)} file; expected one of these: convert it")
    if not path.is_file():
        raise ValueError(f"there is no file {path}; expected a log: check the path")
    return _read_csv(path) if path.suffix.lower() == ".csv" else _read_parquet(path)


def write_table(path: Path, columns: Columns) -> Path:
    """Write columns as CSV (17 digits, empty cells for NaN) or Parquet, by the suffix; atomically."""
    if path.suffix.lower() not in KINDS:
        raise ValueError(f"{path} is no {' or '.join(KINDS)} file; expected one of these: name it so")
    if path.suffix.lower() == ".csv":
        file = io.StringIO(newline="")
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(columns)
        writer.writerows(zip(*(map(_cell, column) for column in columns.values()), strict=True))
        return write_bytes(path, file.getvalue().encode())
    arrow, parquet = package("pyarrow", "nocl[data]"), package("pyarrow.parquet", "nocl[data]")
    buffer = io.BytesIO()
    parquet.write_table(arrow.table(columns), buffer)
    return write_bytes(path, buffer.getvalue())


def _cell(value: Any) -> str:
    if isinstance(value, (str, np.integer)):
        return str(value)
    return "" if value != value else repr(float(value))


def _read_csv(path: Path) -> Columns:
    """Cells apart by commas, or, as spreadsheets write where numbers have a decimal comma, by semicolons or tabs."""
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            text = file.read()
        first = text.partition("\n")[0].strip()
        separator = first[4:] if first.lower().startswith("sep=") and len(first) == 5 else ""
        if separator:  # a line that only says so
            text, first = text.partition("\n")[2], separator
        separator = max(SEPARATORS, key=first.count)
        lines = [row for row in csv.reader(io.StringIO(text, newline=""), delimiter=separator) if row]
        head, *rows = lines or [[]]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise ValueError(f"{path} cannot be read ({error}); expected a CSV file in UTF-8 with a header line") from None
    names = [name.strip() for name in head]
    _check_repeated(names, path)
    for i, row in enumerate(rows):
        if len(row) != len(names):
            raise ValueError(f"{path}: line {i + 2} has {len(row)} cells, the header {len(names)}; expected as many")
    table = {name: [row[k].strip() for row in rows] for k, name in enumerate(names)}
    return table if separator == "," else {name: _points(cells, name, path) for name, cells in table.items()}


def _points(cells: list[str], name: str, path: Path) -> list[str]:
    """Numbers with a decimal comma, with a decimal point; ValueError where a column has both."""
    if not any(COMMA.fullmatch(cell) for cell in cells):
        return cells
    both = [cell for cell in cells if POINT.fullmatch(cell)]
    if both:
        raise ValueError(f"{path}: column {name!r} has decimal commas and points ({both[0]!r}); expected one of them: "
                         "export the file without separators of thousands")
    return [cell.replace(",", ".") if COMMA.fullmatch(cell) else cell for cell in cells]


def _check_repeated(names: list[str], path: Path) -> None:
    repeated = sorted({name for name in names if names.count(name) > 1})
    if repeated:
        raise ValueError(f"{path}: column {', '.join(repeated)} occurs more than once; expected different names")


def _read_parquet(path: Path) -> Columns:
    parquet, types = package("pyarrow.parquet", "nocl[data]"), package("pyarrow.types", "nocl[data]")
    try:
        table = parquet.read_table(path)
    except (OSError, ValueError, NotImplementedError) as error:  # pyarrow's own errors are among these
        raise ValueError(f"{path} cannot be read ({error}); expected a Parquet file") from None
    _check_repeated(table.column_names, path)
    columns = {name: table.column(name) for name in table.column_names}
    timed = {n for n, c in columns.items() if types.is_timestamp(c.type) or types.is_duration(c.type)}
    return {n: c.to_numpy() if n in timed else c.to_pylist() for n, c in columns.items()}
