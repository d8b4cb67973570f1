"""Export of a sealed file with its sidecars: frames, the server's time, markers."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from devices.errors import FileFormatError, UsageError
from devices.frames import FRAME_COLUMNS
from storage.clock.table import ClockTable
from storage.formats.export import ClockName, Export, FrameSource
from storage.formats.markers import (
    DISTANCE_MAX_NS,
    PLACEMENT_COLUMNS,
    PlacedMarker,
    PlacedMarkers,
    place_markers,
)
from storage.formats.slice import NO_OPTIONS, FormatOptions, Slice
from storage.schema import COLUMNS_BY_NAME, MEASURED_COLUMNS
from storage.sessions.folder import Marker
from storage.sessions.metadata import load_clock_table
from storage.sessions.reader import SealedFileReader

_SEARCH_DISTANCE_NS = DISTANCE_MAX_NS + 1_000_000
"""Search distance with a margin: float64 sums of instants do not wrap, but are off by 2 us."""


def place_session_markers(
    reader: SealedFileReader, markers: Sequence[Marker], selection: Slice
) -> PlacedMarkers:
    """Place markers at frames of a sealed file; at none if its clock table is missing or damaged.

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
    return place_markers(
        markers, pieces, clock, selection, reader.read_span_on_axis_ns()[0], reader.time_axis
    )


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
    marks_ns = np.sort(np.array([event.t_ns for event in markers], dtype=np.float64))
    for number, rows in by_part.items():
        groups, begins, ends, earliest, latest = np.array(rows, dtype=np.int64).T
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


def make_sealed_export(
    reader: SealedFileReader,
    selection: Slice,
    *,
    clock: ClockName = "node",
    markers: PlacedMarkers | None = None,
    options: FormatOptions = NO_OPTIONS,
) -> Export:
    """Return the export of a sealed file, which reads only the data that the slice needs.

    Raises:
        UsageError: the server's time is requested, and the clock table is missing.
        FileFormatError: the file or its clock table is damaged.
    """
    extra = [
        name for name in COLUMNS_BY_NAME if name not in FRAME_COLUMNS and reader.has_columns(name)
    ]
    table = load_clock_table(reader) if clock == "server" else None
    begin_t_ns, end_t_ns = reader.read_span_on_axis_ns()
    bounds_ns = selection.compute_bounds_ns(begin_t_ns)
    names = [*(column.name for column in MEASURED_COLUMNS), *extra]
    return Export(
        FrameSource(
            names,
            lambda flat: reader.read_overlapping_row_groups(flat, *bounds_ns),
            begin_t_ns,
            end_t_ns,
            reader.time_axis,
        ),
        reader.info,
        reader.notes,
        selection,
        table,
        markers,
        reader.session_id_and_hashes,
        options,
    )
