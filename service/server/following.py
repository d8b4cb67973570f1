"""Parts of sessions on a server: where they begin, go on in another stream, and end.

A session is a list of intervals of streams. A node that restarts adds a part, and so does every
stream that it recorded offline and sends later. Where a part ends is decided in
`service.sessions.ends`.

The present ledger and inputs of a session follow from its parts.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import suppress

from devices.errors import FootTileError
from service.server.node import ServerNode
from service.server_clock import utc_ns
from service.sessions.begin import taken_up
from service.sessions.ends import SessionStream, at_end, at_stop, broken_off, ended
from service.sessions.sources import Sources, sources_of
from storage.clock.log import ClockOffset
from storage.intervals import NO_END, Intervals
from storage.sessions.folder import Ledger, Part, Session
from storage.sessions.ledger import ledger_of, numbers_of, states_of

_UNHEARD_NS = 1_000_000_000
"""Time after a hello within which frames may come that the hello did not count."""


def streams_of(session: Session, node: ServerNode | None) -> dict[str, SessionStream]:
    """Return the facts of a session's streams, by stream id."""
    found = {}
    for boot_id in dict.fromkeys(part.boot_id for part in session.parts):
        stream = node.streams.get(boot_id) if node is not None else None
        if stream is not None:
            found[boot_id] = stream.for_session(_offset_ns(session, node, boot_id))
        else:  # before its first hello the node may have all frames
            is_gone = node is not None and node.has_spoken
            found[boot_id] = SessionStream(may_come=Intervals(() if is_gone else [(0, NO_END)]))
    return found


def first_part(node: ServerNode, last_seq: int, last_t_ns: int, pre_roll_s: float) -> Part:
    """Return the first part of a session that starts now, or a pre-roll earlier if stored.

    Frames that the node still has and will send count as stored.
    """
    seq_first, journal = last_seq + 1, node.journal
    if pre_roll_s > 0 and journal is not None:
        since_t_ns = last_t_ns - round(pre_roll_s * 1e9)
        reached = journal.first_seq_since(since_t_ns)
        seq_first = min(seq_first, reached if reached is not None else seq_first)
        reached_t_ns = journal.t_ns_near(seq_first, newest=False)
        if reached_t_ns is not None and reached_t_ns > since_t_ns:
            back = round((reached_t_ns - since_t_ns) * 1e-9 * node.info.nominal_rate_hz)
            coming = node.missing & node.present.may_come
            coming = coming.within(max(0, seq_first - back), seq_first - 1)
            seq_first = min((first for first, _ in coming), default=seq_first)
    return Part(boot_id=node.boot_id, seq_first=seq_first)


def stopped(session: Session, node: ServerNode | None) -> Session:
    """Return the session, stopped now; its end is open until the stream has passed this time."""
    update: dict[str, object] = {"stopped_t_ns": utc_ns(), "state": "pending", "problem": None}
    if node is not None and node.connected:
        update["missed_slots_at_stop"] = {node.boot_id: node.present.missed_slots}
    session = session.model_copy(update=update)
    if node is None or node.clock is not None or not node.connected or node.last_seq is None:
        return session
    # Its clock cannot be compared with ours: end with the newest frame.
    return ended(session, session.parts[-1], node.last_seq)


def followed(session: Session, node: ServerNode) -> list[Session]:
    """Extend the session's parts to the present end of its node's streams.

    Returns:
        The session, and further ones that continue it where the node came back with other tiles.
    """
    found = [reattach(session, node)]
    while found[-1].parts[-1].seq_last is None:
        extended = _step(found[-1], node)
        if not extended:
            break
        found[-1:] = extended
    return found


def reattach(session: Session, node: ServerNode) -> Session:
    """Return the session with its open end in an earlier stream that was resumed.

    A part is closed when its node announces another stream. If that stream is gone and the earlier
    one goes on, as when a copy of a node's card was in use for a while, the recording goes on in
    the earlier one, with all frames that it has had meanwhile.
    """
    last_part = session.parts[-1]
    stream = node.streams.get(last_part.boot_id)
    may_go_on = stream is not None and (last_part.boot_id in node.order or bool(stream.may_come))
    if (
        last_part.seq_last is not None
        or not node.has_spoken
        or may_go_on
        or last_part.boot_id in node.unread
    ):
        return session
    for boot_id in node.order:
        own_parts = [part for part in session.parts if part.boot_id == boot_id]
        stream = node.streams[boot_id]
        ends = [part.seq_last for part in own_parts if part.seq_last is not None]
        seq_first = max(ends, default=-1) + 1
        if own_parts and (stream.held | stream.may_come).within(seq_first, NO_END):
            session = _go_on_in(session, node, Part(boot_id=boot_id, seq_first=seq_first))
    return session


