"""Edges of a sync line beside the frames: in the metadata of their message, and in flight.

They travel in the message of the frames with which they were read, so its bytes are journaled,
sent, acknowledged and checked as one. Columns, and messages without edges, do not change.
"""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Annotated

import pyarrow as pa
from pydantic import Field, TypeAdapter

from devices.frames import Edge

EDGES_KEY = b"foottile.edges"
"""Key of a message's metadata: JSON, a list of [number, t_mono_ns, is_rising]."""
_EDGE = TypeAdapter(Edge)
_EDGES = TypeAdapter(Annotated[tuple[Edge, ...], Field(max_length=1 << 14)])
_END_OF_STREAM_BYTES = 8


def encode_record_batch(record: pa.RecordBatch, edges: Sequence[Edge]) -> bytes:
    """Encode a record batch as one message, with edges in its metadata if there are any."""
    if not edges:
        return record.serialize().to_pybytes()
    stream = pa.BufferOutputStream()
    with pa.ipc.new_stream(stream, record.schema) as writer:
        writer.write_batch(record, custom_metadata={EDGES_KEY: json.dumps(edges).encode()})
    begin = len(record.schema.serialize())
    return stream.getvalue().to_pybytes()[begin:-_END_OF_STREAM_BYTES]


def read_edges(message: bytes | memoryview, schema: pa.Schema) -> tuple[Edge, ...]:
    """Read the edges of a message whose layout was checked; none is the usual case.

    Raises:
        ValueError: no node writes such edges.
    """
    if EDGES_KEY not in bytes(message[: 8 + int.from_bytes(message[4:8], "little")]):
        return ()
    reader = pa.ipc.open_stream(schema.serialize().to_pybytes() + bytes(message))
    metadata = reader.read_next_batch_with_custom_metadata().custom_metadata
    return _EDGES.validate_json(metadata[EDGES_KEY] if metadata and EDGES_KEY in metadata else "[]")


_FILE, _OLDER_FILE = "edges_in_flight", "edges_in_flight.older"
_FILE_BYTES_MAX = 4 << 20
"""Length at which the file is begun anew: 40 s of as many edges as a node keeps."""


class EdgesInFlightWriter:
    """Writer of edges that may not be in the journal yet; the kernel keeps them after a kill.

    A full disk costs them this safety only: their message follows all the same.

    Args:
        folder: the stream's own, which exists.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._descriptor: int | None = None
        self._bytes = 0

    def write_edges(self, edges: Sequence[Edge]) -> None:
        """Append edges, each as a line."""
        content = "".join(f"{json.dumps(edge)}\n" for edge in edges).encode()
        with suppress(OSError):
            if self._bytes > _FILE_BYTES_MAX:
                self.close()
                os.replace(self._folder / _FILE, self._folder / _OLDER_FILE)
                self._bytes = 0
            if self._descriptor is None:
                flags = os.O_WRONLY | os.O_CREAT | os.O_APPEND
                self._descriptor = os.open(self._folder / _FILE, flags, 0o666)
            self._bytes += os.write(self._descriptor, content)

    def close(self) -> None:
        """Close the file without deleting it."""
        if self._descriptor is not None:
            os.close(self._descriptor)
            self._descriptor = None


def read_edges_in_flight(folder: Path) -> list[Edge]:
    """Read the edges that a killed process left; lines that are cut are skipped."""
    edges = []
    for name in (_OLDER_FILE, _FILE):
        with suppress(OSError):
            for line in (folder / name).read_bytes().splitlines():
                with suppress(ValueError):
                    edges.append(_EDGE.validate_json(line))
    return edges


def try_delete_edges_in_flight(folder: Path) -> None:
    """Delete the files of edges in flight, if they can be deleted."""
    for name in (_OLDER_FILE, _FILE):
        with suppress(OSError):
            (folder / name).unlink(missing_ok=True)
