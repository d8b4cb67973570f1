"""The server's data folder: its lock, its id, and whether it is still the one under its name."""

from __future__ import annotations

import errno
import logging
import uuid
from contextlib import ExitStack, suppress
from pathlib import Path

from devices.errors import DamagedFileError, FolderGoneError
from storage.durable import (
    is_held,
    locked,
    make_folder,
    put_aside,
    set_aside,
    storage_errors,
    write_whole,
)
from storage.server_id import SERVER_ID_NAME, read_server_id, write_server_id

log = logging.getLogger("foottile.server")

_PROBE_NAME = ".writable"
_PROBE_BYTES = 64 << 10
_COMES_BACK = (
    "Move it back or mount it: the server then goes on by itself, and nodes send again what is "
    "missing"
)


class DataFolder:
    """Held by one server until it is closed.

    A folder that was moved or unmounted is waited for; meanwhile nothing is written under its name.
    It may come back mounted anew, or as a copy, which its id proves: `take_again`.

    Args:
        path: made if absent.

    Raises:
        StorageError: it or its id cannot be read or written, or another server has it.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        with storage_errors(path, "Choose another folder with --data"):
            make_folder(path)
        self._lock = self._locked()
        self.problems: list[str] = []
        """What was found damaged of what is kept here, and what became of it, in words."""
        try:
            if (path / _PROBE_NAME).is_dir():
                set_aside(path / _PROBE_NAME)
            self.id = self._known_id() or self._new_id(uuid.uuid4().hex)
        except BaseException:
            self._lock.close()
            raise

    def check(self) -> None:
        """Whether the folder that is in use is there; from any thread.

        Raises:
            FolderGoneError: it is not, and what is in its place.
            StorageError: that cannot be seen, or its id not be read.
        """
        if is_held(self.path):
            return
        with storage_errors(self.path, _COMES_BACK):
            place = self._place()
        raise FolderGoneError(
            f"the data folder was moved, deleted or unmounted, and nothing is kept: {place}",
            where=str(self.path),
            remedy=_COMES_BACK,
            errno=errno.ENOENT,
        )

    def take_again(self) -> None:
        """Use what is in its place and has its id: the folder, mounted anew, or a copy.

        What is open in the one before takes what is written and keeps it for nobody: the caller has
        closed all of that.

        Raises:
            FolderGoneError: nothing there has its id.
            StorageError: another server has it.
        """
        if is_held(self.path) or self._id_there() != self.id:
            self.check()
            return
        lock = self._locked()
        self._lock.close()
        self._lock = lock
        log.warning("%s: the data folder was mounted anew or copied; it is used again", self.path)

    def check_writable(self) -> None:
        """Whether it is there, and something can be written.

        Raises:
            FolderGoneError: it is not there.
            StorageError: it cannot be written.
        """
        self.check()
        # As much as some seconds of frames: on a full disk an empty file can still be written.
        write_whole(self.path / _PROBE_NAME, bytes(_PROBE_BYTES))

    def close(self) -> None:
        """Let another server have it."""
        self._lock.close()

    def _place(self) -> str:
        """What is in its place, in words.

        Raises:
            OSError: that cannot be seen.
        """
        found = self._id_there()
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

    def _id_there(self) -> str | None:
        """The id of what is in its place; None if it has none."""
        with suppress(DamagedFileError, FileNotFoundError):
            return read_server_id(self.path / SERVER_ID_NAME).id
        return None

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

    def _known_id(self) -> str | None:
        """The id, written anew if it states no checksum; None if there is none, or not any more.

        Raises:
            StorageError: it cannot be read or written now; nobody is given a new name for that.
        """
        path = self.path / SERVER_ID_NAME
        try:
            kept = read_server_id(path)
        except FileNotFoundError:
            return None
        except DamagedFileError as error:
            self.problems.append(f"{put_aside(path, error)}; nodes get to know this server anew")
            log.warning("%s", self.problems[-1])
            return None
        return kept.id if kept.is_proven else self._new_id(kept.id)

    def _new_id(self, made: str) -> str:
        write_server_id(self.path / SERVER_ID_NAME, made)
        return made
