"""A file without a name: bytes that are of use to this process only, and gone with it.

For what would take too much memory and can be made again. Its place on the disk is free as soon as
nobody holds it, however the process ends.
"""

from __future__ import annotations

import os
import tempfile
import weakref
from pathlib import Path
from typing import IO, NamedTuple

import pyarrow as pa

from devices.errors import DamagedFileError, StorageError


class Kept(NamedTuple):
    """Where something is in a scratch file."""

    at: int
    stored: int
    """Bytes that it takes there."""
    size: int
    """Bytes that it has."""


class Scratch:
    """Keeps pieces of bytes, compressed. One thread puts; any may get.

    Args:
        folder: on whose disk.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._file: IO[bytes] | None = None
        self._end = 0

    def put(self, content: bytes) -> Kept:
        """Keep something.

        Raises:
            StorageError: the disk is full or not writable; what was kept before still is.
        """
        stored = pa.compress(content, codec="zstd", asbytes=True)
        try:
            if self._file is None:
                # Open for as long as this object lives.
                self._file = tempfile.TemporaryFile(dir=self._folder, buffering=0)  # noqa: SIM115
                weakref.finalize(self, self._file.close)
            descriptor, written = self._file.fileno(), 0
            while written < len(stored):
                written += os.pwrite(descriptor, stored[written:], self._end + written)
        except OSError as error:
            raise StorageError(
                f"cannot be written: {error.strerror}", where=str(self._folder), errno=error.errno
            ) from error
        kept = Kept(self._end, len(stored), len(content))
        self._end += len(stored)
        return kept

    def get(self, kept: Kept) -> bytes:
        """What was kept.

        Raises:
            DamagedFileError: it is not there any more.
        """
        where = str(self._folder)
        if self._file is None:
            raise DamagedFileError("nothing was kept", where=where)
        try:
            stored = os.pread(self._file.fileno(), kept.stored, kept.at)
            return pa.decompress(stored, kept.size, "zstd", asbytes=True)
        except (OSError, ValueError, pa.ArrowException) as error:
            raise DamagedFileError(f"cannot be read: {error}", where=where) from error
