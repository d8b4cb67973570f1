"""Where the parts of a session begin and end: rules on sessions and streams, nothing kept here.

A session is a list of intervals of streams. It ends with the last frame that was taken before it
was stopped, by the server's clock. A node that is switched on anew adds a part, and so does every
stream that it took meanwhile and brings home.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping
from datetime import UTC, datetime

from devices.frames import ArrayInfo
from service.estimation.tare.tare import Tare
from service.server.nodes import Node
from service.server.streams import ServerStream
from service.server_clock import utc_ns
from storage.clock.offset import ClockOffset
from storage.intervals import NO_END, Intervals
from storage.losses import GIVEN_UP
from storage.sessions.folder import Part, Session, new_session_id
from storage.sessions.ledger import StreamState

_UNHEARD_S = 1.0
_SLOWEST = 1.5
"""A stream is surely no more than so many times as old as its frames make it."""


def first_part(node: Node, last_seq: int, last_t_ns: int, pre_roll_s: float) -> Part:
    """The part of a session that starts now, or earlier if a journal reaches back so far.

    What the node still has and is to send counts as if it were here.
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


def ended(session: Session, seq_last: int, *, tail: int = 0) -> Session:
    """The session with this end of its last part, behind which `tail` frames may have been."""
    part = session.parts[-1]
    part = part.model_copy(update={"seq_last": max(seq_last, part.seq_first - 1)})
    update: dict[str, object] = {"parts": (*session.parts[:-1], part)}
    if tail:
        update["unsynced_tail_max"] = {**session.unsynced_tail_max, part.boot_id: tail}
    return session.model_copy(update=update)


def stopped(session: Session, node: Node | None) -> Session:
    """The session, stopped at this instant; its end is open until the stream has passed it."""
    update: dict[str, object] = {"stopped_t_ns": utc_ns(), "state": "pending", "problem": None}
    if node is not None and node.connected:
        update["missed_slots_at_stop"] = {node.boot_id: node.present.missed_slots}
    session = session.model_copy(update=update)
    comparable = node is None or node.clock is not None or not node.connected
    if comparable or node is None or node.last_seq is None:
        return session
    # Its instants cannot be compared with ours: end with the newest frame there is.
    return ended(session, node.last_seq)


def followed(session: Session, node: Node) -> list[Session]:
    """The session as far as its node's streams are known to go by now.

    Returns:
        The session, and those that take it up where the node came back with other tiles.
    """
    found = [session]
    while found[-1].parts[-1].seq_last is None:
        further = _step(found[-1], node)
        if not further:
            break
        found[-1:] = further
    return found


def given_up(session: Session, node: Node | None) -> Session:
    """The session without what has not come: an open end is closed at what is here."""
    if session.parts[-1].seq_last is None:
        stream = node.streams.get(session.parts[-1].boot_id) if node is not None else None
        last = None if node is None else _seq_at_stop(session, node, stream, waiting=False)
        if last is not None:
            session = ended(session, last)
        else:
            newest = stream.held.last if stream is not None else None
            tail = _silent_frames(session, node, stream)
            session = ended(session, -1 if newest is None else newest, tail=tail)
    return session.model_copy(update={"given_up": True})


def provisional(session: Session, node: Node | None) -> Session:
    """A stopped session whose end is not known yet, with the one that it will have nearly."""
    part = session.parts[-1]
    if session.stopped_t_ns is None or part.seq_last is not None or node is None:
        return session
    last = _seq_at_stop(session, node, node.streams.get(part.boot_id), waiting=False)
    return session if last is None else ended(session, last)


