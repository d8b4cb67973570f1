"""The frames of one stream on disk: Arrow IPC stream segments, each with an index beside it.

`<folder>/<first_seq>.arrows` begins with the schema message; each batch is appended as the bytes in
which it came. Appending does not wait for the disk; `sync` does, and only what was synced may be
promised. Opening a journal takes in the segments that are there and cuts off what is not
whole. Nothing is held twice: a number that is there already is left as it is.
"""

from __future__ import annotations

import errno
import shutil
import stat
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import numpy as np

from devices.errors import DamagedFileError, FileFormatError, StorageError
from devices.frames import ArrayInfo, FrameBatch
from devices.words import printable
from storage.durable import make_folder, storage_errors
from storage.intervals import CORRUPT, NO_END, Intervals, Losses, union
from storage.journal import instants
from storage.journal.instants import Instants
from storage.journal.open_segments import OpenSegments
from storage.journal.reading import Batches, BatchReader
from storage.journal.segment import (
    SUFFIX,
    Segment,
    had_records,
    recover,
    set_aside_no_files,
    unread_of,
)
from storage.journal.segment_format import INDEX_SUFFIX, read_header
from storage.journal.stream_notes import StreamNotes
from storage.layout import FRAMES_MAX
from storage.run import RunReader
from storage.schema import array_info, wire_schema
from storage.wire import EncodedBatch, decode, encode

RING_NS = 600_000_000_000
"""How long frames of no session are kept, for pre-roll and for late starts."""
_WINDOW_FRAMES = 1 << 16
"""Frames whose index is in memory at once while a journal of any length is read."""


