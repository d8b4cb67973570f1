"""Where the parts of a session begin and end: rules on sessions and journals, nothing kept here.

A session is a list of intervals of streams. It ends with the last frame that was taken before it
was stopped, by the server's clock; a node that is switched on anew adds a part.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from datetime import UTC, datetime

from devices.frames import ArrayInfo
from service.estimation.tare import Tare
from service.link import Hello
from service.nodes import Node
from service.steady import utc_ns
from storage.intervals import Intervals
from storage.session import ClockOffset, Part, Session, new_session_id

_NO_END = 2**62


def first_part(node: Node, last_seq: int, last_t_ns: int, pre_roll_s: float) -> Part:
    """The part of a session that starts now, or earlier if the journal reaches back so far."""
    seq_first = last_seq + 1
    if pre_roll_s > 0 and node.journal is not None:
        reached = node.journal.first_seq_since(last_t_ns - round(pre_roll_s * 1e9))
        seq_first = min(seq_first, reached if reached is not None else seq_first)
    return Part(boot_id=node.boot_id, seq_first=seq_first)


def ended(session: Session, seq_last: int) -> Session:
    """The session with this end of its last part."""
    parts = (*session.parts[:-1], session.parts[-1].model_copy(update={"seq_last": seq_last}))
    return session.model_copy(update={"parts": parts})


def stopped(session: Session, node: Node | None) -> Session:
    """The session, stopped at this instant; its end is open until the stream has passed it."""
    update = {"stopped_t_ns": utc_ns(), "state": "pending", "problem": None}
    session = session.model_copy(update=update)
    comparable = node is None or node.clock is not None or not node.connected
    if comparable or node is None or node.last_seq is None:
        return session
    # Its instants cannot be compared with ours: end with the newest frame there is.
    return ended(session, max(node.last_seq, session.parts[-1].seq_first - 1))


def with_end(session: Session, node: Node) -> Session:
    """A stopped session with the end of its last part, if the stream has passed the stop."""
    part = session.parts[-1]
    journal = node.journals.get(part.boot_id)
    if part.seq_last is not None or journal is None or session.stopped_t_ns is None:
        return session
    if node.clock is None:  # it will be measured as soon as the node is there
        return session
    last = journal.last_seq_until(node.node_t_ns(session.stopped_t_ns), at_least=part.seq_first)
    return session if last is None else ended(session, last)


def after_restart(session: Session, node: Node, hello: Hello) -> Session:
    """A session whose node is about to begin a new stream.

    Frames of the old stream that were not sent are gone; how many there may have been is noted. A
    recording goes on in a new part, if the tiles are the same.
    """
    new, previous = hello.array_info, hello.previous
    if previous is not None and previous.boot_id == session.parts[-1].boot_id:
        if session.parts[-1].seq_last is None:
            session = ended(session, previous.next_seq - 1)  # in order: nothing is missing
    else:
        session = _end_of_stream(session, node)
    if session.state != "recording":
        return session
    if node.info.tiles != new.tiles:
        problem = "the node came back with other tiles: recording ended"
        return session.model_copy(
            update={"state": "pending", "stopped_t_ns": utc_ns(), "problem": problem}
        )
    part = Part(boot_id=new.boot_id, seq_first=0)
    return session.model_copy(update={"parts": (*session.parts, part)})


def continued(session: Session, hello: Hello) -> Session:
    """The session that takes up a recording whose node came back with other tiles."""
    name, number = session.name, 2
    if match := re.fullmatch(r"(.*) \((\d+)\)", name):
        name, number = match[1], int(match[2]) + 1
    calibration = hello.calibration
    return Session(
        id=new_session_id(datetime.now(UTC)),
        name=f"{name} ({number})",
        node=session.node,
        state="recording",
        started_t_ns=utc_ns(),
        parts=(Part(boot_id=hello.array_info.boot_id, seq_first=0),),
        subject=session.subject,
        notes=session.notes,
        tags=session.tags,
        scene=hello.array_info.scene,
        scene_content=hello.scene,
        calibration=calibration.model_dump(mode="json") if calibration is not None else None,
    )


def needed(sessions: Iterable[Session]) -> dict[str, Intervals]:
    """Numbers by boot_id that these sessions, not sealed yet, need in the journals."""
    numbers: dict[str, Intervals] = {}
    for session in sessions:
        for part in session.parts:
            last = part.seq_last if part.seq_last is not None else _NO_END
            if last >= part.seq_first:
                numbers.setdefault(part.boot_id, Intervals()).add(part.seq_first, last)
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
    return journal.t_ns_near(seq if seq is not None else _NO_END, newest=newest)


def clock_rows(node: Node) -> tuple[ClockOffset, ...]:
    """The newest measurement of a node's clock, if there is one."""
    if node.clock is None:
        return ()
    content = node.clock.model_dump(exclude={"type"})
    return (ClockOffset(boot_id=node.boot_id, **content),)


def _end_of_stream(session: Session, node: Node) -> Session:
    part = session.parts[-1]
    if part.seq_last is not None:
        return session
    journal = node.journals.get(part.boot_id)
    last = journal.held.last if journal is not None else None
    until_t_ns = min(session.stopped_t_ns or utc_ns(), utc_ns())
    seen_t_ns = node.last_seen_t_ns
    if seen_t_ns is None and journal is not None and last is not None:
        # The server was restarted since: what it still knows is when the newest frame was taken.
        taken_t_ns = journal.t_ns_near(last, newest=True)
        offset_ns = session.clock[-1].server_minus_node_ns if session.clock else 0
        seen_t_ns = None if taken_t_ns is None else taken_t_ns + offset_ns
    silent_s = 0.0 if seen_t_ns is None else max(0.0, (until_t_ns - seen_t_ns) * 1e-9)
    tail = round(silent_s * node.info.nominal_rate_hz) + 1
    tails = {**session.unsynced_tail_max, part.boot_id: tail}
    session = ended(session, max(part.seq_first - 1, last if last is not None else -1))
    return session.model_copy(update={"unsynced_tail_max": tails})
