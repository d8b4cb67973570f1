"""`events.parquet`: what people marked in a session, beside its frames."""

from __future__ import annotations

from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from devices.errors import FileFormatError, UsageError
from storage.clock.file import CLOCK_NAME, read_clock
from storage.clock.table import ClockTable, StreamFacts
from storage.durable import write_whole
from storage.sessions.file import SessionReader
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
