"""Events of the live feed: frames, gaps, stream starts; and their encoding as Arrow messages.

Schema and batches in sequence are an Arrow IPC stream. A buffered batch is encoded once for all
readers of the same columns. The cache is bounded in bytes; the least recently used message is
dropped first. Readers that keep up ask for the newest batches, so these are in it.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Hashable, Iterator
from dataclasses import dataclass
from difflib import get_close_matches
from typing import Any, NamedTuple

import pyarrow as pa

from devices.chips.pressure_chips import get_raw_type
from devices.errors import UsageError
from devices.frames import ArrayInfo
from service.server.estimates.node_estimator import EstimatedBatch
from storage.schema import (
    ARRAY_INFO_KEY,
    ESTIMATE_COLUMNS,
    MEASURED_COLUMNS,
    Column,
    to_flat_column,
)


@dataclass(frozen=True)
class Position:
    """Next frame of a reader."""

    stream_id: str
    seq: int

    def __str__(self) -> str:
        """Return the query to resume from here, as text that programs parse."""
        return f"resume with stream_id={self.stream_id}&from_seq={self.seq}"


@dataclass(frozen=True)
class FrameRows:
    """Consecutive frames of one stream with their estimates, if any."""

    stream_id: str
    batch: EstimatedBatch
    batch_number: int | None = None
    """Number of the buffered batch, if these are all of its rows."""
    is_recomputed: bool = False

    @property
    def first_seq(self) -> int:
        """Number of the first frame."""
        return int(self.batch[0].seq[0])

    @property
    def last_seq(self) -> int:
        """Number of the last frame."""
        return int(self.batch[0].seq[-1])


@dataclass(frozen=True)
class Gap:
    """Frames that are left out, both ends included."""

    stream_id: str
    first_seq: int
    last_seq: int
    reason: str
    """`slow`: the reader was too slow; `late`: the frames did not come in time. Else the loss
    reason."""


@dataclass(frozen=True)
class StreamStart:
    """Start of a stream: the next events are of this stream."""

    stream_id: str
    first_seq: int


FeedEvent = FrameRows | Gap | StreamStart


def slice_batch(batch: EstimatedBatch, begin: int, end: int) -> EstimatedBatch:
    """Return rows `begin` to `end` - 1 of frames and their estimates; unchanged if that is all."""
    frames, columns = batch
    if begin <= 0 and end >= len(frames):
        return batch
    return frames.slice_rows(begin, end), {name: v[begin:end] for name, v in columns.items()}


_CACHE_BYTES_MAX = 4 << 20
"""Limit per node: a second of 64 tiles at 544 Hz, more of fewer."""


class EncodeCache:
    """LRU cache of encoded messages, bounded in bytes."""

    def __init__(self, bytes_max: int = _CACHE_BYTES_MAX) -> None:
        self._messages: OrderedDict[Hashable, bytes] = OrderedDict()
        self._bytes_max = bytes_max
        self.size_bytes = 0
        """Total size of the cached messages."""

    def get(self, key: Hashable) -> bytes | None:
        """Return a message; None if it is not cached."""
        if (message := self._messages.get(key)) is not None:
            self._messages.move_to_end(key)
        return message

    def put(self, key: Hashable, message: bytes) -> None:
        """Add a message that is not cached."""
        self._messages[key] = message
        self.size_bytes += len(message)
        while self.size_bytes > self._bytes_max:
            self.size_bytes -= len(self._messages.popitem(last=False)[1])


ROWS_MAX = 256
"""Limit per message: half a megabyte for 64 tiles."""
_REQUIRED_COLUMNS = ("seq", "t_ns")
"""`seq` is needed to resume a stream, and a number without a time says little."""
RECOMPUTED = pa.field(
    "recomputed",
    pa.bool_(),
    nullable=False,
    metadata={"unit": "1", "description": "estimated again from the journal, not as it came"},
)
_COLUMNS = {column.name: column for column in (*MEASURED_COLUMNS, *ESTIMATE_COLUMNS)}
_FRAMES = {column.name for column in MEASURED_COLUMNS}


class EncodedRows(NamedTuple):
    """Message of frames, and the number of the frame behind them."""

    message: bytes
    next_seq: int


class ArrowEncoder:
    """Encoder for one stream and one selection of columns.

    Args:
        info: array of the stream.
        column_names: names of quantities (`force_n`) or of one tile's (`force_n_0`); none: all.

    Raises:
        UsageError: no column has this name.
    """

    def __init__(self, info: ArrayInfo, column_names: tuple[str, ...]) -> None:
        self._chosen = _select_columns(len(info.tiles), column_names)
        self._key = tuple(name for name, _, _ in self._chosen)
        raw_type = get_raw_type(info.tiles)
        fields = [
            column.make_field(
                name, column.type_for(raw_type), nullable=column.name not in _FRAMES or is_missing
            )
            for name, column, _ in self._chosen
            for is_missing in (
                column.missing_value is not None or pa.types.is_floating(column.type),
            )
        ]
        text = info.model_dump_json().encode()
        self.schema = pa.schema([*fields, RECOMPUTED], metadata={ARRAY_INFO_KEY: text})

    def encode_schema(self) -> bytes:
        """Return the schema's message."""
        return self.schema.serialize().to_pybytes()

    def encode_rows(self, rows: FrameRows, cache: EncodeCache) -> Iterator[EncodedRows]:
        """Yield messages of at most `ROWS_MAX` frames.

        Args:
            rows: the frames.
            cache: encoded messages of the same buffer, from this reader and others.
        """
        seq = rows.batch[0].seq
        for begin in range(0, len(seq), ROWS_MAX):
            end = min(begin + ROWS_MAX, len(seq))
            key = None if rows.batch_number is None else (rows.batch_number, self._key, begin)
            message = None if key is None else cache.get(key)
            if message is None:
                message = self._encode(rows, begin, end)
                if key is not None:
                    cache.put(key, message)
            yield EncodedRows(message, int(seq[end - 1]) + 1)

    def _encode(self, rows: FrameRows, begin: int, end: int) -> bytes:
        frames, columns = rows.batch
        arrays: list[pa.Array[Any]] = []
        for name, column, tile in self._chosen:
            values = getattr(frames, column.name) if column.name in _FRAMES else None
            values = columns.get(column.name) if values is None else values
            if values is None:  # no calibration, no tare, or still compiling
                arrays.append(pa.array([None] * (end - begin), column.type))
                continue
            values = values[begin:end] if tile is None else values[begin:end, tile]
            arrays.append(to_flat_column(column, name, values)[1])
        arrays.append(pa.array([rows.is_recomputed] * (end - begin), pa.bool_()))
        batch = pa.RecordBatch.from_arrays(arrays, schema=self.schema)
        return batch.serialize().to_pybytes()


