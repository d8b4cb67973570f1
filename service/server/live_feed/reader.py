"""Reader of the live feed: next events by its policy, from the buffer or the journal.

A reader is a position, not a queue: a slow reader costs no memory. The next event is decided in
`cursors`; `FeedReader` waits for it, and recomputes frames in a thread, one reader after the other.

Frames that are no longer buffered are estimated again as they were live: with the live look-ahead,
and the tare that was in force. The recorded epochs of the server's own estimates are repeated, so
that the bits are the same, if the frames before were there then, too. For the time before the
server was started the history of tares says which tare was in force, by the frames' times; models
start so many frames earlier that their initial state is forgotten.
"""

from __future__ import annotations

import asyncio
import logging
from collections import deque
from collections.abc import AsyncGenerator, Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from devices.errors import DamagedFramesError, FootTileError, StorageError
from devices.frames import ArrayInfo, FrameBatch
from service.estimation import LIVE_LAG_MS
from service.estimation.calibration import Calibration
from service.estimation.compilation import is_compiling
from service.estimation.pipeline.plan import compute_settling_time_s, make_plan
from service.estimation.tare.tare import Tare
from service.protocol.codec import CloseConnection, LinkCloseCode
from service.protocol.live import Policy
from service.server.estimates.node_estimator import EstimatedBatch
from service.server.live_feed.buffer import (
    FeedBuffer,
    ServerStreamView,
    StreamView,
    wait_briefly_for_batch,
)
from service.server.live_feed.cursors import QUEUE_NS, LosslessCursor, LossyCursor, Recompute
from service.server.live_feed.events import FeedEvent, FrameRows, Position, StreamStart, slice_batch
from service.server.node import ServerNode
from service.server.streams import ServerStream
from service.sessions.pipeline import EstimateOptions, EstimateRun, EstimateStream
from storage.intervals import Intervals
from storage.journal.journal import Journal

ROWS_AT_ONCE = 1024


@dataclass(frozen=True)
class EstimateInputsChange:
    """Change of calibration or tare; without both, frames are not estimated.

    Attributes:
        calibration: calibration in use from here on.
        tare: tare in force from here on.
        seq: first frame of the change.
        t_ns: or time after which it is in force, node's UTC.
    """

    calibration: Calibration | None
    tare: Tare | None
    seq: int | None = None
    t_ns: int | None = None

    def count_rows_before(self, frames: FrameBatch) -> int:
        """Return the number of frames before the change."""
        if self.seq is not None:
            return int(np.searchsorted(frames.seq, self.seq, side="left"))
        return 0 if self.t_ns is None else int(np.searchsorted(frames.t_ns, self.t_ns, "right"))


def estimate_again(
    batches: Iterable[FrameBatch],
    info: ArrayInfo,
    changes: Iterable[EstimateInputsChange],
    *,
    is_final: bool,
) -> Iterator[EstimatedBatch]:
    """Yield frames with their estimates, each once, in order.

    Args:
        batches: frames of one stream, in order.
        info: array of the stream.
        changes: changes of calibration and tare, in order; frames before the first are not
            estimated.
        is_final: True: no more frames will come; else frames that wait for their look-ahead are
            left out.
    """
    run: EstimateRun | None = None
    to_come = deque(changes)
    for frames in batches:
        rest = frames
        while to_come and (count := to_come[0].count_rows_before(rest)) < len(rest):
            if count:
                yield from _feed_run(run, rest.slice_rows(0, count))
                rest = rest.slice_rows(count, len(rest))
            if run is not None:
                yield from run.flush()
            run = _make_run(info, to_come.popleft())
        if len(rest):
            yield from _feed_run(run, rest)
    if is_final and run is not None:
        yield from run.flush()


def _make_run(info: ArrayInfo, change: EstimateInputsChange) -> EstimateRun | None:
    calibration, tare = change.calibration, change.tare
    if calibration is None or tare is None:
        return None
    plan = make_plan(info, calibration, tare, models=info.models, lag_ms=LIVE_LAG_MS)
    return EstimateRun(plan)


def _feed_run(run: EstimateRun | None, frames: FrameBatch) -> Iterator[EstimatedBatch]:
    if run is None:
        yield frames, {}
    else:
        yield from run.feed_frames(frames, {})


