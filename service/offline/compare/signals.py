"""Force signals for alignment: even sampling, identical low-pass, known gaps."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import gaussian_filter1d, minimum_filter1d

from devices.arrays import Bools, Floats, Ints
from devices.errors import ComparisonError

MIN_GAP_STEPS = 3.5
"""Shortest gap, in usual time steps; the signal is unknown within gaps."""

MAX_STEPS = 32_000_000
"""An hour of a foot at 544 Hz with a plate of any rate; some 2 GB during resampling."""


@dataclass(frozen=True)
class ForceSignal:
    """Force over time on its own clock.

    Attributes:
        t_s: (n,), rising.
        force_n: (n,), finite; samples without a force are left out and leave gaps.
        sigma_n: (n,), stated standard uncertainty, whose error may repeat in every stance; None:
            not stated.
    """

    t_s: Floats
    force_n: Floats
    sigma_n: Floats | None = None

    @property
    def step_s(self) -> float:
        """Median time between two samples."""
        return float(np.median(np.diff(self.t_s)))

    def is_known(self, t_s: Floats) -> Bools:
        """Return which times (m,) are between two samples without a gap."""
        after = np.searchsorted(self.t_s, t_s)
        inside = (after > 0) & (after < len(self.t_s))
        after = np.clip(after, 1, len(self.t_s) - 1)
        gap_s = self.t_s[after] - self.t_s[after - 1]
        exact = self.t_s[np.minimum(np.searchsorted(self.t_s, t_s), len(self.t_s) - 1)] == t_s
        return np.asarray(exact | (inside & (gap_s <= MIN_GAP_STEPS * self.step_s)))

    def interpolate_force_n(self, t_s: Floats) -> Floats:
        """Interpolate the force linearly at times (m,); NaN within gaps."""
        force_n = np.interp(t_s, self.t_s, self.force_n)
        force_n[~self.is_known(t_s)] = np.nan
        return np.asarray(force_n, dtype=np.float64)


@dataclass(frozen=True)
class EvenSignal:
    """Signal at even steps, without the inside of long gaps; n samples.

    Attributes:
        begin_s: time of step 0.
        step_s: time between two steps.
        step_index: (n,), rising; step number of each sample. It jumps over long gaps.
        force_n: (n,); linear across unknown parts.
        is_known: (n,), False within gaps.
    """

    begin_s: float
    step_s: float
    step_index: Ints
    force_n: Floats
    is_known: Bools

    @property
    def t_s(self) -> Floats:
        """Times of the samples."""
        return np.asarray(self.begin_s + self.step_s * self.step_index, dtype=np.float64)

    def has_known_sample(self, t_s: Floats) -> Bools:
        """Return whether the samples nearest to times (m,) are known."""
        if not len(self.step_index):
            return np.zeros(len(t_s), dtype=np.bool_)
        step = np.rint((t_s - self.begin_s) / self.step_s)
        at = np.minimum(np.searchsorted(self.step_index, step), len(self.step_index) - 1)
        return np.asarray((self.step_index[at] == step) & self.is_known[at])


def resample_evenly(
    signal: ForceSignal,
    step_s: float,
    edge_steps: int,
    *,
    gap_s: float = 0.0,
    range_s: tuple[float, float] = (-np.inf, np.inf),
) -> EvenSignal:
    """Resample a signal linearly at even steps.

    The size depends on the time with samples, not on the total duration, which a single wrong time
    stamp can make huge.

    Args:
        signal: the signal.
        step_s: time between two steps.
        edge_steps: steps kept at either side of a long gap.
        gap_s: shortest long gap; a long gap is also longer than its edges.
        range_s: begin and end of the returned range.

    Raises:
        ComparisonError: more than `MAX_STEPS` steps would result.
    """
    place = (signal.t_s - signal.t_s[0]) / step_s
    long = np.diff(place) > max(2 * edge_steps + 2, gap_s / step_s)
    begins = np.concatenate([[0], np.floor(place[1:][long]).astype(np.int64) - edge_steps])
    ends = np.concatenate(
        [np.ceil(place[:-1][long]).astype(np.int64) + edge_steps, [int(place[-1])]]
    )
    low, high = np.clip((np.array(range_s) - signal.t_s[0]) / step_s, 0.0, place[-1])
    begins, ends = np.maximum(begins, int(low)), np.minimum(ends, int(high))
    lengths = np.maximum(0, ends - begins + 1)
    count = int(lengths.sum())
    if count > MAX_STEPS:
        raise ComparisonError(
            f"{count} steps of {step_s:.3g} s are too many to be compared",
            expected=f"up to {MAX_STEPS}",
            remedy="Cut out the part that both have recorded",
        )
    before = np.cumsum(lengths) - lengths
    step = np.arange(count) + np.repeat(begins - before, lengths)
    t_s = signal.t_s[0] + step_s * step
    force_n = np.interp(t_s, signal.t_s, signal.force_n)
    return EvenSignal(float(signal.t_s[0]), step_s, step, force_n, signal.is_known(t_s))


def low_pass(
    signal: ForceSignal,
    width_s: float,
    step_s: float,
    margin_s: float = 0.0,
    range_s: tuple[float, float] = (-np.inf, np.inf),
) -> EvenSignal:
    """Low-pass a signal with a Gaussian window, at even steps.

    The same window for two signals keeps their lag, and removes the bias that linear interpolation
    between noisy samples would add to it.

    Args:
        signal: the signal.
        width_s: standard deviation of the window.
        step_s: step of the result; at most half the width.
        margin_s: distance from any gap, beyond the window, that known samples keep.
        range_s: begin and end of the returned range.
    """
    reach = round((3.0 * width_s + margin_s) / step_s)
    # The window spans four widths per side: no known sample depends on values beyond an edge.
    edge_steps = reach + round(4.0 * width_s / step_s)
    raw = resample_evenly(signal, step_s, edge_steps, range_s=range_s)
    known = minimum_filter1d(raw.is_known.view(np.uint8), 2 * reach + 1, mode="constant", cval=0)
    force_n = gaussian_filter1d(raw.force_n, width_s / step_s, mode="nearest")
    return replace(raw, force_n=force_n, is_known=known.astype(np.bool_))
