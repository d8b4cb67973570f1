"""Foxglove's live view: a websocket server of the protocol `foxglove.sdk.v1`.

Topics, schemas and encoder are those of MCAP files. The library sends from its own threads, and
drops the oldest messages for a slow viewer.
"""

from __future__ import annotations

from typing import Any

import foxglove
import numpy as np

from devices.errors import UsageError
from devices.frames import ArrayInfo
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
_Schema = tuple[str, str, bytes]
"""Schema: name, encoding, content."""
_Topic = tuple[str, str, _Schema]
"""Topic: name, encoding of its messages, schema."""
UNKNOWN_FLAGS = 2**32 - 1
"""Value of `estimate_flags` in a frame without an estimate: the field has no NaN."""


class _NodeChannels:
    """Channels of a node and their encoder, across its streams.

    A channel stays open as long as its topic has the same schema, so that no viewer loses it.
    """

    def __init__(self, context: foxglove.Context, topic_prefix: str) -> None:
        self.topic_prefix = topic_prefix
        self._context = context
        self._stream_id = ""
        self._last_turn = -1
        self._schemas: list[_Schema] = []
        self._topics: list[_Topic] = []
        self._open: dict[_Topic, foxglove.Channel] = {}
        self._encoder: FoxgloveEncoder

    def register_schema(self, name: str, encoding: str, data: bytes) -> int:
        """Note a schema; return its number."""
        self._schemas.append((name, encoding, data))
        return len(self._schemas) - 1

    def register_channel(self, topic: str, encoding: str, schema: int, _: object) -> int:
        """Note a channel to open; return its number."""
        self._topics.append((topic, encoding, self._schemas[schema]))
        return len(self._topics) - 1

    def has_readers(self) -> bool:
        """Return whether a viewer reads a channel."""
        return any(channel.has_sinks() for channel in self._open.values())

    def send_frames(self, frames: LiveFrames) -> None:
        """Send frames at the server's time; at the node's if it is unknown."""
        if frames.stream_id != self._stream_id:
            self._open_channels(frames.info)
            self._stream_id = frames.stream_id
        server_ns = frames.columns["t_server_ns"]
        t_ns = np.where(server_ns == UNKNOWN_T_NS, frames.columns["t_ns"], server_ns)
        rows, self._last_turn = find_drawn_rows(t_ns, self._last_turn)
        flags = frames.columns["estimate_flags"].astype(np.float64)  # float32 has no such number
        known = {"estimate_flags": np.nan_to_num(flags, nan=UNKNOWN_FLAGS).astype(np.uint32)}
        chunk = FrameChunk(t_ns, {**frames.columns, **known}, rows.tolist(), [], None)
        for message in self._encoder.encode_messages(chunk):
            self._send(message)

    def send_event(self, event: Event) -> None:
        """Send an event as a marker."""
        self._send(self._encoder.encode_marker(event.t_ns, str(event)))

    def _open_channels(self, info: ArrayInfo) -> None:
        """Open the channels of an array that are not open; close all others."""
        self._schemas, self._topics = [], []
        # A clock adds the columns of the server's time.
        clock = ClockTable({}, (), ())
        export = Export(
            FrameSource(FoxgloveOutlet.columns, lambda _: (), 0), info, {}, Slice(), clock
        )
        writer: Any = self  # two methods of an MCAP writer
        self._encoder = FoxgloveEncoder(writer, export, self.topic_prefix)
        for topic in self._open.keys() - set(self._topics):
            self._open.pop(topic).close()
        for topic in self._topics:
            if topic not in self._open:
                name, message_encoding, (schema_name, encoding, data) = topic
                schema = foxglove.Schema(name=schema_name, encoding=encoding, data=data)
                self._open[topic] = foxglove.Channel(
                    name, schema=schema, message_encoding=message_encoding, context=self._context
                )

    def _send(self, message: Message) -> None:
        at_ns, number, content = message
        self._open[self._topics[number]].log(content, log_time=at_ns)


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
        self._nodes: dict[str, _NodeChannels] = {}

    def has_readers(self, node: str) -> bool:
        """Return whether a viewer reads a node's topics, or they are not advertised yet."""
        return node not in self._nodes or self._nodes[node].has_readers()

    def write_frames(self, frames: LiveFrames, server_clock: LiveClock) -> None:
        """Send the messages of frames."""
        name = frames.node
        node = self._nodes.get(name)
        if node is None:
            names = [each.topic_prefix for each in self._nodes.values()]
            prefix = make_names_unique([*names, f"/{make_ros2_name(name)}"])[-1]
            node = self._nodes[name] = _NodeChannels(self._context, prefix)
        node.send_frames(frames)

    def write_event(self, event: Event, server_clock: LiveClock) -> None:
        """Send an event of a node that has sent frames, as a marker."""
        if event.node in self._nodes:
            self._nodes[event.node].send_event(event)

    def close(self) -> None:
        """Stop the server."""
        self._server.stop()
