"""Reader of a sealed FootTile session as a table, on the session's clock."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from devices.errors import FileFormatError
from devices.inputs import check_file
from storage.formats.tables.table import INSTANTS, OURS, Table
from storage.schema import KNOWN
from storage.sessions.reader import SessionReader
from storage.sessions.time_axis import NODE_AXIS, TimeAxis

SESSION_KEY = b"foottile.format"


def read_session(path: Path, named: Collection[str]) -> Table | None:
    """Read a sealed FootTile session; return None for another kind of file.

    Raises:
        FileFormatError: the session is damaged, or has no frames.
    """
    where = str(path)
    if not is_session(path):
        return None
    with SessionReader(path) as reader:
        single = [name for name in KNOWN if not KNOWN[name].per_tile and reader.has(name)]
        wanted = [name for name in (INSTANTS, "part", *OURS, *sorted(named)) if name in single]
        pieces = list(reader.columns(*dict.fromkeys(wanted)))
        axis = reader.axis
    if not pieces:
        raise FileFormatError("the session has no frames", where=where)
    joined = {name: np.concatenate([piece[name] for piece in pieces]) for name in pieces[0]}
    t_ns = axis.at(joined.pop(INSTANTS), joined.get("part"))
    if "part" not in named:
        joined.pop("part", None)
    columns = {name: values.astype(np.float64) for name, values in joined.items()}
    columns["time_s"] = (t_ns - t_ns[0]) * 1e-9
    units = {name: unit for name in columns if (unit := OURS.get(name) or KNOWN[name].unit)}
    return Table(where, tuple(single), columns, units, frozenset(columns), epoch_ns=int(t_ns[0]))


def read_axis(path: Path) -> TimeAxis:
    """Return the time axis of a sealed session; for another file the node's axis, not shifted.

    Raises:
        FileFormatError: the session is damaged.
    """
    if not is_session(path):
        return NODE_AXIS
    with SessionReader(path) as reader:
        return reader.axis


def is_session(path: Path) -> bool:
    """Return whether a file is a sealed FootTile session.

    Raises:
        FileFormatError: the file ends with .parquet and cannot be read as Parquet.
    """
    if path.suffix.lower() != ".parquet":
        return False
    try:
        check_file(path)
        return SESSION_KEY in (pq.read_schema(path).metadata or {})
    except (OSError, pa.ArrowException) as error:
        raise FileFormatError(f"cannot be read: {error}", where=str(path)) from error
