"""Screens that watch the same are told the same, once; who does not read is told later, alone."""

from __future__ import annotations

import asyncio
import json
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from websockets.client import ClientProtocol
from websockets.frames import Frame
from websockets.protocol import State
from websockets.uri import parse_uri

from service.protocol.codec import CloseConnection, LinkCloseCode
from service.protocol.live import SessionDeleted
from service.server.broadcast.broadcaster import RATES_HZ, Broadcaster, encode_websocket_messages
from service.server.node import ServerNode
from tests.builders.arrays import PERIOD_NS, make_array
from tests.builders.frames import make_frames
from tests.waiting import in_a_loop

RATE_HZ = 60.0
NOTICE = SessionDeleted(session_id="a")


class Screen:
    """Keeps what is written to it, in the pieces in which it was."""

    def __init__(self) -> None:
        self.is_writable = True
        self.written: list[bytes] = []

    def write_framed_unless_closed(self, framed: bytes) -> None:
        assert self.is_writable
        self.written.append(framed)

    @property
    def messages(self) -> list[dict[str, Any]]:
        return read(b"".join(self.written))


def read(sent: bytes) -> list[dict[str, Any]]:
    """What a client understands."""
    client = ClientProtocol(parse_uri("ws://localhost"), state=State.OPEN)
    client.receive_data(sent)
    frames = client.events_received()
    assert client.parser_exc is None
    return [json.loads(bytes(frame.data)) for frame in frames if isinstance(frame, Frame)]


def fake_node(name: str = "bench", *, has_clock: bool = False) -> ServerNode:
    node = SimpleNamespace(
        name=name,
        stream_id="0" * 32,
        published_t_ns=None,
        clock_offset=object() if has_clock else None,
        to_server_t_ns_or_unchanged=lambda t_ns: t_ns,
    )
    return cast(ServerNode, node)


def publish(hub: Broadcaster, node: ServerNode, first: int, rows: int) -> None:
    batch = make_frames(np.arange(first, first + rows), period_ns=PERIOD_NS, servo_counts=0)
    hub.add_to_history_and_updates(node, [(batch, {})])


async def ticked(hub: Broadcaster, now_s: float = 0.0) -> None:
    for feed, _ in list(hub._groups.values()):
        await feed.send_update(now_s)


def test_a_history_begins_anew_with_another_number_of_tiles() -> None:
    hub, node = Broadcaster(), fake_node()
    publish(hub, node, 0, 10)
    cast(Any, node).last_info = make_array(3)
    assert hub.get_present_stream_history(node).tile_count == 3


@in_a_loop
async def test_screens_that_watch_the_same_are_given_the_same_bytes() -> None:
    hub, node, screens = Broadcaster(), fake_node(), [Screen() for _ in range(200)]
    for screen in screens:
        hub.subscribe(screen, RATE_HZ)
    publish(hub, node, 0, 10)
    publish(hub, node, 10, 5)
    await ticked(hub)
    assert [m["n"] for m in screens[0].messages] == [15]
    assert all(screen.written[0] is screens[0].written[0] for screen in screens)


@in_a_loop
async def test_a_rate_is_rounded_down_and_who_asks_for_the_same_shares_a_feed() -> None:
    hub = Broadcaster()
    for rate_hz in (*RATES_HZ, 1.9, 29.97, 31.0, 59.9):
        hub.subscribe(Screen(), rate_hz)
    assert sorted(rate_hz for _, rate_hz in hub._groups) == list(RATES_HZ)
    hub.subscribe(Screen(), 60.0, "bench")
    assert len(hub._groups) == len(RATES_HZ) + 1


@in_a_loop
async def test_who_does_not_read_is_told_later_of_all_peaks_and_the_others_at_once() -> None:
    hub, node, slow, quick = Broadcaster(), fake_node(), Screen(), Screen()
    hub.subscribe(slow, RATE_HZ)
    hub.subscribe(quick, RATE_HZ)
    slow.is_writable = False
    for first in range(0, 50, 10):
        publish(hub, node, first, 10)
        hub.queue_notice(SessionDeleted(session_id=str(first)))
        await ticked(hub, now_s=first / 100)
    assert slow.written == []
    assert [m["n"] for m in quick.messages if m["type"] == "frame"] == [10] * 5
    slow.is_writable = True
    publish(hub, node, 50, 10)
    await ticked(hub, now_s=0.6)
    *notices, frame = slow.messages
    assert [m["session_id"] for m in notices] == ["0", "10", "20", "30", "40"]
    assert (frame["seq"], frame["n"]) == (59, 60)
    publish(hub, node, 60, 10)
    await ticked(hub, now_s=0.7)
    assert slow.written[-1] is quick.written[-1]


