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
from storage.checked_table import read_table, write_table
from storage.clock.bounds import Rows
from storage.clock.log import ClockOffset
from storage.clock.table import StreamFacts, check_rows

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
    """Write a session's clock measurements, with the facts about its streams as metadata.

    Raises:
        StorageError: the disk is full or not writable.
        OverflowError: a number does not fit an int64.
    """
    facts = [vars(stream) for stream in streams]
    columns = {name: [getattr(row, name) for row in rows] for name in _SCHEMA.names}
    schema = _SCHEMA.with_metadata({STREAMS_KEY: json.dumps(facts).encode()})
    write_table(path, pa.table(columns, schema=schema))


@dataclass(frozen=True)
class StoredClock:
    """Content of `clock.parquet`.

    Attributes:
        rows: measurements by stream_id.
        facts: facts about streams, by stream_id.
        is_proven: False: an older version wrote it without a hash.
    """

    rows: dict[str, Rows]
    facts: dict[str, StreamFacts]
    is_proven: bool

    @property
    def offsets(self) -> tuple[ClockOffset, ...]:
        """Measurements as single rows, stream by stream."""
        return tuple(
            ClockOffset(
                boot_id=boot_id,
                t_mono_ns=t_mono_ns,
                server_minus_node_ns=offset_ns,
                uncertainty_ns=uncertainty_ns,
            )
            for boot_id, rows in self.rows.items()
            for t_mono_ns, offset_ns, uncertainty_ns in zip(
                rows.t_mono_ns.tolist(),
                rows.offset_ns.tolist(),
                rows.uncertainty_ns.tolist(),
                strict=True,
            )
        )


def read_clock(path: Path) -> StoredClock:
    """Read `clock.parquet` and verify it.

    Raises:
        FileNotFoundError: there is no such file.
        FileFormatError: it is damaged, no clock table, or a row has impossible numbers.
    """
    read = read_table(path)
    try:
        table = read.table.select(_SCHEMA.names).cast(_SCHEMA)
        table.validate(full=True)
        metadata = read.table.schema.metadata or {}
        facts = _STREAMS.validate_json(metadata.get(STREAMS_KEY, b"[]"))
        boot_ids = np.asarray(table.column("boot_id").to_pylist(), dtype=object)
        arrays = [table.column(name).to_numpy() for name in _NUMBERS]
    except Exception as error:  # unproven bytes may cause any error
        raise DamagedFileError(
            f"cannot be read as a clock table: {' '.join(str(error).split())[:300]}",
            where=str(path),
            expected=f"columns boot_id, {', '.join(_NUMBERS)} without empty values",
        ) from error
    rows = {
        str(boot_id): Rows(*(values[boot_ids == boot_id] for values in arrays))
        for boot_id in dict.fromkeys(boot_ids.tolist())
    }
    for boot_id, own in rows.items():
        check_rows(own, boot_id, str(path))
    return StoredClock(rows, {stream.boot_id: stream for stream in facts}, read.is_proven)
