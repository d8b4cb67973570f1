"""The publisher against servers that a test plays: slow, half open, or none of ours."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest
from websockets.asyncio.server import ServerConnection, serve

import service.node.frame_sender
import service.server
from devices.errors import UsageError
from service.node.server_connection import make_ingest_url
from service.protocol.codec import (
    LinkCloseCode,
    encode_link_message,
    strip_binary_crc,
    strip_text_crc,
)
from service.protocol.link import (
    NODE_MESSAGES,
    PROTOCOL,
    SUBPROTOCOL,
    Ack,
    Challenge,
    Hello,
    Identify,
    LossReport,
    Proof,
    RetentionMessage,
    StreamNumbers,
    StreamSelect,
    Welcome,
    compute_fingerprint,
    make_proof,
)
from storage.intervals import Intervals
from storage.journal.node.retention import RetentionRequests as NodeWanted
from storage.journal.node.stream import NodeStream
from storage.journal.stream_notes import StreamNotes
from storage.schema import wire_schema
from storage.wire import decode_message
from tests.faults.proxy import Proxy
from tests.service.fake_node import FakeNode
from tests.service.node.publishing import Publishing, batches
from tests.waiting import in_a_loop


class Script:
    """A server that says what a test has it say, and notes in which order frames come."""

    def __init__(self) -> None:
        self.port = 0
        self.is_known = False
        self.proofs: list[Proof] = []
        self.hellos: list[Hello] = []
        self.came: list[tuple[str, int, int]] = []
        """Stream, first and last number of each message of frames."""
        self.said: list[Any] = []
        self.lacks: tuple[StreamNumbers, ...] = ()
        self.wanted = RetentionMessage(streams=(), recording=False)
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
        assert isinstance(
            NODE_MESSAGES.validate_json(strip_text_crc(await connection.recv())), Identify
        )
        challenge = Challenge(
            protocol=PROTOCOL, server_id="played", nonce="0" * 64, is_known=self.is_known
        )
        await connection.send(encode_link_message(challenge))
        proof = NODE_MESSAGES.validate_json(strip_text_crc(await connection.recv()))
        assert isinstance(proof, Proof)
        self.proofs.append(proof)
        hello = NODE_MESSAGES.validate_json(strip_text_crc(await connection.recv()))
        assert isinstance(hello, Hello)
        self.hellos.append(hello)
        lacks = self.lacks or (
            StreamNumbers(stream_id=hello.array_info.stream_id, numbers=((0, None),)),
        )
        welcome = Welcome(protocol=PROTOCOL, missing=lacks, retention=self.wanted)
        await connection.send(encode_link_message(welcome))
        stream_id = hello.array_info.stream_id
        schema = wire_schema(hello.array_info)
        async for message in connection:
            await self.reads.wait()
            if isinstance(message, bytes):
                seq = decode_message(strip_binary_crc(message), schema).seq
                first, last = int(seq[0]), int(seq[-1])
                self.came.append((stream_id, first, last))
                if self.acknowledges:
                    ack = Ack(stream_id=stream_id, seq_first=first, seq_last=last)
                    await connection.send(encode_link_message(ack))
                continue
            said = NODE_MESSAGES.validate_json(strip_text_crc(message))
            self.said.append(said)
            if isinstance(said, StreamSelect):
                stream_id = said.stream_id


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


@in_a_loop
async def test_a_node_shows_its_secret_only_where_it_is_not_known_or_was_refused(
    node: FakeNode,
) -> None:
    async with played() as script:
        async with Publishing(node, script.url) as publishing:
            await publishing.until(lambda: publishing.publisher.is_connected)
            script.is_known = True
            publishing.publisher.reconnect_for_new_stream()
            await publishing.until(lambda: len(script.hellos) == 2)
            assert script.connection is not None
            await script.connection.close(LinkCloseCode.WRONG_IDENTITY, "accept it")
            await publishing.until(lambda: len(script.hellos) == 3)
        assert node.secret is not None
        fingerprint = compute_fingerprint(node.secret)
        assert any("accept it" in said and fingerprint in said for said in publishing.reports)
    first, second, third = script.proofs
    assert first == third == Proof(secret=node.secret)
    challenge = Challenge(protocol=PROTOCOL, server_id="played", nonce="0" * 64, is_known=True)
    assert second == Proof(proof=make_proof(node.secret, challenge, node.name))


@in_a_loop
async def test_the_newest_frames_come_first_and_the_past_behind_them(node: FakeNode) -> None:
    async with played() as script:
        publishing = Publishing(node, script.url)
        publishing.take(1000)
        async with publishing:
            await publishing.until(lambda: script.came)
            publishing.take(10)
            await publishing.emptied()
    came, behind = script.came, publishing.behind
    first = [first for _, first, _ in came]
    assert sorted(first) == list(range(0, 1010, 10))
    # Not behind the thousand that were there before: ahead of most of them.
    assert first.index(1000) < 80
    past = [number for number in first if number < 1000]
    assert past == sorted(past)
    assert behind[0] > 0


@in_a_loop
async def test_earlier_streams_are_named_before_their_frames(node: FakeNode) -> None:
    async with played() as script:
        old = NodeStream(Path("nowhere"), StreamNotes(array_info=node.info), None)
        for batch in batches(node, 50):
            old.queue_batch_and_record_gap(batch, 0)
        old_id = node.stream_id
        node.reboot()
        publishing = Publishing(node, script.url, earlier=[old])
        publishing.take(20)
        script.lacks = (
            StreamNumbers(stream_id=old_id, numbers=((15, 34),)),
            StreamNumbers(stream_id=node.stream_id, numbers=((0, None),)),
        )
        async with publishing:
            publishing.take(10)
            await publishing.emptied()
            await publishing.until(lambda: len(script.came) == 6)
            assert old.acked == Intervals([(10, 39)])
    came = [(("new", "old")[b == old_id], first, last) for b, first, last in script.came]
    assert [c for c in came if c[0] == "old"] == [("old", 10, 19), ("old", 20, 29), ("old", 30, 39)]
    new = sorted(c for c in came if c[0] == "new")
    assert new == [("new", 0, 9), ("new", 10, 19), ("new", 20, 29)]


@in_a_loop
async def test_a_retention_request_comes_with_the_streams_that_the_server_knew(
    node: FakeNode,
) -> None:
    async with played() as script:
        wanted = RetentionMessage(
            streams=(StreamNumbers(stream_id=node.stream_id, numbers=((5, None),)),), recording=True
        )
        script.wanted = wanted
        async with Publishing(node, script.url) as publishing:
            await publishing.until(lambda: publishing.wanted)
            assert script.connection is not None
            nothing = RetentionMessage(streams=(), recording=False)
            await script.connection.send(encode_link_message(nothing))
            await publishing.until(lambda: len(publishing.wanted) == 2)
        assert publishing.wanted[0] == ("played", wanted, (node.stream_id,))
        assert publishing.wanted[1] == ("played", nothing, (node.stream_id,))


@in_a_loop
async def test_a_message_of_the_handshake_after_it_ends_the_connection(node: FakeNode) -> None:
    async with played() as script, Publishing(node, script.url) as publishing:
        await publishing.until(lambda: script.said)
        again = Welcome(protocol=PROTOCOL, missing=(), retention=script.wanted)
        assert script.connection is not None
        await script.connection.send(encode_link_message(again))
        await publishing.until(lambda: len(script.hellos) == 2)
    [said] = [report for report in publishing.reports if "'welcome'" in report]
    assert "the server sent 'welcome' here" in said
    assert "ack, retain or probe" in said


@in_a_loop
async def test_losses_are_said_whenever_they_change(node: FakeNode) -> None:
    async with played() as script, Publishing(node, script.url) as publishing:
        await publishing.until(lambda: script.said)
        publishing.stream.record_unacked_or_node_session_loss(
            Intervals([(3, 9)]), "disk_full", NodeWanted(Path("nowhere"))
        )
        await publishing.until(lambda: any(isinstance(m, LossReport) for m in script.said))
        await asyncio.sleep(0.1)
    [lost] = [message for message in script.said if isinstance(message, LossReport)]
    assert lost == LossReport(stream_id=node.stream_id, lost={"disk_full": ((3, 9),)})


@in_a_loop
async def test_a_new_stream_is_announced_by_a_new_hello(node: FakeNode) -> None:
    async with played() as script, Publishing(node, script.url) as publishing:
        publishing.take(20)
        await publishing.emptied()
        before = publishing.stream
        node.reboot()
        publishing.earlier = (before,)
        publishing.stream = NodeStream(Path("nowhere"), StreamNotes(array_info=node.info), None)
        publishing.publisher.reconnect_for_new_stream()
        publishing.take(10)
        await publishing.emptied()
    first, second = script.hellos
    assert [s.array_info.stream_id for s in second.earlier] == [first.array_info.stream_id]


@in_a_loop
async def test_a_link_that_is_half_open_is_noticed_and_dialled_again(
    node: FakeNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A server that reads nothing, and closes nothing: its machine has gone."""
    monkeypatch.setattr(service.node.frame_sender, "_PING_TIMEOUT_S", 0.3)
    monkeypatch.setattr(service.node.frame_sender, "_PING_INTERVAL_S", 0.05)
    async with played() as script:
        with Proxy(script.port) as proxy:
            async with Publishing(node, f"http://127.0.0.1:{proxy.port}") as publishing:
                publishing.take(20)
                await publishing.emptied()
                proxy.black_hole()
                publishing.take(20)
                await publishing.until(lambda: len(publishing.reports) > 1)
                proxy.mend()
                await publishing.emptied()
    assert "has not answered" in publishing.reports[1]
    assert publishing.reports[-1].startswith("connected to")


