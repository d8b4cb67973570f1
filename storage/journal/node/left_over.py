"""Crash recovery of a stream: its journal and notes, and its frames in flight."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

from devices.errors import DamagedFileError, FileFormatError
from storage.durable import put_aside
from storage.intervals import DISK_SLOW
from storage.journal.journal import Journal
from storage.journal.node.in_flight import IN_FLIGHT_FILE, kernel_boot_id, read_in_flight
from storage.journal.node.stream import NodeStream
from storage.journal.stream_notes import StreamNotes
from storage.wire import messages_of


def recover_stream(folder: Path, problems: list[str]) -> NodeStream | None:
    """Open an earlier process's stream with its frames in flight; None if there is none.

    Damaged files are set aside, with a message in `problems`.

    After a reboot the frames in flight are lost. The notes get an upper limit of their number:
    those since the last sync, by the slowest sync of this disk.

    Raises:
        FileFormatError: another version wrote its notes.
        StorageError: it cannot be read.
    """
    try:
        left = read_in_flight(folder)
    except DamagedFileError as error:
        left = None
        problems.append(put_aside(folder / IN_FLIGHT_FILE, error))
    stream = _open(folder, problems)
    if stream is None:
        if left is None:
            return None
        # Frames in flight are read only in the boot in which they were written.
        notes = StreamNotes(array_info=left[0], kernel_boot_id=kernel_boot_id())
        stream = NodeStream(folder, notes, None)
    if stream.has_ended:
        return stream
    if left is None:
        stream.end()
        stream.lose_in_flight()
        return stream
    frames = left[1]
    if frames is not None:
        held, first = stream.stored, int(frames.seq[0])
        # Frames older than all stored ones were evicted, not lost in flight.
        for a, b in held.missing(max(first, held.first or 0), int(frames.seq[-1])):
            # A gap before them: more frames waited for the disk than the file has rows.
            for batch in messages_of(frames.rows(a - first, b + 1 - first), stream.info):
                stream.put(batch, gap=DISK_SLOW)
    stream.end(unsynced_tail_max=0)
    return stream


def _open(folder: Path, problems: list[str]) -> NodeStream | None:
    """Open a stream on disk; None if none of it can be read.

    Raises:
        FileFormatError: another version wrote its notes.
        StorageError: it cannot be read.
    """
    notes = StreamNotes.load_whole(folder, problems)
    journal: Journal | None = None
    with suppress(FileFormatError):
        journal = Journal.open(folder)
        problems += journal.problems
    if notes is None and journal is not None:  # the segments have the array's description, too
        notes = StreamNotes(array_info=journal.info)
    return None if notes is None else NodeStream(folder, notes, journal)
