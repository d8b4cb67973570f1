"""One file of a journal: a schema message, then batches, each as the bytes in which it came."""

from __future__ import annotations

import os
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

import pyarrow as pa

from devices.errors import FileFormatError
from storage.intervals import Intervals
from storage.wire import decode

SUFFIX = ".arrows"
UNREAD_SUFFIX = ".unread"


@dataclass(frozen=True, order=True)
class Entry:
    """One batch in a segment."""

    seq_first: int
    seq_last: int
    t_ns_first: int
    t_ns_last: int
    offset: int
    length: int

    @property
    def frames(self) -> int:
        """How many there are in it."""
        return self.seq_last - self.seq_first + 1


@dataclass
class Segment:
    """A file and what is in it, in the order it was appended."""

    path: Path
    entries: list[Entry] = field(default_factory=list)

    @property
    def t_ns_last(self) -> int:
        """Instant of its newest frame, in the node's UTC."""
        return max((entry.t_ns_last for entry in self.entries), default=0)

    def holds_any(self, wanted: Intervals) -> bool:
        """Is any of these numbers in it?"""
        return any(wanted.within(e.seq_first, e.seq_last) for e in self.entries)


def recover(path: Path, schema: pa.Schema) -> Segment | None:
    """Index a file that is there; None if there is no whole batch in it, and it is gone then.

    What is no whole message is set aside in a file beside it, not thrown away: most often it is a
    message that was cut, but it may be more.

    Raises:
        OSError: it cannot be read, or not cut.
    """
    segment = Segment(path)
    size = path.stat().st_size
    with pa.OSFile(str(path), "r") as arrow_file:
        try:
            pa.ipc.read_schema(pa.ipc.read_message(arrow_file))
        except (pa.ArrowException, EOFError, OSError):
            path.unlink()  # not even its schema was written
            return None
        end = arrow_file.tell()
        while end < size:
            try:
                pa.ipc.read_message(arrow_file)
                length = arrow_file.tell() - end
                payload = os.pread(arrow_file.fileno(), length, end)
                batch = decode(payload, schema)
            except (pa.ArrowException, EOFError, OSError, FileFormatError):
                break
            segment.entries.append(
                Entry(
                    int(batch.seq[0]),
                    int(batch.seq[-1]),
                    int(batch.t_ns[0]),
                    int(batch.t_ns[-1]),
                    end,
                    length,
                )
            )
            end += length
    if end < size:
        with path.open("rb") as file:
            file.seek(end)
            path.with_suffix(UNREAD_SUFFIX).write_bytes(file.read())
        os.truncate(path, end)
    if not segment.entries:
        path.unlink()
        return None
    # A killed process leaves frames that only the kernel holds; from now on they are promised.
    with path.open("rb") as file:
        os.fsync(file.fileno())
    return segment


def write_all(file: BinaryIO, data: bytes) -> None:
    """Write all of `data`, or leave the file as long as it was."""
    begin = file.tell()
    view = memoryview(data)
    try:
        while view:
            view = view[file.write(view) :]
    except OSError:
        with suppress(OSError):
            file.truncate(begin)
            file.seek(begin)
        raise
