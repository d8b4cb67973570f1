"""The server's data folder: its lock, its id, and whether it is still the one under its name."""

from __future__ import annotations

import errno
import re
import threading
import uuid
from contextlib import ExitStack
from pathlib import Path

from devices.errors import FolderGoneError, StorageError
from storage.durable import is_held, locked, make_folder, storage_errors, write_whole

_ID_NAME = "server_id"
_ID = re.compile(r"[0-9a-f]{32}")
_PROBE_BYTES = 64 << 10


class DataFolder:
    """Held by one server until it is closed.

    A folder that was moved or unmounted is waited for: when it is back, which its id proves, it is
    used again. Meanwhile nothing is written under its name.

    Args:
        path: made if absent.

    Raises:
        StorageError: it cannot be written, or another server has it.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._checking = threading.Lock()
        with storage_errors(path, "Choose another folder with --data"):
            make_folder(path)
        self._lock = self._locked()
        try:
            self.id = self._kept_id() or self._new_id()
        except BaseException:
            self._lock.close()
            raise

    def check(self) -> None:
        """Whether it is there; from any thread.

        Raises:
            FolderGoneError: it is not, and what is in its place.
            StorageError: it is back, but another server has it.
        """
        with self._checking:
            if is_held(self.path):
                return
            found = self._kept_id() if self.path.is_dir() else None
            if found == self.id:  # mounted anew, or a copy in its place
                lock = self._locked()
                self._lock.close()
                self._lock = lock
                return
            place = (
                "there is nothing" if not self.path.is_dir() else "there is an empty mount point"
            )
            if found is not None:
                place = "there is the data folder of another server"
            elif self.path.is_dir() and any(self.path.iterdir()):
                place = "there is another folder"
            raise FolderGoneError(
                "the data folder was moved, deleted or unmounted, and nothing is kept: "
                f"{place} in its place",
                where=str(self.path),
                remedy="Move it back or mount it: the server then goes on by itself, and nodes "
                "send again what is missing",
                errno=errno.ENOENT,
            )

    def check_writable(self) -> None:
        """Whether it is there, and something can be written.

        Raises:
            FolderGoneError: it is not there.
            StorageError: it cannot be written.
        """
        self.check()
        # As much as some seconds of frames: on a full disk an empty file can still be written.
        write_whole(self.path / ".writable", bytes(_PROBE_BYTES))

    def close(self) -> None:
        """Let another server have it."""
        self._lock.close()

    def _locked(self) -> ExitStack:
        stack = ExitStack()
        stack.enter_context(
            locked(
                self.path,
                refusal="another foottile server uses this data folder",
                remedy="Stop it, or choose another folder with --data",
            )
        )
        return stack

    def _kept_id(self) -> str | None:
        path = self.path / _ID_NAME
        try:
            kept = path.read_text("utf-8", "replace").strip()
        except FileNotFoundError:
            return None
        except OSError as error:
            raise StorageError(
                f"cannot be read: {error}", where=str(path), errno=error.errno
            ) from error
        return kept if _ID.fullmatch(kept) else None

    def _new_id(self) -> str:
        made = uuid.uuid4().hex
        write_whole(self.path / _ID_NAME, made.encode() + b"\n")
        return made
