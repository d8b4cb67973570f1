"""One stream on a node: its journal on disk, and the batches in memory.

A batch first waits in memory, then it is written, then synced. It is released from memory only
after a successful sync: a kernel that could not write it may have dropped it, and then it is
written once more.
"""

from __future__ import annotations

import shutil
import threading
import time
from collections import deque
from collections.abc import Iterable, Iterator
from contextlib import suppress
from itertools import takewhile
from pathlib import Path

from devices.errors import DamagedFileError, StorageError
from storage.durable_files import try_set_aside_and_describe
from storage.edges import read_edges_in_flight
from storage.intervals import CORRUPT, EVICTED, NODE_BUSY, Intervals, Losses, union
from storage.journal.journal import Journal
from storage.journal.node.in_flight import (
    IN_FLIGHT_FILE,
    read_newest_in_flight_run,
    try_delete_in_flight_file,
)
from storage.journal.node.retention import RetentionRequests
from storage.journal.stream_notes import MAX_UNSYNCED_S, StreamNotes, compute_max_lost_tail_frames
from storage.wire import EncodedBatch, encode_as_messages


class BatchQueue:
    """Queue of batches, oldest first, with its size in bytes."""

    def __init__(self) -> None:
        self.batches: deque[EncodedBatch] = deque()
        self.size_bytes = 0

    @property
    def frame_count(self) -> int:
        """Number of frames in the queue."""
        return sum(batch.seq_last - batch.seq_first + 1 for batch in self.batches)

    def append(self, batch: EncodedBatch) -> None:
        """Append the newest batch."""
        self.batches.append(batch)
        self.size_bytes += len(batch.payload)

    def popleft(self) -> EncodedBatch:
        """Remove and return the oldest batch."""
        batch = self.batches.popleft()
        self.size_bytes -= len(batch.payload)
        return batch

    def prepend(self, batches: Iterable[EncodedBatch]) -> None:
        """Put removed batches back, before all others."""
        given = list(batches)
        self.batches.extendleft(reversed(given))
        self.size_bytes += sum(len(batch.payload) for batch in given)


MAX_RECENT_BYTES = 4 << 20
"""Memory for the newest frames, for the live picture."""


