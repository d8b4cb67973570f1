"""Follower of a server for bridges: frames, summaries, sessions, markers, across broken links.

A bridge is a client: it takes every frame from the live feed of each node, and all else from the
live page's socket. Nothing waits for a bridge: the server drops frames for one that is slow, and a
bridge's outlet drops for a slow reader.

Frames get the server's time by the measurements of the node's clock, as sealed sessions do. The
server's clock is measured against this machine's by the round trip of a ping.
"""

from __future__ import annotations

import asyncio
import json
import math
import time
from collections import deque
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field
from itertools import count
from typing import TYPE_CHECKING, Any

import numpy as np
from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import WebSocketException

from devices.errors import UsageError
from devices.frames import ArrayInfo
from foottile.errors import ClientError, NotFoundError
from service.protocol.codec import run_until_first_ends
from service.protocol.live import LIVE_PATH
from storage.clock.bounds import BoundedOffset, ClockOffsets, OffsetRows
from storage.schema import SERVER_TIME_COLUMNS, UNKNOWN_T_NS, Array, read_array_info

if TYPE_CHECKING:
    import pyarrow as pa

    from foottile import Client

_RETRY_S = 1.0
_PING_INTERVAL_S, _FIRST_PINGS = 2.0, 8
_CLOCK_FIELDS = ("t_mono_ns", "server_minus_node_ns", "uncertainty_ns")
_SERVER_TIMES = tuple(column.name for column in SERVER_TIME_COLUMNS)
_ROWS_MAX = 64
"""Clock measurements kept: of two minutes, or ten of a node's."""
_MARKERS_PERIOD_S = 1.0
"""Shortest time between two requests for the markers of a session: an answer has them all."""


@dataclass(frozen=True)
class LiveFrames:
    """Consecutive frames of one stream.

    Attributes:
        node: name of the node.
        stream_id: its stream.
        info: array of the stream.
        columns: flat columns, n rows each, with the server's time. What may be unknown is a float,
            and NaN where it is; an unknown server's time is `UNKNOWN_T_NS`. Without a calibration
            or a tare, and while the estimator compiles, all of an estimate is unknown.
    """

    node: str
    stream_id: str
    info: ArrayInfo
    columns: Mapping[str, Array]


@dataclass(frozen=True)
class Event:
    """Event of a session.

    Attributes:
        kind: `marker`, `recording_started`, `recording_stopped` or `session_sealed`.
        node: node of the session.
        session_id: id of the session.
        text: label of the marker, else the session's name.
        t_ns: server's UTC.
    """

    kind: str
    node: str
    session_id: str
    text: str
    t_ns: int

    def __str__(self) -> str:
        plain = self.kind.replace("_", " ")
        return self.text if self.kind == "marker" else f"{plain}: {self.text}"


class Outlet:
    """Base of outlets, which publish a bridge's data. No method waits for a reader."""

    columns: tuple[str, ...] | None = None
    """Columns of the frames; empty: all; None: no frames are needed."""
    rate_hz = 10.0
    """Rate of summaries, and of the messages beside them."""

    def has_readers(self, node: str) -> bool:
        """Return whether the frames of a node are needed now."""
        return True

    def write_frames(self, frames: LiveFrames, server_clock: LiveClock) -> None:
        """Publish frames; `server_clock` is the server's UTC against this machine's clock."""

    def write_event(self, event: Event, server_clock: LiveClock) -> None:
        """Publish an event."""

    def write_summary(self, summary: Mapping[str, Any]) -> None:
        """Publish a summary, the message `frame` of the live page."""

    def write_node(self, node: str, view: Mapping[str, Any] | None) -> None:
        """Publish the state of a node; None: no server, so it is unknown."""

    async def run(self) -> None:
        """Run the own work of the outlet until cancelled."""
        await asyncio.Event().wait()

    def close(self) -> None:
        """End the outlet."""


