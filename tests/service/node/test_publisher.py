"""The publisher against a real server: everything arrives once, whatever happens between."""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import AsyncIterator, Callable, Iterator, Sequence
from contextlib import asynccontextmanager
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from websockets.asyncio.server import ServerConnection, serve

import service.node.back_off
import service.node.sending
import service.server
from devices.errors import UsageError
from service.link import (
    PROTOCOL,
    SUBPROTOCOL,
    Ack,
    EarlierStream,
    FramesOf,
    FromNode,
    Hello,
    Lost,
    Status,
    StreamNumbers,
    Wanted,
    Welcome,
    checked,
    heard,
    say,
)
from service.node.dial import ingest_url
from service.node.publisher import Publisher
from service.node.sending import Source
from storage.intervals import Intervals
from storage.journal.node_stream import NodeStream
from storage.journal.stream_notes import StreamNotes
from storage.journal.wanted import Wanted as NodeWanted
from storage.schema import wire_schema
from storage.wire import EncodedBatch, decode
from tests.service.fake_node import FakeNode, NodeOf
from tests.service.running import Running, ServeWith


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Try again soon."""
    monkeypatch.setattr(service.node.back_off, "BACK_OFF_S", (0.05, 0.1))
    monkeypatch.setattr(service.node.back_off, "REFUSED_BACK_OFF_S", (0.05, 0.1))


class Publishing:
    """A publisher that runs while a test's block does, with a fake node as its source of frames."""

    def __init__(
        self,
        node: FakeNode,
        server: str,
        token: str | None = None,
        earlier: Sequence[NodeStream] = (),
    ) -> None:
        self.node = node
        self.stream = NodeStream(Path("nowhere"), StreamNotes(array_info=node.info), None)
        self.earlier = tuple(earlier)
        self.reports: list[str] = []
        self.wanted: list[tuple[str, Wanted, tuple[str, ...]]] = []
        self.behind: list[int] = []
        self.damaged: list[Intervals] = []
        self.publisher = Publisher(
            server,
            Source(
                present=lambda: self.stream,
                streams=lambda: {s.boot_id: s for s in (*self.earlier, self.stream)},
                hello=self._hello,
                status=self._status,
                wanted=lambda *said: self.wanted.append(said),
                damaged=lambda stream, numbers: self.damaged.append(numbers),
            ),
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
        for batch in batches(self.node, n):
            self.stream.put(batch, 0)
        self.publisher.notify()

    async def until(self, condition: Callable[[], object], timeout_s: float = 5.0) -> None:
        end_s = time.monotonic() + timeout_s
        while not condition():
            assert time.monotonic() < end_s, (self.reports, self.stream.acked)
            await asyncio.sleep(0.005)

    async def emptied(self) -> None:
        await self.until(lambda: self.stream.acked.count == self.stream.next_seq)

    def _hello(self) -> Hello:
        hello: Hello = self.node.hello(
            held=tuple(self.stream.held),
            next_seq=self.stream.next_seq,
            lost=self.stream.lost.as_pairs(),
            earlier=tuple(
                EarlierStream(array_info=s.info, held=tuple(s.held), next_seq=s.next_seq)
                for s in self.earlier
            ),
        )
        return hello

    def _status(self, behind: int) -> Status:
        self.behind.append(behind)
        return Status(missed_slots=0, backlog_frames=behind)


def batches(node: FakeNode, n: int) -> list[EncodedBatch]:
    frames = node.frames(n)
    return [
        EncodedBatch.of(rows, node.payload(rows))
        for rows in (frames.rows(begin, begin + 10) for begin in range(0, n, 10))
    ]


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
            monkeypatch.setattr(service.server.server, "TICK_S", 0.5)
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
    serve_with: ServeWith, node_of: NodeOf
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


def test_a_right_token_is_taken(serve_with: ServeWith, node_of: NodeOf) -> None:
    running = serve_with(token="right")  # noqa: S106  # of this test
    node = node_of(running)

    async def scenario() -> None:
        async with Publishing(node, running.url, token="right") as publishing:  # noqa: S106  # of this test
            publishing.take(20)
            await publishing.emptied()

    asyncio.run(scenario())
    assert_all_arrived(running, node)


def test_a_name_that_is_taken_is_reported(
    running: Running, node: FakeNode, node_of: NodeOf
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


# --- against a server that a test plays -----------------------------------------------------------


class Script:
    """A server that says what a test has it say, and notes in which order frames come."""

    def __init__(self) -> None:
        self.port = 0
        self.hellos: list[Hello] = []
        self.came: list[tuple[str, int, int]] = []
        """Stream, first and last number of each message of frames."""
        self.said: list[Any] = []
        self.lacks: tuple[StreamNumbers, ...] = ()
        self.wanted = Wanted(streams=(), recording=False)
        self.acknowledges = True
        self.reads = asyncio.Event()
        self.reads.set()
        self.connection: ServerConnection | None = None
        self.schema: Any = None

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.port}"

    async def serve(self, connection: ServerConnection) -> None:
        self.connection = connection
        hello = FromNode.validate_json(heard(await connection.recv()))
        assert isinstance(hello, Hello)
        self.hellos.append(hello)
        lacks = self.lacks or (
            StreamNumbers(boot_id=hello.array_info.boot_id, numbers=((0, None),)),
        )
        welcome = Welcome(protocol=PROTOCOL, server_id="played", lacks=lacks, wanted=self.wanted)
        await connection.send(say(welcome))
        boot_id = hello.array_info.boot_id
        schema = wire_schema(hello.array_info)
        async for message in connection:
            await self.reads.wait()
            if isinstance(message, bytes):
                seq = decode(checked(message), schema).seq
                first, last = int(seq[0]), int(seq[-1])
                self.came.append((boot_id, first, last))
                if self.acknowledges:
                    ack = Ack(boot_id=boot_id, seq_first=first, seq_last=last)
                    await connection.send(say(ack))
                continue
            said = FromNode.validate_json(heard(message))
            self.said.append(said)
            if isinstance(said, FramesOf):
                boot_id = said.boot_id


@asynccontextmanager
async def played() -> AsyncIterator[Script]:
    script = Script()
    async with serve(
        script.serve,
        "127.0.0.1",
        0,
        subprotocols=[SUBPROTOCOL],  # type: ignore[list-item]  # a NewType of str
        ping_interval=None,
        compression=None,
        close_timeout=0.2,
        max_queue=4,
    ) as server:
        script.port = next(iter(server.sockets)).getsockname()[1]
        yield script


def test_the_newest_frames_come_first_and_the_past_behind_them(node: FakeNode) -> None:
    async def scenario() -> tuple[list[tuple[str, int, int]], list[int]]:
        async with played() as script:
            publishing = Publishing(node, script.url)
            publishing.take(1000)
            async with publishing:
                await publishing.until(lambda: script.came)
                publishing.take(10)
                await publishing.emptied()
                return script.came, publishing.behind

    came, behind = asyncio.run(scenario())
    first = [first for _, first, _ in came]
    assert sorted(first) == list(range(0, 1010, 10))
    # Not behind the thousand that were there before: ahead of most of them.
    assert first.index(1000) < 80
    past = [number for number in first if number < 1000]
    assert past == sorted(past)
    assert behind[0] > 0


def test_earlier_streams_are_named_before_their_frames(node: FakeNode) -> None:
    async def scenario() -> list[tuple[str, int, int]]:
        async with played() as script:
            old = NodeStream(Path("nowhere"), StreamNotes(array_info=node.info), None)
            for batch in batches(node, 50):
                old.put(batch, 0)
            old_id = node.boot_id
            node.reboot()
            publishing = Publishing(node, script.url, earlier=[old])
            publishing.take(20)
            script.lacks = (
                StreamNumbers(boot_id=old_id, numbers=((15, 34),)),
                StreamNumbers(boot_id=node.boot_id, numbers=((0, None),)),
            )
            async with publishing:
                publishing.take(10)
                await publishing.emptied()
                await publishing.until(lambda: len(script.came) == 6)
                assert old.acked == Intervals([(10, 39)])
                return [
                    (("new", "old")[b == old_id], first, last) for b, first, last in script.came
                ]

    came = asyncio.run(scenario())
    assert [c for c in came if c[0] == "old"] == [
        ("old", 10, 19),
        ("old", 20, 29),
        ("old", 30, 39),
    ]
    assert sorted(c for c in came if c[0] == "new") == [
        ("new", 0, 9),
        ("new", 10, 19),
        ("new", 20, 29),
    ]


def test_what_a_server_wants_is_told_with_the_streams_it_had_heard_of(node: FakeNode) -> None:
    async def scenario() -> Publishing:
        async with played() as script:
            wanted = Wanted(
                streams=(StreamNumbers(boot_id=node.boot_id, numbers=((5, None),)),), recording=True
            )
            script.wanted = wanted
            async with Publishing(node, script.url) as publishing:
                await publishing.until(lambda: publishing.wanted)
                assert script.connection is not None
                nothing = Wanted(streams=(), recording=False)
                await script.connection.send(say(nothing))
                await publishing.until(lambda: len(publishing.wanted) == 2)
            assert publishing.wanted[0] == ("played", wanted, (node.boot_id,))
            assert publishing.wanted[1] == ("played", nothing, (node.boot_id,))
            return publishing

    asyncio.run(scenario())


def test_losses_are_said_whenever_they_change(node: FakeNode) -> None:
    async def scenario() -> list[Lost]:
        async with played() as script, Publishing(node, script.url) as publishing:
            await publishing.until(lambda: script.said)
            publishing.stream.lose(Intervals([(3, 9)]), "disk_full", NodeWanted(Path("nowhere")))
            await publishing.until(lambda: any(isinstance(m, Lost) for m in script.said))
            await asyncio.sleep(0.1)
            return [message for message in script.said if isinstance(message, Lost)]

    [lost] = asyncio.run(scenario())
    assert lost == Lost(boot_id=node.boot_id, lost={"disk_full": ((3, 9),)})


def test_a_new_stream_is_announced_by_a_new_hello(node: FakeNode) -> None:
    async def scenario() -> list[Hello]:
        async with played() as script, Publishing(node, script.url) as publishing:
            publishing.take(20)
            await publishing.emptied()
            before = publishing.stream
            node.reboot()
            publishing.earlier = (before,)
            publishing.stream = NodeStream(Path("nowhere"), StreamNotes(array_info=node.info), None)
            publishing.publisher.renew()
            publishing.take(10)
            await publishing.emptied()
            return script.hellos

    first, second = asyncio.run(scenario())
    assert [s.array_info.boot_id for s in second.earlier] == [first.array_info.boot_id]


def test_a_link_that_is_half_open_is_noticed_and_dialled_again(
    node: FakeNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A server that reads nothing, and closes nothing: its machine has gone."""
    monkeypatch.setattr(service.node.sending, "_NO_ANSWER_S", 0.3)
    monkeypatch.setattr(service.node.sending, "_ASK_EVERY_S", 0.05)

    async def scenario() -> list[str]:
        async with played() as script:
            proxy = _Proxy(script.port)
            port = await proxy.start()
            async with Publishing(node, f"http://127.0.0.1:{port}") as publishing:
                publishing.take(20)
                await publishing.emptied()
                proxy.passes.clear()
                publishing.take(20)
                await publishing.until(lambda: len(publishing.reports) > 1)
                proxy.passes.set()
                await publishing.emptied()
                reports = publishing.reports
            await proxy.stop()
            return reports

    reports = asyncio.run(scenario())
    assert "has not answered" in reports[1]
    assert reports[-1].startswith("connected to")


class _Proxy:
    """Passes bytes on, unless it is told to keep them."""

    def __init__(self, port: int) -> None:
        self._port = port
        self.passes = asyncio.Event()
        self.passes.set()
        self._server: asyncio.Server | None = None
        self._tasks: set[asyncio.Task[None]] = set()

    async def start(self) -> int:
        self._server = await asyncio.start_server(self._pass, "127.0.0.1", 0)
        return int(self._server.sockets[0].getsockname()[1])

    async def stop(self) -> None:
        assert self._server is not None
        self._server.close()
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        await self._server.wait_closed()

    async def _pass(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.current_task()
        assert task is not None
        self._tasks.add(task)
        far_reader, far_writer = await asyncio.open_connection("127.0.0.1", self._port)

        async def one_way(source: asyncio.StreamReader, sink: asyncio.StreamWriter) -> None:
            while data := await source.read(4096):
                await self.passes.wait()
                sink.write(data)
                await sink.drain()

        try:
            await asyncio.wait(
                [
                    asyncio.create_task(one_way(reader, far_writer)),
                    asyncio.create_task(one_way(far_reader, writer)),
                ],
                return_when=asyncio.FIRST_COMPLETED,
            )
        finally:
            for each in asyncio.all_tasks():
                if each.get_coro().__qualname__.endswith("one_way"):  # type: ignore[union-attr]
                    each.cancel()
            writer.close()
            far_writer.close()
            self._tasks.discard(task)


def test_on_a_slow_link_the_newest_overtake_what_waits(node: FakeNode) -> None:
    """Half a second of frames may wait; what waits longer follows behind."""

    async def scenario() -> list[int]:
        async with played() as script:
            script.reads.clear()
            async with Publishing(node, script.url) as publishing:
                await publishing.until(lambda: script.hellos)
                for _ in range(60):
                    publishing.take(50)
                    await asyncio.sleep(0.01)
                script.reads.set()
                await publishing.emptied()
                return [first for _, first, _ in script.came]

    first = asyncio.run(scenario())
    assert sorted(first) == list(range(0, 3000, 10))
    assert first != sorted(first)
    newest = first.index(2990)
    assert newest < len(first) - 20  # much of what had waited came after it


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


def test_a_server_that_is_not_ours_is_reported_once(another_server: str, node: FakeNode) -> None:
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
