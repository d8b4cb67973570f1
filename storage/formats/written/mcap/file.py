"""Writes an MCAP file: messages in the order of their frames, and what is said of the session."""

from __future__ import annotations

import json
from collections.abc import Iterator
from itertools import chain

from devices.errors import UsageError
from storage.formats.export import Export
from storage.formats.written.format import Format
from storage.formats.written.mcap.source import (
    FULL_COLOUR_N,
    METRES_PER_NEWTON,
    SHOWN_NS,
    frames_of,
)
from storage.formats.written.sink import Sink

_CHUNK = 1 << 20


def _write(export: Export) -> Iterator[bytes]:
    from mcap.writer import CompressionType, Writer

    from storage.formats.written.mcap import foxglove, ros2

    is_ros2 = export.options.messages == "ros2"
    if is_ros2 and export.part.columns:
        raise UsageError(
            "messages of ROS 2 have fields of their own, and no columns can be chosen",
            remedy="Leave columns out, or ask for messages=foxglove",
        )
    needed = ros2.needed(export) if is_ros2 else foxglove.needed(export)
    frames = frames_of(export, needed)
    first = next(frames)  # what is wrong is said before anything is given away
    sink = Sink()
    writer = Writer(sink, chunk_size=_CHUNK, compression=CompressionType.ZSTD)
    writer.start(profile="ros2" if is_ros2 else "", library=export.info.software)
    kind = ros2.Ros2Messages if is_ros2 else foxglove.FoxgloveMessages
    vocabulary = kind(writer, export, f"/{ros2.name_of(export.info.node)}")
    writer.add_metadata("foottile", _said(export, is_ros2=is_ros2))
    for piece in chain((first,), frames):
        for at_ns, channel, content in vocabulary.messages(piece):
            writer.add_message(channel, at_ns, content, at_ns)
        if content := sink.taken():
            yield content
    writer.finish()  # type: ignore[no-untyped-call]  # of the library
    yield sink.taken()


def _said(export: Export, *, is_ros2: bool) -> dict[str, str]:
    """What the file says of itself; values that are no text are JSON."""
    clock = "the node's" if export.clock is None else "the server's"
    facts = {
        **export.about,
        "log_time": f"log time and publish time are the instant of the frame by {clock} clock",
        "foot": f"drawn every {SHOWN_NS // 1_000_000} ms; tiles in full colour from "
        f"{FULL_COLOUR_N:g} N on, the arrow {METRES_PER_NEWTON:g} m for each newton",
        "node": export.info.node,
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
    options=("messages",),
    extra="mcap",
    packages=("mcap", "mcap_protobuf", "foxglove_schemas_protobuf", "rosbags"),
)
