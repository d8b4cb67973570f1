"""Sidecar files of a session's frames: markers and the clock table."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import pyarrow as pa
from pydantic import TypeAdapter

from devices.errors import DamagedFileError, FileFormatError, UsageError
from storage.clock.file import CLOCK_NAME, read_clock_file
from storage.clock.table import ClockTable, StreamClockFacts
from storage.hashed_table import read_hashed_table, write_hashed_table
from storage.sessions.folder import Marker, Session

if TYPE_CHECKING:
    from storage.sessions.reader import SealedFileReader

MARKERS_NAME = "markers.parquet"


def write_markers(session: Session, folder: Path) -> None:
    """Write `markers.parquet` into the session's folder; an existing one is replaced.

    Raises:
        StorageError: the disk is full or not writable.
    """
    events = session.markers
    columns = {
        "id": pa.array([event.id for event in events], pa.string()),
        "label": pa.array([event.label for event in events], pa.string()),
        "t_ns": pa.array([event.t_ns for event in events], pa.int64()),
    }
    write_hashed_table(folder / MARKERS_NAME, pa.table(columns))


def read_markers(path: Path) -> tuple[Marker, ...]:
    """Read `markers.parquet` and verify its hash.

    Raises:
        FileNotFoundError: there is no such file.
        DamagedFileError: its hash is wrong, or it is no table of markers.
        StorageError: it cannot be read now.
    """
    table = read_hashed_table(path)
    try:
        return TypeAdapter(tuple[Marker, ...]).validate_python(table.to_pylist())
    except Exception as error:  # other content may cause any error
        raise DamagedFileError(
            f"cannot be read as a table of markers: {' '.join(str(error).split())[:300]}",
            where=str(path),
            expected="columns id, label, t_ns without empty values",
        ) from error


def load_clock_table(reader: SealedFileReader) -> ClockTable:
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
    stored, parts = read_clock_file(path), read_stream_ids(reader)
    streams = [
        stored.facts.get(stream_id, StreamClockFacts(stream_id))
        for stream_id in dict.fromkeys(parts)
    ]
    return ClockTable(stored.rows_by_stream, streams, parts, where=str(path))


def read_stream_ids(reader: SealedFileReader) -> list[str]:
    """Return the stream ids by number of part; a file that was never recorded has one part.

    Raises:
        FileFormatError: the session's notes are damaged.
    """
    session = reader.notes.get("session")
    if session is None:
        return [reader.info.stream_id]
    try:
        return [str(part["stream_id"]) for part in session["parts"]]
    except (TypeError, KeyError) as error:
        raise FileFormatError(
            "its notes do not say which streams it is of", where=str(reader.path)
        ) from error
