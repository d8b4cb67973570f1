"""Present state of a stream, for readers of the live feed."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Protocol

from service.server.node import ServerNode
from service.server.streams import ServerStream
from storage.intervals import NO_END, Intervals, Losses


class StreamView(Protocol):
    """Present state of a stream."""

    @property
    def stored(self) -> Intervals:
        """Frames in its journal."""

    @property
    def lost(self) -> Losses:
        """Frames that will not come, by reason."""

    @property
    def has_ended(self) -> bool:
        """True if the node has another present stream."""

    @property
    def end_seq(self) -> int:
        """Number after the last known frame."""

    @property
    def next_stream_id(self) -> str | None:
        """Next stream of the node; None: this is the present one."""

    def compute_unstored_obtainable(self) -> Intervals:
        """Return the frames that are not stored and that the node can still send."""


class ServerStreamView:
    """State of a stream of this server.

    Args:
        node: the node.
        stream_id: id of the stream.
        stream: stored stream; None: nothing yet.
        needed_frames: returns the frames that sessions need of the node, by stream id.
    """

    def __init__(
        self,
        node: ServerNode,
        stream_id: str,
        stream: ServerStream | None,
        needed_frames: Callable[[], Mapping[str, Intervals]],
    ) -> None:
        self._node, self._stream_id = node, stream_id
        self._stream = stream
        self._needed_frames = needed_frames

    @classmethod
    def find_known(
        cls, node: ServerNode, stream_id: str, needed_frames: Callable[[], Mapping[str, Intervals]]
    ) -> ServerStreamView | None:
        """Return the view of a stream, empty without stored frames; None: not known, or not now."""
        stream = node.streams.get(stream_id)
        # After a restart of the server a stream without stored frames has no folder.
        if stream is None and (node.has_connected or stream_id not in node.stream_order):
            return None
        return cls(node, stream_id, stream, needed_frames)

    @property
    def stored(self) -> Intervals:
        """See `StreamView.stored`."""
        return Intervals() if self._stream is None else self._stream.stored

    @property
    def lost(self) -> Losses:
        """See `StreamView.lost`."""
        return Losses() if self._stream is None else self._stream.lost

    @property
    def has_ended(self) -> bool:
        """See `StreamView.has_ended`."""
        return self._stream_id != self._node.stream_id

    @property
    def end_seq(self) -> int:
        """See `StreamView.end_seq`."""
        announced = None if self._stream is None else self._stream.notes.next_seq
        ends = [last + 1 for last in (self.stored.last, self.lost.numbers.last) if last is not None]
        return max([announced or 0, *ends])

    @property
    def next_stream_id(self) -> str | None:
        """See `StreamView.next_stream_id`."""
        node, order = self._node, self._node.stream_order
        if self._stream_id in order:
            return (*order, None)[order.index(self._stream_id) + 1]
        # Hello no longer lists it: the next one is the first that began later, by the node's clock.
        journal = None if self._stream is None else self._stream.journal
        last_t_ns = (
            None if journal is None else journal.find_batch_t_ns_near(NO_END, at_or_before=True)
        )
        if last_t_ns is not None:
            for each in node.hello.earlier:
                if each.t_ns_first > last_t_ns:
                    return each.array_info.stream_id
        return node.stream_id

    def compute_unstored_obtainable(self) -> Intervals:
        """Return the frames as in `StreamView.compute_unstored_obtainable`."""
        stream = self._stream
        if stream is None:
            return Intervals([(0, NO_END)])
        if stream.node_ranges is None:  # no hello since the server was started
            return stream.obtainable - stream.stored
        needed = self._needed_frames().get(self._stream_id, Intervals())
        return stream.frames_to_request(needed, include_unneeded=not self.has_ended)
