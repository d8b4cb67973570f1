"""The publisher against a real server: everything arrives once, whatever happens between."""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import Callable, Iterator
from http.server import BaseHTTPRequestHandler, HTTPServer
from typing import Any

import numpy as np
import pytest

import service.publisher
import service.server
from devices.errors import UsageError
from service.backlog import Backlog, EncodedBatch
from service.link import Hello, Status
from service.publisher import Publisher, ingest_url

Running = Any
FakeNode = Any


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Try again soon."""
    monkeypatch.setattr(service.publisher, "_BACK_OFF_S", (0.05, 0.1))


class Publishing:
    """A publisher that runs while a test's block does, with a fake node as its source of frames."""

    def __init__(self, node: FakeNode, server: str, token: str | None = None) -> None:
        self.node = node
        self.backlog = Backlog()
        self.reports: list[str] = []
        self.publisher = Publisher(
            server,
            hello=self._hello,
            backlog=self.backlog,
            status=lambda: Status(missed_slots=0, first_seq=self.backlog.first_seq),
            token=token,
            report=self.reports.append,
        )

    async def __aenter__(self) -> Publishing:
        self._before = asyncio.all_tasks()
        self._task = asyncio.create_task(self.publisher.run())
        return self

    async def __aexit__(self, *_: object) -> None:
        assert not self._task.done(), self._task
        self._task.cancel()
        await asyncio.gather(self._task, return_exceptions=True)
        await self.until(lambda: asyncio.all_tasks() <= self._before)

    def take(self, n: int) -> None:
        frames = self.node.frames(n)
        for begin in range(0, n, 10):
            rows = frames.rows(begin, begin + 10)
            self.backlog.append(
                EncodedBatch(int(rows.seq[0]), int(rows.seq[-1]), self.node.payload(rows))
            )
        self.publisher.notify()

    async def until(self, condition: Callable[[], object], timeout_s: float = 5.0) -> None:
        end_s = time.monotonic() + timeout_s
        while not condition():
            assert time.monotonic() < end_s, (self.reports, self.backlog.first_seq)
            await asyncio.sleep(0.005)

    async def emptied(self) -> None:
        await self.until(lambda: self.backlog.first_seq == self.backlog.next_seq)

    def _hello(self) -> Hello:
        hello: Hello = self.node.hello(
            first_seq=self.backlog.first_seq, next_seq=self.backlog.next_seq
        )
        return hello


def assert_all_arrived(running: Running, node: FakeNode) -> None:
    found = np.concatenate([b.seq for b in running.journal(node.boot_id).read(0, 2**61)])
    np.testing.assert_array_equal(found, np.arange(node.seq))


def test_everything_is_acknowledged_and_the_backlog_empties(
    running: Running, node: FakeNode
) -> None:
    async def scenario() -> list[str]:
        async with Publishing(node, running.url) as publishing:
            publishing.take(100)
            await publishing.emptied()
            for _ in range(5):
                publishing.take(30)
                await asyncio.sleep(0)
            await publishing.emptied()
            await asyncio.to_thread(running.http.get, "/health")
            return publishing.reports

    reports = asyncio.run(scenario())
    assert len(reports) == 1
    assert reports[0].startswith("connected to ws://127.0.0.1")
    assert_all_arrived(running, node)
    clock = running.node()["clock"]
    assert abs(clock["server_minus_node_ns"]) < 1e9
    assert 0 < clock["uncertainty_ns"] < 1e9


def test_nothing_is_lost_when_the_server_is_away_for_a_while(
    running: Running, node: FakeNode
) -> None:
    async def scenario() -> list[str]:
        async with Publishing(node, running.url) as publishing:
            for _ in range(3):
                publishing.take(100)
                # Not waited for: it may stop anywhere in it.
                await asyncio.to_thread(running.stop)
                publishing.take(100)
                await asyncio.to_thread(running.start)
            publishing.take(50)
            await publishing.until(
                lambda: (
                    running.server.nodes.get("bench").last_seq == node.seq - 1
                    if list(running.server.nodes)
                    else False
                )
            )
            await publishing.emptied()
            return publishing.reports

    reports = asyncio.run(scenario())
    assert reports[-1].startswith("connected to")
    assert_all_arrived(running, node)


