"""Placement of markers: each at the nearest frame of its session in the server's time.

Markers may be set after a session was sealed, so no file of frames has them: they are placed when
the session is read. A marker without a frame within a second has no frame, and so has a marker
whose frames have no server's time, because their clock was never compared. The reason is stated.
An edge of a sync line has its instant by the clock of the frames, and needs no server's time.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from devices.errors import FileFormatError, UsageError
from storage.clock.table import ClockTable
from storage.formats.slice import Slice
from storage.schema import UNKNOWN_T_NS, Array
from storage.sessions.folder import Marker
from storage.sessions.metadata import load_clock_table
from storage.sessions.reader import SealedFileReader
from storage.sessions.time_axis import NODE_AXIS, TimeAxis

DISTANCE_MAX_NS = 1_000_000_000
"""Largest distance in time between a marker and its frame."""
_SEARCH_DISTANCE_NS = DISTANCE_MAX_NS + 1_000_000
"""Search distance with a margin: float64 sums of instants do not wrap, but are off by 2 us."""
LABEL_SEPARATOR = "; "
"""Separator of the labels of several markers at one frame, in the order of their instants."""

PLACEMENT_COLUMNS = ("seq", "t_mono_ns", "t_ns")
"""Columns by which markers are placed, besides `part`."""

_NO_FRAME = "no frame within a second of it"
_NO_CLOCK = "no frame's time is known by the server's clock"
_NOT_IN_SLICE = "its frame is not in this slice"
_NO_DISTANCE = np.iinfo(np.uint64).max


@dataclass(frozen=True)
class PlacedMarker:
    """Marker with its frame, or with the reason why it has none.

    Attributes:
        marker: label and instant.
        frame: part and number of its frame; None: no frame.
        distance_ns: distance in time between marker and frame.
        uncertainty_ns: bound of the error of the frame's server time.
        exclusion_reason: reason why the marker is not in the data; empty if it is.
    """

    marker: Marker
    frame: tuple[int, int] | None = None
    distance_ns: int | None = None
    uncertainty_ns: int | None = None
    exclusion_reason: str = ""

    def to_json_dict(self) -> dict[str, object]:
        """Return the marker as JSON, for the notes of a file."""
        part, seq = self.frame or (None, None)
        return {
            **self.marker.model_dump(mode="json", exclude_none=True),
            "part": part,
            "seq": seq,
            "apart_ns": self.distance_ns,
            "uncertainty_ns": self.uncertainty_ns,
            "left_out": self.exclusion_reason or None,
        }


class PlacedMarkers:
    """Markers of a session, placed at frames.

    Args:
        markers: markers in the order of their instants.
    """

    def __init__(self, markers: Sequence[PlacedMarker]) -> None:
        self.markers = tuple(markers)
        self._labels: dict[tuple[int, int], str] = {}
        for marker in self.markers:
            if marker.frame is not None:
                earlier = self._labels.get(marker.frame)
                label = marker.marker.label
                self._labels[marker.frame] = (
                    label if earlier is None else earlier + LABEL_SEPARATOR + label
                )
        self._seqs = np.array([seq for _, seq in self._labels], dtype=np.uint64)

    @property
    def excluded(self) -> tuple[PlacedMarker, ...]:
        """Markers that are not in the data."""
        return tuple(marker for marker in self.markers if marker.exclusion_reason)

    def get_frame_labels_or_none(self, seq: Array, part: Array | None) -> Array:
        """Return the labels of frames, object[n]: text, or None without a marker.

        Args:
            seq: uint64[n], numbers of the frames.
            part: uint16[n], their parts; None: the first part.
        """
        labels = np.full(len(seq), None, dtype=object)
        for row in np.flatnonzero(np.isin(seq, self._seqs)):
            labels[row] = self._labels.get((0 if part is None else int(part[row]), int(seq[row])))
        return labels


def place_markers(
    markers: Iterable[Marker],
    frame_chunks: Iterable[Mapping[str, Array]],
    clock: ClockTable,
    selection: Slice,
    begin_t_ns: int | None = None,
    axis: TimeAxis = NODE_AXIS,
) -> PlacedMarkers:
    """Place every marker at its nearest frame; of two equally near frames at the earlier one.

    Args:
        markers: markers in any order.
        frame_chunks: `PLACEMENT_COLUMNS` of all frames of the session, and `part`
            if it has parts. Frames further than `DISTANCE_MAX_NS` from every marker may be omitted.
        clock: clock table of the session.
        selection: the requested slice; a marker with a frame outside is left out.
        begin_t_ns: instant from which seconds of the slice count; None: of the first frame in
            `frame_chunks`.
        axis: time axis of the session.
    """
    searches = _group_by_clock(markers)
    for piece in frame_chunks:
        if not len(piece["t_ns"]):
            continue
        begin_t_ns = int(piece["t_ns"][0]) if begin_t_ns is None else begin_t_ns
        times = clock.compute_server_time_columns_or_unknown(
            piece["t_mono_ns"], piece["t_ns"], piece.get("part")
        )
        at_ns = axis.shift_to_axis(piece["t_ns"], piece.get("part"))
        part = piece.get("part", np.zeros(len(at_ns), dtype=np.uint16))
        values = {
            "seq": piece["seq"],
            "part": part,
            "uncertainty_ns": times["t_server_uncertainty_ns"],
            "inside": selection.compute_row_mask(at_ns, begin_t_ns),
        }
        for stream_id, search in searches.items():
            if stream_id is None:
                t_ns = times["t_server_ns"]
                search.add_frames(t_ns, t_ns != UNKNOWN_T_NS, values)
            else:
                own_parts = [number for number, s in enumerate(clock.parts) if s == stream_id]
                search.add_frames(piece["t_mono_ns"], np.isin(part, own_parts), values)
    placed = [
        search.make_placed_marker(i, event)
        for search in searches.values()
        for i, event in enumerate(search.markers)
    ]
    return PlacedMarkers(sorted(placed, key=lambda each: each.marker.t_ns))


def _group_by_clock(markers: Iterable[Marker]) -> dict[str | None, _NearestFrames]:
    """Return the searches for the markers of each stream, and of the server's clock (None)."""
    groups: dict[str | None, list[Marker]] = {}
    for event in markers:
        groups.setdefault(event.stream_id, []).append(event)
    return {stream_id: _NearestFrames(group) for stream_id, group in groups.items()}


