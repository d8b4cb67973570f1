"""Recovery after a crash, without a server: mends journals and completes sessions.

A session is sealed if all its frames are stored or cannot come any more; the missing ones are lost,
for a reason. On a server's folder a node may still send frames: such a session waits, unless its
missing frames are abandoned. Every sealed file is read again and verified before it counts as
recovered. Recovery can be killed at any time: files are written atomically, and a second run gives
the same result.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal, NamedTuple

from devices.errors import (
    DamagedFileError,
    DamagedFramesError,
    FileFormatError,
    FootTileError,
    StorageError,
    escape_control_chars,
)
from service.sessions.inputs import make_inputs
from service.sessions.lifecycle import (
    Reevaluate,
    Sealed,
    apply_event,
    compute_present_ledger,
    create_session,
)
from service.sessions.parts import FramesToCome, NodeFacts, SessionStream, bound_lost_tail_frames
from service.sessions.sealing import rebuild_damaged_session_json, write_sealed_files
from service.sessions.tares import TareHistory
from storage.clock.log import ClockLog
from storage.documents import read_checksummed_json
from storage.durable_files import ASIDE_SUFFIX, remove_dead_process_temporaries, set_aside_damaged
from storage.intervals import CORRUPT, NO_END, Intervals, Losses
from storage.journal.journal import Journal
from storage.journal.node.journal import recover_node_journals
from storage.journal.segment import SUFFIX, UNREAD_SUFFIX
from storage.journal.stream_notes import NOTES_FILE, StreamNotes
from storage.sessions.folder import Ledger, Part, Session, SessionsFolder, make_session_id
from storage.sessions.ledger import group_numbers_by_stream
from storage.sessions.metadata import MARKERS_NAME, read_existing_markers, write_markers
from storage.verify.session import verify_session


@dataclass
class OpenedStream:
    """Journal of one stream, opened after a crash.

    Attributes:
        journal: its frames.
        notes: its `stream.json`; None if there is none.
        damaged: frames that were stored and cannot be read any more.
        is_node_folder: True: the stream is in its own node's folder.
    """

    journal: Journal
    notes: StreamNotes | None
    damaged: Intervals
    is_node_folder: bool

    @property
    def lost(self) -> Losses:
        """Frames that cannot come any more, by reason."""
        lost = Losses(self.notes.lost if self.notes is not None else None)
        if self.is_node_folder:
            lost.add_if_new(self.damaged, CORRUPT)
        lost.remove(self.journal.stored)
        return lost

    def make_session_stream(self) -> SessionStream:
        """Return the stream's facts for its sessions."""
        notes, lost = self.notes or StreamNotes(array_info=self.journal.info), self.lost
        return SessionStream(
            stored=self.journal.stored,
            lost=lost,
            damaged=self.damaged,
            obtainable=Intervals(() if self.is_node_folder else [(0, NO_END)]) - lost.numbers,
            next_seq=notes.next_seq,
            max_lost_tail_frames=notes.max_lost_tail_frames,
            missed_slots=notes.missed_slots,
            info=self.journal.info,
            journal=self.journal,
            offset_ns=0 if self.is_node_folder else None,  # a node stops by its own clock
        )

    def save_damage(self) -> None:
        """Save the damage found: once cut off, no other record exists.

        On a server's folder these frames are not lost yet: the node may have them. Unreadable notes
        are replaced.

        Raises:
            StorageError: the disk is full or not writable.
        """
        notes = self.notes or StreamNotes(array_info=self.journal.info)
        if self.is_node_folder:
            found: dict[str, object] = {"lost": self.lost.to_pairs()}
        else:
            found = {"damaged": tuple(self.damaged)}
        now = notes.model_copy(update=found)
        was_broken = self.notes is None and any(
            self.journal.folder.glob(NOTES_FILE + ASIDE_SUFFIX + "*")
        )
        if now != notes or was_broken:
            self.notes = now
            self.notes.save(self.journal.folder)

    def read_and_invalidate_damaged(self, first_seq: int, last_seq: int) -> None:
        """Read the stored frames from `first_seq` to `last_seq`, and invalidate damaged ones.

        Raises:
            StorageError: it cannot be read.
        """
        seq = first_seq
        while seq <= last_seq:
            try:
                for _ in self.journal.read_overlapping_messages(seq, last_seq):
                    pass
            except DamagedFramesError as error:
                damaged = Intervals([(error.seq_first, error.seq_last)])
                self.journal.invalidate_batches_wholly_within(damaged)
                self.damaged = self.damaged | (damaged - self.journal.stored)
                seq = error.seq_last + 1
            else:
                return


