"""The nodes a server knows: their streams, journals, estimates, tares and clocks.

What has to outlive the server is on disk: the journals, each node's last hello and its tares.
"""

from __future__ import annotations

import logging
import re
from collections import deque
from collections.abc import Iterator
from pathlib import Path

from pydantic import ValidationError

from devices.errors import (
    FileFormatError,
    FootTileError,
    LinkError,
    StateError,
    StorageError,
    UnknownError,
)
from devices.frames import ArrayInfo, FrameBatch
from service.link import ClockRow, Hello
from service.live_estimates import LiveEstimates
from service.pipeline import Columns
from service.tare_keeper import TareKeeper
from service.tares import RecordedTare, TareHistory
from storage.durable import storage_errors, write_whole
from storage.intervals import Intervals
from storage.journal import Journal
from storage.schema import wire_schema
from storage.wire import decode

log = logging.getLogger("foottile.nodes")

RING_NS = 600_000_000_000
"""Frames of no session are kept so long, for pre-roll and for what was not recorded in time."""
_RATE_OVER_NS = 1_000_000_000
_NODE_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9._-]{0,63}")
_BOOT_ID = re.compile(r"[0-9a-f]{32}")

Estimated = tuple[FrameBatch, Columns]


class Node:
    """One node, connected or remembered.

    Args:
        folder: what is kept of it beside its journals.
        journals: folder of its journals, one for each of its streams.
        hello: what it said last.
    """

    def __init__(self, folder: Path, journals: Path, hello: Hello) -> None:
        self.name = hello.array_info.node
        self.hello = hello
        self.connected = False
        self.tares = TareHistory(folder / "tares.json")
        self.clock: ClockRow | None = None
        self.journals: dict[str, Journal] = {}
        self.storage_problem: str | None = None
        self.missed_slots = 0
        self.troubles: tuple[str, ...] = ()
        """What is wrong with its array, as it said last."""
        self.fault_counts: dict[str, dict[str, int]] = {}
        """How often what went wrong in its stream, by serial and reason, as it said last."""
        self.lost_frames = 0
        self.last_seq: int | None = None
        self.last_t_ns: int | None = None
        self.last_seen_t_ns: int | None = None
        self.shown_t_ns: int | None = None
        """Instant of the newest frame on the screens, in the node's UTC."""
        self.node_first_seq = 0
        """The oldest frame of the present stream that the node still has."""
        self._folder = folder
        self._schema = wire_schema(hello.array_info)
        self._journals_folder = journals
        self._pace: deque[tuple[int, int]] = deque()
        for path in sorted(journals.glob("*")):
            if _BOOT_ID.fullmatch(path.name):
                try:
                    self.journals[path.name] = Journal.open(path)
                except FileFormatError as error:
                    log.warning("a journal is left out: %s", error)
        self.live, self.tare_keeper = self._estimates()

    @property
    def info(self) -> ArrayInfo:
        """Description of the present stream's array."""
        return self.hello.array_info

    @property
    def boot_id(self) -> str:
        """Name of the present stream."""
        return self.info.boot_id

    @property
    def journal(self) -> Journal | None:
        """Journal of the present stream; None before its first frame."""
        return self.journals.get(self.boot_id)

    @property
    def rate_hz(self) -> float | None:
        """Frames a second over the last second, by the node's clock."""
        if len(self._pace) < 2:  # a rate needs two instants
            return None
        (first_ns, first_seq), (last_ns, last_seq) = self._pace[0], self._pace[-1]
        return (
            (last_seq - first_seq) / ((last_ns - first_ns) * 1e-9) if last_ns > first_ns else None
        )

    def attach(self, hello: Hello) -> Intervals:
        """The node has connected; gives what the server holds of its stream."""
        if hello.array_info.boot_id != self.boot_id or self.last_seq is None:
            self.last_seq = self.last_t_ns = None
            self.lost_frames = 0
            self.troubles, self.fault_counts = (), {}
            self.clock = None
            self._pace.clear()
        known = (self.hello.array_info, self.hello.calibration)
        self.hello = hello
        self.node_first_seq = hello.first_seq
        if known != (hello.array_info, hello.calibration):
            self._schema = wire_schema(hello.array_info)
            self.live, self.tare_keeper = self._estimates()
        try:
            self.keep()
        except StorageError as error:  # the picture goes on; what is sent is not acknowledged
            self.storage_problem = str(error)
        journal = self.journal
        return journal.held if journal is not None else Intervals()

    def detach(self) -> None:
        """The node has gone; what it sent stays."""
        self.connected = False
        self._pace.clear()

    def take(self, payload: bytes, now_t_ns: int) -> tuple[int, int, list[Estimated]]:
        """One message of frames: kept, and estimated if it is news.

        Args:
            payload: the message.
            now_t_ns: the server's UTC.

        Returns:
            First and last number of the message, and the frames whose estimates are now due.

        Raises:
            FileFormatError: it is not a message of this stream's frames.
        """
        frames = decode(payload, self._schema)
        if (frames.t_ns - frames.t_mono_ns != self.info.utc_offset_ns).any():
            raise FileFormatError(
                f"frames {frames.seq[0]} to {frames.seq[-1]} are not t_mono_ns plus the offset",
                expected=f"t_ns - t_mono_ns = {self.info.utc_offset_ns}, as announced in hello",
            )
        try:
            self._journal_now().append(frames, payload)
        except StorageError as error:  # the live picture goes on; nothing is acknowledged
            self.storage_problem = str(error)
        first, last = int(frames.seq[0]), int(frames.seq[-1])
        self.last_seen_t_ns = now_t_ns
        if self.last_seq is not None and last <= self.last_seq:
            self._look_for_tare()  # sent again for the journal; the picture is further on
            return first, last, []
        if self.last_seq is not None:
            frames = frames.rows(max(0, self.last_seq + 1 - first), len(frames))
            self.lost_frames += int(frames.seq[0]) - self.last_seq - 1
        self.last_seq, self.last_t_ns = last, int(frames.t_ns[-1])
        self._pace.append((int(frames.t_mono_ns[-1]), last))
        while self._pace[-1][0] - self._pace[0][0] > _RATE_OVER_NS and len(self._pace) > 2:
            self._pace.popleft()
        due = list(self.live.feed(frames))
        self._look_for_tare()
        return first, last, due

    def take_tare(self, reason: str = "") -> RecordedTare:
        """Tare from an unloaded interval of the last seconds, and put it in force.

        Raises:
            TareError: the foot was loaded, or there is nothing to tare.
            StateError: the node is away.
            StorageError: it cannot be kept.
        """
        if not self.connected:
            raise StateError(
                f"node {self.name!r} is away", remedy="Tare when it is connected again"
            )
        return self.tare_keeper.by_hand(reason)

    def server_t_ns(self, t_ns: int) -> int:
        """An instant of the node's UTC in the server's; the same while no offset is measured."""
        return t_ns + (self.clock.server_minus_node_ns if self.clock is not None else 0)

    def node_t_ns(self, t_ns: int) -> int:
        """An instant of the server's UTC in the node's."""
        return t_ns - (self.clock.server_minus_node_ns if self.clock is not None else 0)

    def prune(self, keep: dict[str, Intervals]) -> None:
        """Delete what is older than the ring and not in `keep`, by stream.

        Raises:
            StorageError: a file cannot be deleted.
        """
        newest_t_ns = self.last_t_ns
        for boot_id, journal in list(self.journals.items()):
            kept = keep.get(boot_id, Intervals())
            if boot_id == self.boot_id:
                if newest_t_ns is not None:
                    journal.prune(newest_t_ns - RING_NS, kept)
            elif not kept:
                journal.delete()
                del self.journals[boot_id]

    def keep(self) -> None:
        """Write down what the node said, for after a restart.

        Raises:
            StorageError: the disk is full or not writable.
        """
        with storage_errors(self._folder):
            self._folder.mkdir(parents=True, exist_ok=True)
        write_whole(self._folder / "hello.json", self.hello.model_dump_json().encode())

    def _journal_now(self) -> Journal:
        if self.boot_id not in self.journals:
            self.journals[self.boot_id] = Journal(self._journals_folder / self.boot_id, self.info)
        return self.journals[self.boot_id]

    def _look_for_tare(self) -> None:
        if self.storage_problem is not None:  # it could not be kept
            return
        try:
            self.tare_keeper.look(self.journal, self.node_first_seq)
        except StorageError as error:  # not in force then; tried again once it can be kept
            self.storage_problem = str(error)

    def _estimates(self) -> tuple[LiveEstimates, TareKeeper]:
        in_force = self.tares.in_force(self.info)
        tare = in_force.tare if in_force is not None else None
        live = LiveEstimates(self.info, self.hello.calibration, tare)
        automatic = self.hello.scene.get("auto_tare", True) is not False
        return live, TareKeeper(self.info, live, self.tares, automatic=automatic)


