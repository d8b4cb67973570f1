"""Where the columns of a message of frames lie in its bytes: its header says it, and nothing else.

A header of the same bytes says the same of every message, so it is checked once, and messages by
the thousand are read as numpy columns without asking Arrow for each.
"""

from __future__ import annotations

from dataclasses import dataclass

import pyarrow as pa

from devices.errors import FileFormatError
from storage.arrow_header import HeaderError, read_header

FRAMES_MAX = 4096
"""Frames in one message; a node sends some ten. More is not what a node sends."""
PREFIX_BYTES = 8
"""Before the header of a message: a mark, and the header's length."""


@dataclass(frozen=True)
class Layout:
    """What the header of a message says.

    Attributes:
        rows: frames in it.
        message_bytes: its length, prefix and header included.
        columns: first byte of each column's values in the message, in the order of the schema, and
            how many bytes they are.
    """

    rows: int
    message_bytes: int
    columns: tuple[tuple[int, int], ...]


def layout_of(message: pa.ipc.Message, schema: pa.Schema) -> Layout:
    """Whether a message is as large as its number of frames makes it, before memory is taken.

    Args:
        message: whose form Arrow has checked.
        schema: of its stream (`storage.schema.wire_schema`).

    Raises:
        FileFormatError: too many frames, or none.
        HeaderError: columns or buffers are not those of so many frames.
    """
    header = read_header(message)
    rows = header.rows
    if not 0 < rows <= FRAMES_MAX:
        raise FileFormatError(f"a message of {rows} frames", expected=f"1 to {FRAMES_MAX} frames")
    nodes: list[tuple[int, int]] = []
    needed_bytes: list[int] = []
    values_at: list[int] = []
    for type_ in schema.types:
        nodes.append((rows, 0))
        needed_bytes.append(0)  # which rows are empty: none
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
    return Layout(rows, body + header.body_bytes, columns)
