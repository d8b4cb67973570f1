"""A recorded session: which intervals of which streams, what people say of it, and its state.

Each has a folder `<sessions>/<id>/` with `session.json`, replaced whole at every change, and, once
it is sealed, `frames.parquet`, `events.parquet` and `clock.parquet`.
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
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from devices.errors import (
    FileFormatError,
    FootTileError,
    StorageError,
    UnknownError,
)
from storage.checked_json import read_checked, write_checked
from storage.clock.log import ClockOffset
from storage.durable import ASIDE, make_folder, storage_errors, sync_folder

FRAMES_NAME = "frames.parquet"
DOOMED_PREFIX = ".deleted-"
SESSION_ID = re.compile(r"[0-9]{8}T[0-9]{6}Z-[0-9a-f]{6}")

State = Literal["recording", "pending", "sealing", "sealed"]
Completeness = bool | Literal["lossy"]
"""True: every frame is there; False: some may still come; "lossy": some never will."""


class _Record(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class Part(_Record):
    """An interval of one stream, both ends included; `seq_last` is None while it is recorded."""

    boot_id: str
    seq_first: int
    seq_last: int | None = None


class PartLedger(_Record):
    """Each number of a part, counted once: recorded, lost for a reason, or still to come."""

    boot_id: str
    seq_first: int
    seq_last: int
    recorded: int
    lost: dict[str, int]
    pending: int
    unsynced_tail_max: int = 0
    """How many more frames there may have been when the node stopped without a word."""


class Ledger(_Record):
    """What became of every frame of a session."""

    complete: bool
    lossy: bool
    parts: tuple[PartLedger, ...]
    missed_slots: int
    """Slots in which the node took no frame; they never had a number."""

    @property
    def completeness(self) -> Completeness:
        """What there is of the session, in a word."""
        return "lossy" if self.lossy else self.complete

    @property
    def recorded(self) -> int:
        """Frames that are here."""
        return sum(part.recorded for part in self.parts)

    @property
    def pending(self) -> int:
        """Frames that are still to come."""
        return sum(part.pending for part in self.parts)

    @property
    def lost(self) -> dict[str, int]:
        """Frames that never come, by reason."""
        return dict(sum((Counter(part.lost) for part in self.parts), Counter()))

    @property
    def unsynced_tail_max(self) -> int:
        """How many more frames there may have been where a part broke off."""
        return sum(part.unsynced_tail_max for part in self.parts)


class Event(_Record):
    """Something a person marked."""

    id: str
    label: str
    t_ns: int
    """In the server's UTC."""


class Asked(_Record):
    """With which key a recording was asked for, and what was asked: both as digests.

    It is kept with what was begun: so the same request, sent again, finds that and begins no other.
    """

    key: str
    request: str


class Session(_Record):
    """One recorded session."""

    id: str
    name: str
    node: str
    state: State
    started_t_ns: int
    """When it was started, in the server's UTC."""
    stopped_t_ns: int | None = None
    parts: tuple[Part, ...]
    subject: str = ""
    notes: str = ""
    tags: tuple[str, ...] = ()
    scene: str
    scene_content: dict[str, Any] = Field(default_factory=dict)
    """The scene file of the node when it was started."""
    calibration: dict[str, Any] | None = None
    """The calibration in use when it was started; a later one does not change a recording."""
    calibration_source: Literal["node", "server"] = "node"
    """Who said which: the node itself, or the server, where one was assigned to the node."""
    events: tuple[Event, ...] = ()
    clock: tuple[ClockOffset, ...] = ()
    missed_slots_at_start: int = 0
    missed_slots_at_stop: dict[str, int] = Field(default_factory=dict)
    """By boot_id, of the stream in which it was stopped, if the node was there."""
    unsynced_tail_max: dict[str, int] = Field(default_factory=dict)
    """By boot_id, of parts that ended because the node went away."""
    given_up: bool = False
    """A person has given up the frames that are still to come."""
    take: str | None = None
    """Id of the take in which it was recorded together with other nodes."""
    asked: Asked | None = None
    """The `Idempotency-Key` of the request that began it, if it had one."""
    continues: str | None = None
    """Id of the session that this one continues, with other tiles."""
    problem: str | None = None
    """What a person should know: why it could not be sealed yet, why it has no estimates."""
    ledger: Ledger | None = None
    """Final once it is sealed."""
    frames: int = 0
    duration_s: float = 0.0
    bytes: int | None = None
    sha256: str | None = None
    calibration_id: str | None = None
    absolute_scale: Literal["measured", "assumed"] | None = None

    def with_clock(self, rows: Iterable[ClockOffset]) -> Session:
        """The session with new clock measurements of one of its streams added."""
        known = sorted(self.clock, key=lambda row: row.t_mono_ns)
        newest = {row.boot_id: row.t_mono_ns for row in known}
        further = [row for row in rows if row.t_mono_ns > newest.get(row.boot_id, -1)]
        return self.model_copy(update={"clock": (*self.clock, *further)})