class RecomputedFrames:
    """Recomputed frames of one stream from one number on, up to the journal's present end.

    Created on the event loop; `next_rows` may run in another thread.

    Args:
        node: node of the stream.
        stream: stream with a journal.
        position: first frame.
        is_final: True: no more frames of this stream will come.

    Raises:
        StorageError: the journal cannot be read.
    """

    def __init__(
        self, node: ServerNode, stream: ServerStream, position: Position, *, is_final: bool
    ) -> None:
        assert stream.journal is not None  # noqa: S101  # the caller holds a frame of it
        self._journal: Journal = stream.journal
        self.position = position
        """Next frame."""
        calibration = node.estimator.live.calibration
        if calibration is not None and not _is_compatible(calibration, stream.info, node.last_info):
            calibration = None
        last = self._journal.stored.last or 0
        begin = self._first_model_seq(node, stream, calibration, position.seq)
        self._pieces = estimate_again(
            self._journal.read_frames(begin, last),
            stream.info,
            _list_changes(node, stream, calibration, begin, last),
            is_final=is_final,
        )
        self._rest: EstimatedBatch | None = None

    def _first_model_seq(
        self, node: ServerNode, stream: ServerStream, calibration: Calibration | None, seq: int
    ) -> int:
        """Return the number of the frame with which models start."""
        t_ns = self._journal.find_batch_t_ns_near(seq, at_or_before=False)
        tare = node.estimator.tare_history.tare_in_force_or_lost(stream.info)
        if calibration is None or tare is None or t_ns is None:
            return seq
        plan = make_plan(
            stream.info, calibration, tare, models=stream.info.models, lag_ms=LIVE_LAG_MS
        )
        since = self._journal.find_first_batch_seq_since(
            t_ns - round(1e9 * compute_settling_time_s(plan))
        )
        return seq if since is None else min(seq, since)

    def next_rows(self) -> EstimatedBatch | None:
        """Return the next due frames, at most `ROWS_AT_ONCE`; None: no more for now.

        Raises:
            DamagedFramesError: frames are damaged; the error has their numbers.
            FileFormatError: the journal has no frames of this stream.
            StorageError: it cannot be read.
        """
        while True:
            rest, self._rest = self._rest, None
            frames, columns = rest if rest is not None else next(self._pieces, (None, {}))
            if frames is None:
                return None
            begin = int(np.searchsorted(frames.seq, self.position.seq))
            end = min(len(frames), begin + ROWS_AT_ONCE)
            # Return consecutive frames only.
            steps = np.flatnonzero(np.diff(frames.seq[begin:end]) != 1)
            if len(steps):
                end = begin + int(steps[0]) + 1
            if end < len(frames):
                self._rest = slice_batch((frames, columns), end, len(frames))
            if begin < end:
                self.position = Position(self.position.stream_id, int(frames.seq[end - 1]) + 1)
                return slice_batch((frames, columns), begin, end)


def _is_compatible(calibration: Calibration, info: ArrayInfo, present: ArrayInfo) -> bool:
    """Return whether a stream can be estimated with the calibration of the node's present one."""
    if not info.has_same_tiles_as(present):
        return False
    try:  # its scene may name other models
        EstimateStream(info, EstimateOptions(calibration, info.models, LIVE_LAG_MS))
    except FootTileError:
        return False
    return True


def _list_changes(
    node: ServerNode,
    stream: ServerStream,
    calibration: Calibration | None,
    begin: int,
    last: int,
) -> list[EstimateInputsChange]:
    """Return the changes of calibration and tare within these frames, in order."""
    recorded = [
        EstimateInputsChange(each.calibration, each.tare, seq=each.seq)
        for each in node.estimator.epochs_since_server_start(stream.stream_id)
    ]
    before = [change for change in recorded if change.seq is not None and change.seq <= begin]
    if before:  # this server has estimated all of these frames
        return recorded[len(before) - 1 :]
    journal = stream.journal
    if journal is None:
        return recorded
    until = last if not recorded or recorded[0].seq is None else max(begin, recorded[0].seq - 1)
    t_ns = journal.find_batch_t_ns_near(begin, at_or_before=False)
    until_ns = journal.find_batch_t_ns_near(until, at_or_before=True)
    if t_ns is None or until_ns is None:
        return recorded
    tares = node.estimator.tare_history.tares_in_force_or_lost_between(stream.info, t_ns, until_ns)
    return [*(EstimateInputsChange(calibration, tare, t_ns=tare.t_ns) for tare in tares), *recorded]


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
        self._request: Recompute | None = None
        """Request for which `_recomputed` was created."""
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
        return ServerStreamView.find_known(self._node, stream_id, self._needed_frames)

    async def _recompute(self, step: Recompute) -> FrameRows | None:
        """Return the next recomputed rows; None: the state has changed, or no frame is due."""
        position, stream = step.position, self._node.streams[step.position.stream_id]
        begins = self._recomputed is None or self._recomputed.position != position
        try:
            if self._recomputed is None or begins:
                self._recomputed = RecomputedFrames(
                    self._node, stream, position, is_final=step.is_final
                )
                self._request = step
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
        if found is None:  # the journal's end at creation is reached
            self._recomputed, self._request_without_rows = None, self._request
            return None
        first, last = int(found[0].seq[0]), int(found[0].seq[-1])
        if first > position.seq:
            self._recomputed = None
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
