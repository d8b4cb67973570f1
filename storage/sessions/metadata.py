"""Metadata of a session from `session.json`, the server's own or one of `foottile pull`."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pyarrow as pa
from pydantic import TypeAdapter, ValidationError

from devices.errors import DamagedFileError, FileFormatError, StorageError, UsageError
from storage.clock.table import CLOCK_NAME, ClockTable, StreamClockFacts, read_clock_file
from storage.documents import read_checksummed_json, verify_and_strip_json_checksum
from storage.durable_files import read_small_file, translate_storage_errors, write_atomically
from storage.parquet_hash import compute_sha256, read_hashed_table, write_hashed_table
from storage.sessions.folder import FRAMES_NAME, Completeness, Ledger, Marker, Part, Session

if TYPE_CHECKING:
    from storage.sessions.reader import SealedFileReader

SESSION_NAME = "session.json"
LEDGER_NAME = "ledger.json"
PULLED_MARKERS_NAME = "markers.json"
"""Markers; `foottile pull` writes this file and the ledger's."""


@dataclass(frozen=True)
class StoredMetadata:
    """Metadata from a folder's `session.json`, the server's own or a pulled one."""

    content: dict[str, Any]
    parts: tuple[Part, ...]
    ledger: Ledger | None
    session: Session | None
    """Complete model; None for a pulled session, which has fewer fields."""


def parse_session_metadata(
    folder: Path, session_json: bytes | None, problems: list[str]
) -> StoredMetadata | None:
    """Parse the metadata of a session's folder and verify its checksum.

    Args:
        folder: folder of the session.
        session_json: content of its `session.json`; None if it is missing or unreadable.
        problems: messages of damage are added here.

    Returns:
        None if it cannot be parsed.
    """
    if session_json is None:
        is_there = os.path.lexists(folder / SESSION_NAME)
        problems.append(f"{SESSION_NAME} {'cannot be read' if is_there else 'is missing'}")
        return None
    try:
        body = verify_and_strip_json_checksum(session_json, where=SESSION_NAME)
        try:
            return wrap_session_as_metadata(Session.model_validate_json(body))
        except ValidationError:
            return _parse_pulled_metadata(folder, json.loads(body), problems)
    except DamagedFileError as error:
        problems.append(f"{SESSION_NAME}: {error.what}")
        return None
    except (ValueError, KeyError, TypeError) as error:
        problems.append(f"{SESSION_NAME} is not readable: {shorten_error(error)}")
        return None


def wrap_session_as_metadata(session: Session) -> StoredMetadata:
    """Return a session's model as metadata."""
    return StoredMetadata(session.model_dump(mode="json"), session.parts, session.ledger, session)


def _parse_pulled_metadata(
    folder: Path, content: dict[str, Any], problems: list[str]
) -> StoredMetadata:
    """Parse a pulled session: the API's view of the session, with markers and ledger beside it."""
    text = _read_sidecar_json(folder / LEDGER_NAME, problems)
    _read_sidecar_json(folder / PULLED_MARKERS_NAME, problems)
    parts = tuple(Part.model_validate(part) for part in content["parts"])
    ledger = Ledger.model_validate_json(text) if text is not None else None
    return StoredMetadata({**content, "id": content["id"]}, parts, ledger, None)


def _read_sidecar_json(path: Path, problems: list[str]) -> bytes | None:
    try:
        return read_checksummed_json(path)
    except FileNotFoundError:
        return None
    except (DamagedFileError, StorageError) as error:
        problems.append(f"{path.name}: {error.what}")
        return None


def read_bytes_or_none(path: Path) -> bytes | None:
    """Read a file's content; None if there is none, or it cannot be read."""
    try:
        return read_small_file(path)
    except (OSError, DamagedFileError):
        return None


def shorten_error(error: Exception) -> str:
    """Return an error's text in one line of up to 300 characters."""
    return " ".join(str(error).split())[:300]


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
    if any(event.stream_id is not None for event in events):
        columns |= {
            "stream_id": pa.array([event.stream_id for event in events], pa.string()),
            "t_mono_ns": pa.array([event.t_mono_ns for event in events], pa.int64()),
            "bound_ns": pa.array([event.bound_ns for event in events], pa.int64()),
        }
    write_hashed_table(folder / MARKERS_NAME, pa.table(columns))


def read_existing_markers(path: Path) -> tuple[Marker, ...]:
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


SUMS_NAME = "SHA256SUMS"


