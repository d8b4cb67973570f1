"""Store of a server's sessions: on disk, in memory, with its trash.

A season has thousands of sessions, and nearly all are sealed. A tick visits the unsealed ones only;
a page of the list visits the sessions on that page.
"""

from __future__ import annotations

import hashlib
import logging
import shutil
import uuid
from bisect import bisect_left, insort
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path

from devices.clock import server_utc_ns
from devices.errors import (
    ChangedError,
    StateError,
    StorageError,
    UnknownError,
    UsageError,
    escape_control_chars,
)
from service.sessions.lifecycle import Edit, apply_event
from service.sessions.sealing import rebuild_damaged_session_json
from storage.durable_files import translate_storage_errors
from storage.sessions.folder import (
    DELETED_PREFIX,
    FRAMES_NAME,
    IdempotencyRecord,
    LoadedSessions,
    Marker,
    Session,
    SessionsFolder,
    StraySession,
)
from storage.sessions.metadata import write_markers
from storage.sessions.reader import SealedFileReader, VerifiedFileCache

log = logging.getLogger("foottile.sessions")


def load_or_rebuild_sessions(folder: SessionsFolder) -> LoadedSessions:
    """Load all sessions, and rebuild damaged ones on the disk."""
    found = folder.load_all()
    for session_id, error in list(found.errors.items()):
        del found.errors[session_id]
        if not any(folder.get_path(session_id).glob("[!.]*")):
            continue  # never saved
        try:
            session = rebuild_damaged_session_json(folder, session_id)
        except StorageError as refused:
            log.warning("session %s cannot be rebuilt: %s", session_id, refused)
            session = None
        if session is None:
            log.warning("session %s is left out, and no frames are dropped: %s", session_id, error)
            found.errors[session_id] = error
        else:
            log.warning("session %s: %s", session_id, session.problem)
            found.sessions.append(session)
    return found


def log_strays(strays: Iterable[StraySession]) -> dict[str, str]:
    """Log sessions whose folders were renamed or copied; return the errors by folder."""
    for stray in strays:
        log.warning(
            "session folder %s is left out: %s", escape_control_chars(stray.name), stray.error
        )
    return {escape_control_chars(stray.name): str(stray.error) for stray in strays}


StartKey = tuple[int, str]
"""Sort key of sessions: start time, ns UTC, and id."""


def start_key(session: Session) -> StartKey:
    """Return the sort key of a session."""
    return session.started_t_ns, session.id


class SessionIndex:
    """Sessions by id and by start time.

    Args:
        sessions: initial content.
    """

    def __init__(self, sessions: Iterable[Session] = ()) -> None:
        self._by_id = {session.id: session for session in sessions}
        self._keys = sorted(map(start_key, self._by_id.values()))
        self._unsealed = {
            name: session for name, session in self._by_id.items() if session.state != "sealed"
        }

    def __contains__(self, session_id: object) -> bool:
        return session_id in self._by_id

    def __len__(self) -> int:
        return len(self._by_id)

    def __getitem__(self, session_id: str) -> Session:
        return self._by_id[session_id]

    def put(self, session: Session) -> None:
        """Add a session, or replace the one with its id."""
        previous = self._by_id.get(session.id)
        if previous is None or start_key(previous) != start_key(session):
            if previous is not None:
                self.remove(session.id)
            insort(self._keys, start_key(session))
        self._by_id[session.id] = session
        if session.state == "sealed":
            self._unsealed.pop(session.id, None)
        else:
            self._unsealed[session.id] = session

    def remove(self, session_id: str) -> Session:
        """Remove a session and return it.

        Raises:
            KeyError: no session has this id.
        """
        session = self._by_id.pop(session_id)
        del self._keys[bisect_left(self._keys, start_key(session))]
        self._unsealed.pop(session_id, None)
        return session

    def list_unsealed(self, node: str | None = None) -> list[Session]:
        """Return unsealed sessions, of all nodes or of one, in order of addition."""
        return [each for each in self._unsealed.values() if node in (None, each.node)]

    def iterate_newest_first(self, before: StartKey | None = None) -> Iterator[Session]:
        """Yield all sessions, or those before a key, newest first; change none meanwhile."""
        end = len(self._keys) if before is None else bisect_left(self._keys, before)
        for place in range(end - 1, -1, -1):
            yield self._by_id[self._keys[place][1]]


