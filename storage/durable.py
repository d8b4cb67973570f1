"""Writing so that it stays written: whole files or none, synced, and errors a user can act on."""

from __future__ import annotations

import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path

from devices.errors import StorageError


def write_whole(path: Path, content: bytes, *, mode: int = 0o666) -> None:
    """Write a file, whole or not at all, and have it on the disk when this returns.

    Args:
        path: the file; one that is there is replaced.
        content: all of it.
        mode: permissions, of which the umask takes its share.

    Raises:
        StorageError: the disk is full or not writable; nothing is left behind then.
    """
    temporary = path.with_name(f".{path.name}.{os.getpid()}-{secrets.token_hex(4)}.tmp")
    try:
        with storage_errors(path):
            with open(temporary, "wb", opener=partial(os.open, mode=mode)) as file:
                file.write(content)
                file.flush()
                os.fsync(file.fileno())
            temporary.replace(path)
            sync_folder(path.parent)
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)


def sync_folder(folder: Path) -> None:
    """Have the names in a folder on the disk: a rename is not, until its folder is synced."""
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


@contextmanager
def storage_errors(path: Path, remedy: str = "") -> Iterator[None]:
    """Turn an OSError of the block into a StorageError that names `path`.

    Raises:
        StorageError: in place of any other OSError.
    """
    try:
        yield
    except StorageError:
        raise
    except OSError as error:
        raise StorageError(
            f"cannot be written: {error}",
            where=str(path),
            remedy=remedy or "Free space on the disk, or write elsewhere",
            errno=error.errno,
        ) from error
