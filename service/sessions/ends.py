"""Where the parts of a session end: rules on what is known of its streams, nothing kept here.

A session ends with the last frame that was taken before it was stopped, by the clock that it
was stopped by. A stream that ended before that ends its part. Where frames are missing, the end is
placed by the rate; where a node has not said how its stream ended, the frames that it may have
taken unheard are bounded.

A *node's stream* (`NodeStream`) is what the node takes and keeps, a *server's stream*
(`ServerStream`) what a server has of it. Both, and a journal that is opened after a crash, give
the facts of a `SessionStream`; ends, ledger and sources of a session follow from these alone.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

from devices.frames import ArrayInfo
from storage.intervals import NO_END, Intervals
from storage.journal.journal import Journal
from storage.journal.stream_notes import unsynced_tail_max
from storage.sessions.folder import Part, Session
from storage.sessions.ledger import StreamState


class Around(Protocol):
    """Looks up the frames next to an instant of a stream."""

    def __call__(
        self, t_ns: int, *, at_least: int, waiting: bool = False
    ) -> tuple[int, int] | None:
        """As `around_in`; `waiting`: may return an earlier result while frames between may come."""


@dataclass(frozen=True)
class SessionStream(StreamState):
    """What is known of one stream, for the sessions that it is part of.

    Attributes:
        info: description of its array; None: not known.
        journal: its frames; None: there are none.
        around: looks up the frames next to an instant.
        offset_ns: what to add to its instants for those of the clock by which sessions are
            stopped; None: not known, or no session ends by that clock.
        last_seen_t_ns: when a frame of it came last, by that clock; None: not known.
    """

    info: ArrayInfo | None = None
    journal: Journal | None = None
    around: Around | None = None
    offset_ns: int | None = None
    last_seen_t_ns: int | None = None

    def t_ns_near(self, seq: int, *, newest: bool) -> int | None:
        """Its own UTC of the newest frame held up to `seq`, or of the oldest from `seq` on."""
        return self.journal.t_ns_near(seq, newest=newest) if self.journal is not None else None


def around_in(
    journal: Journal, t_ns: int, *, at_least: int, waiting: bool = False
) -> tuple[int, int] | None:
    """Numbers held next to an instant of the node's UTC: the last until it, the first after.

    Args:
        journal: of the stream.
        t_ns: the instant.
        at_least: earlier numbers do not count; the last is `at_least` - 1 if there is none.
        waiting: has no effect here, because nothing is remembered.

    Returns:
        Both; None while the stream has not passed the instant.

    Raises:
        DamagedFramesError: the frames that tell are damaged.
    """
    last = journal.last_seq_until(t_ns, at_least=at_least)
    if last is None:
        return None
    # Where time runs back, frames after the instant may have lower numbers than those before it.
    after = journal.held.within(last + 1, NO_END).first
    return last, last + 1 if after is None else after


RATE_MAX_HZ = 1000.0
"""Assumed rate of a stream without a description: no bus is faster."""

Streams = Mapping[str, SessionStream]


def at_stop(session: Session, streams: Streams, *, waiting: bool = False) -> Session:
    """The session with the parts ended whose stream has passed the stop.

    Args:
        session: the session.
        streams: by boot_id, of all of its parts.
        waiting: leave a part open while frames may come that were taken nearer to the stop.

    Raises:
        DamagedFramesError: the frames that tell are damaged.
    """
    for part in session.parts:
        if part.seq_last is None:
            last = _seq_at_stop(session, part, streams[part.boot_id], waiting=waiting)
            if last is not None:
                session = ended(session, part, last)
    return session


def at_end(session: Session, streams: Streams, now_t_ns: int | None = None) -> Session:
    """The session with every open part ended where its stream ended.

    Args:
        session: the session.
        streams: by boot_id, of all of its parts.
        now_t_ns: a stream whose end is not known may have gone on until then; None: its session
            ends with the newest frame there is.
    """
    for part in session.parts:
        if part.seq_last is None:
            stream = streams[part.boot_id]
            newest = stream.held.last
            beyond = 0 if newest is None else newest + 1
            if stream.next_seq is None:
                session = ended(session, part, beyond - 1, _unheard(session, stream, now_t_ns))
            else:
                # What a node lost with its power may have come here before.
                tail = stream.unsynced_tail_max - max(0, beyond - stream.next_seq)
                session = ended(session, part, max(stream.next_seq, beyond) - 1, max(0, tail))
    return session


def broken_off(session: Session, streams: Streams, now_t_ns: int | None = None) -> Session:
    """The session with every part ended by the frames that are here: no more will come.

    If it was never stopped, it was stopped with its newest frame.

    Args:
        session: the session.
        streams: by boot_id, of all of its parts.
        now_t_ns: as for `at_end`.

    Raises:
        DamagedFramesError: the frames that tell are damaged.
    """
    session = at_end(at_stop(session, streams), streams, now_t_ns)
    if session.stopped_t_ns is None:
        stream = streams[session.parts[-1].boot_id]
        newest_t_ns = stream.t_ns_near(session.parts[-1].seq_last or 0, newest=True)
        stopped_t_ns = session.started_t_ns
        if newest_t_ns is not None:
            stopped_t_ns = newest_t_ns + (stream.offset_ns or 0)
        session = session.model_copy(update={"stopped_t_ns": stopped_t_ns})
    return session


def ended(session: Session, part: Part, seq_last: int, tail: int = 0) -> Session:
    """The session with this end of a part; up to `tail` frames may have followed it."""
    closed = part.model_copy(update={"seq_last": max(seq_last, part.seq_first - 1)})
    parts = tuple(closed if each is part else each for each in session.parts)
    update: dict[str, object] = {"parts": parts}
    if tail:
        update["unsynced_tail_max"] = {**session.unsynced_tail_max, part.boot_id: tail}
    return session.model_copy(update=update)


def open_tail(stream: SessionStream) -> int:
    """How many frames a stream may have had after its newest one, as far as that is known."""
    if stream.next_seq is not None:
        return stream.unsynced_tail_max
    return max(stream.unsynced_tail_max, unsynced_tail_max(_rate_hz(stream)))


def _seq_at_stop(
    session: Session, part: Part, stream: SessionStream, *, waiting: bool
) -> int | None:
    """The last frame of a stream before the stop; None if the stream has not passed it."""
    if session.stopped_t_ns is None or stream.around is None or stream.offset_ns is None:
        return None
    stop_t_ns = session.stopped_t_ns - stream.offset_ns
    found = stream.around(stop_t_ns, at_least=part.seq_first, waiting=waiting)
    if found is None:
        return None
    last, after = found
    if after == last + 1:
        return last
    if waiting and stream.may_come & Intervals([(last + 1, after - 1)]):
        return None
    # The stop lies among lost frames: the rate tells how many of them came after it.
    after_t_ns = stream.t_ns_near(after, newest=False) or stop_t_ns
    late = math.ceil((after_t_ns - stop_t_ns) * 1e-9 * _rate_hz(stream))
    return min(after - 1, max(last, after - late))


def _unheard(session: Session, stream: SessionStream, now_t_ns: int | None) -> int:
    """How many frames there may have been after the last known one.

    Until the stop or now, whichever was first; if neither is known, until the newest was synced.
    """
    known = [t_ns for t_ns in (session.stopped_t_ns, now_t_ns) if t_ns is not None]
    if not known:
        return open_tail(stream)
    # Frames that were sent late came later than they were taken.
    newest_t_ns, seen_t_ns = stream.t_ns_near(NO_END, newest=True), stream.last_seen_t_ns
    if newest_t_ns is not None and (stream.offset_ns is not None or seen_t_ns is None):
        seen_t_ns = newest_t_ns + (stream.offset_ns or 0)
    silent_s = (min(known) - (seen_t_ns or session.started_t_ns)) / 1e9
    return max(1, stream.unsynced_tail_max, math.ceil(silent_s * _rate_hz(stream)))


def _rate_hz(stream: SessionStream) -> float:
    return stream.info.nominal_rate_hz if stream.info is not None else RATE_MAX_HZ
