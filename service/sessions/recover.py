"""Recovery after a crash, without a server: mends journals and completes sessions.

A session is sealed if all its frames are stored or cannot come any more; the missing ones are lost,
for a reason. On a server's folder a node may still send frames: such a session waits, unless its
missing frames are abandoned. Every sealed file is read again and verified before it counts as
recovered. Recovery can be killed at any time: files are written atomically, and a second run gives
the same result.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Literal

from devices.errors import DamagedFileError, DamagedFramesError, FootTileError, StorageError
from service.sessions.begin import begun
from service.sessions.ends import SessionStream, at_stop, broken_off, open_tail
from service.sessions.recover_streams import OpenedStream, hello_of, open_streams
from service.sessions.restore import restore
from service.sessions.sealing import seal
from service.sessions.sources import sources_of
from service.sessions.tares import TareHistory
from storage.clock.log import ClockLog
from storage.durable import remove_stale_temporaries, set_aside
from storage.intervals import NO_END, Intervals
from storage.journal.node.journal import settle_left_over
from storage.journal.segment import UNREAD_SUFFIX
from storage.sessions.beside import EVENTS_NAME, read_events, write_events
from storage.sessions.folder import Ledger, Part, Session, SessionFolder, new_session_id
from storage.sessions.ledger import ledger_of, numbers_of, states_of
from storage.verify.session import verify_session

Outcome = Literal["sealed", "waiting", "failed"]
Streams = Mapping[tuple[str, str], OpenedStream]


@dataclass(frozen=True)
class Recovered:
    """Result of recovery for one session.

    Attributes:
        session: its new state.
        outcome: waiting: its node may still send frames.
        problem: reason of a failure or of waiting.
        ledger: fate of its frames, if known.
    """

    session: Session
    outcome: Outcome
    problem: str = ""
    ledger: Ledger | None = None


@dataclass
class Recovery:
    """Result of recovery for a data folder.

    Attributes:
        sessions: formerly unsealed sessions.
        removed: half-written files of dead processes.
        cut: bytes that were cut off, by journal; they are set aside, not deleted.
        mended: sessions whose `events.parquet` was written again.
        restored: sessions whose `session.json` was rebuilt from the files beside it.
        problems: further failures.
    """

    sessions: list[Recovered] = field(default_factory=list)
    removed: list[Path] = field(default_factory=list)
    """half-written files of dead processes."""
    cut: dict[str, int] = field(default_factory=dict)
    """bytes that were cut off, by journal; they are set aside, not deleted."""
    mended: list[str] = field(default_factory=list)
    """sessions whose `events.parquet` was written again."""
    restored: list[str] = field(default_factory=list)
    """sessions whose `session.json` was rebuilt from the files beside it."""
    problems: list[str] = field(default_factory=list)

    @property
    def is_nothing(self) -> bool:
        """True if there was nothing to do."""
        done = any(one.outcome != "waiting" for one in self.sessions)
        made = (self.removed, self.cut, self.mended, self.restored, self.problems)
        return not (done or any(made))


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
    """Complete a data folder, of a server or of a node, after a crash.

    Args:
        data: data folder; the caller holds its lock.
        streams: create sessions for frames that belong to no session.
        give_up: on a server's folder, seal frames that its nodes have not sent as lost.
        tell: called with a description of each step.
        now: returns the time for ids of new sessions.

    Raises:
        StorageError: the disk is full or not writable; the steps before are complete.
    """
    recovery = Recovery()
    sessions = SessionFolder(data / "sessions")
    recovery.removed += remove_stale_temporaries(data)
    before = _unread(data)
    if _is_local(data):
        settle_left_over(data)  # frames in flight of a killed node
    opened, recovery.problems = open_streams(data, tell, is_local=_is_local(data))
    for path in sorted(_unread(data) - before):
        name = f"{path.parent.parent.name}/{path.parent.name}"
        recovery.cut[name] = recovery.cut.get(name, 0) + path.stat().st_size
    loaded, unreadable = sessions.load_all()
    loaded.sort(key=lambda session: session.id)
    for session_id, error in sorted(unreadable.items()):
        if not any(sessions.path(session_id).iterdir()):
            continue
        if restore(sessions, session_id) is None:
            recovery.problems.append(str(error))
        else:
            recovery.restored.append(session_id)
    strays = [*sessions.strays(), *SessionFolder(data / "trash").strays()]
    recovery.problems += [str(stray.error) for stray in strays]
    for session in loaded:
        if session.state == "sealed":
            if _mend_events(session, sessions.path(session.id)):
                recovery.mended.append(session.id)
            continue
        tell(f"session {session.id} ({session.name})")
        recovery.sessions.append(_complete(data, sessions, session, opened, give_up=give_up))
    if streams:
        for session in _of_no_session(data, loaded, opened, now):
            tell(f"session {session.id} ({session.name})")
            recovery.sessions.append(_complete(data, sessions, session, opened, give_up=True))
    return recovery


def _complete(
    data: Path, sessions: SessionFolder, session: Session, opened: Streams, *, give_up: bool
) -> Recovered:
    """Seal one session, or return the reason why not."""
    own_streams = {part.boot_id: opened.get((session.node, part.boot_id)) for part in session.parts}
    for stream in own_streams.values():
        if stream is not None:
            with suppress(StorageError):  # frames matter more than clock measurements
                session = session.with_clock(ClockLog(stream.journal.folder).rows())
    is_local, give_up = _is_local(data), give_up or session.given_up
    session = _with_ends(session, own_streams, is_local=is_local, give_up=give_up)
    if any(part.seq_last is None for part in session.parts):
        return Recovered(session, "waiting", "its node may still be recording it")
    for part in session.parts:
        stream = own_streams[part.boot_id]
        if stream is not None and part.seq_last is not None:
            stream.disown_damaged(part.seq_first, part.seq_last)
            stream.note_losses()
    streams = _described(session, own_streams, is_local=is_local)
    ledger = ledger_of(session.parts, states_of(session, streams), finished=True)
    if pending := ledger.pending:
        text = f"{pending} frames may still come from node {session.node}"
        return Recovered(session, "waiting", text, ledger)
    folder = sessions.path(session.id)
    try:
        session = session.model_copy(update={"state": "sealing"})
        sessions.save(session)
        sources = sources_of(
            session,
            streams,
            tares=lambda: TareHistory(data / "nodes" / session.node / "tares.json"),
            emulated=hello_of(data, session.node).get("emulated"),
        )
        sealed = seal(sources, folder, ledger)
        problems = verify_session(folder, session=sealed).problems
        if problems:
            return Recovered(session, "failed", "; ".join(problems), ledger)
        sessions.save(sealed)
    except FootTileError as error:
        return Recovered(session, "failed", str(error), ledger)
    return Recovered(sealed, "sealed", sealed.problem or "", ledger)


def _with_ends(
    session: Session,
    own: Mapping[str, OpenedStream | None],
    *,
    is_local: bool,
    give_up: bool,
) -> Session:
    """Return the session with its parts closed, as well as they are known."""
    while True:
        streams = _described(session, own, is_local=is_local)
        try:
            if is_local or give_up:
                closed = broken_off(session, streams)
                return closed.model_copy(update={"given_up": not is_local})
            return at_stop(session, streams, waiting=True)
        except DamagedFramesError as error:  # at the stop: retry without these frames
            _disown(own.values(), error)


def _disown(streams: Iterable[OpenedStream | None], error: DamagedFramesError) -> None:
    """Remove damaged frames from the stored ones.

    Raises:
        DamagedFramesError: the same error, if no stream had these frames.
    """
    for stream in streams:
        if stream is not None and stream.journal.folder == Path(error.where).parent:
            before = stream.journal.held.count
            stream.disown_damaged(error.seq_first, error.seq_last)
            if stream.journal.held.count < before:
                return
    raise error


def _is_local(data: Path) -> bool:
    """Return whether this is a node's own folder: then no more frames will come."""
    return not (data / "nodes").is_dir()


