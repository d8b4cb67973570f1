"""MCAP writer: messages in the order of their instants, then the metadata of each session.

Metadata follow the messages because the largest bound of the server's time is known only then.
"""

from __future__ import annotations

import heapq
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from operator import itemgetter
from typing import TYPE_CHECKING

import numpy as np

from devices.errors import UsageError
from storage.formats.export import Export
from storage.formats.writers.format import (
    DrainedBuffer,
    ExportFormat,
    get_instants_on_export_clock_ns,
    make_names_unique,
    to_floats_with_nan,
)
from storage.schema import SERVER_TIME_COLUMNS, Array

if TYPE_CHECKING:
    from storage.formats.writers.mcap_messages import Message, MessageEncoder

DRAWING_INTERVAL_NS = 50_000_000
"""Interval of drawings of the foot: enough for a screen, and drawings are most of the bytes."""
ARROW_METRES_PER_NEWTON = 0.001
"""Length of the arrow of the GRF."""
SATURATED_COLOUR_N = 30.0
"""Force at which a tile's colour saturates."""


@dataclass(frozen=True)
class FrameChunk:
    """Chunk of a session's frames.

    Attributes:
        t_ns: int64[n], instants on the export's clock.
        columns: flat columns.
        drawn_rows: rows for which the foot is drawn.
        markers: row and label of each marker.
        uncertainty_ns: largest bound of the instants; None: instants of the node's clock.
    """

    t_ns: Array
    columns: Mapping[str, Array]
    drawn_rows: list[int]
    markers: list[tuple[int, str]]
    uncertainty_ns: int | None

    def stack_tile_columns(self, quantity_name: str, tile_count: int) -> Array:
        """Return one quantity of all tiles, (n, tiles), NaN where unknown."""
        columns = [
            to_floats_with_nan(quantity_name, self.columns[f"{quantity_name}_{i}"])
            for i in range(tile_count)
        ]
        return np.stack(columns, axis=1) if columns else np.empty((len(self.t_ns), 0))


class MessageTemplate:
    """Template of encoded messages whose numbers are replaced.

    Args:
        template: one encoded message.
        fields: numpy type and byte offset of each replaced number, by name.
    """

    def __init__(self, template: bytes, fields: Mapping[str, tuple[str, int]]) -> None:
        self._template = np.frombuffer(template, dtype=np.uint8)
        self._dtype = np.dtype(
            {
                "names": list(fields),
                "formats": [type_ for type_, _ in fields.values()],
                "offsets": [place for _, place in fields.values()],
                "itemsize": len(template),
            }
        )

    def encode_messages(self, values: Mapping[str, Array]) -> list[bytes]:
        """Return n encoded messages.

        Args:
            values: n numbers for each field, by name.
        """
        n, size = len(next(iter(values.values()))), len(self._template)
        content = np.tile(self._template, (n, 1))
        rows = content.view(self._dtype)[:, 0]
        for name in self._dtype.names or ():
            rows[name] = values[name]
            if rows[name].dtype.kind == "f":  # its sign depends on numpy's version and on n
                rows[name][np.isnan(rows[name])] = np.nan
        data = content.tobytes()
        return [data[begin : begin + size] for begin in range(0, n * size, size)]


def _read_frame_chunks(export: Export, columns: list[str]) -> Iterator[FrameChunk]:
    """Read a session's frames in chunks, with these columns.

    Raises:
        UsageError: as for `Export.read_chunks`; the server's time of a frame is unknown.
    """
    requested = [*columns, *export.instant_columns, *export.marker_columns]
    last_shown = -1
    for piece in export.read_chunks(requested):
        t_ns = get_instants_on_export_clock_ns(export, piece)
        shown, last_shown = find_drawn_rows(t_ns, last_shown)
        events = piece.get("marker", ())
        markers = [(row, text) for row, text in enumerate(events) if text is not None]
        bound_ns = piece.get(SERVER_TIME_COLUMNS[1].name)
        worst_ns = None if bound_ns is None else int(bound_ns.max(initial=0))
        yield FrameChunk(t_ns, piece, shown.tolist(), markers, worst_ns)


def find_drawn_rows(t_ns: Array, last_turn: int) -> tuple[Array, int]:
    """Return the rows for which the foot is drawn, and the turn of the last one.

    Args:
        t_ns: int64[n], instants of the frames.
        last_turn: turn of the last frame before them.
    """
    turns = t_ns // DRAWING_INTERVAL_NS
    rows = np.flatnonzero(np.diff(turns, prepend=last_turn))
    return rows, int(turns[-1]) if len(turns) else last_turn


_CHUNK_BYTES = 1 << 20
_DRAIN_EVERY = 1 << 10
"""Number of messages after which written bytes are yielded."""


def _encode(exports: Sequence[Export]) -> Iterator[bytes]:
    from mcap.writer import CompressionType, Writer

    from storage.formats.writers import mcap_messages

    is_ros2 = exports[0].options.messages == "ros2"
    if is_ros2 and exports[0].selection.columns:
        raise UsageError(
            "messages of ROS 2 have fixed fields, and no columns can be selected",
            remedy="Leave columns out, or ask for messages=foxglove",
        )
    kind = mcap_messages.Ros2Encoder if is_ros2 else mcap_messages.FoxgloveEncoder
    pieces = [_read_frame_chunks(export, kind.list_columns_to_read(export)) for export in exports]
    firsts = [next(frames) for frames in pieces]  # errors are raised before the first chunk
    sink = DrainedBuffer()
    writer = Writer(sink, chunk_size=_CHUNK_BYTES, compression=CompressionType.ZSTD)
    writer.start(profile="ros2" if is_ros2 else "", library=exports[0].array_info.software)
    prefixes = make_names_unique(
        [f"/{mcap_messages.make_ros2_name(export.array_info.node)}" for export in exports]
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
        **export.provenance_and_slice_metadata,
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
    group_encoder=_encode,
    options=("messages",),
    extra="mcap",
    packages=("mcap", "mcap_protobuf", "foxglove_schemas_protobuf", "rosbags"),
)
