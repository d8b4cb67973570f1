"""One node on the server: its streams, estimates, tares and clock.

On disk, for after a restart: the journals, the node's last hello, its tares, and the calibration
assigned on the server.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Mapping
from pathlib import Path

from devices.errors import (
    DamagedFileError,
    FileFormatError,
    FootTileError,
    LinkError,
    StateError,
    StorageError,
)
from devices.frames import ArrayInfo, FrameBatch
from service.link import BOOT_ID, Hello, StreamNumbers
from service.server.estimates.of_node import Estimated, NodeEstimates
from service.server.pace import Pace
from service.server.streams import ServerStream
from service.server_clock import utc_ns
from service.sessions.tare_file import RecordedTare
from storage.checked_json import write_checked
from storage.clock.log import ClockOffset
from storage.durable import make_folder, storage_errors
from storage.intervals import NO_END, NODE_RESTARTED, Intervals, with_open_ends
from storage.journal.journal import RING_NS, Journal

log = logging.getLogger("foottile.nodes")

IS_BOOT_ID = re.compile(BOOT_ID)
HELLO_FILE = "hello.json"


class ServerNode:
    """One node, connected or remembered.

    Args:
        folder: files of the node other than journals.
        journals: folder of its journals, one for each of its streams.
        hello: last hello of the node.
    """

    def __init__(self, folder: Path, journals: Path, hello: Hello) -> None:
        self.name = hello.array_info.node
        self.hello = hello
        self.connected = False
        self.estimates = NodeEstimates(folder, hello)
        self.streams: dict[str, ServerStream] = {}
        """Streams by id: stored here, or listed in hello."""
        self.unread: set[str] = set()
        """Ids of streams whose journals cannot be read now: their frames are unknown."""
        self.has_words = False
        """True if hello is not saved yet; `save` saves it before its frames are acknowledged."""
        self.has_spoken = False
        """True if the node has sent hello since the server was started."""
        self.greeted_t_ns: int | None = None
        """Arrival time of the last hello, server's UTC."""
        self.storage_problem: str | None = None
        self.troubles: tuple[str, ...] = ()
        """Faults of its array or disk, from its last status."""
        self.fault_counts: dict[str, dict[str, int]] = {}
        """Faults of the present stream by serial and reason, from its last status."""
        self.refused_ahead_frames = 0
        """Frames of the present stream that were refused because they are ahead of time."""
        self.last_seq: int | None = None
        self.last_t_ns: int | None = None
        self.last_seen_t_ns: int | None = None
        self.shown_t_ns: int | None = None
        """Time of the newest frame that was published to subscribers, node's UTC."""
        self._folder = folder
        self._journals_folder = journals
        self._pace = Pace()
        self._found: list[str] = []
        for path in sorted(journals.glob("*")):
            if IS_BOOT_ID.fullmatch(path.name):
                try:
                    self.streams[path.name] = stream = ServerStream.open(path)
                    self._found += stream.problems
                except DamagedFileError as error:
                    self._found.append(f"a journal is left out: {error}")
                except FootTileError as error:  # a full disk, or another version's file
                    self.unread.add(path.name)
                    self._found.append(f"a journal is left out until it can be read: {error}")
        self._found += self.estimates.damages
        for text in self._found:
            log.warning("node %s: %s", self.name, text)
        self.present = self._stream_of(self.info)
        """Stream to which the node adds frames now."""

    @property
    def problems(self) -> list[str]:
        """Damage found in its files, and the consequence, as text."""
        return [f"node {self.name}: {text}" for text in self._found]

    @property
    def info(self) -> ArrayInfo:
        """Description of the present stream's array."""
        return self.hello.array_info

    @property
    def boot_id(self) -> str:
        """Id of the present stream."""
        return self.info.boot_id

    @property
    def order(self) -> tuple[str, ...]:
        """Ids of its streams from its last hello, oldest first; the present one is last."""
        return (*(each.array_info.boot_id for each in self.hello.earlier), self.boot_id)

    @property
    def journals(self) -> dict[str, Journal]:
        """Journals by stream id, for streams that have sent frames."""
        return {name: s.journal for name, s in self.streams.items() if s.journal is not None}

    @property
    def journal(self) -> Journal | None:
        """Journal of the present stream; None before its first frame."""
        return self.present.journal

    @property
    def clock(self) -> ClockOffset | None:
        """Latest offset of its clock in the present stream; None before the first measurement."""
        return self.present.clock

    @property
    def missing(self) -> Intervals:
        """Frames of the present stream that are not stored: lost, or still to come."""
        newest = -1 if self.last_seq is None else self.last_seq
        if self.has_spoken:
            newest = max(newest, self.hello.next_seq - 1)
        return self.present.missing(newest)

    @property
    def backlog_frames(self) -> int:
        """Number of missing frames that the node can still send."""
        return (self.missing & self.present.may_come).count

    @property
    def lost(self) -> dict[str, int]:
        """Number of lost frames of the present stream, by reason."""
        unobtainable = self.missing - self.present.may_come
        named = {why: lost.count for why, lost in self.present.lost.within(unobtainable).items()}
        if unnamed := unobtainable.count - sum(named.values()):
            named[NODE_RESTARTED] = named.get(NODE_RESTARTED, 0) + unnamed
        return named

    @property
    def refusals(self) -> list[str]:
        """Warnings about refused frames of the present stream."""
        if not self.refused_ahead_frames:
            return []
        return [
            f"{self.refused_ahead_frames} frames were refused: they are dated or numbered ahead of "
            "this node's clock. Restart the node"
        ]

    @property
    def rate_hz(self) -> float | None:
        """Frames per second over the last second, by the node's clock; 0 if none came."""
        seen_t_ns = self.present.last_seen_t_ns
        silent_ns = None if seen_t_ns is None else utc_ns() - seen_t_ns
        return self._pace.rate_hz(self.info.nominal_rate_hz, silent_ns)

    def attach(self, hello: Hello, now_t_ns: int) -> None:
        """Update streams and estimates from hello of a node that has connected.

        Args:
            hello: its message; every known stream in it has the array of before.
            now_t_ns: the server's UTC.
        """
        if hello.array_info.boot_id != self.boot_id or self.last_seq is None:
            self.last_seq = self.last_t_ns = None
            self.troubles, self.fault_counts = (), {}
            self.refused_ahead_frames = 0
            self._pace.clear()
        self.hello = hello
        self.has_spoken, self.greeted_t_ns = True, now_t_ns
        for stream in list(self.streams.values()):
            stream.owed = Intervals()
            if stream.boot_id not in self.order and not hello.has_more:
                stream.is_gone()
                if stream.journal is None:  # no frame ever came
                    del self.streams[stream.boot_id]
        for earlier in hello.earlier:
            self._stream_of(earlier.array_info).has_ended(earlier)
        self.present = self._stream_of(hello.array_info)
        self.present.is_present(hello, now_t_ns)
        # Acknowledge stored frames again: a link may have broken before their acknowledgement.
        for name in self.order:
            stream = self.streams[name]
            stream.owed = stream.held & stream.may_come
        self.estimates.greet(hello)
        self.has_words = True

    def lacks(self, needed: Mapping[str, Intervals]) -> tuple[StreamNumbers, ...]:
        """Return the frames to request: first those needed by sessions, then the others.

        Args:
            needed: frames that sessions need, by stream id.
        """
        found = []
        for name in self.order:
            stream, present = self.streams[name], name == self.boot_id
            wanted = needed.get(name, Intervals())
            requested = stream.lacks(wanted, all_of_it=present)
            first = (requested & wanted).within(0, self.hello.next_seq - 1 if present else NO_END)
            numbers = _joined([*first, *requested - first])
            if numbers:
                found.append(StreamNumbers(boot_id=name, numbers=with_open_ends(numbers)))
        return tuple(found)

    def detach(self) -> None:
        """Mark the node as disconnected; its frames stay."""
        self.connected = False
        self._pace.clear()

    def take(
        self, stream: ServerStream, payload: bytes, now_t_ns: int
    ) -> tuple[int, int, list[Estimated]]:
        """Store one message of frames, and estimate the frames newer than all before.

        Args:
            stream: stream of the frames.
            payload: the message.
            now_t_ns: the server's UTC.

        Returns:
            First and last number of the message, and the frames whose estimates are due.

        Raises:
            LinkError: the message is not of this stream, or its frames break a rule.
        """
        try:
            frames = stream.decoder.decode(payload)
            if ahead := stream.check(frames, now_t_ns):
                self._refuse_ahead(frames, ahead)
                return int(frames.seq[0]), int(frames.seq[-1]), []
            stream.take(frames, payload, now_t_ns)
        except FileFormatError as error:
            raise LinkError(f"node {self.name!r}: {error}") from error
        except StorageError as error:  # live goes on; nothing is acknowledged
            self.storage_problem = str(error)
        first, last = int(frames.seq[0]), int(frames.seq[-1])
        self.last_seen_t_ns = now_t_ns
        if stream is not self.present:
            return first, last, []
        if self.last_seq is not None and last <= self.last_seq:
            self._look_for_tare()  # resent for the journal; live is further
            return first, last, []
        if self.last_seq is not None and first <= self.last_seq:
            frames = frames.rows(self.last_seq + 1 - first, len(frames))
        self.last_seq, self.last_t_ns = last, int(frames.t_ns[-1])
        self._pace.note(int(frames.t_mono_ns[-1]), last)
        due = self.estimates.feed(frames)
        self._look_for_tare()
        return first, last, due

    def take_tare(self, reason: str = "") -> RecordedTare:
        """Tare from an unloaded interval of the last seconds, and put the tare in force.

        Raises:
            TareError: the foot was loaded, or there is nothing to tare.
            StateError: the node is not connected.
            StorageError: the tare cannot be stored.
        """
        if not self.connected:
            raise StateError(f"node {self.name!r} is not connected", remedy="Connect it and retry")
        return self.estimates.tare_keeper.by_hand(reason)

    def read_again(self) -> None:
        """Retry opening the journals that could not be read."""
        for name in sorted(self.unread):
            stream = self.streams.get(name)
            try:
                if stream is None or stream.journal is None:
                    opened = ServerStream.open(self._journals_folder / name)
                    if stream is not None:  # the node has listed it
                        stream.journal = opened.journal
                    else:
                        self.streams[name] = opened
                        if self.has_spoken:
                            opened.is_gone()
            except DamagedFileError as error:
                self._found.append(f"a journal is left out: {error}")
            except FootTileError:
                continue
            self.unread.discard(name)

    def server_t_ns(self, t_ns: int) -> int:
        """Convert a time of the node's UTC to the server's; unchanged without an offset."""
        return t_ns + (self.clock.server_minus_node_ns if self.clock is not None else 0)

    def node_t_ns(self, t_ns: int) -> int:
        """Convert a time of the server's UTC to the node's."""
        return t_ns - (self.clock.server_minus_node_ns if self.clock is not None else 0)

    def prune(self, keep: Mapping[str, Intervals]) -> bool:
        """Delete frames older than the ring and not in `keep`, at most one whole journal per call.

        Args:
            keep: frames to keep, by stream id.

        Returns:
            True if a whole journal was deleted: call again. A node that was switched on a thousand
            times has as many.

        Raises:
            StorageError: a file cannot be deleted.
        """
        for name, stream in list(self.streams.items()):
            needed = keep.get(name, Intervals())
            if stream is self.present:
                if self.last_t_ns is not None:
                    stream.prune(self.last_t_ns - RING_NS, needed)
            elif not needed:
                is_there = stream.journal is not None
                stream.delete()
                if name not in self.order:
                    del self.streams[name]
                if is_there:
                    return True
        return False

    def keep(self) -> None:
        """Save hello for after a restart. Runs in any thread.

        Raises:
            StorageError: the disk is full or not writable.
        """
        hello = self.hello
        with storage_errors(self._folder):
            make_folder(self._folder)
        write_checked(self._folder / HELLO_FILE, hello.model_dump_json().encode())
        if hello is self.hello:  # a newer hello may have come meanwhile
            self.has_words = False

    def _refuse_ahead(self, frames: FrameBatch, why: str) -> None:
        """Count frames that are ahead of time; log the first ones of a stream."""
        if not self.refused_ahead_frames:
            first, last = int(frames.seq[0]), int(frames.seq[-1])
            log.warning(
                "node %s: frames %d to %d are refused: %s; further ones are counted",
                *(self.name, first, last, why),
            )
        self.refused_ahead_frames += len(frames)

    def _stream_of(self, info: ArrayInfo) -> ServerStream:
        if info.boot_id not in self.streams:
            self.streams[info.boot_id] = ServerStream(self._journals_folder / info.boot_id, info)
        return self.streams[info.boot_id]

    def _look_for_tare(self) -> None:
        if self.storage_problem is not None:  # a tare could not be stored
            return
        try:
            self.estimates.look_for_tare(self.journal, lambda: self.present.may_come)
        except StorageError as error:
            self.storage_problem = str(error)


def _joined(numbers: list[tuple[int, int]]) -> list[tuple[int, int]]:
    """Return the same ranges in the same order, with adjacent ones joined."""
    joined: list[tuple[int, int]] = []
    for first, last in numbers:
        if joined and joined[-1][1] + 1 == first:
            joined[-1] = (joined[-1][0], last)
        else:
            joined.append((first, last))
    return joined
