"""Columns of numbers of a reference's file, whatever its format; nothing is converted here.

OpenSim's `.mot` and `.sto` are text: a header to the line `endheader`, a line of names, and rows of
numbers, with times in seconds, newtons and metres, and y upwards.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from io import StringIO
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet as pq

from devices.arrays import Floats
from devices.errors import FileFormatError
from devices.inputs import check_file, read_text
from storage.schema import KNOWN
from storage.sessions.reader import SessionReader

TEXT_BYTES_MAX = 256 << 20
NUMBERS_MAX = 50_000_000
"""Rows times columns that are read: 400 MB in memory."""
OURS = ("time_s", "grf_n", "fz_n", "cop_x_m", "cop_y_m")
"""Names that say unit and sign."""
SESSION_KEY = b"foottile.format"
CSV_FORM = "columns parted by commas, semicolons or tabs, a decimal point, names in the first line"


@dataclass(frozen=True)
class Table:
    """A file's columns.

    Attributes:
        where: the file.
        names: of all columns it has.
        columns: those that may be needed, (n,) each; an empty cell is NaN.
        si: names of columns whose unit, and sign, the file says to be ours.
        epoch_ns: UTC of time zero; None: not known.
        notes: what a user should know.
        form: what is expected of such a file, if files of its kind differ.
    """

    where: str
    names: tuple[str, ...]
    columns: Mapping[str, Floats]
    si: frozenset[str]
    epoch_ns: int | None = None
    notes: tuple[str, ...] = ()
    form: str = ""


def read_csv(path: Path, named: Collection[str]) -> Table:
    """A CSV file in UTF-8 with a header line; columns by commas, semicolons or tabs.

    Raises:
        FileFormatError: unreadable, too large, or a column that is needed is no number.
    """
    where = str(path)
    try:
        check_file(path, bytes_max=TEXT_BYTES_MAX)
        with path.open(encoding="utf-8-sig") as file:
            header = file.readline()
        parse = pyarrow.csv.ParseOptions(delimiter=max(",;\t", key=header.count))
        with pyarrow.csv.open_csv(path, parse_options=parse) as opened:
            names = tuple(opened.schema.names)
        wanted = _wanted(names, named, where)
        convert = pyarrow.csv.ConvertOptions(include_columns=wanted)
        table = pyarrow.csv.read_csv(path, parse_options=parse, convert_options=convert)
    except OSError as error:
        raise FileFormatError(f"cannot be read: {error}", where=where) from error
    except (pa.ArrowException, UnicodeDecodeError) as error:
        what = f"cannot be read: {error}"
        raise FileFormatError(what, where=where, expected=CSV_FORM) from error
    return _of_arrow(table, names, where, CSV_FORM)


def read_parquet(path: Path, named: Collection[str]) -> Table:
    """A Parquet file.

    Raises:
        FileFormatError: as for `read_csv`.
    """
    where = str(path)
    try:
        check_file(path)
        with pq.ParquetFile(path, page_checksum_verification=True) as file:
            names = tuple(file.schema_arrow.names)
            wanted = _wanted(names, named, where)
            _check_size(file.metadata.num_rows * len(wanted), where)
            table = file.read(columns=wanted)
    except (OSError, pa.ArrowException) as error:
        raise FileFormatError(f"cannot be read: {error}", where=where) from error
    return _of_arrow(table, names, where)


def read_session(path: Path, named: Collection[str]) -> Table | None:
    """A sealed session of ours, on its own clock; None: it is another kind of file.

    Raises:
        FileFormatError: it is damaged, or has no such column.
    """
    where = str(path)
    if not is_session(path):
        return None
    with SessionReader(path) as reader:
        single = [name for name in KNOWN if not KNOWN[name].per_tile and reader.has(name)]
        wanted = [name for name in ("t_ns", "part", *OURS, *sorted(named)) if name in single]
        pieces = list(reader.columns(*dict.fromkeys(wanted)))
        axis = reader.axis
    if not pieces:
        raise FileFormatError("the session has no frames", where=where)
    joined = {name: np.concatenate([piece[name] for piece in pieces]) for name in pieces[0]}
    t_ns = axis.at(joined.pop("t_ns"), joined.get("part"))
    if "part" not in named:
        joined.pop("part", None)
    columns = {name: values.astype(np.float64) for name, values in joined.items()}
    columns["time_s"] = (t_ns - t_ns[0]) * 1e-9
    return Table(where, tuple(single), columns, frozenset(columns), epoch_ns=int(t_ns[0]))


def is_session(path: Path) -> bool:
    """Is it a sealed session of ours, and no other kind of file?

    Raises:
        FileFormatError: it ends with .parquet, and cannot be read as that.
    """
    if path.suffix.lower() != ".parquet":
        return False
    try:
        check_file(path)
        return SESSION_KEY in (pq.read_schema(path).metadata or {})
    except (OSError, pa.ArrowException) as error:
        raise FileFormatError(f"cannot be read: {error}", where=str(path)) from error


def read_opensim(path: Path, named: Collection[str]) -> Table:
    """A `.mot` or `.sto` file of ground reactions.

    Raises:
        FileFormatError: it has no header, or rows that are no numbers.
    """
    where = str(path)
    try:
        lines = read_text(path, bytes_max=TEXT_BYTES_MAX).splitlines()
        end = next(i for i, line in enumerate(lines) if line.strip().lower() == "endheader")
        names = tuple(lines[end + 1].split())
        rows = np.loadtxt(StringIO("\n".join(lines[end + 2 :])), ndmin=2, dtype=np.float64)
    except (OSError, UnicodeDecodeError) as error:
        raise FileFormatError(f"cannot be read: {error}", where=where) from error
    except (StopIteration, IndexError, ValueError) as error:
        raise FileFormatError(
            f"no table of OpenSim: {str(error) or 'no line `endheader`'}",
            where=where,
            expected="a header to `endheader`, a line of names, rows of numbers",
        ) from error
    if rows.size and rows.shape[1] != len(names):
        raise FileFormatError(
            f"{len(names)} names over {rows.shape[1]} columns of numbers", where=where
        )
    columns = {name: rows[:, i] if rows.size else np.empty(0) for i, name in enumerate(names)}
    if "time" in columns:
        columns["time_s"] = columns["time"]
    # OpenSim's own units; its forces are those of the ground on the body, upwards.
    si = {name for name in names if "_v" in name or "_p" in name}
    return Table(where, names, columns, frozenset(si | (set(OURS) & set(names))))


def _wanted(names: Collection[str], named: Collection[str], where: str) -> list[str]:
    if len(set(names)) < len(names):
        twice = sorted({name for name in names if list(names).count(name) > 1})
        raise FileFormatError(
            f"column {', '.join(name or 'without a name' for name in twice)} is there twice",
            where=where,
            expected="a name of its own for each column",
        )
    return [name for name in names if name in named or name in OURS]


def _check_size(numbers: int, where: str) -> None:
    if numbers > NUMBERS_MAX:
        raise FileFormatError(
            f"{numbers} numbers are too many to be held in memory",
            where=where,
            expected=f"up to {NUMBERS_MAX}",
        )


def _of_arrow(table: pa.Table, names: tuple[str, ...], where: str, form: str = "") -> Table:
    _check_size(table.num_rows * table.num_columns, where)
    columns = {}
    for name in table.column_names:
        try:
            columns[name] = np.asarray(table[name].cast(pa.float64()).to_numpy(), dtype=np.float64)
        except pa.ArrowException as error:
            raise FileFormatError(
                f"column {name!r} is not numeric: {error}", where=where, expected=form
            ) from error
    if "fz_n" in columns and "grf_n" not in columns:
        columns["grf_n"] = columns["fz_n"]
    si = frozenset(name for name in OURS if name in columns)
    return Table(where, names, columns, si, form=form)