def states(session: Session, node: Node | None) -> dict[str, StreamState]:
    """What is known of the streams of a session, for its ledger."""
    found = {}
    for number, part in enumerate(session.parts):
        stream = node.streams.get(part.boot_id) if node is not None else None
        if stream is not None:
            may_come, lost = stream.may_come, stream.lost
        elif node is not None and node.has_spoken:
            may_come, lost = Intervals(), StreamState().lost
        else:
            may_come, lost = Intervals([(0, NO_END)]), StreamState().lost
        if session.given_up:
            lost.add(may_come, GIVEN_UP)
            may_come = Intervals()
        missed = session.missed_slots_at_stop.get(
            part.boot_id, stream.missed_slots if stream is not None else 0
        )
        found[part.boot_id] = StreamState(
            held=stream.held if stream is not None else Intervals(),
            lost=lost,
            may_come=may_come,
            unsynced_tail_max=session.unsynced_tail_max.get(part.boot_id, 0),
            missed_slots=max(0, missed - (0 if number else session.missed_slots_at_start)),
        )
    return found


def needed(session: Session, node: Node | None) -> dict[str, Intervals]:
    """Numbers by boot_id that a session, not sealed yet, needs in the journals."""
    numbers: dict[str, Intervals] = {}
    for part in session.parts:
        last = part.seq_last if part.seq_last is not None else NO_END
        if last >= part.seq_first:
            numbers.setdefault(part.boot_id, Intervals()).add(part.seq_first, last)
    if session.parts[-1].seq_last is None and node is not None:
        # It is not known yet which of them it was stopped in.
        for boot_id in _following(session, node):
            numbers.setdefault(boot_id, Intervals()).add(0, NO_END)
    return numbers


def tares_of(session: Session, node: Node, info: ArrayInfo) -> tuple[tuple[Tare, ...], str | None]:
    """Tares that were in force while it was recorded, by the frames' own instants.

    Returns:
        The tares, oldest first; none, and a reason, if there are tares, but none of that time.
    """
    first, last = session.parts[0], session.parts[-1]
    begin = _instant(node, first.boot_id, first.seq_first, newest=False)
    end = _instant(node, last.boot_id, last.seq_last, newest=True)
    if begin is None or end is None:
        return (), None
    tares = node.tares.during(info, begin, end)
    if not tares and node.tares.in_force(info) is not None:
        return (), "all tares of the node were taken after this session"
    return tares, None


def _instant(node: Node, boot_id: str, seq: int | None, *, newest: bool) -> int | None:
    """Node's UTC of a frame, or of the nearest one that is held."""
    journal = node.journals.get(boot_id)
    if journal is None:
        return None
    return journal.t_ns_near(seq if seq is not None else NO_END, newest=newest)


def clock_at_start(node: Node, part: Part) -> tuple[ClockOffset, ...]:
    """Measurements of a node's clock from the beginning of a part on, and the last before it."""
    begin_t_ns = _instant(node, part.boot_id, part.seq_first, newest=False)
    rows = list(node.present.clock_rows)
    if begin_t_ns is None:
        return tuple(rows[-1:])
    begin_ns = begin_t_ns - node.info.utc_offset_ns
    before = [number for number, row in enumerate(rows) if row.t_mono_ns <= begin_ns]
    return tuple(rows[before[-1] if before else 0 :])


def with_clock_logs(session: Session, node: Node | None) -> Session:
    """A session with what its streams' clock logs have beyond what was written down with it."""
    rows = list(session.clock)
    for boot_id in dict.fromkeys(part.boot_id for part in session.parts):
        stream = node.streams.get(boot_id) if node is not None else None
        known = [row.t_mono_ns for row in session.clock if row.boot_id == boot_id]
        if stream is not None:
            after_ns = max(known, default=-1)
            rows += [row for row in stream.all_clock_rows() if row.t_mono_ns > after_ns]
    return session.model_copy(update={"clock": tuple(rows)})


