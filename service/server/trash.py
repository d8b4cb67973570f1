"""Sessions that were deleted and can still be had back, until the trash is emptied."""

from __future__ import annotations

import logging
import shutil
from pathlib import Path

from devices.errors import UnknownError
from storage.durable import storage_errors
from storage.sessions.folder import DOOMED_PREFIX, Session, SessionFolder

log = logging.getLogger("foottile.trash")


class Trash:
    """The sessions in the trash.

    Args:
        folder: where they are.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = SessionFolder(folder)
        for doomed in folder.glob(DOOMED_PREFIX + "*"):
            shutil.rmtree(doomed, ignore_errors=True)
        found, unreadable = self.folder.load_all()
        for session_id, error in unreadable.items():
            log.warning("session %s in the trash is left out: %s", session_id, error)
        self.has_unreadable = bool(unreadable)
        """Is there one that cannot be read?"""
        self._sessions = {session.id: session for session in found}

    def __contains__(self, session_id: str) -> bool:
        return session_id in self._sessions

    def all(self) -> list[Session]:
        """What is in it, newest first."""
        return sorted(self._sessions.values(), key=lambda s: (s.started_t_ns, s.id), reverse=True)

    def take(self, session: Session, out_of: SessionFolder) -> None:
        """Have a session here.

        Raises:
            StorageError: it cannot be moved.
        """
        out_of.move(session.id, self.folder)
        self._sessions[session.id] = session

    def give_back(self, session_id: str, to: SessionFolder) -> Session:
        """Have a session where it was before.

        Raises:
            UnknownError: it is not here.
            StorageError: it cannot be moved.
        """
        self.folder.path(session_id)
        if session_id not in self._sessions:
            raise UnknownError(f"no session {session_id!r} in the trash")
        self.folder.move(session_id, to)
        return self._sessions.pop(session_id)

    def doom(self) -> list[Path]:
        """Give up all sessions of the trash for good; return the folders to delete.

        Raises:
            StorageError: one of them cannot be moved; it and those after it are still here.
        """
        doomed = []
        for session_id in list(self._sessions):
            doomed.append(self.folder.doom(session_id))
            del self._sessions[session_id]
        return doomed


def destroy(folders: list[Path]) -> int:
    """Delete folders with all that is in them; how many bytes that were.

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
