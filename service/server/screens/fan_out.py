"""Broadcast of summaries to the subscribers of the live page.

Subscribers of the same nodes at the same rate share a rate group: its update is summarized, encoded
and framed once per tick, and written to each without waiting. A subscriber that has not read the
last update gets nothing more: its updates are merged until it reads, or until it is disconnected.
Others are not affected.
"""

from __future__ import annotations

import asyncio
from collections.abc import Iterable, Mapping
from typing import Any, Protocol

from websockets.frames import Frame, Opcode

from service.link import Close, HangUp
from service.server.estimates.of_node import Estimated
from service.server.node import ServerNode
from service.server.screens.picture import Summary, dumps, sum_up
from service.server.screens.recent import Recent
from service.server.screens.recent_tiles import RecentTiles
from service.server.screens.spans import span_of
from service.server_clock import utc_ns

RATES_HZ = (1.0, 2.0, 5.0, 10.0, 15.0, 20.0, 30.0, 60.0)
"""Update rates; a requested rate is rounded down."""
TOO_SLOW_S = 10.0
"""Timeout of a subscriber that does not read; it may reconnect."""
_AT_A_TIME = 64
"""Subscribers written to before other tasks of the event loop run."""


class Outlet(Protocol):
    """Websocket with writes that do not wait."""

    @property
    def is_ready(self) -> bool:
        """True if all earlier writes are sent, up to the transport buffer (64 KiB)."""

    def write(self, framed: bytes) -> None:
        """Write whole frames of the websocket protocol; nothing if it is closed."""


class Viewer:
    """One subscriber."""

    def __init__(self, outlet: Outlet) -> None:
        self.over: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        """Future with the reason, as an exception, once it has to be disconnected."""
        self._outlet = outlet
        self._missed: Summary | None = None
        self._behind_since_s = 0.0

    def tell(self, told: Told, now_s: float) -> None:
        """Write the update with the backlog, or add it to the backlog."""
        is_ready = self._outlet.is_ready
        if self._missed is None:
            if is_ready:
                self._outlet.write(told.framed)
                return
            self._missed, self._behind_since_s = Summary(), now_s
        self._missed.join(told.news)
        if is_ready:
            self._outlet.write(framed(self._missed.take().texts(told.ages_ms)))
            self._missed = None
        elif now_s - self._behind_since_s > TOO_SLOW_S:
            self.end(HangUp(Close.TOO_SLOW, "this client does not read"))

    def end(self, reason: Exception) -> None:
        """Request that the subscriber is disconnected."""
        if not self.over.done():
            self.over.set_exception(reason)


class Told:
    """Update for all subscribers of a rate group, encoded once."""

    def __init__(self, summary: Summary, ages_ms: Mapping[str, float]) -> None:
        self.news, self.ages_ms = summary.take(), ages_ms
        self.framed = framed(self.news.texts(ages_ms))


class Feed:
    """Subscribers of the same nodes at the same rate."""

    def __init__(self, only: str | None, rate_hz: float, nodes: Mapping[str, ServerNode]) -> None:
        self.viewers: set[Viewer] = set()
        self._summary = Summary(only)
        self._news = asyncio.Event()
        self._rate_hz = rate_hz
        self._nodes = nodes

    def change(self) -> Summary:
        """Return the content of the next tick, for additions, and schedule the tick."""
        self._news.set()
        return self._summary

    async def run(self) -> None:
        """Send updates at the group's rate until cancelled."""
        loop = asyncio.get_running_loop()
        due_s = loop.time()
        while True:
            await self._news.wait()
            self._news.clear()
            due_s = max(due_s + 1.0 / self._rate_hz, loop.time())
            try:
                await self.tick(loop.time())
            except Exception as error:
                # An encoding error affects one group only: its subscribers may reconnect.
                for viewer in self.viewers:
                    viewer.end(error)
            await asyncio.sleep(due_s - loop.time())

    async def tick(self, now_s: float) -> None:
        """Send the pending update to all subscribers."""
        if not self._summary:
            return
        tick = Told(self._summary, _ages_ms(self._nodes.values()))
        for count, viewer in enumerate(tuple(self.viewers), 1):
            if viewer in self.viewers:  # it may have left meanwhile
                viewer.tell(tick, now_s)
            if count % _AT_A_TIME == 0:
                await asyncio.sleep(0)


