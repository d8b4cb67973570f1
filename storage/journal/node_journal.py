"""What a node keeps on its disk: every frame, always, whether anybody listens or not.

A thread writes, so that a slow card holds up nobody; what it could not write waits in memory as
long as there is room, and what does not fit is counted under its reason. Frames that a session
needs stay until a server has them on its disk; others are a ring of ten minutes.
"""

from __future__ import annotations

import errno
import logging
import math
import shutil
import threading
import time
from collections import deque
from contextlib import ExitStack, suppress
from pathlib import Path

from devices.errors import StorageError
from devices.frames import ArrayInfo
from storage.durable import make_folder, storage_errors
from storage.folder_lock import locked
from storage.intervals import Intervals
from storage.journal.in_flight import delete_in_flight
from storage.journal.journal import RING_NS, Journal
from storage.journal.left_over import encoded, in_flight_since, taken_up
from storage.journal.node_stream import NodeStream
from storage.journal.stream_notes import PROMISE_S, StreamNotes
from storage.journal.wanted import ServerWants, Wanted
from storage.kernel import kernel_boot_id
from storage.losses import CORRUPT, DISK_FULL, DISK_SLOW, EVICTED, READ_ONLY
from storage.wire import EncodedBatch

log = logging.getLogger("foottile.journal")

BUDGET_BYTES = 4 << 30
"""A day and a half of four tiles at full rate."""
WAITING_BYTES = 32 << 20
"""What may wait in memory for the disk: some minutes."""
SYNC_S = 0.2
_TIDY_S = 2.0
_AGAIN_S = 1.0
_CLOSE_S = 10.0
_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


