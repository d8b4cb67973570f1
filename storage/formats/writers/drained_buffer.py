"""File in memory whose content is drained in chunks while it is written."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator
from typing import Any

import pyarrow as pa


class DrainedBuffer(io.BytesIO):
    """Buffer of written bytes until they are drained; not seekable."""

    def __init__(self) -> None:
        super().__init__()
        self._drained_bytes = 0

    def seekable(self) -> bool:
        """Return False: drained bytes are gone."""
        return False

    def seek(self, offset: int, whence: int = 0) -> int:
        """Raise UnsupportedOperation: zipfile tries `seek` instead of `seekable`."""
        raise io.UnsupportedOperation("seek")

    def tell(self) -> int:
        """Return the position in the whole file, drained bytes included."""
        return self._drained_bytes + super().tell()

    def drain(self) -> bytes:
        """Remove and return the bytes written since the last call."""
        piece = self.getvalue()
        self._drained_bytes += len(piece)
        super().seek(0)
        self.truncate()
        return piece


def encode_tables(
    tables: Iterator[pa.Table], open_writer: Callable[[DrainedBuffer, pa.Schema], Any]
) -> Iterator[bytes]:
    """Yield a file of tables: a chunk for each table, and a last chunk for the file's end.

    Args:
        tables: at least one table; all have one schema.
        open_writer: function that returns a writer with `write_hashed_table` and `close`.
    """
    first = next(tables)
    sink = DrainedBuffer()
    writer = open_writer(sink, first.schema)
    writer.write_table(first)
    yield sink.drain()
    for table in tables:
        writer.write_table(table)
        yield sink.drain()
    writer.close()
    yield sink.drain()
