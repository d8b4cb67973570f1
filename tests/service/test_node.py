"""A node gives its streams away to their ends, one after the other, if there is a server."""

from __future__ import annotations

import asyncio
import time
from dataclasses import dataclass
from typing import Any

import pytest

import service.node
from service.backlog import EncodedBatch
from service.node import _drain, _Stream


@dataclass
class Link:
    """As much of a publisher as counts here."""

    is_connected: bool


def ended_stream() -> Any:
    """A stream that has ended, of ten frames, without a publisher."""
    stream: Any = _Stream(info=None, previous=None)  # type: ignore[arg-type]  # nobody asks
    stream.backlog.append(EncodedBatch(0, 9, b"ten frames"))
    stream.has_ended = True
    return stream


async def drained(streams: list[Any], *happens: Any) -> float:
    """How many seconds draining takes while every 50 ms the next thing happens."""

    async def happen() -> None:
        for what in happens:
            await asyncio.sleep(0.05)
            what()

    happening = asyncio.create_task(happen())
    begin_s = time.monotonic()
    await _drain(streams)
    took_s = time.monotonic() - begin_s
    await happening
    return took_s


@pytest.fixture(autouse=True)
def patience(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(service.node, "_DRAIN_S", 20.0)
    monkeypatch.setattr(service.node, "_AWAY_LOOKS", 20)  # of 20 ms


def test_a_stream_whose_publisher_comes_only_after_the_one_before_is_waited_for() -> None:
    first, second = ended_stream(), ended_stream()
    first.publisher = Link(is_connected=True)

    def first_is_delivered() -> None:
        first.backlog.acknowledge(0, 9)
        first.publisher.is_connected = False

    def second_connects() -> None:
        second.publisher = Link(is_connected=True)

    def second_is_delivered() -> None:
        second.backlog.acknowledge(0, 9)

    nothing = [lambda: None] * 10  # longer than it would wait for a server that is away
    took_s = asyncio.run(
        drained([first, second], *nothing, first_is_delivered, second_connects, second_is_delivered)
    )
    assert second.is_delivered
    assert 13 * 0.05 <= took_s < 10.0


def test_a_server_that_is_away_is_not_waited_for_long() -> None:
    streams = [ended_stream(), ended_stream()]
    streams[0].publisher = Link(is_connected=False)
    assert 20 * 0.02 <= asyncio.run(drained(streams)) < 10.0
    assert not any(stream.is_delivered for stream in streams)


def test_a_node_without_anything_to_give_away_ends_at_once() -> None:
    assert asyncio.run(drained([])) < 0.2
