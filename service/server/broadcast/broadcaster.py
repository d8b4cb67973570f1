"""Broadcast of summaries to the subscribers of the live page.

Subscribers of the same nodes at the same rate share a rate group: its update is summarized, encoded
and framed once per tick, and written to each without waiting. A subscriber that has not read the
last update gets nothing more: its updates are merged until it reads, or until it is disconnected.
Others are not affected.
"""

from __future__ import annotations

import asyncio
from collections.abc import Iterable, Mapping
from typing import Protocol

from websockets.frames import Frame, Opcode

from devices.clock import server_utc_ns
from service.protocol.codec import CloseConnection, LinkCloseCode, encode_message
from service.protocol.live import PageMessage, SessionProgress
from service.server.broadcast.summary import (
    PendingUpdate,
    StreamHistory,
    reduce_tiles,
    summarize_force,
    summarize_frames,
)
from service.server.estimates.node_estimator import EstimatedBatch
from service.server.node import ServerNode

RATES_HZ = (1.0, 2.0, 5.0, 10.0, 15.0, 20.0, 30.0, 60.0)
"""Update rates; a requested rate is rounded down."""
TOO_SLOW_S = 10.0
"""Timeout of a subscriber that does not read; it may reconnect."""
_WRITES_PER_TURN = 64
"""Subscribers written to before other tasks of the event loop run."""


class SubscriberSocket(Protocol):
    """Websocket with writes that do not wait."""

    @property
    def is_writable(self) -> bool:
        """True if all earlier writes are sent, up to the transport buffer (64 KiB)."""

    def write_framed_unless_closed(self, framed: bytes) -> None:
        """Write whole frames of the websocket protocol; nothing if it is closed."""


class Subscriber:
    """One subscriber."""

    def __init__(self, socket: SubscriberSocket) -> None:
        self.disconnected: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        """Future with the reason, as an exception, once it has to be disconnected."""
        self._socket = socket
        self._backlog: PendingUpdate | None = None
        self._backlog_since_s = 0.0

    def send_or_merge_tick(self, tick: Tick, now_s: float) -> None:
        """Write the update, or merge it into the backlog of a subscriber that does not read."""
        is_ready = self._socket.is_writable
        if self._backlog is None:
            if is_ready:
                self._socket.write_framed_unless_closed(tick.framed)
                return
            self._backlog, self._backlog_since_s = PendingUpdate(), now_s
        self._backlog.add_update(tick.update)
        if is_ready:
            self._socket.write_framed_unless_closed(
                encode_websocket_messages(self._backlog.pop_update().encode_messages(tick.ages_ms))
            )
            self._backlog = None
        elif now_s - self._backlog_since_s > TOO_SLOW_S:
            self.request_disconnect(
                CloseConnection(LinkCloseCode.TOO_SLOW, "this client does not read")
            )

    def request_disconnect(self, reason: Exception) -> None:
        """Request that the subscriber is disconnected, by its task; the first reason counts."""
        if not self.disconnected.done():
            self.disconnected.set_exception(reason)


class Tick:
    """Update for all subscribers of a rate group, encoded once."""

    def __init__(self, pending: PendingUpdate, ages_ms: Mapping[str, float]) -> None:
        self.update, self.ages_ms = pending.pop_update(), ages_ms
        self.framed = encode_websocket_messages(self.update.encode_messages(ages_ms))


class RateGroup:
    """Subscribers of the same nodes at the same rate."""

    def __init__(
        self, node_filter: str | None, rate_hz: float, nodes: Mapping[str, ServerNode]
    ) -> None:
        self.subscribers: set[Subscriber] = set()
        self._pending = PendingUpdate(node_filter)
        self._has_pending = asyncio.Event()
        self._rate_hz = rate_hz
        self._nodes = nodes

    def schedule_pending_update(self) -> PendingUpdate:
        """Schedule the next tick, and return its content, for additions."""
        self._has_pending.set()
        return self._pending

    async def run(self) -> None:
        """Send updates at the group's rate until cancelled."""
        loop = asyncio.get_running_loop()
        due_s = loop.time()
        while True:
            await self._has_pending.wait()
            self._has_pending.clear()
            due_s = max(due_s + 1.0 / self._rate_hz, loop.time())
            try:
                await self.send_update(loop.time())
            except Exception as error:
                # An encoding error affects one group only: its subscribers may reconnect.
                for subscriber in self.subscribers:
                    subscriber.request_disconnect(error)
            await asyncio.sleep(due_s - loop.time())

    async def send_update(self, now_s: float) -> None:
        """Send the pending update to all subscribers."""
        if not self._pending:
            return
        tick = Tick(self._pending, _newest_frame_ages_ms(self._nodes.values()))
        for count, subscriber in enumerate(tuple(self.subscribers), 1):
            if subscriber in self.subscribers:  # it may have left meanwhile
                subscriber.send_or_merge_tick(tick, now_s)
            if count % _WRITES_PER_TURN == 0:
                await asyncio.sleep(0)


