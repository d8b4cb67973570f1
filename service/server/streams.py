"""One stream of a node as stored on the server: its journal and the node's report.

The report is stored in `stream.json` beside the journal: a restarted server still has the reasons
of losses and the stream's end. `sync` writes it.

The upper bounds of a running stream's frames (`StreamLimit`) follow from hello, in which a node
states its clock and its next number, and from the server's clock, which counts suspend and never
steps (`devices.clock`). A node's clock gains no more on it than `DISCIPLINE_RATE_LIMIT`; it
may fall behind, where the node was suspended. So neither a date that was set nor an offset that the
node measured changes them, and frames of the past are never beyond them.

A server that is started anew may have another date. Offsets in the log are then of a former clock:
hello, which is later than the node's clock in it, shows whether the latest one still applies.
"""

from __future__ import annotations

import logging
import math
from collections import deque
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from devices.errors import FileFormatError, StorageError
from devices.frames import ArrayInfo, FrameBatch
from service.protocol.link import ClockSample, EarlierStream, Hello, SeqIntervalsByReason
from service.sessions.parts import SeqsAround, SessionStream
from storage.clock.bounds import DISCIPLINE_RATE_LIMIT
from storage.clock.log import ClockLog, ClockOffset
from storage.frame_rules import describe_first_broken_rule
from storage.intervals import CORRUPT, NO_END, REFUSED, Intervals, Losses
from storage.journal.journal import Journal
from storage.journal.stream_notes import StreamNotes
from storage.message_layout import MAX_MESSAGE_FRAMES
from storage.schema import wire_schema
from storage.wire import Decoder

AHEAD_MAX_NS = 60_000_000_000
"""Tolerance: hello is some seconds old when it comes over a poor link, and a server may be busy."""
_RATE_TOLERANCE = 2.0
"""The nominal rate is the fastest that the schedule allows; no node is twice as fast."""


@dataclass(frozen=True)
class StreamLimit:
    """Upper bounds of one stream, from its last hello.

    Attributes:
        hello_t_ns: arrival time of hello, server's UTC.
        t_mono_ns: node's clock, as hello states it.
        next_seq: number of the next frame, as hello states it.
        rate_hz: nominal rate of the array.
    """

    hello_t_ns: int
    t_mono_ns: int
    next_seq: int
    rate_hz: float

    @classmethod
    def from_hello(cls, hello: Hello, now_t_ns: int) -> StreamLimit:
        """Return the limit for the present stream of a node, from its hello."""
        rate_hz = hello.array_info.nominal_rate_hz
        return cls(now_t_ns, hello.t_mono_ns, hello.next_seq, rate_hz)

    def describe_frames_ahead(self, frames: FrameBatch, now_t_ns: int) -> str:
        """Return why frames are ahead of time, as text; empty if they are plausible.

        Args:
            frames: of one message.
            now_t_ns: the server's UTC.
        """
        ahead_ns = int(frames.t_mono_ns.max()) - self._clock_ns(now_t_ns)
        if ahead_ns > self._tolerance_ns(now_t_ns):
            return f"they are dated {ahead_ns * 1e-9:.0f} s ahead of the node's clock"
        since_s = (now_t_ns - self.hello_t_ns + AHEAD_MAX_NS) * 1e-9
        possible = (
            self.next_seq + MAX_MESSAGE_FRAMES + math.ceil(_RATE_TOLERANCE * self.rate_hz * since_s)
        )
        if int(frames.seq[-1]) > possible:
            return f"by now no frame can have a number above {possible}"
        return ""

    def is_near_stated_clock(self, t_mono_ns: int, uncertainty_ns: int, now_t_ns: int) -> bool:
        """Return whether a time just measured is near the clock that hello stated, to either side.

        Args:
            t_mono_ns: the time, by the node's clock.
            uncertainty_ns: half the duration of the measurement.
            now_t_ns: the server's UTC.
        """
        off_ns = abs(t_mono_ns - self._clock_ns(now_t_ns))
        return off_ns <= self._tolerance_ns(now_t_ns) + uncertainty_ns

    def is_offset_of_this_clock(self, row: ClockOffset, utc_offset_ns: int) -> bool:
        """Return whether a former measurement can be of the server's present clock.

        Hello bounds the offset from above, since it took some time to arrive. A measurement below
        that by less than a minute is accepted: with it sessions end later, and no frame is lost.

        Args:
            row: the measurement.
            utc_offset_ns: `t_ns` minus `t_mono_ns` of the stream.
        """
        late_ns = self.hello_t_ns - self.t_mono_ns - utc_offset_ns - row.server_minus_node_ns
        drift_ns = math.ceil(DISCIPLINE_RATE_LIMIT * abs(self.t_mono_ns - row.t_mono_ns))
        tolerance_ns = row.uncertainty_ns + drift_ns
        return -tolerance_ns <= late_ns <= AHEAD_MAX_NS + tolerance_ns

    def _clock_ns(self, now_t_ns: int) -> int:
        return self.t_mono_ns + now_t_ns - self.hello_t_ns

    def _tolerance_ns(self, now_t_ns: int) -> int:
        return AHEAD_MAX_NS + math.ceil(DISCIPLINE_RATE_LIMIT * abs(now_t_ns - self.hello_t_ns))


