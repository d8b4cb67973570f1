"""What an Arrow message says of itself, looked at before anything of it is decoded.

A record batch of 68 kB may say that its buffers are compressed and hold 2 GB, and the Arrow library
would believe it: it has no option that refuses this. So the header is read here first. It is a
flatbuffer, whose form `pyarrow` has checked by then; of its tables only these fields are needed
(Arrow columnar format, `Message.fbs`), which is less than what a generated reader would bring, and
the `flatbuffers` package checks no bounds in Python. Every read is bounded.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

import pyarrow as pa

RECORD_BATCH = 3
"""In `MessageHeader`; 2 is a dictionary, 1 a schema."""
_HEADER_TYPE, _HEADER, _BODY_LENGTH = 1, 2, 3
_LENGTH, _NODES, _BUFFERS, _COMPRESSION, _VARIADIC = range(5)
_PAIR = struct.Struct("<qq")
_PAIRS_MAX = 1024


class HeaderError(ValueError):
    """The header says what no header of ours does."""


@dataclass(frozen=True)
class BatchHeader:
    """A record batch's description of itself.

    Attributes:
        rows: how many.
        nodes: rows and nulls of each column, those inside of lists after their list.
        buffers: offset and length of each buffer in the body.
        body_bytes: length of the body.
    """

    rows: int
    nodes: tuple[tuple[int, int], ...]
    buffers: tuple[tuple[int, int], ...]
    body_bytes: int


def read_header(message: pa.ipc.Message) -> BatchHeader:
    """What a message says of itself.

    Raises:
        HeaderError: it is no record batch, or one that is compressed or otherwise unlike ours.
    """
    content = message.metadata.to_pybytes()
    try:
        root = _Table(content, _u32(content, 0))
        if root.number(_HEADER_TYPE, "<B") != RECORD_BATCH:
            raise HeaderError(f"it is a {message.type}, and no record batch")
        batch = root.table(_HEADER)
        if batch.has(_COMPRESSION):
            raise HeaderError("its buffers are compressed, which nothing here writes")
        if batch.has(_VARIADIC):
            raise HeaderError("it has columns of variable length")
        return BatchHeader(
            rows=batch.number(_LENGTH, "<q"),
            nodes=batch.pairs(_NODES),
            buffers=batch.pairs(_BUFFERS),
            body_bytes=root.number(_BODY_LENGTH, "<q"),
        )
    except struct.error as error:
        raise HeaderError(f"its header is cut: {error}") from error


class _Table:
    """A table of a flatbuffer: a list of where its fields are stands before it."""

    def __init__(self, content: bytes, at: int) -> None:
        self._content = content
        self._at = at
        self._fields = at - _i32(content, at)
        if self._fields < 0:
            raise HeaderError("its header points outside of itself")
        (size,) = struct.unpack_from("<H", content, self._fields)
        self._count = (size - 4) // 2

    def has(self, field: int) -> bool:
        """Is the field there?"""
        return bool(self._offset(field))

    def number(self, field: int, form: str) -> int:
        """A number; 0 if it is not there."""
        offset = self._offset(field)
        return int(struct.unpack_from(form, self._content, self._at + offset)[0]) if offset else 0

    def table(self, field: int) -> _Table:
        """A table."""
        return _Table(self._content, self._pointed(field))

    def pairs(self, field: int) -> tuple[tuple[int, int], ...]:
        """A list of structs of two 64-bit numbers."""
        at = self._pointed(field)
        count = _u32(self._content, at)
        if count > _PAIRS_MAX:
            raise HeaderError(f"it has {count} columns or buffers")
        pairs = [_PAIR.unpack_from(self._content, at + 4 + _PAIR.size * i) for i in range(count)]
        return tuple((int(a), int(b)) for a, b in pairs)

    def _offset(self, field: int) -> int:
        if field >= self._count:
            return 0
        return int(struct.unpack_from("<H", self._content, self._fields + 4 + 2 * field)[0])

    def _pointed(self, field: int) -> int:
        if not (offset := self._offset(field)):
            raise HeaderError("its header lacks a part")
        return self._at + offset + _u32(self._content, self._at + offset)


def _u32(content: bytes, at: int) -> int:
    return int(struct.unpack_from("<I", content, at)[0])


def _i32(content: bytes, at: int) -> int:
    return int(struct.unpack_from("<i", content, at)[0])