class Broadcaster:
    """All subscribers of a server, and the last minute of each node; used from one event loop."""

    def __init__(self) -> None:
        self._groups: dict[tuple[str | None, float], tuple[RateGroup, asyncio.Task[None]]] = {}
        self._nodes: dict[str, ServerNode] = {}
        """Nodes that have sent frames."""
        self._histories: dict[str, StreamHistory] = {}

    @property
    def subscriber_count(self) -> int:
        """Number of subscribers."""
        return sum(len(group.subscribers) for group, _ in self._groups.values())

    def subscribe(
        self, socket: SubscriberSocket, max_rate_hz: float, node_filter: str | None = None
    ) -> Subscriber:
        """Add a subscriber to events from now on, of all nodes or one.

        Args:
            socket: websocket of the subscriber.
            max_rate_hz: greatest update rate, 1 to 60.
            node_filter: node whose frames and progress are sent; None: all.
        """
        key = node_filter, max(rate for rate in RATES_HZ if rate <= max_rate_hz)
        if key not in self._groups:
            group = RateGroup(*key, self._nodes)
            self._groups[key] = group, asyncio.create_task(group.run())
        subscriber = Subscriber(socket)
        self._groups[key][0].subscribers.add(subscriber)
        return subscriber

    def unsubscribe(self, subscriber: Subscriber) -> None:
        """Remove a subscriber."""
        for key, (group, task) in list(self._groups.items()):
            group.subscribers.discard(subscriber)
            if not group.subscribers:
                task.cancel()
                del self._groups[key]

    def queue_notice(self, message: PageMessage) -> None:
        """Queue a message for the next update of all subscribers, whatever their node.

        Of more than 256 unsent ones, a subscriber gets the newest.
        """
        if self._groups:
            text = encode_message(message)
            for pending in self._pending_updates():
                pending.add_notice(text)

    def queue_progress(self, node: str, progress_by_session: Mapping[str, SessionProgress]) -> None:
        """Queue the progress of sessions, by id, for the subscribers of their node."""
        for pending in self._pending_updates():
            pending.add_progress(node, progress_by_session)

    def add_to_history_and_updates(self, node: ServerNode, batches: list[EstimatedBatch]) -> None:
        """Add estimated frames of a node to its history and to the next updates."""
        self._nodes[node.name] = node
        for frames, columns in batches:
            node.published_t_ns = int(frames.t_ns[-1])
            span, tiles = (
                summarize_force(frames, columns),
                reduce_tiles(columns, frames.tile_count),
            )
            self._get_history(node, frames.tile_count).add_span(span, tiles)
            if self._groups:
                piece = summarize_frames(node.stream_id, span, tiles, frames, columns)
                for pending in self._pending_updates():
                    pending.join_summary_or_drop_older(node.name, piece)

    def get_present_stream_history(self, node: ServerNode) -> StreamHistory:
        """Return the history of a node's present stream, in place of another stream's."""
        return self._get_history(node, len(node.last_info.tiles))

    def _get_history(self, node: ServerNode, tile_count: int) -> StreamHistory:
        recent = self._histories.get(node.name)
        key = node.stream_id, tile_count
        if recent is None or (recent.stream_id, recent.tile_count) != key:
            recent = self._histories[node.name] = StreamHistory(*key)
        return recent

    def newest_frame_age_ms(self, node: ServerNode) -> float | None:
        """Return the age of a node's newest published frame; None if unknown."""
        has_frames = node.last_seq is not None
        return _newest_frame_ages_ms([node]).get(node.name) if has_frames else None

    def _pending_updates(self) -> list[PendingUpdate]:
        return [group.schedule_pending_update() for group, _ in self._groups.values()]


def encode_websocket_messages(texts: Iterable[str]) -> bytes:
    """Encode texts as websocket messages of a server (RFC 6455), one behind the other."""
    return b"".join(
        Frame(Opcode.TEXT, text.encode()).serialize(mask=False, extensions=()) for text in texts
    )


def _newest_frame_ages_ms(nodes: Iterable[ServerNode]) -> dict[str, float]:
    now_t_ns = server_utc_ns()
    return {
        node.name: (now_t_ns - node.to_server_t_ns_or_unchanged(node.published_t_ns)) * 1e-6
        for node in nodes
        if node.clock_offset is not None and node.published_t_ns is not None
    }