def _step(session: Session, node: Node) -> list[Session]:
    """The session with its open part ended, and what follows; nothing if that is not known yet."""
    boot_id = session.parts[-1].boot_id
    stream = node.streams.get(boot_id)
    last = _seq_at_stop(session, node, stream, waiting=True)
    if last is not None:
        return [ended(session, last)]
    if boot_id == node.boot_id or not node.has_spoken:
        return []
    following = next(iter(_following(session, node)), None)
    if following is None:
        return []
    if session.stopped_t_ns is not None:
        begun = _has_begun(session.stopped_t_ns, session, node, following)
        if begun is None:
            return []
        if not begun:
            closed = _at_end(session, node, stream)
            numbers = needed(closed, None).get(boot_id, Intervals())
            coming = stream is not None and bool(stream.lacks(numbers, all_of_it=False))
            return [] if coming else [closed]
    closed = _at_end(session, node, stream)
    info = node.streams[following].info
    if stream is None or stream.info.has_same_tiles_as(info):
        part = Part(boot_id=following, seq_first=0)
        return [closed.model_copy(update={"parts": (*closed.parts, part)})]
    update: dict[str, object] = {"problem": "the node came back with other tiles: recording ended"}
    if closed.state == "recording":
        begin_t_ns = _begin_t_ns(session, node, following)
        update |= {"state": "pending", "stopped_t_ns": begin_t_ns}
    return [closed.model_copy(update=update), _continued(session, node, info)]


def _continued(session: Session, node: Node, info: ArrayInfo) -> Session:
    """The session that takes up a recording whose node came back with other tiles."""
    name, number = session.name, 2
    if match := re.fullmatch(r"(.*) \((\d+)\)", name):
        name, number = match[1], int(match[2]) + 1
    calibration = node.hello.calibration
    return Session(
        id=new_session_id(datetime.now(UTC)),
        name=f"{name} ({number})",
        node=session.node,
        state=session.state,
        started_t_ns=_begin_t_ns(session, node, info.boot_id),
        stopped_t_ns=session.stopped_t_ns,
        parts=(Part(boot_id=info.boot_id, seq_first=0),),
        subject=session.subject,
        notes=session.notes,
        tags=session.tags,
        scene=info.scene,
        scene_content=node.hello.scene if info.scene == node.info.scene else {},
        calibration=calibration.model_dump(mode="json") if calibration is not None else None,
        continues=session.id,
    )


def _following(session: Session, node: Node) -> Iterable[str]:
    """Streams that began after that of the session's open part, oldest first."""
    boot_id, order = session.parts[-1].boot_id, node.order
    if boot_id in order:
        return order[order.index(boot_id) + 1 :]
    # The node does not remember it: what began after its last frame came after it.
    stream = node.streams.get(boot_id)
    newest = stream.journal.t_ns_near(NO_END, newest=True) if stream and stream.journal else None
    known = {part.boot_id for part in session.parts}
    later = []
    for name in order:
        begin = node.streams[name].t_ns_first
        if name == node.boot_id or (newest is not None and begin is not None and begin > newest):
            later.append(name)
    return tuple(name for name in later if name not in known)


def _seq_at_stop(
    session: Session, node: Node, stream: ServerStream | None, *, waiting: bool
) -> int | None:
    """The last frame of the open part's stream before the stop; None if it has not passed it.

    Args:
        session: with an open end.
        node: its own.
        stream: in which its last part is.
        waiting: None too while a frame may come that was taken nearer to the stop.
    """
    part, journal = session.parts[-1], stream.journal if stream is not None else None
    offset_ns = _offset_ns(session, node, part.boot_id)
    if session.stopped_t_ns is None or stream is None or journal is None or offset_ns is None:
        return None
    stop_t_ns = session.stopped_t_ns - offset_ns
    found = stream.around(stop_t_ns, at_least=part.seq_first, waiting=waiting)
    if found is None:
        return None
    last, after = found
    if after == last + 1:
        return last
    gap = Intervals([(last + 1, after - 1)])
    if waiting and gap & stream.may_come:
        return None
    # The stop lies among frames that are lost: by the rate, so many of them came after it.
    after_t_ns = journal.t_ns_near(after, newest=False) or stop_t_ns
    late = math.ceil((after_t_ns - stop_t_ns) * 1e-9 * stream.info.nominal_rate_hz)
    return min(after - 1, max(last, after - late))


