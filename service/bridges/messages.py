"""Live frames as messages of the MCAP formats: the same topics, schemas and encoders."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from service.bridges.follower import Event, LiveClock, LiveFrames, Outlet
from storage.clock.table import ClockTable
from storage.formats.export import Export, FrameSource
from storage.formats.slice import Slice
from storage.formats.writers.format import make_names_unique
from storage.formats.writers.mcap import FrameChunk, find_drawn_rows
from storage.schema import ESTIMATE_COLUMNS, UNKNOWN_T_NS

if TYPE_CHECKING:
    from storage.formats.writers.mcap_messages import Message, MessageEncoder


_REQUIRED_COLUMNS = ("seq", "t_mono_ns", "t_ns", "tile_flags", "frame_flags")
_ESTIMATES = tuple(column.name for column in ESTIMATE_COLUMNS)


class Channels(Protocol):
    """Channels of one node, with the two methods of an MCAP writer that encoders call."""

    def register_schema(self, name: str, encoding: str, data: bytes) -> int:
        """Register a schema; return its number."""

    def register_channel(
        self, topic: str, message_encoding: str, schema_id: int, metadata: dict[str, str]
    ) -> int:
        """Open a channel; return its number."""

    def has_readers(self) -> bool:
        """Return whether anyone reads a channel."""

    def send(self, message: Message) -> None:
        """Send a message without waiting."""

    def close(self) -> None:
        """Close all channels."""


class _NodeMessages:
    """Encoder and channels of a node, for one stream with or without estimates."""

    def __init__(
        self,
        kind: type[MessageEncoder],
        columns: tuple[str, ...],
        channels: Channels,
        frames: LiveFrames,
        prefix: str,
    ) -> None:
        self.channels, self.key = channels, (frames.stream_id, frames.has_estimates)
        source = FrameSource(
            [name for name in columns if frames.has_estimates or name not in _ESTIMATES],
            lambda _: (),
            0,
        )
        # A clock adds the columns of the server's time.
        export = Export(source, frames.info, {}, Slice(), clock=ClockTable({}, (), ()))
        writer: Any = channels
        self.encoder = kind(writer, export, prefix)
        self._last_turn = -1

    def encode_frames(self, frames: LiveFrames) -> Iterator[Message]:
        """Yield the messages of frames, at the server's time; at the node's if it is unknown."""
        columns = frames.columns
        t_ns = np.where(
            columns["t_server_ns"] == UNKNOWN_T_NS, columns["t_ns"], columns["t_server_ns"]
        )
        drawn_rows, self._last_turn = find_drawn_rows(t_ns, self._last_turn)
        return self.encoder.encode_messages(
            FrameChunk(t_ns, columns, drawn_rows.tolist(), [], None)
        )


class MessageOutlet(Outlet):
    """Outlet of messages.

    Args:
        kind: encoder of the messages.
        readings: columns of readings in the messages.
        open_channels: opens the channels of a node, by its topics' prefix.
    """

    def __init__(
        self,
        kind: type[MessageEncoder],
        readings: tuple[str, ...],
        open_channels: Callable[[str], Channels],
    ) -> None:
        self.columns: tuple[str, ...] = (*_REQUIRED_COLUMNS, *readings, *_ESTIMATES)
        self._kind, self._open_channels = kind, open_channels
        self._prefixes: dict[str, str] = {}
        self._nodes: dict[str, _NodeMessages] = {}

    def has_readers(self, node: str) -> bool:
        """Return whether anyone reads a node's topics, or these are not announced yet."""
        known = self._nodes.get(node)
        return known is None or known.channels.has_readers()

    def write_frames(self, frames: LiveFrames, server_clock: LiveClock) -> None:
        """Send the messages of frames."""
        from storage.formats.writers.mcap_messages import make_ros2_name

        node = self._nodes.get(frames.node)
        if node is None or node.key != (frames.stream_id, frames.has_estimates):
            if node is not None:
                node.channels.close()
            if frames.node not in self._prefixes:
                names = [*self._prefixes.values(), f"/{make_ros2_name(frames.node)}"]
                self._prefixes[frames.node] = make_names_unique(names)[-1]
            prefix = self._prefixes[frames.node]
            node = _NodeMessages(
                self._kind, self.columns, self._open_channels(prefix), frames, prefix
            )
            self._nodes[frames.node] = node
        for message in node.encode_frames(frames):
            node.channels.send(message)

    def write_event(self, event: Event, server_clock: LiveClock) -> None:
        """Send an event of a node that has sent frames, as a marker."""
        if (node := self._nodes.get(event.node)) is not None:
            node.channels.send(node.encoder.encode_marker(event.t_ns, str(event)))

    def close(self) -> None:
        """Close all channels."""
        for node in self._nodes.values():
            node.channels.close()
