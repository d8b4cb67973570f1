"""MCAP writer: messages in the order of their instants, then the metadata of each session.

Metadata follow the messages because the largest bound of the server's time is known only then.
"""

from __future__ import annotations

import heapq
import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import chain
from operator import itemgetter

from devices.errors import UsageError
from storage.formats.export import Export
from storage.formats.writers.drained_buffer import DrainedBuffer
from storage.formats.writers.format import ExportFormat
from storage.formats.writers.mcap.frame_chunks import (
    ARROW_METRES_PER_NEWTON,
    DRAWING_INTERVAL_NS,
    SATURATED_COLOUR_N,
    FrameChunk,
    Message,
    MessageEncoder,
    read_frame_chunks,
)
from storage.formats.writers.multi_session import make_names_unique

_CHUNK_BYTES = 1 << 20
_DRAIN_EVERY = 1 << 10
"""Number of messages after which written bytes are yielded."""


def _encode(export: Export) -> Iterator[bytes]:
    return _encode_together([export])


def _encode_together(exports: Sequence[Export]) -> Iterator[bytes]:
    from mcap.writer import CompressionType, Writer

    from storage.formats.writers.mcap import foxglove, ros2

    is_ros2 = exports[0].options.messages == "ros2"
    if is_ros2 and exports[0].selection.columns:
        raise UsageError(
            "messages of ROS 2 have fixed fields, and no columns can be selected",
            remedy="Leave columns out, or ask for messages=foxglove",
        )
    needed = ros2.list_ros2_columns if is_ros2 else foxglove.list_foxglove_columns
    pieces = [read_frame_chunks(export, needed(export)) for export in exports]
    firsts = [next(frames) for frames in pieces]  # errors are raised before the first chunk
    sink = DrainedBuffer()
    writer = Writer(sink, chunk_size=_CHUNK_BYTES, compression=CompressionType.ZSTD)
    writer.start(profile="ros2" if is_ros2 else "", library=exports[0].array_info.software)
    kind = ros2.Ros2Encoder if is_ros2 else foxglove.FoxgloveEncoder
    prefixes = make_names_unique(
        [f"/{ros2.make_ros2_name(export.array_info.node)}" for export in exports]
    )
    sessions = [
        _ExportedSession(prefix, export, kind(writer, export, prefix), chain((first,), frames))
        for prefix, export, first, frames in zip(prefixes, exports, firsts, pieces, strict=True)
    ]
    merged = heapq.merge(*(session.encode_messages() for session in sessions), key=itemgetter(0))
    for number, (at_ns, channel, content) in enumerate(merged):
        writer.add_message(channel, at_ns, content, at_ns)
        if number % _DRAIN_EVERY == 0 and (written := sink.drain()):
            yield written
    for session in sessions:
        name = "foottile" if len(sessions) == 1 else f"foottile{session.topic_prefix}"
        writer.add_metadata(name, _metadata_texts(session, is_ros2=is_ros2))
    writer.finish()  # type: ignore[no-untyped-call]  # of the library
    yield sink.drain()


@dataclass
class _ExportedSession:
    """Session in the file.

    Attributes:
        topic_prefix: prefix of its topics.
        export: export of the session.
        encoder: encoder of its messages.
        frame_chunks: chunks of its frames, in order.
        uncertainty_ns: largest bound of the instants up to now; None: instants of the node's clock.
    """

    topic_prefix: str
    export: Export
    encoder: MessageEncoder
    frame_chunks: Iterator[FrameChunk]
    uncertainty_ns: int | None = None

    def encode_messages(self) -> Iterator[Message]:
        """Yield all messages of the session; update the largest bound of the instants."""
        for frames in self.frame_chunks:
            if frames.uncertainty_ns is not None:
                self.uncertainty_ns = max(self.uncertainty_ns or 0, frames.uncertainty_ns)
            yield from self.encoder.encode_messages(frames)


def _metadata_texts(session: _ExportedSession, *, is_ros2: bool) -> dict[str, str]:
    """Return the metadata of a session; values that are no text are JSON."""
    export = session.export
    clock = "the node's" if export.clock is None else "the server's"
    facts = {
        **export.metadata,
        "log_time": f"log time and publish time are the instant of the frame by {clock} clock",
        "log_time_uncertainty_ns": session.uncertainty_ns,
        "topics": f"{session.topic_prefix}/",
        "foot": f"drawn every {DRAWING_INTERVAL_NS // 1_000_000} ms; tiles in full colour from "
        f"{SATURATED_COLOUR_N:g} N on, the arrow {ARROW_METRES_PER_NEWTON:g} m for each newton",
        "serials": [tile.serial for tile in export.array_info.tiles],
        "array_info": export.array_info.model_dump(mode="json"),
        "notes": export.notes_with_clock_and_markers,
    }
    if is_ros2:
        facts["filled"] = (
            "Absolute pressure uses the chip's last temperature, of the last second, in frames "
            "that did not read it; else nothing"
        )
    return {
        name: value if isinstance(value, str) else json.dumps(value)
        for name, value in facts.items()
    }


MCAP = ExportFormat(
    "mcap",
    "MCAP",
    "Foxglove, PlotJuggler, ros2 bag play",
    "application/mcap",
    _encode,
    group_encoder=_encode_together,
    options=("messages",),
    extra="mcap",
    packages=("mcap", "mcap_protobuf", "foxglove_schemas_protobuf", "rosbags"),
)