class MendedStreams(NamedTuple):
    """Streams by node and stream id, and failures as text."""

    streams: dict[tuple[str, str], OpenedStream]
    problems: list[str]


def _open_and_mend_streams(
    data: Path, report_step: Callable[[str], None], *, is_node_folder: bool
) -> MendedStreams:
    """Open and mend every journal of a data folder: cut off partial batches, sync the rest.

    Args:
        data: the data folder.
        report_step: called with a description of each step.
        is_node_folder: True: a node's own folder.

    Raises:
        StorageError: the disk is full or not writable.
    """
    mended = MendedStreams({}, [])
    problems = mended.problems
    for folder in sorted((data / "journal").glob("*/*")):
        if not folder.is_dir() or not (
            (folder / NOTES_FILE).exists() or any(folder.glob("*" + SUFFIX))
        ):
            continue
        report_step(f"journal {folder.parent.name}/{folder.name}")
        remove_dead_process_temporaries(folder)
        try:
            journal = Journal.open_existing_and_recover(folder)
            problems += journal.problems
            notes = StreamNotes.load_or_set_aside(folder, problems)
        except FileFormatError as error:
            problems.append(
                escape_control_chars(f"journal {folder.parent.name}/{folder.name}: {error}")
            )
            continue
        stream = OpenedStream(journal, notes, journal.lost.numbers, is_node_folder)
        stream.save_damage()
        mended.streams[folder.parent.name, folder.name] = stream
    return mended


def _read_hello_or_empty(data: Path, node: str) -> dict[str, Any]:
    """Read the node's last hello on the server's disk; empty if it is missing or unreadable."""
    try:
        content = json.loads(read_checksummed_json(data / "nodes" / node / "hello.json"))
    except (OSError, ValueError, RecursionError):
        return {}
    return content if isinstance(content, dict) else {}


Outcome = Literal["sealed", "waiting", "failed"]
Streams = Mapping[tuple[str, str], OpenedStream]


@dataclass(frozen=True)
class RecoveredSession:
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
class RecoveryReport:
    """Result of recovery for a data folder.

    Attributes:
        sessions: formerly unsealed sessions.
        removed_temporaries: half-written files of dead processes.
        cut_bytes: bytes that were cut off, by journal; they are set aside, not deleted.
        rewritten_markers: sessions whose `markers.parquet` was written again.
        rebuilt_sessions: sessions whose `session.json` was rebuilt from the files beside it.
        problems: further failures.
    """

    sessions: list[RecoveredSession] = field(default_factory=list)
    removed_temporaries: list[Path] = field(default_factory=list)
    cut_bytes: dict[str, int] = field(default_factory=dict)
    rewritten_markers: list[str] = field(default_factory=list)
    rebuilt_sessions: list[str] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)

    @property
    def is_empty_or_all_waiting(self) -> bool:
        """True if nothing was changed; sessions may wait for their node."""
        done = any(one.outcome != "waiting" for one in self.sessions)
        return not (done or any(made for name, made in vars(self).items() if name != "sessions"))


