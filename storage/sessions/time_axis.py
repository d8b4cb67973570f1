"""Time axis of a session, also if its node's date was set between two parts.

A Raspberry Pi without a battery clock begins in 1970 and gets its date from the network; a node
that reboots during a recording begins another stream, with another anchor to its date. Frames keep
their `t_ns` (decision 12); this module computes the shift of each part.

The time between two successive parts is taken

- by the node's own date, unless the server's clock contradicts it by more than its bound;
- else by the server's clock, where both parts were compared with it;
- else not at all: the second part begins one frame after the first one ended.

Without a comparison a step back, or one of more than `MAX_GAP_NS`, cannot be true of a recording.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from pydantic import TypeAdapter

from devices.arrays import Times
from devices.errors import FileFormatError
from storage.clock.table import ClockTable
from storage.schema import UNKNOWN_T_NS, Array

TIME_AXIS_NOTE = "time_axis"
"""Key of a shifted session's time axis in the notes of an export."""
MAX_GAP_NS = 86_400_000_000_000
"""Longest gap between parts, a day, unless the server's clock confirms a longer one."""

Basis = Literal["node", "server", "joined"]
"""Source of a part's begin: its node's date, the server's clock, or neither."""


@dataclass(frozen=True)
class PartSpan:
    """First and last frame of a part.

    Attributes:
        number: number of the part.
        stream_id: id of its stream.
        t_mono_ns: of the two frames.
        t_ns: of the two frames.
    """

    number: int
    stream_id: str
    t_mono_ns: tuple[int, int]
    t_ns: tuple[int, int]


@dataclass(frozen=True)
class TimeAxis:
    """Shifts of `t_ns` by part, which give the session one time axis.

    Attributes:
        shifts_ns: shift by number of part; 0 for the first one.
        bases: source of each shift.
    """

    shifts_ns: tuple[int, ...] = (0,)
    bases: tuple[Basis, ...] = ("node",)

    @property
    def is_shifted(self) -> bool:
        """True if the node's date was set between two parts."""
        return any(self.shifts_ns)

    def get_shift_ns(self, part: int) -> int:
        """Return the shift of a part; behind the last part with frames, that one's."""
        return self.shifts_ns[min(part, len(self.shifts_ns) - 1)]

    def shift_to_axis(self, t_ns: Times, part: Array | None) -> Times:
        """Return instants on the axis, int64[n].

        Args:
            t_ns: int64[n], of frames.
            part: of these frames, [n]; None: all are of the first.
        """
        if not self.is_shifted or part is None:
            return t_ns
        shifts_ns = np.array(self.shifts_ns, dtype=np.int64)
        shifted: Times = t_ns + shifts_ns[np.minimum(part, len(shifts_ns) - 1)]
        return shifted

    def may_overlap(
        self, earliest_ns: int, latest_ns: int, begin_ns: int | None, end_ns: int | None
    ) -> bool:
        """Return whether frames of any parts may be in a range of the axis.

        Args:
            earliest_ns: least `t_ns` of the frames.
            latest_ns: greatest `t_ns`.
            begin_ns: first instant on the axis; None: no bound.
            end_ns: instant on the axis behind the last; None: no bound.
        """
        return any(
            (begin_ns is None or latest_ns + shift_ns >= begin_ns)
            and (end_ns is None or earliest_ns + shift_ns < end_ns)
            for shift_ns in set(self.shifts_ns)
        )

    def to_json_list(self) -> list[dict[str, object]]:
        """Return each part's shift and its basis, for JSON."""
        parts = zip(self.shifts_ns, self.bases, strict=True)
        return [
            {"part": number, "shift_ns": shift_ns, "by": basis}
            for number, (shift_ns, basis) in enumerate(parts)
        ]

    @classmethod
    def from_json_list(cls, content: object, *, where: str) -> TimeAxis:
        """Return the axis from a file's notes, as `to_json_list` made them.

        Raises:
            FileFormatError: it is none.
        """
        try:
            parts = TypeAdapter(list[dict[str, Any]]).validate_python(content)
            return TypeAdapter(TimeAxis).validate_python(
                {
                    "shifts_ns": [part["shift_ns"] for part in parts],
                    "bases": [part["by"] for part in parts],
                }
            )
        except (TypeError, KeyError, ValueError) as error:
            raise FileFormatError("its notes state no time axis", where=where) from error

    def explain_shift_or_empty(self) -> str:
        """Return a message about a shifted axis; empty: the node's date was right."""
        if not self.is_shifted:
            return ""
        if "joined" in self.bases:
            how = (
                "not compared with a server's clock: where that is unknown, parts follow each other"
            )
        else:
            how = "on one axis by the server's clock"
        return f"the node's date was set between two parts; they are {how}"


