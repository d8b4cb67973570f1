"""Limits on messages of websockets: tokens, slices, fragments."""

from __future__ import annotations

import socket

import pytest
from hypothesis import given
from hypothesis import strategies as st
from websockets.frames import Frame, Opcode

from service.api.message_limits import FRAGMENTS_MAX, Allowance, MessageLimiter, find_frame_size
from service.api.settings import LimitSettings
from service.protocol.codec import LinkCloseCode
from service.protocol.link import INGEST_PATH
from service.protocol.live import LIVE_PATH
from tests.service.api.test_connection_limits import dial, read_until, upgrade
from tests.service.fake_node import NodeOf
from tests.service.running import Running, closed

BURST = 120
"""Frames of a connection at once: a minute of two a second."""
ADDRESS_BURST = 2000


class Clock:
    """A clock that a test sets."""

    now_s = 100.0

    def __call__(self) -> float:
        return self.now_s


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def limiter(clock: Clock) -> MessageLimiter:
    return MessageLimiter(LimitSettings(), clock)


def admit(limiter: MessageLimiter, address: str = "a") -> Allowance:
    allowance = limiter.admit_subscriber(address)
    assert allowance is not None
    return allowance


def send_until_closed(allowance: Allowance) -> int:
    sent = 0
    while allowance.take_frame():
        sent += 1
    return sent


def drain(limiter: MessageLimiter, address: str) -> int:
    """Reconnect and send as much as there is, until newcomers are refused; return the frames."""
    sent = 0
    while (allowance := limiter.admit_subscriber(address)) is not None:
        sent += send_until_closed(allowance)
    return sent


def test_a_connection_has_a_burst_and_then_its_rate(limiter: MessageLimiter, clock: Clock) -> None:
    one = admit(limiter)
    assert send_until_closed(one) == BURST
    clock.now_s += 10.0
    assert send_until_closed(one) == 20


def test_one_message_a_second_is_never_too_much(limiter: MessageLimiter, clock: Clock) -> None:
    pages = [admit(limiter, f"phone {number}") for number in range(200)]
    for _ in range(300):
        clock.now_s += 1.0
        assert all(page.take_frame() for page in pages)


def test_reconnecting_gives_an_address_no_more_than_its_burst_and_rate(
    limiter: MessageLimiter, clock: Clock
) -> None:
    assert drain(limiter, "flooder") <= ADDRESS_BURST + BURST
    sent = 0
    for _ in range(100):
        clock.now_s += 0.1
        sent += drain(limiter, "flooder")
    # Each new connection may use a quarter of its burst beyond the tokens of its address.
    assert sent <= 500 * 10 * 4


def test_a_flood_takes_no_page_down_and_keeps_other_addresses_in(
    limiter: MessageLimiter, clock: Clock
) -> None:
    beside, elsewhere = admit(limiter, "hotspot"), admit(limiter, "phone")
    for _ in range(60):
        clock.now_s += 1.0
        for flooding in ("hotspot", "b", "c", "d", "e"):
            drain(limiter, flooding)
        assert limiter.admit_subscriber("hotspot") is None
        assert limiter.admit_subscriber("newcomer") is not None
        assert beside.take_frame()
        assert elsewhere.take_frame()


def test_a_thousand_addresses_make_no_more_buckets(limiter: MessageLimiter) -> None:
    drain(limiter, "flooder")
    for number in range(5000):
        limiter.admit_subscriber(str(number))
    assert len(limiter._addresses) <= 1024
    assert limiter.admit_subscriber("flooder") is None


@given(
    st.sampled_from([Opcode.TEXT, Opcode.BINARY, Opcode.CONT]),
    st.sampled_from([0, 1, 125, 126, 127, 65535, 65536]),
    st.booleans(),
)
def test_the_size_of_a_frame_is_read_from_its_head(
    opcode: Opcode, payload_bytes: int, is_masked: bool
) -> None:
    frame = Frame(opcode, bytes(payload_bytes)).serialize(mask=is_masked)
    assert find_frame_size(bytearray(frame)) == len(frame)
    assert find_frame_size(bytearray(frame + b"more")) == len(frame)
    assert find_frame_size(bytearray(frame[:1])) is None


# --- over sockets ---------------------------------------------------------------------------------

MASK = bytes(4)
PING, FRAGMENT = b"\x89\x80" + MASK, b"\x00\x80" + MASK
FIRST_FRAGMENT = b"\x01\x80" + MASK
TEXT = b'{"type":"ping","t_ms":1}'
MESSAGE = b"\x81" + bytes([0x80 | len(TEXT)]) + MASK + TEXT


@pytest.mark.parametrize(
    "flood",
    [PING * 40_000, FIRST_FRAGMENT + FRAGMENT * 40_000, MESSAGE * 8000],
    ids=["pings", "empty fragments", "messages"],
)
def test_a_flooding_subscriber_is_told_why_it_is_closed(shared: Running, flood: bytes) -> None:
    with dial(shared) as connection:
        connection.sendall(upgrade(LIVE_PATH))
        read_until(connection, b"hello")
        sent = connection.send(flood)
        assert sent > BURST * len(MESSAGE)
        read_until(connection, LinkCloseCode.POLICY.to_bytes(2) + b"this client sends too many")
    assert shared.http.get("/health").status_code == 200


@pytest.mark.parametrize("step", [1, 5, 1000], ids=str)
def test_frames_are_the_same_however_they_are_split(shared: Running, step: int) -> None:
    content = (PING + MESSAGE) * 25
    with dial(shared) as connection:
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        connection.sendall(upgrade(LIVE_PATH))
        read_until(connection, b"hello")
        for start in range(0, len(content), step):
            connection.sendall(content[start : start + step])
        received = b""
        while received.count(b'"type":"pong"') < 25:
            piece = connection.recv(65536)
            assert piece, received
            received += piece
        assert received.count(b"\x8a\x00") >= 25


def test_a_node_sends_any_number_of_messages_but_few_pings(
    shared: Running, node_of: NodeOf
) -> None:
    node = node_of(shared, "quick")
    node.connect()
    for _ in range(3 * BURST):
        node.send(1, 20.0)
    node.acknowledged(3 * BURST - 1)
    node.socket.socket.sendall(PING * (BURST + 1))
    assert closed(node.socket)[0] == LinkCloseCode.POLICY


def test_a_message_of_a_node_has_few_fragments(shared: Running, node_of: NodeOf) -> None:
    node = node_of(shared, "torn")
    node.connect()
    node.socket.socket.sendall(FIRST_FRAGMENT + FRAGMENT * (FRAGMENTS_MAX + 1))
    assert closed(node.socket)[0] == LinkCloseCode.POLICY


def test_a_node_before_welcome_sends_few_frames(shared: Running) -> None:
    with shared.socket(INGEST_PATH) as link:
        link.socket.sendall(PING * 1000)
        assert closed(link)[0] == LinkCloseCode.POLICY
