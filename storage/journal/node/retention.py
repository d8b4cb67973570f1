"""How long a node keeps frames: as long as sessions need them, else a ring, within a budget."""

from __future__ import annotations

import errno
import math
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from devices.errors import StorageError
from storage.journal.journal import RING_NS
from storage.journal.node.stream import NodeStream
from storage.journal.node.wanted import Wanted

BUDGET_BYTES = 4 << 30
"""A day and a half of four tiles at full rate."""
_WEIGH_S = 1.0
"""Between two looks at what all segments take."""
_NEVER_NS = 2**62
"""Later than every frame."""


class Retention:
    """Deletes what no session needs, oldest first.

    Args:
        folder: the node's journals.
        wanted: what sessions need.
        budget_bytes: what the journals may take.
        may_drop: False: nothing is deleted.
    """

    def __init__(
        self, folder: Path, wanted: Wanted, *, budget_bytes: int, may_drop: bool = True
    ) -> None:
        self._folder = folder
        self._wanted = wanted
        self._budget_bytes = budget_bytes
        self._may_drop = may_drop
        self._began_s = time.monotonic()
        self._weighed_s = -math.inf

    def keep_to_budget(self, streams: Sequence[NodeStream], *, at_once: bool) -> None:
        """Make room if the journals take more than they may.

        Args:
            streams: all of the node, oldest first.
            at_once: look, even if that was done a moment ago.

        Raises:
            StorageError: they take more, and all of it is needed.
        """
        now_s = time.monotonic()
        if now_s - self._weighed_s < _WEIGH_S and not at_once:
            return
        self._weighed_s = now_s
        while sum(s.journal.size_bytes for s in streams if s.journal) > self._budget_bytes:
            if not self.evict(streams):
                raise StorageError(
                    f"the journal has its {self._budget_bytes} bytes, all of frames that sessions "
                    "need",
                    where=str(self._folder),
                    errno=errno.ENOSPC,
                )

    def evict(self, streams: Sequence[NodeStream]) -> bool:
        """Make room: delete the oldest frames that no session needs; False if there were none."""
        return self._may_drop and any(stream.evict(self._wanted) for stream in streams)

    def tidy(self, streams: Sequence[NodeStream]) -> list[NodeStream]:
        """Delete frames that are older than the ring; return the streams that have none left."""
        return [stream for stream in streams if self._may_drop and self._tidy(stream)]

    def _tidy(self, stream: NodeStream) -> bool:
        """Delete frames that are older than the ring; is the stream empty and not wanted?"""
        journal = stream.journal
        if journal is None:
            return False
        past_ring = self._is_past_ring(stream)
        newest = stream.recent(max(0, stream.next_seq - 1))
        if self._wanted.may_be_all:  # until there is no room
            stream.save_losses()
            return False
        with suppress(StorageError):
            if not stream.has_ended and newest:
                stream.prune(newest[-1].t_ns_last - RING_NS, self._wanted)
            elif stream.has_ended and past_ring:
                stream.prune(_NEVER_NS, self._wanted)
        is_empty = stream.is_settled and not journal.held
        if is_empty and past_ring and not self._wanted.numbers(stream.boot_id):
            journal.delete()
            return True
        stream.save_losses()
        return False

    def _is_past_ring(self, stream: NodeStream) -> bool:
        """Did a stream end longer ago than the ring, in this process or by the age of its files?"""
        ring_s = RING_NS * 1e-9
        if time.monotonic() - self._began_s > ring_s:
            return True
        try:
            written_s = max(path.stat().st_mtime for path in stream.folder.iterdir())
        except (OSError, ValueError):
            return False
        return stream.is_settled and time.time() - written_s > ring_s
