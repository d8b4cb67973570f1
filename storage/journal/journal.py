"""Journal of one stream on disk: Arrow IPC stream segments, each with an index beside it.

`<folder>/<first_seq>.arrows` begins with the schema message; each batch is appended as the bytes in
which it came. Appending does not wait for the disk; `sync` does, and only synced frames may be
promised. Opening a journal recovers its segments and cuts off incomplete batches. No number is
stored twice: a batch that is stored already is skipped.
"""

from __future__ import annotations

import errno
import shutil
import stat
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import numpy as np

from devices.errors import DamagedFileError, FileFormatError, StorageError, escape_control_chars
from devices.frames import ArrayInfo, Edge, FrameBatch
from storage.durable_files import make_synced_folder, translate_storage_errors
from storage.edges import read_edges
from storage.intervals import CORRUPT, NO_END, Intervals, Losses, union
from storage.journal import time_index
from storage.journal.segment import (
    INDEX_SUFFIX,
    SUFFIX,
    Segment,
    make_free_unread_path,
    read_schema_and_first_offset,
    recover_or_delete_segment,
    set_aside_irregular_or_forbidden_files,
)
from storage.journal.segment_writer import OpenSegments
from storage.journal.stream_notes import StreamNotes
from storage.journal.time_index import BatchIndex, BatchReader, TimeIndex
from storage.message_layout import MAX_MESSAGE_FRAMES
from storage.schema import read_array_info, wire_schema
from storage.wire import EncodedBatch, MessageBatchDecoder, decode_message, encode_frames

RING_DURATION_NS = 600_000_000_000
"""Retention time of frames that no session needs, for pre-roll and for late starts."""
_WINDOW_FRAMES = 1 << 16
"""Frames whose index is in memory at once during a read."""