def _go_on_in(session: Session, node: ServerNode, part: Part) -> Session:
    """Return the session with its open part closed and another one open."""
    *before, last_part = at_end(session, streams_of(session, node), utc_ns()).parts
    tails = {name: n for name, n in session.unsynced_tail_max.items() if name != part.boot_id}
    parts = (
        before
        if last_part.seq_last is None or last_part.seq_last < last_part.seq_first
        else [*before, last_part]
    )
    if parts and parts[-1].boot_id == part.boot_id:
        part = parts.pop().model_copy(update={"seq_last": None})
    return session.model_copy(update={"parts": (*parts, part), "unsynced_tail_max": tails})


def given_up(session: Session, node: ServerNode | None) -> Session:
    """Return the session without its missing frames: its open end is closed."""
    if node is not None:
        session = reattach(session, node)
    closed = broken_off(session, streams_of(session, node), utc_ns())
    return closed.model_copy(update={"given_up": True})


def parts_needed(session: Session, node: ServerNode | None) -> Iterator[Part]:
    """Yield the parts that an unsealed session needs in the journals."""
    yield from session.parts
    if session.parts[-1].seq_last is None and node is not None:
        # The stream in which the session was stopped is not known yet.
        for boot_id in _following(session, node):
            yield Part(boot_id=boot_id, seq_first=0)


def clock_at_start(node: ServerNode, part: Part) -> tuple[ClockOffset, ...]:
    """Return the clock measurements from the beginning of a part on, and the last before it."""
    begin_t_ns = (
        journal.t_ns_near(part.seq_first, newest=False) if (journal := node.journal) else None
    )
    rows = list(node.present.clock_rows)
    if begin_t_ns is None:
        return tuple(rows[-1:])
    begin_ns = begin_t_ns - node.info.utc_offset_ns
    before = [number for number, row in enumerate(rows) if row.t_mono_ns <= begin_ns]
    return tuple(rows[before[-1] if before else 0 :])


def _step(session: Session, node: ServerNode) -> list[Session]:
    """Close the open part and return the session with the next one; empty if undecided."""
    boot_id = session.parts[-1].boot_id
    if boot_id in node.unread and not session.given_up:
        return []
    streams = streams_of(session, node)
    closed = at_stop(session, streams, waiting=True)
    if closed.parts[-1].seq_last is not None:
        return [closed]
    if boot_id == node.boot_id or not node.has_spoken:
        return []
    following = next(iter(_following(session, node)), None)
    if following is None:
        return []
    began = session.stopped_t_ns is None or _has_begun(session, node, following)
    if began is None:
        return []
    closed, stream = at_end(session, streams, utc_ns()), streams[boot_id]
    if not began:
        wanted = numbers_of(closed.parts).get(boot_id, Intervals())
        return [] if (stream.may_come - stream.held) & wanted else [closed]
    info = node.streams[following].info
    if stream.info is None or stream.info.has_same_tiles_as(info):
        part = Part(boot_id=following, seq_first=0)
        return [closed.model_copy(update={"parts": (*closed.parts, part)})]
    begin_t_ns = _begin_t_ns(session, node, following)
    scene_content = node.hello.scene if info.scene == node.info.scene else {}
    return [
        *taken_up(
            closed,
            info,
            begin_t_ns,
            scene_content=scene_content,
            calibration=node.estimates.calibration,
            calibration_source=node.estimates.calibration_source,
        )
    ]


def _following(session: Session, node: ServerNode) -> Iterable[str]:
    """Return streams that began after the one of the session's open part, oldest first."""
    boot_id, order = session.parts[-1].boot_id, node.order
    if boot_id in order:
        return order[order.index(boot_id) + 1 :]
    # Hello no longer lists it: streams that began after its last frame are later.
    newest = streams_of(session, node)[boot_id].t_ns_near(NO_END, newest=True)

    def is_later(name: str) -> bool:
        begin = node.streams[name].t_ns_first
        return newest is not None and begin is not None and begin > newest

    known_ids = {part.boot_id for part in session.parts}
    return [n for n in order if n not in known_ids and (n == node.boot_id or is_later(n))]


