"""Frames at a constant rate, for formats that know no instants.

Between two frames that follow upon each other a sample is on the straight line between them; no
line is drawn over frames that were lost or not taken, nor from a part of a session to the next:
there samples are empty.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from devices.arrays import Floats, Times
from devices.errors import UsageError
from storage.schema import Array

BRIDGED_PERIODS = 2.5
"""No line is drawn over more: in one slot a frame may be late, or not taken."""
SAME_PERIODS = 1e-3
"""A sample that is so near to a frame is that frame, whatever comes before and behind it."""
_NOMINAL_WITHIN = 0.01
"""Frames whose rate is so near the nominal one, relative, have that."""

Indices = npt.NDArray[np.int64]


@dataclass(frozen=True)
class Steady:
    """n samples at a constant rate, of m frames.

    Attributes:
        rate_hz: as a number of single precision has it, as C3D does.
        begin_ns: instant of the first.
        before: (n,), the last frame that is not behind the sample.
        after: (n,), the one behind it, or the same.
        part: (n,), of the way from one to the other, 0 to 1.
        is_there: (n,), bool; else it is empty.
    """

    rate_hz: float
    begin_ns: int
    before: Indices
    after: Indices
    part: Floats
    is_there: npt.NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.before)

    @property
    def time_s(self) -> Floats:
        """(n,), seconds since the first sample."""
        return np.arange(len(self)) / self.rate_hz

    @property
    def empty(self) -> int:
        """Samples without frames."""
        return int((~self.is_there).sum())

    def between(self, column: Floats) -> Floats:
        """A column of m numbers at the samples; NaN where one of the two frames has none."""
        begin, end = column[self.before], column[self.after]
        with np.errstate(invalid="ignore"):
            values = begin + self.part * (end - begin)
        values = np.where(self.part == 0.0, begin, np.where(self.part == 1.0, end, values))
        return np.where(self.is_there, values, np.nan)

    def nearest(self, column: Array) -> Floats:
        """A column of flags: those of the nearer frame."""
        values = column[np.where(self.part <= 0.5, self.before, self.after)]
        return np.where(self.is_there, values.astype(np.float64), np.nan)

    def says(self) -> str:
        """In words, for the file."""
        text = (
            f"{len(self)} samples at {self.rate_hz:.9g} Hz, on straight lines between frames that "
            "follow upon each other; flags are the nearer frame's"
        )
        return f"{text}; {self.empty} samples are empty: frames lost, or not taken"


@dataclass(frozen=True)
class Axis:
    """One time axis of samples at a constant rate.

    Attributes:
        rate_hz: as a number of single precision has it, as C3D does.
        begin_ns: instant of the first.
        count: how many there are.
    """

    rate_hz: float
    begin_ns: int
    count: int


def axis_of(streams: Sequence[tuple[Times, float]], samples_max: int) -> Axis:
    """The axis of some streams of frames: from the first frame of any to the last of any.

    Args:
        streams: instants of the frames of each, one at least, and its nominal rate. Where frames
            come at another one, it is the median's. The axis has the highest.
        samples_max: more are refused.

    Raises:
        UsageError: instants run back, or there were too many samples.
    """
    for t_ns, _ in streams:
        _check_instants(t_ns)
    rate_hz = max(_rate(np.diff(t_ns), nominal_hz) for t_ns, nominal_hz in streams)
    rate_hz = float(np.float32(rate_hz))
    begin_ns = min(int(t_ns[0]) for t_ns, _ in streams)
    end_ns = max(int(t_ns[-1]) for t_ns, _ in streams)
    count = int((end_ns - begin_ns) * 1e-9 * rate_hz + SAME_PERIODS) + 1
    if count > samples_max:
        raise UsageError(
            f"from the first frame to the last there are {count} samples at {rate_hz:.6g} Hz, with "
            f"what lies between; the limit here is {samples_max}",
            expected=f"a slice of {(samples_max - 1) / rate_hz:.3f} s at most",
        )
    return Axis(rate_hz, begin_ns, count)


def steady(axis: Axis, t_ns: Times, seq: Array, part: Array | None) -> Steady:
    """Frames on an axis.

    Args:
        axis: made of these instants, and others if there are.
        t_ns: (m,), their instants, rising; m > 0.
        seq: (m,), their numbers.
        part: (m,), of the session; None: all are of one.
    """
    period_ns = 1e9 / axis.rate_hz
    since_ns = (t_ns - axis.begin_ns).astype(np.float64)
    due_ns = np.arange(axis.count) * period_ns
    before = np.maximum(np.searchsorted(since_ns, due_ns, side="right") - 1, 0)
    after = np.minimum(before + 1, len(t_ns) - 1)
    length_ns = np.where(after > before, since_ns[after] - since_ns[before], period_ns)
    share = np.clip((due_ns - since_ns[before]) / length_ns, 0.0, 1.0)
    is_before = np.abs(due_ns - since_ns[before]) <= SAME_PERIODS * period_ns
    is_after = np.abs(due_ns - since_ns[after]) <= SAME_PERIODS * period_ns
    share[is_before] = 0.0
    share[is_after & (after > before)] = 1.0
    joined = (seq[1:] == seq[:-1] + 1) & (np.diff(t_ns) <= BRIDGED_PERIODS * period_ns)
    if part is not None:
        joined &= part[1:] == part[:-1]
    is_within = (due_ns >= since_ns[0]) & (due_ns <= since_ns[-1])
    is_there = (np.append(joined, False)[before] & is_within) | is_before | is_after
    return Steady(axis.rate_hz, axis.begin_ns, before, after, share, is_there)


def _check_instants(t_ns: Times) -> None:
    steps_ns = np.diff(t_ns)
    if (steps_ns <= 0).any():
        at = int(np.flatnonzero(steps_ns <= 0)[0])
        raise UsageError(
            f"time runs back by {-int(steps_ns[at]) * 1e-9:.6g} s, "
            f"{(t_ns[at] - t_ns[0]) * 1e-9:.3f} s behind the first of these frames, as where a "
            "node's clock was set between two parts",
            expected="one time axis",
            remedy="Ask for the server's clock, or a slice that ends before",
        )


def _rate(steps_ns: Times, nominal_hz: float) -> float:
    if not len(steps_ns):
        return nominal_hz
    median_hz = 1e9 / float(np.median(steps_ns))
    return nominal_hz if abs(median_hz / nominal_hz - 1.0) <= _NOMINAL_WITHIN else median_hz
