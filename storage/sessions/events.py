"""`events.parquet`: what people marked in a session, beside its frames."""

from __future__ import annotations

from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from storage.durable import write_whole
from storage.sessions.folder import Session

EVENTS_NAME = "events.parquet"


def write_events(session: Session, folder: Path) -> None:
    """Write `events.parquet` into the session's folder, in place of the one that is there.

    Raises:
        StorageError: the disk is full or not writable.
    """
    events = session.events
    columns = {
        "id": pa.array([event.id for event in events], pa.string()),
        "label": pa.array([event.label for event in events], pa.string()),
        "t_ns": pa.array([event.t_ns for event in events], pa.int64()),
    }
    sink = pa.BufferOutputStream()
    pq.write_table(pa.table(columns), sink, compression="zstd")
    write_whole(folder / EVENTS_NAME, sink.getvalue().to_pybytes())
