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

import numpy as np

from devices.errors import FootTileError, StorageError
from service.estimation import LIVE_LAG_MS
from service.sessions.pipeline import Columns, EstimateOptions, EstimateStream
from service.sessions.sources import Sources
from storage.schema import Array
from storage.scratch import Kept, Scratch

EVERY = 6144
"""Least distance between two checkpoints, in frames. Estimating so many frames of eight tiles takes
some 60 ms, with all models."""
MOST = 8192
"""Limit of checkpoints: beyond it every other one is dropped, and their distance doubled."""
_EVER_NS = 2**63 - 1


@dataclass(slots=True)
class Milestone:
    """Checkpoint, and facts of the frames from there on.

    Attributes:
        part: part of the next frame.
        seq: least number of the next frame.
        taken: frames fed before.
        left: frames estimated before; others wait for their look-ahead.
        newest_ns: greatest `t_ns` of the fed frames.
        last: part and `t_ns` of the last estimated frame; None: there is none.
        kept: saved state of the estimator; None: initial state.
        begin_ns: least `t_ns` of the frames estimated from here to the next checkpoint.
        end_ns: greatest `t_ns` of these frames.
    """

    part: int = 0
    seq: int = 0
    taken: int = 0
    """frames fed before."""
    left: int = 0
    """frames estimated before; others wait for their look-ahead."""
    newest_ns: int = -_EVER_NS
    last: tuple[int, int] | None = None
    """part and `t_ns` of the last estimated frame; None: there is none."""
    kept: Kept | None = None
    """saved state of the estimator; None: initial state."""
    begin_ns: int = _EVER_NS
    end_ns: int = -_EVER_NS


class Milestones:
    """Checkpoints of one session, in order. One thread adds; any thread reads.

    Args:
        folder: folder on the disk for the scratch file.
    """

    def __init__(self, folder: Path) -> None:
        self.all: Sequence[Milestone] = (Milestone(),)
        """The first is the beginning. The sequence is replaced, never changed."""
        self.every = EVERY
        self._scratch = Scratch(folder)

    def note(self, t_ns: Array) -> None:
        """Extend the time span of the newest checkpoint by estimated frames."""
        newest = self.all[-1]
        newest.begin_ns = min(newest.begin_ns, int(t_ns.min()))
        newest.end_ns = max(newest.end_ns, int(t_ns.max()))

    def add(self, place: Milestone, memory: Columns | None) -> None:
        """Add a checkpoint; without effect if the disk is full.

        Args:
            place: checkpoint behind all present ones.
            memory: state of the estimator; None without estimates.
        """
        if memory is not None:
            content = io.BytesIO()
            np.savez(content, allow_pickle=False, **memory)
            try:
                place.kept = self._scratch.put(content.getvalue())
            except StorageError:  # a full disk is left to frames
                return
        found = [*self.all, place]
        if len(found) > MOST:
            for before, after in zip(found[::2], found[1::2], strict=False):
                before.begin_ns = min(before.begin_ns, after.begin_ns)
                before.end_ns = max(before.end_ns, after.end_ns)
            found, self.every = found[::2], 2 * self.every
        self.all = tuple(found)

    def go_back(self, count: int) -> None:
        """Remove all but the first checkpoints, and the time span of the last one."""
        newest = self.all[count - 1]
        newest.begin_ns, newest.end_ns = _EVER_NS, -_EVER_NS
        self.all = tuple(self.all[:count])

    def stream_at(
        self, places: Sequence[Milestone], at: int, sources: Sources
    ) -> tuple[int, EstimateStream | None]:
        """Resume estimates from a checkpoint, or from one before it if that cannot be read.

        Args:
            places: valid checkpoints.
            at: index of the checkpoint.
            sources: inputs for which the checkpoints are valid.

        Returns:
            Index of the checkpoint used; and the stream, None without estimates.
        """
        stream = stream_of(sources)
        while stream is not None and (state := places[at].kept) is not None:
            try:
                with np.load(io.BytesIO(self._scratch.get(state)), allow_pickle=False) as memory:
                    stream.go_on(dict(memory))
            except Exception:  # damaged bytes cause any error; the first checkpoint has no bytes
                at, stream = at - 1, stream_of(sources)
            else:
                break
        return at, stream


def stream_of(sources: Sources) -> EstimateStream | None:
    """Return the estimate stream of an unsealed session; None without calibration or tare."""
    if sources.calibration is None or not sources.tares:
        return None
    options = EstimateOptions(
        sources.calibration,
        sources.info.models,
        LIVE_LAG_MS,
        tares=sources.tares,
        exact=sources.exact,
    )
    try:
        return EstimateStream(sources.info, options)
    except FootTileError:  # a calibration of other tiles
        return None
