"""Candidate lags of two forces, from their masked cross-correlation.

Masked after Padfield (2012): at every lag, the correlation coefficient of the samples that both
have, so that neither a shrinking overlap nor a gap favours a lag.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy.fft import irfft, next_fast_len, rfft
from scipy.signal import find_peaks

from devices.arrays import Floats
from service.offline.compare.signals import EvenSignal, ForceSignal, resample_evenly

STEP_S = 0.005
MAX_SAMPLES = 1 << 22
MAX_ISLANDS = 256
"""Largest number of islands: parts of a signal between its longest gaps, which are skipped."""
MIN_OVERLAP = 0.5
"""Least overlap at a lag, relative to the signal with fewer samples."""


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
    step_s = max(STEP_S, ours.step_s, reference.step_s, work_s / (2 * MAX_SAMPLES))
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
