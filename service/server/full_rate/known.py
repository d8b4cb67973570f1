"""Present state of a stream, for readers of the live feed."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Protocol

from service.server.node import ServerNode
from service.server.streams import ServerStream
from storage.intervals import NO_END, Intervals, Losses


class Known(Protocol):
    """Present state of a stream."""

    @property
    def held(self) -> Intervals:
        """Frames in its journal."""

    @property
    def lost(self) -> Losses:
        """Frames that will not come, by reason."""

    @property
    def is_over(self) -> bool:
        """True if the node has another present stream."""

    @property
    def end(self) -> int:
        """Number after the last known frame."""

    @property
    def following(self) -> str | None:
        """Next stream of the node; None: this is the present one."""

    def to_come(self) -> Intervals:
        """Return the frames that are not stored and that the node can still send."""


class KnownStream:
    """State of a stream of this server.

    Args:
        node: the node.
        boot_id: id of the stream.
        stream: stored stream; None: nothing yet.
        needed: returns the frames that sessions need of the node, by stream id.
    """

    def __init__(
        self,
        node: ServerNode,
        boot_id: str,
        stream: ServerStream | None,
        needed: Callable[[], Mapping[str, Intervals]],
    ) -> None:
        self._node, self._boot_id = node, boot_id
        self._stream = stream
        self._needed = needed

    @classmethod
    def of(
        cls, node: ServerNode, boot_id: str, needed: Callable[[], Mapping[str, Intervals]]
    ) -> KnownStream | None:
        """Return the view of a stream by its id; None: unknown, or no longer known."""
        stream = node.streams.get(boot_id)
        # After a restart of the server a stream without stored frames has no folder.
        if stream is None and (node.has_spoken or boot_id not in node.order):
            return None
        return cls(node, boot_id, stream, needed)

    @property
    def held(self) -> Intervals:
        """See `Known.stored`."""
        return Intervals() if self._stream is None else self._stream.held

    @property
    def lost(self) -> Losses:
        """See `Known.lost`."""
        return Losses() if self._stream is None else self._stream.lost

    @property
    def is_over(self) -> bool:
        """See `Known.has_ended`."""
        return self._boot_id != self._node.boot_id

    @property
    def end(self) -> int:
        """See `Known.end`."""
        announced = None if self._stream is None else self._stream.notes.next_seq
        ends = [last + 1 for last in (self.held.last, self.lost.all.last) if last is not None]
        return max([announced or 0, *ends])

    @property
    def following(self) -> str | None:
        """See `Known.following`."""
        node, order = self._node, self._node.order
        if self._boot_id in order:
            return (*order, None)[order.index(self._boot_id) + 1]
        # Hello no longer lists it: the next one is the first that began later, by the node's clock.
        journal = None if self._stream is None else self._stream.journal
        last_t_ns = None if journal is None else journal.t_ns_near(NO_END, newest=True)
        if last_t_ns is not None:
            for each in node.hello.earlier:
                if each.t_ns_first > last_t_ns:
                    return each.array_info.boot_id
        return node.boot_id

    def to_come(self) -> Intervals:
        """Return the frames as in `Known.to_come`."""
        stream = self._stream
        if stream is None:
            return Intervals([(0, NO_END)])
        if stream.node_has is None:  # no hello since the server was started
            return stream.may_come - stream.held
        needed = self._needed().get(self._boot_id, Intervals())
        return stream.lacks(needed, all_of_it=not self.is_over)