class Hub:
    """All subscribers of a server, and the last minute of each node; used from one event loop."""

    def __init__(self) -> None:
        self._feeds: dict[tuple[str | None, float], tuple[Feed, asyncio.Task[None]]] = {}
        self._nodes: dict[str, ServerNode] = {}
        """Nodes that have sent frames."""
        self._recent: dict[str, Recent] = {}
        self._recent_tiles: dict[str, RecentTiles] = {}

    @property
    def subscribers(self) -> int:
        """Number of subscribers."""
        return sum(len(feed.viewers) for feed, _ in self._feeds.values())

    def join(self, outlet: Outlet, rate_hz: float, only: str | None = None) -> Viewer:
        """Add a subscriber to events from now on, of all nodes or one.

        Args:
            socket: websocket of the subscriber.
            rate_hz: greatest update rate, 1 to 60.
            node_filter: node of interest; None: all.
        """
        key = only, max(rate for rate in RATES_HZ if rate <= rate_hz)
        if key not in self._feeds:
            feed = Feed(*key, self._nodes)
            self._feeds[key] = feed, asyncio.create_task(feed.run())
        viewer = Viewer(outlet)
        self._feeds[key][0].viewers.add(viewer)
        return viewer

    def leave(self, viewer: Viewer) -> None:
        """Remove a subscriber."""
        for key, (feed, task) in list(self._feeds.items()):
            feed.viewers.discard(viewer)
            if not feed.viewers:
                task.cancel()
                del self._feeds[key]

    def notice(self, message: Mapping[str, Any]) -> None:
        """Send a message to all subscribers with the next update."""
        if self._feeds:
            text = dumps(message)
            for summary in self._changing():
                summary.notice(text)

    def count(self, node: str, counted: Mapping[str, Mapping[str, Any]]) -> None:
        """Send the progress of sessions of a node to all subscribers, by id."""
        for summary in self._changing():
            summary.count(node, counted)

    def publish(self, node: ServerNode, due: list[Estimated]) -> None:
        """Add estimated frames of a node to its history and to the next updates."""
        self._nodes[node.name] = node
        for frames, columns in due:
            node.shown_t_ns = int(frames.t_ns[-1])
            span = span_of(frames, columns)
            self._recent.setdefault(node.name, Recent()).add(node.boot_id, span)
            self._of_tiles(node, frames.tile_count).add(span, columns)
            if self._feeds:
                piece = sum_up(node.boot_id, span, frames, columns)
                for summary in self._changing():
                    summary.add(node.name, piece)

    def recent(self, node: ServerNode) -> Recent:
        """Return the force history of a node's present stream."""
        recent = self._recent.get(node.name)
        return recent if recent is not None and recent.boot_id == node.boot_id else Recent()

    def recent_tiles(self, node: ServerNode) -> RecentTiles:
        """Return the tile history of a node's present stream."""
        return self._of_tiles(node, len(node.info.tiles))

    def _of_tiles(self, node: ServerNode, tiles: int) -> RecentTiles:
        recent = self._recent_tiles.get(node.name)
        if recent is None or (recent.boot_id, recent.tiles) != (node.boot_id, tiles):
            recent = self._recent_tiles[node.name] = RecentTiles(node.boot_id, tiles)
        return recent

    def age_ms(self, node: ServerNode) -> float | None:
        """Return the age of the newest frame of a node's present stream; None if unknown."""
        has_frames = node.last_seq is not None
        return _ages_ms([node]).get(node.name) if has_frames else None

    def _changing(self) -> list[Summary]:
        return [feed.change() for feed, _ in self._feeds.values()]


def framed(texts: Iterable[str]) -> bytes:
    """Encode texts as websocket messages of a server (RFC 6455), one behind the other."""
    return b"".join(
        Frame(Opcode.TEXT, text.encode()).serialize(mask=False, extensions=()) for text in texts
    )


def _ages_ms(nodes: Iterable[ServerNode]) -> dict[str, float]:
    now_t_ns = utc_ns()
    return {
        node.name: (now_t_ns - node.server_t_ns(node.shown_t_ns)) * 1e-6
        for node in nodes
        if node.clock is not None and node.shown_t_ns is not None
    }