@dataclass
class _NearestFrames:
    """Running search for the nearest frame of each of n markers of one clock."""

    markers: Sequence[Marker]
    t_ns: Array = field(init=False)
    distance_ns: Array = field(init=False)
    frame_facts: dict[str, Array] = field(init=False)

    def __post_init__(self) -> None:
        instants = [m.t_ns if m.t_mono_ns is None else m.t_mono_ns for m in self.markers]
        self.t_ns = np.array(instants, dtype=np.int64)
        self.distance_ns = np.full(len(self.t_ns), _NO_DISTANCE, dtype=np.uint64)
        types = {"seq": np.uint64, "part": np.uint16, "uncertainty_ns": np.int64, "inside": bool}
        self.frame_facts = {name: np.zeros(len(self.t_ns), type_) for name, type_ in types.items()}

    def add_frames(self, t_ns: Array, is_known: Array, values: Mapping[str, Array]) -> None:
        """Update the nearest frames by further frames.

        Args:
            t_ns: int64[n], instants of the frames by the markers' clock.
            is_known: bool[n], frames that have such an instant.
            values: facts of the frames, by the names of `frame_facts`.
        """
        known = np.flatnonzero(is_known)
        if not len(known):
            return
        rows = known[np.argsort(t_ns[known], kind="stable")]
        rising_ns = t_ns[rows]
        after = np.searchsorted(rising_ns, self.t_ns)
        # The first of several frames with one instant.
        before = np.searchsorted(rising_ns, rising_ns[np.maximum(after - 1, 0)])
        for at in (before, np.minimum(after, len(rows) - 1)):
            apart_ns = _distance_ns(self.t_ns, rising_ns[at])
            nearer = apart_ns < self.distance_ns
            self.distance_ns[nearer] = apart_ns[nearer]
            for name, column in self.frame_facts.items():
                column[nearer] = values[name][rows[at[nearer]]]

    def make_placed_marker(self, i: int, marker: Marker) -> PlacedMarker:
        """Return the marker of instant number i with its frame."""
        if self.distance_ns[i] > DISTANCE_MAX_NS:
            return PlacedMarker(
                marker,
                exclusion_reason=_NO_FRAME if self.distance_ns[i] != _NO_DISTANCE else _NO_CLOCK,
            )
        facts: dict[str, Any] = {
            name: column[i].item() for name, column in self.frame_facts.items()
        }
        return PlacedMarker(
            marker,
            (facts["part"], facts["seq"]),
            int(self.distance_ns[i]),
            None if facts["uncertainty_ns"] == UNKNOWN_T_NS else facts["uncertainty_ns"],
            "" if facts["inside"] else _NOT_IN_SLICE,
        )


