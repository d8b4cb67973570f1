"""One node as a server knows it: its streams, estimates, tares and clock.

What has to outlive the server is on disk: the journals, the node's last hello, its tares, and the
calibration that the server was told to use.
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
        folder: what is kept of it beside its journals.
        journals: folder of its journals, one for each of its streams.
        hello: what it said last.
    """

    def __init__(self, folder: Path, journals: Path, hello: Hello) -> None:
        self.name = hello.array_info.node
        self.hello = hello
        self.connected = False
        self.estimates = NodeEstimates(folder, hello)
        self.streams: dict[str, ServerStream] = {}
        """By boot_id: those that are kept here, and those that it said it has."""
        self.unread: set[str] = set()
        """Kept here, but their journals cannot be read now: nothing is known of their frames."""
        self.has_words = False
        """Has it said what is not written down yet? `keep` does, before its frames are promised."""
        self.has_spoken = False
        """Has it said hello since the server was started?"""
        self.greeted_t_ns: int | None = None
        """When it last said hello, server's UTC."""
        self.storage_problem: str | None = None
        self.troubles: tuple[str, ...] = ()
        """What is wrong with its array or its disk, as it said last."""
        self.fault_counts: dict[str, dict[str, int]] = {}
        """How often what went wrong in its stream, by serial and reason, as it said last."""
        self.refused_ahead_frames = 0
        """Frames of this stream that were refused because they are ahead of their time."""
        self.last_seq: int | None = None
        self.last_t_ns: int | None = None
        self.last_seen_t_ns: int | None = None
        self.shown_t_ns: int | None = None
        """Instant of the newest frame on the screens, in the node's UTC."""
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
                except FootTileError as error:  # a disk that is full, or another version wrote it
                    self.unread.add(path.name)
                    self._found.append(f"a journal is left out until it can be read: {error}")
        self._found += self.estimates.damages
        for text in self._found:
            log.warning("node %s: %s", self.name, text)
        self.present = self._stream_of(self.info)
        """The stream that it takes now."""

    @property
    def problems(self) -> list[str]:
        """What was found damaged of what is kept of it, and what became of it, in words."""
        return [f"node {self.name}: {text}" for text in self._found]

    @property
    def info(self) -> ArrayInfo:
        """Description of the present stream's array."""
        return self.hello.array_info

    @property
    def boot_id(self) -> str:
        """Name of the present stream."""
        return self.info.boot_id

    @property
    def order(self) -> tuple[str, ...]:
        """Its streams by boot_id, oldest first, as it said last; the present one is the last."""
        return (*(each.array_info.boot_id for each in self.hello.earlier), self.boot_id)

    @property
    def journals(self) -> dict[str, Journal]:
        """Journals by boot_id, for streams that have sent frames."""
        return {name: s.journal for name, s in self.streams.items() if s.journal is not None}

    @property
    def journal(self) -> Journal | None:
        """Journal of the present stream; None before its first frame."""
        return self.present.journal

    @property
    def clock(self) -> ClockOffset | None:
        """How its clock differs in the present stream; None before it was measured."""
        return self.present.clock

    @property
    def missing(self) -> Intervals:
        """Numbers of the present stream that should be here and are not: lost, or still to come."""
        newest = -1 if self.last_seq is None else self.last_seq
        if self.has_spoken:
            newest = max(newest, self.hello.next_seq - 1)
        return self.present.missing(newest)

    @property
    def backlog_frames(self) -> int:
        """How many of the missing frames the node still has."""
        return (self.missing & self.present.may_come).count

    @property
    def lost(self) -> dict[str, int]:
        """How many of the missing frames are lost, by reason."""
        gone = self.missing - self.present.may_come
        named = {why: lost.count for why, lost in self.present.lost.within(gone).items()}
        if unnamed := gone.count - sum(named.values()):
            named[NODE_RESTARTED] = named.get(NODE_RESTARTED, 0) + unnamed
        return named

    @property
    def refusals(self) -> list[str]:
        """Warnings of frames of this stream that were refused."""
        if not self.refused_ahead_frames:
            return []
        return [
            f"{self.refused_ahead_frames} frames were refused: they are dated or numbered ahead of "
            "this node's clock. Restart the node"
        ]

    @property
    def rate_hz(self) -> float | None:
        """Frames a second over the last second, by the node's clock; 0 if none came in it."""
        seen_t_ns = self.present.last_seen_t_ns
        silent_ns = None if seen_t_ns is None else utc_ns() - seen_t_ns
        return self._pace.rate_hz(self.info.nominal_rate_hz, silent_ns)

    def attach(self, hello: Hello, now_t_ns: int) -> None:
        """The node has connected, and said which frames it has.

        Args:
            hello: its message; every stream in it has the array that it had before.
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
                if stream.journal is None:  # nothing of it ever came
                    del self.streams[stream.boot_id]
        for earlier in hello.earlier:
            self._stream_of(earlier.array_info).has_ended(earlier)
        self.present = self._stream_of(hello.array_info)
        self.present.is_present(hello, now_t_ns)
        # What is here but was never acknowledged, because the link broke before: acknowledge it.
        for name in self.order:
            stream = self.streams[name]
            stream.owed = stream.held & stream.may_come
        self.estimates.greet(hello)
        self.has_words = True

    def lacks(self, needed: Mapping[str, Intervals]) -> tuple[StreamNumbers, ...]:
        """Frames to ask it for: first what sessions need, then the rest of the present stream.

        Args:
            needed: numbers by stream.
        """
        found = []
        for name in self.order:
            stream, present = self.streams[name], name == self.boot_id
            wanted = needed.get(name, Intervals())
            asked = stream.lacks(wanted, all_of_it=present)
            first = (asked & wanted).within(0, self.hello.next_seq - 1 if present else NO_END)
            numbers = _joined([*first, *asked - first])
            if numbers:
                found.append(StreamNumbers(boot_id=name, numbers=with_open_ends(numbers)))
        return tuple(found)

    def detach(self) -> None:
        """The node has gone; what it sent stays."""
        self.connected = False
        self._pace.clear()

    def take(
        self, stream: ServerStream, payload: bytes, now_t_ns: int
    ) -> tuple[int, int, list[Estimated]]:
        """One message of frames: kept, and estimated if it is news.

        Args:
            stream: whose frames they are.
            payload: the message.
            now_t_ns: the server's UTC.

        Returns:
            First and last number of the message, and the frames whose estimates are now due.

        Raises:
            LinkError: it is not a message of this stream's frames, or they break a rule of theirs.
        """
        try:
            frames = stream.decoder.decode(payload)
            if ahead := stream.check(frames, now_t_ns):
                self._refuse_ahead(frames, ahead)
                return int(frames.seq[0]), int(frames.seq[-1]), []
            stream.take(frames, payload, now_t_ns)
        except FileFormatError as error:
            raise LinkError(f"node {self.name!r}: {error}") from error
        except StorageError as error:  # the live picture goes on; nothing is acknowledged
            self.storage_problem = str(error)
        first, last = int(frames.seq[0]), int(frames.seq[-1])
        self.last_seen_t_ns = now_t_ns
        if stream is not self.present:
            return first, last, []
        if self.last_seq is not None and last <= self.last_seq:
            self._look_for_tare()  # sent again for the journal; the picture is further on
            return first, last, []
        if self.last_seq is not None and first <= self.last_seq:
            frames = frames.rows(self.last_seq + 1 - first, len(frames))
        self.last_seq, self.last_t_ns = last, int(frames.t_ns[-1])
        self._pace.note(int(frames.t_mono_ns[-1]), last)
        due = self.estimates.feed(frames)
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
        return self.estimates.tare_keeper.by_hand(reason)

    def read_again(self) -> None:
        """Try the journals again that could not be read."""
        for name in sorted(self.unread):
            stream = self.streams.get(name)
            try:
                if stream is None or stream.journal is None:
                    opened = ServerStream.open(self._journals_folder / name)
                    if stream is not None:  # the node has said something of it
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
        """An instant of the node's UTC in the server's; the same while no offset is measured."""
        return t_ns + (self.clock.server_minus_node_ns if self.clock is not None else 0)

    def node_t_ns(self, t_ns: int) -> int:
        """An instant of the server's UTC in the node's."""
        return t_ns - (self.clock.server_minus_node_ns if self.clock is not None else 0)

    def prune(self, keep: Mapping[str, Intervals]) -> bool:
        """Delete what is older than the ring and not in `keep`, by stream.

        Returns:
            Was a journal deleted as a whole? Then there may be more: no more than one is at a time,
            for a node that was switched on a thousand times has as many.

        Raises:
            StorageError: a file cannot be deleted.
        """
        for name, stream in list(self.streams.items()):
            kept = keep.get(name, Intervals())
            if stream is self.present:
                if self.last_t_ns is not None:
                    stream.prune(self.last_t_ns - RING_NS, kept)
            elif not kept:
                is_there = stream.journal is not None
                stream.delete()
                if name not in self.order:
                    del self.streams[name]
                if is_there:
                    return True
        return False

    def keep(self) -> None:
        """Write down what the node said, for after a restart; may run in another thread.

        Raises:
            StorageError: the disk is full or not writable.
        """
        hello = self.hello
        with storage_errors(self._folder):
            make_folder(self._folder)
        write_checked(self._folder / HELLO_FILE, hello.model_dump_json().encode())
        if hello is self.hello:  # it may have said it anew meanwhile
            self.has_words = False

    def _refuse_ahead(self, frames: FrameBatch, why: str) -> None:
        """Count frames that are ahead of their time; the first ones of a stream are logged."""
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
        if self.storage_problem is not None:  # it could not be kept
            return
        try:
            self.estimates.look_for_tare(self.journal, lambda: self.present.may_come)
        except StorageError as error:
            self.storage_problem = str(error)


def _joined(numbers: list[tuple[int, int]]) -> list[tuple[int, int]]:
    """The same numbers in the same order; neighbours that follow each other are joined."""
    joined: list[tuple[int, int]] = []
    for first, last in numbers:
        if joined and joined[-1][1] + 1 == first:
            joined[-1] = (joined[-1][0], last)
        else:
            joined.append((first, last))
    return joined