class Trash:
    """Deleted sessions that can be restored until the trash is emptied.

    Args:
        folder: folder of the trash.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = SessionsFolder(folder)
        for doomed in folder.glob(DELETED_PREFIX + "*"):
            shutil.rmtree(doomed, ignore_errors=True)
        found = load_or_rebuild_sessions(self.folder)
        self.has_unreadable = bool(found.errors)
        """True if a session cannot be read: the frames that it needs are unknown."""
        unreadable = found.error_texts | log_strays(self.folder.find_renamed_or_copied_sessions())
        self.problems = [f"in the trash, {text}" for text in _format_unreadable(unreadable)]
        """Sessions that cannot be read, and the reasons, as text."""
        self._sessions = SessionIndex(found.sessions)

    def __contains__(self, session_id: str) -> bool:
        return session_id in self._sessions

    def list_sessions(self) -> list[Session]:
        """Return all sessions in the trash, newest first."""
        return list(self._sessions.iterate_newest_first())

    def list_unsealed(self) -> list[Session]:
        """Return the unsealed sessions in the trash."""
        return self._sessions.list_unsealed()

    def add(self, session: Session, source: SessionsFolder) -> None:
        """Move a session into the trash.

        Raises:
            StorageError: it cannot be moved.
        """
        source.move_to(session.id, self.folder)
        self._sessions.put(session)

    def restore(self, session_id: str, target: SessionsFolder) -> Session:
        """Move a session back to its former folder.

        Raises:
            UnknownError: it is not in the trash.
            StorageError: it cannot be moved.
        """
        self.folder.get_path(session_id)
        if session_id not in self._sessions:
            raise UnknownError(f"no session {session_id!r} in the trash")
        self.folder.move_to(session_id, target)
        return self._sessions.remove(session_id)

    def rename_all_for_deletion(self) -> list[Path]:
        """Rename the folders of all sessions, to be deleted by `delete_and_count_bytes`.

        Raises:
            StorageError: a folder cannot be moved; its session and those after it are still in the
                trash.
        """
        doomed = []
        for session in self.list_sessions():
            doomed.append(self.folder.rename_for_deletion(session.id))
            self._sessions.remove(session.id)
        return doomed


def delete_and_count_bytes(folders: list[Path]) -> int:
    """Delete folders with all their files; return the number of bytes freed.

    Raises:
        StorageError: a file cannot be deleted; the next start tries again.
    """
    size_bytes = 0
    for folder in folders:
        with translate_storage_errors(folder):
            files = (path for path in folder.rglob("*") if path.is_file())
            size_bytes += sum(path.stat().st_size for path in files)
            shutil.rmtree(folder)
    return size_bytes


class SessionStore:
    """All sessions of a server.

    Args:
        folder: folder of the sessions.
        trash: deleted sessions.
        on_change: called with every session that changed.
    """

    def __init__(
        self, folder: SessionsFolder, trash: Trash, on_change: Callable[[Session], None]
    ) -> None:
        self.folder = folder
        self.trash = trash
        self.on_change = on_change
        found = load_or_rebuild_sessions(folder)
        self.unreadable = found.error_texts
        """Errors of the sessions that cannot be read, by id; their files are unchanged."""
        strays = folder.find_renamed_or_copied_sessions()
        self.has_unreadable = bool(self.unreadable) or any(each.may_need_frames for each in strays)
        """True if a session cannot be read: the frames that it needs are unknown."""
        self.has_unreadable |= trash.has_unreadable
        self.unreadable |= log_strays(strays)
        self.problems = _format_unreadable(self.unreadable) + trash.problems
        """Unreadable sessions and their errors as text, with those in the trash."""
        self._sessions = SessionIndex(found.sessions)
        self._files = VerifiedFileCache()

    def open_frames(self, session_id: str, *, only_slices: bool = False) -> SealedFileReader:
        """Open the sealed file of a session. Runs in any thread.

        Args:
            session_id: id of the session.
            only_slices: as for `SealedFileReader`.

        Raises:
            FileFormatError: it is missing or damaged.
        """
        path = self.folder.get_path(session_id) / FRAMES_NAME
        return self._files.open_reader(path, only_slices=only_slices)

    def list_unsealed(self, node: str | None = None) -> list[Session]:
        """Return unsealed sessions, of all nodes or of one, without those in the trash."""
        return self._sessions.list_unsealed(node)

    def iterate_newest_first(self, before: StartKey | None = None) -> Iterator[Session]:
        """Yield all sessions, or those before one, newest first; change none meanwhile."""
        return self._sessions.iterate_newest_first(before)

    def get_session(self, session_id: str) -> Session:
        """Return a session as last saved or cached.

        Raises:
            UnknownError: no session has this id.
            StateError: it cannot be read.
        """
        self.folder.get_path(session_id)
        if session_id not in self._sessions:
            if session_id in self.unreadable:
                raise StateError(
                    f"session {session_id} cannot be read: {self.unreadable[session_id]}",
                    remedy="No frames of its nodes are dropped meanwhile. See `foottile verify`",
                )
            remedy = "It is in the trash: restore it first" if session_id in self.trash else ""
            raise UnknownError(f"no session {session_id!r}", remedy=remedy)
        return self._sessions[session_id]

    def find_by_idempotency_key(self, request: IdempotencyRecord | None) -> list[Session]:
        """Return the sessions that an earlier sending of this request created, oldest first.

        Raises:
            UsageError: the key came with another request before.
            StateError: a session that it created is in the trash.
        """
        if request is None:
            return []
        found = [
            session
            for session in (*self.iterate_newest_first(), *self.trash.list_sessions())
            if session.request is not None and session.request.key == request.key
        ]
        for session in found:
            if session.request != request:
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

    def save(self, session: Session) -> Session:
        """Save a new or changed session to the disk, and notify `on_change`.

        Raises:
            StorageError: it cannot be saved; the session in memory is unchanged.
        """
        self.folder.save_session_json(session)
        self.cache(session)
        self.on_change(session)
        return session

    def cache(self, session: Session) -> None:
        """Replace a session in memory only; its next `save` writes it to the disk."""
        self._sessions.put(session)

    def edit_user_fields(
        self, session_id: str, *, if_revision: str | None = None, **changes: object
    ) -> Session:
        """Edit the user-written fields of a session: name, subject, notes, tags.

        Args:
            session_id: id of the session.
            if_revision: expected `user_fields_revision`; None: any.
            changes: new values by name.

        Raises:
            UnknownError: no session has this id.
            ChangedError: its revision is another one.
            StorageError: it cannot be saved.
        """
        session = self.get_session(session_id)
        check_revision(if_revision, user_fields_revision(session), f"session {session_id}")
        return self._edit(session_id, **changes)

    def _edit(self, session_id: str, **changes: object) -> Session:
        step = apply_event(self.get_session(session_id), Edit(changes))
        if step.is_changed:
            self.save(step.session)
        if step.action == "write_markers":
            write_markers(step.session, self.folder.get_path(session_id))
        return step.session

    def add_marker(
        self, session_id: str, label: str, t_ns: int | None, marker_id: str | None = None
    ) -> Marker:
        """Add a marker at `t_ns` of the server's UTC, or now; once only if it comes with an id.

        Raises:
            UnknownError: no session has this id.
            StorageError: it cannot be saved.
        """
        session = self.get_session(session_id)
        event = next((marker for marker in session.markers if marker.id == marker_id), None)
        if event is not None and session.state != "sealed":
            return event
        markers = session.markers
        if event is None:
            event = Marker(
                id=marker_id or uuid.uuid4().hex[:12],
                label=label,
                t_ns=server_utc_ns() if t_ns is None else t_ns,
            )
            markers = (*markers, event)
        self._edit(session_id, markers=markers)
        return event

    def edit_marker(
        self, session_id: str, marker_id: str, *, if_revision: str | None = None, **changes: object
    ) -> Marker:
        """Rename or move a marker; arguments as for `edit_user_fields`.

        Raises:
            UnknownError: no such session or marker.
            ChangedError: its revision is another one.
            StorageError: it cannot be saved.
        """
        event = self._find_marker(session_id, marker_id, if_revision)
        if "t_ns" in changes:  # no edge any more
            changes |= {"stream_id": None, "t_mono_ns": None, "bound_ns": None}
        changed = event.model_copy(update=changes)
        events = self.get_session(session_id).markers
        self._edit(session_id, markers=tuple(changed if e.id == marker_id else e for e in events))
        return changed

    def remove_marker(
        self, session_id: str, marker_id: str, *, if_revision: str | None = None
    ) -> None:
        """Remove a marker; arguments and errors as for `edit_marker`."""
        self._find_marker(session_id, marker_id, if_revision)
        events = self.get_session(session_id).markers
        self._edit(session_id, markers=tuple(event for event in events if event.id != marker_id))

    def _find_marker(self, session_id: str, marker_id: str, if_revision: str | None) -> Marker:
        session = self.get_session(session_id)
        for event in session.markers:
            if event.id == marker_id:
                if event.stream_id is not None and session.state != "sealed":
                    raise StateError(
                        f"marker {event.label!r} is an edge of the sync line, and session "
                        f"{session_id} is not sealed yet",
                        remedy="Change it once the session is sealed",
                    )
                check_revision(
                    if_revision,
                    marker_revision(event),
                    f"marker {event.label!r} of session {session_id}",
                )
                return event
        raise UnknownError(
            f"session {session_id} has no marker {marker_id[:40]!r}",
            remedy="It may have been removed",
        )

    def move_to_trash(self, session: Session) -> None:
        """Move a session to the trash.

        Raises:
            StorageError: it cannot be moved.
        """
        self.trash.add(session, self.folder)
        self._sessions.remove(session.id)


def user_fields_revision(session: Session) -> str:
    """Return the revision of a session's user-written fields, a short hash."""
    return _hash(session.model_dump_json(include={"name", "subject", "notes", "tags"}))


def marker_revision(marker: Marker) -> str:
    """Return the revision of a marker, a short hash of what people may change."""
    return _hash(f"{marker.t_ns} {marker.label}")


def _hash(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def check_revision(expected: str | None, actual: str, what: str) -> None:
    """Refuse a change if the client has seen another revision.

    Args:
        expected: revision that the client has seen; None: any.
        actual: present revision.
        what: description of the object, for the error.

    Raises:
        ChangedError: they differ.
    """
    if expected is not None and expected != actual:
        raise ChangedError(
            f"{what} was changed by another client meanwhile",
            remedy="Reload it and retry",
        )


def _format_unreadable(unreadable: Mapping[str, str]) -> list[str]:
    return [f"session {name} is left out: {error}" for name, error in unreadable.items()]