class Reporter:
    """Reporter of problems: each once, until it is over.

    Args:
        write: receives a line of text.
    """

    def __init__(self, write: Callable[[str], None]) -> None:
        self._write = write
        self._problems: set[str] = set()

    def report(self, subject: str, problem: str | None) -> None:
        """Report the problem of a subject, unless it has one already; None: it is over."""
        if problem is None and subject in self._problems:
            self._problems.discard(subject)
            self._write(f"{subject}: works again")
        elif problem is not None and subject not in self._problems:
            self._problems.add(subject)
            self._write(f"{subject}: {problem}")


class LiveClock:
    """Offset to a clock at any instant, by its newest measurements."""

    def __init__(self) -> None:
        self._rows: deque[tuple[int, int, int]] = deque(maxlen=_ROWS_MAX)
        self._offsets: ClockOffsets | None = None

    def add(self, t_mono_ns: int, offset_ns: int, uncertainty_ns: int) -> None:
        """Add a measurement, unless it is known."""
        if (row := (t_mono_ns, offset_ns, uncertainty_ns)) not in self._rows:
            self._rows.append(row)
            columns = np.array(self._rows, dtype=np.int64).T.copy()
            self._offsets = ClockOffsets(OffsetRows(*columns))

    def offset_and_bound_at(self, t_mono_ns: Array) -> BoundedOffset | None:
        """Return the offset and its bound at instants of the clock that never steps.

        None: never measured.
        """
        return None if self._offsets is None else self._offsets.offset_and_bound_at(t_mono_ns)

    def to_mono_ns(self, t_ns: Array) -> tuple[Array, Array] | None:
        """Return instants by the clock that never steps, and their bounds; None: never measured."""
        if self._offsets is None:
            return None
        # The instant is off by the drift since the last row, and the offset by as much of that.
        offset_ns, bound_ns = self._offsets.offset_and_bound_at(t_ns - self._rows[-1][1])
        return t_ns - offset_ns, bound_ns + bound_ns // 1000


@dataclass
class _KnownSession:
    """Session as it was published last."""

    state: str
    marker_ids: set[str] = field(default_factory=set)
    requested_s: float = -math.inf


@dataclass
class _KnownNode:
    """Node as its server showed it last."""

    stream_id: str
    clock: LiveClock = field(default_factory=LiveClock)