NODE_AXIS = TimeAxis()
"""Axis of the node's own date, as of every session of one part."""


def compute_time_axis(
    spans: Sequence[PartSpan], clock: ClockTable | None, *, period_ns: int
) -> TimeAxis:
    """Compute the time axis of a session.

    Args:
        spans: of its parts, in their order; those without frames may be left out.
        clock: its clock table; None: there is none.
        period_ns: between two frames.
    """
    shifts_ns, bases = [0], list[Basis](["node"])
    before: PartSpan | None = None
    for span in spans:
        shift_ns, basis = shifts_ns[-1], bases[-1]
        if before is not None and span.stream_id != before.stream_id:
            shift_ns, basis = _shift_after(before, shifts_ns[-1], span, clock, period_ns)
        # Parts without frames are as the one before them.
        while len(shifts_ns) <= span.number:
            shifts_ns.append(shifts_ns[-1])
            bases.append(bases[-1])
        shifts_ns[span.number], bases[span.number] = shift_ns, basis
        before = span
    return TimeAxis(tuple(shifts_ns), tuple(bases))


def _shift_after(
    before: PartSpan, shift_ns: int, span: PartSpan, clock: ClockTable | None, period_ns: int
) -> tuple[int, Basis]:
    """Return shift and basis of a part that follows another part with a known shift."""
    by_node_ns = span.t_ns[0] - before.t_ns[1]
    change = _measure_clock_change(before, span, clock)
    if change is None:
        if 0 < by_node_ns <= MAX_GAP_NS:
            return shift_ns, "node"
        return shift_ns + period_ns - by_node_ns, "joined"
    change_ns, bound_ns = change
    by_server_ns = by_node_ns + change_ns
    if abs(change_ns) <= bound_ns and by_node_ns > 0:
        return shift_ns, "node"
    is_server_sane = -bound_ns < by_server_ns <= MAX_GAP_NS
    if not is_server_sane and 0 < by_node_ns <= MAX_GAP_NS:  # it was the server's date that was set
        return shift_ns, "node"
    if by_server_ns <= -bound_ns:
        return shift_ns + period_ns - by_node_ns, "joined"
    # Within the bound parts might overlap, which they cannot.
    return shift_ns + max(by_server_ns, period_ns) - by_node_ns, "server"


def _measure_clock_change(
    before: PartSpan, span: PartSpan, clock: ClockTable | None
) -> tuple[int, int] | None:
    """Return the node date's change against the server's clock, and the bound of that.

    None: one of the two parts was not compared with the server.
    """
    if clock is None:
        return None
    numbers = np.array([before.number, span.number])
    t_ns = np.array([before.t_ns[1], span.t_ns[0]], dtype=np.int64)
    t_mono_ns = np.array([before.t_mono_ns[1], span.t_mono_ns[0]], dtype=np.int64)
    found = clock.compute_server_time_columns_or_unknown(t_mono_ns, t_ns, numbers)
    server_ns, bound_ns = found["t_server_ns"].tolist(), found["t_server_uncertainty_ns"].tolist()
    if UNKNOWN_T_NS in server_ns:
        return None
    offsets_ns = [server - own for server, own in zip(server_ns, t_ns.tolist(), strict=True)]
    return offsets_ns[1] - offsets_ns[0], sum(bound_ns)
