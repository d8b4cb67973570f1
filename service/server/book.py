"""The sessions of a server: what is known of each, kept on disk, and what people say of them.

Those that were deleted are in the `Trash`, and can be had back until it is emptied.
"""

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
    """All sessions that can be read, or made again; and of the others what is wrong, by id."""
    found, unreadable = folder.load_all()
    left: dict[str, str] = {}
    for session_id, error in unreadable.items():
        if not any(folder.path(session_id).glob("[!.]*")):
            continue  # never written down
        try:
            session = restore(folder, session_id)
        except StorageError as refused:
            log.warning("session %s cannot be made again: %s", session_id, refused)
            session = None
        if session is None:
            log.warning("session %s is left out, and no frames are dropped: %s", session_id, error)
            left[session_id] = str(error)
        else:
            log.warning("session %s: %s", session_id, session.problem)
            found.append(session)
    return found, left


def told_strays(strays: Iterable[StraySession]) -> dict[str, str]:
    """Warn of sessions whose folders were renamed or copied; return what is wrong, by folder."""
    for stray in strays:
        log.warning("session folder %s is left out: %s", printable(stray.name), stray.error)
    return {printable(stray.name): str(stray.error) for stray in strays}


class Trash:
    """The sessions in the trash.

    Args:
        folder: where they are.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = SessionFolder(folder)
        for doomed in folder.glob(DOOMED_PREFIX + "*"):
            shutil.rmtree(doomed, ignore_errors=True)
        found, unreadable = load_or_restore(self.folder)
        self.has_unreadable = bool(unreadable)
        """Is it not known which frames one of them needs?"""
        unreadable |= told_strays(self.folder.strays())
        self.problems = [f"in the trash, {text}" for text in _in_words(unreadable)]
        """Sessions that cannot be read, and why."""
        self._sessions = SessionIndex(found)

    def __contains__(self, session_id: str) -> bool:
        return session_id in self._sessions

    def all(self) -> list[Session]:
        """What is in it, newest first."""
        return list(self._sessions.newest_first())

    def unsealed(self) -> list[Session]:
        """Those in it that are not sealed."""
        return self._sessions.unsealed()

    def take(self, session: Session, out_of: SessionFolder) -> None:
        """Move a session into the trash.

        Raises:
            StorageError: it cannot be moved.
        """
        out_of.move(session.id, self.folder)
        self._sessions.put(session)

    def give_back(self, session_id: str, to: SessionFolder) -> Session:
        """Move a session back to where it was.

        Raises:
            UnknownError: it is not here.
            StorageError: it cannot be moved.
        """
        self.folder.path(session_id)
        if session_id not in self._sessions:
            raise UnknownError(f"no session {session_id!r} in the trash")
        self.folder.move(session_id, to)
        return self._sessions.take(session_id)

    def doom(self) -> list[Path]:
        """Give up all its sessions for good; return the folders to delete.

        Raises:
            StorageError: one of them cannot be moved; it and those after it are still here.
        """
        doomed = []
        for session in self.all():
            doomed.append(self.folder.doom(session.id))
            self._sessions.take(session.id)
        return doomed


def destroy(folders: list[Path]) -> int:
    """Delete folders with all their files; return how many bytes they took.

    Raises:
        StorageError: one of them cannot be deleted; the next start tries it again.
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
        folder: where they are kept.
        trash: where those are that were deleted.
        changed: told of every session that changed.
    """

    def __init__(
        self, folder: SessionFolder, trash: Trash, changed: Callable[[Session], None]
    ) -> None:
        self.folder = folder
        self.trash = trash
        self.changed = changed
        found, self.unreadable = load_or_restore(folder)
        """By id why these cannot be read; their files are as they were."""
        strays = folder.strays()
        self.has_unreadable = bool(self.unreadable) or any(each.may_need_frames for each in strays)
        """Is a session unreadable? Then it is not known which frames it needs."""
        self.has_unreadable |= trash.has_unreadable
        self.unreadable |= told_strays(strays)
        self.problems = _in_words(self.unreadable) + trash.problems
        """The same in words, with those in the trash."""
        self._sessions = SessionIndex(found)
        self._files = CheckedFiles()

    def frames(self, session_id: str, *, only_slices: bool = False) -> SessionReader:
        """The sealed file of a session, opened; from any thread.

        Args:
            session_id: which.
            only_slices: as for `SessionReader`.

        Raises:
            FileFormatError: there is none, or it is damaged.
        """
        path = self.folder.path(session_id) / FRAMES_NAME
        return self._files.open(path, only_slices=only_slices)

    def unsealed(self, node: str | None = None) -> list[Session]:
        """Sessions, of all nodes or of one, that are not sealed yet and not in the trash."""
        return self._sessions.unsealed(node)

    def newest_first(self, before: Age | None = None) -> Iterator[Session]:
        """All sessions, or those before one, newest first; change none meanwhile."""
        return self._sessions.newest_first(before)

    def get(self, session_id: str) -> Session:
        """One session, with the counts of the moment.

        Raises:
            UnknownError: there is none of this id.
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
        """Sessions that this very request has begun before, oldest first.

        Raises:
            UsageError: its key came with another request.
            StateError: what it began is in the trash.
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
                    "this Idempotency-Key came with another request before, which began session "
                    f"{session.id}",
                    remedy="Make a new key for each recording, and send it again with the same "
                    "request only",
                )
            if session.id in self.trash:
                raise StateError(
                    f"this request began session {session.id} before, which is in the trash",
                    remedy="Restore it, or record with another Idempotency-Key",
                )
        return found[::-1]

    def keep(self, session: Session) -> Session:
        """Write a new or changed session to the disk, and report it.

        Raises:
            StorageError: it cannot be written down; what is known here is as it was.
        """
        self.folder.save(session)
        self.note(session)
        self.changed(session)
        return session

    def note(self, session: Session) -> None:
        """Replace what is known of a session in memory; its next change is written to disk."""
        self._sessions.put(session)

    def change(self, session_id: str, *, only_if: str | None = None, **changes: object) -> Session:
        """Change what people say of a session: name, subject, notes, tags.

        Args:
            session_id: of the session.
            only_if: only if `said_of` it is still this; None: whatever it is.
            changes: by name.

        Raises:
            UnknownError: no such session.
            ChangedError: what people say of it is not this any more.
            StorageError: it cannot be written down.
        """
        session = self.get(session_id)
        expect(only_if, said_of(session), f"session {session_id}")
        return self.keep(session.model_copy(update=changes))

    def mark(
        self, session_id: str, label: str, t_ns: int | None, event_id: str | None = None
    ) -> Event:
        """Note an event, now or at `t_ns` of the server's UTC; once, if it comes with an id.

        Raises:
            UnknownError: no such session.
            StorageError: it cannot be written down.
        """
        session = self.get(session_id)
        event = next((known for known in session.events if known.id == event_id), None)
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
        """Rename or move an event; arguments as for `change`.

        Raises:
            UnknownError: no such session or event.
            ChangedError: it is not this any more.
            StorageError: it cannot be written down.
        """
        event = self._marked(session_id, event_id, only_if)
        changed = event.model_copy(update=changes)
        events = self.get(session_id).events
        self._keep_marks(session_id, tuple(changed if e.id == event_id else e for e in events))
        return changed

    def remove_mark(self, session_id: str, event_id: str, *, only_if: str | None = None) -> None:
        """Take an event away; arguments and errors as for `change_mark`."""
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
    """What people say of a session, as a short hash: it tells whether someone has changed it."""
    return _hash(session.model_dump_json(include={"name", "subject", "notes", "tags"}))


def mark_of(event: Event) -> str:
    """An event, as a short hash."""
    return _hash(event.model_dump_json())


def _hash(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def expect(wanted: str | None, found: str, what: str) -> None:
    """Refuse to change what is not any more what somebody has seen.

    Args:
        wanted: hash of what was seen; None: whatever it is.
        found: hash of what it is.
        what: it is, in words.

    Raises:
        ChangedError: they differ.
    """
    if wanted is not None and wanted != found:
        raise ChangedError(
            f"{what} was changed by somebody else meanwhile",
            remedy="Look at it as it is now, and change it again",
        )


def _in_words(unreadable: Mapping[str, str]) -> list[str]:
    return [f"session {name} is left out: {error}" for name, error in unreadable.items()]
