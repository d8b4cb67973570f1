"""Readers of Parquet files: sealed FootTile sessions, exports, files of other programs."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from devices.errors import FileFormatError
from devices.input_files import check_regular_file
from storage.formats.readers.table import (
    INSTANT_COLUMN,
    STANDARD_UNITS,
    Column,
    ColumnFilter,
    ForceTable,
    check_table_size,
    make_table_with_lowercase_standard_names,
    select_needed_names_or_empty,
)
from storage.formats.readers.text import arrow_to_floats
from storage.parquet_hash import (
    FORMAT_KEY,
    read_stated_and_actual_hash,
    refuse_wrong_or_missing_file_hash,
)
from storage.schema import ARRAY_INFO_KEY, COLUMNS_BY_NAME
from storage.sessions.reader import SealedFileReader
from storage.sessions.time_axis import NODE_AXIS, TimeAxis


def read_parquet_table(path: Path, is_needed: ColumnFilter, values_max: int) -> ForceTable:
    """Read the needed columns of a Parquet file; verify the hash of a FootTile session.

    Raises:
        OSError, pa.ArrowException, UnicodeDecodeError: the file cannot be read.
        FileFormatError: it is too large, or a needed column is not numeric.
        DamagedFileError: the file is a session whose bytes differ from the sealed ones.
    """
    check_regular_file(path)
    with pq.ParquetFile(path, page_checksum_verification=True) as file:
        schema = file.schema_arrow
        hashes = read_stated_and_actual_hash(path)
        if hashes is not None or FORMAT_KEY in (schema.metadata or {}):
            refuse_wrong_or_missing_file_hash(hashes, where=str(path))
        needed = select_needed_names_or_empty(schema.names, is_needed)
        check_table_size(file.metadata.num_rows, len(needed), values_max)
        table = file.read(columns=needed)
    columns = {name: _to_numbers(table[name], name) for name in needed}
    return make_table_with_lowercase_standard_names(schema.names, columns, schema=schema)


def _to_numbers(cells: pa.ChunkedArray[Any], name: str) -> Column:
    if name.lower() == INSTANT_COLUMN and pa.types.is_integer(cells.type) and not cells.null_count:
        return np.asarray(cells.to_numpy(), dtype=np.int64)
    try:
        return arrow_to_floats(cells.cast(pa.float64()).combine_chunks())
    except pa.ArrowException as error:
        raise FileFormatError(
            f"column {name} is not numeric: {error}", expected="numbers"
        ) from error


def read_sealed_session_table(path: Path, optional_names: Collection[str]) -> ForceTable | None:
    """Read the standard and optional columns that a sealed session has; None for another file.

    Raises:
        FileFormatError: the session is damaged, or has no frames.
    """
    if not is_sealed_session_file(path):
        return None
    with SealedFileReader(path) as reader:
        single = [
            name
            for name in COLUMNS_BY_NAME
            if not COLUMNS_BY_NAME[name].per_tile and reader.has_columns(name)
        ]
        wanted = [
            name
            for name in (INSTANT_COLUMN, "part", *STANDARD_UNITS, *sorted(optional_names))
            if name in single
        ]
        pieces = list(reader.read_quantities(*dict.fromkeys(wanted)))
        axis = reader.time_axis
    if not pieces:
        raise FileFormatError("the session has no frames", where=str(path))
    joined = {name: np.concatenate([piece[name] for piece in pieces]) for name in pieces[0]}
    t_ns = axis.shift_to_axis(joined.pop(INSTANT_COLUMN), joined.get("part"))
    if "part" not in optional_names:
        joined.pop("part", None)
    columns = {name: values.astype(np.float64) for name, values in joined.items()}
    columns["time_s"] = (t_ns - t_ns[0]) * 1e-9
    units = {
        name: unit
        for name in columns
        if (unit := STANDARD_UNITS.get(name) or COLUMNS_BY_NAME[name].unit)
    }
    return ForceTable(
        tuple(single), columns, units, frozenset(columns), epoch_ns=int(t_ns[0]), where=str(path)
    )


def read_time_axis_or_node_axis(path: Path) -> TimeAxis:
    """Return the time axis of a sealed session; for another file the node's axis, not shifted.

    Raises:
        FileFormatError: the session is damaged.
    """
    if not is_sealed_session_file(path):
        return NODE_AXIS
    with SealedFileReader(path) as reader:
        return reader.time_axis


def is_sealed_session_file(path: Path) -> bool:
    """Return whether a file is a sealed FootTile session.

    Raises:
        FileFormatError: the file ends with .parquet and cannot be read as Parquet.
    """
    if path.suffix.lower() != ".parquet":
        return False
    try:
        check_regular_file(path)
        # Markers, clocks and stances have the format too; tiles are a session's alone.
        return {FORMAT_KEY, ARRAY_INFO_KEY} <= (pq.read_schema(path).metadata or {}).keys()
    except (OSError, pa.ArrowException) as error:
        raise FileFormatError(f"cannot be read: {error}", where=str(path)) from error
