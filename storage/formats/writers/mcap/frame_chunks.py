"""Input of message encoders: frames with instants and markers, and constants of the drawn foot."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from devices.frames import ArrayInfo
from storage.formats.export import Export
from storage.formats.writers.multi_session import get_instants_on_export_clock_ns
from storage.schema import COLUMNS_BY_NAME, SERVER_TIME_COLUMNS, Array

DRAWING_INTERVAL_NS = 50_000_000
"""Interval of drawings of the foot: enough for a screen, and drawings are most of the bytes."""
TILE_RADIUS_M, TILE_HEIGHT_M = 0.008, 0.006
ARROW_METRES_PER_NEWTON = 0.001
"""Length of the arrow of the GRF."""
SATURATED_COLOUR_N = 30.0
"""Force at which a tile's colour saturates."""

Message = tuple[int, int, bytes]
"""Message: instant in ns, number of the channel, content."""


class ChannelRegistry(Protocol):
    """Registry of schemas and channels, as in `mcap.writer.Writer`."""

    def register_schema(self, name: str, encoding: str, data: bytes) -> int:
        """Register a type of message; return its number."""

    def register_channel(
        self, topic: str, message_encoding: str, schema_id: int, metadata: dict[str, str]
    ) -> int:
        """Register a topic; return its number."""


class MessageEncoder(Protocol):
    """Encoder of one session's messages."""

    def encode_messages(self, frames: FrameChunk) -> Iterator[Message]:
        """Yield the encoded messages of a chunk of frames, in order."""


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


def to_floats_with_nan(quantity_name: str, values: Array) -> Array:
    """Return a column of any type as float64, NaN where unknown."""
    found = values.astype(np.float64)
    missing = COLUMNS_BY_NAME[quantity_name].missing_value
    if missing is not None:
        found[values == missing] = np.nan
    return found


def read_frame_chunks(export: Export, columns: list[str]) -> Iterator[FrameChunk]:
    """Read a session's frames in chunks, with these columns.

    Raises:
        UsageError: as for `Export.read_chunks`; the server's time of a frame is unknown.
    """
    requested = [
        *columns,
        "t_ns",
        *(["part"] if "part" in export.frame_source.quantity_names else []),
    ]
    requested += [column.name for column in SERVER_TIME_COLUMNS] if export.clock is not None else []
    requested += ["marker"] if export.markers is not None else []
    last_shown = -1
    for piece in export.read_chunks(requested):
        t_ns = get_instants_on_export_clock_ns(export, piece)
        turns = t_ns // DRAWING_INTERVAL_NS
        shown = np.flatnonzero(np.diff(turns, prepend=last_shown))
        last_shown = int(turns[-1]) if len(turns) else last_shown
        events = piece.get("marker", ())
        markers = [(row, text) for row, text in enumerate(events) if text is not None]
        bound_ns = piece.get(SERVER_TIME_COLUMNS[1].name)
        worst_ns = None if bound_ns is None else int(bound_ns.max(initial=0))
        yield FrameChunk(t_ns, piece, shown.tolist(), markers, worst_ns)


def compute_tile_colour(force_n: float) -> tuple[float, float, float, float]:
    """Return the colour of a tile: red, green, blue, opacity; grey for an unknown force."""
    if np.isnan(force_n):
        return 0.5, 0.5, 0.5, 0.5
    share = min(max(force_n / SATURATED_COLOUR_N, 0.0), 1.0)
    return 0.2 + 0.8 * share, 0.4 + 0.3 * share, 0.9 - 0.8 * share, 1.0


def get_foot_frame_id(info: ArrayInfo) -> str:
    """Return the name of the foot's coordinate frame."""
    return f"{info.node}_foot"
