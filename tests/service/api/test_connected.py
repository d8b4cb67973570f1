"""Silent nodes: disconnected after five seconds, however the link ends."""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import Any

import pytest
from websockets.sync.client import ClientConnection

from service.protocol.link import LINK_TIMEOUT_S
from tests.faults.proxy import Proxy
from tests.service.fake_node import FakeNode
from tests.service.running import Running, assert_refused
from tests.waiting import until

pytestmark = pytest.mark.real_time

LOOK_S = 5.0
"""A look takes this long beside other tests."""


class Through:
    """A server behind a link that may fail."""

    def __init__(self, running: Running, link: Proxy) -> None:
        self._running = running
        self._over = Running(running.data)
        self._over.port = link.port

    def __getattr__(self, name: str) -> Any:
        return getattr(self._running, name)

    def socket(self, path: str, **options: Any) -> ClientConnection:
        return self._over.socket(path, **options)


@pytest.fixture
def silence_s() -> float:
    """The product's own time-out."""
    return LINK_TIMEOUT_S


@pytest.fixture
def link(running: Running) -> Iterator[Proxy]:
    with Proxy(running.port) as proxy:
        yield proxy


@pytest.fixture
def far(running: Running, link: Proxy) -> Iterator[FakeNode]:
    """A tared node behind the link."""
    node = FakeNode(Through(running, link))  # type: ignore[arg-type]  # over the link
    node.connect()
    node.tared()
    yield node
    link.mend()
    node.close()


def wait_until_away_s(running: Running, begin_s: float) -> float:
    """Return the seconds from an instant until the node is disconnected."""
    until(lambda: not running.node()["connected"], 2 * LINK_TIMEOUT_S)
    return time.monotonic() - begin_s


@pytest.mark.slow
def test_a_node_out_of_reach_is_away_five_seconds_after_its_last_message(
    running: Running, link: Proxy, far: FakeNode
) -> None:
    begin_s = time.monotonic()
    far.send(10)
    far.taken_in()
    link.black_hole()
    assert LINK_TIMEOUT_S <= wait_until_away_s(running, begin_s) < LINK_TIMEOUT_S + LOOK_S
    node = running.node()
    assert node["rate_hz"] is None
    refused = running.http.post("/sessions", json={"node": "bench", "name": "late"})
    assert_refused(refused, 409, "sends no frames")


@pytest.mark.slow
def test_a_node_that_does_not_read_is_away_as_soon(
    running: Running, link: Proxy, far: FakeNode
) -> None:
    # The server's messages do not arrive, either, so the server must not wait for its close.
    far.send(200)
    running.call(lambda: running.server.links["bench"].queue_ack("0" * 32, far.acked))
    link.black_hole()
    assert wait_until_away_s(running, time.monotonic()) < LINK_TIMEOUT_S + LOOK_S


def test_a_node_whose_process_is_killed_is_away_at_once(
    running: Running, link: Proxy, far: FakeNode
) -> None:
    begin_s = time.monotonic()
    link.cut()  # the kernel of a killed process sends a reset
    assert wait_until_away_s(running, begin_s) < 0.5 + LOOK_S


def test_a_rate_is_that_of_the_last_second(running: Running, far: FakeNode) -> None:
    far.send(200)
    far.taken_in()
    assert running.node()["rate_hz"] > 0.0
    until(lambda: running.node()["rate_hz"] == 0.0)
