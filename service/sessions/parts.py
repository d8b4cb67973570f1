"""Parts of sessions: intervals of a node's streams, where each begins, goes on and ends.

A session ends with the last frame before its stop, by the clock that gave the stop's time. A stream
that ended before that ends its part, and the session goes on in the node's next one. Where frames
are missing, the end is placed by the rate; where a node has not reported how its stream ended, the
number of unsent frames is bounded.

A *node's stream* (`NodeStream`) is the node's own, a *server's stream* (`ServerStream`) the
server's copy. Both, and a journal that is opened after a crash, give the facts of a
`SessionStream`; `NodeFacts` are those of all of a node's streams. Parts, states, ledger and inputs
of a session follow from these alone.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Any, Literal, NamedTuple

from devices.errors import FootTileError
from devices.frames import ArrayInfo
from devices.vitals import Vitals
from service.estimation.calibration import Calibration
from storage.intervals import NO_END, Intervals
from storage.journal.journal import RING_DURATION_NS, Journal
from storage.journal.stream_notes import compute_max_lost_tail_frames
from storage.sessions.folder import Part, Session
from storage.sessions.ledger import StreamState

_UNSENT_NS = 1_000_000_000
"""Time after a hello within which frames may come that the hello did not count."""
_CACHED_INSTANTS_MAX = 32


class SeqsAround(NamedTuple):
    """Numbers of the stored frames next to a time.

    `last` is at or before it, or one less than the first number that counts if none is; `after` is
    the next stored one, or `last` + 1.
    """

    last: int
    after: int


@dataclass(frozen=True)
class SessionStream(StreamState):
    """Facts of one stream, for the sessions with a part in it.

    Attributes:
        info: description of its array; None: unknown.
        journal: its frames; None: there are none.
        seqs_around_cache: earlier answers of `find_seqs_around`; None: nothing is cached.
        offset_ns: offset from its times to the clock that gives the stop's time; None: unknown, or
            no session is stopped by that clock.
        last_seen_t_ns: arrival time of its last frame, by that clock; None: unknown.
        first_t_ns: time of the oldest frame that its node has of an ended stream; None: unknown.
        unsynced: stored numbers that a power failure may take back.
    """

    info: ArrayInfo | None = None
    journal: Journal | None = None
    seqs_around_cache: dict[tuple[int, int], SeqsAround] | None = None
    offset_ns: int | None = None
    last_seen_t_ns: int | None = None
    first_t_ns: int | None = None
    unsynced: Intervals = field(default_factory=Intervals)

    def find_batch_t_ns_near(self, seq: int, *, at_or_before: bool) -> int | None:
        """Return the node's time of the newest frame up to `seq` or the oldest from it, or None."""
        return (
            self.journal.find_batch_t_ns_near(seq, at_or_before=at_or_before)
            if self.journal is not None
            else None
        )

    def find_seqs_around(
        self, t_ns: int, *, min_seq: int, may_be_stale: bool = False
    ) -> SeqsAround | None:
        """Return the stored frames next to a time.

        A running server repeats the query while frames are missing: the journal's index is read
        again only when frames between the two have come.

        Args:
            t_ns: the time, node's UTC.
            min_seq: earlier numbers do not count; the last is `min_seq` - 1 if there is none.
            may_be_stale: a cached answer will do until all frames between have come or are lost.

        Returns:
            Both numbers; None while the stream has not passed the time.

        Raises:
            DamagedFramesError: the frames at that time are damaged.
        """
        if self.journal is None:
            return None
        cache = {} if self.seqs_around_cache is None else self.seqs_around_cache
        found = cache.get((t_ns, min_seq))
        if found is not None:
            last, after = found
            ends = self.stored.restricted_to(after, after) and (
                last < min_seq or self.stored.restricted_to(last, last)
            )
            missing = self.stored.missing_in(last + 1, after - 1)
            none_came = missing.number_count == after - last - 1
            if ends and (none_came or (may_be_stale and missing & self.obtainable)):
                return found
        last_seq = self.journal.find_part_last_seq_once_passed(t_ns, part_seq_first=min_seq)
        if last_seq is None:
            return None
        # If the clock steps back, frames after that time may have lower numbers than earlier ones.
        after_seq = self.stored.restricted_to(last_seq + 1, NO_END).first
        found = SeqsAround(last_seq, last_seq + 1 if after_seq is None else after_seq)
        if len(cache) >= _CACHED_INSTANTS_MAX:
            cache.clear()
        cache[t_ns, min_seq] = found
        return found


