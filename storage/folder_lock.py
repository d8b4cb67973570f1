"""The lock of a data folder: two that write in it would each undo what the other does."""

from __future__ import annotations

import fcntl
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from devices.errors import StorageError
from storage.durable import storage_errors

LOCK_NAME = ".lock"


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Hold the folder's lock; a running server or node holds it as long as it runs.

    Raises:
        StorageError: somebody else holds it, or it cannot be written.
    """
    with storage_errors(folder):
        lock = (folder / LOCK_NAME).open("a")
    with lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise StorageError(
                "a foottile server or node uses this folder",
                where=str(folder),
                remedy="Stop it first: while it runs, it completes sessions by itself",
            ) from error
        yield
