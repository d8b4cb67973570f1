"""Time range of a partial estimate: the frames to read, the warm-up and the output.

Models have state: rubber creep, gas temperature, temperature trend. They start before the part by
several times their longest time constant, so that the effect of earlier frames is small. State
without a time limit, such as open hysteresis loops and past faults, starts empty.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from devices.errors import UsageError
from devices.frames import FrameBatch
from service.estimation.pipeline.plan import EstimationPlan, compute_settling_time_s
from service.estimation.tare.tare import Tare
from service.sessions.pipeline import Extra
from storage.formats.slice import Slice
from storage.sessions.reader import SealedFileReader
from storage.sessions.time_axis import NODE_AXIS, TimeAxis

BatchWithColumns = tuple[FrameBatch, Extra]
_READ_MARGIN_NS = 1_000_000_000
"""Time read behind the part beyond the look-ahead: a frame may need its successor."""


@dataclass(frozen=True)
class EstimationRange:
    """Range of frames to read and to output; by default all.

    Attributes:
        run_from_ns: time from which models run, on the time axis; None: from the first frame.
        output_begin_ns: begin of the output; None: the session's first frame.
        output_end_ns: end of the output, exclusive; None: to the end.
        read_until_ns: end of the frames needed for the look-ahead, exclusive.
        row_groups: row groups to read; None: all.
        axis: the session's time axis.
    """

    run_from_ns: int | None = None
    output_begin_ns: int | None = None
    output_end_ns: int | None = None
    read_until_ns: int | None = None
    row_groups: tuple[int, ...] | None = None
    axis: TimeAxis = NODE_AXIS

    @property
    def warm_up_s(self) -> float | None:
        """Warm-up time of the models before the part; None: from the session's begin."""
        if self.run_from_ns is None or self.output_begin_ns is None:
            return None
        return (self.output_begin_ns - self.run_from_ns) * 1e-9

    def select_needed(self, pieces: Iterable[BatchWithColumns]) -> Iterator[BatchWithColumns]:
        """Yield the frames that models run over."""
        return self._select_time_range(pieces, self.run_from_ns, self.read_until_ns)

    def select_output(self, pieces: Iterable[BatchWithColumns]) -> Iterator[BatchWithColumns]:
        """Yield the output frames."""
        return self._select_time_range(pieces, self.output_begin_ns, self.output_end_ns)

    def _select_time_range(
        self, pieces: Iterable[BatchWithColumns], begin_ns: int | None, end_ns: int | None
    ) -> Iterator[BatchWithColumns]:
        for frames, columns in pieces:
            at_ns = self.axis.shift_to_axis(frames.t_ns, columns.get("part"))
            inside = np.ones(len(frames), dtype=np.bool_)
            if begin_ns is not None:
                inside &= at_ns >= begin_ns
            if end_ns is not None:
                inside &= at_ns < end_ns
            if inside.all():
                yield frames, columns
            elif inside.any():
                yield frames.select_rows(inside), {name: v[inside] for name, v in columns.items()}


def compute_estimation_range(
    session: SealedFileReader, part: Slice, plan: EstimationPlan
) -> EstimationRange:
    """Compute the range to read for the estimate of a part of a session.

    Args:
        session: the session.
        part: time range; its columns are ignored.
        plan: constants of the estimate.

    Raises:
        UsageError: the part begins after the session's end.
        FileFormatError: the file is damaged.
    """
    first_ns, last_ns = session.read_span_ns()
    begin_ns, end_ns = part.compute_bounds_ns(first_ns)
    if begin_ns is not None and begin_ns > last_ns:
        raise UsageError(
            f"--start-s {part.start_s:g}: the session ends at {(last_ns - first_ns) * 1e-9:.3f} s",
            expected="a start before the session's end",
        )
    from_ns = None if begin_ns is None else begin_ns - round(1e9 * compute_settling_time_s(plan))
    if from_ns is not None and from_ns <= first_ns:
        from_ns = None
    until_ns = None if end_ns is None else end_ns + plan.lag_ns + _READ_MARGIN_NS
    groups = tuple(session.find_overlapping_row_groups(from_ns, until_ns))
    return EstimationRange(from_ns, begin_ns, end_ns, until_ns, groups, session.time_axis)


def select_tares_in_force(tares: Sequence[Tare], from_ns: int | None) -> tuple[Tare, ...]:
    """Return the tares in force from a time on, oldest first; None: all tares."""
    if from_ns is None:
        return tuple(tares)
    over = sum(later.t_ns < from_ns for _, later in pairwise(tares))
    return tuple(tares[over:])
