"""The lock of a folder: two processes that write in it would each undo what the other does."""

from __future__ import annotations

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from devices.errors import StorageError
from storage.durable import storage_errors

LOCK_NAME = ".lock"


@contextmanager
def locked(
    folder: Path,
    *,
    is_shared: bool = False,
    refusal: str = "a foottile server or node uses this folder",
    remedy: str = "Stop it first: while it runs, it completes sessions by itself",
) -> Iterator[None]:
    """Hold the folder's lock; a running server or node holds it as long as it runs.

    Args:
        folder: must be there.
        is_shared: others that hold it shared do not matter.
        refusal: what is said if another process holds it.
        remedy: what to do then.

    Raises:
        StorageError: another process holds it (`errno` is None), or it cannot be opened.
    """
    with storage_errors(folder):
        # To read is enough for a lock, and possible on a disk that takes nothing any more.
        descriptor = os.open(folder / LOCK_NAME, os.O_RDONLY | os.O_CREAT, 0o666)
    try:
        fcntl.flock(descriptor, (fcntl.LOCK_SH if is_shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
    except BlockingIOError as error:
        os.close(descriptor)
        raise StorageError(refusal, where=str(folder), remedy=remedy) from error
    try:
        yield
    finally:
        os.close(descriptor)
