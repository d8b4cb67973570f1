"""Reader of the live feed: next events by its policy, from the buffer or the journal.

A reader is a position, not a queue: a slow reader costs no memory. The next event is decided in
`cursors`; `FeedReader` waits for it, and recomputes frames in a thread, one reader after the other.

Frames that are no longer buffered are estimated again as they were live: with the live look-ahead,
the tare that was in force, and from the states that live had. So the bits are the same; those of a
backlog, which live has not seen, go on from the state before them. In front of the oldest state, as
before the server's start, models begin so many frames earlier that their initial state is
forgotten; which tare was in force before the start is known from the history, by the frames' times.
"""

from __future__ import annotations

import asyncio
import logging
from collections import deque
from collections.abc import AsyncGenerator, Callable, Iterator, Mapping

import numpy as np

from devices.errors import DamagedFramesError, FootTileError, StorageError
from devices.frames import ArrayInfo, FrameBatch
from service.estimation import LIVE_LAG_MS
from service.estimation.calibration import Calibration
from service.estimation.compilation import is_compiling
from service.estimation.pipeline.plan import compute_settling_time_s
from service.protocol.codec import CloseConnection, LinkCloseCode
from service.protocol.live import Policy
from service.server.estimates.live_estimator import STATE_PERIOD_NS, EstimateEpoch, make_live_plan
from service.server.estimates.node_estimator import EstimatedBatch
from service.server.live_feed.buffer import FeedBuffer, StreamView, wait_briefly_for_batch
from service.server.live_feed.cursors import QUEUE_NS, LosslessCursor, LossyCursor, Recompute
from service.server.live_feed.events import FeedEvent, FrameRows, Position, StreamStart, slice_batch
from service.server.node import ServerNode
from service.server.streams import ServerStream
from service.sessions.estimate_stream import EstimateOptions, EstimateRun, EstimateStream
from storage.intervals import Intervals

ROWS_AT_ONCE = 1024


