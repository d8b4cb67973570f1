"""Edges of a sync line: beside the frames in their message, and in a file after a kill."""

from __future__ import annotations

import json
from pathlib import Path

import pyarrow as pa
import pytest
from hypothesis import given
from hypothesis import strategies as st

from devices.errors import FileFormatError
from devices.frames import Edge
from storage import edges as edges_module
from storage.edges import (
    EDGES_KEY,
    EdgesInFlightWriter,
    encode_record_batch,
    read_edges,
    read_edges_in_flight,
    try_delete_edges_in_flight,
)
from storage.schema import frames_to_record_batch, wire_schema
from storage.wire import Decoder, decode_message, encode_frames
from tests.builders.arrays import make_array
from tests.builders.frames import assert_same_bits, make_frames

SCHEMA = wire_schema(make_array())
EDGES = st.lists(
    st.builds(Edge, st.integers(0, 2**53 - 1), st.integers(0, 2**59), st.booleans()), max_size=64
)


@given(edges=EDGES)
def test_a_message_has_its_edges_and_the_same_frames(edges: list[Edge]) -> None:
    frames = make_frames(9)
    payload = encode_frames(frames, SCHEMA, edges)
    assert list(read_edges(payload, SCHEMA)) == edges
    assert_same_bits(Decoder(SCHEMA).decode(payload), frames)
    stream = pa.ipc.open_stream(SCHEMA.serialize().to_pybytes() + payload)
    assert stream.read_all().num_rows == 9, "any Arrow tool reads it"
    if not edges:
        assert payload == frames_to_record_batch(frames, SCHEMA).serialize().to_pybytes()


@pytest.mark.parametrize("said", ["[[1]]", "{}", '[["x", 1, true]]', "[[-1, 1, true]]", "nonsense"])
def test_other_metadata_is_refused_at_the_link(said: str, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patch:
        patch.setattr("storage.edges.json.dumps", lambda _: said)
        record = frames_to_record_batch(make_frames(3), SCHEMA)
        payload = encode_record_batch(record, [Edge(1, 1, True)])
    assert EDGES_KEY in payload
    with pytest.raises(FileFormatError, match="no Arrow message of frames"):
        decode_message(payload, SCHEMA)


def test_edges_in_flight_are_read_after_a_kill_but_for_a_cut_line(tmp_path: Path) -> None:
    writer = EdgesInFlightWriter(tmp_path)
    assert read_edges_in_flight(tmp_path) == []
    writer.write_edges([Edge(1, 10, True), Edge(2, 20, False)])
    writer.write_edges([Edge(3, 30, True)])
    path = tmp_path / "edges_in_flight"
    path.write_bytes(path.read_bytes() + json.dumps(Edge(4, 40, True)).encode()[:-2])
    expected = [Edge(1, 10, True), Edge(2, 20, False), Edge(3, 30, True)]
    assert read_edges_in_flight(tmp_path) == expected
    writer.close()
    try_delete_edges_in_flight(tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_a_storm_fills_no_disk_and_leaves_the_newest_edges(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(edges_module, "_FILE_BYTES_MAX", 1000)
    writer = EdgesInFlightWriter(tmp_path)
    for number in range(10_000):
        writer.write_edges([Edge(number, number, True)])
    writer.close()
    left = [edge.number for edge in read_edges_in_flight(tmp_path)]
    assert left == list(range(left[0], 10_000))
    assert len(left) > 30
    assert sum(path.stat().st_size for path in tmp_path.iterdir()) < 2200
