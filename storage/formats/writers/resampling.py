"""Resampling of frames to a constant rate, for formats without instants.

Samples between two successive frames are interpolated linearly. Samples in gaps of lost or not
sampled frames, and between two parts of a session, are empty.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from devices.arrays import Floats, Times
from devices.errors import UsageError
from storage.schema import Array

INTERPOLATED_PERIODS_MAX = 2.5
"""Longest interpolated interval, in periods: a frame may be late, or one may not be sampled."""
COINCIDENCE_PERIODS = 1e-3
"""Distance, in periods, up to which a sample has exactly a frame's values."""
_NOMINAL_RATE_TOLERANCE = 0.01
"""Relative difference of the median rate up to which frames have the nominal rate."""

Indices = npt.NDArray[np.int64]


@dataclass(frozen=True)
class Resampling:
    """Linear resampling of m frames to n samples at a constant rate.

    Attributes:
        rate_hz: rate, exact in float32 as C3D stores it.
        begin_ns: instant of the first sample.
        frame_before: (n,), index of the last frame not after the sample.
        frame_after: (n,), index of the next frame, or the same index at the end.
        fraction: (n,), fraction of the interval from `before` to `after`, 0 to 1.
        has_frames: (n,), bool; False: the sample is empty.
    """

    rate_hz: float
    begin_ns: int
    frame_before: Indices
    frame_after: Indices
    fraction: Floats
    has_frames: npt.NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.frame_before)

    @property
    def elapsed_s(self) -> Floats:
        """Times of the samples (n,), in seconds since the first."""
        return np.arange(len(self)) / self.rate_hz

    @property
    def empty_count(self) -> int:
        """Number of empty samples."""
        return int((~self.has_frames).sum())

    def interpolate(self, column: Floats) -> Floats:
        """Return a column of m numbers interpolated linearly, (n,); NaN if a frame has NaN."""
        begin, end = column[self.frame_before], column[self.frame_after]
        with np.errstate(invalid="ignore"):
            values = begin + self.fraction * (end - begin)
        values = np.where(self.fraction == 0.0, begin, np.where(self.fraction == 1.0, end, values))
        return np.where(self.has_frames, values, np.nan)

    def resample_nearest(self, column: Array) -> Floats:
        """Return a column of m numbers or flags of the nearer frames, (n,); NaN if empty."""
        values = column[np.where(self.fraction <= 0.5, self.frame_before, self.frame_after)]
        return np.where(self.has_frames, values.astype(np.float64), np.nan)

    def describe(self) -> str:
        """Return a description of the resampling, for the file."""
        text = (
            f"{len(self)} samples at {self.rate_hz:.9g} Hz, on straight lines between frames that "
            "follow upon each other; flags are the nearer frame's"
        )
        return f"{text}; {self.empty_count} samples are empty: frames lost, or not taken"


@dataclass(frozen=True)
class SampleAxis:
    """Time axis of samples at a constant rate.

    Attributes:
        rate_hz: rate, exact in float32 as C3D stores it.
        begin_ns: instant of the first sample.
        count: number of samples.
    """

    rate_hz: float
    begin_ns: int
    count: int


def make_sample_axis(streams: Sequence[tuple[Times, float]], samples_max: int) -> SampleAxis:
    """Return the time axis from the earliest to the latest frame of all streams.

    Args:
        streams: instants and nominal rate of each stream, one frame at least. The median rate
            counts if it differs from the nominal one. The axis has the highest rate.
        samples_max: limit of samples.

    Raises:
        UsageError: instants run back, or there are too many samples.
    """
    for t_ns, _ in streams:
        _check_rising_instants(t_ns)
    rate_hz = max(_frame_rate_hz(np.diff(t_ns), nominal_hz) for t_ns, nominal_hz in streams)
    rate_hz = float(np.float32(rate_hz))
    begin_ns = min(int(t_ns[0]) for t_ns, _ in streams)
    end_ns = max(int(t_ns[-1]) for t_ns, _ in streams)
    count = int((end_ns - begin_ns) * 1e-9 * rate_hz + COINCIDENCE_PERIODS) + 1
    if count > samples_max:
        raise UsageError(
            f"from the first frame to the last there are {count} samples at {rate_hz:.6g} Hz, "
            f"gaps included; the limit is {samples_max}",
            expected=f"a slice of {(samples_max - 1) / rate_hz:.3f} s at most",
        )
    return SampleAxis(rate_hz, begin_ns, count)


def make_resampling(axis: SampleAxis, t_ns: Times, seq: Array, part: Array | None) -> Resampling:
    """Return the resampling of frames to a time axis.

    Args:
        axis: time axis that covers the frames.
        t_ns: (m,), instants of the frames, rising; m > 0.
        seq: (m,), numbers of the frames.
        part: (m,), parts of the session; None: a single part.
    """
    period_ns = 1e9 / axis.rate_hz
    since_ns = (t_ns - axis.begin_ns).astype(np.float64)
    due_ns = np.arange(axis.count) * period_ns
    before = np.maximum(np.searchsorted(since_ns, due_ns, side="right") - 1, 0)
    after = np.minimum(before + 1, len(t_ns) - 1)
    length_ns = np.where(after > before, since_ns[after] - since_ns[before], period_ns)
    share = np.clip((due_ns - since_ns[before]) / length_ns, 0.0, 1.0)
    is_before = np.abs(due_ns - since_ns[before]) <= COINCIDENCE_PERIODS * period_ns
    is_after = np.abs(due_ns - since_ns[after]) <= COINCIDENCE_PERIODS * period_ns
    share[is_before] = 0.0
    share[is_after & (after > before)] = 1.0
    joined = (seq[1:] == seq[:-1] + 1) & (np.diff(t_ns) <= INTERPOLATED_PERIODS_MAX * period_ns)
    if part is not None:
        joined &= part[1:] == part[:-1]
    is_within = (due_ns >= since_ns[0]) & (due_ns <= since_ns[-1])
    is_there = (np.append(joined, False)[before] & is_within) | is_before | is_after
    return Resampling(axis.rate_hz, axis.begin_ns, before, after, share, is_there)


def _check_rising_instants(t_ns: Times) -> None:
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


def _frame_rate_hz(steps_ns: Times, nominal_hz: float) -> float:
    if not len(steps_ns):
        return nominal_hz
    median_hz = 1e9 / float(np.median(steps_ns))
    return nominal_hz if abs(median_hz / nominal_hz - 1.0) <= _NOMINAL_RATE_TOLERANCE else median_hz