class NodeJournal:
    """All streams of a node.

    Args:
        root: the node's folder.
        node: its name.
        budget_bytes: what its journals may take.
        is_recovery: nothing is dropped, and whoever uses this holds the folder's locks already.

    Raises:
        StorageError: another process uses it.
        FileFormatError: a file in it is damaged.
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
        self._budget_bytes = budget_bytes
        self._may_drop = not is_recovery
        self._locks = ExitStack()
        self._trouble: tuple[str, str] | None = None
        """Reason and words, while the disk takes nothing."""
        self._tried_s = -math.inf
        self._tidied_s = self._synced_s = self._weighed_s = -math.inf
        self._began_s = time.monotonic()
        self._wants_changed = False
        self._damaged: deque[tuple[NodeStream, Intervals]] = deque()
        self._lost_before: dict[str, object] = {}
        self._wake = threading.Event()
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="journal")
        try:
            if not is_recovery:
                self._lock(root, is_shared=True)
                self._lock(self.folder, is_shared=False)
            self.wanted = Wanted(self.folder / "wanted.json")
            self.streams: list[NodeStream] = self._found()
        except BaseException:
            self._locks.close()
            raise

    def start(self) -> None:
        """Begin to write."""
        self._thread.start()

    def close(self) -> None:
        """Write what waits, as far as the disk takes it, and end."""
        self._stopping.set()
        self._wake.set()
        if self._thread.is_alive():
            self._thread.join()
        self._locks.close()

    @property
    def troubles(self) -> tuple[str, ...]:
        """What is wrong with keeping frames, in words."""
        trouble = self._trouble
        if trouble is None:
            return ()
        waiting_s = sum(
            sum(batch.seq_last - batch.seq_first + 1 for batch in list(stream.waiting))
            / stream.info.nominal_rate_hz
            for stream in self.streams
        )
        return (f"{trouble[1]}; {waiting_s:.0f} s of frames wait in memory",)

    def begin(self, info: ArrayInfo) -> NodeStream:
        """A new stream; those before have ended."""
        for stream in self.streams:
            stream.has_ended = True
        number = max((stream.notes.number for stream in self.streams), default=0) + 1
        notes = StreamNotes(array_info=info, number=number, kernel_boot_id=kernel_boot_id())
        stream = NodeStream(self.folder / info.boot_id, notes, None)
        self.streams = [*self.streams, stream]
        self._wake.set()
        return stream

    def put(self, stream: NodeStream, batch: EncodedBatch, missed_slots: int = 0) -> None:
        """Keep the newest frames; returns at once."""
        stream.put(batch, missed_slots)
        while sum(each.waiting_bytes for each in self.streams) > WAITING_BYTES:
            if not self._drop_oldest():  # the writer has taken them meanwhile
                break
        self._wake.set()

    def want(self, server_id: str, wants: ServerWants) -> None:
        """A server has said what its sessions need."""
        if self.wanted.say(server_id, wants):
            self._wants_changed = True
            self._wake.set()

    def damaged(self, stream: NodeStream, numbers: Intervals) -> None:
        """Frames on disk turned out not to be what was written."""
        self._damaged.append((stream, numbers))
        self._wake.set()

    def undelivered(self, stream: NodeStream) -> Intervals:
        """What sessions need of a stream and no server has yet, of what is held."""
        held = stream.held
        with stream.lock:
            wanted = self.wanted.undelivered(stream.boot_id, stream.acked_by)
        return Intervals(pair for first, last in wanted for pair in held.within(first, last))

    def settle(self, timeout_s: float = _CLOSE_S) -> bool:
        """Wait until every stream that has ended is on disk to its end; did it get there?"""
        end_s = time.monotonic() + timeout_s
        while not all(stream.is_settled for stream in self.streams if stream.has_ended):
            if time.monotonic() > end_s or not self._thread.is_alive():
                return False
            self._wake.set()
            time.sleep(0.01)
        return True

    def settle_here(self) -> None:
        """The same without the thread, for recovery.

        Raises:
            StorageError: the disk does not take what was in flight.
        """
        self._work(at_once=True)
        if not all(stream.is_settled for stream in self.streams):
            raise StorageError(
                "what was in flight cannot be written: " + "; ".join(self.troubles),
                where=str(self.folder),
                remedy="Free space on the disk, and run it again",
            )

    def _drop_oldest(self) -> bool:
        """Give up what has waited longest, in any stream; was there anything but the newest?"""
        for stream in self.streams:
            newest = 1 if stream is self.streams[-1] else 0
            with stream.lock:
                if len(stream.waiting) <= newest:
                    continue
                oldest = stream.waiting.popleft()
                stream.waiting_bytes -= len(oldest.payload)
            trouble = self._trouble
            reason = trouble[0] if trouble is not None else DISK_SLOW
            stream.lose(oldest.numbers, reason, self.wanted.local(stream.boot_id))
            return True
        return False

    # --- the writer's thread ----------------------------------------------------------------------

    def _run(self) -> None:
        stop_s = math.inf
        while True:
            self._wake.wait(SYNC_S)
            self._wake.clear()
            if self._stopping.is_set() and stop_s == math.inf:
                stop_s = time.monotonic() + _CLOSE_S
                for stream in self.streams:
                    stream.has_ended = True
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
            for stream in list(self.streams):
                self._sync(stream)
                self._settle(stream)
        if now_s - self._tidied_s >= _TIDY_S or (self._wants_changed and not self._trouble):
            self._tidied_s = now_s
            self._tidy()

    def _write_all(self) -> None:
        now_s = time.monotonic()
        if self._trouble is not None and now_s - self._tried_s < _AGAIN_S:
            return
        self._tried_s = now_s
        try:
            for stream in list(self.streams):
                self._write(stream)
        except StorageError as error:
            reason = DISK_FULL if error.errno in _FULL else READ_ONLY
            what = "is full" if reason == DISK_FULL else f"does not take frames: {error.what}"
            self._trouble = (reason, f"the journal's disk {what}")
            return
        self._trouble = None

    def _write(self, stream: NodeStream) -> None:
        if stream.journal is None and not stream.is_settled:
            begun = Journal(stream.folder, stream.info)
            stream.save_notes()
            stream.journal = begun
        journal = stream.journal
        while stream.waiting and journal is not None:
            batch = stream.waiting[0]
            try:
                self._keep_to_budget()
                journal.append_message(batch)
            except StorageError as error:
                if error.errno in _FULL and self._evict():
                    continue
                raise
            with stream.lock:
                if stream.waiting and stream.waiting[0] is batch:
                    stream.waiting.popleft()
                    stream.waiting_bytes -= len(batch.payload)
                stream.lost.found(batch.numbers)
            stream.unsynced.append(batch)

    def _sync(self, stream: NodeStream) -> None:
        if stream.journal is None or not stream.unsynced:
            return
        with stream.lock:
            since_s, stream.waiting_since_s = stream.waiting_since_s, None
            if stream.waiting:  # came since the others were written
                stream.waiting_since_s = time.monotonic()
        try:
            stream.journal.sync()
        except StorageError:
            # The kernel may forget what it could not write: it has to be written once more.
            numbers = Intervals((b.seq_first, b.seq_last) for b in stream.unsynced)
            stream.journal.disown(numbers)
            with stream.lock:
                stream.waiting.extendleft(reversed(stream.unsynced))
                stream.waiting_bytes += sum(len(batch.payload) for batch in stream.unsynced)
            stream.unsynced = []
            stream.waiting_since_s = since_s
            return
        stream.unsynced = []
        took_s = 0.0 if since_s is None else time.monotonic() - since_s
        if took_s > max(PROMISE_S, stream.notes.sync_max_s):
            with suppress(StorageError):
                stream.save_notes(sync_max_s=took_s)

    def _settle(self, stream: NodeStream) -> None:
        """Note where a stream has ended, once all of it is on disk."""
        if stream.is_settled or not stream.has_ended or stream.waiting or stream.unsynced:
            return
        if self._rescue(stream):
            return
        try:
            if stream.journal is not None:
                stream.journal.close()
            # One that ended before its first frame is remembered if a server asks for it.
            if stream.next_seq or self.wanted.numbers(stream.boot_id):
                stream.save_notes(next_seq=stream.next_seq)
            elif stream.folder.is_dir():
                shutil.rmtree(stream.folder, ignore_errors=True)
        except StorageError:
            return
        delete_in_flight(stream.folder)
        stream.forget_recent()
        stream.is_settled = True

    def _rescue(self, stream: NodeStream) -> bool:
        """Take over what acquisition had taken when it was killed; was there anything?"""
        try:
            rows = in_flight_since(stream)
        except StorageError:
            return False
        if rows is None:
            return False
        for batch in encoded(rows, stream.info):
            stream.put(batch, stream.missed_slots)
        return True

    def _tidy(self) -> None:
        while self._damaged:
            stream, numbers = self._damaged.popleft()
            if stream.journal is not None:
                stream.journal.disown(numbers)
                stream.lose(numbers, CORRUPT, self.wanted.local(stream.boot_id))
        if self._wants_changed:
            self._wants_changed = False
            try:
                self.wanted.save()
            except StorageError:
                self._wants_changed = True
        if not self._may_drop:
            return
        for stream in list(self.streams):
            journal, is_present = stream.journal, not stream.has_ended
            if journal is None:
                continue
            keep = self._keep(stream)
            past_ring = self._is_past_ring(stream)
            newest = stream.recent(max(0, stream.next_seq - 1))
            before_ns: int | None = None
            if is_present and newest:
                before_ns = newest[-1].t_ns_last - RING_NS
            elif not is_present and past_ring:
                before_ns = 2**62
            if before_ns is not None:
                with suppress(StorageError):
                    stream.lose(journal.prune(before_ns, keep), EVICTED)
            unheld = not journal.held and stream.is_settled
            if unheld and past_ring and not self.wanted.numbers(stream.boot_id):
                journal.delete()
                self.streams = [each for each in self.streams if each is not stream]
                continue
            lost = stream.lost.as_pairs()
            if lost != self._lost_before.get(stream.boot_id, stream.notes.lost):
                with suppress(StorageError):
                    stream.save_notes()
                    self._lost_before[stream.boot_id] = lost

    def _is_past_ring(self, stream: NodeStream) -> bool:
        """Has a stream that ended outlasted the ring, in this process or since it was written?"""
        ring_s = RING_NS * 1e-9
        if time.monotonic() - self._began_s > ring_s:
            return True
        try:
            written_s = max(path.stat().st_mtime for path in stream.folder.iterdir())
        except (OSError, ValueError):
            return False
        return stream.is_settled and time.time() - written_s > ring_s

    def _keep(self, stream: NodeStream) -> Intervals:
        """What must not be deleted."""
        with stream.lock:
            return self.wanted.unmet(stream.boot_id, stream.acked_by)

    def _keep_to_budget(self) -> None:
        now_s = time.monotonic()
        if now_s - self._weighed_s < _AGAIN_S and self._trouble is None:
            return
        self._weighed_s = now_s
        while self._size_bytes() > self._budget_bytes:
            if not self._evict():
                raise StorageError(
                    f"the journal has its {self._budget_bytes} bytes, all of frames that sessions "
                    "need",
                    where=str(self.folder),
                    errno=errno.ENOSPC,
                )

    def _size_bytes(self) -> int:
        return sum(s.journal.size_bytes for s in self.streams if s.journal is not None)

    def _evict(self) -> bool:
        """Make room: delete the oldest frames that no session needs; was there anything?"""
        for stream in list(self.streams):
            if stream.journal is not None and self._may_drop:
                gone = stream.journal.evict(self._keep(stream))
                if gone:
                    stream.lose(gone, EVICTED)
                    return True
        return False

    # --- what was there ---------------------------------------------------------------------------

    def _found(self) -> list[NodeStream]:
        streams = []
        if self.folder.is_dir():
            with storage_errors(self.folder):
                folders = [path for path in self.folder.iterdir() if path.is_dir()]
            for folder in folders:
                stream = taken_up(folder)
                if stream is not None:
                    streams.append(stream)
        # One that was killed before its notes were written has no number yet: it is the newest.
        streams.sort(key=lambda stream: stream.notes.number or math.inf)
        for number, stream in enumerate(streams):
            if not stream.notes.number:
                before = streams[number - 1].notes.number if number else 0
                stream.notes = stream.notes.model_copy(update={"number": before + 1})
        return streams

    def _lock(self, folder: Path, *, is_shared: bool) -> None:
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
            if error.errno is None:  # a disk that takes nothing has no second user either
                raise


def settle_left_over(root: Path) -> None:
    """Have what killed nodes left in flight in their journals, and note where their streams ended.

    Args:
        root: the nodes' folder, whose lock the caller holds.

    Raises:
        StorageError: it cannot be read, or not written to its end.
    """
    for folder in sorted(path for path in (root / "journal").glob("*") if path.is_dir()):
        journal = NodeJournal(root, folder.name, is_recovery=True)
        journal.settle_here()
