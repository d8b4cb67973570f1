"""What a session is sealed from when no server runs: journals, tares and notes from files."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from devices.errors import DamagedFramesError, FileFormatError, FootTileError
from devices.frames import ArrayInfo
from service.estimation.calibration import Calibration
from service.estimation.tare.tare import Tare
from service.sessions.sealing import Sources
from service.sessions.tares import TareHistory
from storage.clock.log import ClockLog
from storage.clock.offset import ClockOffset
from storage.durable import remove_stale_temporaries
from storage.intervals import Intervals
from storage.journal.journal import Journal
from storage.journal.segment import SUFFIX
from storage.journal.stream_notes import NOTES_FILE, StreamNotes, unsynced_tail_max
from storage.losses import CORRUPT, Losses
from storage.sessions.folder import Session

RATE_MAX_HZ = 1000.0
"""Of a stream of which not even the description is left: no bus is faster."""


@dataclass
class Stream:
    """One stream's journal, opened, and what is known of its end.

    Attributes:
        journal: its frames.
        notes: its `stream.json`; None if there is none.
        losses: numbers that are lost, by reason.
        clock: measurements of its clock against the server's.
    """

    journal: Journal
    notes: StreamNotes | None
    losses: Losses
    clock: tuple[ClockOffset, ...] = ()

    @property
    def last(self) -> int | None:
        """The last frame it is known to have had; None if nothing is known."""
        held = self.journal.held.last
        if self.notes is not None and self.notes.next_seq is not None:
            return max(self.notes.next_seq - 1, -1 if held is None else held)
        return held

    @property
    def tail_max(self) -> int:
        """How many more frames there may have been behind the last one that is known."""
        notes = self.notes
        if notes is not None and notes.has_ended:
            return notes.unsynced_tail_max
        tail = unsynced_tail_max(self.journal.info.nominal_rate_hz)
        return max(tail, notes.unsynced_tail_max if notes is not None else 0)

    def note_losses(self) -> None:
        """Write down what was found damaged: once it is cut off, nothing else says so.

        Raises:
            StorageError: the disk is full or not writable.
        """
        notes = self.notes or StreamNotes(array_info=self.journal.info)
        lost = self.losses.as_pairs()
        if lost != Losses(notes.lost).as_pairs():
            self.notes = notes.model_copy(update={"lost": lost})
            self.notes.save(self.journal.folder)

    def disown_damaged(self, first: int, last: int) -> None:
        """Read what is held from `first` to `last`; what does not agree with its checksum is lost.

        Raises:
            StorageError: it cannot be read.
        """
        at = first
        while at <= last:
            try:
                for _ in self.journal.messages(at, last):
                    pass
            except DamagedFramesError as error:
                damaged = Intervals([(error.seq_first, error.seq_last)])
                self.journal.disown(damaged)
                self.losses.add(damaged - self.journal.held, CORRUPT)
                at = error.seq_last + 1
            else:
                return


def open_streams(
    data: Path, tell: Callable[[str], None]
) -> tuple[dict[tuple[str, str], Stream], list[str]]:
    """Open every journal of a data folder, which cuts off what is not whole and syncs the rest.

    Returns:
        Streams by node and boot_id, and what could not be opened, in words.

    Raises:
        StorageError: the disk is full or not writable.
    """
    streams: dict[tuple[str, str], Stream] = {}
    problems: list[str] = []
    for folder in sorted((data / "journal").glob("*/*")):
        if not folder.is_dir() or not (
            (folder / NOTES_FILE).exists() or any(folder.glob("*" + SUFFIX))
        ):
            continue
        tell(f"journal {folder.parent.name}/{folder.name}")
        remove_stale_temporaries(folder)
        try:
            journal = Journal.open(folder)
            notes = _notes_of(folder, problems)
        except FileFormatError as error:
            problems.append(f"journal {folder.parent.name}/{folder.name}: {error}")
            continue
        losses = Losses(notes.lost if notes is not None else None)
        losses.add(journal.lost.all, CORRUPT)
        losses.found(journal.held)
        stream = Stream(journal, notes, losses, _clock_rows(folder))
        stream.note_losses()
        streams[(folder.parent.name, folder.name)] = stream
    return streams, problems


def sources_of(
    data: Path, session: Session, streams: Mapping[tuple[str, str], Stream], lost: Mapping[str, Any]
) -> Sources:
    """What a session is sealed from.

    Args:
        data: the data folder.
        session: with its ends.
        streams: opened.
        lost: by boot_id, for the file's notes.
    """
    journals = {
        boot_id: stream.journal
        for (node, boot_id), stream in streams.items()
        if node == session.node and any(part.boot_id == boot_id for part in session.parts)
    }
    first = next((journals[p.boot_id] for p in session.parts if p.boot_id in journals), None)
    info = first.info if first is not None else _no_array(session)
    calibration, problem = _calibration_of(session)
    tares: tuple[Tare, ...] = ()
    if calibration is not None:
        try:
            tares, problem = _tares_of(data, session, info, journals)
        except FootTileError as error:
            problem = str(error)
        calibration = None if problem is not None else calibration
    notes: dict[str, object] = {"scene": session.scene_content, "lost": dict(lost)}
    emulated = hello_of(data, session.node).get("emulated")
    if emulated is not None:
        notes["emulated"] = emulated
    return Sources(session, info, journals, calibration, problem, tares, notes)


def hello_of(data: Path, node: str) -> dict[str, Any]:
    """What a server kept of what a node said last; empty if there is nothing."""
    try:
        content = json.loads((data / "nodes" / node / "hello.json").read_bytes())
    except (OSError, ValueError):
        return {}
    return content if isinstance(content, dict) else {}


def _notes_of(folder: Path, problems: list[str]) -> StreamNotes | None:
    try:
        return StreamNotes.load(folder)
    except FileFormatError as error:  # what it says is bounded without it
        problems.append(str(error))
        return None


def _calibration_of(session: Session) -> tuple[Calibration | None, str | None]:
    if session.calibration is None:
        return None, "the node had no calibration"
    try:
        return Calibration.model_validate(session.calibration), None
    except (FootTileError, ValueError) as error:
        return None, f"its calibration is not readable: {error}"


def _tares_of(
    data: Path, session: Session, info: ArrayInfo, journals: Mapping[str, Journal]
) -> tuple[tuple[Tare, ...], str | None]:
    """Tares that were in force while it was recorded; see `service.server.ends.tares_of`."""
    first, last = session.parts[0], session.parts[-1]
    if first.boot_id not in journals or last.boot_id not in journals:
        return (), None
    begin = journals[first.boot_id].t_ns_near(first.seq_first, newest=False)
    newest = last.seq_last if last.seq_last is not None else last.seq_first
    end = journals[last.boot_id].t_ns_near(newest, newest=True)
    if begin is None or end is None:
        return (), None
    history = TareHistory(data / "nodes" / session.node / "tares.json")
    tares = history.during(info, begin, end)
    if not tares and history.in_force(info) is not None:
        return (), "all tares of the node were taken after this session"
    return tares, None


def _no_array(session: Session) -> ArrayInfo:
    """In place of the array of a session of which not one frame is left."""
    return ArrayInfo(
        node=session.node,
        boot_id=session.parts[0].boot_id if session.parts else "",
        tiles=(),
        servo=None,
        schedule="",
        nominal_rate_hz=RATE_MAX_HZ,
        utc_offset_ns=0,
        clock_set=False,
        software="",
        scene=session.scene,
        models=(),
    )


def with_clock_logs(session: Session, streams: Mapping[tuple[str, str], Stream]) -> Session:
    """The session with the clock rows that its streams' logs have beyond its own."""
    rows = list(session.clock)
    for boot_id in dict.fromkeys(part.boot_id for part in session.parts):
        stream = streams.get((session.node, boot_id))
        if stream is not None:
            known = max((r.t_mono_ns for r in rows if r.boot_id == boot_id), default=-1)
            rows += [row for row in stream.clock if row.t_mono_ns > known]
    return session.model_copy(update={"clock": tuple(rows)})


def _clock_rows(folder: Path) -> tuple[ClockOffset, ...]:
    return tuple(ClockLog(folder).rows())