def format_sha256_sums(folder: Path, frames_sha256: str) -> bytes:
    """Return the content of `SHA256SUMS`, which `sha256sum -c` checks: files that never change.

    Args:
        folder: folder of the session, with the clock's file if there is one.
        frames_sha256: hash of the file of frames.

    Raises:
        OSError: the clock's file cannot be read.
    """
    sums = {FRAMES_NAME: frames_sha256}
    if (folder / CLOCK_NAME).is_file():
        sums[CLOCK_NAME] = compute_sha256(folder / CLOCK_NAME)
    return "".join(f"{sha256}  {name}\n" for name, sha256 in sums.items()).encode()


def write_sha256_sums(folder: Path, frames_sha256: str) -> None:
    """Write `SHA256SUMS` into the session's folder; an existing one is replaced.

    Raises:
        StorageError: the disk is full or not writable, or the clock's file cannot be read.
    """
    with translate_storage_errors(folder):
        content = format_sha256_sums(folder, frames_sha256)
    write_atomically(folder / SUMS_NAME, content)


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


_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
_T_NS_END = 2**63


@dataclass(frozen=True)
class SessionFilter:
    """Filter of sessions; an empty field accepts every session.

    Attributes:
        nodes: names of nodes; one has to have recorded the session.
        tags: tags that the session has, case-insensitive.
        take: id of its take.
        q: text in id, name, subject, notes, node, scene or a tag, case-insensitive.
        from_t_ns: earliest start, UTC.
        to_t_ns: end of the range of starts, exclusive, UTC.
        complete: completeness of the session.
    """

    nodes: tuple[str, ...] = ()
    tags: tuple[str, ...] = ()
    take: str | None = None
    q: str | None = None
    from_t_ns: int | None = None
    to_t_ns: int | None = None
    complete: Completeness | None = None

    def accepts(
        self, session: Session, get_completeness: Callable[[Session], Completeness]
    ) -> bool:
        """Return whether a session passes the filter.

        Args:
            session: the session now.
            get_completeness: returns a session's completeness; called last, since it may have to
                count.
        """
        tags = {tag.casefold() for tag in session.tags}
        return (
            (not self.nodes or session.node in self.nodes)
            and all(tag.strip().casefold() in tags for tag in self.tags)
            and (self.take is None or session.take == self.take)
            and (self.from_t_ns is None or session.started_t_ns >= self.from_t_ns)
            and (self.to_t_ns is None or session.started_t_ns < self.to_t_ns)
            and (self.q is None or _contains_text(session, self.q.casefold()))
            and (self.complete is None or get_completeness(session) == self.complete)
        )


def parse_iso_or_t_ns(text: str, *, where: str) -> int:
    """Parse an instant in ns since 1970, UTC: such a number, or an ISO 8601 date or time.

    Args:
        text: without an offset it is UTC; a date alone is its midnight.
        where: the option or parameter, for the message.

    Raises:
        UsageError: it is neither, or before 1970 or after 2261.
    """
    stripped = text.strip()
    is_number = re.fullmatch(r"[0-9]{9,}", stripped, re.ASCII)
    try:
        t_ns = int(stripped[:20]) if is_number else _parse_iso_t_ns(stripped)
    except (ValueError, OverflowError):
        t_ns = -1
    if not 0 <= t_ns < _T_NS_END:
        raise UsageError(
            f"{where} {text[:40]!r} is no instant",
            expected="2026-11-24, 2026-11-24T08:00, 2026-11-24T08:00:00Z, or nanoseconds "
            "since 1970; without an offset it is UTC",
        )
    return t_ns


def _parse_iso_t_ns(text: str) -> int:
    at = datetime.fromisoformat(text)
    at = at if at.tzinfo is not None else at.replace(tzinfo=UTC)
    return (at - _EPOCH) // timedelta(microseconds=1) * 1000


def parse_completeness(text: str, *, where: str) -> Completeness:
    """Parse `true`, `false` or `lossy`.

    Raises:
        UsageError: it is none of these.
    """
    values: dict[str, Completeness] = {"true": True, "false": False, "lossy": "lossy"}
    if text not in values:
        raise UsageError(f"{where} {text[:40]!r}", expected="true, false or lossy")
    return values[text]


def _contains_text(session: Session, q: str) -> bool:
    texts = (session.id, session.name, session.subject, session.notes, session.node, session.scene)
    return any(q in text.casefold() for text in (*texts, *session.tags))