class NodeReport(NamedTuple):
    """Report of a node on its present stream, at its last connection."""

    t_ns: int
    """Arrival time, by the clock that gives the times of stops."""
    next_seq: int
    first_seq: int | None
    """Number of the oldest frame that it had; None: it had none."""
    first_t_ns: int
    """Time of that frame by the node's clock; 0: unknown."""


FramesToCome = Literal["possible", "none", "abandoned"]


@dataclass(frozen=True)
class NodeFacts:
    """Facts of a node for its sessions: a server's, the node's own, or those of files alone.

    Attributes:
        now_t_ns: present time, by the clock that gives the times of stops.
        find_stream: returns the facts of a stream by its id; None: it is unknown.
        stream_ids: its streams, oldest first; the present one is last.
        unreadable: ids of streams whose journals cannot be read now.
        frames_to_come: possible: any may come; none: all are here or lost; abandoned: further ones
            do not count.
        is_running: True: facts of a running server; a stream without a known end may go on.
        has_reported: True: it has reported its streams since the server was started; an unknown
            one is gone.
        is_connected: True: it is connected to the server.
        newest_seq: number of its newest frame; None: unknown.
        offset_ns: offset of its present clock to that of stops; None: unknown.
        report: last report on the present stream; None: not since the server was started.
        scene: name of its present scene.
        scene_content: content of that scene's file.
        calibration: calibration of its present tiles.
        calibration_source: origin of the calibration.
        vitals: newest vitals of its machine; None: unknown.
    """

    now_t_ns: int = 0
    find_stream: Callable[[str], SessionStream | None] = lambda _: None
    stream_ids: Sequence[str] = ()
    unreadable: Collection[str] = ()
    frames_to_come: FramesToCome = "possible"
    is_running: bool = False
    has_reported: bool = False
    is_connected: bool = False
    newest_seq: int | None = None
    offset_ns: int | None = None
    report: NodeReport | None = None
    scene: str = ""
    scene_content: Mapping[str, Any] = field(default_factory=dict)
    calibration: Calibration | None = None
    calibration_source: Literal["node", "server"] = "node"
    vitals: Vitals | None = None

    @property
    def present_id(self) -> str | None:
        """Id of the present stream; None: unknown."""
        return self.stream_ids[-1] if self.stream_ids else None

    def get_stream(self, session: Session, stream_id: str) -> SessionStream:
        """Return a stream's facts, with the offset of its clock to the one of the session's stop.

        Without a measurement at the stop it is the present one, else the session's last one; a
        present stream is measured soon. Until the node has reported its streams, all frames of an
        unknown one are obtainable.
        """
        stream = self.find_stream(stream_id)
        if stream is None:
            is_gone = self.has_reported or self.frames_to_come == "none"
            return SessionStream(obtainable=Intervals(() if is_gone else [(0, NO_END)]))
        at_stop_ns = session.server_minus_node_ns_at_stop.get(stream_id)
        if at_stop_ns is not None:
            return replace(stream, offset_ns=at_stop_ns)
        if stream.offset_ns is not None or (self.has_reported and stream_id == self.present_id):
            return stream
        rows = [row for row in session.clock if row.stream_id == stream_id]
        # No link during that stream: most likely the node's clock was as wrong as now.
        offset_ns = rows[-1].server_minus_node_ns if rows else self.offset_ns
        return stream if offset_ns is None else replace(stream, offset_ns=offset_ns)

    def is_clock_of_stop_known(self, session: Session, stream_id: str) -> bool:
        """Return whether a stream's times can be compared with the time of the session's stop.

        Measurements before the server's last start may be to a clock of another date. A clock that
        was never measured was most likely as wrong as the present one.
        """
        stream = self.find_stream(stream_id)
        if stream_id in session.server_minus_node_ns_at_stop or (
            stream is not None and stream.offset_ns is not None
        ):
            return True
        return self.has_reported and all(row.stream_id != stream_id for row in session.clock)

    def collect_streams(self, session: Session) -> dict[str, SessionStream]:
        """Return the facts of a session's streams, by stream id."""
        ids = dict.fromkeys(part.stream_id for part in session.parts)
        return {stream_id: self.get_stream(session, stream_id) for stream_id in ids}


RATE_MAX_HZ = 1000.0
"""Assumed rate of a stream without a description: no bus is faster."""