def _at_end(session: Session, node: Node, stream: ServerStream | None) -> Session:
    """The session with its last part reaching to the end of a stream that has ended."""
    newest = stream.held.last if stream is not None else None
    beyond = 0 if newest is None else newest + 1
    next_seq = stream.notes.next_seq if stream is not None else None
    if stream is None or next_seq is None:
        return ended(session, beyond - 1, tail=_silent_frames(session, node, stream))
    tail = max(0, stream.notes.unsynced_tail_max - max(0, beyond - next_seq))
    return ended(session, max(next_seq, beyond) - 1, tail=tail)


def _silent_frames(session: Session, node: Node | None, stream: ServerStream | None) -> int:
    """How many frames there may have been since the last that is known of, until now or the stop.

    The node does not say how its stream ended.
    """
    until_t_ns = min(session.stopped_t_ns or utc_ns(), utc_ns())
    seen_t_ns = session.started_t_ns
    if stream is not None:
        # Frames that were sent late came later than they were taken.
        offset_ns = _offset_ns(session, node, stream.boot_id)
        newest = stream.journal.t_ns_near(NO_END, newest=True) if stream.journal else None
        if newest is not None and (offset_ns is not None or stream.last_seen_t_ns is None):
            seen_t_ns = newest + (offset_ns or 0)
        else:
            seen_t_ns = stream.last_seen_t_ns or seen_t_ns
    info = stream.info if stream is not None else node.info if node is not None else None
    silent_s = max(0.0, (until_t_ns - seen_t_ns) * 1e-9)
    return round(silent_s * (info.nominal_rate_hz if info is not None else 0.0)) + 1


def _offset_ns(session: Session, node: Node | None, boot_id: str) -> int | None:
    """What to add to a stream's instants for the server's UTC; None if it was never measured."""
    stream = node.streams.get(boot_id) if node is not None else None
    if stream is not None and stream.clock is not None:
        return stream.clock.server_minus_node_ns
    rows = [row for row in session.clock if row.boot_id == boot_id]
    if rows:
        return rows[-1].server_minus_node_ns
    # The node was never linked in that stream: its date is most likely as wrong as it is now.
    return node.clock.server_minus_node_ns if node is not None and node.clock is not None else None


def _begin_t_ns(session: Session, node: Node, boot_id: str) -> int:
    """When a stream began, server's UTC; now, if that is not known."""
    begin_t_ns, offset_ns = node.streams[boot_id].t_ns_first, _offset_ns(session, node, boot_id)
    return utc_ns() if begin_t_ns is None or offset_ns is None else begin_t_ns + offset_ns


def _has_begun(stop_t_ns: int, session: Session, node: Node, boot_id: str) -> bool | None:
    """Had a stream begun when the session was stopped? None: not known yet.

    The instant that an earlier stream's oldest frame has is its own word; of the present one only
    frames tell, or that it cannot be so old.
    """
    stream, rate_hz = node.streams[boot_id], node.streams[boot_id].info.nominal_rate_hz
    offset_ns = _offset_ns(session, node, boot_id)
    if boot_id != node.boot_id:
        known = offset_ns is not None and stream.t_ns_first is not None
        return _begin_t_ns(session, node, boot_id) <= stop_t_ns if known else None
    if node.greeted_t_ns is not None:
        taken_s = node.hello.next_seq / rate_hz
        age_s = _SLOWEST * taken_s + _UNHEARD_S if taken_s else 0.0
        if node.greeted_t_ns - round(age_s * 1e9) > stop_t_ns:
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


def by_stream(all_needed: Iterable[Mapping[str, Intervals]]) -> dict[str, Intervals]:
    """What several sessions need, together."""
    numbers: dict[str, Intervals] = {}
    for one in all_needed:
        for boot_id, intervals in one.items():
            for interval in intervals:
                numbers.setdefault(boot_id, Intervals()).add(*interval)
    return numbers
