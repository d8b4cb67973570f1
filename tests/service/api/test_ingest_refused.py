"""Nonsense on a node's connection: it is closed with a reason, and no other node notices."""

from __future__ import annotations

import itertools
import json
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest

from devices.frames import FrameBatch
from service.protocol.link import INGEST_PATH, MESSAGE_BYTES_MAX, PROTOCOL
from storage.verify.journal import verify_journal
from tests.builders.frames import assert_same_bits, with_columns
from tests.builders.odd_values import with_value
from tests.service.fake_node import FakeNode, NodeOf
from tests.service.running import Running, closed

HOUR_NS = 3_600_000_000_000
NUMBERS = itertools.count()


@pytest.fixture(scope="module")
def healthy(shared: Running) -> Iterator[FakeNode]:
    """A node without faults, connected all the time."""
    node = FakeNode(shared, "healthy")
    assert node.connect() == [(0, None)]
    node.deliver(20)
    yield node
    node.close()


@pytest.fixture
def odd(shared: Running) -> Iterator[FakeNode]:
    """A node of the test's own."""
    node = FakeNode(shared, f"odd-{next(NUMBERS)}")
    yield node
    node.close()


def wait_for_close(node: FakeNode, healthy: FakeNode) -> tuple[int, str]:
    """Return the server's code and reason; the other node goes on."""
    end = closed(node.socket)
    assert_goes_on(healthy)
    return end


def assert_goes_on(healthy: FakeNode) -> None:
    assert healthy.running.http.get("/health").json() == {"status": "ok", "problems": []}
    healthy.deliver(20)


def assert_unknown(node: FakeNode) -> None:
    """The server knows neither the node nor its secret."""
    assert node.running.http.get(f"/nodes/{node.name}").status_code == 404
    assert not (node.running.data / "nodes" / node.name).exists()


@pytest.mark.parametrize("offered", [None, ["foottile.v2"], ["chat", "foottile.v0"]])
def test_another_subprotocol_is_refused(healthy: FakeNode, offered: list[str] | None) -> None:
    with healthy.running.socket(INGEST_PATH, subprotocols=offered) as socket:
        assert socket.subprotocol is None
        code, reason = closed(socket)
    assert (code, "foottile.v1" in reason) == (4002, True)
    assert_goes_on(healthy)


@pytest.mark.parametrize(
    ("first", "reason"),
    [
        (
            '{"type":"hello","protocol":2,"array_info":{}}',
            f"protocol 2; this server speaks {PROTOCOL}: node",
        ),
        (
            f'{{"type":"identify","protocol":{PROTOCOL + 1},"more":0}}',
            f"protocol {PROTOCOL + 1}; this server speaks {PROTOCOL}: server",
        ),
    ],
)
def test_another_protocol_is_refused(
    healthy: FakeNode, odd: FakeNode, first: str, reason: str
) -> None:
    odd.open().send(first)  # with fields of its own
    assert wait_for_close(odd, healthy) == (4002, reason.replace(": ", ": update the "))
    assert_unknown(odd)


@pytest.mark.parametrize(
    "first",
    [
        *(b"\0\1\2", "", "hello", "null", "[]", "[" * 100_000, '{"type":"identify"}'),
        *('{"type":"goodbye"}', '{"type":"probe","id":1}', '{"type":"identify","😀":1}'),
        f'{{"type":"identify","protocol":{PROTOCOL},"node":null}}',
    ],
    ids=lambda first: repr(first[:30]),
)
def test_a_node_has_to_identify_first(healthy: FakeNode, odd: FakeNode, first: str | bytes) -> None:
    odd.open().send(first)
    code, reason = wait_for_close(odd, healthy)
    # Only a JSON object has a checksum; any other text counts as damaged.
    assert code == (4001 if isinstance(first, bytes) or first.endswith("}") else 4004)
    assert reason


def test_each_step_of_the_handshake_is_needed_once(healthy: FakeNode, odd: FakeNode) -> None:
    odd.open_and_identify()
    odd.socket.send(odd.hello().model_dump_json())
    assert wait_for_close(odd, healthy) == (4001, "proof was expected, not hello")
    odd.prove().send('{"type":"probe","id":1}')
    assert wait_for_close(odd, healthy) == (4001, "hello was expected, not probe")
    odd.prove().send(b"frames")
    assert wait_for_close(odd, healthy) == (4001, "hello was expected, in text")
    odd.connect()
    odd.socket.send(odd.hello().model_dump_json())
    assert wait_for_close(odd, healthy) == (4001, "hello was sent before")


