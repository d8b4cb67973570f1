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
from service.estimation.ladder.plan import EstimationPlan, warm_up_s
from service.estimation.tare.tare import Tare
from service.sessions.pipeline import Extra
from storage.formats.slice import Slice
from storage.sessions.reader import SessionReader
from storage.sessions.time_axis import NODE_AXIS, TimeAxis

Piece = tuple[FrameBatch, Extra]
_SETTLE_NS = 1_000_000_000
"""Time read behind the part beyond the look-ahead: a frame may need its successor."""


@dataclass(frozen=True)
class Stretch:
    """Range of frames to read and to output; by default all.

    Attributes:
        from_ns: time from which models run, on the time axis; None: from the first frame.
        begin_ns: begin of the output; None: the session's first frame.
        end_ns: end of the output, exclusive; None: to the end.
        until_ns: end of the frames needed for the look-ahead, exclusive.
        groups: row groups to read; None: all.
        axis: the session's time axis.
    """

    from_ns: int | None = None
    begin_ns: int | None = None
    end_ns: int | None = None
    until_ns: int | None = None
    groups: tuple[int, ...] | None = None
    axis: TimeAxis = NODE_AXIS

    @property
    def warm_up_s(self) -> float | None:
        """Warm-up time of the models before the part; None: from the session's begin."""
        if self.from_ns is None or self.begin_ns is None:
            return None
        return (self.begin_ns - self.from_ns) * 1e-9

    def needed(self, pieces: Iterable[Piece]) -> Iterator[Piece]:
        """Yield the frames that models run over."""
        return self._within(pieces, self.from_ns, self.until_ns)

    def given(self, pieces: Iterable[Piece]) -> Iterator[Piece]:
        """Yield the output frames."""
        return self._within(pieces, self.begin_ns, self.end_ns)

    def _within(
        self, pieces: Iterable[Piece], begin_ns: int | None, end_ns: int | None
    ) -> Iterator[Piece]:
        for frames, columns in pieces:
            at_ns = self.axis.at(frames.t_ns, columns.get("part"))
            inside = np.ones(len(frames), dtype=np.bool_)
            if begin_ns is not None:
                inside &= at_ns >= begin_ns
            if end_ns is not None:
                inside &= at_ns < end_ns
            if inside.all():
                yield frames, columns
            elif inside.any():
                yield frames.select(inside), {name: v[inside] for name, v in columns.items()}


def stretch_of(session: SessionReader, part: Slice, plan: EstimationPlan) -> Stretch:
    """Compute the range to read for the estimate of a part of a session.

    Args:
        session: the session.
        part: time range; its columns are ignored.
        plan: constants of the estimate.

    Raises:
        UsageError: the part begins after the session's end.
        FileFormatError: the file is damaged.
    """
    first_ns, last_ns = session.span_ns()
    begin_ns, end_ns = part.bounds_ns(first_ns)
    if begin_ns is not None and begin_ns > last_ns:
        raise UsageError(
            f"--start-s {part.start_s:g}: the session ends at {(last_ns - first_ns) * 1e-9:.3f} s",
            expected="a start before the session's end",
        )
    from_ns = None if begin_ns is None else begin_ns - round(1e9 * warm_up_s(plan))
    if from_ns is not None and from_ns <= first_ns:
        from_ns = None
    until_ns = None if end_ns is None else end_ns + plan.lag_ns + _SETTLE_NS
    groups = tuple(session.groups_within(from_ns, until_ns))
    return Stretch(from_ns, begin_ns, end_ns, until_ns, groups, session.axis)


def since(tares: Sequence[Tare], from_ns: int | None) -> tuple[Tare, ...]:
    """Return the tares in force from a time on, oldest first; None: all tares."""
    if from_ns is None:
        return tuple(tares)
    over = sum(later.t_ns < from_ns for _, later in pairwise(tares))
    return tuple(tares[over:])