class Nodes:
    """All nodes of a server.

    Args:
        data: the server's data folder.

    Raises:
        StorageError: it cannot be read.
        FileFormatError: a file in it is damaged.
    """

    def __init__(self, data: Path) -> None:
        self._data = data
        self._nodes: dict[str, Node] = {}
        for path in sorted((data / "nodes").glob("*/hello.json")):
            try:
                hello = Hello.model_validate_json(path.read_bytes())
            except (OSError, ValidationError) as error:
                raise FileFormatError(
                    f"not a node's description: {error}",
                    where=str(path),
                    remedy="Move it away; it is written anew when the node connects",
                ) from error
            self._nodes[hello.array_info.node] = self._make(hello)

    def __iter__(self) -> Iterator[Node]:
        return iter(self._nodes.values())

    def find(self, name: str) -> Node | None:
        """The node called `name`; None if there is none."""
        return self._nodes.get(name)

    def get(self, name: str) -> Node:
        """The node called `name`.

        Raises:
            UnknownError: there is none.
        """
        if name not in self._nodes:
            known = ", ".join(self._nodes) or "none so far"
            raise UnknownError(f"no node {name[:80]!r}", expected=f"one of: {known}")
        return self._nodes[name]

    def greet(self, hello: Hello) -> Node:
        """The node that says this hello, made if it is new. It is not attached yet.

        Raises:
            LinkError: its name or its stream's cannot be a folder's name.
            FootTileError: its files are damaged.
        """
        info = hello.array_info
        if not _NODE_NAME.fullmatch(info.node) or not _BOOT_ID.fullmatch(info.boot_id):
            raise LinkError(
                f"node {info.node[:80]!r} with boot_id {info.boot_id[:80]!r}",
                expected="a name of letters, digits, '.', '_' and '-', and 32 hex digits",
            )
        if not info.tiles:
            raise LinkError(f"node {info.node!r} has no tiles")
        if info.node not in self._nodes:
            try:
                self._nodes[info.node] = self._make(hello)
            except FootTileError as error:
                raise LinkError(f"node {info.node!r} cannot be taken in: {error}") from error
        return self._nodes[info.node]

    def _make(self, hello: Hello) -> Node:
        name = hello.array_info.node
        return Node(self._data / "nodes" / name, self._data / "journal" / name, hello)
