"""Frames that are no longer buffered, estimated again from the journal as they were live.

With the live look-ahead, and the tare that was in force. The recorded epochs of the server's own
estimates are repeated, so that the bits are the same, if the frames before were there then, too.
For the time before the server was started the history of tares says which tare was in force, by the
frames' times; models start so many frames earlier that their initial state is forgotten.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from devices.errors import FootTileError
from devices.frames import ArrayInfo, FrameBatch
from service.estimation import LIVE_LAG_MS
from service.estimation.calibration import Calibration
from service.estimation.pipeline.plan import compute_settling_time_s, make_plan
from service.estimation.tare.tare import Tare
from service.server.estimates.node_estimator import EstimatedBatch
from service.server.live_feed.events import Position, slice_batch
from service.server.node import ServerNode
from service.server.streams import ServerStream
from service.sessions.pipeline import EstimateOptions, EstimateRun, EstimateStream
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
        for each in node.estimator.epochs_of(stream.stream_id)
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
    tares = node.estimator.tare_history.tares_in_force_between(stream.info, t_ns, until_ns)
    return [*(EstimateInputsChange(calibration, tare, t_ns=tare.t_ns) for tare in tares), *recorded]