def _select_columns(
    tiles: int, column_names: tuple[str, ...]
) -> list[tuple[str, Column, int | None]]:
    """Return name, quantity and tile of each column, each once, in the order of `column_names`."""
    by_name: dict[str, tuple[str, Column, int | None]] = {}
    by_quantity: dict[str, list[str]] = {}
    for column in _COLUMNS.values():
        names = column.flat_names(tiles)
        by_quantity[column.name] = names
        for tile, name in enumerate(names):
            by_name[name] = name, column, tile if column.per_tile else None
    chosen: dict[str, None] = {}
    for name in (*_REQUIRED_COLUMNS, *(column_names or _COLUMNS)):
        if name in by_quantity:
            chosen |= dict.fromkeys(by_quantity[name])
        elif name in by_name:
            chosen[name] = None
        else:
            near = get_close_matches(name, [*by_quantity, *by_name], 1)
            raise UsageError(
                f"no column {name[:40]!r} in a live stream of {tiles} tile{'s'[: tiles != 1]}"
                + (f"; did you mean {near[0]!r}?" if near else ""),
                expected=f"some of {', '.join(_COLUMNS)}",
            )
    return [by_name[name] for name in chosen]


def check_columns(info: ArrayInfo, column_names: tuple[str, ...]) -> None:
    """Check that an array has these columns.

    Raises:
        UsageError: it lacks one.
    """
    _select_columns(len(info.tiles), column_names)
