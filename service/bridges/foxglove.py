"""Foxglove's live view: a websocket server of the protocol `foxglove.sdk.v1`.

Topics, schemas and encoder are those of MCAP files. The library sends from its own threads, and
drops the oldest messages for a slow viewer.
"""

from __future__ import annotations

from typing import Any

import foxglove
import numpy as np

from devices.errors import UsageError
from service.bridges.follower import Event, LiveClock, LiveFrames, Outlet
from storage.clock.table import ClockTable
from storage.formats.export import Export, FrameSource
from storage.formats.slice import Slice
from storage.formats.writers.format import make_names_unique
from storage.formats.writers.mcap import FrameChunk, find_drawn_rows
from storage.formats.writers.mcap_messages import FoxgloveEncoder, Message, make_ros2_name
from storage.schema import ESTIMATE_COLUMNS, UNKNOWN_T_NS

_ESTIMATES = tuple(column.name for column in ESTIMATE_COLUMNS)
_READINGS = (
    "seq",
    "t_mono_ns",
    "t_ns",
    "pressure_raw",
    "servo_age_us",
    "tile_flags",
    "frame_flags",
)


class _NodeChannels:
    """Channels of a node, for one stream with or without estimates, and their encoder."""

    def __init__(self, context: foxglove.Context, frames: LiveFrames, topic_prefix: str) -> None:
        self.key = frames.stream_id, frames.has_estimates
        self._context = context
        self._schemas: list[foxglove.Schema] = []
        self._channels: list[foxglove.Channel] = []
        self._last_turn = -1
        names = _READINGS + (_ESTIMATES if frames.has_estimates else ())
        # A clock adds the columns of the server's time.
        clock = ClockTable({}, (), ())
        export = Export(FrameSource(names, lambda _: (), 0), frames.info, {}, Slice(), clock)
        writer: Any = self  # two methods of an MCAP writer
        self._encoder = FoxgloveEncoder(writer, export, topic_prefix)

    def register_schema(self, name: str, encoding: str, data: bytes) -> int:
        """Register a schema; return its number."""
        self._schemas.append(foxglove.Schema(name=name, encoding=encoding, data=data))
        return len(self._schemas) - 1

    def register_channel(self, topic: str, encoding: str, schema: int, _: object) -> int:
        """Open a channel; return its number."""
        described: dict[str, Any] = {"schema": self._schemas[schema], "message_encoding": encoding}
        self._channels.append(foxglove.Channel(topic, context=self._context, **described))
        return len(self._channels) - 1

    def has_readers(self) -> bool:
        """Return whether a viewer reads a channel."""
        return any(channel.has_sinks() for channel in self._channels)

    def send_frames(self, frames: LiveFrames) -> None:
        """Send frames at the server's time; at the node's if it is unknown."""
        server_ns = frames.columns["t_server_ns"]
        t_ns = np.where(server_ns == UNKNOWN_T_NS, frames.columns["t_ns"], server_ns)
        rows, self._last_turn = find_drawn_rows(t_ns, self._last_turn)
        chunk = FrameChunk(t_ns, frames.columns, rows.tolist(), [], None)
        for message in self._encoder.encode_messages(chunk):
            self._send(message)

    def send_event(self, event: Event) -> None:
        """Send an event as a marker."""
        self._send(self._encoder.encode_marker(event.t_ns, str(event)))

    def close(self) -> None:
        """Close all channels."""
        for channel in self._channels:
            channel.close()

    def _send(self, message: Message) -> None:
        at_ns, number, content = message
        self._channels[number].log(content, log_time=at_ns)


class FoxgloveOutlet(Outlet):
    """Websocket server for Foxglove.

    Args:
        host: address to listen on.
        port: port; 0: any.

    Raises:
        UsageError: the address cannot be listened on.
    """

    columns = _READINGS + _ESTIMATES

    def __init__(self, host: str, port: int) -> None:
        self._context = foxglove.Context()
        try:
            self._server = foxglove.start_server(
                name="FootTile", host=host, port=port, context=self._context
            )
        except RuntimeError as error:
            raise UsageError(
                f"cannot listen on {host}:{port}: {error}", remedy="Name another --host or --port"
            ) from error
        self.url = f"ws://{host}:{self._server.port}"
        """Address for viewers."""
        self._prefixes: dict[str, str] = {}
        self._nodes: dict[str, _NodeChannels] = {}

    def has_readers(self, node: str) -> bool:
        """Return whether a viewer reads a node's topics, or they are not advertised yet."""
        return node not in self._nodes or self._nodes[node].has_readers()

    def write_frames(self, frames: LiveFrames, server_clock: LiveClock) -> None:
        """Send the messages of frames."""
        name = frames.node
        node = self._nodes.get(name)
        if node is None or node.key != (frames.stream_id, frames.has_estimates):
            if node is not None:
                node.close()
            if name not in self._prefixes:
                names = [*self._prefixes.values(), f"/{make_ros2_name(name)}"]
                self._prefixes[name] = make_names_unique(names)[-1]
            node = self._nodes[name] = _NodeChannels(self._context, frames, self._prefixes[name])
        node.send_frames(frames)

    def write_event(self, event: Event, server_clock: LiveClock) -> None:
        """Send an event of a node that has sent frames, as a marker."""
        if event.node in self._nodes:
            self._nodes[event.node].send_event(event)

    def close(self) -> None:
        """Stop the server."""
        self._server.stop()