def _described(
    session: Session, streams: Mapping[str, OpenedStream | None], *, is_local: bool
) -> dict[str, SessionStream]:
    unknown = SessionStream(may_come=Intervals(() if is_local else [(0, NO_END)]))
    return {
        boot_id: stream.for_session(session) if stream is not None else unknown
        for boot_id, stream in streams.items()
    }


def _of_no_session(
    data: Path, known: list[Session], streams: Streams, now: Callable[[], datetime]
) -> list[Session]:
    """Return new sessions for frames that belong to no session, one for each run of a stream."""
    # Frames of a deleted session must not come back as a new one. A session in the trash that
    # cannot be read has unknown frames.
    known = [*known, *SessionFolder(data / "trash").load_all()[0]]
    found = []
    for (node, boot_id), stream in streams.items():
        parts = (part for session in known if session.node == node for part in session.parts)
        used = numbers_of(parts).get(boot_id, Intervals())
        journal, hello = stream.journal, hello_of(data, node)
        # Lost frames do not split a run; frames that belong to a session do.
        unused = (journal.held | stream.lost.all | stream.damaged) - used
        for run in unused:
            stored = list(journal.held.within(*run))
            if not stored:
                continue
            first, last = stored[0][0], stored[-1][1]
            session = begun(
                journal.info,
                f"recovered {node} {boot_id}",
                Part(boot_id=boot_id, seq_first=first, seq_last=last),
                scene_content=hello.get("scene") or {},
                calibration=None,
                id=new_session_id(now()),
                node=node,
                state="sealing",
                started_t_ns=journal.t_ns_near(first, newest=False) or 0,
                stopped_t_ns=journal.t_ns_near(last, newest=True),
            )
            session = session.model_copy(update={"calibration": hello.get("calibration")})
            if last == journal.held.last and (tail := open_tail(stream.for_session(session))):
                session = session.model_copy(update={"unsynced_tail_max": {boot_id: tail}})
            found.append(session)
    return found


def _unread(data: Path) -> set[Path]:
    """Return the files with bytes behind the last whole batch of a segment."""
    return set(data.glob("journal/*/*/*" + UNREAD_SUFFIX))


def _mend_events(session: Session, folder: Path) -> bool:
    """Write `events.parquet` again if it differs from `session.json`, which is written first."""
    try:
        stored = read_events(folder / EVENTS_NAME)
        if stored.events == session.events and stored.is_proven:
            return False
    except FileNotFoundError:
        if not session.frames:
            return False
    except DamagedFileError:
        set_aside(folder / EVENTS_NAME)
    write_events(session, folder)
    return True
