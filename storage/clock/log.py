"""Log of one stream's clock measurements: `clock.jsonl` in its journal folder.

One JSON object a line, each with its own CRC-32. Lines are only appended; a torn end, as after a
power cut, is cut off before the next append. A damaged line is skipped:
every row only narrows the bounds of the offset, so without it they are wider, and still right.
"""

from __future__ import annotations

import json
import os
import zlib
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from pydantic import BaseModel, ConfigDict, ValidationError

from devices.errors import DamagedFileError, StorageError
from storage.durable_files import (
    make_synced_folder,
    raise_if_locked_folder_gone,
    read_small_file,
    sync_folder,
    translate_storage_errors,
)

CLOCK_LOG_NAME = "clock.jsonl"
_BYTES_MAX = 1 << 30
"""Upper limit of a log: a stream of two years."""
_WINDOW = 1024
"""First window in bytes for the search of the last whole line: some lines."""


@dataclass(frozen=True)
class ClockLogContent:
    """Content of a log.

    Attributes:
        rows: rows of whole lines, in the order of the file.
        damaged_lines: number of other lines before the last whole one.
        is_torn: True: the log ends with an incomplete line, as after a power cut or during a write.
    """

    rows: tuple[ClockOffset, ...] = ()
    damaged_lines: int = 0
    is_torn: bool = False


class ClockLog:
    """Clock measurements of one stream on disk. One thread appends; any may read or sync.

    No file is open and no row in memory between calls.

    Args:
        folder: the stream's own; created with the first row.
    """

    def __init__(self, folder: Path) -> None:
        self.path = folder / CLOCK_LOG_NAME

    def append(self, row: ClockOffset) -> None:
        """Append a row, after cutting off a torn end; it is on the disk after `sync`.

        Raises:
            StorageError: the disk is full or not writable. Earlier rows are untouched.
        """
        raise_if_locked_folder_gone(self.path)
        with translate_storage_errors(self.path):
            if not self.path.parent.is_dir():
                make_synced_folder(self.path.parent)
            descriptor = os.open(self.path, os.O_RDWR | os.O_APPEND | os.O_CREAT, 0o666)
            try:
                size = os.fstat(descriptor).st_size
                end = _find_valid_end(descriptor, size)
                if end < size:
                    os.ftruncate(descriptor, end)
                try:
                    _write_all(descriptor, _encode_line(row))
                except OSError:
                    with suppress(OSError):
                        os.ftruncate(descriptor, end)
                    raise
            finally:
                os.close(descriptor)

    def sync(self) -> None:
        """Return when all earlier rows are on the disk; may run in another thread.

        Raises:
            StorageError: the disk refused.
        """
        with translate_storage_errors(self.path):
            try:
                descriptor = os.open(self.path, os.O_RDONLY)
            except FileNotFoundError:  # not one row yet
                return
            try:
                os.fsync(descriptor)
            finally:
                os.close(descriptor)
            sync_folder(self.path.parent)

    def read_undamaged_rows(self) -> tuple[ClockOffset, ...]:
        """Read all readable rows in the order of the file; empty if there is no log.

        Raises:
            StorageError: the log cannot be read.
        """
        return self.read_rows_and_damage().rows

    def read_rows_and_damage(self) -> ClockLogContent:
        """Read the rows, with the number of damaged lines and whether the end is torn.

        Raises:
            StorageError: the log cannot be read.
        """
        try:
            content = read_small_file(self.path, max_bytes=_BYTES_MAX)
        except FileNotFoundError:
            return ClockLogContent()
        except DamagedFileError as error:
            raise StorageError(error.what, where=error.where) from error
        *lines, rest = content.split(b"\n")
        read = [_parse_line(line) for line in lines]
        is_torn = bool(rest)
        while read and read[-1] is None:
            is_torn = True
            read.pop()
        rows = tuple(row for row in read if row is not None)
        return ClockLogContent(rows, damaged_lines=len(read) - len(rows), is_torn=is_torn)


def _find_valid_end(descriptor: int, size: int) -> int:
    """Return the offset behind the last whole line; reads no further back than that.

    If no line is whole, only an unterminated last line is cut.
    """
    window = _WINDOW
    while True:
        begin = max(0, size - window)
        content = os.pread(descriptor, size - begin, begin)
        first = 0 if begin == 0 else content.find(b"\n") + 1
        end = content.rfind(b"\n") + 1
        while end > first:
            start = content.rfind(b"\n", first, end - 1) + 1 or first
            if _parse_line(content[start : end - 1]) is not None:
                return begin + end
            end = start
        if begin == 0:
            return content.rfind(b"\n") + 1
        window *= 16


def _encode_line(row: ClockOffset) -> bytes:
    content = row.model_dump()
    text = json.dumps(content)
    return json.dumps({**content, "crc32": f"{zlib.crc32(text.encode()):08x}"}).encode() + b"\n"


def _parse_line(line: bytes) -> ClockOffset | None:
    try:
        content = json.loads(line)
        del content["crc32"]
        row = ClockOffset.model_validate(content)
    except (ValueError, ValidationError, TypeError, KeyError, RecursionError):
        return None
    # The checksum is not enough: a line of equal content in another spelling was edited.
    return row if _encode_line(row) == line + b"\n" else None


def _write_all(descriptor: int, data: bytes) -> None:
    view = memoryview(data)
    while view:
        view = view[os.write(descriptor, view) :]


class ClockOffset(BaseModel):
    """Measured offset of the server's UTC to the `t_ns` of a stream, at one instant."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    stream_id: str
    t_mono_ns: int
    server_minus_node_ns: int
    uncertainty_ns: int
    """Bound of the error, plus or minus: half the probe's round trip."""
