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

from devices.errors import FileFormatError, StorageError
from devices.frames import ArrayInfo
from storage.durable import locked, make_folder, storage_errors
from storage.intervals import DISK_FULL, DISK_SLOW, READ_ONLY, Intervals
from storage.journal.node.in_flight import kernel_boot_id
from storage.journal.node.left_over import recover_stream
from storage.journal.node.retention import BUDGET_BYTES, Retention
from storage.journal.node.stream import NodeStream
from storage.journal.node.wanted import ServerWants, Wanted
from storage.journal.stream_notes import StreamNotes
from storage.wire import EncodedBatch

log = logging.getLogger("foottile.journal")

WAITING_BYTES = 32 << 20
"""Upper limit of bytes that wait in memory for the disk: some minutes."""
SYNC_S = 0.2
"""Interval between two syncs, each after a write of all waiting batches.

Less than half of `PROMISE_S`: a frame that just misses one sync is on the disk with the next.
"""
_TIDY_S = 2.0
"""Interval between two deletions of expired frames, which are minutes old."""
_AGAIN_S = 1.0
"""Interval between two attempts to write to a disk that refuses."""
_CLOSE_S = 10.0
"""Timeout of the disk when a node is stopped."""
_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
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
        budget_bytes: int = BUDGET_BYTES,
        is_recovery: bool = False,
    ) -> None:
        self.folder = root / "journal" / node
        self._locks = ExitStack()
        self._changing = threading.Lock()
        """Lock for replacing `streams`; a list that was read before does not change."""
        self._trouble: tuple[str, str] | None = None
        """Reason and message, while the disk refuses frames."""
        self._tried_s = -math.inf
        self._tidied_s = self._synced_s = -math.inf
        self._wants_changed = False
        self._damaged: deque[tuple[NodeStream, Intervals]] = deque()
        self._wake = threading.Event()
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="journal")
        try:
            if not is_recovery:
                self._lock_folder(root, is_shared=True)
                self._lock_folder(self.folder, is_shared=False)
            self.wanted = Wanted(self.folder / "wanted.json")
            self._wants_changed = not self.wanted.is_proven
            self.problems = list(self.wanted.problems)
            """Damage found, and how it was handled, as messages."""
            self._retention = Retention(
                self.folder, self.wanted, budget_bytes=budget_bytes, may_drop=not is_recovery
            )
            self.streams: list[NodeStream] = self._found()
        except BaseException:
            self._locks.close()
            raise

    def start(self) -> None:
        """Start the writer thread."""
        self._thread.start()

    def close(self) -> None:
        """Write the waiting batches if the disk accepts them, and stop the writer thread."""
        self._stopping.set()
        self._wake.set()
        if self._thread.is_alive():
            self._thread.join()
        self._locks.close()

    @property
    def troubles(self) -> tuple[str, ...]:
        """Warnings about storage, as messages."""
        trouble = self._trouble
        if trouble is None:
            return ()
        waiting_s = sum(stream.waiting_s for stream in self.streams)
        return (f"{trouble[1]}; {waiting_s:.0f} s of frames wait in memory",)

    def begin(self, info: ArrayInfo) -> NodeStream:
        """Start a new stream and mark earlier ones as ended."""
        with self._changing:
            for stream in self.streams:
                stream.end()
            number = max((stream.notes.number for stream in self.streams), default=0) + 1
            notes = StreamNotes(array_info=info, number=number, kernel_boot_id=kernel_boot_id())
            stream = NodeStream(self.folder / info.boot_id, notes, None)
            self.streams = [*self.streams, stream]
        self._wake.set()
        return stream

    def put(self, stream: NodeStream, batch: EncodedBatch, missed_slots: int = 0) -> None:
        """Queue the newest frames for the writer; drop the oldest beyond a limit."""
        stream.put(batch, missed_slots)
        # The writer is not woken: it writes all batches at its next sync.
        while sum(each.waiting_bytes for each in self.streams) > WAITING_BYTES:
            if not self._drop_oldest():  # the writer has written them meanwhile
                break

    def want(self, server_id: str, wants: ServerWants) -> None:
        """Update a server's retention request."""
        if self.wanted.say(server_id, wants):
            self._wants_changed = True
            self._wake.set()

    def damaged(self, stream: NodeStream, numbers: Intervals) -> None:
        """Report frames that are damaged on disk; the writer invalidates them."""
        self._damaged.append((stream, numbers))
        self._wake.set()

    def undelivered(self, stream: NodeStream) -> Intervals:
        """Return the available numbers of a stream that sessions need and no server has yet."""
        return stream.undelivered(self.wanted)

    def settle(self, timeout_s: float = _CLOSE_S) -> bool:
        """Wait until every ended stream is complete on disk; False after a timeout."""
        end_s = time.monotonic() + timeout_s
        while not all(stream.is_settled for stream in self.streams if stream.has_ended):
            if time.monotonic() > end_s or not self._thread.is_alive():
                return False
            self._wake.set()
            time.sleep(0.01)
        return True

    def settle_here(self) -> None:
        """Write all frames to disk in the caller's thread, for recovery.

        Raises:
            StorageError: the disk refuses the frames in flight.
        """
        self._work(at_once=True)
        if not all(stream.is_settled for stream in self.streams):
            raise StorageError(
                "the frames in flight cannot be written: " + "; ".join(self.troubles),
                where=str(self.folder),
                remedy="Free space on the disk, and run it again",
            )

    def _drop_oldest(self) -> bool:
        """Drop the batch that has waited longest; False if only the newest is left."""
        trouble = self._trouble
        reason = trouble[0] if trouble is not None else DISK_SLOW
        newest = self.streams[-1]
        return any(
            stream.drop_oldest(reason, self.wanted, at_least=1 if stream is newest else 0)
            for stream in self.streams
        )

    # --- the writer's thread ----------------------------------------------------------------------

    def _run(self) -> None:
        stop_s = math.inf
        while True:
            self._wake.wait(SYNC_S)
            self._wake.clear()
            if self._stopping.is_set() and stop_s == math.inf:
                stop_s = time.monotonic() + _CLOSE_S
                for stream in self.streams:
                    stream.end()
            try:
                self._work(at_once=stop_s < math.inf)
            except Exception:
                log.exception("this is a bug; the journal goes on")
            settled = all(stream.is_settled for stream in self.streams)
            is_late = time.monotonic() > stop_s
            if stop_s < math.inf and (settled or is_late or self._trouble is not None):
                return

    def _work(self, *, at_once: bool) -> None:
        self._write_all()
        now_s = time.monotonic()
        if now_s - self._synced_s >= SYNC_S or at_once:
            self._synced_s = now_s
            for stream in self.streams:
                stream.sync()
                stream.settle(self.wanted, self.problems)
        if now_s - self._tidied_s >= _TIDY_S or (self._wants_changed and not self._trouble):
            self._tidied_s = now_s
            self._tidy()

    def _write_all(self) -> None:
        now_s = time.monotonic()
        if self._trouble is not None and now_s - self._tried_s < _AGAIN_S:
            return
        self._tried_s = now_s
        try:
            for stream in self.streams:
                self._write(stream)
        except StorageError as error:
            reason = DISK_FULL if error.errno in _FULL else READ_ONLY
            what = "is full" if reason == DISK_FULL else f"does not take frames: {error.what}"
            self._trouble = (reason, f"the journal's disk {what}")
            return
        self._trouble = None

    def _write(self, stream: NodeStream) -> None:
        stream.begin_journal()
        while stream.waiting_bytes and stream.journal is not None:
            try:
                self._retention.keep_to_budget(self.streams, at_once=self._trouble is not None)
                stream.write_oldest()
            except StorageError as error:
                if error.errno not in _FULL or not self._retention.evict(self.streams):
                    raise

    def _tidy(self) -> None:
        while self._damaged:
            stream, numbers = self._damaged.popleft()
            stream.disown(numbers, self.wanted)
        if self._wants_changed:
            self._wants_changed = False
            try:
                self.wanted.save()
            except StorageError:
                self._wants_changed = True
        dropped = self._retention.tidy(self.streams)
        with self._changing:
            self.streams = [stream for stream in self.streams if stream not in dropped]

    # --- recovery ---------------------------------------------------------------------------------

    def _found(self) -> list[NodeStream]:
        streams = []
        if self.folder.is_dir():
            with storage_errors(self.folder):
                folders = [path for path in self.folder.iterdir() if path.is_dir()]
            for folder in folders:
                try:
                    stream = recover_stream(folder, self.problems)
                except (FileFormatError, StorageError) as error:
                    self.problems.append(f"a stream is skipped: {error}")
                    continue
                if stream is not None:
                    streams.append(stream)
        streams = _in_order(streams)
        number = 0
        for stream in streams:
            number = max(number + 1, stream.notes.number)
            if stream.notes.number != number:
                stream.note(number=number)
        return streams

    def _lock_folder(self, folder: Path, *, is_shared: bool) -> None:
        with suppress(OSError):
            make_folder(folder)
        lock = locked(
            folder,
            is_shared=is_shared,
            refusal="another foottile process uses this folder",
            remedy="Stop it, or choose another folder with --journal or another --name",
        )
        try:
            self._locks.enter_context(lock)
        except StorageError as error:
            if error.errno is None:  # a disk that refuses writes has no second user either
                raise


