"""Frames of an unsealed session with their estimates: a slice, or all.

The cost of a slice does not depend on its place, up to the newest checkpoint. A frame's estimate
does not depend on the slice: it is that of one run over all present frames.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import chain
from typing import Any

from devices.arrays import Columns
from devices.errors import UsageError
from devices.frames import FrameBatch
from service.sessions.inputs import (
    SessionInputs,
    iterate_raw_frames_with_part,
    iterate_warm_up,
)
from service.sessions.preview import SessionPreview
from storage.formats.export import FrameSource, make_one_pass_frame_source
from storage.formats.slice import Slice
from storage.intervals import NO_END
from storage.schema import ROUNDING_STEP_KEY
from storage.sessions.time_axis import NODE_AXIS
from storage.sessions.warm_up import with_part_column

Pieces = Iterator[tuple[FrameBatch, Columns]]


class PreviewFrames:
    """Slice of an unsealed session.

    Args:
        preview: preview of the session.
        inputs: present inputs.
        time_slice: time interval.

    Attributes:
        notes: file metadata of the estimates; known after `make_one_pass_source`.
    """

    def __init__(self, preview: SessionPreview, inputs: SessionInputs, time_slice: Slice) -> None:
        self.notes: dict[str, Any] = {}
        self._checkpoints = preview.checkpoints
        self._valid_checkpoints = preview.valid_checkpoints(inputs)
        self._inputs = inputs
        self._time_slice = time_slice
        self._axis = NODE_AXIS

    def make_one_pass_source(self) -> FrameSource:
        """Return the frames, with estimates if there are any; reads the first ones.

        Raises:
            UsageError: there are no frames.
        """
        first = next(iterate_raw_frames_with_part(self._inputs), None)
        if first is None:
            raise UsageError("the session has no frames")
        self._axis = self._inputs.compute_time_axis()
        span_ns = int(first[0].t_ns[0]), self._latest_ns()
        begin_ns, end_ns = self._time_slice.compute_bounds_ns(span_ns[0])
        legs = self._find_ranges(begin_ns, end_ns)
        pieces = chain.from_iterable(self._iterate_range(*leg, end_ns) for leg in legs)
        some = next(pieces, None)
        if some is None:  # no frame in the interval: use the columns of the first ones
            some = next(self._iterate_range(0, 1, None))
        return make_one_pass_frame_source(chain((some,), pieces), span_ns, self._axis)

    def _find_ranges(self, begin_ns: int | None, end_ns: int | None) -> list[tuple[int, int]]:
        """Return the ranges of checkpoints with frames of an interval; the last one is open."""
        newest = len(self._valid_checkpoints) - 1
        wanted = [
            index
            for index, place in enumerate(self._valid_checkpoints[:newest])
            if place.estimated_frames < self._valid_checkpoints[index + 1].estimated_frames
            and self._axis.may_overlap(place.begin_ns, place.end_ns, begin_ns, end_ns)
        ]
        last = self._valid_checkpoints[newest].last_estimated
        # Frames without an estimate are newer than the last one with one, or of a later part.
        if end_ns is None or last is None or self._may_be_before(*last, end_ns):
            wanted.append(newest)
        legs: list[tuple[int, int]] = []
        for index in wanted:
            begin = legs.pop()[0] if legs and legs[-1][1] == index else index
            legs.append((begin, index + 1))
        return legs

    def _iterate_range(self, begin: int, end: int, end_ns: int | None) -> Pieces:
        """Yield the frames between two checkpoints, with estimates, up to an end time."""
        places = self._valid_checkpoints
        end_count = places[end].estimated_frames if end < len(places) else NO_END
        start, stream = self._checkpoints.resume_stream_at_checkpoint_or_earlier(
            places, begin, self._inputs
        )
        ahead, count = (
            places[begin].estimated_frames - places[start].estimated_frames,
            end_count - places[start].estimated_frames,
        )
        pieces: Pieces = iterate_raw_frames_with_part(
            self._inputs, places[start].part, places[start].seq
        )
        if stream is not None:
            pieces = stream.estimate_batches(
                pieces, warm_up=map(with_part_column, iterate_warm_up(self._inputs))
            )
        for frames, columns in pieces:
            if stream is not None and not self.notes:
                self.notes = {ROUNDING_STEP_KEY: stream.rounding.collect_flat_column_steps()}
            rows = slice(ahead, min(count, len(frames)))
            ahead, count = max(0, ahead - len(frames)), count - len(frames)
            if rows.start < rows.stop:
                whole = rows.stop - rows.start == len(frames)
                yield (frames, columns) if whole else _slice_rows(frames, columns, rows)
            part = int(columns["part"][-1])
            if count <= 0:
                return
            if end_ns is not None and not self._may_be_before(part, int(frames.t_ns[-1]), end_ns):
                return

    def _may_be_before(self, part: int, t_ns: int, end_ns: int) -> bool:
        """Return whether a frame, or a later one, may be before a time of the time axis."""
        return min(t_ns + self._axis.get_shift_ns(part), self._lower_bound_ns(part + 1)) < end_ns

    def _lower_bound_ns(self, number: int) -> int:
        """Return a lower bound of times in this and later parts, on the time axis."""
        begins = [
            t_ns + self._axis.get_shift_ns(index)
            for index, part in enumerate(self._inputs.session.parts)
            if index >= number
            and (journal := self._inputs.journals.get(part.stream_id)) is not None
            and (t_ns := journal.find_batch_t_ns_near(part.seq_first, at_or_before=False))
            is not None
        ]
        return min(begins, default=NO_END)

    def _latest_ns(self) -> int:
        """Return the time of the newest frame on the time axis."""
        latest = -NO_END
        for number, part in enumerate(self._inputs.session.parts):
            journal = self._inputs.journals.get(part.stream_id)
            end = NO_END if part.seq_last is None else part.seq_last
            last = (
                None if journal is None else journal.stored.restricted_to(part.seq_first, end).last
            )
            if journal is not None and last is not None:
                shift_ns = self._axis.get_shift_ns(number)
                ends_ns = (int(f.t_ns[-1]) + shift_ns for f in journal.read_frames(last, last))
                latest = max(latest, *ends_ns)
        return latest


def _slice_rows(frames: FrameBatch, columns: Columns, rows: slice) -> tuple[FrameBatch, Columns]:
    cut = {name: values[rows] for name, values in columns.items()}
    return frames.slice_rows(rows.start, rows.stop), cut