@pytest.mark.parametrize(
    ("place", "value"),
    [
        (("surprise",), 1),
        (("array_info", "tiles"), ()),
        *[
            (("array_info", "stream_id"), stream_id)
            for stream_id in ("../x", "", "0" * 31, "G" * 32, "0" * 32 + "/..")
        ],
    ],
    ids=str,
)
def test_a_malformed_hello_is_refused_and_leaves_no_trace(
    healthy: FakeNode, odd: FakeNode, place: Any, value: Any
) -> None:
    hello = json.loads(odd.hello().model_dump_json())
    hello = hello | {place[0]: value} if len(place) == 1 else with_value(hello, place, value)
    odd.prove().send(json.dumps(hello))
    code, reason = wait_for_close(odd, healthy)
    assert code == 4001
    assert any(word in reason for word in place[:2])
    assert_unknown(odd)
    assert odd.connect() == [(0, None)]


@pytest.mark.parametrize(
    "name", ["../outside", "..", ".", "", "a/b", "a\\b", "a\0b", ".hidden", "x" * 65, "naïve"]
)
def test_a_name_has_to_be_that_of_a_folder(odd: FakeNode, name: str) -> None:
    odd.open().send(json.dumps({"type": "identify", "protocol": PROTOCOL, "node": name}))
    assert closed(odd.socket)[0] == 4001
    # After a right name in the identification.
    odd.open_with_hello(array_info=odd.info.model_copy(update={"node": name}))
    assert closed(odd.socket)[0] == 4001
    assert_unknown(odd)
    assert name not in [known["node"] for known in odd.running.http.get("/nodes").json()["items"]]
    assert not (odd.running.data / "outside").exists()
    assert not (odd.running.data / "hello.json").exists()


@pytest.mark.parametrize("fault", ["name", "tiles", "twice", "stored"])
def test_an_impossible_earlier_stream_is_refused(
    healthy: FakeNode, odd: FakeNode, fault: str
) -> None:
    odd.reboot()
    [before] = odd.before
    changes: dict[str, dict[str, Any]] = {
        "name": {"node": "other"},
        "tiles": {"tiles": ()},
        "twice": {"stream_id": odd.stream_id},
        "stored": {},
    }
    earlier = before.said(array_info=before.info.model_copy(update=changes[fault]))
    if fault == "stored":
        earlier = earlier.model_copy(update={"stored": ((5, 4),)})
    odd.open_with_hello(earlier=(earlier,))
    assert wait_for_close(odd, healthy)[0] == 4001


@pytest.mark.parametrize(
    ("message", "code"),
    [
        ("{", 4004),
        ("\0", 4004),
        ('{"type":"ack"}', 4001),
        ('{"type":"probe","id":-1}', 4001),
        ('{"type":"stream","stream_id":"../x"}', 4001),
        (json.dumps({"type": "stream", "stream_id": "f" * 32}), 4001),
        (json.dumps({"type": "lost", "stream_id": "f" * 32, "lost": {}}), 4001),
        (json.dumps({"type": "lost", "stream_id": "own", "lost": {"evicted": [[5, 4]]}}), 4001),
        ("x" * (MESSAGE_BYTES_MAX + 1), 1009),
        (b"x" * (MESSAGE_BYTES_MAX + 1), 1009),
    ],
    ids=lambda value: repr(value)[:60],
)
def test_a_wrong_message_is_refused(
    healthy: FakeNode, odd: FakeNode, message: str | bytes, code: int
) -> None:
    """4004 is for a wrong checksum: the message may be right when it is sent again."""
    odd.connect()
    if isinstance(message, str):
        message = message.replace('"own"', f'"{odd.stream_id}"')
    odd.socket.send(message)
    assert wait_for_close(odd, healthy)[0] == code


def reverse(node: FakeNode, payload: bytes) -> bytes:
    batch = node.sent[-1]
    return node.payload(FrameBatch.concatenate([batch.slice_rows(5, 10), batch.slice_rows(0, 5)]))


