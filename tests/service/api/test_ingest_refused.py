"""Who says nonsense over a node's connection is let go, with the reason and alone."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import numpy as np
import pytest
from websockets.exceptions import ConnectionClosed

from devices.frames import FrameBatch
from service.protocol import INGEST_PATH, MESSAGE_BYTES_MAX, PROTOCOL
from tests.service.fake_node import FakeNode, NodeOf
from tests.service.running import Running, closed


def let_go(node: FakeNode, healthy: FakeNode) -> tuple[int, str]:
    """Code and reason with which the server lets a node go, while it keeps the other one."""
    said = closed(node.socket)
    assert_goes_on(healthy)
    return said


def assert_goes_on(healthy: FakeNode) -> None:
    """The server answers, and a node that was there all the time is taken in as before."""
    assert healthy.running.http.get("/health").json() == {"status": "ok", "problems": []}
    healthy.deliver(20)


@pytest.fixture
def healthy(running: Running, node_of: NodeOf) -> FakeNode:
    """Another node, which does everything right."""
    node = node_of(running, "healthy")
    assert node.connect() == [(0, None)]
    node.deliver(20)
    return node


@pytest.mark.parametrize("offered", [None, ["foottile.v2"], ["chat", "foottile.v0"]])
def test_another_subprotocol_is_refused(
    running: Running, healthy: FakeNode, offered: list[str] | None
) -> None:
    with running.socket(INGEST_PATH, subprotocols=offered) as socket:
        assert socket.subprotocol is None
        code, reason = closed(socket)
    assert code == 4002
    assert "foottile.v1" in reason
    assert_goes_on(healthy)


@pytest.mark.parametrize(
    ("first", "says"),
    [
        ('{"type":"hello","protocol":2,"array_info":{}}', "protocol 2; this server speaks 4: node"),
        ('{"type":"identify","protocol":5,"more":0}', "protocol 5; this server speaks 4: server"),
    ],
)
def test_another_protocol_number_is_refused(
    running: Running, healthy: FakeNode, node: FakeNode, first: str, says: str
) -> None:
    node.open().send(first)  # with fields of its own
    assert let_go(node, healthy) == (4002, says.replace(": ", ": update the "))
    assert running.http.get("/nodes/bench").status_code == 404


@pytest.mark.parametrize(
    "first",
    [
        b"\0\1\2",
        "",
        "hello",
        "null",
        "[]",
        "[" * 100_000,
        '{"type":"identify"}',
        '{"type":"goodbye"}',
        '{"type":"probe","id":1}',
        '{"type":"identify","protocol":4,"node":null}',
        '{"type":"identify","😀":1}',
    ],
    ids=lambda first: repr(first[:30]),
)
def test_whoever_does_not_identify_first_is_let_go(
    healthy: FakeNode, node: FakeNode, first: str | bytes
) -> None:
    node.open().send(first)
    code, reason = let_go(node, healthy)
    # What is no JSON object goes without a checksum, as if it had been damaged.
    assert code == (4001 if isinstance(first, bytes) or first.endswith("}") else 4004)
    assert reason


def test_no_step_of_the_handshake_can_be_left_out(healthy: FakeNode, node: FakeNode) -> None:
    node.open_and_identify()
    node.socket.send(node.hello().model_dump_json())
    assert let_go(node, healthy) == (4001, "proof was expected, not hello")
    node.prove().send('{"type":"probe","id":1}')
    assert let_go(node, healthy) == (4001, "hello was expected, not probe")
    node.prove().send(b"frames")
    assert let_go(node, healthy) == (4001, "hello was expected, in text")


@pytest.mark.parametrize(
    "change",
    [
        {"stored": [[-1, 5]]},
        {"stored": [[0, 2**62]]},
        {"stored": [[0]]},
        {"lost": {"Evicted!": [[0, 1]]}},
        {"earlier": [{}]},
        {"next_seq": 1.5},
        {"protocol": "one"},
        {"surprise": 1},
        {"calibration": {"version": 1}},
        {"scene": []},
    ],
    ids=str,
)
def test_a_malformed_hello_is_refused_with_the_place(
    healthy: FakeNode, node: FakeNode, change: dict[str, Any]
) -> None:
    hello = json.loads(node.hello().model_dump_json()) | change
    node.prove().send(json.dumps(hello))
    code, reason = let_go(node, healthy)
    assert code == 4001
    assert next(iter(change)) in reason


@pytest.mark.parametrize(
    "name", ["../outside", "..", ".", "", "a/b", "a\\b", "a\0b", ".hidden", "x" * 65, "naïve"]
)
def test_a_name_that_is_no_folders_name_is_refused(
    running: Running, node: FakeNode, name: str
) -> None:
    node.open().send(json.dumps({"type": "identify", "protocol": PROTOCOL, "node": name}))
    assert closed(node.socket)[0] == 4001
    info = node.info.model_copy(update={"node": name})
    node.open_with_hello(array_info=info)  # after it has identified itself with a right one
    assert closed(node.socket)[0] == 4001
    assert running.http.get("/nodes").json()["items"] == []
    assert not (running.data / "outside").exists()
    assert not (running.data / "nodes").exists()


@pytest.mark.parametrize("stream_id", ["../x", "", "0" * 31, "G" * 32, "0" * 32 + "/.."])
def test_a_stream_id_that_is_no_folders_name_is_refused(
    running: Running, node: FakeNode, stream_id: str
) -> None:
    info = node.info.model_copy(update={"stream_id": stream_id})
    node.open_with_hello(array_info=info)
    assert closed(node.socket)[0] == 4001
    assert running.http.get("/nodes").json()["items"] == []


def test_a_node_without_tiles_is_refused(running: Running, node: FakeNode) -> None:
    info = node.info.model_copy(update={"tiles": ()})
    node.open_with_hello(array_info=info)
    code, reason = closed(node.socket)
    assert code == 4001
    assert "no tiles" in reason
    assert running.http.get("/nodes").json()["items"] == []


def _backwards(node: FakeNode, payload: bytes) -> bytes:
    batch = node.sent[-1]
    return bytes(
        node.payload(FrameBatch.concatenate([batch.slice_rows(5, 10), batch.slice_rows(0, 5)]))
    )


def _endless(_: FakeNode, payload: bytes) -> bytes:
    # The message's length says 2 GiB.
    return payload[:4] + struct.pack("<i", 2**31 - 1) + payload[8:]


@pytest.mark.parametrize(
    "spoil",
    [
        lambda _, payload: b"",
        lambda _, payload: b"\0",
        lambda _, payload: payload[: len(payload) // 2],
        lambda _, payload: payload[:-1],
        lambda _, payload: payload[8:],
        lambda _, payload: np.random.default_rng(3).bytes(len(payload)),
        lambda _, payload: b"\xff" * 4 + np.random.default_rng(4).bytes(len(payload)),
        _backwards,
        _endless,
    ],
    ids=["empty", "one", "half", "all-but-one", "headless", "random", "marked", "order", "endless"],
)
def test_a_binary_message_that_is_no_frames_is_refused(
    healthy: FakeNode, node: FakeNode, spoil: Callable[[FakeNode, bytes], bytes]
) -> None:
    node.connect()
    node.send(10)
    payload = node.payload(node.frames(10))
    node.socket.send(spoil(node, payload))
    code, reason = let_go(node, healthy)
    assert code == 4001
    assert "bench" in reason
    assert node.connect() == [(10, None)]
    node.send_again(node.sent[-1])
    node.acknowledged(19, first=10)


def test_a_binary_message_with_flipped_bits_harms_nobody(healthy: FakeNode, node: FakeNode) -> None:
    random = np.random.default_rng(7)
    for _ in range(40):
        node.reboot()
        node.connect()
        spoilt = bytearray(node.payload(node.frames(10)))
        spoilt[random.integers(0, 400)] ^= 1 << int(random.integers(8))  # in its description
        node.socket.send(bytes(spoilt))
        with suppress(ConnectionClosed):
            node.socket.send("no JSON")  # it is hung up on in any case
        code, _ = closed(node.socket)
        assert code in (4001, 4004)
    assert_goes_on(healthy)


@pytest.mark.parametrize("message", ["x" * (MESSAGE_BYTES_MAX + 1), b"x" * (MESSAGE_BYTES_MAX + 1)])
def test_a_message_of_more_than_a_mebibyte_is_refused(
    healthy: FakeNode, node: FakeNode, message: str | bytes
) -> None:
    node.connect()
    node.socket.send(message)
    assert let_go(node, healthy)[0] == 1009


@pytest.mark.parametrize(
    ("message", "code"),
    [("{", 4004), ("\0", 4004), ('{"type":"ack"}', 4001), ('{"type":"probe","id":-1}', 4001)],
)
def test_a_text_message_that_is_none_is_refused(
    healthy: FakeNode, node: FakeNode, message: str, code: int
) -> None:
    """4004 for what its checksum does not fit, which may be right when it is sent again."""
    node.connect()
    node.socket.send(message)
    assert let_go(node, healthy)[0] == code


def test_a_second_hello_is_refused(healthy: FakeNode, node: FakeNode) -> None:
    node.connect()
    node.socket.send(node.hello().model_dump_json())
    code, reason = let_go(node, healthy)
    assert (code, reason) == (4001, "hello was sent before")


def test_a_name_that_is_in_use_is_refused_by_name(
    running: Running, node: FakeNode, node_of: NodeOf
) -> None:
    node.connect()
    node.send(10)
    other = node_of(running, secret=node.secret)  # from a copy of its card: another stream
    other.open_with_hello()
    code, reason = closed(other.socket)
    assert code == 4009
    assert "'bench'" in reason
    assert "--name" in reason
    assert running.node()["stream_id"] == node.stream_id
    assert_goes_on(node)


def test_what_another_version_wrote_of_a_node_does_not_keep_the_server_from_starting(
    running: Running, node: FakeNode
) -> None:
    node.connect()
    node.deliver(10)
    running.stop()
    path = running.data / "nodes" / "bench" / "hello.json"
    path.write_text('{"type":"hello","protocol":1,"first_seq":0}')
    running.start()
    assert running.http.get("/nodes").json()["items"] == []
    assert node.connect() == [(10, None)]


@pytest.mark.parametrize(
    "message",
    [
        {"type": "stream", "stream_id": "f" * 32},
        {"type": "stream", "stream_id": "../x"},
        {"type": "lost", "stream_id": "f" * 32, "lost": {}},
        {"type": "lost", "stream_id": None, "lost": {"evicted": [[5, 4]]}},
    ],
    ids=str,
)
def test_a_stream_that_was_not_announced_is_refused(
    healthy: FakeNode, node: FakeNode, message: dict[str, Any]
) -> None:
    node.connect()
    stream_id = message["stream_id"] or node.stream_id
    node.socket.send(json.dumps(message | {"stream_id": stream_id}))
    assert let_go(node, healthy)[0] == 4001


@pytest.mark.parametrize("what", ["name", "tiles", "twice", "stored"])
def test_earlier_streams_that_cannot_be_are_refused(
    healthy: FakeNode, node: FakeNode, what: str
) -> None:
    node.reboot()
    [before] = node.before
    changes: dict[str, dict[str, Any]] = {
        "name": {"node": "other"},
        "tiles": {"tiles": ()},
        "twice": {"stream_id": node.stream_id},
        "stored": {},
    }
    said = before.said(array_info=before.info.model_copy(update=changes[what]))
    if what == "stored":
        said = said.model_copy(update={"stored": ((5, 4),)})
    node.open_with_hello(earlier=(said,))
    assert let_go(node, healthy)[0] == 4001