def _in_order(found: Iterable[NodeStream]) -> list[NodeStream]:
    """Sort streams by their numbers, oldest first.

    A stream that was killed before its notes were written has no number: it is the newest. A stream
    with damaged notes has frames, whose times give its place.
    """
    order: list[NodeStream] = []
    for stream in sorted(found, key=lambda stream: stream.notes.number or math.inf):
        begin_t_ns = _begin_t_ns(stream)
        later = [other for other in order if begin_t_ns < _begin_t_ns(other) < math.inf]
        at = order.index(later[0]) if later and not stream.notes.number else len(order)
        order.insert(at, stream)
    return order


def _begin_t_ns(stream: NodeStream) -> float:
    journal = stream.journal
    begin_t_ns = journal.t_ns_near(0, newest=False) if journal is not None else None
    return math.inf if begin_t_ns is None else begin_t_ns


def settle_left_over(root: Path) -> None:
    """Write frames that killed nodes left in flight to their journals; record the streams' ends.

    Args:
        root: the nodes' folder, whose lock the caller holds.

    Raises:
        StorageError: it cannot be read, or not written completely.
    """
    for folder in sorted(path for path in (root / "journal").glob("*") if path.is_dir()):
        journal = NodeJournal(root, folder.name, is_recovery=True)
        journal.settle_here()
