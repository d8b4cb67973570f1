"""Where the servo stood at a frame's own instant: between its readings before and after that.

A frame carries the newest reading, which is up to a reading's interval old. The reading after it
comes with a later frame; if that lies within the look-ahead, the position at the frame's instant is
taken from the straight line between the two, else the reading before is held.
"""

from __future__ import annotations

import math

import numpy as np

from devices.compiled import inlined
from devices.frames import NO_SERVO_COUNTS, FrameStatus
from service.estimation.records import Records, record_type

_AGE_UNIT_NS = 1000
"""Ages are cut to microseconds: two frames may date one reading this far apart."""
_UNKNOWN = int(FrameStatus.SERVO_STALE | FrameStatus.SERVO_TURN_UNKNOWN)

READING = record_type(
    [
        ("t_ns", np.int64),  # instant of the frame
        ("sampled_ns", np.int64),  # of its reading; without meaning where there is no age
        ("counts", np.int64),
        ("known", np.int64),  # is there one, not stale, and its turn is known?
        ("dated", np.int64),  # and is its age known?
        ("begins", np.int64),  # is it another than that of the frame before, or none?
        ("joins", np.int64),  # is it the reading next after that of the frame before?
    ]
)
"""A reading of the servo as a frame carries it."""


@inlined
def carry(
    readings: Records,
    i: int,
    t_ns: int,
    counts: np.int64,
    age_us: np.int64,
    frame_status: int,
    counts_per_turn: int,
    broken: bool,
) -> None:
    """Note what frame `i` carries of the servo.

    Args:
        readings: (n,), those of the frames before.
        i: row; 0 is the first frame of all.
        t_ns: instant of the frame.
        counts: `servo_counts`.
        age_us: `servo_age_us`.
        frame_status: bits of `FrameStatus`.
        counts_per_turn: of the servo. Between two readings it does not move half a turn, so one
            that seems to has wrapped from the end of its turn to the beginning.
        broken: does the frame come after a gap? There a reading follows upon nothing.
    """
    now, before = readings[i], readings[max(i - 1, 0)]
    now.t_ns, now.sampled_ns, now.counts = t_ns, t_ns - age_us * _AGE_UNIT_NS, counts
    now.known = 1 if counts != NO_SERVO_COUNTS and (frame_status & _UNKNOWN) == 0 else 0
    now.dated = 1 if now.known == 1 and age_us >= 0 else 0
    unbroken = i > 0 and now.dated == 1 and before.dated == 1 and not broken
    later_ns, moved = now.sampled_ns - before.sampled_ns, abs(counts - before.counts)
    same = unbroken and abs(later_ns) < _AGE_UNIT_NS and moved == 0
    now.begins = 0 if same else 1
    joins = unbroken and later_ns >= _AGE_UNIT_NS and 2 * moved < counts_per_turn
    now.joins = 1 if joins else 0


@inlined
def counts_at(readings: Records, i: int, end: int, lag_ns: int) -> float:
    """Position at the instant of frame `i`, in counts; NaN where it is unknown.

    Args:
        readings: of all frames up to `lag_ns` after it.
        i: row.
        end: row after the last that is there.
        lag_ns: look-ahead.
    """
    t_ns, here = readings[i].t_ns, i
    if readings[i].known == 0:
        return math.nan
    after = _following(readings, here, end, t_ns + lag_ns)
    # A reading that was on its way at the frame's instant was sampled before it.
    if after >= 0 and readings[after].sampled_ns <= t_ns:
        here = after
        after = _following(readings, here, end, t_ns + lag_ns)
    counts = float(readings[here].counts)
    if after < 0 or readings[after].sampled_ns <= t_ns:
        return counts
    interval_ns = readings[after].sampled_ns - readings[here].sampled_ns
    part = (t_ns - readings[here].sampled_ns) / interval_ns
    between: float = counts + part * (readings[after].counts - readings[here].counts)
    return between


@inlined
def _following(readings: Records, at: int, end: int, until_ns: int) -> int:
    """Frame in which the reading next after that of frame `at` is seen; -1: none is."""
    after = at + 1
    # Of frames at the end of the look-ahead only the first is there for certain; without any, none.
    while after < end and readings[after].t_ns <= until_ns and readings[after - 1].t_ns < until_ns:
        if readings[after].begins == 1:
            return after if readings[after].joins == 1 else -1
        after += 1
    return -1
