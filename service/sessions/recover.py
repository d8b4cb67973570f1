"""After a crash, without a server: journals are mended, and sessions completed from them.

A session is sealed if all its frames are here or can never come; what is missing then is lost, for
a reason. On a server's folder a node may still bring frames: such a session waits, unless it is
given up. Every sealed file is read again and proven before it counts as recovered. Who is killed
here begins anew: what was written is whole, and the second run comes to the same.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Literal

import pyarrow as pa
import pyarrow.parquet as pq

from devices.errors import FootTileError
from service.sessions.recover_ends import with_ends
from service.sessions.recover_sources import (
    Stream,
    hello_of,
    open_streams,
    sources_of,
    with_clock_logs,
)
from service.sessions.sealing import seal
from storage.durable import remove_stale_temporaries
from storage.intervals import NO_END, Intervals
from storage.journal.node_journal import settle_left_over
from storage.journal.segment import UNREAD_SUFFIX
from storage.losses import GIVEN_UP, NODE_RESTARTED, Losses
from storage.sessions.events import EVENTS_NAME, write_events
from storage.sessions.folder import Ledger, Part, Session, SessionFolder, new_session_id
from storage.sessions.ledger import StreamState, ledger_of
from storage.verify.session import verify_session

Outcome = Literal["sealed", "waiting", "failed"]
Streams = Mapping[tuple[str, str], Stream]


@dataclass(frozen=True)
class Recovered:
    """What became of one session.

    Attributes:
        session: as it is now.
        outcome: waiting: its node may still bring frames.
        problem: why it failed, or what it waits for.
        ledger: what became of its frames, as far as that is known.
    """

    session: Session
    outcome: Outcome
    problem: str = ""
    ledger: Ledger | None = None


@dataclass
class Recovery:
    """What was done.

    Attributes:
        sessions: that were not sealed before.
        removed: half-written files of dead processes.
        cut: journals of which something was cut off, and how many bytes; set aside, not deleted.
        mended: sessions whose `events.parquet` was written anew.
        problems: what could not be recovered, beside sessions.
    """

    sessions: list[Recovered] = field(default_factory=list)
    removed: list[Path] = field(default_factory=list)
    cut: dict[str, int] = field(default_factory=dict)
    mended: list[str] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)

    @property
    def is_nothing(self) -> bool:
        """Was there nothing to do?"""
        done = any(one.outcome != "waiting" for one in self.sessions)
        return not (done or self.removed or self.cut or self.mended or self.problems)


def _silent(_: str) -> None:
    pass


def recover(
    data: Path,
    *,
    streams: bool = False,
    give_up: bool = False,
    tell: Callable[[str], None] = _silent,
    now: Callable[[], datetime] = lambda: datetime.now(UTC),
) -> Recovery:
    """Complete what a crash has left in a data folder, a server's or a node's.

    Args:
        data: the folder, whose lock the caller holds.
        streams: make sessions of frames that belong to none.
        give_up: on a server's folder, seal what its nodes have not brought as lost.
        tell: told what is being done.
        now: for the ids of new sessions.

    Raises:
        StorageError: the disk is full or not writable; what was done until then is whole.
    """
    recovery = Recovery()
    sessions = SessionFolder(data / "sessions")
    recovery.removed += remove_stale_temporaries(data)
    set_aside = _set_aside(data)
    if not (data / "nodes").is_dir():
        settle_left_over(data)  # a node's: what it had in flight when it was killed is there yet
    opened, recovery.problems = open_streams(data, tell)
    for path in sorted(_set_aside(data) - set_aside):
        name = f"{path.parent.parent.name}/{path.parent.name}"
        recovery.cut[name] = recovery.cut.get(name, 0) + path.stat().st_size
    known = []
    for session_id in sorted(sessions.ids()):
        try:
            known.append(sessions.load(session_id))
        except FootTileError as error:
            if any(sessions.path(session_id).iterdir()):
                recovery.problems.append(str(error))
    for session in known:
        if session.state == "sealed":
            if _mend_events(session, sessions.path(session.id)):
                recovery.mended.append(session.id)
            continue
        tell(f"session {session.id} ({session.name})")
        recovery.sessions.append(_complete(data, sessions, session, opened, give_up=give_up))
    if streams:
        for session in _of_no_session(data, known, opened, now):
            tell(f"session {session.id} ({session.name})")
            recovery.sessions.append(_complete(data, sessions, session, opened, give_up=True))
    return recovery


def _complete(
    data: Path, sessions: SessionFolder, session: Session, streams: Streams, *, give_up: bool
) -> Recovered:
    """Seal one session if that can be; say why not otherwise."""
    is_local = not (data / "nodes").is_dir()
    session = with_clock_logs(session, streams)
    session = with_ends(session, streams, is_local=is_local, may_guess=is_local or give_up)
    if any(part.seq_last is None for part in session.parts):
        return Recovered(session, "waiting", "its node may still be recording it")
    for part in session.parts:
        stream = streams.get((session.node, part.boot_id))
        if stream is not None and part.seq_last is not None:
            stream.disown_damaged(part.seq_first, part.seq_last)
            stream.note_losses()
    states = _states(session, streams, is_local=is_local, give_up=give_up)
    ledger = ledger_of(session.parts, states, finished=True)
    if pending := sum(part.pending for part in ledger.parts):
        text = f"{pending} frames may still come from node {session.node}"
        return Recovered(session, "waiting", text, ledger)
    lost = {b: state.lost.as_pairs() for b, state in states.items() if state.lost}
    folder = sessions.path(session.id)
    try:
        session = session.model_copy(update={"state": "sealing"})
        sessions.save(session)
        sealed = seal(sources_of(data, session, streams, lost), folder, ledger)
        problems = verify_session(folder, session=sealed).problems
        if problems:
            return Recovered(session, "failed", "; ".join(problems), ledger)
        sessions.save(sealed)
    except FootTileError as error:
        return Recovered(session, "failed", str(error), ledger)
    return Recovered(sealed, "sealed", sealed.problem or "", ledger)


def _states(
    session: Session, streams: Streams, *, is_local: bool, give_up: bool
) -> dict[str, StreamState]:
    """What is known of each of a session's streams, every gap with its reason or still to come."""
    states = {}
    for boot_id in dict.fromkeys(part.boot_id for part in session.parts):
        stream = streams.get((session.node, boot_id))
        held = stream.journal.held if stream is not None else Intervals()
        gaps = Intervals(
            gap
            for part in session.parts
            if part.boot_id == boot_id and part.seq_last is not None
            for gap in held.missing(part.seq_first, part.seq_last)
        )
        lost = Losses()
        if stream is not None:
            for reason, numbers in stream.losses.within(gaps).items():
                lost.add(numbers, reason)
        if is_local or give_up:
            lost.add(gaps, NODE_RESTARTED if is_local else GIVEN_UP)
        missed_slots = 0
        if stream is not None and stream.notes is not None:
            missed_slots = stream.notes.missed_slots
            if boot_id == session.parts[0].boot_id:
                missed_slots = max(0, missed_slots - session.missed_slots_at_start)
        states[boot_id] = StreamState(
            held=held,
            lost=lost,
            may_come=Intervals([(0, NO_END)]),
            unsynced_tail_max=session.unsynced_tail_max.get(boot_id, 0),
            missed_slots=missed_slots,
        )
    return states


