"""Marks at frames: each at the nearest one, or said to be at none; nothing else changes."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from devices.errors import UsageError
from devices.frames import FrameBatch
from storage.clock.bounds import OffsetRows
from storage.clock.table import ClockTable, StreamClockFacts
from storage.formats.export import make_one_pass_frame_source
from storage.formats.markers import DISTANCE_MAX_NS, PLACEMENT_COLUMNS, PlacedMarkers, place_markers
from storage.formats.slice import Slice
from storage.schema import Array
from storage.sessions.folder import Marker
from storage.sessions.footer import NOTES_KEY
from tests.builders.arrays import PERIOD_NS, make_array
from tests.builders.frames import make_frames
from tests.storage.formats.exports import TABLES, export, read

UTC_NS = 10**18
OFFSET_NS = 7_000_000_000
"""Server's UTC minus the node's."""
GAP_NS = 10_000_000_000
ROWS = 50


def session() -> tuple[FrameBatch, Array]:
    """Two parts of one stream's clock, ten seconds between them; numbers begin at 0 again."""
    rows = np.arange(ROWS)
    second = rows >= 30
    frames = make_frames(
        np.where(second, rows - 30, rows), 2, t_mono_ns=PERIOD_NS * rows + GAP_NS * second
    )
    return frames, second.astype(np.uint16)


def clock(*, measured: bool = True) -> ClockTable:
    rows = OffsetRows(np.array([0]), np.array([OFFSET_NS]), np.array([1000]))
    streams = [StreamClockFacts("a", UTC_NS, True)]
    return ClockTable({"a": rows} if measured else {}, streams, ["a", "a"])


def times(every: int = ROWS) -> Iterator[dict[str, Array]]:
    frames, part = session()
    for a in range(0, ROWS, every):
        piece = frames.slice_rows(a, a + every)
        yield {name: getattr(piece, name) for name in PLACEMENT_COLUMNS} | {
            "part": part[a : a + every]
        }


def at(*t_ns: int, labels: Sequence[str] = ()) -> list[Marker]:
    """Events at instants of the node's clock, counted from the first frame's."""
    begin = int(session()[0].t_ns[0]) + OFFSET_NS
    names = labels or [f"marker {i}" for i in range(len(t_ns))]
    return [
        Marker(id=f"{i:012x}", label=name, t_ns=begin + t)
        for i, (t, name) in enumerate(zip(t_ns, names, strict=True))
    ]


def placed(
    events: Sequence[Marker], part: Slice | None = None, *, every: int = ROWS
) -> PlacedMarkers:
    return place_markers(events, times(every), clock(), part or Slice())


def frames_of(markers: PlacedMarkers) -> list[tuple[int, int] | None]:
    return [marker.frame for marker in markers.markers]


def test_a_mark_is_at_the_nearest_frame_in_the_servers_time() -> None:
    near, half = int(0.4 * PERIOD_NS), PERIOD_NS // 2  # of two at the same distance, the earlier
    places = (5 * PERIOD_NS + near, 5 * PERIOD_NS + half, 6 * PERIOD_NS - near)
    markers = placed(at(0, *places, GAP_NS + 30 * PERIOD_NS))
    assert frames_of(markers) == [(0, 0), (0, 5), (0, 5), (0, 6), (1, 0)]
    assert [marker.distance_ns for marker in markers.markers] == [0, near, half, near, 0]
    assert markers.excluded == ()
    assert all(
        marker.uncertainty_ns and marker.uncertainty_ns >= 1000 for marker in markers.markers
    )


def test_a_mark_is_at_a_frame_within_a_second_or_at_none() -> None:
    last = 29 * PERIOD_NS
    end = GAP_NS + (ROWS - 1) * PERIOD_NS
    markers = placed(
        at(
            *(-DISTANCE_MAX_NS - 1, -DISTANCE_MAX_NS),
            *(last + DISTANCE_MAX_NS, last + DISTANCE_MAX_NS + 1),
            *(end + DISTANCE_MAX_NS, end + DISTANCE_MAX_NS + 1),
        )
    )
    assert frames_of(markers) == [None, (0, 0), (0, 29), None, (1, 19), None]
    reasons = [marker.exclusion_reason for marker in markers.excluded]
    assert reasons == ["no frame within a second of it"] * 3


def test_marks_at_the_ends_of_time_are_at_no_frame() -> None:
    far = [Marker(id="0" * 12, label="far", t_ns=t_ns) for t_ns in (0, 2**63 - 1)]
    assert frames_of(placed(far)) == [None, None]


def test_marks_at_one_frame_are_joined_in_order_of_time() -> None:
    markers = placed(
        at(3 * PERIOD_NS + 9, 3 * PERIOD_NS + 5, 3 * PERIOD_NS + 5, labels=["c", "a", "b"])
    )
    frames, part = session()
    column = markers.get_frame_labels_or_none(frames.seq, part)
    assert column[3] == "a; b; c"
    assert [label for label in column if label is not None] == ["a; b; c"]


