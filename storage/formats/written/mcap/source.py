"""What messages are made of: frames with their instants, and the foot that is drawn of some."""

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
"""The foot is drawn twenty times a second: more no screen needs, and it is most of the bytes."""
TILE_RADIUS_M, TILE_HEIGHT_M = 0.008, 0.006
METRES_PER_NEWTON = 0.001
"""Length of the arrow of the GRF."""
FULL_COLOUR_N = 30.0
"""Force from which on a tile is drawn in its fullest colour."""

Message = tuple[int, int, bytes]
"""Instant, channel and content."""


class Channels(Protocol):
    """Where messages go; `mcap.writer.Writer` has these."""

    def register_schema(self, name: str, encoding: str, data: bytes) -> int:
        """Number of a kind of message."""

    def register_channel(
        self, topic: str, message_encoding: str, schema_id: int, metadata: dict[str, str]
    ) -> int:
        """Number of a topic."""


class Vocabulary(Protocol):
    """Messages of one session."""

    def messages(self, frames: Frames) -> Iterator[Message]:
        """Of some frames, in their order."""


@dataclass(frozen=True)
class Frames:
    """Some frames of a session.

    Attributes:
        t_ns: int64[n], instants on the clock that was asked for.
        flat: flat columns.
        shown: rows of which the foot is drawn.
        marks: row and text of what was marked.
        uncertainty_ns: greatest bound of the instants; None: they are the node's own.
    """

    t_ns: Array
    flat: Mapping[str, Array]
    shown: list[int]
    marks: list[tuple[int, str]]
    uncertainty_ns: int | None

    def tiles(self, name: str, count: int) -> Array:
        """One quantity of all tiles, (n, tiles), NaN where it is not known."""
        columns = [numbers(name, self.flat[f"{name}_{i}"]) for i in range(count)]
        return np.stack(columns, axis=1) if columns else np.empty((len(self.t_ns), 0))


def numbers(name: str, values: Array) -> Array:
    """A column of any type as float64, NaN where it is not known."""
    found = values.astype(np.float64)
    missing = KNOWN[name].missing
    if missing is not None:
        found[values == missing] = np.nan
    return found


def frames_of(export: Export, columns: list[str]) -> Iterator[Frames]:
    """A session's frames, with these columns.

    Raises:
        UsageError: as for `Export.pieces`; the server's time of a frame is not known.
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
    """Of a tile: red, green, blue, opacity. Grey: its force is not known."""
    if np.isnan(force_n):
        return 0.5, 0.5, 0.5, 0.5
    share = min(max(force_n / FULL_COLOUR_N, 0.0), 1.0)
    return 0.2 + 0.8 * share, 0.4 + 0.3 * share, 0.9 - 0.8 * share, 1.0


def frame_id(info: ArrayInfo) -> str:
    """Name of the foot frame."""
    return f"{info.node}_foot"
