"""What people marked in a session, as it lies beside the frames: read back."""

from __future__ import annotations

from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
from pydantic import TypeAdapter, ValidationError

from devices.errors import FileFormatError
from storage.sessions.folder import EVENTS_NAME, Event

_EVENTS = TypeAdapter(tuple[Event, ...])


def read_events(path: Path) -> tuple[Event, ...]:
    """The events of an `events.parquet`, in the order in which they were marked.

    Raises:
        FileNotFoundError: there is none.
        FileFormatError: it cannot be read, or is no table of events.
    """
    try:
        with pq.ParquetFile(path, page_checksum_verification=True) as file:
            return _EVENTS.validate_python(file.read().to_pylist())
    except FileNotFoundError:
        raise
    except (OSError, ValueError, ValidationError, pa.ArrowException) as error:
        raise FileFormatError(
            f"cannot be read as a table of events: {error}",
            where=str(path),
            expected="columns id, label, t_ns",
        ) from error


def events_beside(frames: Path) -> tuple[Event, ...] | None:
    """The events that lie beside a session's frames; None if there is no such table.

    Raises:
        FileFormatError: it is damaged.
    """
    try:
        return read_events(frames.with_name(EVENTS_NAME))
    except FileNotFoundError:
        return None
