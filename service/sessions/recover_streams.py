"""Streams of a data folder without a running process: every journal opened and mended."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from devices.errors import DamagedFramesError, FileFormatError
from devices.words import printable
from service.sessions.ends import SessionStream, around_in
from storage.checked_json import read_checked
from storage.durable import ASIDE, remove_stale_temporaries
from storage.intervals import CORRUPT, NO_END, Intervals, Losses
from storage.journal.journal import Journal
from storage.journal.segment import SUFFIX
from storage.journal.stream_notes import NOTES_FILE, StreamNotes
from storage.sessions.folder import Session


@dataclass
class OpenedStream:
    """Journal of one stream, opened after a crash.

    Attributes:
        journal: its frames.
        notes: its `stream.json`; None if there is none.
        damaged: frames that were stored and cannot be read any more.
        is_local: True: the stream is in its own node's folder.
    """

    journal: Journal
    notes: StreamNotes | None
    damaged: Intervals
    is_local: bool
    """True: the stream is in its own node's folder."""

    @property
    def lost(self) -> Losses:
        """Frames that cannot come any more, by reason."""
        lost = Losses(self.notes.lost if self.notes is not None else None)
        if self.is_local:
            lost.add(self.damaged, CORRUPT)
        lost.found(self.journal.held)
        return lost

    def for_session(self, session: Session) -> SessionStream:
        """Return the stream's facts for a session."""
        notes, lost = self.notes or StreamNotes(array_info=self.journal.info), self.lost
        rows = [row for row in session.clock if row.boot_id == self.journal.info.boot_id]
        measured_ns = rows[-1].server_minus_node_ns if rows else None
        return SessionStream(
            held=self.journal.held,
            lost=lost,
            damaged=self.damaged,
            may_come=Intervals(() if self.is_local else [(0, NO_END)]) - lost.all,
            next_seq=notes.next_seq,
            unsynced_tail_max=notes.unsynced_tail_max,
            missed_slots=notes.missed_slots,
            info=self.journal.info,
            journal=self.journal,
            around=partial(around_in, self.journal),
            offset_ns=0 if self.is_local else measured_ns,  # a node stops by its own clock
        )

    def note_losses(self) -> None:
        """Save the damage found: once cut off, no other record exists.

        On a server's folder these frames are not lost yet: the node may have them. Unreadable notes
        are replaced.

        Raises:
            StorageError: the disk is full or not writable.
        """
        notes = self.notes or StreamNotes(array_info=self.journal.info)
        if self.is_local:
            found: dict[str, object] = {"lost": self.lost.as_pairs()}
        else:
            found = {"damaged": tuple(self.damaged)}
        now = notes.model_copy(update=found)
        was_broken = self.notes is None and any(self.journal.folder.glob(NOTES_FILE + ASIDE + "*"))
        if now != notes or was_broken:
            self.notes = now
            self.notes.save(self.journal.folder)

    def disown_damaged(self, first: int, last: int) -> None:
        """Read the stored frames from `first` to `last`; frames with a wrong checksum are lost.

        Raises:
            StorageError: it cannot be read.
        """
        seq = first
        while seq <= last:
            try:
                for _ in self.journal.messages(seq, last):
                    pass
            except DamagedFramesError as error:
                damaged = Intervals([(error.seq_first, error.seq_last)])
                self.journal.disown(damaged)
                self.damaged = self.damaged | (damaged - self.journal.held)
                seq = error.seq_last + 1
            else:
                return


def open_streams(
    data: Path, tell: Callable[[str], None], *, is_local: bool
) -> tuple[dict[tuple[str, str], OpenedStream], list[str]]:
    """Open every journal of a data folder; this cuts off partial batches and syncs the rest.

    Args:
        data: the data folder.
        tell: called with a description of each step.
        is_local: True: a node's own folder.

    Returns:
        Streams by node and stream id, and failures as text.

    Raises:
        StorageError: the disk is full or not writable.
    """
    streams: dict[tuple[str, str], OpenedStream] = {}
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
            problems += journal.problems
            notes = StreamNotes.load_whole(folder, problems)
        except FileFormatError as error:
            problems.append(printable(f"journal {folder.parent.name}/{folder.name}: {error}"))
            continue
        stream = OpenedStream(journal, notes, journal.lost.all, is_local)
        stream.note_losses()
        streams[(folder.parent.name, folder.name)] = stream
    return streams, problems


def hello_of(data: Path, node: str) -> dict[str, Any]:
    """Read the node's last hello on the server's disk; empty if there is none."""
    try:
        content = json.loads(read_checked(data / "nodes" / node / "hello.json").text)
    except (OSError, ValueError, RecursionError):
        return {}
    return content if isinstance(content, dict) else {}
