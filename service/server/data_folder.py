"""Data folder of a server: its lock and id."""

from __future__ import annotations

import errno
import logging
import uuid
from contextlib import ExitStack, suppress
from pathlib import Path

from pydantic import BaseModel, ConfigDict, Field

from devices.errors import FileFormatError, FolderGoneError
from storage.documents import read_document, write_document
from storage.durable_files import (
    is_locked_folder_in_place,
    lock_folder,
    make_synced_folder,
    set_aside_damaged,
    translate_storage_errors,
    try_set_aside_and_describe,
    write_atomically,
)

log = logging.getLogger("foottile.server")

SERVER_NAME = "server.json"


class ServerIdentity(BaseModel):
    """Random name of a server's data folder, `server.json`."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    server_id: str = Field(pattern=r"^[0-9a-f]{32}$")


_PROBE_NAME = ".writable"
_PROBE_BYTES = 64 << 10
_REMEDY = (
    "Move it back or mount it: the server then goes on by itself, and nodes send again what is "
    "missing"
)


class DataFolder:
    """Data folder, locked by one server until `close`.

    The server waits for a folder that was moved or unmounted; meanwhile nothing is written at its
    path. The folder may come back mounted again, or as a copy: its id is compared.

    Args:
        path: created if absent.

    Raises:
        StorageError: folder or id cannot be read or written, or another server has locked it.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        with translate_storage_errors(path, "Choose another folder with --data"):
            make_synced_folder(path)
        self._lock = self._acquire_lock()
        self.problems: list[str] = []
        """Damage found in the folder's own files, and the consequence, as text."""
        try:
            if (path / _PROBE_NAME).is_dir():
                set_aside_damaged(path / _PROBE_NAME)
            self.id = self._read_id() or self._write_id(uuid.uuid4().hex)
        except BaseException:
            self._lock.close()
            raise

    def check_still_in_place(self) -> None:
        """Check that the folder in use is still at its path. Runs in any thread.

        Raises:
            FolderGoneError: it is not; the error names the folder that is there now.
            StorageError: that cannot be checked, or the id not be read.
        """
        if is_locked_folder_in_place(self.path):
            return
        with translate_storage_errors(self.path, _REMEDY):
            place = self._describe_path()
        raise FolderGoneError(
            f"the data folder was moved, deleted or unmounted, and nothing is stored: {place}",
            where=str(self.path),
            remedy=_REMEDY,
            errno=errno.ENOENT,
        )

    def relock_same_folder(self) -> None:
        """Lock the folder at the path anew; it must have the same id: mounted again, or a copy.

        Files that are open in the former folder are lost: the caller has closed them all.

        Raises:
            FolderGoneError: no folder with its id is there.
            StorageError: another server has locked it.
        """
        if is_locked_folder_in_place(self.path) or self._read_id_at_path() != self.id:
            self.check_still_in_place()
            return
        lock = self._acquire_lock()
        self._lock.close()
        self._lock = lock
        log.warning("%s: the data folder was mounted anew or copied; it is used again", self.path)

    def check_writable(self) -> None:
        """Check that the folder is in place and writable.

        Raises:
            FolderGoneError: it is not in place.
            StorageError: it is not writable.
        """
        self.check_still_in_place()
        # The size of some seconds of frames: a full disk still accepts an empty file.
        write_atomically(self.path / _PROBE_NAME, bytes(_PROBE_BYTES))

    def release_lock(self) -> None:
        """Release the lock."""
        self._lock.close()

    def _describe_path(self) -> str:
        """Describe the content of the path, for an error.

        Raises:
            OSError: it cannot be read.
        """
        found = self._read_id_at_path()
        if found is not None:
            is_ours = found == self.id
            what = (
                "it, or a copy, not used yet," if is_ours else "the data folder of another server"
            )
        elif not self.path.is_dir():
            what = "nothing"
        else:
            what = "another folder" if any(self.path.iterdir()) else "an empty mount point"
        return f"there is {what} in its place"

    def _read_id_at_path(self) -> str | None:
        """Read the id of the folder at the path; None if it has none."""
        with suppress(FileFormatError, FileNotFoundError):
            return read_document(self.path / SERVER_NAME, ServerIdentity).server_id
        return None

    def _acquire_lock(self) -> ExitStack:
        stack = ExitStack()
        stack.enter_context(
            lock_folder(
                self.path,
                refusal_text="another foottile server uses this data folder",
                remedy="Stop it, or choose another folder with --data",
            )
        )
        return stack

    def _read_id(self) -> str | None:
        """Read the id; None if missing or damaged.

        Raises:
            StorageError: it cannot be read now; no new id is made for that.
        """
        path = self.path / SERVER_NAME
        try:
            return read_document(path, ServerIdentity).server_id
        except FileNotFoundError:
            return None
        except FileFormatError as error:
            self.problems.append(
                f"{try_set_aside_and_describe(path, error)}; nodes treat this server as a new one"
            )
            log.warning("%s", self.problems[-1])
            return None

    def _write_id(self, server_id: str) -> str:
        write_document(self.path / SERVER_NAME, ServerIdentity(server_id=server_id))
        return server_id
