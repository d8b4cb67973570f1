"""Bounded parser of Arrow message headers, used before Arrow decodes the message.

A record batch of 68 kB may state that its buffers are compressed and hold 2 GB, and Arrow would
allocate them: it has no option that refuses this. So the header is read here first. It is a
flatbuffer, whose form `pyarrow` has checked by then; only these fields of its tables are needed
(Arrow columnar format, `Message.fbs`), which is less code than a generated reader, and the
`flatbuffers` package checks no bounds in Python. Every read is bounded.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

import pyarrow as pa

RECORD_BATCH = 3
"""Type code of a record batch in `MessageHeader`; 2 is a dictionary, 1 a schema."""
_HEADER_TYPE, _HEADER, _BODY_LENGTH = 1, 2, 3
_LENGTH, _NODES, _BUFFERS, _COMPRESSION, _VARIADIC = range(5)
_PAIR = struct.Struct("<qq")
_PAIRS_MAX = 1024


class HeaderError(ValueError):
    """Header that no message of ours has."""


@dataclass(frozen=True)
class BatchHeader:
    """Header of a record batch.

    Attributes:
        rows: number of rows.
        nodes: rows and nulls of each column; the values of a list follow their list.
        buffers: offset and length of each buffer in the body.
        body_bytes: length of the body.
    """

    rows: int
    nodes: tuple[tuple[int, int], ...]
    buffers: tuple[tuple[int, int], ...]
    body_bytes: int


def parse_uncompressed_batch_header(message: pa.ipc.Message) -> BatchHeader:
    """Parse the header of a record batch; refuse compression and columns of variable length.

    Raises:
        HeaderError: it is no record batch, or is compressed or otherwise unlike ours.
    """
    content = message.metadata.to_pybytes()
    try:
        root = _Table(content, _u32(content, 0))
        if root.read_number(_HEADER_TYPE, "<B") != RECORD_BATCH:
            raise HeaderError(f"it is a {message.type}, and no record batch")
        batch = root.read_table(_HEADER)
        if batch.has_field(_COMPRESSION):
            raise HeaderError("its buffers are compressed, which nothing here writes")
        if batch.has_field(_VARIADIC):
            raise HeaderError("it has columns of variable length")
        return BatchHeader(
            rows=batch.read_number(_LENGTH, "<q"),
            nodes=batch.read_pairs(_NODES),
            buffers=batch.read_pairs(_BUFFERS),
            body_bytes=root.read_number(_BODY_LENGTH, "<q"),
        )
    except struct.error as error:
        raise HeaderError(f"its header is cut: {error}") from error


class _Table:
    """Flatbuffer table; a list of field offsets precedes it."""

    def __init__(self, content: bytes, at: int) -> None:
        self._content = content
        self._at = at
        self._fields = at - _i32(content, at)
        if self._fields < 0:
            raise HeaderError("its header points outside of itself")
        (size,) = struct.unpack_from("<H", content, self._fields)
        self._count = (size - 4) // 2

    def has_field(self, field: int) -> bool:
        """Return whether the table has the field."""
        return bool(self._field_offset(field))

    def read_number(self, field: int, form: str) -> int:
        """Return a number; 0 if the field is missing."""
        offset = self._field_offset(field)
        return int(struct.unpack_from(form, self._content, self._at + offset)[0]) if offset else 0

    def read_table(self, field: int) -> _Table:
        """Return a nested table."""
        return _Table(self._content, self._target_position(field))

    def read_pairs(self, field: int) -> tuple[tuple[int, int], ...]:
        """Return a list of structs of two 64-bit numbers."""
        at = self._target_position(field)
        count = _u32(self._content, at)
        if count > _PAIRS_MAX:
            raise HeaderError(f"it has {count} columns or buffers")
        pairs = [_PAIR.unpack_from(self._content, at + 4 + _PAIR.size * i) for i in range(count)]
        return tuple((int(a), int(b)) for a, b in pairs)

    def _field_offset(self, field: int) -> int:
        if field >= self._count:
            return 0
        return int(struct.unpack_from("<H", self._content, self._fields + 4 + 2 * field)[0])

    def _target_position(self, field: int) -> int:
        if not (offset := self._field_offset(field)):
            raise HeaderError("its header lacks a field")
        return self._at + offset + _u32(self._content, self._at + offset)


def _u32(content: bytes, at: int) -> int:
    return int(struct.unpack_from("<I", content, at)[0])


def _i32(content: bytes, at: int) -> int:
    return int(struct.unpack_from("<i", content, at)[0])
