"""Journal of a node: every frame on its disk, with or without a server.

A thread writes, so that a slow card delays no other work. Unwritten frames wait in memory as long
as there is room, and dropped ones are counted by reason. Frames that a session needs stay until a
server has them on its disk; others are a ring of ten minutes.
"""

from __future__ import annotations

import errno
import logging
import math
import threading
import time
from collections import deque
from collections.abc import Iterable
from contextlib import ExitStack, suppress
from pathlib import Path

from devices.errors import DamagedFileError, FileFormatError, StorageError
from devices.frames import ArrayInfo
from storage.durable_files import (
    lock_folder,
    make_synced_folder,
    translate_storage_errors,
    try_set_aside_and_describe,
)
from storage.edges import read_edges_in_flight
from storage.intervals import DISK_FULL, DISK_SLOW, READ_ONLY, Intervals
from storage.journal.journal import Journal
from storage.journal.node.in_flight import (
    IN_FLIGHT_FILE,
    read_in_flight_of_this_boot,
    read_kernel_boot_id,
)
from storage.journal.node.retention import (
    DEFAULT_BUDGET_BYTES,
    RetentionPolicy,
    RetentionRequest,
    RetentionRequests,
)
from storage.journal.node.stream import NodeStream
from storage.journal.stream_notes import StreamNotes
from storage.wire import EncodedBatch, encode_as_messages


def _recover_ended_stream(folder: Path, problems: list[str]) -> NodeStream | None:
    """Open an earlier process's stream as ended, its frames in flight queued; or None.

    Damaged files are set aside, with a message in `problems`.

    After a reboot the frames in flight are lost. The notes get an upper limit of their number:
    those since the last sync, by the slowest sync of this disk.

    Raises:
        FileFormatError: another version wrote its notes.
        StorageError: it cannot be read.
    """
    try:
        left = read_in_flight_of_this_boot(folder)
    except DamagedFileError as error:
        left = None
        problems.append(try_set_aside_and_describe(folder / IN_FLIGHT_FILE, error))
    stream = _open_stream(folder, problems)
    if stream is None:
        if left is None:
            return None
        # Frames in flight are read only in the boot in which they were written.
        notes = StreamNotes(array_info=left.array_info, kernel_boot_id=read_kernel_boot_id())
        stream = NodeStream(folder, notes, None)
    if stream.has_ended:
        return stream
    if left is None:
        stream.mark_ended_in_memory()
        stream.set_max_lost_tail_in_memory()
        return stream
    frames = left.frames
    if frames is not None:
        held, first = stream.stored, int(frames.seq[0])
        edges = read_edges_in_flight(folder)
        # Frames older than all stored ones were evicted, not lost in flight.
        for a, b in held.missing_in(max(first, held.first or 0), int(frames.seq[-1])):
            # A gap before them: more frames waited for the disk than the file has rows.
            for batch in encode_as_messages(
                frames.slice_rows(a - first, b + 1 - first), stream.info, edges
            ):
                stream.queue_batch_and_record_gap(batch, gap_reason=DISK_SLOW)
    stream.mark_ended_in_memory(max_lost_tail_frames=0)
    return stream


def _open_stream(folder: Path, problems: list[str]) -> NodeStream | None:
    """Open a stream on disk; None if nothing can be read.

    Raises:
        FileFormatError: another version wrote its notes.
        StorageError: it cannot be read.
    """
    notes = StreamNotes.load_or_set_aside(folder, problems)
    journal: Journal | None = None
    with suppress(FileFormatError):
        journal = Journal.open_existing_and_recover(folder)
        problems += journal.problems
    if notes is None and journal is not None:  # the segments have the array's description, too
        notes = StreamNotes(array_info=journal.info)
    return None if notes is None else NodeStream(folder, notes, journal)


log = logging.getLogger("foottile.journal")

