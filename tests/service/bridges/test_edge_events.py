"""Edges of a sync line as events of a bridge, which have the server's time or are withheld."""

from __future__ import annotations

import asyncio
from types import SimpleNamespace
from typing import Any

from service.bridges.follower import Event, LiveClock, Outlet, Reporter, ServerFollower


class Events(Outlet):
    """An outlet that keeps the events."""

    def __init__(self) -> None:
        self.labels: list[str] = []

    def write_event(self, event: Event, server_clock: LiveClock) -> None:
        self.labels.append(event.text)


def test_an_edge_without_the_servers_time_is_withheld() -> None:
    items: list[dict[str, Any]] = [
        {"id": "1", "label": "a stone", "t_ns": 5, "stream_id": None, "bound_ns": None},
        {"id": "2", "label": "TTL", "t_ns": 5, "stream_id": "a", "bound_ns": None},
        {"id": "3", "label": "TTL 2", "t_ns": 5, "stream_id": "a", "bound_ns": 1000},
    ]
    server: Any = SimpleNamespace(http=SimpleNamespace(get=lambda _: {"items": items}))
    outlet = Events()
    follower = ServerFollower(server, outlet, Reporter(print))
    view = {"id": "s", "node": "leg", "name": "trial", "state": "recording", "started_t_ns": 1}
    asyncio.run(follower._update_session(view | {"marker_count": 3}, is_new=True))
    assert outlet.labels == ["trial", "a stone", "TTL 2"]
