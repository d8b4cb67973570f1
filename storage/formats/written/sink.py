"""File in memory whose content is drained in chunks while it is written."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator
from typing import Any

import pyarrow as pa


class Sink(io.BytesIO):
    """Buffer of written bytes until they are drained; not seekable."""

    def __init__(self) -> None:
        super().__init__()
        self._given = 0

    def seekable(self) -> bool:
        """Return False: drained bytes are gone."""
        return False

    def seek(self, offset: int, whence: int = 0) -> int:
        """Raise UnsupportedOperation: zipfile tries `seek` instead of `seekable`."""
        raise io.UnsupportedOperation("seek")

    def tell(self) -> int:
        """Return the position in the whole file, drained bytes included."""
        return self._given + super().tell()

    def taken(self) -> bytes:
        """Remove and return the bytes written since the last call."""
        piece = self.getvalue()
        self._given += len(piece)
        super().seek(0)
        self.truncate()
        return piece


def in_pieces(
    tables: Iterator[pa.Table], opened: Callable[[Sink, pa.Schema], Any]
) -> Iterator[bytes]:
    """Yield a file of tables: a chunk for each table, and a last chunk for the file's end.

    Args:
        tables: at least one table; all have one schema.
        opened: function that returns a writer with `write_table` and `close`.
    """
    first = next(tables)
    sink = Sink()
    writer = opened(sink, first.schema)
    writer.write_table(first)
    yield sink.taken()
    for table in tables:
        writer.write_table(table)
        yield sink.taken()
    writer.close()
    yield sink.taken()
