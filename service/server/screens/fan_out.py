"""Who watches: screens that are told the same at the same pace share one feed, and one text.

What they are told is summed up, encoded and framed once a tick, however many they are; for each of
them there is one write, which never waits. A screen that has not read what it was given is given
nothing more: it is summed up for on its own until it reads, or is let go. Others do not feel it.
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
"""How often a screen may be told; what is asked for is rounded down to one of them."""
TOO_SLOW_S = 10.0
"""A screen that does not read for so long is let go; it may come back."""
_AT_A_TIME = 64
"""Screens that are written to before others of the loop's tasks have their turn."""


class Outlet(Protocol):
    """A websocket that is written to without waiting."""

    @property
    def is_ready(self) -> bool:
        """Has what was written before gone, but for what a transport holds (64 KiB)?"""

    def write(self, framed: bytes) -> None:
        """Write whole frames of the websocket protocol; nothing, if it is closed."""


class Viewer:
    """One screen."""

    def __init__(self, outlet: Outlet) -> None:
        self.over: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        """Holds why it has to go, as an exception, once it has to."""
        self._outlet = outlet
        self._missed: Summary | None = None
        self._behind_since_s = 0.0

    def tell(self, told: Told, now_s: float) -> None:
        """Write it, with all that it has missed; or keep it for later."""
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
        """It has to go."""
        if not self.over.done():
            self.over.set_exception(reason)


class Told:
    """What all screens of a feed are told at a tick."""

    def __init__(self, summary: Summary, ages_ms: Mapping[str, float]) -> None:
        self.news, self.ages_ms = summary.take(), ages_ms
        self.framed = framed(self.news.texts(ages_ms))


class Feed:
    """Screens that watch the same at the same rate."""

    def __init__(self, only: str | None, rate_hz: float, nodes: Mapping[str, ServerNode]) -> None:
        self.viewers: set[Viewer] = set()
        self._summary = Summary(only)
        self._news = asyncio.Event()
        self._rate_hz = rate_hz
        self._nodes = nodes

    def change(self) -> Summary:
        """What is to be told at the next tick, to be added to."""
        self._news.set()
        return self._summary

    async def run(self) -> None:
        """Tell at the feed's rate what there is, until cancelled."""
        loop = asyncio.get_running_loop()
        due_s = loop.time()
        while True:
            await self._news.wait()
            self._news.clear()
            due_s = max(due_s + 1.0 / self._rate_hz, loop.time())
            try:
                await self.tick(loop.time())
            except Exception as error:
                # A text that cannot be made is one feed's fault: its screens may come again.
                for viewer in self.viewers:
                    viewer.end(error)
            await asyncio.sleep(due_s - loop.time())

    async def tick(self, now_s: float) -> None:
        """Tell everybody what there is."""
        if not self._summary:
            return
        told = Told(self._summary, _ages_ms(self._nodes.values()))
        for at, viewer in enumerate(tuple(self.viewers), 1):
            if viewer in self.viewers:  # it may have left while others had their turn
                viewer.tell(told, now_s)
            if at % _AT_A_TIME == 0:
                await asyncio.sleep(0)


class Hub:
    """All screens of a server; used from its loop."""

    def __init__(self) -> None:
        self._feeds: dict[tuple[str | None, float], tuple[Feed, asyncio.Task[None]]] = {}
        self._nodes: dict[str, ServerNode] = {}
        """Those that have sent frames."""
        self._recent: dict[str, Recent] = {}
        self._recent_tiles: dict[str, RecentTiles] = {}

    @property
    def subscribers(self) -> int:
        """How many screens there are."""
        return sum(len(feed.viewers) for feed, _ in self._feeds.values())

    def join(self, outlet: Outlet, rate_hz: float, only: str | None = None) -> Viewer:
        """A screen that is told what happens from now on, on all nodes or `only` one.

        Args:
            outlet: where it is written to.
            rate_hz: how often at most, 1 to 60.
            only: the node it wants to see.
        """
        key = only, max(rate for rate in RATES_HZ if rate <= rate_hz)
        if key not in self._feeds:
            feed = Feed(*key, self._nodes)
            self._feeds[key] = feed, asyncio.create_task(feed.run())
        viewer = Viewer(outlet)
        self._feeds[key][0].viewers.add(viewer)
        return viewer

    def leave(self, viewer: Viewer) -> None:
        """Forget a screen."""
        for key, (feed, task) in list(self._feeds.items()):
            feed.viewers.discard(viewer)
            if not feed.viewers:
                task.cancel()
                del self._feeds[key]

    def notice(self, message: Mapping[str, Any]) -> None:
        """Tell everybody."""
        if self._feeds:
            text = dumps(message)
            for summary in self._changing():
                summary.notice(text)

    def count(self, node: str, counted: Mapping[str, Mapping[str, Any]]) -> None:
        """Tell everybody what sessions of a node have come to, by id."""
        for summary in self._changing():
            summary.count(node, counted)

    def publish(self, node: ServerNode, due: list[Estimated]) -> None:
        """Frames of a node with their estimates."""
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
        """What was told of its present stream."""
        recent = self._recent.get(node.name)
        return recent if recent is not None and recent.boot_id == node.boot_id else Recent()

    def recent_tiles(self, node: ServerNode) -> RecentTiles:
        """The same of each of its tiles."""
        return self._of_tiles(node, len(node.info.tiles))

    def _of_tiles(self, node: ServerNode, tiles: int) -> RecentTiles:
        recent = self._recent_tiles.get(node.name)
        if recent is None or (recent.boot_id, recent.tiles) != (node.boot_id, tiles):
            recent = self._recent_tiles[node.name] = RecentTiles(node.boot_id, tiles)
        return recent

    def age_ms(self, node: ServerNode) -> float | None:
        """How old the newest frame of its present stream is; None where that is not known."""
        known = node.last_seq is not None
        return _ages_ms([node]).get(node.name) if known else None

    def _changing(self) -> list[Summary]:
        return [feed.change() for feed, _ in self._feeds.values()]


def framed(texts: Iterable[str]) -> bytes:
    """Text messages as a server sends them on a websocket (RFC 6455), one behind the other."""
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
