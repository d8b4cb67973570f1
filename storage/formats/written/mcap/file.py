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
from storage.formats.written.format import Format
from storage.formats.written.mcap.source import (
    FULL_COLOUR_N,
    METRES_PER_NEWTON,
    SHOWN_NS,
    Frames,
    Message,
    Vocabulary,
    frames_of,
)
from storage.formats.written.sink import Sink
from storage.formats.written.together import distinct

_CHUNK = 1 << 20
_LOOK_EVERY = 1 << 10
"""Number of messages after which written bytes are yielded."""


def _write(export: Export) -> Iterator[bytes]:
    return _write_together([export])


def _write_together(exports: Sequence[Export]) -> Iterator[bytes]:
    from mcap.writer import CompressionType, Writer

    from storage.formats.written.mcap import foxglove, ros2

    is_ros2 = exports[0].options.messages == "ros2"
    if is_ros2 and exports[0].part.columns:
        raise UsageError(
            "messages of ROS 2 have fixed fields, and no columns can be selected",
            remedy="Leave columns out, or ask for messages=foxglove",
        )
    needed = ros2.needed if is_ros2 else foxglove.needed
    pieces = [frames_of(export, needed(export)) for export in exports]
    firsts = [next(frames) for frames in pieces]  # errors are raised before the first chunk
    sink = Sink()
    writer = Writer(sink, chunk_size=_CHUNK, compression=CompressionType.ZSTD)
    writer.start(profile="ros2" if is_ros2 else "", library=exports[0].info.software)
    kind = ros2.Ros2Messages if is_ros2 else foxglove.FoxgloveMessages
    prefixes = distinct([f"/{ros2.name_of(export.info.node)}" for export in exports])
    sessions = [
        _Session(prefix, export, kind(writer, export, prefix), chain((first,), frames))
        for prefix, export, first, frames in zip(prefixes, exports, firsts, pieces, strict=True)
    ]
    merged = heapq.merge(*(session.messages() for session in sessions), key=itemgetter(0))
    for number, (at_ns, channel, content) in enumerate(merged):
        writer.add_message(channel, at_ns, content, at_ns)
        if number % _LOOK_EVERY == 0 and (written := sink.taken()):
            yield written
    for session in sessions:
        name = "foottile" if len(sessions) == 1 else f"foottile{session.prefix}"
        writer.add_metadata(name, _said(session, is_ros2=is_ros2))
    writer.finish()  # type: ignore[no-untyped-call]  # of the library
    yield sink.taken()


@dataclass
class _Session:
    """Session in the file.

    Attributes:
        prefix: prefix of its topics.
        export: export of the session.
        vocabulary: encoder of its messages.
        pieces: chunks of its frames, in order.
        uncertainty_ns: largest bound of the instants up to now; None: instants of the node's clock.
    """

    prefix: str
    export: Export
    vocabulary: Vocabulary
    pieces: Iterator[Frames]
    uncertainty_ns: int | None = None

    def messages(self) -> Iterator[Message]:
        """Yield all messages of the session; update the largest bound of the instants."""
        for frames in self.pieces:
            if frames.uncertainty_ns is not None:
                self.uncertainty_ns = max(self.uncertainty_ns or 0, frames.uncertainty_ns)
            yield from self.vocabulary.messages(frames)


def _said(session: _Session, *, is_ros2: bool) -> dict[str, str]:
    """Return the metadata of a session; values that are no text are JSON."""
    export = session.export
    clock = "the node's" if export.clock is None else "the server's"
    facts = {
        **export.about,
        "log_time": f"log time and publish time are the instant of the frame by {clock} clock",
        "log_time_uncertainty_ns": session.uncertainty_ns,
        "topics": f"{session.prefix}/",
        "foot": f"drawn every {SHOWN_NS // 1_000_000} ms; tiles in full colour from "
        f"{FULL_COLOUR_N:g} N on, the arrow {METRES_PER_NEWTON:g} m for each newton",
        "serials": [tile.serial for tile in export.info.tiles],
        "array_info": export.info.model_dump(mode="json"),
        "notes": export.all_notes,
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


MCAP = Format(
    "mcap",
    "MCAP",
    "Foxglove, PlotJuggler, ros2 bag play",
    "application/mcap",
    _write,
    write_together=_write_together,
    options=("messages",),
    extra="mcap",
    packages=("mcap", "mcap_protobuf", "foxglove_schemas_protobuf", "rosbags"),
)
