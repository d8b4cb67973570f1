"""Parts of sessions on a server: where they begin, go on in another stream, and end.

A session is a list of intervals of streams. A node that restarts adds a part, and so does every
stream that it recorded offline and sends later. Where a part ends is decided in
`service.sessions.parts`.

The present ledger and inputs of a session follow from its parts.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import suppress

from devices.errors import FootTileError
from service.server.node import ServerNode
from service.server.streams import ServerStream
from service.server_clock import server_utc_ns
from service.sessions.inputs import SessionInputs, make_inputs
from service.sessions.parts import (
    SessionStream,
    close_at_stop_if_passed,
    close_at_stream_end_or_newest_frame,
    close_part,
    close_unfinished,
    stop_session_and_make_continuation,
)
from storage.clock.log import ClockOffset
from storage.intervals import NO_END, Intervals
from storage.sessions.folder import Ledger, Part, Session
from storage.sessions.ledger import (
    compute_ledger,
    group_numbers_by_stream,
    mark_damaged_and_abandoned_lost,
)

_UNSENT_NS = 1_000_000_000
"""Time after a hello within which frames may come that the hello did not count."""


def collect_stream_facts(session: Session, node: ServerNode | None) -> dict[str, SessionStream]:
    """Return the facts of a session's streams, by stream id."""
    found = {}
    for stream_id in dict.fromkeys(part.stream_id for part in session.parts):
        stream = node.streams.get(stream_id) if node is not None else None
        if stream is not None:
            found[stream_id] = stream.make_session_stream(
                _server_offset_ns(session, node, stream_id)
            )
        else:  # before its first hello the node may have all frames
            is_gone = node is not None and node.has_connected
            found[stream_id] = SessionStream(obtainable=Intervals(() if is_gone else [(0, NO_END)]))
    return found


def make_initial_part(node: ServerNode, last_seq: int, last_t_ns: int, pre_roll_s: float) -> Part:
    """Return the first part of a session that starts now, or a pre-roll earlier if stored.

    Frames that the node still has and will send count as stored.
    """
    seq_first, journal = last_seq + 1, node.journal
    if pre_roll_s > 0 and journal is not None:
        since_t_ns = last_t_ns - round(pre_roll_s * 1e9)
        reached = journal.find_first_batch_seq_since(since_t_ns)
        seq_first = min(seq_first, reached if reached is not None else seq_first)
        reached_t_ns = journal.find_batch_t_ns_near(seq_first, at_or_before=False)
        if reached_t_ns is not None and reached_t_ns > since_t_ns:
            back = round((reached_t_ns - since_t_ns) * 1e-9 * node.last_info.nominal_rate_hz)
            coming = node.present_stream_lost_or_pending & node.present_stream.obtainable
            coming = coming.restricted_to(max(0, seq_first - back), seq_first - 1)
            seq_first = min((first for first, _ in coming), default=seq_first)
    return Part(stream_id=node.stream_id, seq_first=seq_first)


def mark_stopped(session: Session, node: ServerNode | None) -> Session:
    """Return the session, stopped now; its end is open until the stream has passed this time."""
    update: dict[str, object] = {
        "stopped_t_ns": server_utc_ns(),
        "state": "pending",
        "problem": None,
    }
    if node is not None and node.is_connected:
        update["missed_slots_at_stop"] = {node.stream_id: node.present_stream.missed_slots}
    session = session.model_copy(update=update)
    if (
        node is None
        or node.clock_offset is not None
        or not node.is_connected
        or node.last_seq is None
    ):
        return session
    # Its clock cannot be compared with ours: end with the newest frame.
    return close_part(session, session.parts[-1], node.last_seq)


def extend_session_or_continue_with_other_tiles(
    session: Session, node: ServerNode
) -> list[Session]:
    """Extend the session's parts to the present end of its node's streams; nothing is saved.

    Returns:
        The session, and further ones that continue it where the node came back with other tiles.
    """
    found = [_reopen_earlier_part(session, node)]
    while found[-1].parts[-1].seq_last is None:
        extended = _extend_once(found[-1], node)
        if not extended:
            break
        found[-1:] = extended
    return found


def _reopen_earlier_part(session: Session, node: ServerNode) -> Session:
    """Return the session with its open end in an earlier stream that was resumed.

    A part is closed when its node announces another stream. If that stream is gone and the earlier
    one goes on, as when a copy of a node's card was in use for a while, the recording goes on in
    the earlier one, with all frames that it has had meanwhile.
    """
    last_part = session.parts[-1]
    stream = node.streams.get(last_part.stream_id)
    may_go_on = stream is not None and (
        last_part.stream_id in node.announced_stream_order or bool(stream.obtainable)
    )
    if (
        last_part.seq_last is not None
        or not node.has_connected
        or may_go_on
        or last_part.stream_id in node.unreadable_streams
    ):
        return session
    for stream_id in node.announced_stream_order:
        own_parts = [part for part in session.parts if part.stream_id == stream_id]
        stream = node.streams[stream_id]
        ends = [part.seq_last for part in own_parts if part.seq_last is not None]
        seq_first = max(ends, default=-1) + 1
        if own_parts and (stream.stored | stream.obtainable).restricted_to(seq_first, NO_END):
            session = _switch_stream(session, node, Part(stream_id=stream_id, seq_first=seq_first))
    return session


