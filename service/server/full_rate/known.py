"""What is known of a stream when somebody asks for its next frame."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Protocol

from service.server.node import ServerNode
from service.server.streams import ServerStream
from storage.intervals import NO_END, Intervals, Losses


class Known(Protocol):
    """A stream, as far as it is known now."""

    @property
    def held(self) -> Intervals:
        """Numbers in its journal."""

    @property
    def lost(self) -> Losses:
        """Numbers that will not come, and why."""

    @property
    def is_over(self) -> bool:
        """Does its node take another one by now?"""

    @property
    def end(self) -> int:
        """Number after the last frame that is known of."""

    @property
    def following(self) -> str | None:
        """The stream that its node took after it; None: it is the present one."""

    def to_come(self) -> Intervals:
        """Numbers that are not here and that its node may still send."""


class KnownStream:
    """A stream of a node of this server.

    Args:
        node: the node.
        boot_id: name of the stream.
        stream: what is kept of it; None: nothing yet.
        needed: which numbers sessions need of the node, by stream.
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
        """A stream by its name; None if it is not known, or not any more."""
        stream = node.streams.get(boot_id)
        # After a restart of the server nothing is there of one of which nothing has come.
        if stream is None and (node.has_spoken or boot_id not in node.order):
            return None
        return cls(node, boot_id, stream, needed)

    @property
    def held(self) -> Intervals:
        """As `Known.held`."""
        return Intervals() if self._stream is None else self._stream.held

    @property
    def lost(self) -> Losses:
        """As `Known.lost`."""
        return Losses() if self._stream is None else self._stream.lost

    @property
    def is_over(self) -> bool:
        """As `Known.is_over`."""
        return self._boot_id != self._node.boot_id

    @property
    def end(self) -> int:
        """As `Known.end`."""
        said = None if self._stream is None else self._stream.notes.next_seq
        known = [last + 1 for last in (self.held.last, self.lost.all.last) if last is not None]
        return max([said or 0, *known])

    @property
    def following(self) -> str | None:
        """As `Known.following`."""
        node, order = self._node, self._node.order
        if self._boot_id in order:
            return (*order, None)[order.index(self._boot_id) + 1]
        # The node has forgotten it: the next is the first that it began later, by its own clock.
        journal = None if self._stream is None else self._stream.journal
        last_t_ns = None if journal is None else journal.t_ns_near(NO_END, newest=True)
        if last_t_ns is not None:
            for each in node.hello.earlier:
                if each.t_ns_first > last_t_ns:
                    return each.array_info.boot_id
        return node.boot_id

    def to_come(self) -> Intervals:
        """As `Known.to_come`."""
        stream = self._stream
        if stream is None:
            return Intervals([(0, NO_END)])
        if stream.node_has is None:  # it has not spoken since the server was started
            return stream.may_come - stream.held
        needed = self._needed().get(self._boot_id, Intervals())
        return stream.lacks(needed, all_of_it=not self.is_over)
