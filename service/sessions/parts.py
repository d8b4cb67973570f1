"""Parts of sessions: their creation and their ends.

A session ends with the last frame before its stop, by the clock that gave the stop's time. A stream
that ended before that ends its part. Where frames are missing, the end is placed by the rate; where
a node has not reported how its stream ended, the number of unsent frames is bounded.

A *node's stream* (`NodeStream`) is the node's own, a *server's stream* (`ServerStream`) the
server's copy. Both, and a journal that is opened after a crash, give the facts of a
`SessionStream`; ends, ledger and inputs of a session follow from these alone.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any, Literal, NamedTuple, Protocol

from devices.frames import ArrayInfo
from service.estimation.calibration import Calibration
from service.server_clock import server_utc_ns
from storage.intervals import NO_END, Intervals
from storage.journal.journal import Journal
from storage.journal.stream_notes import compute_max_lost_tail_frames
from storage.sessions.folder import Part, Session, make_session_id
from storage.sessions.ledger import StreamState


def create_session(
    info: ArrayInfo,
    name: str,
    part: Part,
    *,
    scene_content: Mapping[str, Any],
    calibration: Calibration | None,
    **fields: Any,
) -> Session:
    """Create a session that begins now.

    Args:
        info: array of its first part.
        name: user-given name.
        part: first part.
        scene_content: content of the node's scene file.
        calibration: calibration in use at the beginning.
        fields: further fields of a session, or other values of the above.
    """
    facts: dict[str, Any] = {
        "id": make_session_id(datetime.now(UTC)),
        "name": name,
        "node": info.node,
        "state": "recording",
        "started_t_ns": server_utc_ns(),
        "parts": (part,),
        "scene": info.scene,
        "scene_content": dict(scene_content),
        "calibration": calibration.model_dump(mode="json") if calibration is not None else None,
    }
    return Session(**facts | fields)


class ContinuedSession(NamedTuple):
    """Session whose tiles have changed, in two."""

    closed: Session
    continuation: Session


def stop_session_and_make_continuation(
    session: Session,
    info: ArrayInfo,
    begin_t_ns: int,
    *,
    scene_content: Mapping[str, Any],
    calibration: Calibration | None,
    calibration_source: Literal["node", "server"] = "node",
) -> ContinuedSession:
    """Return a session whose tiles have changed, closed, and its continuation.

    A file describes one array, so the recording goes on in another session.

    Args:
        session: session whose last part is closed.
        info: present array of the node.
        begin_t_ns: begin of its stream, by the clock that gives the times of stops.
        scene_content: content of the node's scene file.
        calibration: calibration of the present tiles.
        calibration_source: origin of the calibration.
    """
    problem = "the node came back with other tiles: recording ended"
    update: dict[str, object] = {"problem": problem}
    if session.state == "recording":
        update |= {"state": "pending", "stopped_t_ns": begin_t_ns}
    name, number = split_number_in_parentheses(session.name)
    continuation = create_session(
        info,
        f"{name} ({number + 1})",
        Part(stream_id=info.stream_id, seq_first=0),
        scene_content=scene_content,
        calibration=calibration,
        calibration_source=calibration_source,
        state=session.state,
        started_t_ns=begin_t_ns,
        stopped_t_ns=session.stopped_t_ns,
        continues=session.id,
        **{field: getattr(session, field) for field in ("subject", "notes", "tags", "take")},
    )
    return ContinuedSession(session.model_copy(update=update), continuation)


class NumberedName(NamedTuple):
    """Name of a session as given, and its number: 2 for `mud (2)`, else 1."""

    given: str
    number: int


def split_number_in_parentheses(name: str) -> NumberedName:
    """Split a session's name into the given name and its number."""
    match = re.fullmatch(r"(.*) \((\d+)\)", name)
    return NumberedName(match[1], int(match[2])) if match else NumberedName(name, 1)


class SeqsAround(NamedTuple):
    """Numbers of the stored frames next to a time.

    `last` is at or before it, or one less than the first number that counts if none is; `after` is
    the next stored one, or `last` + 1.
    """

    last: int
    after: int


class SeqsAroundFinder(Protocol):
    """Lookup of the frames next to a time of a stream."""

    def __call__(self, t_ns: int, *, min_seq: int, may_be_stale: bool = False) -> SeqsAround | None:
        """Return the same as `find_seqs_around_once_passed`.

        Args:
            t_ns: the time, node's UTC.
            min_seq: earlier numbers do not count.
            may_be_stale: an earlier answer will do while frames between the two may still come.
        """


@dataclass(frozen=True)
class SessionStream(StreamState):
    """Facts of one stream, for the sessions with a part in it.

    Attributes:
        info: description of its array; None: unknown.
        journal: its frames; None: there are none.
        find_seqs_around: lookup of the frames next to a time.
        offset_ns: offset from its times to the clock that gives the stop's time; None: unknown, or
            no session is stopped by that clock.
        last_seen_t_ns: arrival time of its last frame, by that clock; None: unknown.
    """

    info: ArrayInfo | None = None
    journal: Journal | None = None
    find_seqs_around: SeqsAroundFinder | None = None
    offset_ns: int | None = None
    last_seen_t_ns: int | None = None

    def find_batch_t_ns_near(self, seq: int, *, at_or_before: bool) -> int | None:
        """Return the node's time of the newest frame up to `seq` or the oldest from it, or None."""
        return (
            self.journal.find_batch_t_ns_near(seq, at_or_before=at_or_before)
            if self.journal is not None
            else None
        )