def test_what_the_server_held_and_had_not_acknowledged_is_not_kept_for_ever(
    running: Running, node: FakeNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def scenario() -> None:
        async with Publishing(node, running.url) as publishing:
            publishing.take(50)
            await publishing.emptied()
            monkeypatch.setattr(service.server, "TICK_S", 0.5)
            publishing.take(10)
            await publishing.emptied()  # the next tick is half a second away
            publishing.take(10)
            bench = running.server.nodes.get("bench")
            await publishing.until(lambda: bench.last_seq == 69)
            await asyncio.to_thread(running.restart)
            publishing.take(10)
            await publishing.emptied()

    asyncio.run(scenario())


def test_a_server_that_comes_later_is_found(running: Running, node: FakeNode) -> None:
    running.stop()

    async def scenario() -> list[str]:
        async with Publishing(node, running.url) as publishing:
            publishing.take(50)
            await publishing.until(lambda: publishing.reports)
            await asyncio.sleep(0.5)  # several attempts
            said = list(publishing.reports)
            await asyncio.to_thread(running.start)
            await publishing.emptied()
            return said

    [reason] = asyncio.run(scenario())  # said once
    assert reason.startswith("not connected to ws://127.0.0.1")
    assert "trying again" in reason
    assert_all_arrived(running, node)


def test_a_wrong_token_is_reported_once_and_it_keeps_trying(
    serve_with: Callable[..., Running], node_of: Callable[..., FakeNode]
) -> None:
    running = serve_with(token="right")  # noqa: S106  # of this test
    node = node_of(running)

    async def scenario() -> list[str]:
        async with Publishing(node, running.url, token="wrong") as publishing:  # noqa: S106  # of this test
            await publishing.until(lambda: publishing.reports)
            await asyncio.sleep(0.5)  # several attempts
            return publishing.reports

    [reason] = asyncio.run(scenario())
    assert "FOOTTILE_TOKEN" in reason
    assert running.http.get("/nodes").json()["items"] == []


def test_a_right_token_is_taken(
    serve_with: Callable[..., Running], node_of: Callable[..., FakeNode]
) -> None:
    running = serve_with(token="right")  # noqa: S106  # of this test
    node = node_of(running)

    async def scenario() -> None:
        async with Publishing(node, running.url, token="right") as publishing:  # noqa: S106  # of this test
            publishing.take(20)
            await publishing.emptied()

    asyncio.run(scenario())
    assert_all_arrived(running, node)


def test_a_name_that_is_taken_is_reported(
    running: Running, node: FakeNode, node_of: Callable[..., FakeNode]
) -> None:
    node.connect()
    other = node_of(running)

    async def scenario() -> list[str]:
        async with Publishing(other, running.url) as publishing:
            await publishing.until(lambda: publishing.reports)
            await asyncio.sleep(0.3)
            return publishing.reports

    reports = asyncio.run(scenario())
    assert len(reports) == 1, reports
    assert "--name" in reports[0]


@pytest.fixture
def another_server(no_threads_left: None) -> Iterator[str]:
    """A web server that is not ours."""

    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def do_GET(self) -> None:
            self.send_response(200)
            self.send_header("Content-Length", "5")
            self.end_headers()
            self.wfile.write(b"hello")

        def log_message(self, *_: Any) -> None:
            pass

    with HTTPServer(("127.0.0.1", 0), Handler) as server:
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02})
        thread.start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()
        thread.join(5.0)


def test_a_server_that_is_not_ours_is_reported_once(
    another_server: str, running: Running, node: FakeNode
) -> None:
    async def scenario() -> list[str]:
        async with Publishing(node, another_server) as publishing:
            await publishing.until(lambda: publishing.reports)
            await asyncio.sleep(0.5)
            return publishing.reports

    [reason] = asyncio.run(scenario())
    assert "not connected" in reason
    assert "200" in reason


@pytest.mark.parametrize(
    ("server", "expected"),
    [
        ("http://127.0.0.1:8000", "ws://127.0.0.1:8000/api/v1/ingest"),
        ("http://robot.local", "ws://robot.local/api/v1/ingest"),
        ("https://robot.local/", "wss://robot.local/api/v1/ingest"),
        ("https://robot.local/foot/", "wss://robot.local/foot/api/v1/ingest"),
        ("ws://h:1", "ws://h:1/api/v1/ingest"),
        ("wss://h", "wss://h/api/v1/ingest"),
        ("HTTP://h:1", "ws://h:1/api/v1/ingest"),
        ("http://[::1]:8000", "ws://[::1]:8000/api/v1/ingest"),
        ("http://h:1/#token=x", "ws://h:1/api/v1/ingest"),
        ("http://h:1/?a=b", "ws://h:1/api/v1/ingest"),
    ],
)
def test_the_ingest_of_a_server_is_found_by_its_address(server: str, expected: str) -> None:
    assert ingest_url(server) == expected


@pytest.mark.parametrize(
    "server",
    [
        *("", "127.0.0.1:8000", "robot.local", "ftp://h", "http://", "http:///x", "http://:80"),
        *("http://h:port", "http://h:70000", "http://h:-1", "http://h:0", "/dev/i2c-1", "http:h"),
        "http://[::1",
    ],
)
def test_what_is_no_address_is_refused(server: str) -> None:
    with pytest.raises(UsageError, match="no server address"):
        ingest_url(server)


def test_a_redirect_is_no_end(node: FakeNode) -> None:
    asked: list[int] = []

    async def redirect(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await reader.readuntil(b"\r\n\r\n")
        location = b"Location: http://login.example/portal\r\n"
        writer.write(b"HTTP/1.1 302 Found\r\n" + location + b"Content-Length: 0\r\n\r\n")
        await writer.drain()
        writer.close()
        await writer.wait_closed()
        asked.append(1)

    async def scenario() -> list[str]:
        portal = await asyncio.start_server(redirect, "127.0.0.1", 0)
        port = portal.sockets[0].getsockname()[1]
        async with Publishing(node, f"http://127.0.0.1:{port}") as publishing:
            await publishing.until(lambda: len(asked) > 1)
        portal.close()
        await portal.wait_closed()
        return publishing.reports

    assert "trying again" in asyncio.run(scenario())[0]
