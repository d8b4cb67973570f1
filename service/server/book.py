"""Store of a server's sessions: on disk, in memory, with its trash."""

from __future__ import annotations

import hashlib
import logging
import shutil
import uuid
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path

from devices.errors import ChangedError, StateError, StorageError, UnknownError, UsageError
from devices.words import printable
from service.server.index import Age, SessionIndex
from service.server_clock import utc_ns
from service.sessions.restore import restore
from storage.durable import storage_errors
from storage.sessions.beside import write_events
from storage.sessions.checked_files import CheckedFiles
from storage.sessions.folder import (
    DOOMED_PREFIX,
    FRAMES_NAME,
    Asked,
    Event,
    Session,
    SessionFolder,
    StraySession,
)
from storage.sessions.reader import SessionReader

log = logging.getLogger("foottile.book")


def load_or_restore(folder: SessionFolder) -> tuple[list[Session], dict[str, str]]:
    """Load all sessions, rebuilding damaged ones; return them, and errors by id."""
    found, unreadable = folder.load_all()
    errors: dict[str, str] = {}
    for session_id, error in unreadable.items():
        if not any(folder.path(session_id).glob("[!.]*")):
            continue  # never saved
        try:
            session = restore(folder, session_id)
        except StorageError as refused:
            log.warning("session %s cannot be rebuilt: %s", session_id, refused)
            session = None
        if session is None:
            log.warning("session %s is left out, and no frames are dropped: %s", session_id, error)
            errors[session_id] = str(error)
        else:
            log.warning("session %s: %s", session_id, session.problem)
            found.append(session)
    return found, errors


def told_strays(strays: Iterable[StraySession]) -> dict[str, str]:
    """Log sessions whose folders were renamed or copied; return the errors by folder."""
    for stray in strays:
        log.warning("session folder %s is left out: %s", printable(stray.name), stray.error)
    return {printable(stray.name): str(stray.error) for stray in strays}


