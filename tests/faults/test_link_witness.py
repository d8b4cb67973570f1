"""The witness on the link: what it makes of websocket bytes, whoever cuts them up."""

from __future__ import annotations

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from websockets.frames import Frame, Opcode

from storage.schema import wire_schema
from storage.wire import encode_frames
from tests.builders.arrays import make_array
from tests.builders.frames import make_frames
from tests.faults.link_witness import Messages, Witness

HEAD = b"GET /api/v1/ingest HTTP/1.1\r\nUpgrade: websocket\r\n\r\n"
TEXT, BINARY = 1, 2


def frame(
    opcode: Opcode, payload: bytes = b"", *, masked: bool = True, is_last: bool = True
) -> bytes:
    return Frame(opcode, payload, fin=is_last).serialize(mask=masked)


@pytest.mark.slow
@pytest.mark.parametrize("masked", [True, False])
@given(
    sizes=st.lists(st.sampled_from([0, 1, 125, 126, 70_000]), max_size=5),
    cut=st.integers(1, 50_000),
)
def test_messages_are_found_however_the_bytes_come(
    masked: bool, sizes: list[int], cut: int
) -> None:
    payloads = [bytes(n % 251 for n in range(size)) for size in sizes]
    data = HEAD + b"".join(frame(Opcode.BINARY, each, masked=masked) for each in payloads)
    messages = Messages()
    pieces = [data[at : at + cut] for at in range(0, len(data), cut)]
    assert [m for piece in pieces for m in messages.feed(piece)] == [(BINARY, p) for p in payloads]


def test_a_message_in_pieces_with_a_ping_between_them_is_one() -> None:
    data = (
        HEAD
        + frame(Opcode.TEXT, b"he", is_last=False)
        + frame(Opcode.PING, b"?")
        + frame(Opcode.CONT, b"llo")
        + frame(Opcode.CLOSE)
    )
    assert list(Messages().feed(data)) == [(TEXT, b"hello")]


def frames(first: int, count: int, stream_id: str) -> bytes:
    """A message of frames with their number as the first tile's count."""
    seq = np.arange(first, first + count)
    payload = encode_frames(
        make_frames(seq, 1, pressure_raw=seq[:, None]),
        wire_schema(make_array(1, stream_id=stream_id)),
    )
    return frame(Opcode.BINARY, payload)


def connected(witness: Witness, *stream_ids: str) -> tuple[bytes, bytes]:
    """What a node says first, of its last stream, and a server's answer."""
    arrays = [make_array(1, stream_id=stream_id) for stream_id in stream_ids]
    *earlier, present = [array.model_dump(mode="json") for array in arrays]
    hello = {
        "type": "hello",
        "array_info": present,
        "earlier": [{"array_info": each} for each in earlier],
    }
    return HEAD + frame(Opcode.TEXT, json.dumps(hello).encode()), HEAD


def test_frames_belong_to_the_stream_that_was_named_last_and_count_once() -> None:
    witness = Witness()
    tap = witness.tap()
    node, _ = connected(witness, "old", "new")
    tap.to_server(node)
    for first in (0, 10, 5):
        tap.to_server(frames(first, 10, "new"))
    tap.to_server(frame(Opcode.TEXT, json.dumps({"type": "stream", "stream_id": "old"}).encode()))
    tap.to_server(frames(70, 3, "old"))
    new, old = witness.frames("new"), witness.frames("old")
    assert new is not None
    assert old is not None
    np.testing.assert_array_equal(new["seq"], np.arange(20))
    np.testing.assert_array_equal(new["pressure_raw"][:, 0], np.arange(20))
    np.testing.assert_array_equal(old["seq"], [70, 71, 72])
    assert (witness.last_seq("new"), witness.last_seq("unknown")) == (19, None)


def test_an_acknowledgement_is_of_the_stream_it_names_or_else_of_the_present_one() -> None:
    witness = Witness()
    tap = witness.tap()
    node, server = connected(witness, "old", "new")
    tap.to_server(node)
    acks = [
        {"type": "welcome"},
        {"type": "ack", "seq_first": 0, "seq_last": 4},
        {"type": "ack", "seq_first": 3, "seq_last": 6},
        {"type": "ack", "stream_id": "old", "seq_first": 70, "seq_last": 70},
    ]
    said = [frame(Opcode.TEXT, json.dumps(ack).encode(), masked=False) for ack in acks]
    tap.to_node(server + b"".join(said))
    promised = witness.acknowledged()
    np.testing.assert_array_equal(promised["new"], np.arange(7))
    np.testing.assert_array_equal(promised["old"], [70])
