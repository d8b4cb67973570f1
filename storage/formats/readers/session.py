"""Reader of a sealed FootTile session as a table, on the session's clock."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from devices.errors import FileFormatError
from devices.input_files import check_regular_file
from storage.formats.readers.table import INSTANT_COLUMN, STANDARD_UNITS, ForceTable
from storage.parquet_hash import FORMAT_KEY
from storage.schema import ARRAY_INFO_KEY, COLUMNS_BY_NAME
from storage.sessions.reader import SealedFileReader
from storage.sessions.time_axis import NODE_AXIS, TimeAxis


def read_sealed_session_table(path: Path, optional_names: Collection[str]) -> ForceTable | None:
    """Read the standard and optional columns that a sealed session has; None for another file.

    Raises:
        FileFormatError: the session is damaged, or has no frames.
    """
    where = str(path)
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
        raise FileFormatError("the session has no frames", where=where)
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
        where, tuple(single), columns, units, frozenset(columns), epoch_ns=int(t_ns[0])
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
