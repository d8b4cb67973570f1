"""The law of edges: each between a session's first and last frame is one marker in its bound."""

from __future__ import annotations

import tracemalloc
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from devices.frames import Edge
from service.sessions import edges as edges_module
from service.sessions.edges import EdgeMarkers, collect_edge_markers, read_sync_section
from service.sessions.inputs import SessionInputs
from storage.clock.log import ClockOffset
from storage.journal.journal import Journal
from storage.schema import wire_schema
from storage.sessions.folder import Marker, Part, Session
from storage.wire import decode_message, encode_as_messages, encode_frames
from tests.builders.arrays import PERIOD_NS, UTC_NS, make_array
from tests.builders.frames import make_frames

INFO = make_array()
SCHEMA = wire_schema(INFO)
FRAMES = make_frames(120)
OFFSET_NS = 5_000_000_123
SYNC: dict[str, Any] = {"sync": {"input_line": 17, "label": "TTL"}}


def inputs_of(journal: Journal, first: int, last: int, *, clock: bool = True) -> SessionInputs:
    rows = [
        ClockOffset(
            stream_id=INFO.stream_id,
            t_mono_ns=t_mono_ns,
            server_minus_node_ns=OFFSET_NS,
            uncertainty_ns=1000,
        )
        for t_mono_ns in (0, 120 * PERIOD_NS)
    ]
    session = Session(
        id="20260101T000000Z-000000",
        name="x",
        node=INFO.node,
        state="sealing",
        started_t_ns=0,
        parts=(Part(stream_id=INFO.stream_id, seq_first=first, seq_last=last),),
        scene="x",
        scene_content=SYNC,
        clock=tuple(rows) if clock else (),
    )
    return SessionInputs(session, INFO, {INFO.stream_id: journal}, None, None, (), {})


def deliver(batches: list[tuple[int, int]], edges: list[Edge]) -> list[bytes]:
    """Messages of these batches, each with the edges up to its end, as acquisition makes them."""
    messages, begin_ns = [], -1
    for first, last in batches:
        rows = FRAMES.slice_rows(first, last + 1)
        end_ns = int(rows.t_mono_ns[-1])
        own = [edge for edge in edges if begin_ns < edge.t_mono_ns <= end_ns]
        messages.append(encode_frames(rows, SCHEMA, own))
        begin_ns = end_ns
    return messages


