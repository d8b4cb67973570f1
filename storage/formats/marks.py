"""Where people's marks stand in a session: each at the frame nearest to it in the server's time.

A mark may be made after the session was sealed, so no file of frames holds any: they are placed
when the session is read. One that has no frame within a second of it stands nowhere, and that is
said; so does one whose frames have no server's time, because their clock was never compared.
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
"""A mark further from every frame than this stands at none of them."""
BETWEEN = "; "
"""Between the labels of marks at one frame, in the order of their instants."""

TIMES = ("seq", "t_mono_ns", "t_ns")
"""Columns by which marks are placed, besides `part`."""

_FAR = np.iinfo(np.uint64).max


@dataclass(frozen=True)
class Mark:
    """What became of one event.

    Attributes:
        event: what was marked, and when.
        frame: part and number of the frame at which it stands; None: at none.
        apart_ns: how far that frame is from it in time.
        uncertainty_ns: how far the frame's server's time may be from the truth.
        left_out: why it is not in the data; empty if it is.
    """

    event: Event
    frame: tuple[int, int] | None = None
    apart_ns: int | None = None
    uncertainty_ns: int | None = None
    left_out: str = ""

    def as_dict(self) -> dict[str, object]:
        """For the notes of a file."""
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
    """Events at frames.

    Args:
        marks: in the order of their instants.
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
        """Those that are not in the data."""
        return tuple(mark for mark in self.all if mark.left_out)

    def column(self, seq: Array, part: Array | None) -> Array:
        """Labels of frames, object[n]: text, or None where nothing was marked.

        Args:
            seq: uint64[n], numbers of frames.
            part: uint16[n], their parts; None: the first.
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
    """Find the frame of every event.

    Args:
        events: in any order.
        pieces: columns `TIMES` of all frames of the session, and `part` if it has parts; those
            that are further than `NEAREST_NS` from every event may be left out.
        clock: of the session.
        part: the slice that is wanted; a mark whose frame is not in it is left out.
        begin_t_ns: instant of the session's first frame; None: the first that comes.
        axis: of the session.

    Returns:
        The marks. Of two frames that are as near the earlier one has it.
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
    """The nearest frame so far of each of n instants."""

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
        """Compare with further frames."""
        t_server_ns = times["t_server_ns"]
        known = np.flatnonzero(t_server_ns != NO_INSTANT)
        if not len(known) or not len(self.t_ns):
            return
        rows = known[np.argsort(t_server_ns[known], kind="stable")]
        rising_ns = t_server_ns[rows]
        after = np.searchsorted(rising_ns, self.t_ns)
        # Of frames with one instant the first.
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
        """What became of instant number i."""
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
    """Distances of int64 instants, which may be too large for an int64, as uint64."""
    a, b = a_ns.astype(np.uint64), b_ns.astype(np.uint64)
    return np.where(a_ns > b_ns, a - b, b - a)
