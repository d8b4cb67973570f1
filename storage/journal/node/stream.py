"""One stream as a node keeps it: its journal on disk, and what is not on the disk yet.

A frame first waits in memory, then it is written, then synced. Its batch is let go only when a sync
has succeeded: a kernel that could not write it may have forgotten it, and then it is written once
more.
"""

from __future__ import annotations

import shutil
import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from itertools import takewhile
from pathlib import Path

from devices.errors import DamagedFileError, StorageError
from storage.durable import put_aside
from storage.intervals import CORRUPT, EVICTED, NODE_BUSY, Intervals, Losses, union
from storage.journal.journal import Journal
from storage.journal.node.batch_queue import BatchQueue
from storage.journal.node.in_flight import IN_FLIGHT_FILE, delete_in_flight, read_in_flight_from
from storage.journal.node.wanted import Wanted
from storage.journal.stream_notes import PROMISE_S, StreamNotes, unsynced_tail_max
from storage.wire import EncodedBatch, messages_of

RECENT_BYTES = 4 << 20
"""Newest frames that are kept in memory, for the live picture."""


class NodeStream:
    """Frames of one stream, wherever they are.

    Safe to use from several threads; its attributes are to be read. One thread writes: only it
    calls the methods of the last section. The lock is never held while the disk works.

    Args:
        folder: the stream's own.
        notes: what is known of it.
        journal: what is on disk already; None: nothing, it is begun when the disk lets it be.
    """

    def __init__(self, folder: Path, notes: StreamNotes, journal: Journal | None) -> None:
        self.folder = folder
        self.info = notes.array_info
        self.boot_id = self.info.boot_id
        self.notes = notes
        """What is written down of it, or will be."""
        self.journal = journal
        """To read from; None as long as the disk does not let it be begun."""
        self.missed_slots = notes.missed_slots
        """Slots in which no frame was taken."""
        self.has_ended = notes.has_ended
        """Will no more frames come?"""
        self.is_settled = notes.has_ended
        """Is all of it on disk, with a note of where it ended?"""
        self._lock = threading.Lock()
        self._noted_lost = notes.lost
        self._lost = Losses(notes.lost)
        self._acked_by: dict[str, Intervals] = {}
        self._waiting = BatchQueue()
        """Not in the journal yet."""
        self._unsynced: list[EncodedBatch] = []
        """In the journal, but perhaps not on the disk yet."""
        self._waiting_since_s: float | None = None
        """When the oldest frame came that may not be on the disk yet."""
        self._recent = BatchQueue()
        if journal is not None:
            self._lost.found(journal.held)
            for reason, numbers in journal.lost.by_reason.items():
                self._lost.add(numbers, reason)
        last = (self.stored | self._lost.all).last
        known = 0 if last is None else last + 1
        self.next_seq = known if notes.next_seq is None else notes.next_seq
        """The number of the next frame to come."""

    # --- what is known of it ----------------------------------------------------------------------

    @property
    def is_synced(self) -> bool:
        """Is everything that came on the disk?"""
        with self._lock:
            return not self._waiting.batches and not self._unsynced

    @property
    def waiting_bytes(self) -> int:
        """What waits in memory to be written."""
        return self._waiting.size_bytes

    @property
    def waiting_s(self) -> float:
        """Seconds of frames that wait in memory to be written."""
        with self._lock:
            return self._waiting.frames / self.info.nominal_rate_hz

    @property
    def held(self) -> Intervals:
        """Numbers that can be given away: on disk, or waiting for it."""
        with self._lock:
            waiting = Intervals((b.seq_first, b.seq_last) for b in self._waiting.batches)
            return self.stored | waiting

    @property
    def stored(self) -> Intervals:
        """Numbers that are in the journal."""
        return Intervals(self.journal.held if self.journal is not None else ())

    @property
    def lost(self) -> Losses:
        """Numbers that are not held any more, and that no server has, by reason."""
        with self._lock:
            return Losses(self._lost.by_reason)

    @property
    def acked(self) -> Intervals:
        """Numbers that are on any server's disk."""
        with self._lock:
            return self._acked()

    def undelivered(self, wanted: Wanted) -> Intervals:
        """Held numbers that servers need and do not have yet."""
        held = self.held
        with self._lock:
            return held & wanted.undelivered(self.boot_id, self._acked_by)

    def needed(self, wanted: Wanted) -> Intervals:
        """What must not be deleted."""
        with self._lock:
            return wanted.unmet(self.boot_id, self._acked_by)

    # --- frames come and go -----------------------------------------------------------------------

    def put(
        self, batch: EncodedBatch, missed_slots: int | None = None, *, gap: str = NODE_BUSY
    ) -> None:
        """Take in frames, the newest ones if they come as they are taken.

        Args:
            batch: the frames.
            missed_slots: since the stream began; None: as before.
            gap: why frames between the newest one so far and these are lost.
        """
        with self._lock:
            if batch.seq_first > self.next_seq:
                self._lost.add(Intervals([(self.next_seq, batch.seq_first - 1)]), gap)
            if self._waiting_since_s is None:
                self._waiting_since_s = time.monotonic()
            self._waiting.append(batch)
            self._recent.append(batch)
            while self._recent.size_bytes > RECENT_BYTES and len(self._recent.batches) > 1:
                self._recent.popleft()
            self.next_seq = max(self.next_seq, batch.seq_last + 1)
            if missed_slots is not None:
                self.missed_slots = missed_slots

    def end(self, **known: object) -> None:
        """No more frames come. What is known of that is noted, as in `StreamNotes`."""
        with self._lock:
            self.has_ended = True
        self.note(**known)

    def acknowledge(self, server_id: str, seq_first: int, seq_last: int) -> None:
        """These frames are on a server's disk."""
        with self._lock:
            self._acked_by.setdefault(server_id, Intervals()).add(seq_first, seq_last)
            self._lost.found(Intervals([(seq_first, seq_last)]))

    def drop_oldest(self, reason: str, wanted: Wanted, *, at_least: int = 0) -> bool:
        """Give up what has waited longest to be written; was there anything?

        Args:
            reason: why.
            wanted: what sessions need.
            at_least: so many batches stay.
        """
        with self._lock:
            if len(self._waiting.batches) <= at_least:
                return False
            oldest = self._waiting.popleft()
        self.lose(oldest.numbers, reason, wanted)
        return True

    def lose(self, numbers: Intervals, reason: str, wanted: Wanted) -> None:
        """Note frames that are not kept any more.

        Frames that a server has are not lost, except those that the node's own session needs.
        """
        needed_here = wanted.local(self.boot_id)
        with self._lock:
            self._lost.add(numbers - (self._acked() - needed_here), reason)

    def recent(self, seq: int) -> list[EncodedBatch]:
        """The newest batches with frames from `seq` on, oldest first, as far as memory goes."""
        with self._lock:
            found = list(takewhile(lambda b: b.seq_last >= seq, reversed(self._recent.batches)))
        return found[::-1]

    def batches(self, seq_first: int, seq_last: int) -> Iterator[EncodedBatch]:
        """Batches with any of these frames, from disk and memory, in order.

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
        asked = Intervals([(seq_first, seq_last)])
        on_disk = asked - Intervals((batch.seq_first, batch.seq_last) for batch in memory)
        at = 0
        for first, last in on_disk:
            while at < len(memory) and memory[at].seq_first < first:
                yield memory[at]
                at += 1
            if journal is not None:
                yield from journal.messages(first, last)
        yield from memory[at:]

    # --- for the thread that writes ---------------------------------------------------------------

    def note(self, **changes: object) -> None:
        """Change what is known of it; `save_notes` writes it down."""
        with self._lock:
            now = {"lost": self._lost.as_pairs(), "missed_slots": self.missed_slots, **changes}
            self.notes = self.notes.model_copy(update=now)

    def lose_in_flight(self) -> None:
        """What was in flight cannot be known: note how many frames that may have been."""
        rate_hz, slowest_s = self.info.nominal_rate_hz, self.notes.sync_max_s
        self.note(unsynced_tail_max=unsynced_tail_max(rate_hz, slowest_s))

    def save_notes(self, **changes: object) -> None:
        """Write down what is known of it.

        Raises:
            StorageError: the disk is full or not writable; what is known stays in memory.
        """
        self.note(**changes)
        notes = self.notes
        notes.save(self.folder)
        self._noted_lost = notes.lost

    def save_losses(self) -> None:
        """Write down what was lost since the notes were written; if that fails, next time."""
        if self.lost.as_pairs() != self._noted_lost:
            with suppress(StorageError):
                self.save_notes()

    def write_oldest(self) -> None:
        """Write the batch that has waited longest to the journal, if there is one.

        Raises:
            StorageError: the disk does not take it; it goes on waiting.
        """
        journal = self.journal
        with self._lock:
            batch = next(iter(self._waiting.batches), None)
        if journal is None or batch is None:
            return
        journal.append_message(batch)
        with self._lock:
            if self._waiting.batches and self._waiting.batches[0] is batch:  # not given up by now
                self._waiting.popleft()
            self._lost.found(batch.numbers)
            self._unsynced.append(batch)

    def begin_journal(self) -> None:
        """Begin the journal, if there is none.

        Raises:
            StorageError: the disk does not let it be begun.
        """
        if self.journal is None and not self.is_settled:
            journal = Journal(self.folder, self.info)
            self.save_notes()
            with self._lock:
                self.journal = journal

    def sync(self) -> None:
        """Sync what was written; what the disk refuses waits again."""
        journal = self.journal
        if journal is None or not self._unsynced:
            return
        with self._lock:
            since_s = self._waiting_since_s
            # What waits has come since the others were written.
            self._waiting_since_s = time.monotonic() if self._waiting.batches else None
        try:
            journal.sync()
        except StorageError:
            refused = Intervals((b.seq_first, b.seq_last) for b in self._unsynced)
            with self._lock:
                self._waiting.give_back(self._unsynced)
                self._unsynced = []
                self._waiting_since_s = since_s
            journal.disown(refused)  # only now: until then they are in memory as well
            return
        with self._lock:
            self._unsynced = []
        took_s = 0.0 if since_s is None else time.monotonic() - since_s
        if took_s > max(PROMISE_S, self.notes.sync_max_s):
            with suppress(StorageError):
                self.save_notes(sync_max_s=took_s)

    def settle(self, wanted: Wanted, problems: list[str]) -> None:
        """Note where it has ended, once all of it is on disk; if that fails, next time.

        Args:
            wanted: what sessions need.
            problems: told what was found damaged and what became of it.
        """
        if self.is_settled or not self.has_ended or not self.is_synced:
            return
        try:
            if self._take_over_in_flight(problems):  # it is written first
                return
            if self.journal is not None:
                self.journal.close()
            # A stream that ended before its first frame is remembered if a server asks for it.
            if self.next_seq or wanted.numbers(self.boot_id):
                self.save_notes(next_seq=self.next_seq)
            elif self.folder.is_dir():
                shutil.rmtree(self.folder, ignore_errors=True)
        except StorageError:
            return
        # Only now: until the end is noted, the frames in flight may be needed again.
        delete_in_flight(self.folder)
        with self._lock:
            self._recent = BatchQueue()
            self.is_settled = True

    def disown(self, damaged: Intervals, wanted: Wanted) -> None:
        """Stop holding frames that turned out to be damaged on disk."""
        if self.journal is not None:
            self.journal.disown(damaged)
            self.lose(damaged, CORRUPT, wanted)

    def prune(self, before_t_ns: int, wanted: Wanted) -> None:
        """Delete segments that end before an instant, and hold nothing that is needed.

        Raises:
            StorageError: a file cannot be deleted.
        """
        if self.journal is not None:
            gone = self.journal.prune(before_t_ns, self.needed(wanted))
            self.lose(gone, EVICTED, wanted)

    def evict(self, wanted: Wanted) -> bool:
        """Delete its oldest segment that holds nothing that is needed; is there any?

        Raises:
            StorageError: it cannot be deleted.
        """
        gone = Intervals()
        if self.journal is not None:
            gone = self.journal.evict(self.needed(wanted))
            self.lose(gone, EVICTED, wanted)
        return bool(gone)

    def _take_over_in_flight(self, problems: list[str]) -> bool:
        """Take over the frames that acquisition had in flight when it was killed; False if none.

        Raises:
            StorageError: they cannot be read now.
        """
        try:
            new = read_in_flight_from(self.folder, self.next_seq)
        except DamagedFileError as error:
            problems.append(put_aside(self.folder / IN_FLIGHT_FILE, error))
            self.lose_in_flight()
            return False
        if new is None:
            return False
        for batch in messages_of(new, self.info):
            self.put(batch)
        return True

    def _acked(self) -> Intervals:
        return union(self._acked_by.values())