def _switch_stream(session: Session, node: ServerNode, part: Part) -> Session:
    """Return the session with its open part closed and another one open."""
    *before, last_part = close_at_stream_end_or_newest_frame(
        session, collect_stream_facts(session, node), server_utc_ns()
    ).parts
    tails = {name: n for name, n in session.max_lost_tail_frames.items() if name != part.stream_id}
    parts = (
        before
        if last_part.seq_last is None or last_part.seq_last < last_part.seq_first
        else [*before, last_part]
    )
    if parts and parts[-1].stream_id == part.stream_id:
        part = parts.pop().model_copy(update={"seq_last": None})
    return session.model_copy(update={"parts": (*parts, part), "max_lost_tail_frames": tails})


def abandon_missing(session: Session, node: ServerNode | None) -> Session:
    """Return the session without its missing frames: its open end is closed."""
    if node is not None:
        session = _reopen_earlier_part(session, node)
    closed = close_unfinished(session, collect_stream_facts(session, node), server_utc_ns())
    return closed.model_copy(update={"is_abandoned": True})


def iterate_own_and_possible_later_parts(
    session: Session, node: ServerNode | None
) -> Iterator[Part]:
    """Yield the parts that an unsealed session needs in the journals."""
    yield from session.parts
    if session.parts[-1].seq_last is None and node is not None:
        # The stream in which the session was stopped is not known yet.
        for stream_id in _later_streams(session, node):
            yield Part(stream_id=stream_id, seq_first=0)


def list_clock_offsets_since(stream: ServerStream, seq_first: int) -> tuple[ClockOffset, ...]:
    """Return a stream's clock measurements since a frame, and the last one before."""
    begin_t_ns = (
        stream.journal.find_batch_t_ns_near(seq_first, at_or_before=False)
        if stream.journal is not None
        else None
    )
    rows = list(stream.clock_offsets)
    if begin_t_ns is None:
        return tuple(rows[-1:])
    begin_ns = begin_t_ns - stream.info.utc_offset_ns
    before = [number for number, row in enumerate(rows) if row.t_mono_ns <= begin_ns]
    return tuple(rows[before[-1] if before else 0 :])


def _extend_once(session: Session, node: ServerNode) -> list[Session]:
    """Close the open part and return the session with the next one; empty if undecided."""
    stream_id = session.parts[-1].stream_id
    if stream_id in node.unreadable_streams and not session.is_abandoned:
        return []
    streams = collect_stream_facts(session, node)
    closed = close_at_stop_if_passed(session, streams, leave_open_while_missing=True)
    if closed.parts[-1].seq_last is not None:
        return [closed]
    if stream_id == node.stream_id or not node.has_connected:
        return []
    following = next(iter(_later_streams(session, node)), None)
    if following is None:
        return []
    began = session.stopped_t_ns is None or _began_before_stop(session, node, following)
    if began is None:
        return []
    closed, stream = (
        close_at_stream_end_or_newest_frame(session, streams, server_utc_ns()),
        streams[stream_id],
    )
    if not began:
        wanted = group_numbers_by_stream(closed.parts).get(stream_id, Intervals())
        return [] if (stream.obtainable - stream.stored) & wanted else [closed]
    info = node.streams[following].info
    if stream.info is None or stream.info.has_same_tiles_as(info):
        part = Part(stream_id=following, seq_first=0)
        return [closed.model_copy(update={"parts": (*closed.parts, part)})]
    begin_t_ns = _stream_begin_t_ns(session, node, following)
    scene_content = node.hello.scene if info.scene == node.last_info.scene else {}
    return [
        *stop_session_and_make_continuation(
            closed,
            info,
            begin_t_ns,
            scene_content=scene_content,
            calibration=node.estimator.assigned_or_node_calibration,
            calibration_source=node.estimator.calibration_source,
        )
    ]


def _later_streams(session: Session, node: ServerNode) -> Iterable[str]:
    """Return streams that began after the one of the session's open part, oldest first."""
    stream_id, order = session.parts[-1].stream_id, node.announced_stream_order
    if stream_id in order:
        return order[order.index(stream_id) + 1 :]
    # Hello no longer lists it: streams that began after its last frame are later.
    newest = collect_stream_facts(session, node)[stream_id].find_batch_t_ns_near(
        NO_END, at_or_before=True
    )

    def is_later(name: str) -> bool:
        begin = node.streams[name].first_t_ns
        return newest is not None and begin is not None and begin > newest

    known_ids = {part.stream_id for part in session.parts}
    return [n for n in order if n not in known_ids and (n == node.stream_id or is_later(n))]


