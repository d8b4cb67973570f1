"""Where the servo stood at a frame's own instant: between its readings before and after that.

A frame carries the newest reading, which is up to a reading's interval old. The reading after it
comes with a later frame; if that lies within the look-ahead, the position at the frame's instant is
taken from the straight line between the two, else the reading before is held.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from devices.arrays import Arrays, Bools, Floats, Ints, Times
from devices.frames import NO_SERVO_COUNTS, FrameBatch, FrameStatus

_AGE_UNIT_NS = 1000
"""Ages are cut to microseconds: two frames may date one reading this far apart."""


@dataclass(frozen=True)
class Readings(Arrays):
    """The servo's readings as n frames carry them, one row per frame.

    Attributes:
        t_ns: int64[n], instant of the frame.
        sampled_ns: int64[n], instant of its reading; without meaning where there is no age.
        counts: int64[n], its position.
        known: bool[n], there is one, and it is not stale.
        dated: bool[n], and its age is known.
        begins: bool[n], this is another reading than that of the frame before, or none.
        joins: bool[n], this is the reading next after that of the frame before.
    """

    t_ns: Times
    sampled_ns: Times
    counts: Ints
    known: Bools
    dated: Bools
    begins: Bools
    joins: Bools


def readings_of(
    frames: FrameBatch,
    broken: Bools,
    before: Readings | None,
    counts_per_turn: int,
) -> Readings:
    """What n > 0 frames carry of the servo.

    Args:
        frames: n frames.
        broken: (n,), which of them come after a gap: there a reading follows upon nothing.
        before: the row of the frame before the first; None if there is none.
        counts_per_turn: of the servo. Between two readings it does not move half a turn, so one
            that seems to has wrapped from the end of its turn to the beginning.
    """
    known = (frames.servo_counts != NO_SERVO_COUNTS) & (
        (frames.frame_status & FrameStatus.SERVO_STALE) == 0
    )
    dated = known & (frames.servo_age_us >= 0)
    counts = frames.servo_counts.astype(np.int64)
    sampled_ns = frames.t_mono_ns - frames.servo_age_us.astype(np.int64) * _AGE_UNIT_NS
    later_ns = np.diff(sampled_ns, prepend=before.sampled_ns if before else sampled_ns[:1])
    moved = np.diff(counts, prepend=before.counts if before else counts[:1])
    dated_before = np.concatenate([before.dated if before else [False], dated[:-1]])
    unbroken = dated & dated_before & ~broken
    same = unbroken & (np.abs(later_ns) < _AGE_UNIT_NS) & (moved == 0)
    joins = unbroken & (later_ns >= _AGE_UNIT_NS) & (2 * np.abs(moved) < counts_per_turn)
    return Readings(frames.t_mono_ns, sampled_ns, counts, known, dated, ~same, joins)


def counts_at(readings: Readings, rows: int, lag_ns: int) -> Floats:
    """Position at the instants of the first `rows` frames, in counts; NaN where it is unknown.

    Args:
        readings: of these and of all frames up to `lag_ns` after each of them.
        rows: how many frames to decide.
        lag_ns: look-ahead.
    """
    n = len(readings.t_ns)
    frame = np.arange(rows)
    t_ns = readings.t_ns[:rows]
    last_seen = np.searchsorted(readings.t_ns, t_ns + lag_ns, side="right") - 1
    # The frame in which the next reading is seen; n: no more of them.
    begins = np.append(np.flatnonzero(readings.begins), n)
    joins = np.append(readings.joins, False)
    sampled_ns = np.append(readings.sampled_ns, 0)

    def following(at: npt.NDArray[np.intp]) -> tuple[npt.NDArray[np.intp], Bools]:
        after = begins[np.searchsorted(begins, at, side="right")]
        return after, (after <= last_seen) & joins[after]

    after, seen = following(frame)
    # A reading that was on its way at the frame's instant was sampled before it.
    passed = seen & (sampled_ns[after] <= t_ns)
    here = np.where(passed, after, frame)
    after, seen = following(here)
    between = seen & (sampled_ns[after] > t_ns)
    after = np.where(between, after, here)
    interval_ns = np.where(between, sampled_ns[after] - sampled_ns[here], 1)
    part = np.where(between, t_ns - sampled_ns[here], 0) / interval_ns
    counts = readings.counts[here] + part * (readings.counts[after] - readings.counts[here])
    return np.where(readings.known[:rows], counts, np.nan)