def find_seqs_around_once_passed(journal: Journal, t_ns: int, *, min_seq: int) -> SeqsAround | None:
    """Return the stored frames next to a time.

    Args:
        journal: journal of the stream.
        t_ns: the time, node's UTC.
        min_seq: earlier numbers do not count; the last is `min_seq` - 1 if there is none.

    Returns:
        Both numbers; None while the stream has not passed the time.

    Raises:
        DamagedFramesError: the frames at that time are damaged.
    """
    last = journal.find_part_last_seq_once_passed(t_ns, part_seq_first=min_seq)
    if last is None:
        return None
    # If the clock steps back, frames after that time may have lower numbers than earlier ones.
    after = journal.stored.restricted_to(last + 1, NO_END).first
    return SeqsAround(last, last + 1 if after is None else after)


RATE_MAX_HZ = 1000.0
"""Assumed rate of a stream without a description: no bus is faster."""

Streams = Mapping[str, SessionStream]


def close_at_stop_if_passed(
    session: Session, streams: Streams, *, leave_open_while_missing: bool = False
) -> Session:
    """Return the session with those open parts closed whose stream has passed the stop.

    Args:
        session: the session.
        streams: facts by stream id, for all of its parts.
        leave_open_while_missing: keep a part open while frames closer to the stop may come.

    Raises:
        DamagedFramesError: the frames at the stop are damaged.
    """
    for part in session.parts:
        if part.seq_last is None:
            last = _seq_at_stop(
                session, part, streams[part.stream_id], waiting=leave_open_while_missing
            )
            if last is not None:
                session = close_part(session, part, last)
    return session


def close_at_stream_end_or_newest_frame(
    session: Session, streams: Streams, now_t_ns: int | None = None
) -> Session:
    """Return the session with every open part closed at the end of its stream.

    Args:
        session: the session.
        streams: facts by stream id, for all of its parts.
        now_t_ns: a stream without a known end may have gone on until then; None: its session ends
            with the newest stored frame.
    """
    for part in session.parts:
        if part.seq_last is None:
            stream = streams[part.stream_id]
            newest = stream.stored.last
            beyond = 0 if newest is None else newest + 1
            if stream.next_seq is None:
                session = close_part(
                    session, part, beyond - 1, _max_unsent_frames(session, stream, now_t_ns)
                )
            else:
                # Frames that a node lost in a power failure may be stored here.
                tail = stream.max_lost_tail_frames - max(0, beyond - stream.next_seq)
                session = close_part(session, part, max(stream.next_seq, beyond) - 1, max(0, tail))
    return session


def close_unfinished(session: Session, streams: Streams, now_t_ns: int | None = None) -> Session:
    """Return the session with every part closed at its stored frames: no more will come.

    A session without a stop gets the time of its newest frame as stop.

    Args:
        session: the session.
        streams: facts by stream id, for all of its parts.
        now_t_ns: as for `close_at_stream_end_or_newest_frame`.

    Raises:
        DamagedFramesError: the frames at the stop are damaged.
    """
    session = close_at_stream_end_or_newest_frame(
        close_at_stop_if_passed(session, streams), streams, now_t_ns
    )
    if session.stopped_t_ns is None:
        stream = streams[session.parts[-1].stream_id]
        newest_t_ns = stream.find_batch_t_ns_near(
            session.parts[-1].seq_last or 0, at_or_before=True
        )
        stopped_t_ns = session.started_t_ns
        if newest_t_ns is not None:
            stopped_t_ns = newest_t_ns + (stream.offset_ns or 0)
        session = session.model_copy(update={"stopped_t_ns": stopped_t_ns})
    return session


def close_part(session: Session, part: Part, seq_last: int, max_lost_tail: int = 0) -> Session:
    """Return the session with a part closed; up to `max_lost_tail` lost frames may follow."""
    closed = part.model_copy(update={"seq_last": max(seq_last, part.seq_first - 1)})
    parts = tuple(closed if each is part else each for each in session.parts)
    update: dict[str, object] = {"parts": parts}
    if max_lost_tail:
        update["max_lost_tail_frames"] = {
            **session.max_lost_tail_frames,
            part.stream_id: max_lost_tail,
        }
    return session.model_copy(update=update)


def bound_lost_tail_frames(stream: SessionStream) -> int:
    """Return the upper bound of frames that a stream had after its newest stored one."""
    if stream.next_seq is not None:
        return stream.max_lost_tail_frames
    return max(stream.max_lost_tail_frames, compute_max_lost_tail_frames(_rate_hz(stream)))


def _seq_at_stop(
    session: Session, part: Part, stream: SessionStream, *, waiting: bool
) -> int | None:
    """Return the last frame of a stream before the stop; None if the stream has not passed it."""
    if session.stopped_t_ns is None or stream.find_seqs_around is None or stream.offset_ns is None:
        return None
    stop_t_ns = session.stopped_t_ns - stream.offset_ns
    found = stream.find_seqs_around(stop_t_ns, min_seq=part.seq_first, may_be_stale=waiting)
    if found is None:
        return None
    last, after = found
    if after == last + 1:
        return last
    if waiting and stream.obtainable & Intervals([(last + 1, after - 1)]):
        return None
    # The stop lies among lost frames: the rate gives the number of those after it.
    after_t_ns = stream.find_batch_t_ns_near(after, at_or_before=False) or stop_t_ns
    late = math.ceil((after_t_ns - stop_t_ns) * 1e-9 * _rate_hz(stream))
    return min(after - 1, max(last, after - late))


def _max_unsent_frames(session: Session, stream: SessionStream, now_t_ns: int | None) -> int:
    """Return the upper bound of frames after the last known one.

    Until the earlier of stop and now; if neither is known, until the newest was synced.
    """
    limits_ns = [t_ns for t_ns in (session.stopped_t_ns, now_t_ns) if t_ns is not None]
    if not limits_ns:
        return bound_lost_tail_frames(stream)
    # Arrival times of delayed frames are too late.
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
