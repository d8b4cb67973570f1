"""A part of a session to estimate: what is read for it, and from when on models have to run.

Models remember: what the rubber has crept, what the gas has cooled, how the temperature went. So
they begin before the part, by several times their longest time constant, and what they then have
forgotten of the time before is small. What lasts without limit - loops of the rubber that no load
has closed since, edges that the watch has seen - begins with them.
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
"""Behind the part, beyond the look-ahead: a frame may wait for the next one."""


@dataclass(frozen=True)
class Stretch:
    """Which frames are read, and which are given; by default all.

    Attributes:
        from_ns: instant of the time axis from which models run; None: from the first frame.
        begin_ns: of the first frame that is given; None: the session's.
        end_ns: behind the last one; None: to the end.
        until_ns: behind the last one that is needed for its look-ahead.
        groups: row groups that are read; None: all.
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
        """How long models run before the part; None: since the session began."""
        if self.from_ns is None or self.begin_ns is None:
            return None
        return (self.begin_ns - self.from_ns) * 1e-9

    def needed(self, pieces: Iterable[Piece]) -> Iterator[Piece]:
        """Of the frames that the row groups have, those that models run over."""
        return self._within(pieces, self.from_ns, self.until_ns)

    def given(self, pieces: Iterable[Piece]) -> Iterator[Piece]:
        """Of those the frames that are given."""
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
    """What has to be read of a session to estimate a part of it.

    Args:
        session: the session.
        part: its seconds; columns are not looked at.
        plan: what it is estimated with.

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
    """Those of all tares, oldest first, that are in force from an instant on; None: all."""
    if from_ns is None:
        return tuple(tares)
    over = sum(later.t_ns < from_ns for _, later in pairwise(tares))
    return tuple(tares[over:])
