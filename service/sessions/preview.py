"""Preview of unsealed sessions and its checkpoints: each frame is estimated once, on demand.

The estimator's state is in a scratch file, some ten thousand bytes every some thousand frames;
memory has only its place. So a slice costs the frames between it and the checkpoint before it, be
it at the beginning or hours later.

Frames come from the journals, so a restart of the server loses nothing of a preview, and a session
without viewers costs nothing. Estimates are as live, with the tares known now. They are
provisional: further frames and tares may come, and sealing uses a longer look-ahead.
"""

from __future__ import annotations

import io
import threading
import time
from bisect import bisect_left
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from devices.arrays import Columns
from devices.errors import FootTileError, StateError, StorageError
from devices.frames import FrameBatch
from service.estimation import LIVE_LAG_MS
from service.estimation.compilation import is_compiling
from service.sessions.estimate_stream import EstimateOptions, EstimateStream
from service.sessions.inputs import (
    SessionInputs,
    iterate_raw_frames_with_part,
    iterate_warm_up,
)
from service.sessions.overview import BinnedSlice
from storage.durable_files import ScratchBlock, ScratchFile
from storage.formats.slice import Slice
from storage.schema import Array
from storage.sessions.pyramid import (
    MAX_PREVIEW_BINS,
    BinBuilder,
    bin_source_columns,
    select_and_downsample_bins,
    shift_bins_to_axis,
)
from storage.sessions.warm_up import with_part_column

CHECKPOINT_FRAMES = 6144
"""Least distance between two checkpoints, in frames. Estimating so many frames of eight tiles takes
some 60 ms, with all models."""
CHECKPOINTS_MAX = 8192
"""Limit of checkpoints: beyond it every other one is dropped, and their distance doubled."""
_EVER_NS = 2**63 - 1


@dataclass(slots=True)
class Checkpoint:
    """Checkpoint, and facts of the frames from there on.

    Attributes:
        part: part of the next frame.
        seq: least number of the next frame.
        fed_frames: frames fed before.
        estimated_frames: frames estimated before; others wait for their look-ahead.
        newest_ns: greatest `t_ns` of the fed frames.
        last_estimated: part and `t_ns` of the last estimated frame; None: there is none.
        state: saved state of the estimator; None: initial state.
        begin_ns: least `t_ns` of the frames estimated from here to the next checkpoint.
        end_ns: greatest `t_ns` of these frames.
    """

    part: int = 0
    seq: int = 0
    fed_frames: int = 0
    estimated_frames: int = 0
    newest_ns: int = -_EVER_NS
    last_estimated: tuple[int, int] | None = None
    state: ScratchBlock | None = None
    begin_ns: int = _EVER_NS
    end_ns: int = -_EVER_NS


class ResumedStream(NamedTuple):
    """Stream of estimates at a checkpoint."""

    checkpoint_index: int
    stream: EstimateStream | None
    """None without estimates."""


