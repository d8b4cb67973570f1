"""Models of a recorded session, and the folder of all sessions.

A session has a folder `<sessions>/<id>/` with `session.json`, replaced atomically at every change,
and, once it is sealed, `frames.parquet`, `markers.parquet` and `clock.parquet`.
"""

from __future__ import annotations

import re
import secrets
import shutil
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal, NamedTuple

from pydantic import BaseModel, ConfigDict, Field

from devices.errors import FileFormatError, FootTileError, StorageError, UnknownError
from devices.vitals import Vitals
from storage.clock.log import ClockOffset
from storage.documents import read_document, write_document
from storage.durable_files import (
    ASIDE_SUFFIX,
    make_synced_folder,
    sync_folder,
    translate_storage_errors,
)

FRAMES_NAME = "frames.parquet"
WARM_UP_NAME = "warm_up.parquet"
DELETED_PREFIX = ".deleted-"
SESSION_ID = re.compile(r"[0-9]{8}T[0-9]{6}Z-[0-9a-f]{6}")

SessionState = Literal["recording", "pending", "sealing", "sealed"]
Completeness = bool | Literal["lossy"]
"""True: all frames are stored; False: some may still come; "lossy": some will not."""


class _Record(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class Part(_Record):
    """Interval of one stream, both ends included; `seq_last` is None during the recording."""

    stream_id: str
    seq_first: int
    seq_last: int | None = None


class PartLedger(_Record):
    """Counts of a part's numbers, each once: recorded, lost for a reason, or pending."""

    stream_id: str
    seq_first: int
    seq_last: int
    recorded: int
    lost: dict[str, int]
    pending: int
    max_lost_tail_frames: int = 0
    """Upper limit of further frames when the node stopped unexpectedly."""


class Ledger(_Record):
    """Counts of a session's numbers."""

    complete: bool
    lossy: bool
    parts: tuple[PartLedger, ...]
    missed_slots: int
    """Frames not sampled: slots that the node left out because it was late, without a number."""

    @property
    def not_sampled_share(self) -> float:
        """Share of its slots in which no frame was sampled, 0 to 1."""
        slots = self.recorded + self.pending + sum(self.lost.values()) + self.missed_slots
        return self.missed_slots / slots if slots else 0.0

    @property
    def completeness(self) -> Completeness:
        """Completeness of the session."""
        return "lossy" if self.lossy else self.complete

    @property
    def recorded(self) -> int:
        """Number of stored frames."""
        return sum(part.recorded for part in self.parts)

    @property
    def pending(self) -> int:
        """Number of frames still to come."""
        return sum(part.pending for part in self.parts)

    @property
    def lost(self) -> dict[str, int]:
        """Number of lost frames by reason."""
        return dict(sum((Counter(part.lost) for part in self.parts), Counter()))

    @property
    def max_lost_tail_frames(self) -> int:
        """Upper limit of further frames behind unexpected ends of parts."""
        return sum(part.max_lost_tail_frames for part in self.parts)


class Marker(_Record):
    """Marker that a person set, or an edge of a node's sync line."""

    id: str
    label: str
    t_ns: int
    """Instant in the server's UTC; of an edge without clock measurements in its node's."""
    stream_id: str | None = None
    """Stream with the edge; None: a person set or moved it, and so for the next two."""
    t_mono_ns: int | None = None
    """Instant of the edge by the node's clock, as `t_mono_ns` of frames."""
    bound_ns: int | None = None
    """Bound of the error of `t_ns`; None: the server's time of the edge is unknown."""


class IdempotencyRecord(_Record):
    """Idempotency key and request that started a recording, both as digests.

    The record is stored with the session: a repeated request returns that session and starts no
    other.
    """

    key: str
    request: str


class Session(_Record):
    """Recorded session."""

    id: str
    name: str
    node: str
    state: SessionState
    started_t_ns: int
    """Start in the server's UTC."""
    stopped_t_ns: int | None = None
    parts: tuple[Part, ...]
    warm_up: Part | None = None
    """Frames just before the first part, for the models' history; no part of the session, which
    waits for none of them."""
    subject: str = ""
    notes: str = ""
    tags: tuple[str, ...] = ()
    scene: str
    scene_content: dict[str, Any] = Field(default_factory=dict)
    """Scene file of the node at the start."""
    calibration: dict[str, Any] | None = None
    """Calibration at the start; a later one does not change a recording."""
    calibration_source: Literal["node", "server"] = "node"
    """Origin of the calibration: the node itself, or an assignment on the server."""
    markers: tuple[Marker, ...] = ()
    clock: tuple[ClockOffset, ...] = ()
    missed_slots_at_start: int = 0
    missed_slots_at_stop: dict[str, int] = Field(default_factory=dict)
    """Count by stream_id, of the stream at the stop, if the node was connected."""
    server_minus_node_ns_at_stop: dict[str, int] = Field(default_factory=dict)
    """Offset by stream_id, of the stream at the stop, to the clock of `stopped_t_ns`: from its next
    start on a server may have another date."""
    vitals_at_start: Vitals | None = None
    """Vitals of the node's machine when it was started."""
    vitals_at_stop: Vitals | None = None
    """Vitals of the node's machine when it was stopped."""
    max_lost_tail_frames: dict[str, int] = Field(default_factory=dict)
    """Count by stream_id, of parts that ended because the node went away."""
    is_abandoned: bool = False
    """True: a person has abandoned the pending frames."""
    take: str | None = None
    """Id of the take that it was recorded in together with other nodes."""
    request: IdempotencyRecord | None = None
    """Record of the request that started it, if that had an `Idempotency-Key`."""
    continues: str | None = None
    """Id of the session that this one continues, with other tiles."""
    problem: str | None = None
    """User-visible problem: why it is not sealed yet, or has no estimates."""
    ledger: Ledger | None = None
    """Ledger; final once the session is sealed."""
    frames: int = 0
    duration_s: float = 0.0
    bytes: int | None = None
    sha256: str | None = None
    calibration_id: str | None = None
    absolute_scale: Literal["measured", "assumed"] | None = None

    def with_replaced_edges(self, edges: Iterable[Marker]) -> Session:
        """Return the session with these markers as its edges; those of people stay."""
        others = (marker for marker in self.markers if marker.stream_id is None)
        return self.model_copy(update={"markers": (*others, *edges)})

    def with_newer_clock_rows(self, rows: Iterable[ClockOffset]) -> Session:
        """Return the session with rows that are newer than its own of the same stream."""
        sorted_rows = sorted(self.clock, key=lambda row: row.t_mono_ns)
        newest = {row.stream_id: row.t_mono_ns for row in sorted_rows}
        further = [row for row in rows if row.t_mono_ns > newest.get(row.stream_id, -1)]
        return self.model_copy(update={"clock": (*self.clock, *further)})


def make_session_id(now: datetime) -> str:
    """Return an id that sorts by time and is the name of its folder."""
    return f"{now.astimezone(UTC):%Y%m%dT%H%M%SZ}-{secrets.token_hex(3)}"


@dataclass(frozen=True)
class StraySession:
    """Session whose folder was renamed or copied, so that its name is not the session's id.

    Attributes:
        name: name of the folder.
        error: problem and remedy.
        may_need_frames: True: it is not sealed, so it still needs journaled frames.
    """

    name: str
    error: FileFormatError
    may_need_frames: bool


class LoadedSessions(NamedTuple):
    """Sessions of a folder."""

    sessions: list[Session]
    errors: dict[str, FootTileError]
    """Errors of unreadable ones, by id."""

    @property
    def error_texts(self) -> dict[str, str]:
        """Errors as text, by id."""
        return {session_id: str(error) for session_id, error in self.errors.items()}


class SessionsFolder:
    """Folder of all sessions, or of those in the trash."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def get_path(self, session_id: str) -> Path:
        """Return the folder of a session.

        Raises:
            UnknownError: the id has an invalid form, which might lead out of the folder.
        """
        if not SESSION_ID.fullmatch(session_id):
            raise UnknownError(f"no session {session_id[:80]!r}")
        return self._folder / session_id

    def save_session_json(self, session: Session) -> None:
        """Write `session.json`.

        Raises:
            StorageError: the disk is full or not writable; the old file is unchanged.
        """
        folder = self.get_path(session.id)
        is_new = not folder.exists()
        try:
            with translate_storage_errors(folder):
                make_synced_folder(folder)
            write_document(folder / "session.json", session)
        except StorageError:
            if is_new:  # a full disk still accepts an empty folder, and perhaps a file's name
                shutil.rmtree(folder, ignore_errors=True)
            raise

    def load(self, session_id: str) -> Session:
        """Read `session.json`.

        Raises:
            UnknownError: there is no such session.
            FileFormatError: it is damaged.
            StorageError: it cannot be read now.
        """
        path = self.get_path(session_id) / "session.json"
        try:
            session = read_document(path, Session)
        except FileNotFoundError as error:
            raise UnknownError(f"no session {session_id!r}") from error
        if session.id != session_id:
            raise self._make_stray_error(path.parent, session.id)
        return session

    def load_all(self) -> LoadedSessions:
        """Load all sessions, newest first."""
        found = LoadedSessions([], {})
        for session_id in self.list_ids_newest_first():
            try:
                found.sessions.append(self.load(session_id))
            except FootTileError as error:
                found.errors[session_id] = error
        return found

    def find_renamed_or_copied_sessions(self) -> list[StraySession]:
        """Find sessions in folders without a session's name; they are not moved."""
        found: list[StraySession] = []
        if not self._folder.is_dir():
            return found
        for path in sorted(self._folder.iterdir()):
            is_named = SESSION_ID.fullmatch(path.name) or path.name.startswith(".")
            if is_named or ASIDE_SUFFIX in path.name or not path.is_dir():
                continue
            try:
                session = read_document(path / "session.json", Session)
            except FileNotFoundError:
                if (path / FRAMES_NAME).is_file():
                    found.append(StraySession(path.name, self._make_stray_error(path, None), True))
            except FootTileError:
                found.append(StraySession(path.name, self._make_stray_error(path, None), True))
            else:
                is_copy = (self._folder / session.id).is_dir()
                needs_frames = session.state != "sealed" and not is_copy
                error = self._make_stray_error(path, session.id)
                found.append(StraySession(path.name, error, needs_frames))
        return found

    def _make_stray_error(self, path: Path, session_id: str | None) -> FileFormatError:
        if session_id is None:
            return FileFormatError(
                "its folder was renamed, and its session.json cannot be read",
                where=str(path),
                expected="a folder that has the session's id as its name",
                remedy="Rename it to the id, as 20200131T235959Z-0123ab",
            )
        if (self._folder / session_id).is_dir() and path.name != session_id:
            return FileFormatError(
                f"it is a copy of session {session_id}, which is here, too",
                where=str(path),
                expected="each session once",
                remedy="Move the copy elsewhere",
            )
        return FileFormatError(
            f"it is session {session_id}, whose folder was renamed",
            where=str(path),
            expected=f"a folder of the name {session_id}",
            remedy=f"Rename it to {session_id}",
        )

    def move_to(self, session_id: str, destination: SessionsFolder) -> None:
        """Move a session's folder to `destination`, atomically.

        Raises:
            UnknownError: there is no such session.
            StorageError: it cannot be moved, and is where it was.
        """
        source, target = self.get_path(session_id), destination.get_path(session_id)
        if not source.is_dir():
            raise UnknownError(f"no session {session_id!r}")
        with translate_storage_errors(target):
            make_synced_folder(target.parent)
            source.rename(target)
            sync_folder(target.parent)
            sync_folder(source.parent)

    def rename_for_deletion(self, session_id: str) -> Path:
        """Rename a session's folder for deletion, so that it is no session any more.

        Returns:
            The renamed folder, to be deleted.

        Raises:
            UnknownError: there is no such session.
            StorageError: it cannot be renamed; the session is unchanged.
        """
        folder = self.get_path(session_id)
        if not folder.is_dir():
            raise UnknownError(f"no session {session_id!r}")
        # A half-deleted folder must not look like a session.
        doomed = folder.with_name(DELETED_PREFIX + session_id)
        with translate_storage_errors(folder):
            folder.rename(doomed)
            sync_folder(self._folder)
        return doomed

    def list_ids_newest_first(self) -> Iterator[str]:
        """Yield the ids of all sessions, newest first."""
        if self._folder.is_dir():
            names = [
                path.name
                for path in self._folder.iterdir()
                if SESSION_ID.fullmatch(path.name) and not _has_no_complete_file(path)
            ]
            yield from sorted(names, reverse=True)


def _has_no_complete_file(folder: Path) -> bool:
    """Return whether the folder has no complete file: its session was never created."""
    try:
        return all(path.match(".*.tmp") for path in folder.iterdir())
    except OSError:  # a file, or not readable: it may be a session
        return False
