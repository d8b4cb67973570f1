"""Streams of a data folder without a running process: every journal opened and mended."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from devices.errors import DamagedFramesError, FileFormatError
from devices.text import escape_control_chars
from service.sessions.part_end import SeqsAround, SessionStream, find_seqs_around
from storage.checksummed_json import read_checksummed_json
from storage.durable_files import ASIDE_SUFFIX, remove_dead_process_temporaries
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
        is_node_folder: True: the stream is in its own node's folder.
    """

    journal: Journal
    notes: StreamNotes | None
    damaged: Intervals
    is_node_folder: bool
    """True: the stream is in its own node's folder."""

    @property
    def lost(self) -> Losses:
        """Frames that cannot come any more, by reason."""
        lost = Losses(self.notes.lost if self.notes is not None else None)
        if self.is_node_folder:
            lost.add_if_new(self.damaged, CORRUPT)
        lost.remove(self.journal.stored)
        return lost

    def make_session_stream(self, session: Session) -> SessionStream:
        """Return the stream's facts for a session."""
        notes, lost = self.notes or StreamNotes(array_info=self.journal.info), self.lost
        rows = [row for row in session.clock if row.stream_id == self.journal.info.stream_id]
        measured_ns = rows[-1].server_minus_node_ns if rows else None
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
            find_seqs_around=self._find_seqs_around,
            offset_ns=0 if self.is_node_folder else measured_ns,  # a node stops by its own clock
        )

    def _find_seqs_around(
        self, t_ns: int, *, min_seq: int, may_be_stale: bool = False
    ) -> SeqsAround | None:
        del may_be_stale  # nothing is cached here
        return find_seqs_around(self.journal, t_ns, min_seq=min_seq)

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
                self.journal.invalidate_whole_batches(damaged)
                self.damaged = self.damaged | (damaged - self.journal.stored)
                seq = error.seq_last + 1
            else:
                return


class MendedStreams(NamedTuple):
    """Streams by node and stream id, and failures as text."""

    streams: dict[tuple[str, str], OpenedStream]
    problems: list[str]


def open_and_mend_streams(
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
            journal = Journal.open_and_recover(folder)
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


def read_hello_or_empty(data: Path, node: str) -> dict[str, Any]:
    """Read the node's last hello on the server's disk; empty if it is missing or unreadable."""
    try:
        content = json.loads(read_checksummed_json(data / "nodes" / node / "hello.json"))
    except (OSError, ValueError, RecursionError):
        return {}
    return content if isinstance(content, dict) else {}
