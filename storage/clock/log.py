"""The measurements of one stream's clock as they come: `clock.jsonl` in its journal folder.

One JSON object a line, each with a CRC-32 of its own. A line is only ever appended: a torn last one
is closed before the next, and a line that is not to the letter what was written is skipped.
"""

from __future__ import annotations

import json
import os
import zlib
from contextlib import suppress
from pathlib import Path

from pydantic import BaseModel, ConfigDict, ValidationError

from devices.errors import StorageError
from storage.durable import check_held, make_folder, storage_errors, sync_folder

NAME = "clock.jsonl"


class ClockLog:
    """The clock rows of one stream. One thread appends; any may read or sync meanwhile.

    Nothing is kept open or in memory between calls.

    Args:
        folder: the stream's own; made at the first row if absent.
    """

    def __init__(self, folder: Path) -> None:
        self.path = folder / NAME

    def append(self, row: ClockOffset) -> None:
        """Add a row, at the same cost however many there are; on the disk after `sync`.

        Raises:
            StorageError: the disk is full or not writable. Earlier rows are untouched.
        """
        check_held(self.path)
        with storage_errors(self.path):
            if not self.path.parent.is_dir():
                make_folder(self.path.parent)
            descriptor = os.open(self.path, os.O_RDWR | os.O_APPEND | os.O_CREAT, 0o666)
            try:
                end = os.fstat(descriptor).st_size
                torn = end > 0 and os.pread(descriptor, 1, end - 1) != b"\n"
                try:
                    _write(descriptor, b"\n" * torn + _line(row))
                except OSError:
                    with suppress(OSError):
                        os.ftruncate(descriptor, end)
                    raise
            finally:
                os.close(descriptor)

    def sync(self) -> None:
        """Return when every row appended before is on the disk; may run in another thread.

        Raises:
            StorageError: the disk refused.
        """
        with storage_errors(self.path):
            try:
                descriptor = os.open(self.path, os.O_RDONLY)
            except FileNotFoundError:  # not one row yet
                return
            try:
                os.fsync(descriptor)
            finally:
                os.close(descriptor)
            sync_folder(self.path.parent)

    def rows(self) -> tuple[ClockOffset, ...]:
        """All rows that can be read, in the order they came; none if there is no log.

        Raises:
            StorageError: it is there and cannot be read.
        """
        try:
            content = self.path.read_bytes()
        except FileNotFoundError:
            return ()
        except OSError as error:
            raise StorageError(f"cannot be read: {error}", where=str(self.path)) from error
        read = (_row(line) for line in content.split(b"\n"))
        return tuple(row for row in read if row is not None)


def _line(row: ClockOffset) -> bytes:
    content = row.model_dump()
    text = json.dumps(content)
    return json.dumps({**content, "crc32": f"{zlib.crc32(text.encode()):08x}"}).encode() + b"\n"


def _row(line: bytes) -> ClockOffset | None:
    try:
        content = json.loads(line)
        del content["crc32"]
        row = ClockOffset.model_validate(content)
    except (ValueError, ValidationError, TypeError, KeyError, RecursionError):
        return None
    # The checksum is not enough: a line that parses alike but is spelt differently was edited.
    return row if _line(row) == line + b"\n" else None


def _write(descriptor: int, data: bytes) -> None:
    view = memoryview(data)
    while view:
        view = view[os.write(descriptor, view) :]


class ClockOffset(BaseModel):
    """How far the server's UTC was from the `t_ns` of a stream, at one instant."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    boot_id: str
    t_mono_ns: int
    server_minus_node_ns: int
    uncertainty_ns: int
    """The truth is within plus or minus this: half the probe's round trip."""