def _server_offset_ns(session: Session, node: ServerNode | None, stream_id: str) -> int | None:
    """Return the offset from a stream's time to the server's UTC; None without a measurement."""
    stream = node.streams.get(stream_id) if node is not None else None
    if stream is not None and stream.clock_offset is not None:
        return stream.clock_offset.server_minus_node_ns
    rows = [row for row in session.clock if row.stream_id == stream_id]
    if rows:
        return rows[-1].server_minus_node_ns
    # No link during that stream: most likely the node's clock was as wrong as now.
    return (
        node.clock_offset.server_minus_node_ns
        if node is not None and node.clock_offset is not None
        else None
    )


def _stream_begin_t_ns(session: Session, node: ServerNode, stream_id: str) -> int:
    """Return the begin of a stream, server's UTC; the present time if unknown."""
    begin_t_ns, offset_ns = (
        node.streams[stream_id].first_t_ns,
        _server_offset_ns(session, node, stream_id),
    )
    return server_utc_ns() if begin_t_ns is None or offset_ns is None else begin_t_ns + offset_ns


def _began_before_stop(session: Session, node: ServerNode, stream_id: str) -> bool | None:
    """Return whether a stream began before the session was stopped; None: not known yet.

    The node states the time of its oldest frame. That is the begin of the stream, unless older
    frames are gone: then only the frames themselves show it.
    """
    stream, rate_hz = node.streams[stream_id], node.streams[stream_id].info.nominal_rate_hz
    stop_t_ns = session.stopped_t_ns or server_utc_ns()
    offset_ns = _server_offset_ns(session, node, stream_id)
    if stream_id != node.stream_id:
        is_known = offset_ns is not None and stream.first_t_ns is not None
        return _stream_begin_t_ns(session, node, stream_id) <= stop_t_ns if is_known else None
    hello = node.hello
    if node.hello_t_ns is not None and not hello.next_seq and not stream.stored:
        # Hello may not count the newest frames; these come at once.
        is_settled = stop_t_ns < node.hello_t_ns < server_utc_ns() - _UNSENT_NS
        return False if is_settled else None
    if hello.t_ns_first and hello.stored and offset_ns is not None:
        if hello.t_ns_first + offset_ns <= stop_t_ns:
            return True
        if hello.stored[0][0] == 0:
            return False
    journal = stream.journal
    oldest = next(iter(stream.stored), None)
    if oldest is None or journal is None or offset_ns is None:
        return None
    taken_t_ns = journal.find_batch_t_ns_near(oldest[0], at_or_before=False)
    if taken_t_ns is None:
        return None
    if taken_t_ns + offset_ns <= stop_t_ns:
        return True
    if stream.obtainable.restricted_to(0, oldest[0] - 1):
        return None
    return taken_t_ns + offset_ns - round(oldest[0] / rate_hz * 1e9) <= stop_t_ns


def current_ledger(session: Session, node: ServerNode | None) -> Ledger:
    """Return the session's present ledger: the fate of every frame."""
    if session.state == "sealed" and session.ledger is not None:
        return session.ledger
    finished = session.stopped_t_ns is not None and session.parts[-1].seq_last is not None
    likely, streams = _with_likely_end(session, node)
    return compute_ledger(
        likely.parts, mark_damaged_and_abandoned_lost(likely, streams), has_all_parts=finished
    )


def current_inputs(
    session: Session, node: ServerNode, *, unquantized: bool = False
) -> SessionInputs:
    """Return the inputs from which a session can be sealed or exported now."""
    session, streams = _with_likely_end(session, node)
    return make_inputs(
        session,
        streams,
        load_tares=lambda: node.estimator.tare_history,
        emulated=node.hello.emulated,
        default_array=node.last_info,
        unquantized=unquantized,
    )


def has_unreadable_journal(session: Session, node: ServerNode | None) -> bool:
    """Return whether a journal of the session cannot be read now: its losses are then unknown."""
    if node is None or session.is_abandoned:
        return False
    return any(part.stream_id in node.unreadable_streams for part in session.parts)


def is_ready_to_seal(session: Session, node: ServerNode | None) -> bool:
    """Return whether the end is found, and all obtainable frames are stored and synced."""
    if session.parts[-1].seq_last is None or has_unreadable_journal(session, node):
        return False
    for stream_id, numbers in group_numbers_by_stream(session.parts).items():
        stream = node.streams.get(stream_id) if node is not None else None
        if stream is not None and stream.unsynced & numbers:
            return False
    return not any(part.pending for part in current_ledger(session, node).parts)


def _with_likely_end(
    session: Session, node: ServerNode | None
) -> tuple[Session, dict[str, SessionStream]]:
    """Return a session with its likely end, and its streams."""
    streams = collect_stream_facts(session, node)
    with suppress(FootTileError):  # the frames at the stop are damaged
        session = close_at_stop_if_passed(session, streams)
    return session, streams
