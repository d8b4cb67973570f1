"""Frames of a session with their estimates; raw frames where the estimator is not installed.

They are sealed, and exported as CSV or Arrow from a session that is still recorded or pending. Only
here does a node use the estimator: it seals, and so does `foottile recover`, where neither numba
nor scipy is installed.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from devices.errors import FootTileError, require_extra
from devices.frames import FrameBatch
from service.estimation import OFFLINE_LAG_MS
from service.sessions.inputs import SessionInputs

Columns = Mapping[str, npt.NDArray[Any]]

TARE_LOST = (
    "a tare is damaged and lost: where it may have been in force, forces are not known (bit 512 of "
    "estimate_flags)"
)


class SessionFrames:
    """Frames of a session, with the column `part` and, where possible, estimates.

    After the first frames, `notes` has the file's metadata of the estimates, and `problem` the
    reason why there are none, or not for all frames.
    """

    def __init__(self, inputs: SessionInputs) -> None:
        self.notes: dict[str, Any] = {}
        self.problem: str | None = None
        self._inputs = inputs

    def __iter__(self) -> Iterator[tuple[FrameBatch, Columns]]:
        if self._inputs.calibration is None:
            self._note_no_estimates(self._inputs.problem)
            yield from self.iterate_raw_with_part()
            return
        try:
            pieces = self._iterate_estimated()
            first = next(pieces, None)
        except FootTileError as error:  # no tare, a calibration of other tiles, no estimator
            self._note_no_estimates(error)
            yield from self.iterate_raw_with_part()
            return
        if first is not None:
            yield first
            yield from pieces

    def _iterate_estimated(self) -> Iterator[tuple[FrameBatch, Columns]]:
        sources = self._inputs
        with require_extra("server", "the estimator", remedy=_REMEDY):
            from service.sessions.pipeline import (
                EstimateOptions,
                EstimateStream,
                make_estimate_metadata,
            )
        assert sources.calibration is not None  # noqa: S101  # or there is nothing to estimate with
        options = EstimateOptions(
            sources.calibration,
            sources.info.models,
            OFFLINE_LAG_MS,
            tares=sources.tares,
            unquantized=sources.unquantized,
        )
        stream = EstimateStream(sources.info, options)
        for frames, columns in stream.estimate_batches(self.iterate_raw_with_part()):
            if not self.notes and stream.plan is not None:
                self.notes = make_estimate_metadata(stream.plan, stream.rounding, sources.tares)
                if any(tare.is_lost for tare in sources.tares):
                    self.problem = TARE_LOST
            yield frames, columns

    def _note_no_estimates(self, reason: object) -> None:
        """Note why there are no estimates, and what `foottile estimate` needs to add them."""
        calibration, tares = self._inputs.calibration, self._inputs.tares
        self.problem = f"no estimates: {reason}"
        self.notes = {"estimates": self.problem}
        if calibration is not None:
            self.notes["calibration"] = calibration.model_dump(mode="json")
        if tares:
            self.notes["tares"] = [tare.as_dict() for tare in tares]

    def iterate_raw_with_part(self) -> Iterator[tuple[FrameBatch, Columns]]:
        """Yield frames with the column `part` only."""
        return iterate_raw_frames_with_part(self._inputs)


def iterate_raw_frames_with_part(
    inputs: SessionInputs, first_part: int = 0, first_seq: int = 0
) -> Iterator[tuple[FrameBatch, Columns]]:
    """Yield frames from the journals in order, with the column `part` only.

    Args:
        inputs: inputs of the session.
        first_part: number of the first part.
        first_seq: frames of this part before this number are left out.
    """
    for i, part in list(enumerate(inputs.session.parts))[first_part:]:
        journal = inputs.journals.get(part.stream_id)
        first = max(first_seq, part.seq_first) if i == first_part else part.seq_first
        last = journal.stored.last if journal is not None else None
        last = part.seq_last if part.seq_last is not None else last
        if journal is None or last is None or last < first:
            continue
        for batch in journal.read_frames(first, last):
            if len(batch):
                yield batch, {"part": np.full(len(batch), i, dtype=np.uint16)}


_REMEDY = "`foottile estimate` adds them where foottile[server] is installed"