def recover_locked_folder(
    data: Path,
    *,
    make_sessions: bool = False,
    abandon_missing: bool = False,
    report_step: Callable[[str], None] = lambda _: None,
    now: Callable[[], datetime] = lambda: datetime.now(UTC),
) -> RecoveryReport:
    """Complete a data folder, of a server or of a node, after a crash.

    Args:
        data: data folder; the caller holds its lock.
        make_sessions: create sessions for frames that belong to no session.
        abandon_missing: on a server's folder, seal frames that its nodes have not sent as lost.
        report_step: called with a description of each step.
        now: returns the time for ids of new sessions.

    Raises:
        StorageError: the disk is full or not writable; the steps before are complete.
    """
    recovery = RecoveryReport()
    sessions = SessionsFolder(data / "sessions")
    recovery.removed_temporaries += remove_dead_process_temporaries(data)
    before = _find_cut_files(data)
    if _is_node_folder(data):
        recover_node_journals(data)  # frames in flight of a killed node
    opened, recovery.problems = _open_and_mend_streams(
        data, report_step, is_node_folder=_is_node_folder(data)
    )
    for path in sorted(_find_cut_files(data) - before):
        name = f"{path.parent.parent.name}/{path.parent.name}"
        recovery.cut_bytes[name] = recovery.cut_bytes.get(name, 0) + path.stat().st_size
    loaded, unreadable = sessions.load_all()
    loaded.sort(key=lambda session: session.id)
    for session_id, error in sorted(unreadable.items()):
        if rebuild_damaged_session_json(sessions, session_id) is None:
            recovery.problems.append(str(error))
        else:
            recovery.rebuilt_sessions.append(session_id)
    strays = [
        *sessions.find_renamed_or_copied_sessions(),
        *SessionsFolder(data / "trash").find_renamed_or_copied_sessions(),
    ]
    recovery.problems += [str(stray.error) for stray in strays]
    for session in loaded:
        if session.state == "sealed":
            if _rewrite_markers(session, sessions.get_path(session.id)):
                recovery.rewritten_markers.append(session.id)
            continue
        report_step(f"session {session.id} ({session.name})")
        recovery.sessions.append(
            _seal_if_possible(data, sessions, session, opened, abandon_missing=abandon_missing)
        )
    if make_sessions:
        for session in _make_sessions(data, loaded, opened, now):
            report_step(f"session {session.id} ({session.name})")
            recovery.sessions.append(
                _seal_if_possible(data, sessions, session, opened, abandon_missing=True)
            )
    return recovery


def _seal_if_possible(
    data: Path,
    sessions: SessionsFolder,
    session: Session,
    opened: Streams,
    *,
    abandon_missing: bool,
) -> RecoveredSession:
    """Seal one session, or return the reason why not."""
    own_streams = {
        part.stream_id: opened.get((session.node, part.stream_id)) for part in session.parts
    }
    for stream in own_streams.values():
        if stream is not None:
            with suppress(StorageError):  # frames matter more than clock measurements
                session = session.with_newer_clock_rows(
                    ClockLog(stream.journal.folder).read_undamaged_rows()
                )
    frames_to_come: FramesToCome = "possible"
    if _is_node_folder(data):
        frames_to_come = "none"
    elif abandon_missing or session.is_abandoned:
        frames_to_come = "abandoned"

    def find_stream(stream_id: str) -> SessionStream | None:
        stream = own_streams.get(stream_id)
        return stream.make_session_stream() if stream is not None else None

    facts = NodeFacts(find_stream=find_stream, frames_to_come=frames_to_come)
    session = _close_parts_without_damaged_frames(session, own_streams.values(), facts)
    if any(part.seq_last is None for part in session.parts):
        return RecoveredSession(session, "waiting", "its node may still be recording it")
    for part in session.parts:
        stream = own_streams[part.stream_id]
        if stream is not None and part.seq_last is not None:
            stream.read_and_invalidate_damaged(part.seq_first, part.seq_last)
            stream.save_damage()
    session = _close_parts_without_damaged_frames(session, own_streams.values(), facts)
    ledger = compute_present_ledger(session, facts)
    if session.state != "sealing":
        text = f"{ledger.pending} frames may still come from node {session.node}"
        return RecoveredSession(session, "waiting", text, ledger)
    folder = sessions.get_path(session.id)
    try:
        sessions.save_session_json(session)
        sources = make_inputs(
            session,
            facts,
            load_tares=lambda: TareHistory(data / "nodes" / session.node / "tares.json"),
            emulated=_read_hello_or_empty(data, session.node).get("emulated"),
        )
        sealed = apply_event(session, Sealed(write_sealed_files(sources, folder, ledger))).session
        problems = verify_session(folder, expected_session=sealed).problems
        if problems:
            return RecoveredSession(session, "failed", "; ".join(problems), ledger)
        sessions.save_session_json(sealed)
    except FootTileError as error:
        return RecoveredSession(session, "failed", str(error), ledger)
    return RecoveredSession(sealed, "sealed", sealed.problem or "", ledger)


