"""What sessions need of a node's frames, as each server said last; it outlives the node's process.

Until a server says otherwise its word holds: a laptop that went away with an open recording will
ask for these frames when it is back.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from devices.errors import DamagedFileError, StorageError
from storage.checked_json import read_checked, write_checked
from storage.durable import ASIDE, put_aside
from storage.intervals import NO_END, Intervals, OpenPairs, closed, union


class ServerWants(BaseModel):
    """What one server needs.

    Attributes:
        streams: numbers by boot_id; one without an end goes on with every frame to come.
        recording: a stream that it has not heard of yet is recorded from its first frame on.
        known: streams that it had heard of when it said this.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    streams: dict[str, OpenPairs] = Field(default_factory=dict)
    recording: bool = False
    known: tuple[str, ...] = ()

    def numbers(self, boot_id: str) -> Intervals:
        """What it needs of a stream."""
        if boot_id in self.streams:
            return closed(self.streams[boot_id])
        if self.recording and boot_id not in self.known:
            return Intervals([(0, NO_END)])
        return Intervals()


class _File(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)

    servers: dict[str, ServerWants]


class Wanted:
    """All that is wanted of one node.

    A damaged file is set aside. As long as it lies there, any server may want any frame; so it is
    if the file cannot be read now, which is then not written before it was read.

    Args:
        path: where it is kept.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._local: dict[str, Intervals] = {}
        self._servers: dict[str, ServerWants] = {}
        self.is_proven = True
        """Was its file written by a version that writes a hash?"""
        self.problems: list[str] = []
        """What was found damaged, and what became of it, in words."""
        self._is_read = True
        try:
            self._servers = self._read()
        except StorageError as error:
            self._is_read = False
            self.problems.append(f"frames are kept as long as there is room: {error}")
        aside = sorted(each.name for each in path.parent.glob(path.name + ASIDE + "*"))
        self.may_be_all = bool(aside or self.problems)
        """Is it not known what servers need? Then nothing is deleted for its age alone."""
        if aside:
            self.problems.append(
                f"what servers need was damaged, so frames are kept as long as there is room: "
                f"delete {path.with_name(aside[-1])} when servers have all they need"
            )

    def _read(self) -> dict[str, ServerWants]:
        """What is written down.

        Raises:
            StorageError: it cannot be read now.
        """
        path = self._path
        try:
            found = read_checked(path)
            self.is_proven = found.is_proven
            return _File.model_validate_json(found.text).servers
        except FileNotFoundError:
            pass
        except (DamagedFileError, ValidationError) as error:
            damage = DamagedFileError(f"what servers need cannot be read: {error}", where=str(path))
            self.problems.append(put_aside(path, damage))
        return {}

    def numbers(self, boot_id: str) -> Intervals:
        """What servers and the node's own session need of a stream."""
        servers = list(self._servers.values())
        return self.local(boot_id) | union(server.numbers(boot_id) for server in servers)

    def unmet(self, boot_id: str, acked_by: Mapping[str, Intervals]) -> Intervals:
        """What is needed and not delivered: of each server by its own acknowledgements.

        What the node's own session needs is needed here even if a server has it as well.
        """
        return self.local(boot_id) | self.undelivered(boot_id, acked_by)

    def local(self, boot_id: str) -> Intervals:
        """What the node's own session needs of a stream."""
        return Intervals(self._local.get(boot_id, ()))

    def undelivered(self, boot_id: str, acked_by: Mapping[str, Intervals]) -> Intervals:
        """What servers need and do not have yet."""
        return union(
            server.numbers(boot_id) - acked_by.get(server_id, Intervals())
            for server_id, server in list(self._servers.items())
        )

    def say(self, server_id: str, wants: ServerWants) -> bool:
        """Note what a server says it needs; return whether that changes anything."""
        if self._servers.get(server_id, ServerWants()) == wants:
            return False
        self._servers = {**self._servers, server_id: wants}
        if not wants.streams and not wants.recording:
            del self._servers[server_id]
        return True

    def say_local(self, needed: Mapping[str, Intervals]) -> None:
        """What a session that is recorded on the node itself needs; kept by that session."""
        self._local = dict(needed)

    def save(self) -> None:
        """Write it down.

        Raises:
            StorageError: the disk is full or not writable, or what is there could not be read yet.
        """
        if not self._is_read:
            self._servers = {**self._read(), **self._servers}
            self._is_read = True
        write_checked(self._path, _File(servers=self._servers).model_dump_json().encode())
