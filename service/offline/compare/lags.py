"""Lags at which two forces resemble each other, from their masked cross-correlation.

Masked as by Padfield (2012): at every lag the correlation coefficient of the samples that both
have, so that neither an overlap that shrinks nor a gap makes one lag look better than another.
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
from service.offline.compare.signals import Even, Signal, even

STEP_S = 0.005
SAMPLES_MAX = 1 << 22
ISLANDS_MAX = 256
"""Stretches of one signal, parted by its longest gaps, in which nothing is resampled."""
OVERLAP_MIN = 0.5
"""Of what the one with fewer samples has, so much has to overlap at a lag."""


@dataclass(frozen=True)
class Peak:
    """A lag at which correlation has a maximum.

    Attributes:
        lag_s: reference time less our time of the same event.
        correlation: coefficient.
    """

    lag_s: float
    correlation: float


@dataclass(frozen=True)
class Peaks:
    """The best lag, and the best of those beyond the hill that it stands on.

    Attributes:
        best: it.
        rival: None if there is no other maximum.
        opposite: correlation at the best lag of the reference's force turned.
        step_s: of the lags.
    """

    best: Peak
    rival: Peak | None
    opposite: float
    step_s: float


def likely_lags(
    ours: Signal, reference: Signal, lag_range_s: tuple[float, float] | None
) -> Peaks | None:
    """Lags of a reference behind our force, coarsely.

    Args:
        ours: our force.
        reference: that of the reference.
        lag_range_s: least and greatest lag that can be; None: any.

    Returns:
        The lags; None if there is none at which enough overlaps.
    """
    sides, step_s = _even_sides(ours, reference)
    lags_s, correlation = _correlation(*sides)
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
        Peak(float(lags_s[i]), float(correlation[i]))
        for i in (best, *others[np.argsort(-correlation[others])][:1].tolist())
    ]
    opposite = -float(correlation[np.isfinite(correlation)].min())
    return Peaks(peaks[0], peaks[1] if len(peaks) > 1 else None, opposite, step_s)


def _even_sides(ours: Signal, reference: Signal) -> tuple[tuple[Even, Even], float]:
    """Return both signals at the same even steps, and the step in s.

    Long gaps part them into islands, in as many as make least work.
    """
    # Of each pair of islands there are as many lags as both have samples.
    work_s, own, theirs = min(
        (own.held_s * theirs.islands + theirs.held_s * own.islands, own, theirs)
        for own in _splits(ours)
        for theirs in _splits(reference)
    )
    step_s = max(STEP_S, ours.step_s, reference.step_s, work_s / (2 * SAMPLES_MAX))
    sides = [
        even(signal, step_s, edge_steps=1, gap_s=split.gap_s)
        for signal, split in ((ours, own), (reference, theirs))
    ]
    return (sides[0], sides[1]), step_s


class _Split(NamedTuple):
    """A way to part a signal into islands: at gaps beyond so many s, leaving so many s in them."""

    islands: int
    held_s: float
    gap_s: float


def _splits(signal: Signal) -> list[_Split]:
    steps_s = np.sort(np.diff(signal.t_s))
    held_s = np.cumsum(steps_s)
    most = min(ISLANDS_MAX, len(steps_s))
    return [
        _Split(1 + gaps, float(held_s[-1 - gaps]), float(steps_s[-1 - gaps]))
        for gaps in range(most)
        if (gaps & (gaps + 1)) == 0  # 0, 1, 3, 7, ...
    ]


def _islands(side: Even) -> list[slice]:
    """Return the stretches of a signal without a long gap in them."""
    ends = np.flatnonzero(np.diff(side.step) > 1) + 1
    return [slice(int(a), int(b)) for a, b in pairwise([0, *ends, len(side.step)])]


def _correlation(ours: Even, reference: Even) -> tuple[Floats, Floats]:
    """Return lags, and the correlation coefficient at each.

    It is -inf where too little overlaps, or is constant. Of lags at which no islands overlap there
    are none, and one of -inf stands in their place.
    """
    masks = [one.known.astype(np.float64) for one in (ours, reference)]
    values = [
        mask * (one.force_n - one.force_n[one.known].mean() if one.known.any() else 0.0)
        for one, mask in zip((ours, reference), masks, strict=True)
    ]
    # What is summed over the samples of both at a lag: how many, and their moments.
    factors = [
        (masks[0], masks[1]),
        (values[0], masks[1]),
        (masks[0], values[1]),
        (values[0], values[1]),
        (values[0] ** 2, masks[1]),
        (masks[0], values[1] ** 2),
    ]
    lags, (count, sum_a, sum_b, product, square_a, square_b) = _summed(ours, reference, factors)
    count = np.rint(count)
    enough = count >= max(2.0, OVERLAP_MIN * min(mask.sum() for mask in masks))
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


def _summed(
    ours: Even, reference: Even, factors: Sequence[tuple[Floats, Floats]]
) -> tuple[Floats, list[Floats]]:
    """Return lags in steps, rising, and at each the sums over i of a[i] b[i + lag] of all factors.

    Lags at which no two islands overlap are left out, but for one beside those that do.
    """
    pairs = [
        (mine, theirs, int(reference.step[theirs.start] - ours.step[mine.stop - 1]))
        for mine in _islands(ours)
        for theirs in _islands(reference)
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
            merged.append([begin, end + 1])  # one more, where nothing overlaps
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