MAX_WAITING_BYTES = 32 << 20
"""Upper limit of bytes that wait in memory for the disk: some minutes."""
SYNC_INTERVAL_S = 0.2
"""Interval between two syncs, each after a write of all waiting batches.

Less than half of `MAX_UNSYNCED_S`: a frame that just misses one sync is on the disk with the next.
"""
_CLEANUP_INTERVAL_S = 2.0
"""Interval between two deletions of expired frames, which are minutes old."""
_RETRY_INTERVAL_S = 1.0
"""Interval between two attempts to write to a disk that refuses."""
_CLOSE_TIMEOUT_S = 10.0
"""Timeout of the disk when a node is stopped."""
_DISK_FULL_ERRORS = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
"""Errors of a full disk, a quota and a limit of file sizes: deleting frames helps."""


class NodeJournal:
    """Journals of all streams of a node, with the thread that writes them.

    Args:
        root: the node's folder.
        node: its name.
        budget_bytes: most bytes of its journals.
        is_recovery: no frame is deleted, and the caller holds the folder's locks already.

    Raises:
        StorageError: another process uses the folder.
    """

    def __init__(
        self,
        root: Path,
        node: str,
        *,
        budget_bytes: int = DEFAULT_BUDGET_BYTES,
        is_recovery: bool = False,
    ) -> None:
        self.folder = root / "journal" / node
        self._locks = ExitStack()
        self._streams_lock = threading.Lock()
        """Lock for replacing `streams`; a list that was read before does not change."""
        self._disk_problem: tuple[str, str] | None = None
        """Reason and message, while the disk refuses frames."""
        self._tried_s = -math.inf
        self._tidied_s = self._synced_s = -math.inf
        self._are_requests_changed = False
        self._damaged: deque[tuple[NodeStream, Intervals]] = deque()
        self._wake = threading.Event()
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run_writer, name="journal")
        try:
            if not is_recovery:
                self._lock_folder(root, is_shared=True)
                self._lock_folder(self.folder, is_shared=False)
            self.retention_requests = RetentionRequests(self.folder / "retention.json")
            self.problems = list(self.retention_requests.problems)
            """Damage found, and how it was handled, as messages."""
            self._retention = RetentionPolicy(
                self.folder,
                self.retention_requests,
                budget_bytes=budget_bytes,
                is_deletion_allowed=not is_recovery,
            )
            self.streams: list[NodeStream] = self._recover_streams()
        except BaseException:
            self._locks.close()
            raise

    def start_writer(self) -> None:
        """Start the writer thread."""
        self._thread.start()

    def end_streams_and_close(self) -> None:
        """End all streams, write what waits for up to 10 s, and stop the writer thread."""
        self._stopping.set()
        self._wake.set()
        if self._thread.is_alive():
            self._thread.join()
        self._locks.close()

    @property
    def disk_refusal_warnings(self) -> tuple[str, ...]:
        """Warning that the disk refuses frames, as a message; empty while it accepts them."""
        problem = self._disk_problem
        if problem is None:
            return ()
        waiting_s = sum(stream.waiting_frames_duration_s for stream in self.streams)
        return (f"{problem[1]}; {waiting_s:.0f} s of frames wait in memory",)

    def switch_to_new_stream(self, info: ArrayInfo) -> NodeStream:
        """Start a new stream and mark earlier ones as ended."""
        with self._streams_lock:
            for stream in self.streams:
                stream.mark_ended_in_memory()
            number = max((stream.notes.number for stream in self.streams), default=0) + 1
            notes = StreamNotes(
                array_info=info, number=number, kernel_boot_id=read_kernel_boot_id()
            )
            stream = NodeStream(self.folder / info.stream_id, notes, None)
            self.streams = [*self.streams, stream]
        self._wake.set()
        return stream

    def queue_batch_and_limit_memory(
        self, stream: NodeStream, batch: EncodedBatch, total_missed_slots: int | None = None
    ) -> None:
        """Queue the newest frames for the writer; drop the oldest beyond 32 MiB."""
        stream.queue_batch_and_record_gap(batch, total_missed_slots)
        # The writer is not woken: it writes all batches at its next sync.
        while sum(each.unwritten_bytes for each in self.streams) > MAX_WAITING_BYTES:
            if not self._drop_oldest():  # the writer has written them meanwhile
                break

    def update_retention_request(self, server_id: str, request: RetentionRequest) -> None:
        """Update a server's retention request."""
        if self.retention_requests.update_request_in_memory(server_id, request):
            self._are_requests_changed = True
            self._wake.set()

    def queue_invalidation(self, stream: NodeStream, numbers: Intervals) -> None:
        """Queue damaged frames, which the writer's thread then invalidates."""
        self._damaged.append((stream, numbers))
        self._wake.set()

    def available_undelivered_numbers(self, stream: NodeStream) -> Intervals:
        """Return a stream's available numbers that a server needs and has not acknowledged."""
        return stream.available_undelivered_numbers(self.retention_requests)

    def wait_for_ended_streams_on_disk(self, timeout_s: float = _CLOSE_TIMEOUT_S) -> bool:
        """Wait until every ended stream is complete on disk; False after a timeout."""
        end_s = time.monotonic() + timeout_s
        while not all(stream.is_complete_on_disk for stream in self.streams if stream.has_ended):
            if time.monotonic() > end_s or not self._thread.is_alive():
                return False
            self._wake.set()
            time.sleep(0.01)
        return True

    def write_in_flight_frames_and_stream_ends(self) -> None:
        """Write frames in flight and the ends of all streams in the caller's thread.

        Raises:
            StorageError: the disk refuses the frames in flight.
        """
        self._write_and_clean_up(is_forced=True)
        if not all(stream.is_complete_on_disk for stream in self.streams):
            raise StorageError(
                "the frames in flight cannot be written: " + "; ".join(self.disk_refusal_warnings),
                where=str(self.folder),
                remedy="Free space on the disk, and run it again",
            )

    def _drop_oldest(self) -> bool:
        """Drop the batch that has waited longest; False if only the newest is left."""
        problem = self._disk_problem
        reason = problem[0] if problem is not None else DISK_SLOW
        newest = self.streams[-1]
        return any(
            stream.drop_oldest_waiting_and_record_unacked_loss(
                reason, self.retention_requests, min_batches_left=1 if stream is newest else 0
            )
            for stream in self.streams
        )

    # --- the writer's thread ----------------------------------------------------------------------

    def _run_writer(self) -> None:
        stop_s = math.inf
        while True:
            self._wake.wait(SYNC_INTERVAL_S)
            self._wake.clear()
            if self._stopping.is_set() and stop_s == math.inf:
                stop_s = time.monotonic() + _CLOSE_TIMEOUT_S
                for stream in self.streams:
                    stream.mark_ended_in_memory()
            try:
                self._write_and_clean_up(is_forced=stop_s < math.inf)
            except Exception:
                log.exception("this is a bug; the journal goes on")
            settled = all(stream.is_complete_on_disk for stream in self.streams)
            is_late = time.monotonic() > stop_s
            if stop_s < math.inf and (settled or is_late or self._disk_problem is not None):
                return

    def _write_and_clean_up(self, *, is_forced: bool) -> None:
        self._write_streams()
        now_s = time.monotonic()
        if now_s - self._synced_s >= SYNC_INTERVAL_S or is_forced:
            self._synced_s = now_s
            for stream in self.streams:
                stream.try_sync_or_requeue()
                stream.try_record_end_once_synced(self.retention_requests, self.problems)
        if now_s - self._tidied_s >= _CLEANUP_INTERVAL_S or (
            self._are_requests_changed and not self._disk_problem
        ):
            self._tidied_s = now_s
            self._clean_up()

    def _write_streams(self) -> None:
        now_s = time.monotonic()
        if self._disk_problem is not None and now_s - self._tried_s < _RETRY_INTERVAL_S:
            return
        self._tried_s = now_s
        try:
            for stream in self.streams:
                self._write_stream(stream)
        except StorageError as error:
            reason = DISK_FULL if error.errno in _DISK_FULL_ERRORS else READ_ONLY
            what = "is full" if reason == DISK_FULL else f"does not take frames: {error.what}"
            self._disk_problem = (reason, f"the journal's disk {what}")
            return
        self._disk_problem = None

    def _write_stream(self, stream: NodeStream) -> None:
        stream.ensure_journal_and_notes()
        while stream.unwritten_bytes and stream.journal is not None:
            try:
                self._retention.delete_unneeded_to_budget_or_raise_full(
                    self.streams, ignore_check_interval=self._disk_problem is not None
                )
                stream.write_oldest_waiting()
            except StorageError as error:
                if (
                    error.errno not in _DISK_FULL_ERRORS
                    or not self._retention.evict_oldest_unneeded_segment(self.streams)
                ):
                    raise

    def _clean_up(self) -> None:
        while self._damaged:
            stream, numbers = self._damaged.popleft()
            stream.invalidate_and_record_loss(numbers, self.retention_requests)
        if self._are_requests_changed:
            self._are_requests_changed = False
            try:
                self.retention_requests.save()
            except StorageError:
                self._are_requests_changed = True
        dropped = self._retention.evict_expired_and_list_deleted_streams(self.streams)
        with self._streams_lock:
            self.streams = [stream for stream in self.streams if stream not in dropped]

    # --- recovery ---------------------------------------------------------------------------------

    def _recover_streams(self) -> list[NodeStream]:
        streams = []
        if self.folder.is_dir():
            with translate_storage_errors(self.folder):
                folders = [path for path in self.folder.iterdir() if path.is_dir()]
            for folder in folders:
                try:
                    stream = _recover_ended_stream(folder, self.problems)
                except (FileFormatError, StorageError) as error:
                    self.problems.append(f"a stream is skipped: {error}")
                    continue
                if stream is not None:
                    streams.append(stream)
        streams = _sort_streams(streams)
        number = 0
        for stream in streams:
            number = max(number + 1, stream.notes.number)
            if stream.notes.number != number:
                stream.update_notes_in_memory(number=number)
        return streams

    def _lock_folder(self, folder: Path, *, is_shared: bool) -> None:
        with suppress(OSError):
            make_synced_folder(folder)
        lock = lock_folder(
            folder,
            is_shared=is_shared,
            refusal_text="another foottile process uses this folder",
            remedy="Stop it, or choose another folder with --journal or another --name",
        )
        try:
            self._locks.enter_context(lock)
        except StorageError as error:
            if error.errno is None:  # a disk that refuses writes has no second user either
                raise


