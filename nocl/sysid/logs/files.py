"""Tables of columns on disk: CSV by the standard library, Parquet by pyarrow."""

from __future__ import annotations

import csv
import io
from pathlib import Path
from typing import Any

from nocl.support.packages import package
from nocl.support.store import write_bytes

Table = dict[str, Any]  # column name -> its cells, in order
KINDS = (".csv", ".parquet")


def read_table(path: Path) -> Table:
    """The columns of a CSV file with a header line, or of a Parquet file; ValueError for anything else."""
    if path.suffix.lower() not in KINDS:
        raise ValueError(f"{path} is no {' or '.join(KINDS)} file; expected one of these: convert it")
    if not path.is_file():
        raise ValueError(f"there is no file {path}; expected a log: check the path")
    return _read_csv(path) if path.suffix.lower() == ".csv" else _read_parquet(path)


def write_table(path: Path, columns: Table) -> Path:
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
    return str(value) if isinstance(value, str) else "" if value != value else repr(float(value))


def _read_csv(path: Path) -> Table:
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            head, *rows = list(csv.reader(file)) or [[]]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise ValueError(f"{path} cannot be read ({error}); expected a CSV file in UTF-8 with a header line") from None
    names = [name.strip() for name in head]
    repeated = sorted({name for name in names if names.count(name) > 1})
    if repeated:
        raise ValueError(f"{path}: column {', '.join(repeated)} occurs more than once; expected different names")
    rows = [row for row in rows if row]
    for i, row in enumerate(rows):
        if len(row) != len(names):
            raise ValueError(f"{path}: line {i + 2} has {len(row)} cells, the header {len(names)}; expected as many")
    return {name: [row[k].strip() for row in rows] for k, name in enumerate(names)}


def _read_parquet(path: Path) -> Table:
    parquet = package("pyarrow.parquet", "nocl[data]")
    try:
        table = parquet.read_table(path)
    except (OSError, ValueError) as error:  # pyarrow's own errors are ValueErrors
        raise ValueError(f"{path} cannot be read ({error}); expected a Parquet file") from None
    return {name: table.column(name).to_pylist() for name in table.column_names}
