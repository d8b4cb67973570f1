"""`clock.parquet` beside a session's frames: the measurements of its streams' clocks."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from pydantic import TypeAdapter

from devices.errors import DamagedFileError
from storage.clock.bounds import OffsetRows
from storage.clock.log import ClockOffset
from storage.clock.table import StreamClockFacts, check_rows_in_range
from storage.hashed_table import read_hashed_table, write_hashed_table

CLOCK_NAME = "clock.parquet"
STREAMS_KEY = b"foottile.streams"

_NUMBERS = ("t_mono_ns", "server_minus_node_ns", "uncertainty_ns")
_FIELDS: list[pa.Field[Any]] = [
    pa.field("stream_id", pa.string(), nullable=False),
    *(pa.field(name, pa.int64(), nullable=False) for name in _NUMBERS),
]
_SCHEMA = pa.schema(_FIELDS)


_STREAMS = TypeAdapter(tuple[StreamClockFacts, ...])


def write_clock_file(
    path: Path, rows: Sequence[ClockOffset], streams: Sequence[StreamClockFacts]
) -> None:
    """Write a session's clock measurements, with the facts about its streams as metadata.

    Raises:
        StorageError: the disk is full or not writable.
        OverflowError: a number does not fit an int64.
    """
    facts = [vars(stream) for stream in streams]
    columns = {name: [getattr(row, name) for row in rows] for name in _SCHEMA.names}
    schema = _SCHEMA.with_metadata({STREAMS_KEY: json.dumps(facts).encode()})
    write_hashed_table(path, pa.table(columns, schema=schema))


@dataclass(frozen=True)
class StoredClock:
    """Content of `clock.parquet`.

    Attributes:
        rows_by_stream: measurements by stream_id.
        facts: facts about streams, by stream_id.
    """

    rows_by_stream: dict[str, OffsetRows]
    facts: dict[str, StreamClockFacts]

    @property
    def offsets(self) -> tuple[ClockOffset, ...]:
        """Measurements as single rows, stream by stream."""
        return tuple(
            ClockOffset(
                stream_id=stream_id,
                t_mono_ns=t_mono_ns,
                server_minus_node_ns=offset_ns,
                uncertainty_ns=uncertainty_ns,
            )
            for stream_id, rows in self.rows_by_stream.items()
            for t_mono_ns, offset_ns, uncertainty_ns in zip(
                rows.t_mono_ns.tolist(),
                rows.offset_ns.tolist(),
                rows.uncertainty_ns.tolist(),
                strict=True,
            )
        )


def read_clock_file(path: Path) -> StoredClock:
    """Read `clock.parquet` and verify it.

    Raises:
        FileNotFoundError: there is no such file.
        FileFormatError: it is damaged, no clock table, or a row has impossible numbers.
    """
    stored = read_hashed_table(path)
    try:
        table = stored.select(_SCHEMA.names).cast(_SCHEMA)
        table.validate(full=True)
        facts = _STREAMS.validate_json((stored.schema.metadata or {})[STREAMS_KEY])
        stream_ids = np.asarray(table.column("stream_id").to_pylist(), dtype=object)
        arrays = [table.column(name).to_numpy() for name in _NUMBERS]
    except Exception as error:  # other content may cause any error
        raise DamagedFileError(
            f"cannot be read as a clock table: {' '.join(str(error).split())[:300]}",
            where=str(path),
            expected=f"columns stream_id, {', '.join(_NUMBERS)} without empty values",
        ) from error
    rows = {
        str(stream_id): OffsetRows(*(values[stream_ids == stream_id] for values in arrays))
        for stream_id in dict.fromkeys(stream_ids.tolist())
    }
    for stream_id, own in rows.items():
        check_rows_in_range(own, stream_id, str(path))
    return StoredClock(rows, {stream.stream_id: stream for stream in facts})