class ServerFollower:
    """Follower of one server, which gives an outlet all that is new.

    Args:
        server: client of the server.
        outlet: outlet of the bridge.
        reporter: reporter of problems.
        nodes: names of nodes; empty: all.
        is_public: True: a private server may be republished.
    """

    def __init__(
        self,
        server: Client,
        outlet: Outlet,
        reporter: Reporter,
        nodes: Collection[str] = (),
        *,
        is_public: bool = False,
    ) -> None:
        self.server_clock = LiveClock()
        """The server's UTC against `time.monotonic_ns` of this machine."""
        self._server, self._outlet, self._reporter = server, outlet, reporter
        self._names, self._is_public = nodes, is_public
        self._nodes: dict[str, _KnownNode] = {}
        self._feeds: dict[str, asyncio.Task[None]] = {}
        self._sessions: dict[str, _KnownSession] = {}
        self._late: dict[str, Mapping[str, Any]] = {}  # sessions whose markers are asked for later
        self._has_connected = False

    async def run(self) -> None:
        """Follow the server until cancelled.

        Raises:
            UsageError: the server is private, and the bridge is not public.
            ClientError: no server at first, or it rejects the client.
        """
        url = f"ws{self._server.url.removeprefix('http')}{LIVE_PATH}?rate_hz={self._outlet.rate_hz}"
        options: dict[str, Any] = {"additional_headers": self._server.headers, "proxy": None}
        options |= {"ssl": self._server.http.context, "max_size": None, "close_timeout": 1.0}
        try:
            while True:
                try:
                    await self._check_access()
                    async with connect(url, compression=None, **options) as socket:
                        await run_until_first_ends(self._follow(socket), _ping(socket))
                except (OSError, WebSocketException, ClientError) as error:
                    if not self._has_connected and isinstance(error, ClientError):
                        raise
                    self._reporter.report(self._server.url, f"no connection: {error}")
                    for name in self._nodes:
                        self._outlet.write_node(name, None)
                await asyncio.sleep(_RETRY_S)
        finally:
            for feed in self._feeds.values():
                feed.cancel()
            await asyncio.gather(*self._feeds.values(), return_exceptions=True)

    async def _check_access(self) -> None:
        login = await asyncio.to_thread(self._server.http.get, "/login", field="private")
        if login["private"] and not self._is_public:
            raise UsageError(
                f"the server {self._server.url} is private, and a bridge shows its data to whoever "
                "reaches the bridge",
                remedy="Add --public if they may see it",
            )

    async def _follow(self, socket: ClientConnection) -> None:
        async for text in socket:
            message = json.loads(text)
            match message["type"]:
                case "hello":
                    self._reporter.report(self._server.url, None)
                    for name in {*self._names} - {view["node"] for view in message["nodes"]}:
                        self._reporter.report(f"node {name}", "not known to the server yet")
                    for view in message["nodes"]:
                        self._update_node(view)
                    self._late.clear()
                    is_first, self._has_connected = not self._has_connected, True
                    await self._update_sessions(message["recording"], is_first=is_first)
                case "node":
                    self._update_node(message["node"])
                case "session":
                    await self._update_session(message["session"], is_new=True)
                case "frame" if self._is_followed(message["node"]):
                    self._outlet.write_summary(message)
                case "pong":
                    sent_ns, now_ns = round(message["t_ms"] * 1e6), time.monotonic_ns()
                    middle_ns, half_ns = (sent_ns + now_ns) // 2, (now_ns - sent_ns) // 2 + 1
                    self.server_clock.add(middle_ns, message["t_ns"] - middle_ns, half_ns)
                    await self._update_late_sessions()

    def _is_followed(self, node: str) -> bool:
        return not self._names or node in self._names

    def _update_node(self, view: Mapping[str, Any]) -> None:
        name, stream_id, measured = view["node"], view["stream_id"], view["clock"]
        if not self._is_followed(name):
            return
        self._reporter.report(f"node {name}", None)
        node = self._nodes.get(name)
        if node is None or node.stream_id != stream_id:
            node = self._nodes[name] = _KnownNode(stream_id)
        if measured is not None:
            node.clock.add(*(measured[each] for each in _CLOCK_FIELDS))
        self._outlet.write_node(name, view)
        if self._outlet.columns is not None and name not in self._feeds:
            self._feeds[name] = asyncio.create_task(self._feed_frames(name, self._outlet.columns))

    async def _update_sessions(self, recording: list[dict[str, Any]], *, is_first: bool) -> None:
        """Publish the changes of the time without a connection; nothing at the first one."""
        present = {view["id"]: view for view in recording}
        for session_id in self._sessions.keys() - present.keys():
            path = f"/sessions/{session_id}"
            try:
                present[session_id] = await asyncio.to_thread(self._server.http.get, path)
            except NotFoundError:
                del self._sessions[session_id]
        for view in present.values():
            await self._update_session(view, is_new=not is_first)

    async def _update_late_sessions(self) -> None:
        for view in tuple(self._late.values()):
            await self._update_session(view, is_new=True)

    async def _update_session(self, view: Mapping[str, Any], *, is_new: bool) -> None:
        session_id, state = view["id"], view["state"]
        self._late.pop(session_id, None)
        known = self._sessions.get(session_id)
        if not self._is_followed(view["node"]) or (known is None and state == "sealed"):
            return
        is_new = is_new and (known is not None or state == "recording")

        def write(kind: str, text: str, t_ns: int) -> None:
            if is_new:
                event = Event(kind, view["node"], session_id, text, t_ns)
                self._outlet.write_event(event, self.server_clock)

        if known is None:
            known = self._sessions[session_id] = _KnownSession(state)
            if state == "recording":
                write("recording_started", view["name"], view["started_t_ns"])
        if view["marker_count"] != len(known.marker_ids):
            now_s = time.monotonic()
            if known.state == state and now_s - known.requested_s < _MARKERS_PERIOD_S:
                self._late[session_id] = view
                return
            known.requested_s = now_s
            path = f"/sessions/{session_id}/markers"
            try:
                markers = (await asyncio.to_thread(self._server.http.get, path))["items"]
            except NotFoundError:  # it was deleted
                del self._sessions[session_id]
                return
            for marker in markers:
                is_edge = marker.get("stream_id") is not None
                is_known = not is_edge or marker["bound_ns"] is not None  # its server's time
                if is_known and marker["id"] not in known.marker_ids:
                    write("marker", marker["label"], marker["t_ns"])
            known.marker_ids = {marker["id"] for marker in markers}
        if known.state == "recording" != state:
            write("recording_stopped", view["name"], view["stopped_t_ns"])
        known.state = state
        if state == "sealed":
            write("session_sealed", view["name"], view["stopped_t_ns"])
            del self._sessions[session_id]

    async def _feed_frames(self, name: str, columns: tuple[str, ...]) -> None:
        """Give the outlet the frames of a node until cancelled."""
        from foottile.asyncio_client import AsyncLiveStream
        from foottile.live import FrameLoss, LiveRequest

        def report_loss(loss: FrameLoss) -> None:
            self._reporter.report(f"frames of {name}", f"{loss}; further ones are not reported")

        request = LiveRequest.create(self._server.url, name, columns, "drop_oldest")
        while True:
            try:
                http = self._server.http
                async with AsyncLiveStream(request, http, on_loss=report_loss) as stream:
                    info: ArrayInfo | None = None
                    async for batch in stream:
                        stream_id = stream.position and stream.position[0]
                        if info is None or info.stream_id != stream_id:
                            info = read_array_info(batch.schema, where=f"live feed of {name}")
                            may_be_unknown = [
                                field.name for field in batch.schema if field.nullable
                            ]
                        if self._outlet.has_readers(name):
                            self._write_frames(name, info, may_be_unknown, batch)
                        self._reporter.report(name, None)
            except Exception as error:  # a bug of one feed must not end the others
                self._reporter.report(name, f"no frames: {error!r}")
            await asyncio.sleep(_RETRY_S)

    def _write_frames(
        self, name: str, info: ArrayInfo, may_be_unknown: list[str], batch: pa.RecordBatch
    ) -> None:
        node = self._nodes[name]
        columns = {
            each: batch.column(each).to_numpy(zero_copy_only=False)
            for each in batch.schema.names
            if each not in may_be_unknown
        }
        # All at once: one by one, these conversions would take most of a bridge's time.
        numbers = batch.select(may_be_unknown).to_tensor(null_to_nan=True).to_numpy()
        columns |= zip(may_be_unknown, numbers.T, strict=True)
        is_present = node.stream_id == info.stream_id
        measured = node.clock.offset_and_bound_at(columns["t_mono_ns"]) if is_present else None
        unknown = np.full(len(batch), UNKNOWN_T_NS)
        times = (unknown, unknown)
        if measured is not None:
            times = columns["t_ns"] + measured.offset_ns, measured.bound_ns
        columns |= zip(_SERVER_TIMES, times, strict=True)
        frames = LiveFrames(name, info.stream_id, info, columns)
        self._outlet.write_frames(frames, self.server_clock)


async def _ping(socket: ClientConnection) -> None:
    """Send pings, the first ones fast: one of several has a short round trip."""
    for number in count():
        await socket.send(json.dumps({"type": "ping", "t_ms": time.monotonic_ns() * 1e-6}))
        await asyncio.sleep(_PING_INTERVAL_S if number > _FIRST_PINGS else 0.1)