def close_where_stream_passed_stop(
    session: Session, node: NodeFacts, *, leave_open_while_missing: bool = False
) -> Session:
    """Return the session with those open parts closed whose stream has passed the stop.

    Args:
        session: the session.
        node: facts of its node.
        leave_open_while_missing: keep a part open while frames closer to the stop may come.

    Raises:
        DamagedFramesError: the frames at the stop are damaged.
    """
    if session.stopped_t_ns is None:
        return session
    for part in session.parts:
        if part.seq_last is None and node.is_clock_of_stop_known(session, part.stream_id):
            stream = node.get_stream(session, part.stream_id)
            last = _find_last_seq_at_stop(
                session, part, stream, leave_open_while_missing=leave_open_while_missing
            )
            if last is not None:
                session = close_part(session, part, last)
    return session


def close_at_likely_end(session: Session, node: NodeFacts) -> Session:
    """Return the session closed at its likely end; frames close to the stop may still come."""
    with suppress(FootTileError):  # the frames at the stop are damaged
        return close_where_stream_passed_stop(session, node)
    return session


def close_at_stream_end_or_newest_frame(session: Session, node: NodeFacts) -> Session:
    """Return the session with every open part closed at the end of its stream."""
    for part in session.parts:
        if part.seq_last is None:
            stream = node.get_stream(session, part.stream_id)
            newest = stream.stored.last
            beyond = 0 if newest is None else newest + 1
            if stream.next_seq is None:
                unsent = _bound_unsent_frames(session, stream, node)
                session = close_part(session, part, beyond - 1, unsent)
            else:
                # Frames that a node lost in a power failure may be stored here.
                tail = stream.max_lost_tail_frames - max(0, beyond - stream.next_seq)
                session = close_part(session, part, max(stream.next_seq, beyond) - 1, max(0, tail))
    return session


def close_unfinished(session: Session, node: NodeFacts) -> Session:
    """Return the session with every part closed at its stored frames: no more will come.

    A session without a stop gets the time of its newest frame as stop.

    Raises:
        DamagedFramesError: the frames at the stop are damaged.
    """
    session = close_at_stream_end_or_newest_frame(
        close_where_stream_passed_stop(session, node), node
    )
    if session.stopped_t_ns is None:
        last_part = session.parts[-1]
        stream = node.get_stream(session, last_part.stream_id)
        newest_t_ns = stream.find_batch_t_ns_near(last_part.seq_last or 0, at_or_before=True)
        stopped_t_ns = session.started_t_ns
        if newest_t_ns is not None:
            stopped_t_ns = newest_t_ns + (stream.offset_ns or 0)
        session = session.model_copy(update={"stopped_t_ns": stopped_t_ns})
    return session


def close_part(session: Session, part: Part, seq_last: int, max_lost_tail: int = 0) -> Session:
    """Return the session with one of its parts closed.

    Args:
        session: the session.
        part: equal to one of its parts.
        seq_last: number of the last frame; below the first one for a part without frames.
        max_lost_tail: lost frames that may follow.

    Raises:
        ValueError: the session has no such part.
    """
    parts = list(session.parts)
    closed = part.model_copy(update={"seq_last": max(seq_last, part.seq_first - 1)})
    parts[parts.index(part)] = closed
    update: dict[str, object] = {"parts": tuple(parts)}
    if max_lost_tail:
        update["max_lost_tail_frames"] = {
            **session.max_lost_tail_frames,
            part.stream_id: max_lost_tail,
        }
    return session.model_copy(update=update)


def find_first_seq(
    stream: SessionStream, newest: tuple[int, int], pre_roll_s: float, coming: Intervals
) -> int:
    """Return the first number of a session that starts now, or a pre-roll earlier if stored.

    Args:
        stream: present stream of the node.
        newest: number and time of its newest frame.
        pre_roll_s: length of the pre-roll.
        coming: numbers that the node still has and will send; they count as stored.
    """
    newest_seq, newest_t_ns = newest
    seq_first, journal = newest_seq + 1, stream.journal
    if pre_roll_s <= 0 or journal is None or stream.info is None:
        return seq_first
    since_t_ns = newest_t_ns - round(pre_roll_s * 1e9)
    reached = journal.find_first_batch_seq_since(since_t_ns)
    seq_first = min(seq_first, reached if reached is not None else seq_first)
    reached_t_ns = stream.find_batch_t_ns_near(seq_first, at_or_before=False)
    if reached_t_ns is not None and reached_t_ns > since_t_ns:
        back = round((reached_t_ns - since_t_ns) * 1e-9 * stream.info.nominal_rate_hz)
        coming = coming.restricted_to(max(0, seq_first - back), seq_first - 1)
        seq_first = min((first for first, _ in coming), default=seq_first)
    return seq_first