@in_a_loop
async def test_the_newest_frames_overtake_waiting_ones_on_a_slow_link(node: FakeNode) -> None:
    """Half a second of frames may wait; what waits longer follows behind."""
    async with played() as script:
        script.reads.clear()
        async with Publishing(node, script.url) as publishing:
            await publishing.until(lambda: script.hellos)
            for _ in range(60):
                publishing.take(50)
                await asyncio.sleep(0.01)
            script.reads.set()
            await publishing.emptied()
    first = [first for _, first, _ in script.came]
    assert sorted(first) == list(range(0, 3000, 10))
    assert first != sorted(first)
    newest = first.index(2990)
    assert newest < len(first) - 20  # much of what had waited came after it


PORTAL = b"HTTP/1.1 302 Found\r\nLocation: http://login.example/\r\nContent-Length: 0\r\n\r\n"
WEB_PAGE = b"HTTP/1.1 200 OK\r\nContent-Length: 5\r\n\r\nhello"


@pytest.mark.parametrize(("answer", "reason"), [(WEB_PAGE, "200"), (PORTAL, "trying again")])
@in_a_loop
async def test_a_server_that_is_not_ours_is_said_once_and_asked_again(
    node: FakeNode, answer: bytes, reason: str
) -> None:
    asked: list[int] = []

    async def serve_foreign(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await reader.readuntil(b"\r\n\r\n")
        writer.write(answer)
        await writer.drain()
        writer.close()
        await writer.wait_closed()
        asked.append(1)

    async with await asyncio.start_server(serve_foreign, "127.0.0.1", 0) as foreign:
        port = foreign.sockets[0].getsockname()[1]
        async with Publishing(node, f"http://127.0.0.1:{port}") as publishing:
            await publishing.until(lambda: len(asked) > 2)
    (said,) = publishing.reports
    assert said.startswith("not connected to")
    assert reason in said


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
    assert make_ingest_url(server) == expected


@pytest.mark.parametrize(
    "server",
    [
        *("", "127.0.0.1:8000", "robot.local", "ftp://h", "http://", "http:///x", "http://:80"),
        *("http://h:port", "http://h:70000", "http://h:-1", "http://h:0", "/dev/i2c-1", "http:h"),
        "http://[::1",
    ],
)
def test_a_text_that_is_no_address_is_refused(server: str) -> None:
    with pytest.raises(UsageError, match="no server address"):
        make_ingest_url(server)
