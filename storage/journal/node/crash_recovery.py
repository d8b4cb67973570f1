"""Crash recovery of a stream: its journal and notes, and its frames in flight."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

from devices.errors import DamagedFileError, FileFormatError
from storage.durable_files import set_aside_and_describe
from storage.intervals import DISK_SLOW
from storage.journal.journal import Journal
from storage.journal.node.in_flight import (
    IN_FLIGHT_FILE,
    read_in_flight_of_this_boot,
    read_kernel_boot_id,
)
from storage.journal.node.stream import NodeStream
from storage.journal.stream_notes import StreamNotes
from storage.wire import encode_as_messages


def recover_ended_stream(folder: Path, problems: list[str]) -> NodeStream | None:
    """Open an earlier process's stream as ended, its frames in flight queued; or None.

    Damaged files are set aside, with a message in `problems`.

    After a reboot the frames in flight are lost. The notes get an upper limit of their number:
    those since the last sync, by the slowest sync of this disk.

    Raises:
        FileFormatError: another version wrote its notes.
        StorageError: it cannot be read.
    """
    try:
        left = read_in_flight_of_this_boot(folder)
    except DamagedFileError as error:
        left = None
        problems.append(set_aside_and_describe(folder / IN_FLIGHT_FILE, error))
    stream = _open_stream(folder, problems)
    if stream is None:
        if left is None:
            return None
        # Frames in flight are read only in the boot in which they were written.
        notes = StreamNotes(array_info=left.array_info, kernel_boot_id=read_kernel_boot_id())
        stream = NodeStream(folder, notes, None)
    if stream.has_ended:
        return stream
    if left is None:
        stream.mark_ended_in_memory()
        stream.set_max_lost_tail_in_memory()
        return stream
    frames = left.frames
    if frames is not None:
        held, first = stream.stored, int(frames.seq[0])
        # Frames older than all stored ones were evicted, not lost in flight.
        for a, b in held.missing_in(max(first, held.first or 0), int(frames.seq[-1])):
            # A gap before them: more frames waited for the disk than the file has rows.
            for batch in encode_as_messages(
                frames.slice_rows(a - first, b + 1 - first), stream.info
            ):
                stream.queue_batch_and_record_gap(batch, gap_reason=DISK_SLOW)
    stream.mark_ended_in_memory(max_lost_tail_frames=0)
    return stream


def _open_stream(folder: Path, problems: list[str]) -> NodeStream | None:
    """Open a stream on disk; None if nothing of it can be read.

    Raises:
        FileFormatError: another version wrote its notes.
        StorageError: it cannot be read.
    """
    notes = StreamNotes.load_or_set_aside(folder, problems)
    journal: Journal | None = None
    with suppress(FileFormatError):
        journal = Journal.open_and_recover(folder)
        problems += journal.problems
    if notes is None and journal is not None:  # the segments have the array's description, too
        notes = StreamNotes(array_info=journal.info)
    return None if notes is None else NodeStream(folder, notes, journal)