class Journal:
    """Frames of one stream (one `stream_id` of one node). One thread writes; any may read.

    Args:
        folder: the stream's own folder; created if absent.
        info: description of the stream's array.
        is_write_deferred: appending never waits for the disk. Appended batches wait in memory until
            they are synced or read; batches that the disk then refuses count as stored until
            `disown`.
    """

    def __init__(self, folder: Path, info: ArrayInfo, *, is_write_deferred: bool = False) -> None:
        self.folder = folder
        self.info = info
        self.stored = Intervals()
        """Numbers that were appended, synced or not."""
        self.lost = Losses()
        """Numbers that were or should have been stored, by the reason why they are not."""
        self.problems: list[str] = []
        """Damage found when the journal was opened, and how it was handled, as messages."""
        self._schema = wire_schema(info)
        self._segments: list[Segment] = []
        header = self._schema.serialize().to_pybytes()
        self._open = OpenSegments(folder, header, is_write_deferred=is_write_deferred)
        self._runs = MessageBatchDecoder(self._schema)
        self._instants = TimeIndex(
            lambda seq, is_upper: self.find_batch_t_ns_near(seq, at_or_before=is_upper)
        )
        with translate_storage_errors(folder):
            make_synced_folder(folder)
            self.problems += set_aside_irregular_or_forbidden_files(folder)
            for path in sorted(folder.glob("*" + SUFFIX)):
                segment, damaged, had_batches = recover_or_delete_segment(path, self._schema)
                self.lost.add_if_new(damaged, CORRUPT)
                if segment is not None:
                    self._add_segment(segment)
                elif had_batches:
                    self.problems.append(
                        escape_control_chars(f"{path}: no frame in it is proven by its index")
                    )
            for path in folder.glob("*" + INDEX_SUFFIX):
                # A power cut may lose the name of a segment and keep that of its index. None of its
                # frames was promised then; but a person may have deleted it: set the index aside.
                if not path.with_suffix(SUFFIX).exists():
                    with suppress(OSError):
                        path.rename(make_free_unread_path(path))
        self.lost.remove(self.stored)

    @classmethod
    def open_existing_and_recover(cls, folder: Path, *, is_write_deferred: bool = False) -> Journal:
        """Open an existing journal and recover its segments on disk.

        Raises:
            DamagedFileError: it has no readable segment.
            FileFormatError: another version wrote its notes.
            StorageError: it cannot be read.
        """
        problems: list[str] = []
        with translate_storage_errors(folder):
            notes = StreamNotes.load_or_set_aside(folder, problems)
            info = notes.array_info if notes is not None else _read_segment_description(folder)
        if info is None:
            what = "; ".join(("no readable journal segment", *problems))
            raise DamagedFileError(what, where=str(folder))
        journal = cls(folder, info, is_write_deferred=is_write_deferred)
        journal.problems[:0] = problems
        if notes is not None:
            journal.lost.add_if_new(Intervals(notes.damaged) - journal.stored, CORRUPT)
        return journal

    @property
    def size_bytes(self) -> int:
        """Approximate size on disk."""
        return sum(segment.size_bytes for segment in self._segments)

    @property
    def has_unclosed_segment(self) -> bool:
        """True if a segment accepts batches, or is not closed yet."""
        return bool(self._open.unclosed_paths)

    @property
    def has_segment_to_close(self) -> bool:
        """True if the next sync closes a segment."""
        return self._open.has_segment_to_close

    def describe_reversal_against_stored(self, frames: FrameBatch) -> str:
        """Return a message if time would run back between `frames` and stored ones; else empty.

        Raises:
            StorageError: an index cannot be read.
        """
        with translate_storage_errors(self.folder):
            return self._instants.describe_reversal_against_stored(frames, self.stored)

    def append_new_frames(self, batch: FrameBatch, payload: bytes | None = None) -> Intervals:
        """Append the frames of `batch` that are not stored yet; return their numbers.

        Args:
            batch: frames, `seq` rising by one.
            payload: the batch as it came over the wire; None: it is encoded here.

        Raises:
            StorageError: the disk is full or not writable. The frames that could not be written do
                not count as stored.
        """
        first, last = int(batch.seq[0]), int(batch.seq[-1])
        new = self.stored.missing_in(first, last)
        for a, b in new:
            if (a, b) == (first, last):  # the usual case, without the cost of views
                payload = encode_frames(batch, self._schema) if payload is None else payload
                self._append_to_segment(EncodedBatch.from_frames_and_payload(batch, payload))
            else:
                rows = batch.slice_rows(a - first, b - first + 1)
                edges = () if payload is None else read_edges(payload, self._schema)
                content = encode_frames(rows, self._schema, edges)
                self._append_to_segment(EncodedBatch.from_frames_and_payload(rows, content))
        return new

    def append_unstored_frames_of_message(self, message: EncodedBatch) -> None:
        """Append a message encoded here; decode it only if some frames are stored already.

        Raises:
            StorageError: as for `append_new_frames`.
        """
        if self.stored.missing_in(message.seq_first, message.seq_last) == message.numbers:
            self._append_to_segment(message)
        else:
            self.append_new_frames(decode_message(message.payload, self._schema), message.payload)

    def sync(self) -> None:
        """Return when all earlier batches are on the disk; may run in another thread.

        Raises:
            StorageError: the disk refused.
        """
        self._open.sync()

    def invalidate_batches_wholly_within(self, doubtful_numbers: Intervals) -> None:
        """Remove batches wholly within `doubtful_numbers`; later frames go into new segments.

        In a closed segment they are removed from the index on disk, so that a later copy is the
        valid one after a restart.
        """
        written = self._open.unclosed_paths
        for segment in self._segments:
            if not segment.stored & doubtful_numbers:
                continue
            segment.invalidate_batches_wholly_within_in_memory(doubtful_numbers)
            if segment.path in written:
                segment.has_invalidated_frames = True
            else:
                with suppress(StorageError, OSError):
                    segment.rewrite_and_close_index()
        self._segments = [segment for segment in self._segments if segment.stored]
        self._recompute_stored()
        self._open.close_segments_at_next_sync()

    def read_frames(self, seq_first: int, seq_last: int) -> Iterator[FrameBatch]:
        """Yield the stored frames from `seq_first` to `seq_last`, in order, in pieces.

        Raises:
            DamagedFramesError: a batch on disk is damaged; the error has its numbers.
            StorageError: a segment cannot be read.
        """
        with BatchReader(self._runs) as reader:
            for batches in self._find_batches(seq_first, seq_last):
                for frames in reader.read_frames(batches):
                    begin, end = np.searchsorted(frames.seq, (seq_first, seq_last + 1)).tolist()
                    yield frames.slice_rows(begin, end)

    def read_overlapping_messages(self, seq_first: int, seq_last: int) -> Iterator[EncodedBatch]:
        """Yield the complete batches with any of these frames, in order, as they came.

        Raises:
            DamagedFramesError: a batch on disk is damaged; the error has its numbers.
            StorageError: a segment cannot be read.
        """
        with BatchReader(self._runs) as reader:
            for batches in self._find_batches(seq_first, seq_last):
                yield from reader.read_messages(batches)

    def read_edges(self, seq_first: int, seq_last: int) -> Iterator[Edge]:
        """Yield the edges in messages with these frames, and in the one before; some twice.

        Raises:
            DamagedFramesError, StorageError: as for `read_overlapping_messages`.
        """
        for message in self.read_overlapping_messages(max(0, seq_first - 1), seq_last):
            yield from read_edges(message.payload, self._schema)

    def find_first_batch_seq_since(self, t_ns: int) -> int | None:
        """Return the first stored number at `t_ns` (node's UTC) or later, to a batch.

        It is up to one batch earlier; None if no stored frame is that young.
        """
        self._open.write_waiting()
        return time_index.find_first_batch_seq_since(self._segments, t_ns)

    def find_batch_t_ns_near(self, seq: int, *, at_or_before: bool) -> int | None:
        """Return the end of the newest batch up to `seq`, or the begin of the oldest from it.

        To a batch; None if there is no such frame.
        """
        near = (
            self.stored.restricted_to(0, seq).last
            if at_or_before
            else self.stored.restricted_to(seq, NO_END).first
        )
        if near is None:
            return None
        self._open.write_waiting()
        return time_index.find_batch_t_ns_near(self._segments, near, at_or_before=at_or_before)

    def find_part_last_seq_once_passed(self, t_ns: int, *, part_seq_first: int) -> int | None:
        """Return the last number at `t_ns` or before, if later frames are stored too.

        None while the stream has not passed `t_ns`. Batches before `part_seq_first` are skipped;
        `part_seq_first` - 1 if all others are later.
        """
        self._open.write_waiting()
        return time_index.find_part_last_seq_once_passed(
            self._segments, t_ns, part_seq_first=part_seq_first, read_frames=self.read_frames
        )

    def delete_old_segments(self, before_t_ns: int, keep_numbers: Intervals) -> Intervals:
        """Delete closed segments that end before `before_t_ns`, without any of `keep_numbers`.

        Returns:
            The deleted numbers.

        Raises:
            StorageError: a file cannot be deleted.
        """
        written = self._open.unclosed_paths
        gone = Intervals()
        for segment in list(self._segments):
            if segment.path in written or segment.t_ns_last >= before_t_ns:
                continue
            if segment.stored & keep_numbers:
                continue
            with translate_storage_errors(segment.path):
                segment.delete_files()
            self._segments.remove(segment)
            gone = gone | segment.stored
        if gone:
            self._recompute_stored()
        return gone

    def delete_oldest_unneeded_segment(self, keep_numbers: Intervals) -> Intervals:
        """Delete the oldest closed segment without any of `keep_numbers`; return its numbers.

        Raises:
            StorageError: it cannot be deleted.
        """
        for t_ns in sorted(segment.t_ns_last for segment in self._segments):
            if gone := self.delete_old_segments(t_ns + 1, keep_numbers):
                return gone
        return Intervals()

    def close_and_delete(self) -> None:
        """Close the journal and delete its folder; files that cannot be deleted stay."""
        self._open.close_without_sync()
        self._segments = []
        self.stored = Intervals()
        shutil.rmtree(self.folder, ignore_errors=True)

    def close_segments_at_next_sync(self) -> None:
        """Stop appending to the open segments: the next sync closes them."""
        self._open.close_segments_at_next_sync()

    def close(self) -> None:
        """Sync and close the open segments; a later append opens a new one.

        Raises:
            StorageError: the disk refused.
        """
        self.close_segments_at_next_sync()
        self.sync()

    def _add_segment(self, segment: Segment) -> None:
        """Add a recovered segment; after an invalidation two segments may have equal numbers."""
        if segment.stored & self.stored:
            segment.invalidate_batches_wholly_within_in_memory(self.stored)
        if segment.stored:
            self._segments.append(segment)
            self.stored = self.stored | segment.stored

    def _recompute_stored(self) -> None:
        self._instants.forget_cached_times()
        self.stored = union(segment.stored for segment in self._segments)

    def _append_to_segment(self, message: EncodedBatch) -> None:
        segment, numbers_ = self._open.append(message).segment, message.numbers
        if segment.stored == numbers_:  # its first batch
            self._segments.append(segment)
        self.stored.add(message.seq_first, message.seq_last)
        self._instants.register_message(message, self.stored)
        self.lost.remove(numbers_)

    def _find_batches(self, seq_first: int, seq_last: int) -> Iterator[BatchIndex]:
        """Yield batches with any of these frames, some ten thousand frames at a time."""
        at = max(0, seq_first - MAX_MESSAGE_FRAMES)
        while (held := list(self.stored.restricted_to(at, seq_last))) and held[0][0] <= seq_last:
            at = held[0][0]
            end = min(at + _WINDOW_FRAMES, seq_last + 1)
            self._open.write_waiting()
            found = []
            for segment in list(self._segments):
                if segment.stored and segment.seq_range[0] < end and segment.seq_range[1] >= at:
                    try:
                        records = segment.read_stored_batch_records()
                    except StorageError as error:
                        if error.errno == errno.ENOENT and segment not in self._segments:
                            continue  # pruned meanwhile
                        raise
                    inside = (records["seq_first"] >= at) & (records["seq_first"] < end)
                    found.append((segment.path, records[inside]))
            yield BatchIndex.from_segments(found).skip_before(seq_first)
            at = end


def _read_segment_description(folder: Path) -> ArrayInfo | None:
    """Return the array description of the oldest readable segment; None if there is none."""
    for path in sorted(folder.glob("*" + SUFFIX)):
        with suppress(FileFormatError):
            schema = (
                read_schema_and_first_offset(path)[0]
                if stat.S_ISREG(path.lstat().st_mode)
                else None
            )
            if schema is not None:
                return read_array_info(schema, where=str(path))
    return None