class Checkpoints:
    """Checkpoints of one session, in order. One thread adds; any thread reads.

    Args:
        folder: folder on the disk for the scratch file.
    """

    def __init__(self, folder: Path) -> None:
        self.checkpoints: Sequence[Checkpoint] = (Checkpoint(),)
        """The first is the beginning. The sequence is replaced, never changed."""
        self.distance_frames = CHECKPOINT_FRAMES
        self._scratch = ScratchFile(folder)

    def extend_newest_span(self, t_ns: Array) -> None:
        """Extend the time span of the newest checkpoint by estimated frames."""
        newest = self.checkpoints[-1]
        newest.begin_ns = min(newest.begin_ns, int(t_ns.min()))
        newest.end_ns = max(newest.end_ns, int(t_ns.max()))

    def try_add_checkpoint(
        self, checkpoint: Checkpoint, state_if_estimated: Columns | None
    ) -> None:
        """Try to add a checkpoint; without effect if the disk is full.

        Args:
            checkpoint: checkpoint behind all present ones.
            state_if_estimated: state of the estimator; None without estimates.
        """
        if state_if_estimated is not None:
            content = io.BytesIO()
            np.savez(content, allow_pickle=False, **state_if_estimated)
            try:
                checkpoint.state = self._scratch.append(content.getvalue())
            except StorageError:  # a full disk is left to frames
                return
        found = [*self.checkpoints, checkpoint]
        if len(found) > CHECKPOINTS_MAX:
            for before, after in zip(found[::2], found[1::2], strict=False):
                before.begin_ns = min(before.begin_ns, after.begin_ns)
                before.end_ns = max(before.end_ns, after.end_ns)
            found, self.distance_frames = found[::2], 2 * self.distance_frames
        self.checkpoints = tuple(found)

    def truncate(self, count: int) -> None:
        """Remove all but the first checkpoints, and the time span of the last one."""
        newest = self.checkpoints[count - 1]
        newest.begin_ns, newest.end_ns = _EVER_NS, -_EVER_NS
        self.checkpoints = tuple(self.checkpoints[:count])

    def resume_stream_at_checkpoint_or_earlier(
        self, checkpoints: Sequence[Checkpoint], checkpoint_index: int, inputs: SessionInputs
    ) -> ResumedStream:
        """Resume estimates from a checkpoint, or from one before it if that cannot be read.

        Args:
            checkpoints: valid checkpoints.
            checkpoint_index: of the checkpoint to resume from, among `checkpoints`.
            inputs: inputs for which the checkpoints are valid.
        """
        stream = make_preview_stream(inputs)
        while stream is not None and (state := checkpoints[checkpoint_index].state) is not None:
            try:
                with np.load(io.BytesIO(self._scratch.read(state)), allow_pickle=False) as memory:
                    stream.load_state(dict(memory))
            except Exception:  # damaged bytes cause any error; the first checkpoint has no bytes
                checkpoint_index, stream = checkpoint_index - 1, make_preview_stream(inputs)
            else:
                break
        return ResumedStream(checkpoint_index, stream)


def make_preview_stream(inputs: SessionInputs) -> EstimateStream | None:
    """Return the estimate stream of an unsealed session; None without calibration or tare."""
    if inputs.calibration is None or not inputs.tares:
        return None
    options = EstimateOptions(
        inputs.calibration,
        inputs.info.models,
        LIVE_LAG_MS,
        tares=inputs.tares,
        unquantized=inputs.unquantized,
    )
    try:
        return EstimateStream(inputs.info, options)
    except FootTileError:  # a calibration of other tiles
        return None


UPDATE_BUDGET_S = 0.5
"""Time budget of one update; a long session is complete after several."""
_PREVIEWS_KEPT = 4
"""Number of sessions with a preview in memory."""
_REST_FACTOR = 10
"""Pause after repeated work, as a multiple of its time: late frames have those behind them
estimated again."""