def _distance_ns(a_ns: Array, b_ns: Array) -> Array:
    """Return distances of int64 instants as uint64: an int64 might overflow."""
    a, b = a_ns.astype(np.uint64), b_ns.astype(np.uint64)
    return np.where(a_ns > b_ns, a - b, b - a)


def place_session_markers(
    reader: SealedFileReader,
    markers: Sequence[Marker],
    selection: Slice,
    take_offset_s: float = 0.0,
) -> PlacedMarkers:
    """Place markers at frames of a sealed file; at none if its clock table is missing or damaged.

    Args:
        reader: the file.
        markers: markers in any order.
        selection: the requested slice.
        take_offset_s: as for `storage.formats.export.Export`.

    Raises:
        FileFormatError: the file is damaged.
    """
    if not markers:
        return PlacedMarkers(())
    try:
        clock = load_clock_table(reader)
    except (UsageError, FileFormatError) as error:  # export the frames without markers
        return PlacedMarkers(
            [PlacedMarker(event, exclusion_reason=error.what) for event in markers]
        )
    names = (*PLACEMENT_COLUMNS, "part") if reader.has_columns("part") else PLACEMENT_COLUMNS
    pieces = reader.read_quantities(
        *names, row_groups=_row_groups_near_markers(reader, clock, markers)
    )
    zero_ns = reader.read_span_on_axis_ns()[0] - round(take_offset_s * 1e9)
    return place_markers(markers, pieces, clock, selection, zero_ns, reader.time_axis)


def _row_groups_near_markers(
    reader: SealedFileReader, clock: ClockTable, markers: Sequence[Marker]
) -> list[int]:
    """Return the row groups that may have a marker's frame, by the times in the footer.

    At least one row group with a compared clock is included, if there is one: a marker without a
    frame is reported differently if no frame has the server's time.
    """
    names = (
        (*PLACEMENT_COLUMNS[1:], "part") if reader.has_columns("part") else PLACEMENT_COLUMNS[1:]
    )
    extremes = zip(*(reader.read_min_max_by_row_group(name) for name in names), strict=True)
    near: set[int] = set()
    compared: list[int] = []
    by_part: dict[int, list[tuple[int, ...]]] = {}
    for group, (t_mono_ns, t_ns, *part) in enumerate(extremes):
        of_part = part[0] if part else (0, 0)
        if t_mono_ns is None or t_ns is None or of_part is None or of_part[0] != of_part[1]:
            near.add(group)
        else:
            by_part.setdefault(of_part[0], []).append((group, *t_mono_ns, *t_ns))
    marks_ns = np.sort([float(event.t_ns) for event in markers if event.stream_id is None])
    for number, rows in by_part.items():
        groups, begins, ends, earliest, latest = np.array(rows, dtype=np.int64).T
        stream_id = clock.parts[number] if number < len(clock.parts) else ""
        edges_ns = np.sort([m.t_mono_ns for m in markers if m.stream_id == stream_id])
        first = np.searchsorted(edges_ns, begins - _SEARCH_DISTANCE_NS)
        near.update(groups[first < np.searchsorted(edges_ns, ends + _SEARCH_DISTANCE_NS)].tolist())
        reach = clock.bound_offset_in_ranges(begins, ends, number)
        if reach is None:
            continue
        compared += groups.tolist()
        least, greatest, sure = reach
        first = np.searchsorted(marks_ns, earliest.astype(np.float64) + least - _SEARCH_DISTANCE_NS)
        behind = np.searchsorted(
            marks_ns, latest.astype(np.float64) + greatest + _SEARCH_DISTANCE_NS
        )
        near.update(groups[~sure | (first < behind)].tolist())
    if near.isdisjoint(compared):
        near.update(sorted(compared)[:1])
    return sorted(near)
