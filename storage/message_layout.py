"""Byte layout of messages of frames: where each column lies, by the message's header.

Messages with equal headers have equal layouts. So a header is checked once, by Arrow and here, and
thousands of messages are then read as numpy columns without parsing each by Arrow.

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

from devices.errors import FileFormatError
from storage.edges import EDGES_KEY, read_edges
from storage.schema import frames_from_record_batch

_RECORD_BATCH = 3
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


def _parse_uncompressed_batch_header(message: pa.ipc.Message) -> BatchHeader:
    """Parse the header of a record batch; refuse compression and columns of variable length.

    Raises:
        HeaderError: it is no record batch, or is compressed or otherwise unlike ours.
    """
    content = message.metadata.to_pybytes()
    try:
        root = _Table(content, _u32(content, 0))
        if root.read_number(_HEADER_TYPE, "<B") != _RECORD_BATCH:
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


MAX_MESSAGE_FRAMES = 4096
"""Upper limit of frames in one message; a node sends some ten."""
PREFIX_BYTES = 8
"""Length of the marker and the header's length, before the header of a message."""
_CONTINUATION_MARKER = b"\xff\xff\xff\xff"
"""First bytes of a message.

Arrow also reads older messages without it, whose header and body begin four bytes earlier: there
the computed offsets would be wrong.
"""
_MAX_CACHED_HEADERS = 256
"""Upper limit of cached headers; a node's batches have two or three different ones."""
_MAX_CACHED_HEADER_BYTES = 4096
"""Longest cached header: ours take some 700 bytes, a stranger's up to a megabyte."""


@dataclass(frozen=True)
class MessageLayout:
    """Byte layout of a message, from its header.

    Attributes:
        rows: number of frames.
        message_bytes: length of the message, prefix and header included.
        columns: offset and length in bytes of each column's values in the message, in the order of
            the schema.
    """

    rows: int
    message_bytes: int
    columns: tuple[tuple[int, int], ...]


def check_and_compute_layout(message: pa.ipc.Message, schema: pa.Schema) -> MessageLayout:
    """Compute a message's layout; check that its size fits its number of frames first.

    Args:
        message: a message whose form Arrow has checked.
        schema: schema of its stream (`storage.schema.wire_schema`).

    Raises:
        FileFormatError: it has no frames, or too many.
        HeaderError: columns or buffers do not fit that many frames.
    """
    header = _parse_uncompressed_batch_header(message)
    rows = header.rows
    if not 0 < rows <= MAX_MESSAGE_FRAMES:
        raise FileFormatError(
            f"a message of {rows} frames", expected=f"1 to {MAX_MESSAGE_FRAMES} frames"
        )
    nodes: list[tuple[int, int]] = []
    needed_bytes: list[int] = []
    values_at: list[int] = []
    for type_ in schema.types:
        nodes.append((rows, 0))
        needed_bytes.append(0)  # validity bitmap: empty, no row is null
        values, value_type = rows, type_
        if isinstance(type_, pa.FixedSizeListType):
            values, value_type = rows * type_.list_size, type_.value_type
            nodes.append((values, 0))
            needed_bytes.append(0)
        values_at.append(len(needed_bytes))
        needed_bytes.append(values * value_type.bit_width // 8)
    if list(header.nodes) != nodes:
        raise HeaderError(f"its columns are not those of {rows} frames without empty values")
    if len(header.buffers) != len(needed_bytes):
        raise HeaderError(f"{len(header.buffers)} buffers instead of {len(needed_bytes)}")
    end = 0
    for (offset, length), needed in zip(header.buffers, needed_bytes, strict=True):
        if length < needed:
            raise HeaderError(f"a column of {length} bytes where {needed} are needed")
        if length and (offset < end or offset + length > header.body_bytes):
            raise HeaderError("its buffers overlap, or reach outside of it")
        end = max(end, offset + length if length else 0)
    body = PREFIX_BYTES + message.metadata.size
    columns = tuple((body + header.buffers[at][0], needed_bytes[at]) for at in values_at)
    return MessageLayout(rows, body + header.body_bytes, columns)


class MessageLayoutCache:
    """Cache of message layouts by header, for one stream. Thread-safe.

    Args:
        schema: schema of the stream (`storage.schema.wire_schema`).
    """

    def __init__(self, schema: pa.Schema) -> None:
        self.schema = schema
        self._cache: dict[bytes, MessageLayout] = {}

    def validate_and_get_layout(self, message: bytes | memoryview) -> MessageLayout:
        """Return the layout of a message; validate a header that is not cached yet.

        Raises:
            FileFormatError: it is no message of this stream, or is cut off.
        """
        head = bytes(message[: PREFIX_BYTES + int.from_bytes(message[4:PREFIX_BYTES], "little")])
        layout = self._cache.get(head)
        try:
            if layout is None:
                layout = self._validate_and_cache(message, head)
            if layout.message_bytes != len(message):
                raise HeaderError(f"it has {len(message)} bytes, not those its header states")
        except (pa.ArrowException, EOFError, OSError, ValueError, IndexError) as error:
            raise FileFormatError(
                f"no Arrow message of frames: {error}",
                expected="a record batch of the schema announced in hello",
            ) from error
        return layout

    def _validate_and_cache(self, message: bytes | memoryview, head: bytes) -> MessageLayout:
        if not head.startswith(_CONTINUATION_MARKER):
            raise HeaderError("it does not begin as messages do since Arrow 0.15")
        found = pa.ipc.read_message(pa.py_buffer(message))
        layout = check_and_compute_layout(found, self.schema)
        if layout.message_bytes == len(message):
            record = pa.ipc.read_record_batch(found, self.schema)
            record.validate(full=True)  # checks the values, which the header does not describe
            frames_from_record_batch(record)
            if EDGES_KEY in head:
                read_edges(message, self.schema)  # its header is like no other's
            elif len(head) <= _MAX_CACHED_HEADER_BYTES:
                if len(self._cache) >= _MAX_CACHED_HEADERS:
                    self._cache.clear()
                self._cache[head] = layout
        return layout