class SessionPreview:
    """Estimates of one unsealed session up to some frame.

    Args:
        inputs: inputs of the session.
        folder: folder on the disk for states of estimators (`Checkpoints`).
    """

    def __init__(self, inputs: SessionInputs, folder: Path) -> None:
        self.checkpoints = Checkpoints(folder)
        self._inputs = inputs
        self._bins = BinBuilder(max_bins=MAX_PREVIEW_BINS)
        self._stream = make_preview_stream(inputs)
        self._position = Checkpoint()
        self._repeated_frames = 0
        """Number of frames that will be estimated a second time."""
        self._fed_before_rewind = 0
        """Number of frames that were fed before the last rewind."""
        self.repeated_work_s = 0.0
        """Time spent on repeated work."""
        self.is_catching_up = False
        """True if the journals have more frames."""

    @property
    def has_estimate_stream(self) -> bool:
        """True if there are estimates, not only raw counts."""
        return self._stream is not None

    def has_valid_beginning(self, inputs: SessionInputs) -> bool:
        """Return whether part of the preview is valid for these inputs."""
        before = self._inputs
        same = inputs.info == before.info and inputs.calibration == before.calibration
        tares = inputs.tares[: len(before.tares)]
        return (
            same
            and tares == before.tares
            and (make_preview_stream(inputs) is None) != self.has_estimate_stream
        )

    def valid_checkpoints(self, inputs: SessionInputs) -> list[Checkpoint]:
        """Return the checkpoints before any change: the beginning, and perhaps more."""
        checkpoints = self.checkpoints.checkpoints
        if not self.has_valid_beginning(inputs):
            return [Checkpoint()]
        count = bisect_left(checkpoints, True, key=lambda place: not self._is_valid(place, inputs))
        return list(checkpoints[: max(1, count)])

    def advance_within_time_limit(self, inputs: SessionInputs) -> None:
        """Estimate new frames for `UPDATE_BUDGET_S` at most; `inputs` have a valid beginning.

        Raises:
            FootTileError: a journal is damaged, or cannot be read.
        """
        if self.has_estimate_stream and is_compiling():  # else it would compile here
            self.is_catching_up = True
            return
        begun_s, is_again = time.monotonic(), self._position.fed_frames < self._fed_before_rewind
        if self._stream is not None and inputs.tares != self._inputs.tares:
            on = make_preview_stream(inputs)
            if on is not None and self._position.fed_frames:
                on.load_state(self._stream.state_dict())
            self._stream = on
        self._inputs = inputs
        self.is_catching_up = True
        for frames, columns in iterate_raw_frames_with_part(
            inputs, self._position.part, self._position.seq
        ):
            if time.monotonic() - begun_s >= UPDATE_BUDGET_S:
                break
            self._feed_frames(frames, columns)
        else:
            self.is_catching_up = False
        if is_again:
            self.repeated_work_s += time.monotonic() - begun_s

    def has_past_changed(self, inputs: SessionInputs) -> bool:
        """Return whether frames or tares before the present position have changed."""
        return not self._is_valid(self._position, inputs)

    def rewind_to_valid_checkpoint(self, inputs: SessionInputs) -> None:
        """Drop everything after the last valid checkpoint."""
        all_, true = self.checkpoints.checkpoints, self.valid_checkpoints(inputs)
        kept_frames = self._bins.truncate_to_full_bins_and_forget_seq(true[-1].estimated_frames)
        # Repeat one frame at least: its number shows whether the next one follows it.
        index = max(
            0, bisect_left(true, max(kept_frames, 1), key=lambda place: place.estimated_frames) - 1
        )
        index, self._stream = self.checkpoints.resume_stream_at_checkpoint_or_earlier(
            all_, index, inputs
        )
        self.checkpoints.truncate(index + 1)
        place = all_[index]
        self.reset_repeated_work_timer(self)
        self._position = replace(place, state=None, begin_ns=_EVER_NS, end_ns=-_EVER_NS)
        self._repeated_frames = kept_frames - place.estimated_frames
        self._inputs = inputs

    def reset_repeated_work_timer(self, previous: SessionPreview) -> None:
        """Reset the time of repeated work, which is measured up to another preview's position."""
        self._fed_before_rewind, self.repeated_work_s = previous._position.fed_frames, 0.0

    def get_bins(self, time_slice: Slice, min_bins: int) -> BinnedSlice:
        """Return a slice as about `min_bins` to four times as many bins; fewer of few frames.

        Raises:
            StateError: there is no frame yet.
            FootTileError: a journal is damaged, or cannot be read.
        """
        bins = self._bins.get_bins()
        if bins is None:
            raise StateError(
                f"session {self._inputs.session.id} has no frames yet", remedy="Ask again"
            )
        axis = self._inputs.compute_time_axis()
        bins = shift_bins_to_axis(bins, axis)
        begin_ns, end_ns = int(bins["t_first_ns"][0]), int(bins["t_last_ns"].max())
        found, count = select_and_downsample_bins(
            bins, *time_slice.compute_bounds_ns(begin_ns), 4 * min_bins
        )
        return BinnedSlice(found, count * self._bins.frames_in_bin, begin_ns, end_ns, axis)

    def _feed_frames(self, frames: FrameBatch, extra: Columns) -> None:
        position = self._position
        pieces = [(frames, extra)]
        due = (
            iter(pieces)
            if self._stream is None
            else self._stream.estimate_batches(
                pieces, warm_up=map(with_part_column, iterate_warm_up(self._inputs)), is_final=False
            )
        )
        names = bin_source_columns(has_estimates=self.has_estimate_stream)
        for estimated, columns in due:
            fields = {name: getattr(estimated, name) for name in names if name not in columns}
            fields |= {name: columns[name] for name in (*names, "part") if name in columns}
            repeated = min(self._repeated_frames, len(estimated))
            self._bins.add_frames(fields, already_added=repeated)
            self._repeated_frames -= repeated
            self.checkpoints.extend_newest_span(estimated.t_ns)
            position.estimated_frames += len(estimated)
            position.last_estimated = int(columns["part"][-1]), int(estimated.t_ns[-1])
        position.part, position.seq = int(extra["part"][-1]), int(frames.seq[-1]) + 1
        position.fed_frames += len(frames)
        position.newest_ns = max(position.newest_ns, int(frames.t_ns.max()))
        if (
            position.fed_frames - self.checkpoints.checkpoints[-1].fed_frames
            >= self.checkpoints.distance_frames
        ):
            self.checkpoints.try_add_checkpoint(
                replace(position), None if self._stream is None else self._stream.state_dict()
            )

    def _is_valid(self, checkpoint: Checkpoint, inputs: SessionInputs) -> bool:
        """Return whether nothing before a checkpoint has changed since."""
        tares = inputs.tares[len(self._inputs.tares) :]
        if any(tare.t_ns < checkpoint.newest_ns for tare in tares):
            return False
        stored_frames = 0
        for i, each in enumerate(inputs.session.parts[: checkpoint.part + 1]):
            journal = inputs.journals.get(each.stream_id)
            ends = [checkpoint.seq - 1] if i == checkpoint.part else []
            ends += [each.seq_last] if each.seq_last is not None else []
            last = min(ends, default=-1)
            if journal is not None and last >= each.seq_first:
                stored_frames += journal.stored.restricted_to(each.seq_first, last).number_count
        return stored_frames == checkpoint.fed_frames


