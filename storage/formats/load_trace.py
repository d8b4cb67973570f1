"""Reads a recorded load from CSV or Parquet, and refuses what cannot be one.

Columns, whatever their case: `time_s`, and either `fz_n, cop_x_m, cop_y_m` or one force per tile,
`cell1_n, cell2_n, ...`; optionally `angle_rad`. Others are ignored. A session of ours, sealed or
exported, has `t_ns` instead, and is translated (`storage.formats.session_load`).
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
from devices.errors import DamagedFileError, LoadTraceError
from devices.inputs import check_file
from storage.file_hash import check_hash, file_hashes
from storage.formats.session_load import SESSION_COLUMN, as_load, is_session

CSV_BYTES_MAX = 256 << 20
NUMBERS_MAX = 20_000_000
"""Rows times columns: an hour of eight cells at 500 rows a second, and 160 MB in memory."""

NUMBER_MAX = 1e9
"""More than any second, newton or metre can be."""

_COLUMN = re.compile(r"time_s|fz_n|cop_[xy]_m|angle_rad|cell\d+_n")
"""A pattern of those that are read."""

_UNITS = {"time": "time_s", "fz": "fz_n", "cop_x": "cop_x_m", "cop_y": "cop_y_m"}


def read_load_trace(path: Path) -> LoadTrace:
    """Read a load trace.

    Raises:
        LoadTraceError: unreadable, a session whose bytes are not those that were sealed, a column
            is missing or in another unit, times do not rise, or a force is not a number.
    """
    where = str(path)
    columns, names = _read(path)

    def numbers(name: str, *, may_be_empty: bool = False) -> npt.NDArray[np.float64]:
        return _numbers(columns, names, name, where, may_be_empty=may_be_empty)

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
            f"no load in its columns ({', '.join(names)})",
            where=where,
            expected=_other_unit(names, "fz_n") or "fz_n, or cell1_n, cell2_n, ...",
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


Columns = dict[str, "pa.ChunkedArray[pa.Scalar[pa.DataType]]"]


def _read(path: Path) -> tuple[Columns, list[str]]:
    """The columns of a trace, and the names of all that the file has, in lower case."""
    where = str(path)
    try:
        is_parquet = path.suffix.lower() == ".parquet"
        check_file(path, bytes_max=None if is_parquet else CSV_BYTES_MAX)
        if is_parquet:
            with pyarrow.parquet.ParquetFile(path, page_checksum_verification=True) as file:
                check_hash(file_hashes(path), file.schema_arrow.metadata or {}, where=where)
                names, rows = file.schema_arrow.names, file.metadata.num_rows
                wanted = _wanted(names, where)
                _check_size(rows, len(wanted), where)
                table = file.read(columns=wanted)
        else:
            with pyarrow.csv.open_csv(path) as file:
                names = file.schema.names
            wanted = _wanted(names, where)
            convert = pyarrow.csv.ConvertOptions(include_columns=wanted)
            table = pyarrow.csv.read_csv(path, convert_options=convert)
            _check_size(len(table), len(wanted), where)
    except DamagedFileError as error:
        raise LoadTraceError(error.what, where=where, remedy=error.remedy) from error
    except (OSError, pa.ArrowException, UnicodeDecodeError) as error:
        raise LoadTraceError(
            f"cannot be read: {error}",
            where=where,
            expected="a CSV file in UTF-8 with a header line, or a Parquet file",
        ) from error
    columns: Columns = dict(zip([name.lower() for name in wanted], table.columns, strict=True))
    known = [name.lower() for name in names]
    if is_session(known):
        columns = as_load(columns, table.schema, where=where)
    return columns, [*known, *columns]


def _wanted(names: list[str], where: str) -> list[str]:
    """Those that are read."""
    known = [name.lower() for name in names]
    pattern = SESSION_COLUMN if is_session(known) else _COLUMN
    wanted = [name for name in names if pattern.fullmatch(name.lower())]
    lower = [name.lower() for name in wanted]
    if twice := sorted({name for name in lower if lower.count(name) > 1}):
        raise LoadTraceError(
            f"column {', '.join(twice)} is there twice, whatever its case", where=where
        )
    if not wanted:
        raise LoadTraceError(
            f"no load in its columns ({', '.join(names)[:200]})",
            where=where,
            expected=_other_unit(known, "time_s") or "time_s, and fz_n or cell1_n, cell2_n, ...",
        )
    return wanted


def _check_size(rows: int, columns: int, where: str) -> None:
    if rows * columns > NUMBERS_MAX:
        raise LoadTraceError(
            f"{rows} rows of {columns} columns are too many to be held in memory",
            where=where,
            expected=f"up to {NUMBERS_MAX} numbers",
            remedy="Cut out the part that is to be pressed",
        )


def _numbers(
    columns: Columns, names: list[str], name: str, where: str, *, may_be_empty: bool
) -> npt.NDArray[np.float64]:
    if name not in columns:
        raise LoadTraceError(
            f"column {name} is missing (it has {', '.join(names)})",
            where=where,
            expected=_other_unit(names, name) or name,
        )
    column = columns[name]
    try:
        values = column.cast(pa.float64()).to_numpy().astype(np.float64)
    except pa.ArrowException as error:
        raise LoadTraceError(f"column {name} is not numeric: {error}", where=where) from error
    bad = ~(np.abs(values) < NUMBER_MAX)  # NaN too
    if may_be_empty:
        bad &= ~np.isnan(values)
    if bad.any():
        row = int(np.flatnonzero(bad)[0])
        raise LoadTraceError(
            f"column {name} is {values[row]:g} at row {row + 1}",
            where=where,
            expected=f"a number below {NUMBER_MAX:g} in every row",
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
