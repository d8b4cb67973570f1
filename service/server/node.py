"""One node on the server: its streams, estimates, tares and clock.

On disk, for after a restart: the journals, the node's last hello, its tares, and the calibration
assigned on the server.
"""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Mapping
from contextlib import suppress
from functools import cache
from pathlib import Path

from devices.clock import server_utc_ns
from devices.errors import (
    DamagedFileError,
    FileFormatError,
    FootTileError,
    LinkError,
    StateError,
    StorageError,
)
from devices.frames import ArrayInfo, FrameBatch
from devices.vitals import Vitals
from service.protocol.link import Hello, StreamNumbers, is_stream_id
from service.server.estimates.node_estimator import EstimatedBatch, NodeEstimator
from service.server.streams import ServerStream
from service.sessions.parts import NodeFacts, NodeReport, SessionStream
from service.sessions.tares import RecordedTare
from storage.clock.log import ClockOffset
from storage.documents import write_document
from storage.durable_files import make_synced_folder, translate_storage_errors
from storage.intervals import NO_END, NODE_RESTARTED, Intervals, to_open_pairs
from storage.journal.journal import RING_DURATION_NS, Journal

_RATE_WINDOW_NS = 1_000_000_000
_RATE_JITTER = 1.02


class FrameRateMeter:
    """Frame rate over the last second."""

    def __init__(self) -> None:
        self._samples: deque[tuple[int, int]] = deque()

    def clear(self) -> None:
        """Drop all samples: the next frame does not follow the last one."""
        self._samples.clear()

    def add_frame(self, t_mono_ns: int, seq: int) -> None:
        """Add time and number of the newest frame."""
        noted = self._samples
        noted.append((t_mono_ns, seq))
        while noted[-1][0] - noted[0][0] > _RATE_WINDOW_NS and len(noted) > 2:
            noted.popleft()

    def rate_hz(self, nominal_hz: float, silent_ns: int | None) -> float | None:
        """Return frames per second; 0 if none came lately; None if unknown.

        Args:
            nominal_hz: rate limit of bus and node: a slightly higher rate over one second is
                jitter.
            silent_ns: time since the last frame; None: no frame yet.
        """
        if len(self._samples) < 2:  # a rate needs two instants
            return None
        if silent_ns is None or silent_ns > 2 * _RATE_WINDOW_NS:
            return 0.0
        (first_ns, first_seq), (last_ns, last_seq) = self._samples[0], self._samples[-1]
        if last_ns <= first_ns:
            return None
        rate_hz = (last_seq - first_seq) / ((last_ns - first_ns) * 1e-9)
        return nominal_hz if nominal_hz < rate_hz < _RATE_JITTER * nominal_hz else rate_hz


log = logging.getLogger("foottile.nodes")

