"""Lags at which two forces resemble each other, from their masked cross-correlation.

Masked as by Padfield (2012): at every lag the correlation coefficient of the samples that both
have, so that neither an overlap that shrinks nor a gap makes one lag look better than another.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.fft import irfft, next_fast_len, rfft
from scipy.signal import find_peaks

from devices.arrays import Floats
from service.offline.compare.signals import Even, Signal, even

STEP_S = 0.005
SAMPLES_MAX = 1 << 22
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
        step_s: of the lags.
    """

    best: Peak
    rival: Peak | None
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
    longest_s = max(float(s.t_s[-1] - s.t_s[0]) for s in (ours, reference))
    step_s = max(STEP_S, ours.step_s, reference.step_s, longest_s / SAMPLES_MAX)
    lags_s, correlation = _correlation(even(ours, step_s), even(reference, step_s))
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
    return Peaks(peaks[0], peaks[1] if len(peaks) > 1 else None, step_s)


def _correlation(ours: Even, reference: Even) -> tuple[Floats, Floats]:
    """Correlation coefficient at every lag; -inf where too little overlaps, or is constant."""
    masks = [one.known.astype(np.float64) for one in (ours, reference)]
    values = [
        mask * (one.force_n - one.force_n[one.known].mean() if one.known.any() else 0.0)
        for one, mask in zip((ours, reference), masks, strict=True)
    ]
    n_ours, n_reference = len(masks[0]), len(masks[1])
    size = next_fast_len(n_ours + n_reference - 1, real=True)

    def across(a: Floats, b: Floats) -> Floats:
        # Sum over i of a[i] b[i + k], for k from 1 - n_ours to n_reference - 1.
        product = irfft(np.conj(rfft(a, size)) * rfft(b, size), size)
        return np.concatenate([product[size - n_ours + 1 :], product[:n_reference]])

    count = np.rint(across(masks[0], masks[1]))
    enough = count >= max(2.0, OVERLAP_MIN * min(mask.sum() for mask in masks))
    with np.errstate(divide="ignore", invalid="ignore"):
        mean_a = across(values[0], masks[1]) / count
        mean_b = across(masks[0], values[1]) / count
        covariance = across(values[0], values[1]) / count - mean_a * mean_b
        variance_a = across(values[0] ** 2, masks[1]) / count - mean_a**2
        variance_b = across(masks[0], values[1] ** 2) / count - mean_b**2
        coefficient = covariance / np.sqrt(variance_a * variance_b)
    varies = (variance_a > 1e-9 * np.max(values[0] ** 2, initial=0.0)) & (
        variance_b > 1e-9 * np.max(values[1] ** 2, initial=0.0)
    )
    lags_s = (
        reference.begin_s
        - ours.begin_s
        + ours.step_s * np.arange(1 - n_ours, n_reference, dtype=np.float64)
    )
    return lags_s, np.where(enough & varies, coefficient, -np.inf)
