"""Checkpoints of an unsealed session, from which its estimates can be resumed bit by bit.

The estimator's state is in a scratch file, some ten thousand bytes every some thousand frames;
memory has only its place. So a slice costs the frames between it and the checkpoint before it, be
it at the beginning or hours later.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from devices.errors import FootTileError, StorageError
from service.estimation import LIVE_LAG_MS
from service.sessions.frames import Columns
from service.sessions.inputs import SessionInputs
from service.sessions.pipeline import EstimateOptions, EstimateStream
from storage.durable_files import ScratchBlock, ScratchFile
from storage.schema import Array

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

    def resume_stream_at_or_before(
        self, checkpoints: Sequence[Checkpoint], index: int, inputs: SessionInputs
    ) -> ResumedStream:
        """Resume estimates from a checkpoint, or from one before it if that cannot be read.

        Args:
            checkpoints: valid checkpoints.
            index: index of the checkpoint.
            inputs: inputs for which the checkpoints are valid.
        """
        stream = make_preview_stream(inputs)
        while stream is not None and (state := checkpoints[index].state) is not None:
            try:
                with np.load(io.BytesIO(self._scratch.read(state)), allow_pickle=False) as memory:
                    stream.load_state(dict(memory))
            except Exception:  # damaged bytes cause any error; the first checkpoint has no bytes
                index, stream = index - 1, make_preview_stream(inputs)
            else:
                break
        return ResumedStream(index, stream)


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