class Journal:
    """The frames of one stream (one `boot_id` of one node). One thread writes; any may read.

    Args:
        folder: the stream's own folder; made if absent.
        info: description of the stream's array.
        writes_later: who appends never waits for the disk. What is appended waits in memory until
            it is synced or read, and what the disk then refuses is held until it is disowned.
    """

    def __init__(self, folder: Path, info: ArrayInfo, *, writes_later: bool = False) -> None:
        self.folder = folder
        self.info = info
        self.held = Intervals()
        """Numbers that were appended, synced or not."""
        self.lost = Losses()
        """Numbers that were held, or should have been, and why they are not."""
        self.problems: list[str] = []
        """What was found damaged when it was opened, and what became of it, in words."""
        self._schema = wire_schema(info)
        self._segments: list[Segment] = []
        header = self._schema.serialize().to_pybytes()
        self._open = OpenSegments(folder, header, writes_later=writes_later)
        self._runs = RunReader(self._schema)
        self._instants = Instants(lambda seq, is_upper: self.t_ns_near(seq, newest=is_upper))
        with storage_errors(folder):
            make_folder(folder)
            self.problems += set_aside_no_files(folder)
            for path in sorted(folder.glob("*" + SUFFIX)):
                index = path.with_suffix(INDEX_SUFFIX)
                is_indexed = index.exists() and had_records(path, self._schema)
                segment, damaged = recover(path, self._schema)
                self.lost.add(damaged, CORRUPT)
                if segment is not None:
                    self._take_in(segment)
                elif is_indexed:  # else it was just begun when its process was killed
                    self.problems.append(
                        printable(f"{path}: no frame in it is proven by its index")
                    )
            for path in folder.glob("*" + INDEX_SUFFIX):
                # A power cut may take the name of a segment and leave that of its index. Nothing in
                # it was promised then; but a person may have deleted it, so the index is set aside.
                if not path.with_suffix(SUFFIX).exists():
                    with suppress(OSError):
                        path.rename(unread_of(path))
        self.lost.found(self.held)

    @classmethod
    def open(cls, folder: Path, *, writes_later: bool = False) -> Journal:
        """A journal that is there already; its description is in its notes or its segments.

        Raises:
            DamagedFileError: no readable segment in it.
            FileFormatError: another version wrote its notes.
            StorageError: it cannot be read.
        """
        problems: list[str] = []
        with storage_errors(folder):
            notes = StreamNotes.load_whole(folder, problems)
            info = notes.array_info if notes is not None else _described(folder)
        if info is None:
            said = "; ".join(("no readable journal segment", *problems))
            raise DamagedFileError(said, where=str(folder))
        journal = cls(folder, info, writes_later=writes_later)
        journal.problems[:0] = problems
        if notes is not None:
            journal.lost.add(Intervals(notes.damaged) - journal.held, CORRUPT)
        return journal

    @property
    def size_bytes(self) -> int:
        """What it takes on the disk, nearly."""
        return sum(segment.size_bytes for segment in self._segments)

    @property
    def is_open(self) -> bool:
        """Is a segment open, or not closed yet?"""
        return bool(self._open.paths)

    @property
    def is_closing(self) -> bool:
        """Is a segment to be closed by the next sync?"""
        return self._open.is_closing

    def misplaced(self, frames: FrameBatch) -> str:
        """Why frames cannot stand among those that are held, in words; empty if they can.

        Raises:
            StorageError: an index cannot be read.
        """
        with storage_errors(self.folder):
            return self._instants.misplaced(frames, self.held)

    def append(self, batch: FrameBatch, payload: bytes | None = None) -> Intervals:
        """Hold the frames of `batch` that are not held yet; return their numbers.

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
            if (a, b) == (first, last):  # nearly always; views of the batch would cost a fifth more
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
        self._open.sync()

    def disown(self, doubtful: Intervals) -> None:
        """Stop holding batches within `doubtful`: they could not be synced, or are damaged.

        A segment that was closed forgets them for good, so that a copy that comes later is the one
        that counts after a restart.
        """
        written = self._open.paths
        for segment in self._segments:
            if not segment.held & doubtful:
                continue
            segment.disown(doubtful)
            if segment.path in written:
                segment.is_doubtful = True
            else:
                with suppress(StorageError, OSError):
                    segment.rewrite_index()
        self._segments = [segment for segment in self._segments if segment.held]
        self._recount()
        self._open.retire_all()

    def read(self, seq_first: int, seq_last: int) -> Iterator[FrameBatch]:
        """Frames from `seq_first` to `seq_last` that are held, in order, some thousand at a time.

        Raises:
            DamagedFramesError: a batch on disk is damaged; which one, it says.
            StorageError: a segment cannot be read.
        """
        with BatchReader(self._runs) as reader:
            for batches in self._found(seq_first, seq_last):
                for frames in reader.frames(batches):
                    begin, end = np.searchsorted(frames.seq, (seq_first, seq_last + 1)).tolist()
                    yield frames.rows(begin, end)

    def messages(self, seq_first: int, seq_last: int) -> Iterator[EncodedBatch]:
        """Batches with any of these frames, whole, in order, as the bytes in which they came.

        Raises:
            DamagedFramesError: a batch on disk is damaged; which one, it says.
            StorageError: a segment cannot be read.
        """
        with BatchReader(self._runs) as reader:
            for batches in self._found(seq_first, seq_last):
                yield from reader.messages(batches)

    def first_seq_since(self, t_ns: int) -> int | None:
        """The first number held that was taken at `t_ns` (node's UTC) or later, roughly.

        By whole batches, so up to one batch earlier; None if nothing so young is held.
        """
        self._open.write()
        return instants.first_seq_since(self._segments, t_ns)

    def t_ns_near(self, seq: int, *, newest: bool) -> int | None:
        """Node's UTC of the newest frame held up to `seq`, or of the oldest from `seq` on.

        By whole batches; None if there is no such frame.
        """
        near = self.held.within(0, seq).last if newest else self.held.within(seq, NO_END).first
        if near is None:
            return None
        self._open.write()
        return instants.t_ns_near(self._segments, near, newest=newest)

    def last_seq_until(self, t_ns: int, *, at_least: int) -> int | None:
        """The last number taken at `t_ns` or before, if frames after `t_ns` are held too.

        None while the stream has not passed `t_ns`. Batches before `at_least` are not looked at;
        `at_least` - 1 if all of them were taken later.
        """
        self._open.write()
        return instants.last_seq_until(self._segments, t_ns, at_least=at_least, read=self.read)

    def prune(self, before_t_ns: int, keep: Intervals) -> Intervals:
        """Delete segments that end before `before_t_ns` and hold nothing of `keep`; their numbers.

        Raises:
            StorageError: a file cannot be deleted.
        """
        written = self._open.paths
        gone = Intervals()
        for segment in list(self._segments):
            if segment.path in written or segment.t_ns_last >= before_t_ns:
                continue
            if segment.held & keep:
                continue
            with storage_errors(segment.path):
                segment.delete()
            self._segments.remove(segment)
            gone = gone | segment.held
        if gone:
            self._recount()
        return gone

    def evict(self, keep: Intervals) -> Intervals:
        """Delete the oldest segment that holds nothing of `keep`; its numbers, if there is one.

        Raises:
            StorageError: it cannot be deleted.
        """
        for t_ns in sorted(segment.t_ns_last for segment in self._segments):
            if gone := self.prune(t_ns + 1, keep):
                return gone
        return Intervals()

    def delete(self) -> None:
        """Close the journal and delete all of it."""
        self._open.abandon()
        self._segments = []
        self.held = Intervals()
        shutil.rmtree(self.folder, ignore_errors=True)

    def retire(self) -> None:
        """Take nothing more into what is open: the next sync closes it, an append begins anew."""
        self._open.retire_all()

    def close(self) -> None:
        """Sync what is open and close it; a later append opens a new segment.

        Raises:
            StorageError: the disk refused.
        """
        self.retire()
        self.sync()

    def _take_in(self, segment: Segment) -> None:
        """Take in a segment that was there; what was disowned once may be in two of them."""
        if segment.held & self.held:
            segment.disown(self.held)
        if segment.held:
            self._segments.append(segment)
            self.held = self.held | segment.held

    def _recount(self) -> None:
        self._instants.forget()
        self.held = union(segment.held for segment in self._segments)

    def _write(self, message: EncodedBatch) -> None:
        segment, numbers_ = self._open.append(message).segment, message.numbers
        if segment.held == numbers_:  # its first batch
            self._segments.append(segment)
        self.held.add(message.seq_first, message.seq_last)
        self._instants.note(message, self.held)
        self.lost.found(numbers_)

    def _found(self, seq_first: int, seq_last: int) -> Iterator[Batches]:
        """Batches with any of these frames, some ten thousand frames at a time."""
        at = max(0, seq_first - FRAMES_MAX)
        while (held := list(self.held.within(at, seq_last))) and held[0][0] <= seq_last:
            at = held[0][0]
            end = min(at + _WINDOW_FRAMES, seq_last + 1)
            self._open.write()
            found = []
            for segment in list(self._segments):
                if segment.held and segment.span[0] < end and segment.span[1] >= at:
                    try:
                        records = segment.records()
                    except StorageError as error:
                        if error.errno == errno.ENOENT and segment not in self._segments:
                            continue  # pruned meanwhile
                        raise
                    inside = (records["seq_first"] >= at) & (records["seq_first"] < end)
                    found.append((segment.path, records[inside]))
            yield Batches.of(found).since(seq_first)
            at = end


def _described(folder: Path) -> ArrayInfo | None:
    """The array that the oldest readable segment says it is of; None if there is none."""
    for path in sorted(folder.glob("*" + SUFFIX)):
        with suppress(FileFormatError):
            schema = read_header(path)[0] if stat.S_ISREG(path.lstat().st_mode) else None
            if schema is not None:
                return array_info(schema, where=str(path))
    return None