def new_session_id(now: datetime) -> str:
    """An id that sorts by time and is its folder's name."""
    return f"{now.astimezone(UTC):%Y%m%dT%H%M%SZ}-{secrets.token_hex(3)}"


@dataclass(frozen=True)
class StraySession:
    """A session whose folder was renamed or copied, so that it has another name than its id.

    Attributes:
        name: of the folder.
        error: what is wrong, and what to do.
        may_need_frames: is it not sealed, so that it is still to be made of frames?
    """

    name: str
    error: FileFormatError
    may_need_frames: bool


class SessionFolder:
    """All sessions of a data folder."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def path(self, session_id: str) -> Path:
        """Folder of a session.

        Raises:
            UnknownError: the id has not the form of one, so it can not leave the folder either.
        """
        if not SESSION_ID.fullmatch(session_id):
            raise UnknownError(f"no session {session_id[:80]!r}")
        return self._folder / session_id

    def save(self, session: Session) -> None:
        """Write `session.json`.

        Raises:
            StorageError: the disk is full or not writable; the old one is still there then.
        """
        folder = self.path(session.id)
        is_new = not folder.exists()
        text = session.model_dump_json(indent=1).encode()
        try:
            with storage_errors(folder):
                make_folder(folder)
            write_checked(folder / "session.json", text)
        except StorageError:
            if is_new:  # a full disk still takes an empty folder, and perhaps a file's name
                shutil.rmtree(folder, ignore_errors=True)
            raise

    def load(self, session_id: str) -> Session:
        """Read `session.json`.

        Raises:
            UnknownError: there is no such session.
            FileFormatError: it is damaged.
            StorageError: it cannot be read now.
        """
        path = self.path(session_id) / "session.json"
        try:
            session = Session.model_validate_json(read_checked(path).text)
        except FileNotFoundError as error:
            raise UnknownError(f"no session {session_id!r}") from error
        except ValidationError as error:
            raise FileFormatError(f"not a session: {error}", where=str(path)) from error
        if session.id != session_id:
            raise self._stray(path.parent, session.id)
        return session

    def load_all(self) -> tuple[list[Session], dict[str, FootTileError]]:
        """All sessions, newest first, and errors by id for those that cannot be read."""
        found, unreadable = [], {}
        for session_id in self.ids():
            try:
                found.append(self.load(session_id))
            except FootTileError as error:
                unreadable[session_id] = error
        return found, unreadable

    def strays(self) -> list[StraySession]:
        """Find sessions in folders that have no session's name; they are left where they are."""
        found: list[StraySession] = []
        if not self._folder.is_dir():
            return found
        for path in sorted(self._folder.iterdir()):
            is_named = SESSION_ID.fullmatch(path.name) or path.name.startswith(".")
            if is_named or ASIDE in path.name or not path.is_dir():
                continue
            try:
                session = Session.model_validate_json(read_checked(path / "session.json").text)
            except FileNotFoundError:
                if (path / FRAMES_NAME).is_file():
                    found.append(StraySession(path.name, self._stray(path, None), True))
            except (FootTileError, ValidationError):
                found.append(StraySession(path.name, self._stray(path, None), True))
            else:
                is_copy = (self._folder / session.id).is_dir()
                needs_frames = session.state != "sealed" and not is_copy
                error = self._stray(path, session.id)
                found.append(StraySession(path.name, error, needs_frames))
        return found

    def _stray(self, path: Path, session_id: str | None) -> FileFormatError:
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

    def move(self, session_id: str, to: SessionFolder) -> None:
        """Move a session's folder to those of `to`: it is in one place or the other, never both.

        Raises:
            UnknownError: there is no such session.
            StorageError: it cannot be moved; it is where it was then.
        """
        source, target = self.path(session_id), to.path(session_id)
        if not source.is_dir():
            raise UnknownError(f"no session {session_id!r}")
        with storage_errors(target):
            make_folder(target.parent)
            source.rename(target)
            sync_folder(target.parent)
            sync_folder(source.parent)

    def doom(self, session_id: str) -> Path:
        """Rename a session's folder so that it is no session any more.

        Returns:
            The renamed folder, to be deleted.

        Raises:
            UnknownError: there is no such session.
            StorageError: it cannot be renamed; the session is unchanged then.
        """
        folder = self.path(session_id)
        if not folder.is_dir():
            raise UnknownError(f"no session {session_id!r}")
        # A half-deleted folder must not look like a session.
        doomed = folder.with_name(DOOMED_PREFIX + session_id)
        with storage_errors(folder):
            folder.rename(doomed)
            sync_folder(self._folder)
        return doomed

    def ids(self) -> Iterator[str]:
        """Ids of all sessions, newest first."""
        if self._folder.is_dir():
            names = [
                path.name
                for path in self._folder.iterdir()
                if SESSION_ID.fullmatch(path.name) and not _holds_nothing(path)
            ]
            yield from sorted(names, reverse=True)


def _holds_nothing(folder: Path) -> bool:
    """Is it what is left of a session that was never begun: made, and nothing written whole?"""
    try:
        return all(path.match(".*.tmp") for path in folder.iterdir())
    except OSError:  # a file, or not readable: then it may be one
        return False