@pytest.mark.parametrize(
    "spoil",
    [lambda _, payload: payload[: len(payload) // 2], reverse],
    ids=["half", "in another order"],
)
def test_a_damaged_batch_is_refused_and_asked_for_again(
    healthy: FakeNode, odd: FakeNode, spoil: Callable[[FakeNode, bytes], bytes]
) -> None:
    odd.connect()
    odd.send(10)
    payload = odd.payload(odd.frames(10))
    odd.socket.send(spoil(odd, payload))
    code, reason = wait_for_close(odd, healthy)
    assert (code, odd.name in reason) == (4001, True)
    assert odd.connect() == [(10, None)]
    odd.send_again(odd.sent[-1])
    odd.acknowledged(19, first=10)


@pytest.mark.parametrize("t_mono_ns", [2**60, 2**62, 2**63 - 100, -(2**63)])
def test_an_instant_out_of_range_is_refused(odd: FakeNode, t_mono_ns: int) -> None:
    odd.connect()
    frames = odd.frames(10)
    with np.errstate(over="ignore"):
        t_ns = np.full(10, t_mono_ns) + np.int64(odd.utc_offset_ns)
    wrong = FrameBatch(**{**vars(frames), "t_mono_ns": np.full(10, t_mono_ns), "t_ns": t_ns})
    odd.socket.send(odd.payload(wrong))
    assert closed(odd.socket)[0] == 4001


def test_late_frames_have_to_fit_earlier_ones(odd: FakeNode) -> None:
    odd.connect()
    odd.frames(50)
    odd.deliver(20)
    first = odd.sent[0]
    shifted = with_columns(first, t_mono_ns=first.t_mono_ns + 60_000_000)
    odd.socket.send(odd.payload(shifted.slice_rows(40, 50)))
    code, reason = closed(odd.socket)
    assert (code, "40 to 49" in reason) == (4001, True)
    odd.connect()
    odd.send_again(first.slice_rows(0, 40))
    odd.acknowledged(39)


def test_no_frame_follows_the_end_of_a_stream(odd: FakeNode) -> None:
    odd.connect()
    odd.deliver(20)
    more = odd.frames(10)
    odd.restart()
    [before] = odd.before
    before.next_seq = 20
    odd.connect(earlier=(before.said(),))
    before.sent[-1] = more
    odd.send_earlier(before, 20, 29)
    code, reason = closed(odd.socket)
    assert (code, "frames 20 to 29" in reason) == (4001, True)


def test_frames_whose_time_runs_backwards_are_lost(running: Running, node: FakeNode) -> None:
    node.connect()
    node.deliver(20)
    late = node.frames(10)
    node.socket.send(node.payload(with_columns(late, t_mono_ns=late.t_mono_ns - 25_000_000)))
    code, reason = closed(node.socket)
    assert (code, "frames 20 to 29" in reason) == (4001, True)
    assert node.connect() == [(30, None)]
    node.deliver(20)
    assert running.node()["lost"] == {"refused": 10}
    assert not node.acked.restricted_to(20, 29)
    running.restart()
    assert node.connect() == [(50, None)]
    running.stop()
    report = verify_journal(running.data / "journal" / "bench" / node.stream_id)
    assert report.problems == []
    assert report.lost.to_pairs() == {"refused": ((20, 29),)}


def test_frames_dated_ahead_are_dropped_and_true_ones_stored(
    running: Running, tared: FakeNode
) -> None:
    session = tared.record()
    tared.deliver(20)
    seq, clock_ns = tared.seq, tared.next_t_mono_ns
    for ahead_ns, ahead_seq in ((HOUR_NS, 0), (10 * HOUR_NS, 0), (0, 10**9)):
        tared.seq, tared.next_t_mono_ns = seq + ahead_seq, clock_ns + ahead_ns
        tared.send(10, 99.0)
        tared.sent.pop()
    tared.seq, tared.next_t_mono_ns = seq, clock_ns
    tared.deliver(50)
    assert tared.acked == tared.acked.restricted_to(0, tared.seq - 1)
    (warning,) = running.node()["warnings"]
    assert "30 frames were refused" in warning
    assert_same_bits(running.held(tared.stream_id), tared.all_sent())
    sealed = tared.finish(session)
    assert (sealed["complete"], sealed["frames"]) == (True, 70)


def test_a_name_in_use_is_refused(running: Running, node: FakeNode, node_of: NodeOf) -> None:
    node.connect()
    node.send(10)
    copy = node_of(running, secret=node.secret)  # of its card, with another stream
    copy.open_with_hello()
    code, reason = closed(copy.socket)
    assert (code, "'bench'" in reason, "--name" in reason) == (4009, True, True)
    assert running.node()["stream_id"] == node.stream_id
    node.deliver(10)
    node.leave()
    copy.connect()
    copy.deliver(10)