HELLO_NAME = "hello.json"


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
        self.is_connected = False
        self.estimator = NodeEstimator(folder, hello)
        self.streams: dict[str, ServerStream] = {}
        """Streams by id: stored here, or listed in hello."""
        self.unreadable_streams: dict[str, str] = {}
        """Streams whose journals cannot be read now, by id: why. Their frames are unknown."""
        self.is_dirty = False
        """True if hello is not saved yet; it must be before its frames are acknowledged."""
        self.has_connected = False
        """True if the node has sent hello since the server was started."""
        self.hello_t_ns: int | None = None
        """Arrival time of the last hello, server's UTC."""
        self.storage_problem: str | None = None
        self.warnings: tuple[str, ...] = ()
        """Faults of its array or disk, from its last status."""
        self.fault_counts: dict[str, dict[str, int]] = {}
        """Faults of the present stream by serial and reason, from its last status."""
        self.vitals: Vitals | None = None
        """Vitals of its machine, from its last hello or status; None: unknown, or disconnected."""
        self.refused_ahead_frames = 0
        """Frames of the present stream that were refused because they are ahead of time."""
        self.received_frames = self.received_bytes = 0
        """Frames received since the server was started, and their bytes."""
        self.last_seq: int | None = None
        self.last_t_ns: int | None = None
        self.last_seen_t_ns: int | None = None
        self.published_t_ns: int | None = None
        """Time of the newest frame that was published to subscribers, node's UTC."""
        self._folder = folder
        self._journals_folder = journals
        self._rate_meter = FrameRateMeter()
        self._problems: list[str] = []
        for path in sorted(journals.glob("*")):
            if is_stream_id(path.name):
                try:
                    self.streams[path.name] = stream = ServerStream.open_stored(path)
                    self._problems += stream.problems
                except DamagedFileError as error:
                    self._problems.append(f"a journal is left out: {error}")
                except FootTileError as error:  # a full disk, or another version's file
                    self.unreadable_streams[path.name] = _describe_unreadable(error)
        self._problems += self.estimator.file_problems
        for text in self.file_problems:
            log.warning("%s", text)
        self.present_stream = self._get_or_create_stream(self.last_info)
        """Stream to which the node adds frames now."""

    @property
    def file_problems(self) -> list[str]:
        """Damage found in its files, and the consequence, as text."""
        found = [*self._problems, *self.unreadable_streams.values()]
        return [f"node {self.name}: {text}" for text in found]

    @property
    def last_info(self) -> ArrayInfo:
        """Description of the present stream's array, from the last hello."""
        return self.hello.array_info

    @property
    def stream_id(self) -> str:
        """Id of the present stream."""
        return self.last_info.stream_id

    @property
    def announced_stream_order(self) -> tuple[str, ...]:
        """Ids of its streams from its last hello, oldest first; the present one is last."""
        return (*(each.array_info.stream_id for each in self.hello.earlier), self.stream_id)

    @property
    def journal(self) -> Journal | None:
        """Journal of the present stream; None before its first frame."""
        return self.present_stream.journal

    @property
    def clock_offset(self) -> ClockOffset | None:
        """Latest offset of its clock in the present stream; None: not measured yet."""
        return self.present_stream.clock_offset

    @property
    def present_stream_lost_or_pending(self) -> Intervals:
        """Frames of the present stream that are not stored: lost, or still to come."""
        newest = -1 if self.last_seq is None else self.last_seq
        if self.has_connected:
            newest = max(newest, self.hello.next_seq - 1)
        return self.present_stream.lost_or_pending_up_to(newest)

    @property
    def present_stream_backlog_frames(self) -> int:
        """Number of missing frames that the node can still send."""
        return (self.present_stream_lost_or_pending & self.present_stream.obtainable).number_count

    def compute_backlog_age_s(self, now_t_ns: int) -> float | None:
        """Return the age of the backlog's oldest frame, to a batch; 0: none; None: unknown.

        Args:
            now_t_ns: the server's UTC.
        """
        oldest = (self.present_stream_lost_or_pending & self.present_stream.obtainable).first
        if oldest is None:
            return 0.0
        t_ns = None
        if self.journal is not None:
            with suppress(StorageError):  # it writes what still waits
                t_ns = self.journal.find_batch_t_ns_near(oldest, at_or_before=True)
        if t_ns is None:
            return None
        return (now_t_ns - self.to_server_t_ns_or_unchanged(t_ns)) * 1e-9

    @property
    def present_stream_lost_by_reason(self) -> dict[str, int]:
        """Number of lost frames of the present stream, by reason; unexplained: node_restarted."""
        unobtainable = self.present_stream_lost_or_pending - self.present_stream.obtainable
        named = {
            why: lost.number_count
            for why, lost in self.present_stream.lost.restricted_to(unobtainable).items()
        }
        if unnamed := unobtainable.number_count - sum(named.values()):
            named[NODE_RESTARTED] = named.get(NODE_RESTARTED, 0) + unnamed
        return named

    @property
    def refused_ahead_frames_warnings(self) -> list[str]:
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
        seen_t_ns = self.present_stream.last_seen_t_ns
        silent_ns = None if seen_t_ns is None else server_utc_ns() - seen_t_ns
        return self._rate_meter.rate_hz(self.last_info.nominal_rate_hz, silent_ns)

    def apply_checked_hello(self, hello: Hello, now_t_ns: int) -> None:
        """Update streams and estimates from hello; the caller sets `is_connected`.

        Args:
            hello: its message; every known stream in it has the array of before.
            now_t_ns: the server's UTC.
        """
        if hello.array_info.stream_id != self.stream_id or self.last_seq is None:
            self.last_seq = self.last_t_ns = None
            self.warnings, self.fault_counts = (), {}
            self.refused_ahead_frames = 0
            self._rate_meter.clear()
        self.hello, self.vitals = hello, hello.vitals
        self.has_connected, self.hello_t_ns = True, now_t_ns
        for stream in list(self.streams.values()):
            stream.unacked = Intervals()
            if stream.stream_id not in self.announced_stream_order and not hello.has_more:
                stream.expect_no_more_frames()
                if stream.journal is None:  # no frame ever came
                    del self.streams[stream.stream_id]
        for earlier in hello.earlier:
            self._get_or_create_stream(earlier.array_info).apply_end_report(earlier)
        self.present_stream = self._get_or_create_stream(hello.array_info)
        self.present_stream.apply_present_hello(hello, now_t_ns)
        # Acknowledge stored frames again: a link may have broken before their acknowledgement.
        for name in self.announced_stream_order:
            stream = self.streams[name]
            stream.unacked = stream.stored & stream.obtainable
        self.estimator.restart_if_changed(hello)
        self.is_dirty = True

    def make_session_facts(self) -> NodeFacts:
        """Return the present facts of the node for its sessions."""
        hello, offset = self.hello, self.clock_offset
        first_seq = hello.stored[0][0] if hello.stored else None
        return NodeFacts(
            now_t_ns=server_utc_ns(),
            find_stream=cache(self._find_session_stream),
            stream_ids=self.announced_stream_order,
            unreadable=self.unreadable_streams.keys(),
            is_running=True,
            has_reported=self.has_connected,
            is_connected=self.is_connected,
            newest_seq=self.last_seq,
            offset_ns=offset.server_minus_node_ns if offset is not None else None,
            report=NodeReport(self.hello_t_ns, hello.next_seq, first_seq, hello.t_ns_first)
            if self.hello_t_ns is not None
            else None,
            scene=self.last_info.scene,
            scene_content=hello.scene,
            calibration=self.estimator.assigned_or_node_calibration,
            calibration_source=self.estimator.calibration_source,
            vitals=self.vitals,
        )

    def _find_session_stream(self, stream_id: str) -> SessionStream | None:
        stream = self.streams.get(stream_id)
        return stream.make_session_stream() if stream is not None else None

    def needed_and_present_frames_to_request(
        self, needed_first: Mapping[str, Intervals]
    ) -> tuple[StreamNumbers, ...]:
        """Return the frames to request: first those needed by sessions, then the others.

        Of earlier streams only the needed ones.

        Args:
            needed_first: frames that sessions need, by stream id.
        """
        found = []
        for name in self.announced_stream_order:
            stream, present = self.streams[name], name == self.stream_id
            wanted = needed_first.get(name, Intervals())
            requested = stream.frames_to_request(wanted, include_unneeded=present)
            first = (requested & wanted).restricted_to(
                0, self.hello.next_seq - 1 if present else NO_END
            )
            numbers = _join_adjacent([*first, *requested - first])
            if numbers:
                found.append(StreamNumbers(stream_id=name, numbers=to_open_pairs(numbers)))
        return tuple(found)

    def mark_disconnected(self) -> None:
        """Mark the node as disconnected; its frames stay."""
        self.is_connected, self.vitals = False, None
        self._rate_meter.clear()

    def receive_frames(
        self, stream: ServerStream, payload: bytes, now_t_ns: int
    ) -> list[EstimatedBatch]:
        """Store one message of frames, estimate its newest, and return the estimates due now.

        Args:
            stream: stream of the frames.
            payload: the message.
            now_t_ns: the server's UTC.

        Raises:
            LinkError: the message is not of this stream, or its frames break a rule.
        """
        try:
            frames = stream.decoder.decode(payload)
            if ahead := stream.check_frames_and_describe_ahead(frames, now_t_ns):
                self._count_ahead_frames(frames, ahead)
                return []
            stream.append_frames(frames, payload, now_t_ns)
        except FileFormatError as error:
            raise LinkError(f"node {self.name!r}: {error}") from error
        except StorageError as error:  # live goes on; nothing is acknowledged
            self.storage_problem = str(error)
        first, last = int(frames.seq[0]), int(frames.seq[-1])
        self.received_frames += len(frames)
        self.received_bytes += len(payload)
        self.last_seen_t_ns = now_t_ns
        if stream is not self.present_stream:
            return []
        if self.last_seq is not None and last <= self.last_seq:
            self._update_tare()  # resent for the journal; live is further
            return []
        if self.last_seq is not None and first <= self.last_seq:
            frames = frames.slice_rows(self.last_seq + 1 - first, len(frames))
        self.last_seq, self.last_t_ns = last, int(frames.t_ns[-1])
        self._rate_meter.add_frame(int(frames.t_mono_ns[-1]), last)
        due = self.estimator.estimate_or_pass_frames(frames)
        self._update_tare()
        return due

    def tare_now(self, reason: str = "") -> RecordedTare:
        """Tare from an unloaded interval of the last seconds, and put the tare in force.

        Raises:
            TareError: the foot was loaded, or there is nothing to tare.
            StateError: the node is not connected.
            StorageError: the tare cannot be stored.
        """
        if not self.is_connected:
            raise StateError(f"node {self.name!r} is not connected", remedy="Connect it and retry")
        return self.estimator.tare_controller.tare_by_hand(reason)

    def retry_unreadable_journals(self) -> None:
        """Retry opening the journals that could not be read."""
        for name in sorted(self.unreadable_streams):
            stream = self.streams.get(name)
            try:
                if stream is None or stream.journal is None:
                    opened = ServerStream.open_stored(self._journals_folder / name)
                    if stream is not None:  # the node has listed it
                        stream.journal = opened.journal
                    else:
                        self.streams[name] = opened
                        if self.has_connected:
                            opened.expect_no_more_frames()
            except DamagedFileError as error:
                self._problems.append(f"a journal is left out: {error}")
            except FootTileError as error:
                self.unreadable_streams[name] = _describe_unreadable(error)
                continue
            del self.unreadable_streams[name]

    def to_server_t_ns_or_unchanged(self, t_ns: int) -> int:
        """Convert a time of the node's UTC to the server's; unchanged without an offset."""
        return t_ns + (
            self.clock_offset.server_minus_node_ns if self.clock_offset is not None else 0
        )

    def to_node_t_ns_or_unchanged(self, t_ns: int) -> int:
        """Convert a time of the server's UTC to the node's."""
        return t_ns - (
            self.clock_offset.server_minus_node_ns if self.clock_offset is not None else 0
        )

    def delete_old_frames_and_up_to_one_ended_journal(self, keep: Mapping[str, Intervals]) -> bool:
        """Delete frames older than the ring and not in `keep`, at most one whole journal per call.

        Args:
            keep: frames to keep, by stream id.

        Returns:
            True if a whole journal was deleted: call again. A node that was switched on a thousand
            times has as many.

        Raises:
            StorageError: an old segment of the present stream cannot be deleted.
        """
        for name, stream in list(self.streams.items()):
            needed = keep.get(name, Intervals())
            if stream is self.present_stream:
                if self.last_t_ns is not None:
                    stream.delete_older(self.last_t_ns - RING_DURATION_NS, needed)
            elif not needed and (not stream.unacked or self.storage_problem is not None):
                # The node waits for their acknowledgement; on a full disk, room comes first.
                is_there = stream.journal is not None
                stream.delete_journal()
                if name not in self.announced_stream_order:
                    del self.streams[name]
                if is_there:
                    return True
        return False

    def save_hello(self) -> None:
        """Save hello for after a restart. Runs in any thread.

        Raises:
            StorageError: the disk is full or not writable.
        """
        hello = self.hello
        with translate_storage_errors(self._folder):
            make_synced_folder(self._folder)
        write_document(self._folder / HELLO_NAME, hello)
        if hello is self.hello:  # a newer hello may have come meanwhile
            self.is_dirty = False

    def _count_ahead_frames(self, frames: FrameBatch, why: str) -> None:
        """Count frames that are ahead of time; log the first ones of a stream."""
        if not self.refused_ahead_frames:
            first, last = int(frames.seq[0]), int(frames.seq[-1])
            log.warning(
                "node %s: frames %d to %d are refused: %s; further ones are counted",
                *(self.name, first, last, why),
            )
        self.refused_ahead_frames += len(frames)

    def _get_or_create_stream(self, info: ArrayInfo) -> ServerStream:
        if info.stream_id not in self.streams:
            self.streams[info.stream_id] = ServerStream(
                self._journals_folder / info.stream_id, info
            )
        return self.streams[info.stream_id]

    def _update_tare(self) -> None:
        if self.storage_problem is not None:  # a tare could not be stored
            return
        try:
            self.estimator.store_lead_or_flight_tare_if_due(
                self.journal, lambda: self.present_stream.obtainable
            )
        except StorageError as error:
            self.storage_problem = str(error)


def _join_adjacent(numbers: list[tuple[int, int]]) -> list[tuple[int, int]]:
    """Return the same ranges in the same order, with adjacent ones joined."""
    joined: list[tuple[int, int]] = []
    for first, last in numbers:
        if joined and joined[-1][1] + 1 == first:
            joined[-1] = (joined[-1][0], last)
        else:
            joined.append((first, last))
    return joined


def _describe_unreadable(error: FootTileError) -> str:
    return f"a journal is left out until it can be read: {error}"
