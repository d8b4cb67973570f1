"""Table of the foot segment's angle over time, as Parquet or CSV with a line of names.

| column | content |
|---|---|
| `film_s` | instant in s from the film's first picture |
| `t_ns` | instant in the session's time, ns; `sigma_ns` its standard deviation, if known |
| `angle_rad` | angle, positive as the foot rolls forward; empty where unknown |
| `sigma_rad` | standard deviation of the angle |
| `angle_source` | what measured it; without this column "video" |

One of `film_s` and `t_ns` is there. Other columns, such as the markers' places, are not read.
"""

from __future__ import annotations

import io
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet as pq

from devices.arrays import Bools, Floats, Times
from devices.errors import FileFormatError, UsageError
from devices.input_files import read_bytes
from storage.durable_files import write_atomically

ANGLE_NAME = "angle.parquet"
"""Name of the table beside its film."""
SUFFIXES = (".parquet", ".csv")
UNKNOWN_ANGLE, VIDEO = "none", "video"
"""Values of `angle_source`."""
_BYTES_MAX = 1 << 30
_TYPES: Mapping[str, pa.DataType] = {
    "film_s": pa.float64(),
    "t_ns": pa.int64(),
    "sigma_ns": pa.float64(),
    "angle_rad": pa.float64(),
    "sigma_rad": pa.float64(),
    "angle_source": pa.string(),
}


@dataclass(frozen=True)
class AngleTable:
    """Angle at n instants, rising; see the module.

    Attributes:
        angle_rad: (n,), NaN where unknown.
        sigma_rad: (n,).
        film_s: (n,); None: not stated.
        t_ns: (n,); None: not stated.
        sigma_ns: (n,); None: the instants are exact.
        angle_source: (n,), texts.
    """

    angle_rad: Floats
    sigma_rad: Floats
    film_s: Floats | None = None
    t_ns: Times | None = None
    sigma_ns: Floats | None = None
    angle_source: npt.NDArray[np.str_] | None = None

    def write(self, path: Path, others: Mapping[str, Floats] | None = None) -> None:
        """Write the table and other columns; the suffix names the format.

        Raises:
            UsageError: another suffix.
            StorageError: the disk is full or not writable.
        """
        check_suffix(path)
        columns = {name: getattr(self, name) for name in _TYPES} | dict(others or {})
        table = pa.table(
            {
                name: pa.array(values, _TYPES.get(name, pa.float64()), from_pandas=True)
                for name, values in columns.items()
                if values is not None
            }
        )
        file = io.BytesIO()
        if path.suffix == ".csv":
            pyarrow.csv.write_csv(table, file)
        else:
            pq.write_table(table, file)
        write_atomically(path, file.getvalue())


def check_suffix(path: Path) -> None:
    """Refuse a path of another format.

    Raises:
        UsageError: its suffix is none of `SUFFIXES`.
    """
    if path.suffix not in SUFFIXES:
        raise UsageError(
            f"{str(path)!r} is no table", expected=f"a file in {' or '.join(SUFFIXES)}"
        )


def read_angle_table(path: Path) -> AngleTable:
    """Read a table of angles.

    Raises:
        FileFormatError: unreadable, a column is missing, times do not rise, or an angle is not in
            rad or has no uncertainty.
        UsageError: its suffix is of another format.
    """
    check_suffix(path)
    try:
        content = read_bytes(path, bytes_max=_BYTES_MAX)
        table = _parse(content, is_csv=path.suffix == ".csv")
        columns: dict[str, Any] = {
            name: table[name].combine_chunks().to_numpy(zero_copy_only=False)
            for name in table.column_names
        }
        return _check(columns)
    except FileFormatError as error:
        raise FileFormatError(error.what, where=str(path), expected=error.expected) from error
    except (OSError, pa.ArrowException) as error:
        raise FileFormatError(
            f"cannot be read as a table of angles: {error}",
            where=str(path),
            expected="the columns film_s or t_ns, angle_rad, sigma_rad",
        ) from error


def _parse(content: bytes, *, is_csv: bool) -> pa.Table:
    source: Any = pa.BufferReader(content)  # its stubs know no buffers
    if is_csv:
        table = pyarrow.csv.read_csv(
            source,
            read_options=pyarrow.csv.ReadOptions(use_threads=False),  # errors then name the row
            convert_options=pyarrow.csv.ConvertOptions(column_types=dict(_TYPES)),
        )
    else:
        table = pq.read_table(source)
    names = [name for name in _TYPES if name in table.column_names]
    twice = [name for name in names if table.column_names.count(name) > 1]
    if twice:
        raise FileFormatError(f"column {twice[0]} is there twice", expected="each column once")
    missing = {"angle_rad", "sigma_rad"} - set(names)
    if missing or not {"film_s", "t_ns"} & set(names):
        raise FileFormatError(
            f"column {', '.join(sorted(missing)) or 'film_s'} is missing",
            expected="the columns film_s or t_ns, angle_rad, sigma_rad",
        )
    table = table.select(names)
    if "t_ns" in names and table["t_ns"].null_count:
        table = table.drop_columns(["t_ns"]) if "film_s" in names else table
    return table.cast(pa.schema([(name, _TYPES[name]) for name in table.column_names]))


def _check(columns: dict[str, Any]) -> AngleTable:
    def refuse(is_wrong: Bools, problem: str, expected: str) -> None:
        if is_wrong.any():
            row = int(np.argmax(is_wrong)) + 1
            raise FileFormatError(f"{problem} in row {row} of its numbers", expected=expected)

    angle_rad, sigma_rad = columns["angle_rad"], columns["sigma_rad"]
    is_known = ~np.isnan(angle_rad)
    for name in ("film_s", "t_ns"):
        if name in columns:
            times = columns[name]
            refuse(~np.isfinite(times), f"{name} is empty", "an instant in each row")
            falls = np.diff(times, prepend=times[:1] - 1) <= 0
            refuse(falls, f"{name} does not rise", "rows in order of time, each instant once")
    is_beyond = np.abs(angle_rad) > math.pi / 2.0
    refuse(is_beyond, "the angle is beyond a quarter of a turn", "radians, not degrees")
    refuse(
        is_known & ~(np.isfinite(sigma_rad) & (sigma_rad > 0.0)),
        "sigma_rad is no uncertainty",
        "the standard deviation of angle_rad, above 0",
    )
    if is_known.sum() < 2:
        raise FileFormatError("it has less than two angles", expected="the angle of each picture")
    return AngleTable(**columns)
