"""Sidecar files of a session's frames: markers and the clock table."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import pyarrow as pa
from pydantic import TypeAdapter

from devices.errors import DamagedFileError, FileFormatError, UsageError
from storage.checked_table import read_table, write_table
from storage.clock.file import CLOCK_NAME, read_clock
from storage.clock.table import ClockTable, StreamFacts
from storage.sessions.folder import Event, Session

if TYPE_CHECKING:
    from storage.sessions.reader import SessionReader

EVENTS_NAME = "events.parquet"


def write_events(session: Session, folder: Path) -> None:
    """Write `events.parquet` into the session's folder; an existing one is replaced.

    Raises:
        StorageError: the disk is full or not writable.
    """
    events = session.events
    columns = {
        "id": pa.array([event.id for event in events], pa.string()),
        "label": pa.array([event.label for event in events], pa.string()),
        "t_ns": pa.array([event.t_ns for event in events], pa.int64()),
    }
    write_table(folder / EVENTS_NAME, pa.table(columns))


@dataclass(frozen=True)
class StoredEvents:
    """Content of `events.parquet`."""

    events: tuple[Event, ...]
    is_proven: bool
    """False: an older version wrote it without a hash."""


def read_events(path: Path) -> StoredEvents:
    """Read `events.parquet` and verify its hash.

    Raises:
        FileNotFoundError: there is no such file.
        DamagedFileError: its hash is wrong, or it is no table of markers.
        StorageError: it cannot be read now.
    """
    read = read_table(path)
    try:
        events = TypeAdapter(tuple[Event, ...]).validate_python(read.table.to_pylist())
    except Exception as error:  # unproven bytes may cause any error
        raise DamagedFileError(
            f"cannot be read as a table of events: {' '.join(str(error).split())[:300]}",
            where=str(path),
            expected="columns id, label, t_ns without empty values",
        ) from error
    return StoredEvents(events, read.is_proven)


def clock_beside(reader: SessionReader) -> ClockTable:
    """Load the clock table in the folder of a sealed session's frames.

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
    stored, info = read_clock(path), reader.info
    facts = dict(stored.facts)
    facts.setdefault(info.boot_id, StreamFacts(info.boot_id, info.utc_offset_ns, info.clock_set))
    parts = stream_ids(reader)
    streams = [facts.get(boot_id, StreamFacts(boot_id)) for boot_id in dict.fromkeys(parts)]
    return ClockTable(stored.rows, streams, parts, where=str(path))


def stream_ids(reader: SessionReader) -> list[str]:
    """Return the stream ids by number of part; a file that was never recorded has one part.

    Raises:
        FileFormatError: the session's notes are damaged.
    """
    session = reader.notes.get("session")
    if session is None:
        return [reader.info.boot_id]
    try:
        return [str(part["boot_id"]) for part in session["parts"]]
    except (TypeError, KeyError) as error:
        raise FileFormatError(
            "its notes do not say which streams it is of", where=str(reader.path)
        ) from error
