"""Placement of markers: each at the nearest frame of its session in the server's time.

Markers may be set after a session was sealed, so no file of frames has them: they are placed when
the session is read. A marker without a frame within a second has no frame, and so has a marker
whose frames have no server's time, because their clock was never compared. The reason is stated.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from storage.clock.table import ClockTable
from storage.formats.slice import Slice
from storage.schema import NO_INSTANT, Array
from storage.sessions.folder import Event
from storage.sessions.time_axis import NODE_AXIS, TimeAxis

NEAREST_NS = 1_000_000_000
"""Largest distance in time between a marker and its frame."""
BETWEEN = "; "
"""Separator of the labels of several markers at one frame, in the order of their instants."""

TIMES = ("seq", "t_mono_ns", "t_ns")
"""Columns by which markers are placed, besides `part`."""

_FAR = np.iinfo(np.uint64).max


@dataclass(frozen=True)
class Mark:
    """Marker with its frame, or with the reason why it has none.

    Attributes:
        event: label and instant.
        frame: part and number of its frame; None: no frame.
        apart_ns: distance in time between marker and frame.
        uncertainty_ns: bound of the error of the frame's server time.
        left_out: reason why the marker is not in the data; empty if it is.
    """

    event: Event
    frame: tuple[int, int] | None = None
    apart_ns: int | None = None
    uncertainty_ns: int | None = None
    left_out: str = ""

    def as_dict(self) -> dict[str, object]:
        """Return the marker as JSON, for the notes of a file."""
        part, seq = self.frame or (None, None)
        return {
            **self.event.model_dump(mode="json"),
            "part": part,
            "seq": seq,
            "apart_ns": self.apart_ns,
            "uncertainty_ns": self.uncertainty_ns,
            "left_out": self.left_out or None,
        }


class Marks:
    """Markers of a session, placed at frames.

    Args:
        marks: markers in the order of their instants.
    """

    def __init__(self, marks: Sequence[Mark]) -> None:
        self.all = tuple(marks)
        self._labels: dict[tuple[int, int], str] = {}
        for mark in self.all:
            if mark.frame is not None:
                earlier = self._labels.get(mark.frame)
                label = mark.event.label
                self._labels[mark.frame] = label if earlier is None else earlier + BETWEEN + label
        self._seqs = np.array([seq for _, seq in self._labels], dtype=np.uint64)

    @property
    def left_out(self) -> tuple[Mark, ...]:
        """Markers that are not in the data."""
        return tuple(mark for mark in self.all if mark.left_out)

    def column(self, seq: Array, part: Array | None) -> Array:
        """Return the labels of frames, object[n]: text, or None without a marker.

        Args:
            seq: uint64[n], numbers of the frames.
            part: uint16[n], their parts; None: the first part.
        """
        labels = np.full(len(seq), None, dtype=object)
        for row in np.flatnonzero(np.isin(seq, self._seqs)):
            labels[row] = self._labels.get((0 if part is None else int(part[row]), int(seq[row])))
        return labels


def place(
    events: Iterable[Event],
    pieces: Iterable[Mapping[str, Array]],
    clock: ClockTable,
    part: Slice,
    begin_t_ns: int | None = None,
    axis: TimeAxis = NODE_AXIS,
) -> Marks:
    """Place every marker at its nearest frame; of two equally near frames at the earlier one.

    Args:
        events: markers in any order.
        pieces: columns `TIMES` of all frames of the session, and `part` if it has parts. Frames
            further than `NEAREST_NS` from every marker may be omitted.
        clock: clock table of the session.
        part: the requested slice; a marker with a frame outside is left out.
        begin_t_ns: instant of the session's first frame; None: of the first frame in `pieces`.
        axis: time axis of the session.
    """
    ordered = sorted(events, key=lambda event: event.t_ns)
    nearest = _Nearest(np.array([event.t_ns for event in ordered], dtype=np.int64))
    for piece in pieces:
        if not len(piece["t_ns"]):
            continue
        begin_t_ns = int(piece["t_ns"][0]) if begin_t_ns is None else begin_t_ns
        times = clock.columns(piece["t_mono_ns"], piece["t_ns"], piece.get("part"))
        at_ns = axis.at(piece["t_ns"], piece.get("part"))
        nearest.look_at(piece, times, part.rows(at_ns, begin_t_ns))
    return Marks([nearest.mark(i, event) for i, event in enumerate(ordered)])


@dataclass
class _Nearest:
    """Running search for the nearest frame of each of n instants."""

    t_ns: Array
    apart_ns: Array = field(init=False)
    facts: dict[str, Array] = field(init=False)

    def __post_init__(self) -> None:
        self.apart_ns = np.full(len(self.t_ns), _FAR, dtype=np.uint64)
        types = {"seq": np.uint64, "part": np.uint16, "uncertainty_ns": np.int64, "inside": bool}
        self.facts = {name: np.zeros(len(self.t_ns), type_) for name, type_ in types.items()}

    def look_at(
        self, piece: Mapping[str, Array], times: Mapping[str, Array], inside: Array
    ) -> None:
        """Update the nearest frames by further frames."""
        t_server_ns = times["t_server_ns"]
        known = np.flatnonzero(t_server_ns != NO_INSTANT)
        if not len(known) or not len(self.t_ns):
            return
        rows = known[np.argsort(t_server_ns[known], kind="stable")]
        rising_ns = t_server_ns[rows]
        after = np.searchsorted(rising_ns, self.t_ns)
        # The first of several frames with one instant.
        before = np.searchsorted(rising_ns, rising_ns[np.maximum(after - 1, 0)])
        values = {
            "seq": piece["seq"],
            "part": piece.get("part", np.zeros(len(t_server_ns), dtype=np.uint16)),
            "uncertainty_ns": times["t_server_uncertainty_ns"],
            "inside": inside,
        }
        for at in (before, np.minimum(after, len(rows) - 1)):
            apart_ns = _apart(self.t_ns, rising_ns[at])
            nearer = apart_ns < self.apart_ns
            self.apart_ns[nearer] = apart_ns[nearer]
            for name, column in self.facts.items():
                column[nearer] = values[name][rows[at[nearer]]]

    def mark(self, i: int, event: Event) -> Mark:
        """Return the marker of instant number i with its frame."""
        if self.apart_ns[i] > NEAREST_NS:
            return Mark(event, left_out=_NO_FRAME if self.apart_ns[i] != _FAR else _NO_CLOCK)
        facts: dict[str, Any] = {name: column[i].item() for name, column in self.facts.items()}
        return Mark(
            event,
            (facts["part"], facts["seq"]),
            int(self.apart_ns[i]),
            facts["uncertainty_ns"],
            "" if facts["inside"] else _NOT_IN_SLICE,
        )


_NO_FRAME = "no frame within a second of it"
_NO_CLOCK = "no frame's time is known by the server's clock"
_NOT_IN_SLICE = "its frame is not in this slice"


def _apart(a_ns: Array, b_ns: Array) -> Array:
    """Return distances of int64 instants as uint64: an int64 might overflow."""
    a, b = a_ns.astype(np.uint64), b_ns.astype(np.uint64)
    return np.where(a_ns > b_ns, a - b, b - a)