class NodeStream:
    """Frames of one stream, in memory or on disk.

    Thread-safe; attributes are read-only for callers. Only one thread, the writer, calls the
    methods of the last section. The lock is never held during disk I/O.

    Args:
        folder: the stream's own.
        notes: its notes.
        journal: its journal; None: not created yet, since the disk refused it or is still to be
            tried.
    """

    def __init__(self, folder: Path, notes: StreamNotes, journal: Journal | None) -> None:
        self.folder = folder
        self.info = notes.array_info
        self.stream_id = self.info.stream_id
        self.notes = notes
        """Notes in `stream.json`, or still to be written there."""
        self.journal = journal
        """Journal to read from; None until the disk lets it be created."""
        self.missed_slots = notes.missed_slots
        """Slots without a frame."""
        self.has_ended = notes.has_ended
        """True if no more frames will come."""
        self.is_complete_on_disk = notes.has_ended
        """True if all frames are on disk, with a note of where the stream ended."""
        self._lock = threading.Lock()
        self._saved_losses = notes.lost
        self._lost = Losses(notes.lost)
        self._acked_by: dict[str, Intervals] = {}
        self._waiting = BatchQueue()
        """Batches that are not in the journal yet."""
        self._unsynced: list[EncodedBatch] = []
        """Batches in the journal that may not be on the disk yet."""
        self._waiting_since_s: float | None = None
        """Arrival of the oldest batch that may not be on the disk yet."""
        self._recent = BatchQueue()
        if journal is not None:
            self._lost.remove(journal.stored)
            for reason, numbers in journal.lost.by_reason.items():
                self._lost.add_if_new(numbers, reason)
        last = (self.stored | self._lost.numbers).last
        recovered_seq = 0 if last is None else last + 1
        self.next_seq = recovered_seq if notes.next_seq is None else notes.next_seq
        """Number of the next frame."""

    # --- state ------------------------------------------------------------------------------------

    @property
    def is_synced(self) -> bool:
        """True if every batch is on the disk."""
        with self._lock:
            return not self._waiting.batches and not self._unsynced

    @property
    def unwritten_bytes(self) -> int:
        """Bytes that wait in memory to be written."""
        return self._waiting.size_bytes

    @property
    def waiting_frames_duration_s(self) -> float:
        """Duration of the frames that wait in memory to be written, s."""
        with self._lock:
            return self._waiting.frame_count / self.info.nominal_rate_hz

    @property
    def available(self) -> Intervals:
        """Numbers that can be sent: on disk, or waiting for it."""
        with self._lock:
            waiting = Intervals((b.seq_first, b.seq_last) for b in self._waiting.batches)
            return self.stored | waiting

    @property
    def stored(self) -> Intervals:
        """Numbers in the journal."""
        return Intervals(self.journal.stored if self.journal is not None else ())

    @property
    def lost(self) -> Losses:
        """Numbers that are neither here nor on a server, by reason."""
        with self._lock:
            return Losses(self._lost.by_reason)

    @property
    def acked(self) -> Intervals:
        """Numbers that are on any server's disk."""
        with self._lock:
            return self._union_of_acked()

    def available_undelivered_numbers(self, requests: RetentionRequests) -> Intervals:
        """Return the available numbers that servers need and have not acknowledged."""
        held = self.available
        with self._lock:
            return held & requests.undelivered_numbers_of(self.stream_id, self._acked_by)

    def numbers_to_retain(self, requests: RetentionRequests) -> Intervals:
        """Return the numbers that must not be deleted."""
        with self._lock:
            return requests.node_session_or_undelivered_numbers(self.stream_id, self._acked_by)

    # --- frames in and out ------------------------------------------------------------------------

    def queue_batch_and_record_gap(
        self,
        batch: EncodedBatch,
        total_missed_slots: int | None = None,
        *,
        gap_reason: str = NODE_BUSY,
    ) -> None:
        """Append a batch to the memory queue, and record skipped numbers before it as lost.

        Args:
            batch: the frames.
            total_missed_slots: count since the stream began; None: unchanged.
            gap_reason: reason of loss for skipped numbers before this batch.
        """
        with self._lock:
            if batch.seq_first > self.next_seq:
                self._lost.add_if_new(Intervals([(self.next_seq, batch.seq_first - 1)]), gap_reason)
            if self._waiting_since_s is None:
                self._waiting_since_s = time.monotonic()
            self._waiting.append(batch)
            self._recent.append(batch)
            while self._recent.size_bytes > MAX_RECENT_BYTES and len(self._recent.batches) > 1:
                self._recent.popleft()
            self.next_seq = max(self.next_seq, batch.seq_last + 1)
            if total_missed_slots is not None:
                self.missed_slots = total_missed_slots

    def mark_ended_in_memory(self, **changes: object) -> None:
        """Mark the stream as ended and change its notes, both in memory."""
        with self._lock:
            self.has_ended = True
        self.update_notes_in_memory(**changes)

    def record_acknowledgement(self, server_id: str, seq_first: int, seq_last: int) -> None:
        """Record that these frames are on a server's disk."""
        with self._lock:
            self._acked_by.setdefault(server_id, Intervals()).add(seq_first, seq_last)
            self._lost.remove(Intervals([(seq_first, seq_last)]))

    def drop_oldest_waiting_and_record_unacked_loss(
        self, reason: str, requests: RetentionRequests, *, min_batches_left: int = 0
    ) -> bool:
        """Drop the oldest batch that waits to be written; return whether there was one.

        Args:
            reason: reason of the loss.
            requests: retention requests.
            min_batches_left: number of batches that stay.
        """
        with self._lock:
            if len(self._waiting.batches) <= min_batches_left:
                return False
            oldest = self._waiting.popleft()
        self.record_unacked_or_node_session_loss(oldest.numbers, reason, requests)
        return True

    def record_unacked_or_node_session_loss(
        self, numbers: Intervals, reason: str, requests: RetentionRequests
    ) -> None:
        """Record the loss of frames in memory, except frames that a server has.

        Frames that a server has are not lost, except frames that the node's own session needs.
        """
        needed_here = requests.node_session_numbers_of(self.stream_id)
        with self._lock:
            self._lost.add_if_new(numbers - (self._union_of_acked() - needed_here), reason)

    def recent_batches(self, from_seq: int) -> list[EncodedBatch]:
        """Return the newest batches in memory with frames from `from_seq` on, oldest first."""
        with self._lock:
            found = list(
                takewhile(lambda b: b.seq_last >= from_seq, reversed(self._recent.batches))
            )
        return found[::-1]

    def read_overlapping_batches(self, seq_first: int, seq_last: int) -> Iterator[EncodedBatch]:
        """Yield batches with any of these frames, from disk and memory, in order.

        Raises:
            DamagedFramesError: a batch on disk is damaged.
            StorageError: the journal cannot be read.
        """
        with self._lock:
            journal = self.journal
            memory = [
                batch
                for batch in self._waiting.batches
                if batch.seq_first <= seq_last and batch.seq_last >= seq_first
            ]
        requested = Intervals([(seq_first, seq_last)])
        on_disk = requested - Intervals((batch.seq_first, batch.seq_last) for batch in memory)
        at = 0
        for first, last in on_disk:
            while at < len(memory) and memory[at].seq_first < first:
                yield memory[at]
                at += 1
            if journal is not None:
                yield from journal.read_overlapping_messages(first, last)
        yield from memory[at:]

    # --- for the thread that writes ---------------------------------------------------------------

    def update_notes_in_memory(self, **changes: object) -> None:
        """Change the notes in memory; `update_and_save_notes` writes them."""
        with self._lock:
            now = {"lost": self._lost.to_pairs(), "missed_slots": self.missed_slots, **changes}
            self.notes = self.notes.model_copy(update=now)

    def set_max_lost_tail_in_memory(self) -> None:
        """Set the notes' `max_lost_tail_frames` in memory: a limit of frames lost in flight."""
        rate_hz, slowest_s = self.info.nominal_rate_hz, self.notes.sync_max_s
        self.update_notes_in_memory(
            max_lost_tail_frames=compute_max_lost_tail_frames(rate_hz, slowest_s)
        )

    def update_and_save_notes(self, **changes: object) -> None:
        """Change the notes and write them to disk.

        Raises:
            StorageError: the disk is full or not writable; the changes stay in memory.
        """
        self.update_notes_in_memory(**changes)
        notes = self.notes
        notes.save(self.folder)
        self._saved_losses = notes.lost

    def try_save_new_losses(self) -> None:
        """Write the notes if losses have changed; after an error the next call retries."""
        if self.lost.to_pairs() != self._saved_losses:
            with suppress(StorageError):
                self.update_and_save_notes()

    def write_oldest_waiting(self) -> None:
        """Write the oldest waiting batch to the journal, if there is one.

        Raises:
            StorageError: the disk refuses it; it goes on waiting.
        """
        journal = self.journal
        with self._lock:
            batch = next(iter(self._waiting.batches), None)
        if journal is None or batch is None:
            return
        journal.append_unstored_frames_of_message(batch)
        with self._lock:
            if self._waiting.batches and self._waiting.batches[0] is batch:  # not dropped meanwhile
                self._waiting.popleft()
            self._lost.remove(batch.numbers)
            self._unsynced.append(batch)

    def ensure_journal_and_notes(self) -> None:
        """Create the journal and save the notes, if it is missing and needed.

        Raises:
            StorageError: the disk refuses it.
        """
        if self.journal is None and not self.is_complete_on_disk:
            journal = Journal(self.folder, self.info)
            self.update_and_save_notes()
            with self._lock:
                self.journal = journal

    def try_sync_or_requeue(self) -> None:
        """Sync written batches; batches that the disk refuses go back to the memory queue."""
        journal = self.journal
        if journal is None or not self._unsynced:
            return
        with self._lock:
            since_s = self._waiting_since_s
            # Waiting batches came after the written ones.
            self._waiting_since_s = time.monotonic() if self._waiting.batches else None
        try:
            journal.sync()
        except StorageError:
            refused = Intervals((b.seq_first, b.seq_last) for b in self._unsynced)
            with self._lock:
                self._waiting.prepend(self._unsynced)
                self._unsynced = []
                self._waiting_since_s = since_s
            journal.invalidate_batches_wholly_within(
                refused
            )  # after the queue has them again, so no frame is missing
            return
        with self._lock:
            self._unsynced = []
        took_s = 0.0 if since_s is None else time.monotonic() - since_s
        if took_s > max(MAX_UNSYNCED_S, self.notes.sync_max_s):
            with suppress(StorageError):
                self.update_and_save_notes(sync_max_s=took_s)

    def try_record_end_once_synced(self, requests: RetentionRequests, problems: list[str]) -> None:
        """Record the stream's end once it is whole on disk; the next call retries after an error.

        Args:
            requests: retention requests.
            problems: messages of any damage are added here.
        """
        if self.is_complete_on_disk or not self.has_ended or not self.is_synced:
            return
        try:
            if self._queue_in_flight(problems):  # these are written first
                return
            if self.journal is not None:
                self.journal.close()
            # A stream that ended before its first frame is kept if a server requests it.
            if self.next_seq or requests.node_session_or_server_numbers_of(self.stream_id):
                self.update_and_save_notes(next_seq=self.next_seq)
            elif self.folder.is_dir():
                shutil.rmtree(self.folder, ignore_errors=True)
        except StorageError:
            return
        # Only now: until the end is noted, the frames in flight may be needed again.
        try_delete_in_flight_file(self.folder)
        with self._lock:
            self._recent = BatchQueue()
            self.is_complete_on_disk = True

    def invalidate_and_record_loss(
        self, damaged_numbers: Intervals, requests: RetentionRequests
    ) -> None:
        """Remove frames that turned out to be damaged on disk, and record their loss."""
        if self.journal is not None:
            self.journal.invalidate_batches_wholly_within(damaged_numbers)
            self.record_unacked_or_node_session_loss(damaged_numbers, CORRUPT, requests)

    def evict_old_segments(self, before_t_ns: int, requests: RetentionRequests) -> None:
        """Delete segments that end before an instant, without needed frames; record losses.

        Raises:
            StorageError: a file cannot be deleted.
        """
        if self.journal is not None:
            gone = self.journal.delete_old_segments(before_t_ns, self.numbers_to_retain(requests))
            self.record_unacked_or_node_session_loss(gone, EVICTED, requests)

    def evict_oldest_unneeded_segment(self, requests: RetentionRequests) -> bool:
        """Delete the oldest segment without needed frames, record losses; False if none.

        Raises:
            StorageError: it cannot be deleted.
        """
        gone = Intervals()
        if self.journal is not None:
            gone = self.journal.delete_oldest_unneeded_segment(self.numbers_to_retain(requests))
            self.record_unacked_or_node_session_loss(gone, EVICTED, requests)
        return bool(gone)

    def _queue_in_flight(self, problems: list[str]) -> bool:
        """Queue the frames that a killed acquisition left in flight; False if there are none.

        Raises:
            StorageError: they cannot be read now.
        """
        try:
            new = read_newest_in_flight_run(self.folder, self.next_seq)
        except DamagedFileError as error:
            problems.append(try_set_aside_and_describe(self.folder / IN_FLIGHT_FILE, error))
            self.set_max_lost_tail_in_memory()
            return False
        if new is None:
            return False
        for batch in encode_as_messages(new, self.info, read_edges_in_flight(self.folder)):
            self.queue_batch_and_record_gap(batch)
        return True

    def _union_of_acked(self) -> Intervals:
        return union(self._acked_by.values())