_BEFORE_LOAD_S = 0.1
"""Time before a load in which the foot was in the air: contact is found late by less."""


def compute_warm_up(
    info: ArrayInfo, seq_first: int, settling_s: float, unloaded_seq: int | None = None
) -> Part | None:
    """Return the frames before a session in which models settle; None: its stream begins there.

    Time settles creep and gas, and a load that ends closes loops: frames reach back to the last
    unloaded one, but not farther than frames of no session are kept. Missing ones may still come.

    Args:
        info: array of the session's first part.
        seq_first: first number of the session.
        settling_s: time that the models need.
        unloaded_seq: number of the last frame without contact; None: unknown.
    """
    if not seq_first:
        return None
    rate_hz = info.nominal_rate_hz  # of a slower stream it is a longer time
    first = seq_first - math.ceil(settling_s * rate_hz)
    if unloaded_seq is not None:
        first = min(first, unloaded_seq - math.ceil(_BEFORE_LOAD_S * rate_hz))
    first = max(0, first, seq_first - math.floor(RING_DURATION_NS * 1e-9 * rate_hz))
    return Part(stream_id=info.stream_id, seq_first=first, seq_last=seq_first - 1)


def find_usable_warm_up(session: Session) -> Part | None:
    """Return the warm-up frames; None if the session turned out to begin with a later stream."""
    before = session.warm_up
    return before if before and before.stream_id == session.parts[0].stream_id else None


def reopen_earlier_part(session: Session, node: NodeFacts) -> Session:
    """Return the session with its open end in an earlier stream that was resumed.

    A part is closed when its node announces another stream. If that stream is gone and the earlier
    one goes on, as when a copy of a node's card was in use for a while, the recording goes on in
    the earlier one, with all frames that it has had meanwhile.
    """
    last_part = session.parts[-1]
    if last_part.seq_last is not None or not node.has_reported:
        return session
    stream = node.find_stream(last_part.stream_id)
    may_go_on = stream is not None and (
        last_part.stream_id in node.stream_ids or bool(stream.obtainable)
    )
    if may_go_on or last_part.stream_id in node.unreadable:
        return session
    for stream_id in node.stream_ids:
        own_parts = [part for part in session.parts if part.stream_id == stream_id]
        if not own_parts:
            continue
        stream = node.get_stream(session, stream_id)
        ends = [part.seq_last for part in own_parts if part.seq_last is not None]
        seq_first = max(ends, default=-1) + 1
        if (stream.stored | stream.obtainable).restricted_to(seq_first, NO_END):
            session = _switch_stream(session, node, Part(stream_id=stream_id, seq_first=seq_first))
    return session


def _switch_stream(session: Session, node: NodeFacts, part: Part) -> Session:
    """Return the session with its open part closed and another one open."""
    *before, last_part = close_at_stream_end_or_newest_frame(session, node).parts
    tails = {name: n for name, n in session.max_lost_tail_frames.items() if name != part.stream_id}
    parts = (
        before
        if last_part.seq_last is None or last_part.seq_last < last_part.seq_first
        else [*before, last_part]
    )
    if parts and parts[-1].stream_id == part.stream_id:
        part = parts.pop().model_copy(update={"seq_last": None})
    return session.model_copy(update={"parts": (*parts, part), "max_lost_tail_frames": tails})


def find_later_streams(session: Session, node: NodeFacts) -> Sequence[str]:
    """Return streams that began after the one of the session's open part, oldest first."""
    stream_id, order = session.parts[-1].stream_id, node.stream_ids
    if stream_id in order:
        return order[order.index(stream_id) + 1 :]
    # The node no longer lists it: streams that began after its last frame are later.
    newest_t_ns = node.get_stream(session, stream_id).find_batch_t_ns_near(
        NO_END, at_or_before=True
    )
    known_ids = {part.stream_id for part in session.parts}

    def is_later(name: str) -> bool:
        begin_t_ns = node.get_stream(session, name).first_t_ns
        return newest_t_ns is not None and begin_t_ns is not None and begin_t_ns > newest_t_ns

    return [n for n in order if n not in known_ids and (n == node.present_id or is_later(n))]


