"""Force signals for alignment: even sampling, identical low-pass, known gaps, candidate lags.

Lags come from a cross-correlation that is masked after Padfield (2012): at every lag, the
correlation coefficient of the samples that both have, so that neither a shrinking overlap nor a gap
favours a lag.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy.fft import irfft, next_fast_len, rfft
from scipy.ndimage import gaussian_filter1d, minimum_filter1d
from scipy.signal import find_peaks

from devices.arrays import Bools, Floats, Ints
from devices.errors import ComparisonError

MIN_GAP_STEPS = 3.5
"""Shortest gap, in usual time steps; the signal is unknown within gaps."""

MAX_STEPS = 32_000_000
"""An hour of a foot at 544 Hz with a plate of any rate; some 2 GB during resampling."""
LAG_STEP_S = 0.005
"""Least step of the lags."""
MAX_LAGS = 1 << 23
"""Most lags that are computed; the step grows for longer signals."""
MAX_ISLANDS = 256
"""Largest number of islands: parts of a signal between its longest gaps, which are skipped."""
MIN_OVERLAP = 0.5
"""Least overlap at a lag, relative to the signal with fewer samples."""


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


def compute_robust_deviation(values: Floats) -> float:
    """Estimate the standard deviation of normal values by their median absolute deviation."""
    return 1.4826 * float(np.median(np.abs(values - np.median(values))))


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


@dataclass(frozen=True)
class CorrelationPeak:
    """Local maximum of the correlation.

    Attributes:
        lag_s: reference time minus our time of the same event.
        correlation: coefficient at that lag.
    """

    lag_s: float
    correlation: float


@dataclass(frozen=True)
class LagCandidates:
    """Best lag, and the second-best local maximum.

    Attributes:
        best: highest maximum.
        rival: highest maximum outside the best one's hill; None if there is none.
        inverted_correlation: highest correlation with the reference's sign inverted.
        step_s: resolution of the lags.
    """

    best: CorrelationPeak
    rival: CorrelationPeak | None
    inverted_correlation: float
    step_s: float


def find_lag_candidates(
    ours: ForceSignal, reference: ForceSignal, lag_range_s: tuple[float, float] | None
) -> LagCandidates | None:
    """Find candidate lags of a reference behind our force, coarsely.

    Args:
        ours: our force.
        reference: the reference force.
        lag_range_s: smallest and largest allowed lag; None: any.

    Returns:
        The lags; None if no lag has enough overlap.
    """
    sides, step_s = _resample_both(ours, reference)
    lags_s, correlation = _correlate(*sides)
    if lag_range_s is not None:
        outside = (lags_s < lag_range_s[0] - step_s) | (lags_s > lag_range_s[1] + step_s)
        correlation[outside] = -np.inf
    if not np.isfinite(correlation).any():
        return None
    best = int(np.argmax(correlation))
    tops, _ = find_peaks(np.where(np.isfinite(correlation), correlation, -2.0))
    low = np.flatnonzero(~(correlation > 0.5 * correlation[best]))
    begin = low[low < best].max(initial=-1)
    end = low[low > best].min(initial=len(correlation))
    others = tops[(tops <= begin) | (tops >= end)]
    others = others[np.isfinite(correlation[others])]
    peaks = [
        CorrelationPeak(float(lags_s[i]), float(correlation[i]))
        for i in (best, *others[np.argsort(-correlation[others])][:1].tolist())
    ]
    opposite = -float(correlation[np.isfinite(correlation)].min())
    return LagCandidates(peaks[0], peaks[1] if len(peaks) > 1 else None, opposite, step_s)


def _resample_both(
    ours: ForceSignal, reference: ForceSignal
) -> tuple[tuple[EvenSignal, EvenSignal], float]:
    """Return both signals at the same even steps, and the step in s.

    Long gaps split them into islands; the number of islands minimises the work.
    """
    # Of each pair of islands there are as many lags as both have samples.
    work_s, own, theirs = min(
        (own.held_s * theirs.islands + theirs.held_s * own.islands, own, theirs)
        for own in _list_splits(ours)
        for theirs in _list_splits(reference)
    )
    step_s = max(LAG_STEP_S, ours.step_s, reference.step_s, work_s / MAX_LAGS)
    sides = [
        resample_evenly(signal, step_s, edge_steps=1, gap_s=split.gap_s)
        for signal, split in ((ours, own), (reference, theirs))
    ]
    return (sides[0], sides[1]), step_s


class _Split(NamedTuple):
    """Split of a signal into islands at gaps longer than `gap_s`; `held_s` of signal remain."""

    islands: int
    held_s: float
    gap_s: float


def _list_splits(signal: ForceSignal) -> list[_Split]:
    steps_s = np.sort(np.diff(signal.t_s))
    held_s = np.cumsum(steps_s)
    most = min(MAX_ISLANDS, len(steps_s))
    return [
        _Split(1 + gaps, float(held_s[-1 - gaps]), float(steps_s[-1 - gaps]))
        for gaps in range(most)
        if (gaps & (gaps + 1)) == 0  # 0, 1, 3, 7, ...
    ]


def _find_islands(side: EvenSignal) -> list[slice]:
    """Return the islands of a signal, parts without a long gap, as slices."""
    ends = np.flatnonzero(np.diff(side.step_index) > 1) + 1
    return [slice(int(a), int(b)) for a, b in pairwise([0, *ends, len(side.step_index)])]


def _correlate(ours: EvenSignal, reference: EvenSignal) -> tuple[Floats, Floats]:
    """Return lags, and the correlation coefficient at each.

    The coefficient is -inf where the overlap is too short or constant. Lags at which no islands
    overlap are left out, except one per gap, with -inf.
    """
    masks = [one.is_known.astype(np.float64) for one in (ours, reference)]
    values = [
        mask * (one.force_n - one.force_n[one.is_known].mean() if one.is_known.any() else 0.0)
        for one, mask in zip((ours, reference), masks, strict=True)
    ]
    # Sums over the common samples at a lag: their count and moments.
    factors = [
        (masks[0], masks[1]),
        (values[0], masks[1]),
        (masks[0], values[1]),
        (values[0], values[1]),
        (values[0] ** 2, masks[1]),
        (masks[0], values[1] ** 2),
    ]
    lags, (count, sum_a, sum_b, product, square_a, square_b) = _sum_products(
        ours, reference, factors
    )
    count = np.rint(count)
    enough = count >= max(2.0, MIN_OVERLAP * min(mask.sum() for mask in masks))
    with np.errstate(divide="ignore", invalid="ignore"):
        mean_a, mean_b = sum_a / count, sum_b / count
        covariance = product / count - mean_a * mean_b
        variance_a = square_a / count - mean_a**2
        variance_b = square_b / count - mean_b**2
        coefficient = covariance / np.sqrt(variance_a * variance_b)
    varies = (variance_a > 1e-9 * np.max(values[0] ** 2, initial=0.0)) & (
        variance_b > 1e-9 * np.max(values[1] ** 2, initial=0.0)
    )
    lags_s = reference.begin_s - ours.begin_s + ours.step_s * lags
    return lags_s, np.where(enough & varies, coefficient, -np.inf)


def _sum_products(
    ours: EvenSignal, reference: EvenSignal, factors: Sequence[tuple[Floats, Floats]]
) -> tuple[Floats, list[Floats]]:
    """Return lags in steps, rising, and for all factors the sums over i of a[i] b[i + lag].

    Lags at which no two islands overlap are left out, except one per gap.
    """
    pairs = [
        (mine, theirs, int(reference.step_index[theirs.start] - ours.step_index[mine.stop - 1]))
        for mine in _find_islands(ours)
        for theirs in _find_islands(reference)
    ]
    ranges = [
        (first, first + (mine.stop - mine.start) + (theirs.stop - theirs.start) - 1)
        for mine, theirs, first in pairs
    ]
    merged: list[list[int]] = []
    for begin, end in sorted(ranges):
        if merged and begin <= merged[-1][1]:
            merged[-1][1] = max(merged[-1][1], end)
        else:
            merged.append([begin, end + 1])  # one more, without overlap
    lags = np.concatenate([np.arange(begin, end) for begin, end in merged])
    sums = [np.zeros(len(lags)) for _ in factors]
    for (mine, theirs, first), (begin, end) in zip(pairs, ranges, strict=True):
        at = int(np.searchsorted(lags, first))
        size = next_fast_len(end - begin, real=True)
        count = mine.stop - mine.start
        for total, (a, b) in zip(sums, factors, strict=True):
            product = irfft(np.conj(rfft(a[mine], size)) * rfft(b[theirs], size), size)
            total[at : at + count - 1] += product[size - count + 1 :]
            total[at + count - 1 : at + end - begin] += product[: end - begin - count + 1]
    return lags.astype(np.float64), sums
