"""Reads a recorded load from CSV or Parquet, and refuses what cannot be one.

Columns, whatever their case: `time_s`, and either `fz_n, cop_x_m, cop_y_m` or one force per tile,
`cell1_n, cell2_n, ...`; optionally `angle_rad`. Others are ignored.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet

from devices.emulation.ground.load_trace import LoadTrace
from devices.errors import LoadTraceError

_UNITS = {"time": "time_s", "fz": "fz_n", "cop_x": "cop_x_m", "cop_y": "cop_y_m"}


def read_load_trace(path: Path) -> LoadTrace:
    """Read a load trace.

    Raises:
        LoadTraceError: unreadable, a column is missing or in another unit, times do not rise, or a
            force is not a number.
    """
    table = _read_table(path)
    where = str(path)
    names = [name.lower() for name in table.column_names]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise LoadTraceError(
            f"column {', '.join(twice)} is there twice, whatever its case", where=where
        )
    columns = dict(zip(names, table.columns, strict=True))

    def numbers(name: str, *, may_be_empty: bool = False) -> npt.NDArray[np.float64]:
        return _numbers(columns, name, where, may_be_empty=may_be_empty)

    time_s = numbers("time_s")
    if len(time_s) < 2:
        raise LoadTraceError(f"{len(time_s)} rows", where=where, expected="at least two")
    steps = np.flatnonzero(np.diff(time_s) <= 0.0)
    if len(steps):
        row = int(steps[0])
        raise LoadTraceError(
            f"time_s goes from {time_s[row]:g} to {time_s[row + 1]:g} at row {row + 2}",
            where=where,
            expected="times that rise from row to row",
            remedy="Sort the rows and remove repeated ones",
        )
    cells = sorted(
        (int(match[1]), name) for name in columns if (match := re.fullmatch(r"cell(\d+)_n", name))
    )
    if cells and [number for number, _ in cells] != list(range(1, len(cells) + 1)):
        raise LoadTraceError(
            f"cell columns are numbered {', '.join(str(number) for number, _ in cells)}",
            where=where,
            expected="cell1_n, cell2_n, ... without a gap",
        )
    has_total = "fz_n" in columns
    if not cells and not has_total:
        raise LoadTraceError(
            f"no load in its columns ({', '.join(table.column_names)})",
            where=where,
            expected=_other_unit(columns, "fz_n") or "fz_n, or cell1_n, cell2_n, ...",
        )
    fz_n = numbers("fz_n") if has_total else None
    cells_n = np.stack([numbers(name) for _, name in cells], axis=1) if cells else None
    pressed_n = cells_n if cells_n is not None else fz_n
    if pressed_n is not None and pressed_n.sum() < 0.0:
        raise LoadTraceError(
            "the load is mostly negative",
            where=where,
            expected="the force of the ground on the foot, positive under load",
            remedy="Change its sign",
        )
    cop_m = None
    if has_total and not cells:
        cop_m = np.stack(
            [numbers("cop_x_m", may_be_empty=True), numbers("cop_y_m", may_be_empty=True)], axis=1
        )
    return LoadTrace(
        where=where,
        time_s=time_s,
        cells_n=cells_n,
        fz_n=fz_n,
        cop_m=cop_m,
        angle_rad=numbers("angle_rad") if "angle_rad" in columns else None,
    )


def _read_table(path: Path) -> pa.Table:
    try:
        if path.suffix.lower() == ".parquet":
            table = pyarrow.parquet.read_table(path)
        else:
            table = pyarrow.csv.read_csv(path)
        _ = table.column_names  # decoded only here
    except (OSError, pa.ArrowException, UnicodeDecodeError) as error:
        raise LoadTraceError(
            f"cannot be read: {error}",
            where=str(path),
            expected="a CSV file in UTF-8 with a header line, or a Parquet file",
        ) from error
    return table


def _numbers(
    columns: dict[str, pa.ChunkedArray[pa.Scalar[pa.DataType]]],
    name: str,
    where: str,
    *,
    may_be_empty: bool,
) -> npt.NDArray[np.float64]:
    if name not in columns:
        raise LoadTraceError(
            f"column {name} is missing (it has {', '.join(columns)})",
            where=where,
            expected=_other_unit(columns, name) or name,
        )
    column = columns[name]
    try:
        values = column.cast(pa.float64()).to_numpy().astype(np.float64)
    except pa.ArrowException as error:
        raise LoadTraceError(f"column {name} is not numeric: {error}", where=where) from error
    bad = np.isinf(values) if may_be_empty else ~np.isfinite(values)
    if bad.any():
        row = int(np.flatnonzero(bad)[0])
        raise LoadTraceError(
            f"column {name} is {values[row]:g} at row {row + 1}",
            where=where,
            expected="a finite number in every row",
            remedy="Cut the row out, or fill it from its neighbours on purpose",
        )
    return values


def _other_unit(columns: Iterable[str], name: str) -> str:
    """What to say if the quantity is there under another unit's name."""
    stem = next((stem for stem, full in _UNITS.items() if full == name), None)
    for other in columns:
        if stem is not None and re.fullmatch(rf"{stem}(_[a-z]+)?", other):
            return f"{name}, converted from {other!r}: units are SI and part of the name"
    return ""
