"""The frames of one stream on disk: Arrow IPC stream segments, each with an index beside it.

`<folder>/<first_seq>.arrows` begins with the schema message; each batch is appended as the bytes in
which it came. Appending does not wait for the disk; `sync` does, and only what was synced may be
promised to anybody. Opening a journal takes in the segments that are there and cuts off what is not
whole. Nothing is held twice: a number that is there already is left as it is.

Frames may come out of order, newest first and what was missed behind them: two segments are open,
and each takes only what follows its last frame, so that within a file time never runs back.
"""

from __future__ import annotations

import os
import shutil
import threading
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import numpy as np

from devices.errors import DamagedFramesError, FileFormatError, StorageError
from devices.frames import ArrayInfo, FrameBatch
from storage.durable import make_folder, storage_errors, sync_folder
from storage.intervals import Intervals
from storage.journal.segment import SUFFIX, Segment, SegmentWriter, recover
from storage.journal.segment_bytes import payload_of, read_header
from storage.journal.segment_index import numbers
from storage.journal.stream_notes import StreamNotes
from storage.losses import CORRUPT, Losses
from storage.schema import array_info, wire_schema
from storage.wire import FRAMES_MAX, EncodedBatch, decode, encode

SEGMENT_NS = 60_000_000_000
"""A segment is closed after a minute of frames: what is not needed is deleted by segments."""
RING_NS = 600_000_000_000
"""Frames of no session are kept so long, for pre-roll and for what was not recorded in time."""
_OPEN_MAX = 2
_WINDOW_FRAMES = 1 << 16
"""So many frames' index is in memory when a journal of any length is read."""


