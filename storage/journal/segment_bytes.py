"""What stands in a segment itself: the schema message, then batches; read without writing."""

from __future__ import annotations

import os
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pyarrow as pa

from devices.errors import FileFormatError
from storage.wire import EncodedBatch, decode


def read_header(path: Path) -> tuple[pa.Schema | None, int]:
    """Schema of a segment, and where its first batch begins; None and 0 without a whole one.

    Raises:
        OSError: there is no such file.
    """
    with pa.OSFile(str(path), "r") as file:
        try:
            return pa.ipc.read_schema(pa.ipc.read_message(file)), file.tell()
        except (pa.ArrowException, EOFError, OSError):
            return None, 0


def messages_from(path: Path, begin: int, schema: pa.Schema) -> Iterator[EncodedBatch]:
    """Batches that follow one another from a place on, up to what is no whole batch.

    Raises:
        OSError: there is no such file.
    """
    with pa.OSFile(str(path), "r") as file:
        while True:
            try:
                file.seek(begin)
                pa.ipc.read_message(file)
                payload = os.pread(file.fileno(), file.tell() - begin, begin)
                message = EncodedBatch.of(decode(payload, schema), payload)
            except (pa.ArrowException, EOFError, OSError, FileFormatError):
                return
            yield message
            begin += len(payload)


def payload_of(descriptor: int, record: Any) -> bytes | None:
    """A batch's bytes from an open segment; None if they are not the ones that were written.

    Args:
        descriptor: the segment.
        record: of the batch, in the index.

    Raises:
        OSError: they cannot be read.
    """
    payload = os.pread(descriptor, int(record["length"]), int(record["offset"]))
    whole = len(payload) == record["length"] and zlib.crc32(payload) == record["crc32"]
    return payload if whole else None
