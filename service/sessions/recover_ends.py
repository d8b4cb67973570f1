"""Where the parts of a session end that nobody has stopped, or whose stop nobody has followed."""

from __future__ import annotations

from collections.abc import Mapping

from service.sessions.recover_sources import RATE_MAX_HZ, Stream
from storage.intervals import NO_END
from storage.journal.stream_notes import unsynced_tail_max
from storage.sessions.folder import Part, Session


def with_ends(
    session: Session,
    streams: Mapping[tuple[str, str], Stream],
    *,
    is_local: bool,
    may_guess: bool,
) -> Session:
    """The session with the ends of its parts, as far as they are known or may be guessed.

    Args:
        session: as it was when everything died.
        streams: opened, by node and boot_id.
        is_local: is it the node's own, whose clock it was stopped by?
        may_guess: end an open part with the newest frame there is; how many more there may have
            been is noted. Otherwise it stays open.
    """
    parts, tails = [], dict(session.unsynced_tail_max)
    stopped_t_ns = session.stopped_t_ns
    for part in session.parts:
        if part.seq_last is not None:
            parts.append(part)
            continue
        stream = streams.get((session.node, part.boot_id))
        offset_ns = 0 if is_local else _server_minus_node_ns(session, part.boot_id)
        last = _end_at_stop(session, part, stream, offset_ns, may_guess=may_guess)
        if last is None and may_guess:
            known = stream.last if stream is not None else None
            last = max(part.seq_first - 1, -1 if known is None else known)
            tail = stream.tail_max if stream is not None else unsynced_tail_max(RATE_MAX_HZ)
            if not is_local and stream is not None:
                tail = max(tail, _silent_frames(session, stream, last, offset_ns or 0))
            tails[part.boot_id] = max(tails.get(part.boot_id, 0), tail)
            if stopped_t_ns is None:
                stopped_t_ns = _newest_t_ns(stream, last, offset_ns or 0, session.started_t_ns)
        parts.append(part.model_copy(update={"seq_last": last}))
    tails = {boot_id: tail for boot_id, tail in tails.items() if tail}
    changed = {"parts": tuple(parts), "unsynced_tail_max": tails, "stopped_t_ns": stopped_t_ns}
    return session.model_copy(update=changed)


def _end_at_stop(
    session: Session,
    part: Part,
    stream: Stream | None,
    offset_ns: int | None,
    *,
    may_guess: bool,
) -> int | None:
    """The last frame before the session was stopped, if its stream has passed that.

    If frames around the stop are missing, it is not known which was the last: then all of them
    count, if that may be guessed. The newest frames come first, and the others behind them.
    """
    if session.stopped_t_ns is None or offset_ns is None or stream is None:
        return None
    until_t_ns = session.stopped_t_ns - offset_ns
    last = stream.journal.last_seq_until(until_t_ns, at_least=part.seq_first)
    if last is None:
        return None
    after = next(iter(stream.journal.held.within(last + 1, NO_END)), None)
    if after is None or after[0] == last + 1:
        return last
    return after[0] - 1 if may_guess else None


def _server_minus_node_ns(session: Session, boot_id: str) -> int | None:
    rows = [row for row in session.clock if row.boot_id == boot_id]
    return rows[-1].server_minus_node_ns if rows else None


def _newest_t_ns(stream: Stream | None, last: int, offset_ns: int, otherwise_ns: int) -> int:
    newest = stream.journal.t_ns_near(last, newest=True) if stream is not None else None
    return newest + offset_ns if newest is not None else otherwise_ns


def _silent_frames(session: Session, stream: Stream, last: int, offset_ns: int) -> int:
    """How many frames its node may have taken between the newest one here and the stop."""
    newest_t_ns = stream.journal.t_ns_near(last, newest=True)
    has_ended = stream.notes is not None and stream.notes.has_ended
    if session.stopped_t_ns is None or newest_t_ns is None or has_ended:
        return 0
    silent_s = (session.stopped_t_ns - newest_t_ns - offset_ns) * 1e-9
    return max(0, round(silent_s * stream.journal.info.nominal_rate_hz))