class SessionPreviews:
    """Previews of unsealed sessions; only the most recently used are kept.

    Args:
        folder: folder on the disk for states of estimators.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._previews: OrderedDict[str, SessionPreview] = OrderedDict()
        self._retry_after_s: dict[str, float] = {}
        self._one_at_a_time = threading.Lock()

    def advance_preview_within_time_limit(self, inputs: SessionInputs) -> SessionPreview:
        """Estimate more of a session for a bounded time, and return its preview.

        Raises:
            FootTileError: a journal is damaged, or cannot be read.
        """
        with self._one_at_a_time:
            return self._advance_preview(inputs)

    def advance_unless_catching_up(self, inputs: SessionInputs) -> SessionPreview:
        """Return a session's preview; it is advanced first unless it is catching up.

        Raises:
            FootTileError: a journal is damaged, or cannot be read.
        """
        preview = self._previews.get(inputs.session.id)
        if preview is not None and preview.is_catching_up:
            return preview
        return self.advance_preview_within_time_limit(inputs)

    def discard(self, session_id: str) -> None:
        """Remove the preview of a session that is sealed or gone."""
        self._previews.pop(session_id, None)
        self._retry_after_s.pop(session_id, None)

    def _advance_preview(self, inputs: SessionInputs) -> SessionPreview:
        name = inputs.session.id
        preview = self._previews.get(name)
        if preview is None:
            preview = self._previews[name] = SessionPreview(inputs, self._folder)
        elif not preview.has_valid_beginning(inputs) or preview.has_past_changed(inputs):
            if time.monotonic() < self._retry_after_s.get(name, 0.0):
                return preview
            if preview.has_valid_beginning(inputs):
                preview.rewind_to_valid_checkpoint(inputs)
            else:
                before, preview = preview, SessionPreview(inputs, self._folder)
                preview.reset_repeated_work_timer(before)
                self._previews[name] = preview
        self._previews.move_to_end(name)
        while len(self._previews) > _PREVIEWS_KEPT:
            self.discard(next(iter(self._previews)))
        try:
            preview.advance_within_time_limit(inputs)
        except FootTileError:
            self.discard(name)
            raise
        self._retry_after_s[name] = time.monotonic() + _REST_FACTOR * preview.repeated_work_s
        return preview
