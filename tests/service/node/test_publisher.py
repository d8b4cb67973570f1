"""The publisher against a real server: everything arrives once, whatever happens between."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from itertools import count

import pytest

import service.node.frame_sender
import service.server
from storage.journal.node.stream import NodeStream
from storage.wire import EncodedBatch
from tests.service.fake_node import FakeNode, NodeOf
from tests.service.node.publishing import Publishing, assert_all_arrived
from tests.service.running import Running, ServeWith
from tests.waiting import in_a_loop


@in_a_loop
async def test_everything_is_acknowledged_and_the_backlog_empties(
    running: Running, node: FakeNode
) -> None:
    async with Publishing(node, running.url) as publishing:
        publishing.take(100)
        await publishing.emptied()
        for _ in range(5):
            publishing.take(30)
            await asyncio.sleep(0)
        await publishing.emptied()
        await asyncio.to_thread(running.http.get, "/health")
    assert len(publishing.reports) == 1
    assert publishing.reports[0].startswith("connected to ws://127.0.0.1")
    assert_all_arrived(running, node)
    clock = running.node()["clock"]
    assert abs(clock["server_minus_node_ns"]) < 1e9
    assert 0 < clock["uncertainty_ns"] < 1e9


@in_a_loop
async def test_nothing_is_lost_when_the_server_is_away_for_a_while(
    running: Running, node: FakeNode
) -> None:
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
    assert publishing.reports[-1].startswith("connected to")
    assert_all_arrived(running, node)


@in_a_loop
async def test_frames_stored_and_not_acknowledged_before_a_restart_are_not_kept_for_ever(
    running: Running, node: FakeNode, monkeypatch: pytest.MonkeyPatch
) -> None:
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


@in_a_loop
async def test_a_server_that_comes_later_is_found(running: Running, node: FakeNode) -> None:
    running.stop()
    async with Publishing(node, running.url) as publishing:
        publishing.take(50)
        await publishing.until(lambda: publishing.reports)
        await asyncio.sleep(0.5)  # several attempts
        said = list(publishing.reports)
        await asyncio.to_thread(running.start)
        await publishing.emptied()
    [reason] = said  # said once
    assert reason.startswith("not connected to ws://127.0.0.1")
    assert "trying again" in reason
    assert_all_arrived(running, node)


@in_a_loop
async def test_a_wrong_token_is_reported_once_and_a_right_one_is_taken(
    serve_with: ServeWith, node_of: NodeOf
) -> None:
    running = serve_with(token="right")  # noqa: S106  # of this test
    node = node_of(running)
    async with Publishing(node, running.url, token="wrong") as publishing:  # noqa: S106  # of this test
        await publishing.until(lambda: publishing.reports)
        await asyncio.sleep(0.5)  # several attempts
    [reason] = publishing.reports
    assert "FOOTTILE_TOKEN is not the server's token" in reason
    assert running.http.get("/nodes").json()["items"] == []
    async with Publishing(node, running.url, token="right") as publishing:  # noqa: S106  # of this test
        publishing.take(20)
        await publishing.emptied()
    assert_all_arrived(running, node)


@in_a_loop
async def test_a_name_that_is_taken_is_reported(
    running: Running, node: FakeNode, node_of: NodeOf
) -> None:
    node.connect()
    other = node_of(running, secret=node.secret)
    async with Publishing(other, running.url) as publishing:
        await publishing.until(lambda: publishing.reports)
        await asyncio.sleep(0.3)
    assert len(publishing.reports) == 1, publishing.reports
    assert "--name" in publishing.reports[0]


@in_a_loop
async def test_frames_on_their_way_between_memory_and_disk_are_sent_a_moment_later(
    running: Running, node: FakeNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A look at both may miss what goes from one to the other; it is held all the same."""
    given, looks = NodeStream.read_overlapping_batches, count()

    def not_at_first(stream: NodeStream, seq_first: int, seq_last: int) -> Iterator[EncodedBatch]:
        return iter(()) if next(looks) == 0 else given(stream, seq_first, seq_last)

    monkeypatch.setattr(NodeStream, "read_overlapping_batches", not_at_first)
    publishing = Publishing(node, running.url)
    publishing.take(100)
    async with publishing:
        await publishing.emptied()
    assert next(looks) > 1
    assert_all_arrived(running, node)
