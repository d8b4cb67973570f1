"""Retention on a node: frames that sessions need stay, others are a ring, within a budget."""

from __future__ import annotations

import errno
import math
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from devices.errors import StorageError
from storage.journal.journal import RING_DURATION_NS
from storage.journal.node.retention_requests import RetentionRequests
from storage.journal.node.stream import NodeStream

DEFAULT_BUDGET_BYTES = 4 << 30
"""Default budget: a day and a half of four tiles at full rate."""
_BUDGET_CHECK_INTERVAL_S = 1.0
"""Interval between two sums of the segments' sizes."""
_END_OF_TIME_NS = 2**62
"""Instant after every frame."""


class RetentionPolicy:
    """Deletion of frames that no session needs, oldest first.

    Args:
        folder: the node's journals.
        requests: retention requests.
        budget_bytes: most bytes of all journals.
        is_deletion_allowed: False: no frame is deleted.
    """

    def __init__(
        self,
        folder: Path,
        requests: RetentionRequests,
        *,
        budget_bytes: int,
        is_deletion_allowed: bool = True,
    ) -> None:
        self._folder = folder
        self._wanted = requests
        self._budget_bytes = budget_bytes
        self._may_drop = is_deletion_allowed
        self._began_s = time.monotonic()
        self._weighed_s = -math.inf

    def delete_unneeded_to_budget_or_raise_full(
        self, streams: Sequence[NodeStream], *, ignore_check_interval: bool
    ) -> None:
        """Delete the oldest unneeded segments beyond the budget; check once a second.

        Args:
            streams: all streams of the node, oldest first.
            ignore_check_interval: check even if the last check was a moment ago.

        Raises:
            StorageError: they exceed it, and sessions need every frame.
        """
        now_s = time.monotonic()
        if now_s - self._weighed_s < _BUDGET_CHECK_INTERVAL_S and not ignore_check_interval:
            return
        self._weighed_s = now_s
        while sum(s.journal.size_bytes for s in streams if s.journal) > self._budget_bytes:
            if not self.evict_oldest_unneeded_segment(streams):
                raise StorageError(
                    f"the journal's {self._budget_bytes} bytes are used up, and sessions need "
                    "every frame",
                    where=str(self._folder),
                    errno=errno.ENOSPC,
                )

    def evict_oldest_unneeded_segment(self, streams: Sequence[NodeStream]) -> bool:
        """Delete the oldest segment that no session needs; return whether there was one."""
        return self._may_drop and any(
            stream.evict_oldest_unneeded_segment(self._wanted) for stream in streams
        )

    def evict_expired_and_list_deleted_streams(
        self, streams: Sequence[NodeStream]
    ) -> list[NodeStream]:
        """Delete expired frames and save the losses; return streams that are deleted whole."""
        return [stream for stream in streams if self._may_drop and self._delete_expired_of(stream)]

    def _delete_expired_of(self, stream: NodeStream) -> bool:
        """Delete a stream's expired frames; return whether the stream is deleted completely."""
        journal = stream.journal
        if journal is None:
            return False
        past_ring = self._is_expired(stream)
        newest = stream.recent_batches(max(0, stream.next_seq - 1))
        if self._wanted.is_unknown:  # only a full budget deletes then
            stream.try_save_new_losses()
            return False
        with suppress(StorageError):
            if not stream.has_ended and newest:
                stream.evict_old_segments(newest[-1].t_ns_last - RING_DURATION_NS, self._wanted)
            elif stream.has_ended and past_ring:
                stream.evict_old_segments(_END_OF_TIME_NS, self._wanted)
        is_empty = stream.is_complete_on_disk and not journal.stored
        if (
            is_empty
            and past_ring
            and not self._wanted.node_session_or_server_numbers_of(stream.stream_id)
        ):
            journal.close_and_delete()
            return True
        stream.try_save_new_losses()
        return False

    def _is_expired(self, stream: NodeStream) -> bool:
        """Return whether a stream ended longer ago than the ring, by uptime or file times."""
        ring_s = RING_DURATION_NS * 1e-9
        if time.monotonic() - self._began_s > ring_s:
            return True
        try:
            written_s = max(path.stat().st_mtime for path in stream.folder.iterdir())
        except (OSError, ValueError):
            return False
        return stream.is_complete_on_disk and time.time() - written_s > ring_s
