"""Retention on a node: frames that sessions need stay, others are a ring, within a budget.

Servers request the numbers that their sessions need, and the requests are kept on disk. A request
is valid until the server sends another one: a laptop that went away with an open recording will
request these frames when it is back.
"""

from __future__ import annotations

import errno
import math
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

from pydantic import BaseModel, ConfigDict, Field

from devices.errors import FileFormatError, StorageError
from storage.documents import read_document, write_document
from storage.durable_files import ASIDE_SUFFIX, try_set_aside_and_describe
from storage.intervals import NO_END, Intervals, OpenPairs, intervals_from_inclusive_pairs, union
from storage.journal.journal import RING_DURATION_NS

if TYPE_CHECKING:  # a stream imports the requests
    from storage.journal.node.stream import NodeStream


class RetentionRequest(BaseModel):
    """Retention request of one server.

    Attributes:
        streams: numbers by stream_id; an interval without an end includes every frame to come.
        recording: True: a stream that the server has not seen yet is needed from its first frame
            on.
        known: streams that the server had seen when it sent the request.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    streams: dict[str, OpenPairs] = Field(default_factory=dict)
    recording: bool = False
    known: tuple[str, ...] = ()

    def required_numbers_of_known_or_new_stream(self, stream_id: str) -> Intervals:
        """Return the requested numbers of a stream."""
        if stream_id in self.streams:
            return intervals_from_inclusive_pairs(self.streams[stream_id])
        if self.recording and stream_id not in self.known:
            return Intervals([(0, NO_END)])
        return Intervals()


class _File(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)

    servers: dict[str, RetentionRequest]


class RetentionRequests:
    """Retention requests of all servers, and of the node's own session.

    A damaged file is set aside. As long as it lies there, any server may need any frame. The same
    holds if the file cannot be read now: then it is read before it is written.

    Args:
        path: the file of the requests.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._local: dict[str, Intervals] = {}
        self._servers: dict[str, RetentionRequest] = {}
        self.problems: list[str] = []
        """Damage found, and how it was handled, as messages."""
        self._is_read = True
        try:
            self._servers = self._load()
        except StorageError as error:
            self._is_read = False
            self.problems.append(f"frames are kept as long as there is room: {error}")
        aside = sorted(each.name for each in path.parent.glob(path.name + ASIDE_SUFFIX + "*"))
        self.is_unknown = bool(aside or self.problems)
        """True if the servers' needs are unknown: then age alone deletes no frame."""
        if aside:
            self.problems.append(
                f"the servers' retention requests were damaged, so frames are kept as long as "
                f"there is room. Delete {path.with_name(aside[-1])} when servers have all they need"
            )

    def _load(self) -> dict[str, RetentionRequest]:
        """Read the servers' requests from the file.

        Raises:
            StorageError: it cannot be read now.
        """
        path = self._path
        try:
            return read_document(path, _File).servers
        except FileNotFoundError:
            pass
        except FileFormatError as error:
            self.problems.append(f"retention requests: {try_set_aside_and_describe(path, error)}")
        return {}

    def node_session_or_server_numbers_of(self, stream_id: str) -> Intervals:
        """Return the numbers of a stream that servers or the node's own session need."""
        servers = list(self._servers.values())
        return self.node_session_numbers_of(stream_id) | union(
            server.required_numbers_of_known_or_new_stream(stream_id) for server in servers
        )

    def node_session_or_undelivered_numbers(
        self, stream_id: str, acked_by: Mapping[str, Intervals]
    ) -> Intervals:
        """Return the needed numbers that their own server has not acknowledged.

        Numbers of the node's own session stay included even if a server has them as well.
        """
        return self.node_session_numbers_of(stream_id) | self.undelivered_numbers_of(
            stream_id, acked_by
        )

    def node_session_numbers_of(self, stream_id: str) -> Intervals:
        """Return the numbers of a stream that the node's own session needs."""
        return Intervals(self._local.get(stream_id, ()))

    def undelivered_numbers_of(
        self, stream_id: str, acked_by: Mapping[str, Intervals]
    ) -> Intervals:
        """Return the numbers that servers need and have not acknowledged."""
        return union(
            server.required_numbers_of_known_or_new_stream(stream_id)
            - acked_by.get(server_id, Intervals())
            for server_id, server in list(self._servers.items())
        )

    def update_request_in_memory(self, server_id: str, request: RetentionRequest) -> bool:
        """Set a server's request in memory; return whether it differs from the one before."""
        if self._servers.get(server_id, RetentionRequest()) == request:
            return False
        self._servers = {**self._servers, server_id: request}
        if not request.streams and not request.recording:
            del self._servers[server_id]
        return True

    def set_node_session_numbers(self, numbers: Mapping[str, Intervals]) -> None:
        """Set the numbers that the node's own session needs; that session stores them."""
        self._local = dict(numbers)

    def save(self) -> None:
        """Write the servers' requests to the file.

        Raises:
            StorageError: the disk is full or not writable, or the existing file cannot be read yet.
        """
        if not self._is_read:
            self._servers = {**self._load(), **self._servers}
            self._is_read = True
        write_document(self._path, _File(servers=self._servers))


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
