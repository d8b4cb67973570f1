"""Retention requests: numbers of a node's frames that sessions need, by server, kept on disk.

A request is valid until the server sends another one: a laptop that went away with an open
recording will request these frames when it is back.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from pydantic import BaseModel, ConfigDict, Field

from devices.errors import FileFormatError, StorageError
from storage.documents import read_document, write_document
from storage.durable_files import ASIDE_SUFFIX, try_set_aside_and_describe
from storage.intervals import NO_END, Intervals, OpenPairs, intervals_from_inclusive_pairs, union


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
