"""One stream as a node keeps it: its journal on disk, and what is not on the disk yet."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Iterator
from pathlib import Path

from devices.errors import FileFormatError
from devices.frames import ArrayInfo
from storage.intervals import Intervals
from storage.journal.journal import Journal
from storage.journal.stream_notes import StreamNotes
from storage.losses import NODE_BUSY, Losses
from storage.wire import EncodedBatch

RECENT_BYTES = 4 << 20
"""What is kept in memory of the newest frames, for the live picture."""


class NodeStream:
    """Frames of one stream, wherever they are. Safe to use from several threads.

    Args:
        folder: the stream's own.
        notes: what is known of it.
        journal: what is on disk already.
    """

    def __init__(self, folder: Path, notes: StreamNotes, journal: Journal | None) -> None:
        self.folder = folder
        self.notes = notes
        self.journal = journal
        """None as long as the disk does not let it be begun."""
        self.lost = Losses(notes.lost)
        self.acked_by: dict[str, Intervals] = {}
        """Numbers that are on a server's disk, by server."""
        self.next_seq = notes.next_seq or 0
        """The number of the next frame to come."""
        self.missed_slots = notes.missed_slots
        self.lock = threading.Lock()
        """Guards everything here; never held while the disk works."""
        self.waiting: deque[EncodedBatch] = deque()
        """Not in the journal yet, oldest first."""
        self.waiting_bytes = 0
        self.unsynced: list[EncodedBatch] = []
        """In the journal, but perhaps not on the disk yet."""
        self.has_ended = notes.has_ended
        self.is_settled = notes.has_ended
        """Is all of it on disk, with a note of where it ended?"""
        self.waiting_since_s: float | None = None
        """Since when the oldest frame that is not surely on the disk is here."""
        self._recent: deque[EncodedBatch] = deque()
        self._recent_bytes = 0
        if journal is not None:
            self.lost.found(journal.held)
            for reason, numbers in journal.lost.by_reason.items():
                self.lost.add(numbers, reason)

    @property
    def info(self) -> ArrayInfo:
        """Description of its array."""
        return self.notes.array_info

    @property
    def boot_id(self) -> str:
        """Its name."""
        return self.info.boot_id

    @property
    def held(self) -> Intervals:
        """Numbers that can be given away: on disk, or waiting for it."""
        with self.lock:
            numbers = Intervals(self.journal.held if self.journal is not None else ())
            for batch in self.waiting:
                numbers.add(batch.seq_first, batch.seq_last)
        return numbers

    def put(self, batch: EncodedBatch, missed_slots: int) -> None:
        """Take in the newest frames."""
        with self.lock:
            if batch.seq_first > self.next_seq:  # the node was too busy to take them over
                self.lost.add(Intervals([(self.next_seq, batch.seq_first - 1)]), NODE_BUSY)
            if self.waiting_since_s is None:
                self.waiting_since_s = time.monotonic()
            self.waiting.append(batch)
            self.waiting_bytes += len(batch.payload)
            self._recent.append(batch)
            self._recent_bytes += len(batch.payload)
            while self._recent_bytes > RECENT_BYTES and len(self._recent) > 1:
                self._recent_bytes -= len(self._recent.popleft().payload)
            self.next_seq = batch.seq_last + 1
            self.missed_slots = missed_slots

    @property
    def acked(self) -> Intervals:
        """Numbers that are on any server's disk."""
        servers = list(self.acked_by.values())
        if len(servers) == 1:
            return Intervals(servers[0])
        return Intervals(pair for numbers in servers for pair in numbers)

    def acknowledge(self, server_id: str, seq_first: int, seq_last: int) -> None:
        """These frames are on a server's disk."""
        with self.lock:
            self.acked_by.setdefault(server_id, Intervals()).add(seq_first, seq_last)
            self.lost.found(Intervals([(seq_first, seq_last)]))

    def recent(self, seq: int) -> list[EncodedBatch]:
        """The newest batches with frames from `seq` on, oldest first, as far as memory goes."""
        found: deque[EncodedBatch] = deque()
        with self.lock:
            for batch in reversed(self._recent):
                if batch.seq_last < seq:
                    break
                found.appendleft(batch)
        return list(found)

    def batches(self, seq_first: int, seq_last: int) -> Iterator[EncodedBatch]:
        """Batches with any of these frames, from disk and memory, in order.

        Raises:
            DamagedFramesError: a batch on disk is damaged.
            StorageError: the journal cannot be read.
        """
        asked = Intervals([(seq_first, seq_last)])
        with self.lock:
            journal = self.journal
            memory = [
                batch
                for batch in self.waiting
                if batch.seq_first <= seq_last and batch.seq_last >= seq_first
            ]
        for batch in memory:
            asked = asked - batch.numbers
        at = 0
        for first, last in asked:
            while at < len(memory) and memory[at].seq_first < first:
                yield memory[at]
                at += 1
            if journal is not None:
                yield from journal.messages(first, last)
        yield from memory[at:]

    def lose(self, numbers: Intervals, reason: str, needed_here: Intervals | None = None) -> None:
        """Note frames that are not kept any more.

        Args:
            numbers: which ones. Those that a server has are not lost,
            reason: why.
            needed_here: but for these, which the node's own session needs.
        """
        with self.lock:
            elsewhere = self.acked
            if needed_here is not None:
                elsewhere = elsewhere - needed_here
            self.lost.add(numbers - elsewhere, reason)

    def forget_recent(self) -> None:
        """It has ended: nothing of it is news any more."""
        with self.lock:
            self._recent.clear()
            self._recent_bytes = 0

    def save_notes(self, **changes: object) -> None:
        """Write down what is known of it.

        Raises:
            StorageError: the disk is full or not writable; what is known stays in memory.
        """
        with self.lock:
            now = {"lost": self.lost.as_pairs(), "missed_slots": self.missed_slots, **changes}
            self.notes = self.notes.model_copy(update=now)
            notes = self.notes
        notes.save(self.folder)


def opened(folder: Path) -> NodeStream | None:
    """A stream that is on disk already; None if there is nothing of it.

    Raises:
        StorageError: it cannot be read.
    """
    notes: StreamNotes | None = None
    journal: Journal | None = None
    try:
        notes = StreamNotes.load(folder)
    except FileFormatError:
        notes = None  # its segments still say which array they are of
    try:
        journal = Journal.open(folder)
    except FileFormatError:
        if notes is None:
            return None
    if notes is None and journal is not None:
        notes = StreamNotes(array_info=journal.info)
    if notes is None:
        return None
    return NodeStream(folder, notes, journal)
