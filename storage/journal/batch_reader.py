"""Reader of a journal's batches, found by the indexes of its segments, as messages or frames.

Frames are returned in pieces of thousands, independent of the batches: a piece is read and decoded
at once, and batch by batch only if a check fails.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from devices.arrays import Ints
from devices.errors import DamagedFramesError, StorageError
from devices.frames import FrameBatch
from storage.durable_files import translate_storage_errors
from storage.journal.segment_format import (
    RECORD_DTYPE,
    Records,
    make_message_batch,
    read_verified_payload,
    seq_range_of,
)
from storage.message_batch import MessageBatchDecoder
from storage.wire import EncodedBatch, decode_message

PIECE_FRAMES = 4096
"""Frames in a piece, unless one message has more: as many as the estimator handles at a time."""
_MAX_OPEN_FILES = 8
"""Upper limit of open segments; out-of-order frames alternate between two or three."""


@dataclass(frozen=True)
class BatchIndex:
    """Index records of batches in order of their frames.

    Attributes:
        records: index records.
        paths: segments.
        segment_number: int64, index of each batch's segment in `paths`.
    """

    records: Records
    paths: Sequence[Path]
    segment_number: Ints

    @classmethod
    def from_segments(cls, records_by_path: Sequence[tuple[Path, Records]]) -> BatchIndex:
        """Merge the records of several segments, in order of their frames."""
        records = np.concatenate(
            [np.zeros(0, RECORD_DTYPE), *(records for _, records in records_by_path)]
        )
        segment = np.repeat(
            np.arange(len(records_by_path)), [len(records) for _, records in records_by_path]
        )
        order = np.lexsort((records["count"], records["seq_first"]))
        return cls(records[order], [path for path, _ in records_by_path], segment[order])

    def __len__(self) -> int:
        return len(self.records)

    def skip_before(self, seq: int) -> BatchIndex:
        """Return the batches that do not end before this number."""
        keep = self.records["seq_first"] + self.records["count"] > seq
        return BatchIndex(self.records[keep], self.paths, self.segment_number[keep])

    def split_by_frame_count(self) -> Iterator[BatchIndex]:
        """Split the batches into groups of up to `PIECE_FRAMES` frames."""
        frames = np.cumsum(self.records["count"], dtype=np.int64)
        begin = before = 0
        while begin < len(self):
            end = int(np.searchsorted(frames, before + PIECE_FRAMES, side="right"))
            end = max(end, begin + 1)
            yield BatchIndex(self.records[begin:end], self.paths, self.segment_number[begin:end])
            begin, before = end, int(frames[end - 1])


class BatchReader:
    """Reader of batches; it keeps the last segments open until it is closed.

    Args:
        decoder: decoder of the stream.
    """

    def __init__(self, decoder: MessageBatchDecoder) -> None:
        self._runs = decoder
        self._opened: dict[Path, int] = {}

    def __enter__(self) -> BatchReader:
        return self

    def __exit__(self, *_: object) -> None:
        with ExitStack() as stack:
            for descriptor in self._opened.values():
                stack.callback(os.close, descriptor)

    def read_messages(self, batches: BatchIndex) -> Iterator[EncodedBatch]:
        """Yield each batch as the bytes in which it came.

        Raises:
            DamagedFramesError: a batch on disk is damaged; the error has its numbers.
            StorageError: a segment cannot be read.
        """
        for record, at in zip(batches.records, batches.segment_number.tolist(), strict=True):
            path = batches.paths[at]
            first, last = seq_range_of(record)
            with translate_storage_errors(path):
                payload = read_verified_payload(self._open_segment(path), record)
            if payload is None:
                raise _damage_error(path, record, "the bytes that were written, by their CRC-32")
            t_ns = int(record["t_ns_first"]), int(record["t_ns_last"])
            yield EncodedBatch(first, last, *t_ns, payload)

    def read_frames(self, batches: BatchIndex) -> Iterator[FrameBatch]:
        """Yield the frames in pieces; those before an unreadable batch come before its error.

        Raises:
            DamagedFramesError: as for `read_messages`.
            FileFormatError: a batch is undamaged but holds no frames of this stream.
            StorageError: as for `read_messages`.
        """
        for piece in batches.split_by_frame_count():
            try:
                content = self._read_bytes(piece)
            except StorageError:  # a bad sector is in one batch: read those before it
                content = b""
            frames = self._runs.decode(make_message_batch(piece.records, content))
            if frames is not None:
                yield frames
                continue
            for at, message in enumerate(self.read_messages(piece)):
                frames = decode_message(message.payload, self._runs.schema)
                if (
                    EncodedBatch.from_frames_and_payload(frames, message.payload).numbers
                    != message.numbers
                ):
                    path = piece.paths[piece.segment_number[at]]
                    raise _damage_error(path, piece.records[at], "the frames that its index says")
                yield frames

    def _read_bytes(self, batches: BatchIndex) -> bytes:
        """Read the bytes of adjacent batches; fewer if a segment was cut."""
        records, segment = batches.records, batches.segment_number
        ends = records["offset"] + records["length"]
        breaks = (segment[1:] != segment[:-1]) | (records["offset"][1:] != ends[:-1])
        stretches = []
        for begin, end in pairwise([0, *(np.flatnonzero(breaks) + 1).tolist(), len(records)]):
            path = batches.paths[segment[begin]]
            offset = int(records["offset"][begin])
            with translate_storage_errors(path):
                length = int(ends[end - 1]) - offset
                stretches.append(os.pread(self._open_segment(path), length, offset))
        return b"".join(stretches)

    def _open_segment(self, path: Path) -> int:
        if path not in self._opened:
            if len(self._opened) >= _MAX_OPEN_FILES:  # a session of hours has hundreds
                os.close(self._opened.pop(next(iter(self._opened))))
            self._opened[path] = os.open(path, os.O_RDONLY)
        return self._opened[path]


def _damage_error(path: Path, record: np.void, expected: str) -> DamagedFramesError:
    first, last = seq_range_of(record)
    return DamagedFramesError(
        f"the batch at byte {int(record['offset'])} (frames {first} to {last}) is damaged",
        where=str(path),
        expected=expected,
        seq_first=first,
        seq_last=last,
    )