log = logging.getLogger("foottile.streams")

CLOCK_OFFSETS_MAX = 128
"""Clock measurements kept in memory for a pre-roll; the log has all."""


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
        self.node_ranges: Intervals | None = None
        """Frames that the node can still send; None: no report since the server was started."""
        self.first_t_ns: int | None = None
        """Time of the oldest frame that the node has of an earlier stream, node's UTC."""
        self.clock_offsets: deque[ClockOffset] = deque(maxlen=CLOCK_OFFSETS_MAX)
        """Measured offsets of the node's clock, oldest first; the first may be of a former date."""
        self.clock_offset: ClockOffset | None = None
        """Latest offset of the node's clock to the present one; None: not measured since the server
        was started, and no earlier one is known to apply."""
        self.last_seen_t_ns: int | None = None
        """Arrival time of the last frame, server's UTC."""
        self.missed_slots = 0
        self.limit: StreamLimit | None = None
        """Upper bounds of its frames; None: not the present stream since the server was started."""
        self.unsynced = Intervals()
        """Frames appended to the journal since the last sync."""
        self.unacked = Intervals()
        """Frames to acknowledge once the journal is synced."""
        self.problems: list[str] = []
        """Damage found when the stream was opened, and the consequence, as text."""
        self._first_seq: int | None = None
        self._refused = Intervals()
        self._dropped = Intervals()
        self._are_gaps_assumed_dropped = False
        self._notes_on_disk: StreamNotes | None = None
        self._seqs_around_cache: dict[tuple[int, int], SeqsAround] = {}
        self._clock_log = ClockLog(folder)
        self._is_clock_unsynced = False

    @classmethod
    def open_stored(cls, folder: Path) -> ServerStream:
        """Open a stream that is on the disk.

        Raises:
            FileFormatError: nothing in its folder is readable.
            StorageError: it cannot be read.
        """
        journal = Journal.open_existing_and_recover(folder, is_write_deferred=True)
        stream = cls(folder, journal.info)
        stream.journal = journal
        stream.problems = list(journal.problems)
        notes = StreamNotes.load_or_set_aside(
            folder, stream.problems
        )  # without notes the node reports again
        if notes is not None:
            stream.notes = stream._notes_on_disk = notes
            stream.missed_slots = notes.missed_slots
            stream._refused = Intervals(notes.lost.get(REFUSED, ()))
        with suppress(StorageError):
            lines = stream._clock_log.read_rows_and_damage()
            stream.clock_offsets.extend(lines.rows)
            if lines.damaged_lines:
                log.warning("%s: %d damaged clock rows are left out", folder, lines.damaged_lines)
        newest = journal.stored.last
        if newest is not None:
            stream._first_seq = next(iter(journal.stored))[0]
            # Most likely these frames were deleted as unneeded.
            stream._are_gaps_assumed_dropped = True
            stream._dropped = journal.stored.missing_in(0, newest) - stream.lost.numbers
        return stream

    @property
    def stream_id(self) -> str:
        """Id of the stream."""
        return self.info.stream_id

    def read_clock_offsets(self) -> tuple[ClockOffset, ...]:
        """Read all clock measurements of the stream, oldest first.

        Raises:
            StorageError: the log cannot be read.
        """
        return self._clock_log.read_undamaged_rows()

    def list_clock_offsets_since(self, seq_first: int) -> tuple[ClockOffset, ...]:
        """Return the clock measurements since a frame, and the last one before.

        Empty while none is known to be of the present clock.
        """
        if self.clock_offset is None:
            return ()
        begin_t_ns = (
            self.journal.find_batch_t_ns_near(seq_first, at_or_before=False)
            if self.journal is not None
            else None
        )
        rows = list(self.clock_offsets)
        if begin_t_ns is None:
            return tuple(rows[-1:])
        begin_ns = begin_t_ns - self.info.utc_offset_ns
        before = [number for number, row in enumerate(rows) if row.t_mono_ns <= begin_ns]
        return tuple(rows[before[-1] if before else 0 :])

    def record_clock_offset(self, row: ClockSample) -> None:
        """Record a measurement of the node's clock.

        Raises:
            StorageError: the log cannot be written; the measurement is used all the same.
        """
        offset = ClockOffset(stream_id=self.stream_id, **row.model_dump(exclude={"type"}))
        self.clock_offset = offset
        self.clock_offsets.append(offset)
        if self.journal is not None:
            self._append_to_clock_log(offset)

    @property
    def stored(self) -> Intervals:
        """Frames in the journal."""
        return self.journal.stored if self.journal is not None else Intervals()

    @property
    def obtainable(self) -> Intervals:
        """Frames that the node can still send, or has sent."""
        reported = Intervals([(0, NO_END)]) if self.node_ranges is None else self.node_ranges
        return reported - Losses(self.notes.lost).numbers

    @property
    def lost(self) -> Losses:
        """Frames that will not come, by reason; a stored frame is never lost."""
        lost = Losses(self.notes.lost)
        if self.journal is not None:
            for reason, numbers in self.journal.lost.by_reason.items():
                lost.add_if_new(numbers - self.obtainable, reason)
        return lost

    def make_session_stream(self) -> SessionStream:
        """Return the stream's facts for its sessions."""
        offset = self.clock_offset
        return SessionStream(
            stored=self.stored,
            lost=Losses(self.notes.lost),
            damaged=self.journal.lost.numbers if self.journal is not None else Intervals(),
            obtainable=self.obtainable,
            next_seq=self.notes.next_seq,
            max_lost_tail_frames=self.notes.max_lost_tail_frames,
            missed_slots=self.missed_slots,
            info=self.info,
            journal=self.journal,
            seqs_around_cache=self._seqs_around_cache,
            offset_ns=offset.server_minus_node_ns if offset is not None else None,
            last_seen_t_ns=self.last_seen_t_ns,
            first_t_ns=self.first_t_ns,
            unsynced=self.unsynced,
        )

    def lost_or_pending_up_to(self, newest_seq: int) -> Intervals:
        """Return the frames that are not stored, from the first known one to `newest_seq`."""
        if self._first_seq is None or newest_seq < self._first_seq:
            return Intervals()
        return self.stored.missing_in(self._first_seq, newest_seq) - self._dropped

    def frames_to_request(self, needed: Intervals, *, include_unneeded: bool) -> Intervals:
        """Return the frames to request: the node has them, and they are not stored.

        Args:
            needed: frames that sessions need.
            include_unneeded: request all missing frames; False: only those in `needed`.
        """
        if self.node_ranges is None:
            return Intervals()
        requested = self.obtainable - self.stored
        if include_unneeded:
            return requested - (self._dropped - needed)
        return requested & needed

    def apply_present_hello(self, hello: Hello, now_t_ns: int) -> None:
        """Apply a hello that names this stream as present: bounds, obtainable frames, losses."""
        self.limit = StreamLimit.from_hello(hello, now_t_ns)
        if self.clock_offset is None and self.clock_offsets:
            latest = self.clock_offsets[-1]
            if self.limit.is_offset_of_this_clock(latest, self.info.utc_offset_ns):
                self.clock_offset = latest
        self.node_ranges = Intervals((*hello.stored, (hello.next_seq, NO_END)))
        self._update_notes(hello.lost, next_seq=None)
        self._extend_start(min((first for first, _ in hello.stored), default=hello.next_seq))

    def apply_end_report(self, report: EarlierStream) -> None:
        """Apply the node's report of how this stream ended: end, obtainable frames, losses."""
        self.node_ranges = Intervals(report.stored)
        self.first_t_ns = report.t_ns_first
        # A node that was killed may have an older count than it had reported.
        self.missed_slots = max(self.missed_slots, report.missed_slots)
        # Frames that a node lost in a power failure may be stored here.
        beyond = max(
            0, (-1 if self.stored.last is None else self.stored.last) + 1 - report.next_seq
        )
        tail = max(0, report.max_lost_tail_frames - beyond)
        self._update_notes(
            report.lost, next_seq=report.next_seq + beyond, max_lost_tail_frames=tail
        )

    def expect_no_more_frames(self) -> None:
        """Retire the stream, which hello lacks: nothing more will come; the next sync closes it."""
        self.node_ranges = Intervals()
        if self.journal is not None:
            self.journal.close_segments_at_next_sync()

    def set_node_losses(self, lost: SeqIntervalsByReason) -> None:
        """Replace the losses that the node has reported for this stream."""
        notes = self.notes
        self._update_notes(
            lost, next_seq=notes.next_seq, max_lost_tail_frames=notes.max_lost_tail_frames
        )

    def check_frames_and_describe_ahead(self, frames: FrameBatch, now_t_ns: int) -> str:
        """Check received frames; frames that break a rule are lost and never requested again.

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
        wrong = describe_first_broken_rule(frames, self.info)
        if not wrong and self.limit is not None:
            ahead = self.limit.describe_frames_ahead(frames, now_t_ns)
            if ahead:
                return ahead
        if not wrong and end is not None and last >= end:
            wrong = f"the stream has ended with frame {end - 1}"
        if not wrong and self.journal is not None:
            wrong = self.journal.describe_reversal_against_stored(frames)
        if wrong:
            refused = Intervals([(first, last)]) - self.stored
            self._refused = self._refused | refused
            self.set_node_losses(self.notes.lost)
            raise FileFormatError(
                f"frames {first} to {last} of stream {self.stream_id} are refused: {wrong}",
                expected="frames as docs/formats.md says",
            )
        return ""

    def append_frames(self, frames: FrameBatch, payload: bytes, now_t_ns: int) -> None:
        """Append received frames to the journal.

        Raises:
            StorageError: the disk is full or not writable; the frames are not stored.
        """
        if self.journal is None:
            self.journal = Journal(self.folder, self.info, is_write_deferred=True)
            for row in self.clock_offsets:
                self._append_to_clock_log(row)
        first, last = int(frames.seq[0]), int(frames.seq[-1])
        self.last_seen_t_ns = now_t_ns
        self._extend_start(first)
        for interval in self.journal.append_new_frames(frames, payload):
            self.unsynced.add(*interval)
        self.unacked.add(first, last)

    def sync(self) -> None:
        """Sync journal and notes to the disk. Runs in any thread.

        Raises:
            StorageError: the disk refused.
        """
        if self.journal is not None:
            self.journal.sync()
        notes = self._current_notes
        if notes != self._notes_on_disk and self.folder.is_dir():
            notes.save(self.folder)
            self._notes_on_disk = notes
        if self._is_clock_unsynced:
            self._is_clock_unsynced = False
            self._clock_log.sync()

    @property
    def needs_sync_or_ack(self) -> bool:
        """True if anything has to be synced or acknowledged."""
        unsaved = self._current_notes != self._notes_on_disk and self.journal is not None
        closing = self.journal is not None and self.journal.has_segment_to_close
        return bool(self.unsynced or self.unacked or unsaved or self._is_clock_unsynced or closing)

    @property
    def has_open_files(self) -> bool:
        """True if a file of the stream is open."""
        return self.journal is not None and self.journal.has_unclosed_segment

    def invalidate(self, frames: Intervals, *, are_corrupt: bool = False) -> None:
        """Remove frames from the stored ones: the disk may not have them."""
        if self.journal is None:
            return
        self.journal.invalidate_batches_wholly_within(frames)
        if are_corrupt:
            self.journal.lost.add_if_new(frames - self.stored, CORRUPT)

    def delete_older(self, before_t_ns: int, keep: Intervals) -> None:
        """Delete frames older than `before_t_ns` and not in `keep`.

        Raises:
            StorageError: a file cannot be deleted.
        """
        if self.journal is not None:
            self._dropped = self._dropped | self.journal.delete_old_segments(before_t_ns, keep)

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

    def drop_unsynced(self) -> None:
        """Drop unsynced frames: the data folder is away. The next `sync` closes open files."""
        self.invalidate(self.unsynced)
        self.unsynced, self.unacked = Intervals(), Intervals()

    def delete_journal(self) -> None:
        """Delete the journal."""
        if self.journal is not None:
            self.journal.close_and_delete()
        self.journal = self._notes_on_disk = None
        self.unsynced, self.unacked = Intervals(), Intervals()

    def _update_notes(
        self, lost: SeqIntervalsByReason, *, next_seq: int | None, max_lost_tail_frames: int = 0
    ) -> None:
        losses = Losses(lost)
        losses.add_if_new(self._refused, REFUSED)
        self.notes = StreamNotes(
            array_info=self.info,
            next_seq=next_seq,
            max_lost_tail_frames=max_lost_tail_frames,
            missed_slots=self.missed_slots,
            lost=losses.to_pairs(),
        )
        if self._are_gaps_assumed_dropped:
            self._are_gaps_assumed_dropped = False
            self._dropped = self._dropped - self.obtainable

    @property
    def _current_notes(self) -> StreamNotes:
        """Notes with the damage found here and the missed slots counted up to now."""
        lost = self.journal.lost.by_reason if self.journal is not None else {}
        now = {"damaged": tuple(lost.get(CORRUPT, ())), "missed_slots": self.missed_slots}
        if all(getattr(self.notes, name) == value for name, value in now.items()):
            return self.notes
        return self.notes.model_copy(update=now)

    def _append_to_clock_log(self, row: ClockOffset) -> None:
        self._clock_log.append(row)
        self._is_clock_unsynced = True

    def _extend_start(self, seq: int) -> None:
        self._first_seq = seq if self._first_seq is None else min(self._first_seq, seq)