class Journal:
    """The frames of one stream (one `boot_id` of one node). One thread writes; any may read.

    Args:
        folder: the stream's own folder; made if absent.
        info: description of the stream's array.
    """

    def __init__(self, folder: Path, info: ArrayInfo) -> None:
        self.folder = folder
        self.info = info
        self.held = Intervals()
        """Numbers that were appended, synced or not."""
        self.lost = Losses()
        """Numbers that were held, or should have been, and why they are not."""
        self._schema = wire_schema(info)
        self._header = self._schema.serialize().to_pybytes()
        self._segments: list[Segment] = []
        self._open: list[SegmentWriter] = []
        self._closing: list[SegmentWriter] = []
        self._has_new_names = False
        self._lock = threading.Lock()
        """Guards the lists of writers: `sync` may run in another thread."""
        with storage_errors(folder):
            make_folder(folder)
            for path in sorted(folder.glob("*" + SUFFIX)):
                segment, damaged = recover(path, self._schema)
                self.lost.add(damaged, CORRUPT)
                if segment is not None:
                    self._take_in(segment)
        self.lost.found(self.held)

    @classmethod
    def open(cls, folder: Path) -> Journal:
        """A journal that is there already; its description is in its notes or its segments.

        Raises:
            FileFormatError: no readable segment in it.
            StorageError: it cannot be read.
        """
        with storage_errors(folder):
            with suppress(FileFormatError):
                notes = StreamNotes.load(folder)
                if notes is not None:
                    return cls(folder, notes.array_info)
            for path in sorted(folder.glob("*" + SUFFIX)):
                schema, _ = read_header(path)
                with suppress(FileFormatError):
                    if schema is not None:
                        return cls(folder, array_info(schema, where=str(path)))
        raise FileFormatError("no readable journal segment", where=str(folder))

    @property
    def size_bytes(self) -> int:
        """What it takes on the disk, nearly."""
        return sum(segment.size_bytes for segment in self._segments)

    def append(self, batch: FrameBatch, payload: bytes | None = None) -> Intervals:
        """Hold the frames of `batch` that are not held yet; give back which ones these are.

        Args:
            batch: frames, `seq` rising by one.
            payload: the batch as it came over the wire; else it is encoded here.

        Raises:
            StorageError: the disk is full or not writable. What of the batch could not be written
                is not held then.
        """
        first, last = int(batch.seq[0]), int(batch.seq[-1])
        new = self.held.missing(first, last)
        for a, b in new:
            if (a, b) == (first, last):  # nearly always, and views of it would cost a fifth
                payload = encode(batch, self._schema) if payload is None else payload
                self._write(EncodedBatch.of(batch, payload))
            else:
                rows = batch.rows(a - first, b - first + 1)
                self._write(EncodedBatch.of(rows, encode(rows, self._schema)))
        return new

    def append_message(self, message: EncodedBatch) -> None:
        """The same for a message that this machine has encoded: it is not read again.

        Raises:
            StorageError: as for `append`.
        """
        if self.held.missing(message.seq_first, message.seq_last) == message.numbers:
            self._write(message)
        else:
            self.append(decode(message.payload, self._schema), message.payload)

    def sync(self) -> None:
        """Return when everything appended before is on the disk; may run in another thread.

        Raises:
            StorageError: the disk refused.
        """
        with self._lock:
            closing, self._closing = self._closing, []
            writers = [writer for writer in self._open if writer.has_news]
            has_new_names, self._has_new_names = self._has_new_names, False
        failed: OSError | None = None
        for writer in closing:
            try:
                writer.close()
            except OSError as error:
                failed = error
        with storage_errors(self.folder):
            for writer in writers:
                # A segment that is closed meanwhile was synced by whoever closed it.
                with suppress(ValueError):
                    writer.sync()
            if has_new_names:
                sync_folder(self.folder)
            if failed is not None:
                raise failed

    def disown(self, doubtful: Intervals) -> None:
        """Hold batches within `doubtful` no longer: they could not be synced, or are damaged.

        A segment that was closed forgets them for ever, so that a copy that comes later is the one
        that counts after a restart.
        """
        written = {writer.segment.path for writer in (*self._open, *self._closing)}
        for segment in self._segments:
            if not any(segment.held.within(*interval) for interval in doubtful):
                continue
            for record in segment.records():
                if not (Intervals([numbers(record)]) - doubtful):
                    segment.held = segment.held - Intervals([numbers(record)])
            if segment.path in written:
                segment.is_doubtful = True
            else:
                with suppress(StorageError, OSError):
                    segment.rewrite_index()
        self._segments = [segment for segment in self._segments if segment.held]
        self._count_anew()
        with self._lock:
            self._closing += self._open
            self._open = []

    def read(self, seq_first: int, seq_last: int) -> Iterator[FrameBatch]:
        """Frames from `seq_first` to `seq_last` that are held, in order, a batch at a time.

        Raises:
            DamagedFramesError: a batch on disk is damaged; which one, it says.
            StorageError: a segment cannot be read.
        """
        for message in self.messages(seq_first, seq_last):
            batch, first = decode(message.payload, self._schema), message.seq_first
            yield batch.rows(max(0, seq_first - first), min(len(batch), seq_last - first + 1))

    def messages(self, seq_first: int, seq_last: int) -> Iterator[EncodedBatch]:
        """Batches with any of these frames, whole, in order, as the bytes in which they came.

        Raises:
            DamagedFramesError: a batch on disk is damaged; which one, it says.
            StorageError: a segment cannot be read.
        """
        at = max(0, seq_first - FRAMES_MAX)
        while (held := list(self.held.within(at, seq_last))) and held[0][0] <= seq_last:
            at = held[0][0]
            end = min(at + _WINDOW_FRAMES, seq_last + 1)
            found = []
            for segment in list(self._segments):
                if segment.held and segment.span[0] < end and segment.span[1] >= at:
                    try:
                        records = segment.records()
                    except OSError as error:
                        if isinstance(error, FileNotFoundError) and segment not in self._segments:
                            continue  # pruned meanwhile
                        raise StorageError(
                            f"cannot be read: {error}", where=str(segment.path), errno=error.errno
                        ) from error
                    inside = (records["seq_first"] >= at) & (records["seq_first"] < end)
                    found += [(numbers(r), segment.path, r) for r in records[inside]]
            found.sort(key=lambda item: item[0])
            yield from self._messages_of([item for item in found if item[0][1] >= seq_first])
            at = end

    def first_seq_since(self, t_ns: int) -> int | None:
        """The first number held that was taken at `t_ns` (node's UTC) or later, roughly.

        By whole batches, so up to one batch earlier; None if nothing so young is held.
        """
        young = []
        for segment in self._segments:
            if segment.t_ns_first >= t_ns:
                young.append(segment.span[0])
            elif segment.t_ns_last >= t_ns:
                records = segment.records()
                young.append(int(records["seq_first"][records["t_ns_last"] >= t_ns].min()))
        return min(young, default=None)

    def t_ns_near(self, seq: int, *, newest: bool) -> int | None:
        """Node's UTC of the newest frame held up to `seq`, or of the oldest from `seq` on.

        By whole batches; None if there is no such frame.
        """
        found: list[tuple[int, int]] = []
        reach = [segment.span for segment in self._segments]
        # Of segments that lie beside `seq` altogether only the nearest one counts.
        nearest = (
            max((last for _, last in reach if last <= seq), default=None)
            if newest
            else min((first for first, _ in reach if first >= seq), default=None)
        )
        for segment, (first, last) in zip(self._segments, reach, strict=True):
            if not first <= seq <= last and nearest not in (first, last):
                continue
            records = segment.records()
            if newest:
                records = records[records["seq_first"] <= seq][-1:]
            else:
                records = records[records["seq_first"] + records["count"] > seq][:1]
            name = "t_ns_last" if newest else "t_ns_first"
            found += [(int(r["seq_first"]), int(r[name])) for r in records]
        if not found:
            return None
        return max(found)[1] if newest else min(found)[1]

    def last_seq_until(self, t_ns: int, *, at_least: int) -> int | None:
        """The last number taken at `t_ns` or before, if frames after `t_ns` are held too.

        None while the stream has not passed `t_ns`. Batches before `at_least` are not looked at;
        `at_least` - 1 if all of them were taken later.
        """
        segments = [segment for segment in self._segments if segment.span[1] >= at_least]
        if all(segment.t_ns_last <= t_ns for segment in segments):
            return None
        newest: tuple[int, int] | None = None
        passed = any(segment.t_ns_first > t_ns for segment in segments)
        # Of segments that were taken before `t_ns` altogether only the last one counts.
        before = max((s.span[1] for s in segments if s.t_ns_last <= t_ns), default=None)
        for segment in segments:
            if segment.t_ns_first > t_ns:
                continue
            if segment.t_ns_last <= t_ns and segment.span[1] != before:
                continue
            records = segment.records()
            records = records[records["seq_first"] + records["count"] > at_least]
            passed = passed or bool((records["t_ns_last"] > t_ns).any())
            early = records[records["t_ns_first"] <= t_ns]
            if len(early) and (newest is None or numbers(early[-1]) > newest):
                newest = numbers(early[-1])
        if not passed:
            return None
        if newest is None:
            return at_least - 1
        rows = sum(
            int(np.searchsorted(batch.t_ns, t_ns, side="right")) for batch in self.read(*newest)
        )
        return max(at_least - 1, newest[0] + rows - 1)

    def prune(self, before_t_ns: int, keep: Intervals) -> Intervals:
        """Delete segments that end before `before_t_ns` and hold nothing of `keep`; their numbers.

        Raises:
            StorageError: a file cannot be deleted.
        """
        writers = (*self._open, *self._closing)
        written = {writer.segment.path for writer in writers}
        gone = Intervals()
        for segment in list(self._segments):
            if segment.path in written or segment.t_ns_last >= before_t_ns:
                continue
            if any(keep.within(*interval) for interval in segment.held):
                continue
            with storage_errors(segment.path):
                segment.delete()
            self._segments.remove(segment)
            for interval in segment.held:
                gone.add(*interval)
        if gone:
            self._count_anew()
        return gone

    def evict(self, keep: Intervals) -> Intervals:
        """Delete the oldest segment that holds nothing of `keep`; its numbers, if there is one.

        Raises:
            StorageError: it cannot be deleted.
        """
        ends = sorted(segment.t_ns_last for segment in self._segments)
        for t_ns in ends:
            if gone := self.prune(t_ns + 1, keep):
                return gone
        return Intervals()

    def delete(self) -> None:
        """Close the journal and delete all of it."""
        with suppress(StorageError):
            self.close()
        self._segments = []
        self.held = Intervals()
        shutil.rmtree(self.folder, ignore_errors=True)

    def close(self) -> None:
        """Sync what is open and close it; a later append opens a new segment.

        Raises:
            StorageError: the disk refused.
        """
        with self._lock:
            self._closing += self._open
            self._open = []
        self.sync()

    def _take_in(self, segment: Segment) -> None:
        """Take in a segment that was there; what was disowned once may be in two of them."""
        twice = segment.held & self.held
        if twice:
            for record in segment.records():
                if not (Intervals([numbers(record)]) - self.held):
                    segment.held = segment.held - Intervals([numbers(record)])
        if segment.held:
            self._segments.append(segment)
            for interval in segment.held:
                self.held.add(*interval)

    def _count_anew(self) -> None:
        self.held = Intervals(pair for segment in self._segments for pair in segment.held)

    def _write(self, message: EncodedBatch) -> None:
        first, last = message.seq_first, message.seq_last
        writer = self._writer_for(first, message.t_ns_first)
        try:
            with storage_errors(writer.segment.path):
                writer.append(message)
        except StorageError:
            # Whatever stands at the end of the file now: the next batch begins another one.
            self._retire(writer)
            raise
        if len(list(writer.segment.held)) == 1 and writer.segment.span == (first, last):
            self._segments.append(writer.segment)
        self.held.add(first, last)
        self.lost.found(message.numbers)

    def _writer_for(self, seq_first: int, t_ns: int) -> SegmentWriter:
        """An open segment that these frames may follow in: the one that ends nearest before."""
        fitting = [w for w in self._open if w.segment.span[1] < seq_first]
        if fitting:
            writer = max(fitting, key=lambda w: w.segment.span[1])
            if t_ns - writer.segment.t_ns_first < SEGMENT_NS:
                return writer
            self._retire(writer)
        if len(self._open) >= _OPEN_MAX:
            self._retire(self._open[0])
        # After a failed write the name may be taken.
        path = self.folder / f"{seq_first:020d}{SUFFIX}"
        taken = 1
        while path.exists():
            path = self.folder / f"{seq_first:020d}-{taken}{SUFFIX}"
            taken += 1
        with storage_errors(path):
            writer = SegmentWriter(path, self._header)
        with self._lock:
            self._open.append(writer)
            self._has_new_names = True
        return writer

    def _retire(self, writer: SegmentWriter) -> None:
        """Take nothing more into this segment; the next sync closes it."""
        with self._lock:
            self._open.remove(writer)
            if writer.segment.held:
                self._closing.append(writer)
                return
        writer.abandon()
        with suppress(OSError):
            writer.segment.delete()

    def _messages_of(
        self, found: list[tuple[tuple[int, int], Path, np.void]]
    ) -> Iterator[EncodedBatch]:
        opened: dict[Path, int] = {}
        try:
            for (first, last), path, record in found:
                with storage_errors(path):
                    if path not in opened:
                        opened[path] = os.open(path, os.O_RDONLY)
                    payload = payload_of(opened[path], record)
                if payload is None:
                    raise DamagedFramesError(
                        f"the batch at byte {int(record['offset'])} (frames {first} to {last}) is "
                        "damaged",
                        where=str(path),
                        expected="the bytes that were written, by their CRC-32",
                        seq_first=first,
                        seq_last=last,
                    )
                t_ns = int(record["t_ns_first"]), int(record["t_ns_last"])
                yield EncodedBatch(first, last, *t_ns, payload)
        finally:
            for descriptor in opened.values():
                os.close(descriptor)
