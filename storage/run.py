"""Many messages of a stream, read at once: what a loop over batches does, column by column.

A batch of 25 ms costs as much to decode as thousands of frames, and a journal has 140,000 of them
an hour. So the bytes of a run of batches are held against their checksums one by one, which is
cheap, and everything else is looked at for all of them together. Where anything is not as it
should be the answer is that it is not: who reads then goes batch by batch, and finds out which.
"""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from devices.arrays import Ints
from devices.errors import FileFormatError
from devices.facts import SEQ_END
from devices.frames import FRAME_COLUMNS, FrameBatch
from storage.layout import Layout, Layouts

Numbers = npt.NDArray[np.integer[Any]]


@dataclass(frozen=True)
class Run:
    """Messages that stand one behind the other in memory, and what an index says of them.

    Attributes:
        content: their bytes.
        length: of each message.
        seq_first: number of each message's first frame, rising.
        count: frames of each message.
        crc32: of each message's bytes.
    """

    content: bytes
    length: Numbers
    seq_first: Numbers
    count: Numbers
    crc32: Numbers


class RunReader:
    """Reads runs of one stream. May be used from several threads.

    Args:
        schema: of the stream (`storage.schema.wire_schema`).
    """

    def __init__(self, schema: pa.Schema) -> None:
        self.schema = schema
        self._layouts = Layouts(schema)

    def read(self, run: Run) -> FrameBatch | None:
        """The frames of all messages, copied; None if `decode` or the index says otherwise of one.

        Whether the frames keep to the rules of their stream is not asked.
        """
        ends = np.cumsum(run.length, dtype=np.int64)
        begins = ends - run.length.astype(np.int64)
        if not len(ends) or ends[-1] != len(run.content):
            return None
        layouts = self._checked(run, begins.tolist(), ends.tolist())
        if layouts is None:
            return None
        frames = _joined(run, begins, layouts, self.schema)
        return frames if _is_in_order(frames, run) else None

    def _checked(self, run: Run, begins: Sequence[int], ends: Sequence[int]) -> list[Layout] | None:
        """The layout of each message; None if one is not what was written, or not ours."""
        view = memoryview(run.content)
        found = []
        indexed = zip(begins, ends, run.count.tolist(), run.crc32.tolist(), strict=True)
        for begin, end, count, crc32 in indexed:
            message = view[begin:end]
            if zlib.crc32(message) != crc32:
                return None
            try:
                layout = self._layouts.of(message)
            except FileFormatError:
                return None
            if layout.rows != count:
                return None
            found.append(layout)
        return found


def _joined(run: Run, begins: Ints, layouts: Sequence[Layout], schema: pa.Schema) -> FrameBatch:
    """The frames of messages that are known to be whole, copied into columns of their own."""
    count = run.count.astype(np.int64)
    row = np.cumsum(count) - count
    total = int(count.sum())
    tiles = schema.field("padc").type.list_size
    columns = {
        name: np.empty((total, tiles) if per_tile else total, dtype)
        for name, (dtype, per_tile) in FRAME_COLUMNS.items()
    }
    alike: dict[int, list[int]] = {}
    for number, layout in enumerate(layouts):
        alike.setdefault(id(layout), []).append(number)
    for numbers in alike.values():
        layout = layouts[numbers[0]]
        rows = (row[numbers, None] + np.arange(layout.rows)).reshape(-1)
        for name, (offset, size) in zip(schema.names, layout.columns, strict=True):
            if not size:
                continue
            column = columns[name]
            # Every stretch of so many bytes; those that begin where a message has the column.
            shape = len(run.content) - size + 1, size
            stretches = np.ndarray(shape, np.uint8, run.content, strides=(1, 1))
            found = stretches[begins[numbers] + offset].view(column.dtype)
            column[rows] = found.reshape(len(rows), *column.shape[1:])
    return FrameBatch(**columns)


def _is_in_order(frames: FrameBatch, run: Run) -> bool:
    """Are the frames those of the index, and rise their numbers, and time within each message?"""
    first, count = run.seq_first.astype(np.uint64), run.count.astype(np.uint64)
    row = (np.cumsum(count) - count).astype(np.int64)
    number = np.arange(len(frames), dtype=np.uint64)
    expected = np.repeat(first - row.astype(np.uint64), run.count) + number  # modulo 2^64
    back = frames.t_mono_ns[1:] < frames.t_mono_ns[:-1]
    back[row[1:] - 1] = False
    return bool(
        (frames.seq == expected).all()
        and (first[1:] >= first[:-1] + count[:-1]).all()
        and int(first[-1] + count[-1]) <= SEQ_END
        and not back.any()
    )