class RecomputedFrames:
    """Recomputed frames of one stream from one number on: each is estimated once, in order.

    Created on the event loop; `next_rows` may run in another thread.

    Args:
        node: node of the stream.
        stream: stream with a journal.
        position: first frame.

    Raises:
        StorageError: the journal cannot be read.
    """

    def __init__(self, node: ServerNode, stream: ServerStream, position: Position) -> None:
        assert stream.journal is not None  # noqa: S101  # the caller holds a frame of it
        self.position = position
        """Next frame."""
        self._node, self._stream, self._journal = node, stream, stream.journal
        calibration = node.estimator.live.calibration
        if calibration is not None and not _is_compatible(calibration, stream.info, node.last_info):
            calibration = None
        self._calibration = calibration
        self._next_seq = self._find_first_seq()
        """Next frame to estimate."""
        self._last_fed: tuple[int, int] | None = None
        """Number and time of the last frame that was estimated."""
        self._run: EstimateRun | None = None
        self._extended_to: tuple[int, bool] | None = None
        self._frames: Iterator[FrameBatch] = iter(())
        self._epochs: deque[EstimateEpoch] = deque()
        """Epochs that begin behind the last estimated frame."""
        self._due_batches: deque[EstimatedBatch] = deque()
        """Estimated frames that are not returned yet."""

    def _find_first_seq(self) -> int:
        """Return the first frame to estimate: that of an epoch, or so early that models settle."""
        seq = self.position.seq
        recorded = self._node.estimator.epochs_since_server_start(self._stream.stream_id)
        epoch = next((each for each in reversed(recorded) if each.seq <= seq), None)
        if epoch is not None and epoch.state is not None:
            return epoch.seq
        t_ns = self._journal.find_batch_t_ns_near(seq, at_or_before=False)
        if t_ns is None:
            return seq
        if epoch is None:
            epoch = next(iter(self._list_epochs_before_start(t_ns, t_ns)), None)
        if epoch is None or epoch.calibration is None or epoch.tare is None:
            return seq
        plan = make_live_plan(self._stream.info, epoch.calibration, epoch.tare)
        # At least the time between two states: the initial one of an epoch counts as one of them.
        settling_ns = max(round(1e9 * compute_settling_time_s(plan)), STATE_PERIOD_NS)
        settled_seq = self._journal.find_first_batch_seq_since(t_ns - settling_ns)
        return seq if settled_seq is None else max(min(seq, settled_seq), epoch.seq)

    def extend(self, last_seq: int, *, is_final: bool) -> bool:
        """Go on to a number; all frames up to it are stored or lost.

        Args:
            last_seq: the number.
            is_final: True: no more frames will come; else frames that wait for their look-ahead go
                on waiting.

        Returns:
            False: it has gone on to there before.
        """
        if self._extended_to == (last_seq, is_final):
            return False
        self._extended_to = last_seq, is_final
        self._epochs = deque(filter(self._is_to_come, self._list_epochs(last_seq)))
        self._frames = self._journal.read_frames(self._next_seq, last_seq)
        return True

    def _is_to_come(self, epoch: EstimateEpoch) -> bool:
        if self._last_fed is None:
            return True
        seq, t_ns = self._last_fed
        return epoch.seq > seq if epoch.t_ns is None else epoch.t_ns >= t_ns

    def _list_epochs(self, last_seq: int) -> list[EstimateEpoch]:
        """Return the epochs from the next frame to estimate on, that of this frame first."""
        begin = self._next_seq
        recorded = self._node.estimator.epochs_since_server_start(self._stream.stream_id)
        before = [epoch for epoch in recorded if epoch.seq <= begin]
        if before:
            return recorded[len(before) - 1 :]
        until = max(begin, recorded[0].seq - 1) if recorded else last_seq
        t_ns = self._journal.find_batch_t_ns_near(begin, at_or_before=False)
        until_ns = self._journal.find_batch_t_ns_near(until, at_or_before=True)
        if t_ns is None or until_ns is None:
            return recorded
        return [*self._list_epochs_before_start(t_ns, until_ns), *recorded]

    def _list_epochs_before_start(self, begin_t_ns: int, end_t_ns: int) -> list[EstimateEpoch]:
        """Return the epochs before the server's start, by the history of tares."""
        tares = self._node.estimator.tare_history.tares_in_force_or_lost_between(
            self._stream.info, begin_t_ns, end_t_ns
        )
        return [EstimateEpoch(self._calibration, tare, t_ns=tare.t_ns) for tare in tares]

    def _estimate(self, frames: FrameBatch) -> Iterator[EstimatedBatch]:
        """Yield the frames that are due with these, with their estimates."""
        rest = frames
        while self._epochs and (count := self._epochs[0].count_rows_before(rest)) < len(rest):
            yield from self._feed_run(rest.slice_rows(0, count))
            rest = rest.slice_rows(count, len(rest))
            epoch = self._epochs.popleft()
            # A state has the frames that wait for their look-ahead, unless others came between.
            has_waiting = self._last_fed is not None and self._last_fed[0] == epoch.seen_seq
            if self._run is not None and not has_waiting:
                yield from self._run.flush()
            self._run = epoch.make_run(self._stream.info)
        yield from self._feed_run(rest)

    def _feed_run(self, frames: FrameBatch) -> Iterator[EstimatedBatch]:
        if not len(frames):
            return
        self._last_fed = int(frames.seq[-1]), int(frames.t_ns[-1])
        self._next_seq = self._last_fed[0] + 1
        if self._run is None:
            yield frames, {}
        else:
            yield from self._run.feed_frames(frames, {})

    def next_rows(self) -> EstimatedBatch | None:
        """Return the next due frames, at most `ROWS_AT_ONCE`; None: no more for now.

        Raises:
            DamagedFramesError: frames are damaged; the error has their numbers.
            FileFormatError: the journal has no frames of this stream.
            StorageError: it cannot be read.
        """
        while True:
            if not self._due_batches and not self._estimate_next_frames():
                return None
            frames, columns = self._due_batches.popleft()
            begin = int(np.searchsorted(frames.seq, self.position.seq))
            end = min(len(frames), begin + ROWS_AT_ONCE)
            # Return consecutive frames only.
            steps = np.flatnonzero(np.diff(frames.seq[begin:end]) != 1)
            if len(steps):
                end = begin + int(steps[0]) + 1
            if end < len(frames):
                self._due_batches.appendleft(slice_batch((frames, columns), end, len(frames)))
            if begin < end:
                self.position = Position(self.position.stream_id, int(frames.seq[end - 1]) + 1)
                return slice_batch((frames, columns), begin, end)

    def _estimate_next_frames(self) -> bool:
        """Estimate the next frames of the journal until some are due; return whether any are."""
        while not self._due_batches:
            frames = next(self._frames, None)
            if frames is None:
                _, is_final = self._extended_to or (0, False)
                if is_final and self._run is not None:
                    self._due_batches.extend(self._run.flush())
                return bool(self._due_batches)
            self._due_batches.extend(self._estimate(frames))
        return True

    def put_back(self, rows: EstimatedBatch) -> None:
        """Take back the rows that `next_rows` returned last; they are the next."""
        self._due_batches.appendleft(rows)
        self.position = Position(self.position.stream_id, int(rows[0].seq[0]))