def has_begun_before_stop(session: Session, node: NodeFacts, stream_id: str) -> bool | None:
    """Return whether a stream began before the session was stopped; None: not known yet.

    The node states the time of its oldest frame. That is the begin of the stream, unless older
    frames are gone: then only the frames themselves show it.
    """
    stop_t_ns = session.stopped_t_ns
    if stop_t_ns is None:
        return True
    stream = node.get_stream(session, stream_id)
    offset_ns, report, oldest = stream.offset_ns, node.report, stream.stored.first
    if stream_id != node.present_id:
        is_known = offset_ns is not None and stream.first_t_ns is not None
        return find_begin_t_ns(stream, node) <= stop_t_ns if is_known else None
    if report is not None and not report.next_seq and oldest is None:
        # The report may not count the newest frames; these come at once.
        is_settled = stop_t_ns < report.t_ns < node.now_t_ns - _UNSENT_NS
        return False if is_settled else None
    if offset_ns is None:
        return None
    if report is not None and report.first_t_ns and report.first_seq is not None:
        if report.first_t_ns + offset_ns <= stop_t_ns:
            return True
        if report.first_seq == 0:
            return False
    if oldest is None:
        return None
    taken_t_ns = stream.find_batch_t_ns_near(oldest, at_or_before=False)
    if taken_t_ns is None:
        return None
    if taken_t_ns + offset_ns <= stop_t_ns:
        return True
    if stream.obtainable.restricted_to(0, oldest - 1):
        return None
    return taken_t_ns + offset_ns - round(oldest / _rate_hz(stream) * 1e9) <= stop_t_ns


def find_begin_t_ns(stream: SessionStream, node: NodeFacts) -> int:
    """Return the begin of a stream, by the clock of stops; the present time if unknown."""
    if stream.first_t_ns is None or stream.offset_ns is None:
        return node.now_t_ns
    return stream.first_t_ns + stream.offset_ns


def bound_lost_tail_frames(stream: SessionStream) -> int:
    """Return the upper bound of frames that a stream had after its newest stored one."""
    if stream.next_seq is not None:
        return stream.max_lost_tail_frames
    return max(stream.max_lost_tail_frames, compute_max_lost_tail_frames(_rate_hz(stream)))


def _find_last_seq_at_stop(
    session: Session, part: Part, stream: SessionStream, *, leave_open_while_missing: bool
) -> int | None:
    """Return the last frame of a stream before the stop; None if the stream has not passed it."""
    if session.stopped_t_ns is None or stream.offset_ns is None:
        return None
    stop_t_ns = session.stopped_t_ns - stream.offset_ns
    found = stream.find_seqs_around(
        stop_t_ns, min_seq=part.seq_first, may_be_stale=leave_open_while_missing
    )
    if found is None:
        return None
    last, after = found
    if after == last + 1:
        return last
    if leave_open_while_missing and stream.obtainable & Intervals([(last + 1, after - 1)]):
        return None
    # The stop lies among lost frames: the rate gives the number of those after it.
    after_t_ns = stream.find_batch_t_ns_near(after, at_or_before=False) or stop_t_ns
    late = math.ceil((after_t_ns - stop_t_ns) * 1e-9 * _rate_hz(stream))
    return min(after - 1, max(last, after - late))


def _bound_unsent_frames(session: Session, stream: SessionStream, node: NodeFacts) -> int:
    """Return the upper bound of frames after the newest known one.

    The stream is assumed to have run at its rate until the stop or, on a running server, until now
    if that is earlier. With neither, the bound is that of a power failure.
    """
    limits_ns = [session.stopped_t_ns] if session.stopped_t_ns is not None else []
    limits_ns += [node.now_t_ns] if node.is_running else []
    if not limits_ns:
        return bound_lost_tail_frames(stream)
    # Prefer the frame's own time: a delayed frame arrives late.
    newest_t_ns, seen_t_ns = (
        stream.find_batch_t_ns_near(NO_END, at_or_before=True),
        stream.last_seen_t_ns,
    )
    if newest_t_ns is not None and (stream.offset_ns is not None or seen_t_ns is None):
        seen_t_ns = newest_t_ns + (stream.offset_ns or 0)
    silent_s = (min(limits_ns) - (seen_t_ns or session.started_t_ns)) / 1e9
    return max(1, stream.max_lost_tail_frames, math.ceil(silent_s * _rate_hz(stream)))


def _rate_hz(stream: SessionStream) -> float:
    return stream.info.nominal_rate_hz if stream.info is not None else RATE_MAX_HZ
