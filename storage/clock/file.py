"""`clock.parquet`: the measurements of a sealed session's clocks, and facts of its streams."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from pydantic import TypeAdapter, ValidationError

from devices.errors import FileFormatError
from storage.clock.bounds import Rows
from storage.clock.log import ClockOffset
from storage.clock.table import StreamFacts
from storage.durable import write_whole

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
    facts = [vars(stream) for stream in streams]
    columns = {name: [getattr(row, name) for row in rows] for name in _SCHEMA.names}
    schema = _SCHEMA.with_metadata({STREAMS_KEY: json.dumps(facts).encode()})
    sink = pa.BufferOutputStream()
    pq.write_table(pa.table(columns, schema=schema), sink, compression="zstd")
    write_whole(path, sink.getvalue().to_pybytes())


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
