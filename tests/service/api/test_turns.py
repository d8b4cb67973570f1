"""A node that brings home what it took on its way keeps nobody else waiting."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest

from service.server.node import ServerNode
from tests.service.fake_node import FakeNode
from tests.service.running import Running
from tests.waiting import until

MESSAGES = 60


def test_between_two_messages_of_a_node_others_have_their_turn(
    running: Running, node: FakeNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    node.connect()
    node.deliver(10)
    turns, take = 0, ServerNode.receive_frames
    taken_at: list[int] = []

    async def count() -> None:
        nonlocal turns
        while len(taken_at) < MESSAGES:
            turns += 1
            await asyncio.sleep(0)

    def noted(self: ServerNode, *given: Any) -> Any:
        taken_at.append(turns)
        return take(self, *given)

    monkeypatch.setattr(ServerNode, "receive_frames", noted)
    counting = running.call(lambda: asyncio.ensure_future(count()))
    # As one piece: the server reads so many messages at once.
    sent = node.frames(10 * MESSAGES)
    payloads = [node.payload(sent.slice_rows(i, i + 10)) for i in range(0, len(sent), 10)]
    for payload in payloads:
        node.socket.send(payload)
    until(lambda: len(taken_at) == MESSAGES)
    until(counting.done)
    assert len(set(taken_at)) == MESSAGES