@settings(max_examples=40, deadline=None)
@given(data=st.data())
def test_each_edge_of_a_session_is_one_marker_within_its_bound(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    ends = sorted({*data.draw(st.sets(st.integers(0, 118), max_size=15)), 119})
    batches = [(a + 1, b) for a, b in zip([-1, *ends], ends, strict=False)]
    times = sorted(data.draw(st.sets(st.integers(0, 119 * PERIOD_NS), max_size=30)))
    edges = [Edge(n + 1, t_ns, n % 2 == 0) for n, t_ns in enumerate(times)]
    folder = tmp_path_factory.mktemp("journal")
    messages = deliver(batches, edges)
    # Some frames come after a kill, from the file of frames in flight, others twice.
    first = data.draw(st.integers(0, 119))
    again = [m.payload for m in encode_as_messages(FRAMES.slice_rows(first, 120), INFO, edges)]
    come = data.draw(st.permutations(again[:1] + messages + messages[:3] + again[1:]))
    a, b = sorted(data.draw(st.tuples(st.integers(0, 119), st.integers(0, 119))))
    clock, is_reopened = data.draw(st.booleans()), data.draw(st.booleans())
    with closing(Journal(folder, INFO)) as journal:
        for message in come:
            journal.append_new_frames(decode_message(message, SCHEMA), message)
        found = collect_edge_markers(inputs_of(journal, a, b, clock=clock))
    if is_reopened:
        with closing(Journal.open_existing_and_recover(folder)) as journal:
            assert found == collect_edge_markers(inputs_of(journal, a, b, clock=clock))
    expected = [e for e in edges if a * PERIOD_NS <= e.t_mono_ns <= b * PERIOD_NS]
    assert [(m.id, m.t_mono_ns) for m in found.markers] == [
        (f"{INFO.stream_id}-{e.number}", e.t_mono_ns) for e in expected
    ]
    assert found.problem is None
    for marker in found.markers:
        assert marker.t_mono_ns is not None
        truth = marker.t_mono_ns + UTC_NS + OFFSET_NS * clock
        assert (marker.bound_ns is not None) == clock, "an unknown time has no bound"
        assert abs(marker.t_ns - truth) <= (marker.bound_ns or 0) <= 1_000_000
        assert marker.label == "TTL"


def test_edges_of_lost_frames_are_said(tmp_path: Path) -> None:
    edges = [Edge(n, n * 10 * PERIOD_NS, True) for n in range(1, 12)]
    journal = Journal(tmp_path, INFO)
    messages = deliver([(n, n + 9) for n in range(0, 120, 10)], edges)
    for message in messages[:4] + messages[6:]:
        journal.append_new_frames(decode_message(message, SCHEMA), message)
    found = collect_edge_markers(inputs_of(journal, 0, 119))
    journal.close()
    assert len(found.markers) == 9
    assert found.problem is not None
    assert "2 edges of the sync line are lost" in found.problem


def test_more_edges_than_markers_are_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(edges_module, "EDGE_MARKERS_MAX", 4)
    journal = Journal(tmp_path, INFO)
    edges = [Edge(n, n * PERIOD_NS, True) for n in range(1, 12)]
    journal.append_new_frames(FRAMES, encode_frames(FRAMES, SCHEMA, edges))
    found = collect_edge_markers(inputs_of(journal, 0, 119))
    journal.close()
    assert [m.t_mono_ns for m in found.markers] == [n * PERIOD_NS for n in range(1, 5)]
    assert found.problem == "7 edges of the sync line are no markers, beyond 4"


def test_the_memory_for_edges_has_a_bound(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(edges_module, "EDGE_MARKERS_MAX", 50)
    journal = Journal(tmp_path, INFO)
    edges = [Edge(n, n * PERIOD_NS // 200, True) for n in range(1, 20_000)]
    for message in deliver([(n, n + 9) for n in range(0, 120, 10)], edges):
        journal.append_new_frames(decode_message(message, SCHEMA), message)
    inputs = inputs_of(journal, 0, 119)
    tracemalloc.start()
    found = collect_edge_markers(inputs)
    peak_bytes = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    journal.close()
    assert len(found.markers) == 50
    assert peak_bytes < 2e6, "one message with its edges"


def test_a_session_without_a_sync_input_has_no_edges(tmp_path: Path) -> None:
    journal = Journal(tmp_path, INFO)
    journal.append_new_frames(FRAMES)
    inputs = inputs_of(journal, 0, 119)
    for content in ({}, {"sync": None}, {"sync": {"output_line": 5}}, {"sync": {"unknown": 1}}):
        session = inputs.session.model_copy(update={"scene_content": content})
        assert read_sync_section(session) is None
        assert (
            collect_edge_markers(SessionInputs(session, INFO, inputs.journals, None, None, (), {}))
            == EdgeMarkers()
        )
    journal.close()


def test_edges_replace_edges_and_leave_the_markers_of_people() -> None:
    person = Marker(id="0" * 12, label="a stone", t_ns=1)
    old, new = (
        Marker(id=f"a-{n}", label="sync", t_ns=n, stream_id="a", t_mono_ns=n, bound_ns=1)
        for n in (2, 3)
    )
    session = Session(
        id="20260101T000000Z-000000",
        name="x",
        node="x",
        state="recording",
        started_t_ns=0,
        parts=(),
        scene="x",
        markers=(old, person),
    )
    assert session.with_replaced_edges([new]).markers == (person, new)
    assert np.all([marker.stream_id is None for marker in session.with_replaced_edges([]).markers])