def _is_compatible(calibration: Calibration, info: ArrayInfo, present: ArrayInfo) -> bool:
    """Return whether a stream can be estimated with the calibration of the node's present one."""
    if not info.has_same_tiles_as(present):
        return False
    try:  # its scene may name other models
        EstimateStream(info, EstimateOptions(calibration, info.models, LIVE_LAG_MS))
    except FootTileError:
        return False
    return True


log = logging.getLogger("foottile.live")


def check_stream_and_get_requested_position(
    node: ServerNode, stream_id: str | None, from_seq: int | None
) -> Position | None:
    """Return the first frame for a reader; None: the next one that comes.

    Raises:
        CloseConnection: no stream has this id.
    """
    if stream_id is None and from_seq is None:
        return None
    stream_id = node.stream_id if stream_id is None else stream_id
    if stream_id in node.unreadable_streams:
        node.retry_unreadable_journals()
    if stream_id not in node.streams and stream_id not in (
        *node.announced_stream_order,
        *node.unreadable_streams,
    ):
        raise CloseConnection(
            LinkCloseCode.NO_STREAM, f"no stream {stream_id[:32]!r} here; leave out stream_id"
        )
    if from_seq is None:
        stream = node.streams.get(stream_id)
        from_seq = (stream.stored.first if stream is not None else None) or 0
    return Position(stream_id, from_seq)