def test_a_mark_outside_the_slice_is_said_to_be() -> None:
    part = Slice(10 * PERIOD_NS * 1e-9, 20 * PERIOD_NS * 1e-9)
    markers = placed(at(9 * PERIOD_NS, 10 * PERIOD_NS, 19 * PERIOD_NS, 20 * PERIOD_NS), part)
    assert frames_of(markers) == [(0, 9), (0, 10), (0, 19), (0, 20)]
    is_excluded = [bool(marker.exclusion_reason) for marker in markers.markers]
    assert is_excluded == [True, False, False, True]


def test_without_a_measured_clock_a_mark_is_at_no_frame() -> None:
    (marker,) = place_markers(at(0), times(), clock(measured=False), Slice()).excluded
    assert marker.frame is None
    assert "clock" in marker.exclusion_reason


@settings(max_examples=60)
@given(
    every=st.integers(1, ROWS),
    t_ns=st.lists(st.integers(-2 * DISTANCE_MAX_NS, GAP_NS + 2 * DISTANCE_MAX_NS), max_size=8),
)
def test_marks_in_pieces_are_where_a_search_of_all_frames_finds_them(
    every: int, t_ns: list[int]
) -> None:
    frames, part = session()
    t_server_ns = [int(t) + OFFSET_NS for t in frames.t_ns]
    expected: list[tuple[int, int] | None] = []
    for event in sorted(at(*t_ns), key=lambda event: event.t_ns):
        row = min(range(ROWS), key=lambda i: abs(t_server_ns[i] - event.t_ns))  # the first of ties
        is_near = abs(t_server_ns[row] - event.t_ns) <= DISTANCE_MAX_NS
        expected.append((int(part[row]), int(frames.seq[row])) if is_near else None)
    assert frames_of(placed(at(*t_ns), every=every)) == expected


# --- in a file ------------------------------------------------------------------------------------


def exported(to: str, markers: PlacedMarkers | None, *columns: str) -> bytes:
    frames, part = session()
    pieces = (
        (frames.slice_rows(a, a + 20), {"part": part[a : a + 20]}) for a in range(0, ROWS, 20)
    )
    content = make_one_pass_frame_source(pieces)
    return b"".join(export(content, make_array(), {}, to, Slice(columns=columns), markers=markers))


@pytest.mark.parametrize("to", TABLES)
def test_the_column_is_the_last_and_the_others_stay(to: str) -> None:
    table = read(exported(to, placed(at(3 * PERIOD_NS, labels=["stone"]))), to)
    plain = read(exported(to, None), to)
    assert table.column_names == [*plain.column_names, "marker"]
    assert table.drop_columns(["marker"]).equals(plain)
    labels = table.column("marker").to_pylist()
    assert labels[3] == "stone"
    assert labels.count("" if to == "csv" else None) == ROWS - 1


@pytest.mark.parametrize("to", TABLES)
def test_without_any_mark_the_column_is_there_and_empty(to: str) -> None:
    content = exported(to, PlacedMarkers(()), "marker")
    if to == "csv":
        assert content == b'"marker"\n' + b"\n" * ROWS
    else:
        assert read(content, to).column("marker").to_pylist() == [None] * ROWS


def test_a_column_that_was_not_asked_for_says_how_to_have_it() -> None:
    with pytest.raises(UsageError, match="markers"):
        exported("arrow", None, "marker")


def test_notes_have_the_frame_of_each_mark_or_the_reason() -> None:
    markers = placed(at(3 * PERIOD_NS, -5 * DISTANCE_MAX_NS, labels=["stone", "early"]))
    metadata = read(exported("arrow", markers), "arrow").schema.metadata
    early, stone = json.loads(metadata[NOTES_KEY])["markers"]
    assert (stone["label"], stone["part"], stone["seq"], stone["left_out"]) == ("stone", 0, 3, None)
    assert (early["label"], early["seq"]) == ("early", None)
    assert early["left_out"] == "no frame within a second of it"


@pytest.mark.parametrize("measured", [True, False])
def test_an_edge_is_placed_by_its_nodes_clock(measured: bool) -> None:
    person = at(3 * PERIOD_NS)
    edges = [
        Marker(
            id=f"a-{n}", label="sync", t_ns=t_ns, stream_id=stream_id, t_mono_ns=t_ns, bound_ns=1
        )
        for n, (t_ns, stream_id) in enumerate(
            [
                (7 * PERIOD_NS + 1, "a"),
                (GAP_NS + 31 * PERIOD_NS, "a"),
                (GAP_NS + 60 * PERIOD_NS, "a"),
                (5 * PERIOD_NS, "b"),
            ]
        )
    ]
    table = clock(measured=measured)
    found = place_markers([*edges, *person], times(), table, Slice())
    places = {m.marker.id: (m.frame, m.distance_ns) for m in found.markers}
    assert places["a-0"] == ((0, 7), 1)
    assert places["a-1"] == ((1, 1), 0)
    assert places["a-2"] == ((1, 19), 11 * PERIOD_NS)
    assert places["a-3"] == (None, None), "of a stream without frames here"
    assert places[person[0].id] == (((0, 3), 0) if measured else (None, None))
    assert {m.uncertainty_ns is not None for m in found.markers if m.frame} == {measured}