def _close_parts_without_damaged_frames(
    session: Session, streams: Iterable[OpenedStream | None], facts: NodeFacts
) -> Session:
    """Return the session with its parts closed, as well as they are known."""
    while True:
        try:
            return apply_event(session, Reevaluate(), facts).session
        except DamagedFramesError as error:  # at the stop: retry without these frames
            _invalidate(streams, error)


def _invalidate(streams: Iterable[OpenedStream | None], error: DamagedFramesError) -> None:
    """Remove damaged frames from the stored ones.

    Raises:
        DamagedFramesError: the same error, if no stream had these frames.
    """
    for stream in streams:
        if stream is not None and stream.journal.folder == Path(error.where).parent:
            before = stream.journal.stored.number_count
            stream.read_and_invalidate_damaged(error.seq_first, error.seq_last)
            if stream.journal.stored.number_count < before:
                return
    raise error


def _is_node_folder(data: Path) -> bool:
    """Return whether this is a node's own folder: then no more frames will come."""
    return not (data / "nodes").is_dir()


def _make_sessions(
    data: Path, known: list[Session], streams: Streams, now: Callable[[], datetime]
) -> list[Session]:
    """Return new sessions for frames that belong to no session, one for each run of a stream."""
    # Frames of a deleted session must not come back as a new one. A session in the trash that
    # cannot be read has unknown frames.
    known = [*known, *SessionsFolder(data / "trash").load_all().sessions]
    found = []
    for (node, stream_id), stream in streams.items():
        parts = (part for session in known if session.node == node for part in session.parts)
        used = group_numbers_by_stream(parts).get(stream_id, Intervals())
        journal, hello = stream.journal, _read_hello_or_empty(data, node)
        # Lost frames do not split a run; frames that belong to a session do.
        unused = (journal.stored | stream.lost.numbers | stream.damaged) - used
        for run in unused:
            stored = list(journal.stored.restricted_to(*run))
            if not stored:
                continue
            first, last = stored[0][0], stored[-1][1]
            session = create_session(
                journal.info,
                f"recovered {node} {stream_id}",
                Part(stream_id=stream_id, seq_first=first, seq_last=last),
                scene_content=hello.get("scene") or {},
                calibration=None,
                id=make_session_id(now()),
                node=node,
                state="sealing",
                started_t_ns=journal.find_batch_t_ns_near(first, at_or_before=False) or 0,
                stopped_t_ns=journal.find_batch_t_ns_near(last, at_or_before=True),
            )
            session = session.model_copy(update={"calibration": hello.get("calibration")})
            if last == journal.stored.last and (
                tail := bound_lost_tail_frames(stream.make_session_stream())
            ):
                session = session.model_copy(update={"max_lost_tail_frames": {stream_id: tail}})
            found.append(session)
    return found


def _find_cut_files(data: Path) -> set[Path]:
    """Return the files with bytes behind the last whole batch of a segment."""
    return set(data.glob("journal/*/*/*" + UNREAD_SUFFIX))


def _rewrite_markers(session: Session, folder: Path) -> bool:
    """Write `markers.parquet` again if it differs from `session.json`, which is written first."""
    try:
        if read_existing_markers(folder / MARKERS_NAME) == session.markers:
            return False
    except FileNotFoundError:
        if not session.frames:
            return False
    except DamagedFileError:
        set_aside_damaged(folder / MARKERS_NAME)
    write_markers(session, folder)
    return True
