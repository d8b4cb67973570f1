"""A file in memory that is handed on in pieces while it is written."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator
from typing import Any

import pyarrow as pa


class Sink(io.BytesIO):
    """Keeps what was written until it is taken; nobody can go back in it."""

    def __init__(self) -> None:
        super().__init__()
        self._given = 0

    def seekable(self) -> bool:
        """Not in what was handed on."""
        return False

    def seek(self, offset: int, whence: int = 0) -> int:
        """Nobody can; zip files ask so, not by `seekable`."""
        raise io.UnsupportedOperation("seek")

    def tell(self) -> int:
        """Position in the whole file, of which only the end is kept here."""
        return self._given + super().tell()

    def taken(self) -> bytes:
        """What was written since."""
        piece = self.getvalue()
        self._given += len(piece)
        super().seek(0)
        self.truncate()
        return piece


def in_pieces(
    tables: Iterator[pa.Table], opened: Callable[[Sink, pa.Schema], Any]
) -> Iterator[bytes]:
    """A file of tables, in as many chunks, and its end.

    Args:
        tables: one at least, all with one schema.
        opened: gives a writer with `write_table` and `close`.
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