class Trash:
    """Deleted sessions that can be restored until the trash is emptied.

    Args:
        folder: folder of the trash.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = SessionFolder(folder)
        for doomed in folder.glob(DOOMED_PREFIX + "*"):
            shutil.rmtree(doomed, ignore_errors=True)
        found, unreadable = load_or_restore(self.folder)
        self.has_unreadable = bool(unreadable)
        """True if a session cannot be read: the frames that it needs are unknown."""
        unreadable |= told_strays(self.folder.strays())
        self.problems = [f"in the trash, {text}" for text in _in_words(unreadable)]
        """Sessions that cannot be read, and the reasons, as text."""
        self._sessions = SessionIndex(found)

    def __contains__(self, session_id: str) -> bool:
        return session_id in self._sessions

    def all(self) -> list[Session]:
        """Return all sessions in the trash, newest first."""
        return list(self._sessions.newest_first())

    def unsealed(self) -> list[Session]:
        """Return the unsealed sessions in the trash."""
        return self._sessions.unsealed()

    def take(self, session: Session, out_of: SessionFolder) -> None:
        """Move a session into the trash.

        Raises:
            StorageError: it cannot be moved.
        """
        out_of.move(session.id, self.folder)
        self._sessions.put(session)

    def give_back(self, session_id: str, to: SessionFolder) -> Session:
        """Move a session back to its former folder.

        Raises:
            UnknownError: it is not in the trash.
            StorageError: it cannot be moved.
        """
        self.folder.path(session_id)
        if session_id not in self._sessions:
            raise UnknownError(f"no session {session_id!r} in the trash")
        self.folder.move(session_id, to)
        return self._sessions.take(session_id)

    def doom(self) -> list[Path]:
        """Remove all sessions for good; return their folders, to be deleted by `destroy`.

        Raises:
            StorageError: a folder cannot be moved; its session and those after it are still in the
                trash.
        """
        doomed = []
        for session in self.all():
            doomed.append(self.folder.doom(session.id))
            self._sessions.take(session.id)
        return doomed


def destroy(folders: list[Path]) -> int:
    """Delete folders with all their files; return the number of bytes freed.

    Raises:
        StorageError: a file cannot be deleted; the next start tries again.
    """
    size_bytes = 0
    for folder in folders:
        with storage_errors(folder):
            files = (path for path in folder.rglob("*") if path.is_file())
            size_bytes += sum(path.stat().st_size for path in files)
            shutil.rmtree(folder)
    return size_bytes


class SessionBook:
    """All sessions of a server.

    Args:
        folder: folder of the sessions.
        trash: deleted sessions.
        changed: called with every session that changed.
    """

    def __init__(
        self, folder: SessionFolder, trash: Trash, changed: Callable[[Session], None]
    ) -> None:
        self.folder = folder
        self.trash = trash
        self.changed = changed
        found, self.unreadable = load_or_restore(folder)
        """Errors of the sessions that cannot be read, by id; their files are unchanged."""
        strays = folder.strays()
        self.has_unreadable = bool(self.unreadable) or any(each.may_need_frames for each in strays)
        """True if a session cannot be read: the frames that it needs are unknown."""
        self.has_unreadable |= trash.has_unreadable
        self.unreadable |= told_strays(strays)
        self.problems = _in_words(self.unreadable) + trash.problems
        """Unreadable sessions and their errors as text, with those in the trash."""
        self._sessions = SessionIndex(found)
        self._files = CheckedFiles()

    def frames(self, session_id: str, *, only_slices: bool = False) -> SessionReader:
        """Open the sealed file of a session. Runs in any thread.

        Args:
            session_id: id of the session.
            only_slices: as for `SessionReader`.

        Raises:
            FileFormatError: it is missing or damaged.
        """
        path = self.folder.path(session_id) / FRAMES_NAME
        return self._files.open(path, only_slices=only_slices)

    def unsealed(self, node: str | None = None) -> list[Session]:
        """Return unsealed sessions, of all nodes or of one, without those in the trash."""
        return self._sessions.unsealed(node)

    def newest_first(self, before: Age | None = None) -> Iterator[Session]:
        """Yield all sessions, or those before one, newest first; change none meanwhile."""
        return self._sessions.newest_first(before)

    def get(self, session_id: str) -> Session:
        """Return a session as last saved or cached.

        Raises:
            UnknownError: no session has this id.
            StateError: it cannot be read.
        """
        self.folder.path(session_id)
        if session_id not in self._sessions:
            if session_id in self.unreadable:
                raise StateError(
                    f"session {session_id} cannot be read: {self.unreadable[session_id]}",
                    remedy="No frames of its nodes are dropped meanwhile. See `foottile verify`",
                )
            remedy = "It is in the trash: restore it first" if session_id in self.trash else ""
            raise UnknownError(f"no session {session_id!r}", remedy=remedy)
        return self._sessions[session_id]

    def begun_by(self, asked: Asked | None) -> list[Session]:
        """Return the sessions that an earlier sending of this request created, oldest first.

        Raises:
            UsageError: the key came with another request before.
            StateError: a session that it created is in the trash.
        """
        if asked is None:
            return []
        found = [
            session
            for session in (*self.newest_first(), *self.trash.all())
            if session.asked is not None and session.asked.key == asked.key
        ]
        for session in found:
            if session.asked != asked:
                raise UsageError(
                    "this Idempotency-Key was used by another request, which started session "
                    f"{session.id}",
                    remedy="Make a new key for each recording, and send it again with the same "
                    "request only",
                )
            if session.id in self.trash:
                raise StateError(
                    f"this request has started session {session.id}, which is in the trash",
                    remedy="Restore it, or record with another Idempotency-Key",
                )
        return found[::-1]

    def keep(self, session: Session) -> Session:
        """Save a new or changed session to the disk, and notify `changed`.

        Raises:
            StorageError: it cannot be saved; the session in memory is unchanged.
        """
        self.folder.save(session)
        self.note(session)
        self.changed(session)
        return session

    def note(self, session: Session) -> None:
        """Replace a session in memory only; its next `save` writes it to the disk."""
        self._sessions.put(session)

    def change(self, session_id: str, *, only_if: str | None = None, **changes: object) -> Session:
        """Edit the user-written fields of a session: name, subject, notes, tags.

        Args:
            session_id: id of the session.
            only_if: expected `said_of`; None: any.
            changes: new values by name.

        Raises:
            UnknownError: no session has this id.
            ChangedError: its revision is another one.
            StorageError: it cannot be saved.
        """
        session = self.get(session_id)
        expect(only_if, said_of(session), f"session {session_id}")
        return self.keep(session.model_copy(update=changes))

    def mark(
        self, session_id: str, label: str, t_ns: int | None, event_id: str | None = None
    ) -> Event:
        """Add a marker at `t_ns` of the server's UTC, or now; once only if it comes with an id.

        Raises:
            UnknownError: no session has this id.
            StorageError: it cannot be saved.
        """
        session = self.get(session_id)
        event = next((marker for marker in session.events if marker.id == event_id), None)
        if event is None:
            event = Event(
                id=event_id or uuid.uuid4().hex[:12],
                label=label,
                t_ns=utc_ns() if t_ns is None else t_ns,
            )
            session = self.keep(session.model_copy(update={"events": (*session.events, event)}))
        if session.state == "sealed":
            write_events(session, self.folder.path(session_id))
        return event

    def change_mark(
        self, session_id: str, event_id: str, *, only_if: str | None = None, **changes: object
    ) -> Event:
        """Rename or move a marker; arguments as for `change`.

        Raises:
            UnknownError: no such session or marker.
            ChangedError: its revision is another one.
            StorageError: it cannot be saved.
        """
        event = self._marked(session_id, event_id, only_if)
        changed = event.model_copy(update=changes)
        events = self.get(session_id).events
        self._keep_marks(session_id, tuple(changed if e.id == event_id else e for e in events))
        return changed

    def remove_mark(self, session_id: str, event_id: str, *, only_if: str | None = None) -> None:
        """Remove a marker; arguments and errors as for `change_mark`."""
        self._marked(session_id, event_id, only_if)
        events = self.get(session_id).events
        self._keep_marks(session_id, tuple(event for event in events if event.id != event_id))

    def _marked(self, session_id: str, event_id: str, only_if: str | None) -> Event:
        for event in self.get(session_id).events:
            if event.id == event_id:
                expect(only_if, mark_of(event), f"mark {event.label!r} of session {session_id}")
                return event
        raise UnknownError(
            f"session {session_id} has no mark {event_id[:40]!r}", remedy="It may have been removed"
        )

    def _keep_marks(self, session_id: str, events: tuple[Event, ...]) -> None:
        session = self.keep(self.get(session_id).model_copy(update={"events": events}))
        if session.state == "sealed":
            write_events(session, self.folder.path(session_id))

    def take_out(self, session: Session) -> None:
        """Move a session to the trash.

        Raises:
            StorageError: it cannot be moved.
        """
        self.trash.take(session, self.folder)
        self._sessions.take(session.id)


def said_of(session: Session) -> str:
    """Return the revision of a session's user-written fields, a short hash."""
    return _hash(session.model_dump_json(include={"name", "subject", "notes", "tags"}))


def mark_of(event: Event) -> str:
    """Return the revision of a marker, a short hash."""
    return _hash(event.model_dump_json())


def _hash(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def expect(wanted: str | None, found: str, what: str) -> None:
    """Refuse a change if the client has seen another revision.

    Args:
        wanted: revision that the client has seen; None: any.
        found: present revision.
        what: description of the object, for the error.

    Raises:
        ChangedError: they differ.
    """
    if wanted is not None and wanted != found:
        raise ChangedError(
            f"{what} was changed by another client meanwhile",
            remedy="Reload it and retry",
        )


def _in_words(unreadable: Mapping[str, str]) -> list[str]:
    return [f"session {name} is left out: {error}" for name, error in unreadable.items()]