class FeedReader:
    """Reader of one node's frames.

    Args:
        node: the node.
        buffer: buffer of the node.
        policy: rule for dropping frames.
        position: first frame to send; None: the next one.
        needed_frames: returns the frames that sessions need of the node, by stream id.
        invalidate_damaged: called with frames that are damaged on disk.
    """

    def __init__(
        self,
        node: ServerNode,
        buffer: FeedBuffer,
        policy: Policy,
        position: Position | None,
        *,
        needed_frames: Callable[[], Mapping[str, Intervals]],
        invalidate_damaged: Callable[[DamagedFramesError], None],
    ) -> None:
        self._node = node
        self._buffer = buffer
        self._needed_frames = needed_frames
        self._invalidate_damaged = invalidate_damaged
        self._cursor: LosslessCursor | LossyCursor
        if policy == "lossless":
            self._cursor = LosslessCursor(buffer, self._find_stream, position)
        else:
            queue_ns = None if policy == "latest" else QUEUE_NS
            self._cursor = LossyCursor(buffer, self._find_stream, position, queue_ns)
        self._recomputed: RecomputedFrames | None = None
        self._request_without_rows: Recompute | None = None
        """Last request for which no frame was due."""

    async def iterate_events_until_closed(self) -> AsyncGenerator[FeedEvent, None]:
        """Yield events without end.

        Raises:
            CloseConnection: the reader cannot go on.
        """
        announced_id: str | None = None
        async with self._buffer.subscribe() as news:
            while True:
                news.clear()
                item = await self.next_event()
                if item is None:
                    await wait_briefly_for_batch(news)
                    continue
                if not isinstance(item, StreamStart) and item.stream_id != announced_id:
                    yield StreamStart(item.stream_id, item.first_seq)
                announced_id = item.stream_id
                yield item

    async def next_event(self) -> FeedEvent | None:
        """Return the next event; None: nothing yet.

        Raises:
            CloseConnection: the reader cannot go on.
        """
        while True:
            step = self._cursor.next_event()
            if not isinstance(step, Recompute):
                if isinstance(step, FrameRows):  # from the buffer
                    self._recomputed = None  # and so its journal is closed
                return step
            # During warm-up this would compile here. Frames not due wait for their look-ahead.
            if is_compiling() or step == self._request_without_rows:
                return None
            async with self._buffer.recompute_turn:
                step = self._cursor.next_event()  # frames may have come or gone meanwhile
                if not isinstance(step, Recompute):
                    return step
                rows = await self._recompute(step)
            if rows is not None:
                return rows

    def _find_stream(self, stream_id: str) -> StreamView | None:
        if stream_id in self._node.unreadable_streams:
            raise CloseConnection(
                LinkCloseCode.TRY_LATER, f"its journal cannot be read; {self._cursor.position}"
            )
        return StreamView.find_known(self._node, stream_id, self._needed_frames)

    async def _recompute(self, step: Recompute) -> FrameRows | None:
        """Return the next recomputed rows; None: the state has changed, or no frame is due."""
        position, stream = step.position, self._node.streams[step.position.stream_id]
        begins = self._recomputed is None or self._recomputed.position != position
        try:
            if self._recomputed is None or begins:
                self._recomputed = RecomputedFrames(self._node, stream, position)
            found = await asyncio.to_thread(self._recomputed.next_rows)
            if found is None and self._recomputed.extend(step.last_seq, is_final=step.is_final):
                found = await asyncio.to_thread(self._recomputed.next_rows)
        except DamagedFramesError as error:
            self._recomputed = None
            self._invalidate_damaged(error)
            if stream.stored & Intervals([(error.seq_first, error.seq_last)]):
                raise self._unreadable_error(position, error) from error
            return None
        except StorageError as error:
            log.warning("node %s, for a live client: %s", self._node.name, error)
            raise CloseConnection(
                LinkCloseCode.TRY_LATER, f"frames cannot be read now; {position}"
            ) from error
        except FootTileError as error:
            raise self._unreadable_error(position, error) from error
        if found is None:
            self._request_without_rows = step
            return None
        first, last = int(found[0].seq[0]), int(found[0].seq[-1])
        if first > position.seq:  # first the reader is told what lies between
            self._recomputed.put_back(found)
            if begins and stream.stored.restricted_to(position.seq, position.seq):
                raise self._unreadable_error(position, "a stored frame is not in its journal")
            return None
        if step.until_seq is not None and last >= step.until_seq:  # the buffer has the rest
            found = slice_batch(found, 0, step.until_seq - first)
        rows = FrameRows(position.stream_id, found, is_recomputed=True)
        self._cursor.position = Position(rows.stream_id, rows.last_seq + 1)
        return rows

    def _unreadable_error(self, at: Position, why: object) -> CloseConnection:
        log.warning("node %s, for a live client: %s", self._node.name, why)
        reason = f"frame {at.seq} cannot be read, see the server's log; {at}"
        return CloseConnection(LinkCloseCode.UNREADABLE, reason)