def _of_no_session(
    data: Path, known: list[Session], streams: Streams, now: Callable[[], datetime]
) -> list[Session]:
    """Sessions of the frames that belong to none, one for every run of a stream."""
    trash = SessionFolder(data / "trash")
    for session_id in trash.ids():
        try:
            known = [*known, trash.load(session_id)]
        except FootTileError:  # whoever deleted it does not want it back
            continue
    found = []
    for (node, boot_id), stream in streams.items():
        taken = Intervals(
            (part.seq_first, NO_END if part.seq_last is None else part.seq_last)
            for session in known
            for part in session.parts
            if (session.node, part.boot_id) == (node, boot_id)
            and (part.seq_last is None or part.seq_last >= part.seq_first)
        )
        journal, hello = stream.journal, hello_of(data, node)
        # What was lost between two frames does not part them; what a session took does.
        own = (journal.held | stream.losses.all) - taken
        for run in own:
            held = list(journal.held.within(*run))
            if not held:
                continue
            first, last = held[0][0], held[-1][1]
            is_end = last == journal.held.last
            begin_t_ns = journal.t_ns_near(first, newest=False)
            end_t_ns = journal.t_ns_near(last, newest=True)
            found.append(
                Session(
                    id=new_session_id(now()),
                    name=f"recovered {node} {boot_id}",
                    node=node,
                    state="sealing",
                    started_t_ns=begin_t_ns or 0,
                    stopped_t_ns=end_t_ns,
                    parts=(Part(boot_id=boot_id, seq_first=first, seq_last=last),),
                    scene=journal.info.scene,
                    scene_content=hello.get("scene") or {},
                    calibration=hello.get("calibration"),
                    unsynced_tail_max={boot_id: t} if is_end and (t := stream.tail_max) else {},
                )
            )
    return found


def _set_aside(data: Path) -> set[Path]:
    """What stood behind the last whole batch of a segment."""
    return set(data.glob("journal/*/*/*" + UNREAD_SUFFIX))


def _mend_events(session: Session, folder: Path) -> bool:
    """Write `events.parquet` anew if it is not what `session.json` says: that is written first."""
    wanted = [event.model_dump() for event in session.events]
    try:
        with pq.ParquetFile(folder / EVENTS_NAME) as file:
            if file.read().to_pylist() == wanted:
                return False
    except FileNotFoundError:
        if not session.frames:
            return False
    except (OSError, ValueError, pa.ArrowException):
        pass
    write_events(session, folder)
    return True
