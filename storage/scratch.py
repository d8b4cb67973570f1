"""Scratch file without a name, for bytes that only this process needs.

For data that would take too much memory and can be made again. The disk space is freed when the
process ends, in whatever way.
"""

from __future__ import annotations

import os
import tempfile
import weakref
from pathlib import Path
from typing import IO, NamedTuple

import pyarrow as pa

from devices.errors import DamagedFileError, StorageError


class ScratchBlock(NamedTuple):
    """Position and sizes of a block in a scratch file."""

    offset: int
    """Offset in bytes."""
    stored_bytes: int
    """Length in the file, compressed."""
    size_bytes: int
    """Length after decompression."""


class ScratchFile:
    """Scratch file of compressed blocks. One thread appends; any may read.

    Args:
        folder: a folder on the disk to use.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._file: IO[bytes] | None = None
        self._end = 0

    def append(self, content: bytes) -> ScratchBlock:
        """Compress and append a block.

        Raises:
            StorageError: the disk is full or not writable; earlier blocks are still there.
        """
        stored = pa.compress(content, codec="zstd", asbytes=True)
        try:
            if self._file is None:
                # Stays open as long as this object lives.
                self._file = tempfile.TemporaryFile(dir=self._folder, buffering=0)  # noqa: SIM115
                weakref.finalize(self, self._file.close)
            descriptor, written = self._file.fileno(), 0
            while written < len(stored):
                written += os.pwrite(descriptor, stored[written:], self._end + written)
        except OSError as error:
            raise StorageError(
                f"cannot be written: {error.strerror}", where=str(self._folder), errno=error.errno
            ) from error
        block = ScratchBlock(self._end, len(stored), len(content))
        self._end += len(stored)
        return block

    def read(self, block: ScratchBlock) -> bytes:
        """Read and decompress a block.

        Raises:
            DamagedFileError: it cannot be read any more.
        """
        where = str(self._folder)
        if self._file is None:
            raise DamagedFileError("the scratch file holds no block", where=where)
        try:
            stored = os.pread(self._file.fileno(), block.stored_bytes, block.offset)
            return pa.decompress(stored, block.size_bytes, "zstd", asbytes=True)
        except (OSError, ValueError, pa.ArrowException) as error:
            raise DamagedFileError(f"cannot be read: {error}", where=where) from error
