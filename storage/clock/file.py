"""`clock.parquet`: the measurements of a sealed session's clocks, and facts of its streams."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from pydantic import TypeAdapter, ValidationError

from devices.errors import FileFormatError, UsageError
from storage.clock.bounds import Rows
from storage.clock.table import ClockTable, StreamFacts
from storage.sessions.events import write_table
from storage.sessions.file import SessionReader
from storage.sessions.folder import ClockOffset

CLOCK_NAME = "clock.parquet"
STREAMS_KEY = b"foottile.streams"

_NUMBERS = ("t_mono_ns", "server_minus_node_ns", "uncertainty_ns")
_FIELDS: list[pa.Field[Any]] = [
    pa.field("boot_id", pa.string(), nullable=False),
    *(pa.field(name, pa.int64(), nullable=False) for name in _NUMBERS),
]
_SCHEMA = pa.schema(_FIELDS)


_STREAMS = TypeAdapter(tuple[StreamFacts, ...])


def write_clock(path: Path, rows: Sequence[ClockOffset], streams: Sequence[StreamFacts]) -> None:
    """Write a session's clock rows, and what is known of its streams into the metadata.

    Raises:
        StorageError: the disk is full or not writable.
        OverflowError: a number does not fit an int64.
    """
    columns = {name: [getattr(row, name) for row in rows] for name in _SCHEMA.names}
    schema = _SCHEMA.with_metadata({STREAMS_KEY: _STREAMS.dump_json(tuple(streams))})
    write_table(pa.table(columns, schema=schema), path)


def read_clock(path: Path) -> tuple[dict[str, Rows], dict[str, StreamFacts]]:
    """Rows and facts of streams, by boot_id.

    Raises:
        FileFormatError: it cannot be read, or is no clock table.
    """
    try:
        with pq.ParquetFile(path) as file:
            table = file.read()
        table = table.select(_SCHEMA.names).cast(_SCHEMA)
        said = file.schema_arrow.metadata or {}
        facts = _STREAMS.validate_json(said.get(STREAMS_KEY, b"[]"))
    except (OSError, ValueError, KeyError, ValidationError, pa.ArrowException) as error:
        raise FileFormatError(
            f"cannot be read as a clock table: {error}",
            where=str(path),
            expected=f"columns boot_id, {', '.join(_NUMBERS)} without empty values",
        ) from error
    boot_ids = np.asarray(table.column("boot_id").to_pylist(), dtype=object)
    arrays = [table.column(name).to_numpy() for name in _NUMBERS]
    rows = {
        str(boot_id): Rows(*(values[boot_ids == boot_id] for values in arrays))
        for boot_id in dict.fromkeys(boot_ids.tolist())
    }
    return rows, {stream.boot_id: stream for stream in facts}


def clock_beside(reader: SessionReader) -> ClockTable:
    """The clock table that lies beside a sealed session's frames.

    Raises:
        UsageError: there is none.
        FileFormatError: it is damaged, or the session's notes are.
    """
    path = reader.path.with_name(CLOCK_NAME)
    if not path.is_file():
        raise UsageError(
            f"there is no {CLOCK_NAME} beside {reader.path.name}, so the server's time is unknown",
            where=str(reader.path.parent),
            expected="a session's folder as a server sealed it",
            remedy="Leave the clock at `node`, or fetch the session's folder whole",
        )
    rows, facts = read_clock(path)
    info = reader.info
    facts.setdefault(info.boot_id, StreamFacts(info.boot_id, info.utc_offset_ns, info.clock_set))
    parts = _parts(reader)
    streams = [facts.get(boot_id, StreamFacts(boot_id)) for boot_id in dict.fromkeys(parts)]
    return ClockTable(rows, streams, parts, where=str(path))


def _parts(reader: SessionReader) -> list[str]:
    """Streams by number of part; a file that was never recorded is of one."""
    session = reader.notes.get("session")
    if session is None:
        return [reader.info.boot_id]
    try:
        return [str(part["boot_id"]) for part in session["parts"]]
    except (TypeError, KeyError) as error:
        raise FileFormatError(
            "its notes do not say which streams it is of", where=str(reader.path)
        ) from error