@in_a_loop
async def test_who_does_not_read_for_ten_seconds_has_to_go_and_nobody_else() -> None:
    hub, slow, quick = Broadcaster(), Screen(), Screen()
    going, staying = hub.subscribe(slow, RATE_HZ), hub.subscribe(quick, RATE_HZ)
    slow.is_writable = False
    for now_s in range(11):
        hub.queue_notice(NOTICE)
        await ticked(hub, now_s=float(now_s))
        assert not going.disconnected.done()
    hub.queue_notice(NOTICE)
    await ticked(hub, now_s=10.1)
    with pytest.raises(CloseConnection) as end:
        going.disconnected.result()
    assert end.value.code == LinkCloseCode.TOO_SLOW
    assert not staying.disconnected.done()
    assert len(quick.messages) == 12


@in_a_loop
async def test_time_without_news_is_not_time_without_reading() -> None:
    hub, screen = Broadcaster(), Screen()
    viewer = hub.subscribe(screen, RATE_HZ)
    hub.queue_notice(NOTICE)
    await ticked(hub, now_s=0.0)
    screen.is_writable = False
    hub.queue_notice(NOTICE)
    await ticked(hub, now_s=100.0)
    assert not viewer.disconnected.done()


@in_a_loop
async def test_only_who_has_joined_is_told_and_nobody_after_leaving() -> None:
    hub, node, one, two = Broadcaster(), fake_node(), Screen(), Screen()
    hub.queue_notice(SessionDeleted(session_id="early"))
    publish(hub, node, 0, 5)
    assert node.published_t_ns == 10**18 + 4 * PERIOD_NS
    first, _ = hub.subscribe(one, RATE_HZ), hub.subscribe(two, RATE_HZ, "other")
    assert hub.subscriber_count == 2
    publish(hub, node, 5, 5)
    hub.queue_notice(SessionDeleted(session_id="late"))
    await ticked(hub)
    hub.unsubscribe(first)
    hub.unsubscribe(first)
    publish(hub, node, 10, 5)
    await ticked(hub)
    assert hub.subscriber_count == 1
    assert [(m.get("session_id"), m.get("n")) for m in one.messages] == [("late", None), (None, 5)]
    assert [m["session_id"] for m in two.messages] == ["late"]


@in_a_loop
async def test_the_age_of_a_frame_is_known_if_the_clocks_are_compared() -> None:
    hub, screen = Broadcaster(), Screen()
    hub.subscribe(screen, RATE_HZ)
    publish(hub, fake_node("with", has_clock=True), 0, 5)
    publish(hub, fake_node("without"), 0, 5)
    await ticked(hub)
    ages = {m["node"]: m["age_ms"] for m in screen.messages}
    assert ages["with"] > 0
    assert ages["without"] is None


@in_a_loop
async def test_a_feed_tells_at_its_rate_and_its_task_ends_with_its_last_screen() -> None:
    hub, screen = Broadcaster(), Screen()
    viewer = hub.subscribe(screen, RATE_HZ)
    ((_, task),) = hub._groups.values()
    loop = asyncio.get_running_loop()
    began_s = loop.time()
    while len(screen.written) < 6:
        hub.queue_notice(NOTICE)
        await asyncio.sleep(0.001)
    assert loop.time() - began_s > 4 / RATE_HZ
    hub.unsubscribe(viewer)
    await asyncio.gather(task, return_exceptions=True)
    assert task.cancelled()


@in_a_loop
async def test_what_cannot_be_told_ends_the_connections_of_one_feed_and_is_said() -> None:
    hub, node = Broadcaster(), fake_node()
    viewer, other = (
        hub.subscribe(Screen(), RATE_HZ, "bench"),
        hub.subscribe(Screen(), RATE_HZ, "other"),
    )
    publish(hub, node, 0, 5)
    (summary,) = [feed._pending for (only, _), (feed, _) in hub._groups.items() if only == "bench"]
    cast(dict[str, Any], summary._summaries["bench"].newest)["grf_n"] = float("nan")
    async with asyncio.timeout(5.0):
        with pytest.raises(ValueError, match="finite"):
            await viewer.disconnected
    assert not other.disconnected.done()


def test_texts_are_framed_as_the_protocol_has_it() -> None:
    texts = ["{}", json.dumps({"a": "ä" * 100}), json.dumps({"b": "x" * 70_000}, indent=1)]
    assert read(encode_websocket_messages(texts)) == [json.loads(text) for text in texts]
    # RFC 6455, section 5.7: a single-frame unmasked text message "Hello".
    assert encode_websocket_messages(["Hello"]) == bytes.fromhex("810548656c6c6f")


@in_a_loop
async def test_screens_that_are_many_do_not_hold_up_the_loop() -> None:
    hub, turns = Broadcaster(), 0
    leaving = [hub.subscribe(Screen(), RATE_HZ) for _ in range(640)]

    async def others() -> None:
        nonlocal turns
        while True:
            turns += 1
            hub.unsubscribe(leaving.pop())
            await asyncio.sleep(0)

    task = asyncio.create_task(others())
    hub.queue_notice(NOTICE)
    await ticked(hub)
    task.cancel()
    assert turns >= 9
