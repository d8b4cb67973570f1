"""What a follower asks its server for, and what does not end it."""

from __future__ import annotations

import asyncio
import json
from typing import Any, ClassVar

import pytest
from websockets.asyncio.server import ServerConnection, serve

from foottile.errors import ClientError, NotFoundError
from service.bridges.follower import Event, LiveClock, Outlet, Reporter, ServerFollower
from tests.waiting import PATIENCE_S, in_a_loop


class Events(Outlet):
    """An outlet that keeps the events."""

    def __init__(self) -> None:
        self.seen: list[str] = []

    def write_event(self, event: Event, server_clock: LiveClock) -> None:
        self.seen.append(str(event))


class Source:
    """A server of one session, which a test changes; it counts requests for markers."""

    headers: ClassVar[dict[str, str]] = {}
    context = None

    def __init__(self) -> None:
        self.http = self
        self.url = ""
        self.markers: list[dict[str, Any]] = []
        self.error: ClientError | None = None
        self.asked = 0
        self.hellos = 0

    def get(self, path: str, field: str | None = None) -> Any:
        if path == "/login":
            return {"private": False}
        assert path.endswith("/markers")
        self.asked += 1
        if self.error is not None:
            raise self.error
        return {"items": [*self.markers]}

    def view(self, n: int, state: str = "recording") -> dict[str, Any]:
        self.markers = [{"id": str(i), "label": f"m{i}", "t_ns": i} for i in range(n)]
        times = {"started_t_ns": 1, "stopped_t_ns": 2}
        return {"id": "s", "node": "a", "name": "mud", "state": state, "marker_count": n, **times}

    async def answer(self, socket: ServerConnection) -> None:
        """Show a session without markers, and then one with a marker."""
        self.hellos += 1
        await socket.send(json.dumps({"type": "hello", "nodes": [], "recording": [self.view(0)]}))
        await socket.send(json.dumps({"type": "session", "session": self.view(1)}))
        await socket.wait_closed()


def make_follower(source: Any, outlet: Outlet) -> ServerFollower:
    return ServerFollower(source, outlet, Reporter(lambda _: None))


@in_a_loop
async def test_a_burst_of_markers_is_one_request_a_second_and_each_is_an_event_once() -> None:
    source, outlet = Source(), Events()
    follower = make_follower(source, outlet)
    for n in range(60):
        await follower._update_session(source.view(n), is_new=True)
    assert source.asked <= 2
    while follower._late:
        await asyncio.sleep(0.05)
        await follower._update_late_sessions()
    assert source.asked <= 3
    await follower._update_session(source.view(61, "stopped"), is_new=True)  # at once
    await follower._update_session(source.view(61, "sealed"), is_new=True)
    markers = [f"m{i}" for i in range(61)]
    ends = ["recording stopped: mud", "session sealed: mud"]
    assert outlet.seen == ["recording started: mud", *markers, *ends]
    assert not follower._sessions


@in_a_loop
async def test_a_session_deleted_meanwhile_is_forgotten() -> None:
    source, outlet = Source(), Events()
    follower = make_follower(source, outlet)
    await follower._update_session(source.view(0), is_new=True)
    source.error = NotFoundError("no such session")
    await follower._update_session(source.view(1), is_new=True)
    assert not follower._sessions


@in_a_loop
async def test_an_error_of_the_first_connection_is_followed_by_the_next() -> None:
    source, outlet = Source(), Events()
    source.error = ClientError("the server ends")
    async with serve(source.answer, "127.0.0.1", 0) as listening:
        port = next(iter(listening.sockets)).getsockname()[1]
        source.url = f"http://127.0.0.1:{port}"
        running = asyncio.create_task(make_follower(source, outlet).run())
        try:
            async with asyncio.timeout(PATIENCE_S):
                while source.hellos < 2 and not running.done():
                    await asyncio.sleep(0.01)
        finally:
            running.cancel()
        with pytest.raises(asyncio.CancelledError):
            await running