def _offset_ns(session: Session, node: ServerNode | None, boot_id: str) -> int | None:
    """Return the offset from a stream's time to the server's UTC; None without a measurement."""
    stream = node.streams.get(boot_id) if node is not None else None
    if stream is not None and stream.clock is not None:
        return stream.clock.server_minus_node_ns
    rows = [row for row in session.clock if row.boot_id == boot_id]
    if rows:
        return rows[-1].server_minus_node_ns
    # No link during that stream: most likely the node's clock was as wrong as now.
    return node.clock.server_minus_node_ns if node is not None and node.clock is not None else None


def _begin_t_ns(session: Session, node: ServerNode, boot_id: str) -> int:
    """Return the begin of a stream, server's UTC; the present time if unknown."""
    begin_t_ns, offset_ns = node.streams[boot_id].t_ns_first, _offset_ns(session, node, boot_id)
    return utc_ns() if begin_t_ns is None or offset_ns is None else begin_t_ns + offset_ns


def _has_begun(session: Session, node: ServerNode, boot_id: str) -> bool | None:
    """Return whether a stream began before the session was stopped; None: not known yet.

    The node states the time of its oldest frame. That is the begin of the stream, unless older
    frames are gone: then only the frames themselves show it.
    """
    stream, rate_hz = node.streams[boot_id], node.streams[boot_id].info.nominal_rate_hz
    stop_t_ns = session.stopped_t_ns or utc_ns()
    offset_ns = _offset_ns(session, node, boot_id)
    if boot_id != node.boot_id:
        is_known = offset_ns is not None and stream.t_ns_first is not None
        return _begin_t_ns(session, node, boot_id) <= stop_t_ns if is_known else None
    hello = node.hello
    if node.greeted_t_ns is not None and not hello.next_seq and not stream.held:
        # Hello may not count the newest frames; these come at once.
        is_settled = stop_t_ns < node.greeted_t_ns < utc_ns() - _UNHEARD_NS
        return False if is_settled else None
    if hello.t_ns_first and hello.held and offset_ns is not None:
        if hello.t_ns_first + offset_ns <= stop_t_ns:
            return True
        if hello.held[0][0] == 0:
            return False
    journal = stream.journal
    oldest = next(iter(stream.held), None)
    if oldest is None or journal is None or offset_ns is None:
        return None
    taken_t_ns = journal.t_ns_near(oldest[0], newest=False)
    if taken_t_ns is None:
        return None
    if taken_t_ns + offset_ns <= stop_t_ns:
        return True
    if stream.may_come.within(0, oldest[0] - 1):
        return None
    return taken_t_ns + offset_ns - round(oldest[0] / rate_hz * 1e9) <= stop_t_ns


def ledger_now(session: Session, node: ServerNode | None) -> Ledger:
    """Return the session's present ledger: the fate of every frame."""
    if session.state == "sealed" and session.ledger is not None:
        return session.ledger
    finished = session.stopped_t_ns is not None and session.parts[-1].seq_last is not None
    likely, streams = _provisional(session, node)
    return ledger_of(likely.parts, states_of(likely, streams), finished=finished)


def sources_now(session: Session, node: ServerNode, *, exact: bool = False) -> Sources:
    """Return the inputs from which a session can be sealed or exported now."""
    session, streams = _provisional(session, node)
    return sources_of(
        session,
        streams,
        tares=lambda: node.estimates.tares,
        emulated=node.hello.emulated,
        no_array=node.info,
        exact=exact,
    )


def is_unread(session: Session, node: ServerNode | None) -> bool:
    """Return whether a journal of the session cannot be read now: its losses are then unknown."""
    if node is None or session.given_up:
        return False
    return any(part.boot_id in node.unread for part in session.parts)


def is_all_here(session: Session, node: ServerNode | None) -> bool:
    """Return whether all obtainable frames are stored and synced."""
    if session.parts[-1].seq_last is None or is_unread(session, node):
        return False
    for boot_id, numbers in numbers_of(session.parts).items():
        stream = node.streams.get(boot_id) if node is not None else None
        if stream is not None and stream.unsynced & numbers:
            return False
    return not any(part.pending for part in ledger_now(session, node).parts)


def _provisional(
    session: Session, node: ServerNode | None
) -> tuple[Session, dict[str, SessionStream]]:
    """Return a session with its likely end, and its streams."""
    streams = streams_of(session, node)
    with suppress(FootTileError):  # the frames at the stop are damaged
        session = at_stop(session, streams)
    return session, streams
