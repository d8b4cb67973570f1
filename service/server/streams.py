"""One stream of a node as stored on the server: its journal and the node's report.

The report is stored in `stream.json` beside the journal: a restarted server still has the reasons
of losses and the stream's end. `sync` writes it.
"""

from __future__ import annotations

import logging
from collections import deque
from contextlib import suppress
from pathlib import Path

from devices.errors import FileFormatError, StorageError
from devices.frames import ArrayInfo, FrameBatch
from service.link import ClockRow, EarlierStream, Hello, PairsByReason
from service.server.stream_limit import StreamLimit
from service.sessions.ends import SessionStream, around_in
from storage.clock.log import ClockLog, ClockOffset
from storage.frame_rules import broken_rule
from storage.intervals import CORRUPT, NO_END, REFUSED, Intervals, Losses
from storage.journal.journal import Journal
from storage.journal.stream_notes import StreamNotes
from storage.schema import wire_schema
from storage.wire import Decoder

log = logging.getLogger("foottile.streams")

CLOCK_ROWS = 128
"""Clock measurements kept in memory for a pre-roll; the log has all."""
_AROUND_MAX = 32


class ServerStream:
    """Server's copy of one stream: frames stored, obtainable and lost.

    Args:
        folder: the stream's own; created with its first frames.
        info: description of the array.
    """

    def __init__(self, folder: Path, info: ArrayInfo) -> None:
        self.folder = folder
        self.info = info
        self.decoder = Decoder(wire_schema(info))
        self.journal: Journal | None = None
        self.notes = StreamNotes(array_info=info)
        self.node_has: Intervals | None = None
        """Frames that the node can still send; None: no report since the server was started."""
        self.t_ns_first: int | None = None
        """Time of the oldest frame that the node has of an earlier stream, node's UTC."""
        self.clock_rows: deque[ClockOffset] = deque(maxlen=CLOCK_ROWS)
        """Measured offsets of the node's clock, oldest first."""
        self.last_seen_t_ns: int | None = None
        """Arrival time of the last frame, server's UTC."""
        self.missed_slots = 0
        self.limit: StreamLimit | None = None
        """Upper bounds of its frames; None: not the present stream since the server was started."""
        self.unsynced = Intervals()
        """Frames appended to the journal since the last sync."""
        self.owed = Intervals()
        """Frames to acknowledge once the journal is synced."""
        self.problems: list[str] = []
        """Damage found when the stream was opened, and the consequence, as text."""
        self._first_seq: int | None = None
        self._refused = Intervals()
        self._forgotten = Intervals()
        self._guessed = False
        self._notes_on_disk: StreamNotes | None = None
        self._around: dict[tuple[int, int], tuple[int, int]] = {}
        self._clock_log = ClockLog(folder)
        self._clock_unsynced = False

    @classmethod
    def open(cls, folder: Path) -> ServerStream:
        """Open a stream that is on the disk.

        Raises:
            FileFormatError: nothing in its folder is readable.
            StorageError: it cannot be read.
        """
        journal = Journal.open(folder, writes_later=True)
        stream = cls(folder, journal.info)
        stream.journal = journal
        stream.problems = list(journal.problems)
        notes = StreamNotes.load_whole(
            folder, stream.problems
        )  # without notes the node reports again
        if notes is not None:
            stream.notes = stream._notes_on_disk = notes
            stream.missed_slots = notes.missed_slots
            stream._refused = Intervals(notes.lost.get(REFUSED, ()))
        with suppress(StorageError):
            lines = stream._clock_log.lines()
            stream.clock_rows.extend(lines.rows)
            if lines.damaged:
                log.warning("%s: %d damaged clock rows are left out", folder, lines.damaged)
        newest = journal.held.last
        if newest is not None:
            stream._first_seq = next(iter(journal.held))[0]
            # Most likely these frames were deleted as unneeded.
            stream._guessed = True
            stream._forgotten = journal.held.missing(0, newest) - stream.lost.all
        return stream

    @property
    def boot_id(self) -> str:
        """Id of the stream."""
        return self.info.boot_id

    @property
    def clock(self) -> ClockOffset | None:
        """Latest offset of the node's clock; None before the first measurement."""
        return self.clock_rows[-1] if self.clock_rows else None

    def all_clock_rows(self) -> tuple[ClockOffset, ...]:
        """Read all clock measurements of the stream, oldest first.

        Raises:
            StorageError: the log cannot be read.
        """
        return self._clock_log.rows()

    def note_clock(self, row: ClockRow) -> None:
        """Record a measurement of the node's clock.

        Raises:
            StorageError: the log cannot be written; the measurement is used all the same.
        """
        offset = ClockOffset(boot_id=self.boot_id, **row.model_dump(exclude={"type"}))
        self.clock_rows.append(offset)
        if self.journal is not None:
            self._log_clock(offset)

    @property
    def held(self) -> Intervals:
        """Frames in the journal."""
        return self.journal.held if self.journal is not None else Intervals()

    @property
    def may_come(self) -> Intervals:
        """Frames that the node can still send, or has sent."""
        reported = Intervals([(0, NO_END)]) if self.node_has is None else self.node_has
        return reported - Losses(self.notes.lost).all

    @property
    def lost(self) -> Losses:
        """Frames that will not come, by reason; a stored frame is never lost."""
        lost = Losses(self.notes.lost)
        if self.journal is not None:
            for reason, numbers in self.journal.lost.by_reason.items():
                lost.add(numbers - self.may_come, reason)
        return lost

    def for_session(self, offset_ns: int | None) -> SessionStream:
        """Return the stream's facts for the rules of sessions.

        Args:
            offset_ns: added to the stream's times to get server time.
        """
        return SessionStream(
            held=self.held,
            lost=Losses(self.notes.lost),
            damaged=self.journal.lost.all if self.journal is not None else Intervals(),
            may_come=self.may_come,
            next_seq=self.notes.next_seq,
            unsynced_tail_max=self.notes.unsynced_tail_max,
            missed_slots=self.missed_slots,
            info=self.info,
            journal=self.journal,
            around=self.around,
            offset_ns=offset_ns,
            last_seen_t_ns=self.last_seen_t_ns,
        )

    def around(self, t_ns: int, *, at_least: int, waiting: bool = False) -> tuple[int, int] | None:
        """Return the stored frames next to a time: the last one until it, the first one after.

        The result is cached: callers repeat the query while frames are missing. The journal's index
        is read again only when frames between the two have come.

        Args, result and errors as for the function `around_in`; with `waiting` the
        cached result is kept until all frames between have come or are lost.
        """
        if self.journal is None:
            return None
        found, stored = self._around.get((t_ns, at_least)), self.held
        if found is not None:
            last, after = found
            ends = stored.within(after, after) and (last < at_least or stored.within(last, last))
            missing = stored.missing(last + 1, after - 1) if after > last + 1 else Intervals()
            none_came = missing.count == after - last - 1
            if ends and (none_came or (waiting and missing & self.may_come)):
                return found
        found = around_in(self.journal, t_ns, at_least=at_least)
        if found is None:
            return None
        if len(self._around) >= _AROUND_MAX:
            self._around.clear()
        self._around[t_ns, at_least] = found
        return found

    def missing(self, newest: int) -> Intervals:
        """Return the frames that are not stored, from the first known one to `newest`."""
        if self._first_seq is None or newest < self._first_seq:
            return Intervals()
        return self.held.missing(self._first_seq, newest) - self._forgotten

    def lacks(self, needed: Intervals, *, all_of_it: bool) -> Intervals:
        """Return the frames to request: the node has them, and they are not stored.

        Args:
            needed: frames that sessions need.
            all_of_it: request all missing frames; False: only those in `needed`.
        """
        if self.node_has is None:
            return Intervals()
        requested = self.may_come - self.held
        if all_of_it:
            return requested - (self._forgotten - needed)
        return requested & needed

    def is_present(self, hello: Hello, now_t_ns: int) -> None:
        """Handle hello of the node for which this is the present stream."""
        self.limit = StreamLimit.of(hello, now_t_ns)
        self.node_has = Intervals((*hello.held, (hello.next_seq, NO_END)))
        self._said(hello.lost, next_seq=None)
        self._see_from(min((first for first, _ in hello.held), default=hello.next_seq))

    def has_ended(self, said: EarlierStream) -> None:
        """Handle the node's report of how this stream ended."""
        self.node_has = Intervals(said.held)
        self.t_ns_first = said.t_ns_first
        # A node that was killed may have an older count than it had reported.
        self.missed_slots = max(self.missed_slots, said.missed_slots)
        # Frames that a node lost in a power failure may be stored here.
        beyond = max(0, (-1 if self.held.last is None else self.held.last) + 1 - said.next_seq)
        tail = max(0, said.unsynced_tail_max - beyond)
        self._said(said.lost, next_seq=said.next_seq + beyond, unsynced_tail_max=tail)

    def is_gone(self) -> None:
        """Handle a hello without this stream: nothing more will come; the next sync closes it."""
        self.node_has = Intervals()
        if self.journal is not None:
            self.journal.retire()

    def note_losses(self, lost: PairsByReason) -> None:
        """Replace the losses that the node has reported for this stream."""
        notes = self.notes
        self._said(lost, next_seq=notes.next_seq, unsynced_tail_max=notes.unsynced_tail_max)

    def check(self, frames: FrameBatch, now_t_ns: int) -> str:
        """Check received frames; frames that break a rule are never requested again.

        Args:
            frames: of one message.
            now_t_ns: the server's UTC.

        Returns:
            Reason why the frames are ahead of time and must not be stored now; frames with the same
            numbers may still come. Empty if they may be stored.

        Raises:
            FileFormatError: they break a rule that `verify` checks as well.
            StorageError: the frames stored next to them cannot be read.
        """
        first, last = int(frames.seq[0]), int(frames.seq[-1])
        end = self.notes.next_seq
        wrong = broken_rule(frames, self.info)
        if not wrong and self.limit is not None:
            ahead = self.limit.violation(frames, now_t_ns)
            if ahead:
                return ahead
        if not wrong and end is not None and last >= end:
            wrong = f"the stream has ended with frame {end - 1}"
        if not wrong and self.journal is not None:
            wrong = self.journal.misplaced(frames)
        if wrong:
            refused = Intervals([(first, last)]) - self.held
            self._refused = self._refused | refused
            self.note_losses(self.notes.lost)
            raise FileFormatError(
                f"frames {first} to {last} of stream {self.boot_id} are refused: {wrong}",
                expected="frames as docs/formats.md says",
            )
        return ""

    def take(self, frames: FrameBatch, payload: bytes, now_t_ns: int) -> None:
        """Append received frames to the journal.

        Raises:
            StorageError: the disk is full or not writable; the frames are not stored.
        """
        if self.journal is None:
            self.journal = Journal(self.folder, self.info, writes_later=True)
            for row in self.clock_rows:
                self._log_clock(row)
        first, last = int(frames.seq[0]), int(frames.seq[-1])
        self.last_seen_t_ns = now_t_ns
        self._see_from(first)
        for interval in self.journal.append(frames, payload):
            self.unsynced.add(*interval)
        self.owed.add(first, last)

    def sync(self) -> None:
        """Sync journal and notes to the disk. Runs in any thread.

        Raises:
            StorageError: the disk refused.
        """
        if self.journal is not None:
            self.journal.sync()
        notes = self._notes_to_keep
        if notes != self._notes_on_disk and self.folder.is_dir():
            notes.save(self.folder)
            self._notes_on_disk = notes
        if self._clock_unsynced:
            self._clock_unsynced = False
            self._clock_log.sync()

    @property
    def has_news(self) -> bool:
        """True if anything has to be synced or acknowledged."""
        unsaved = self._notes_to_keep != self._notes_on_disk and self.journal is not None
        closing = self.journal is not None and self.journal.is_closing
        return bool(self.unsynced or self.owed or unsaved or self._clock_unsynced or closing)

    @property
    def is_open(self) -> bool:
        """True if a file of the stream is open."""
        return self.journal is not None and self.journal.is_open

    def disown(self, doubtful: Intervals, *, corrupt: bool = False) -> None:
        """Remove frames from the stored ones: the disk may not have them."""
        if self.journal is None:
            return
        self.journal.disown(doubtful)
        if corrupt:
            self.journal.lost.add(doubtful - self.held, CORRUPT)

    def prune(self, before_t_ns: int, keep: Intervals) -> None:
        """Delete frames older than `before_t_ns` and not in `keep`.

        Raises:
            StorageError: a file cannot be deleted.
        """
        if self.journal is not None:
            self._forgotten = self._forgotten | self.journal.prune(before_t_ns, keep)

    def close(self) -> None:
        """Sync everything and close the journal.

        Raises:
            StorageError: the disk refused.
        """
        try:
            self.sync()
        finally:
            if self.journal is not None:
                self.journal.close()

    def let_go(self) -> None:
        """Drop unsynced frames: the data folder is away. The next `sync` closes open files."""
        self.disown(self.unsynced)
        self.unsynced, self.owed = Intervals(), Intervals()

    def delete(self) -> None:
        """Delete the journal."""
        if self.journal is not None:
            self.journal.delete()
        self.journal = self._notes_on_disk = None
        self.unsynced, self.owed = Intervals(), Intervals()

    def _said(
        self, lost: PairsByReason, *, next_seq: int | None, unsynced_tail_max: int = 0
    ) -> None:
        losses = Losses(lost)
        losses.add(self._refused, REFUSED)
        self.notes = StreamNotes(
            array_info=self.info,
            next_seq=next_seq,
            unsynced_tail_max=unsynced_tail_max,
            missed_slots=self.missed_slots,
            lost=losses.as_pairs(),
        )
        if self._guessed:
            self._guessed = False
            self._forgotten = self._forgotten - self.may_come

    @property
    def _notes_to_keep(self) -> StreamNotes:
        """Notes with the damage found here and the missed slots counted up to now."""
        lost = self.journal.lost.by_reason if self.journal is not None else {}
        now = {"damaged": tuple(lost.get(CORRUPT, ())), "missed_slots": self.missed_slots}
        if all(getattr(self.notes, name) == value for name, value in now.items()):
            return self.notes
        return self.notes.model_copy(update=now)

    def _log_clock(self, row: ClockOffset) -> None:
        self._clock_log.append(row)
        self._clock_unsynced = True

    def _see_from(self, seq: int) -> None:
        self._first_seq = seq if self._first_seq is None else min(self._first_seq, seq)
