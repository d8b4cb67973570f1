"""Input of message encoders: frames with instants and markers, and constants of the drawn foot."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from devices.frames import ArrayInfo
from storage.formats.export import Export
from storage.formats.written.together import instants_of
from storage.schema import KNOWN, SERVER_TIME, Array

SHOWN_NS = 50_000_000
"""Interval of drawings of the foot: enough for a screen, and drawings are most of the bytes."""
TILE_RADIUS_M, TILE_HEIGHT_M = 0.008, 0.006
METRES_PER_NEWTON = 0.001
"""Length of the arrow of the GRF."""
FULL_COLOUR_N = 30.0
"""Force at which a tile's colour saturates."""

Message = tuple[int, int, bytes]
"""Message: instant in ns, number of the channel, content."""


class Channels(Protocol):
    """Registry of schemas and channels, as in `mcap.writer.Writer`."""

    def register_schema(self, name: str, encoding: str, data: bytes) -> int:
        """Register a type of message; return its number."""

    def register_channel(
        self, topic: str, message_encoding: str, schema_id: int, metadata: dict[str, str]
    ) -> int:
        """Register a topic; return its number."""


class Vocabulary(Protocol):
    """Encoder of one session's messages."""

    def messages(self, frames: Frames) -> Iterator[Message]:
        """Yield the encoded messages of a chunk of frames, in order."""


@dataclass(frozen=True)
class Frames:
    """Chunk of a session's frames.

    Attributes:
        t_ns: int64[n], instants on the export's clock.
        flat: flat columns.
        shown: rows for which the foot is drawn.
        marks: row and label of each marker.
        uncertainty_ns: largest bound of the instants; None: instants of the node's clock.
    """

    t_ns: Array
    flat: Mapping[str, Array]
    shown: list[int]
    marks: list[tuple[int, str]]
    uncertainty_ns: int | None

    def tiles(self, name: str, count: int) -> Array:
        """Return one quantity of all tiles, (n, tiles), NaN where unknown."""
        columns = [numbers(name, self.flat[f"{name}_{i}"]) for i in range(count)]
        return np.stack(columns, axis=1) if columns else np.empty((len(self.t_ns), 0))


def numbers(name: str, values: Array) -> Array:
    """Return a column of any type as float64, NaN where unknown."""
    found = values.astype(np.float64)
    missing = KNOWN[name].missing
    if missing is not None:
        found[values == missing] = np.nan
    return found


def frames_of(export: Export, columns: list[str]) -> Iterator[Frames]:
    """Read a session's frames in chunks, with these columns.

    Raises:
        UsageError: as for `Export.pieces`; the server's time of a frame is unknown.
    """
    asked = [*columns, "t_ns", *(["part"] if "part" in export.content.names else [])]
    asked += [column.name for column in SERVER_TIME] if export.clock is not None else []
    asked += ["event"] if export.marks is not None else []
    last_shown = -1
    for piece in export.pieces(asked):
        t_ns = instants_of(export, piece)
        turns = t_ns // SHOWN_NS
        shown = np.flatnonzero(np.diff(turns, prepend=last_shown))
        last_shown = int(turns[-1]) if len(turns) else last_shown
        events = piece.get("event", ())
        marks = [(row, text) for row, text in enumerate(events) if text is not None]
        bound_ns = piece.get(SERVER_TIME[1].name)
        worst_ns = None if bound_ns is None else int(bound_ns.max(initial=0))
        yield Frames(t_ns, piece, shown.tolist(), marks, worst_ns)


def colour(force_n: float) -> tuple[float, float, float, float]:
    """Return the colour of a tile: red, green, blue, opacity; grey for an unknown force."""
    if np.isnan(force_n):
        return 0.5, 0.5, 0.5, 0.5
    share = min(max(force_n / FULL_COLOUR_N, 0.0), 1.0)
    return 0.2 + 0.8 * share, 0.4 + 0.3 * share, 0.9 - 0.8 * share, 1.0


def frame_id(info: ArrayInfo) -> str:
    """Return the name of the foot's coordinate frame."""
    return f"{info.node}_foot"