def _sort_streams(found: Iterable[NodeStream]) -> list[NodeStream]:
    """Sort streams by their numbers, oldest first.

    A stream that was killed before its notes were written has no number: it is the newest. A stream
    with damaged notes has frames, whose times give its place.
    """
    order: list[NodeStream] = []
    for stream in sorted(found, key=lambda stream: stream.notes.number or math.inf):
        begin_t_ns = _first_t_ns_of(stream)
        later = [other for other in order if begin_t_ns < _first_t_ns_of(other) < math.inf]
        at = order.index(later[0]) if later and not stream.notes.number else len(order)
        order.insert(at, stream)
    return order


def _first_t_ns_of(stream: NodeStream) -> float:
    journal = stream.journal
    begin_t_ns = (
        journal.find_batch_t_ns_near(0, at_or_before=False) if journal is not None else None
    )
    return math.inf if begin_t_ns is None else begin_t_ns


def recover_node_journals(locked_root: Path) -> None:
    """Write frames that killed nodes left in flight to their journals; record the streams' ends.

    Args:
        locked_root: the nodes' folder, whose lock the caller holds.

    Raises:
        StorageError: it cannot be read, or not written completely.
    """
    for folder in sorted(path for path in (locked_root / "journal").glob("*") if path.is_dir()):
        journal = NodeJournal(locked_root, folder.name, is_recovery=True)
        journal.write_in_flight_frames_and_stream_ends()
