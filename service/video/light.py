"""Lamp of the node in a film: the part of the picture whose brightness follows its code.

A picture shows the mean of the code over its exposure, which is unknown. So for each window of the
film the misfit is computed over a grid of offsets and exposures, and offset and uncertainty are the
moments of its posterior: without a difference between pictures of one interval the offset is
uncertain by that interval, and says so.
"""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import numpy as np

from devices.arrays import Floats
from devices.lamp_code import BIT_NS, CODE_BITS, make_code

_WINDOW_S = 6.0
"""Length of a window: 64 bits."""
_PEAK_MIN = 0.6
"""Least correlation with the code: by chance 64 bits reach half of it in 10^5 offsets."""
_SHARE_OF_INTERVAL = 1.0 / 24.0
"""Step of the offsets in the fine grid, in intervals of pictures."""
_EXPOSURES = np.linspace(0.0, 1.0, 9)[1:]
"""Exposures of the grid, in intervals of pictures."""


@cache
def _sum_code() -> Floats:
    return np.concatenate([[0.0], np.cumsum(make_code(), dtype=np.float64)])


def _integrate_code(t_bits: Floats) -> Floats:
    """Integrate the code from 0 to instants in bits, over any number of its periods."""
    periods, rest = np.divmod(t_bits, CODE_BITS)
    whole = rest.astype(np.int64)
    sums = _sum_code()
    inside = sums[whole] + (rest - whole) * make_code()[np.minimum(whole, CODE_BITS - 1)]
    return np.asarray(periods * sums[-1] + inside)


def compute_mean_code(t_ns: Floats, exposure_ns: float) -> Floats:
    """Compute the mean of the code over exposures whose middle is at instants `t_ns`."""
    half_bits = 0.5 * exposure_ns / BIT_NS
    t_bits = t_ns / BIT_NS
    difference = _integrate_code(t_bits + half_bits) - _integrate_code(t_bits - half_bits)
    return np.asarray(difference / (2.0 * half_bits))


class LampPair(NamedTuple):
    """An instant of the film and of the node's clock."""

    film_s: float
    t_mono_ns: float
    sigma_ns: float
    correlation: float
    """Correlation of the brightness with the code, at most 1."""


def find_lamp(
    times_s: Floats, brightness: Floats, begin_ns: float, end_ns: float
) -> list[LampPair]:
    """Find the lamp in the brightness of a film's parts, one pair a window.

    Args:
        times_s: (pictures,), rising.
        brightness: (pictures, parts).
        begin_ns: earliest possible instant of the film's first picture, by the node's clock.
        end_ns: latest one.

    Returns:
        Pairs of the windows in which a part follows the code; empty if none does.
    """
    found: list[LampPair] = []
    begin_s, last_s = times_s[0], times_s[-1]
    count = max(1, int((last_s - begin_s) // _WINDOW_S))
    for edge_s in np.linspace(begin_s, max(begin_s, last_s - _WINDOW_S), count):
        rows = (times_s >= edge_s) & (times_s <= edge_s + _WINDOW_S)
        if rows.sum() < 2 * _WINDOW_S:  # a film of less than two pictures a second
            continue
        if found:  # later windows follow within the drift of any camera
            expected_ns = found[0].t_mono_ns + 1e9 * (begin_s - found[0].film_s)
            margin_ns = 1e-3 * 1e9 * (edge_s - found[0].film_s) + 2 * BIT_NS
            within = expected_ns - margin_ns, expected_ns + margin_ns
        else:
            within = begin_ns, end_ns
        pair = _find_in_window(times_s[rows] - begin_s, brightness[rows], *within)
        if pair is not None:
            found.append(pair._replace(film_s=pair.film_s + begin_s))
    return found


def _find_in_window(
    film_s: Floats, brightness: Floats, begin_ns: float, end_ns: float
) -> LampPair | None:
    interval_ns = 1e9 * float(np.median(np.diff(film_s)))
    # Coarse: a quarter of a bit is enough to see a peak, in pictures and in offsets.
    begins = np.arange(0, len(film_s), max(1, int(BIT_NS / 4 / interval_ns)))
    sizes = np.diff(np.append(begins, len(film_s)))
    coarse_s = np.add.reduceat(film_s, begins) / sizes
    series = _normalize(np.add.reduceat(brightness, begins) / sizes[:, None])
    coarse_ns = interval_ns * sizes[0]
    offsets_ns = np.arange(begin_ns, end_ns + BIT_NS, BIT_NS / 4)
    best = 0.0, 0.0, 0
    for chunk in np.array_split(offsets_ns, len(offsets_ns) // 4096 + 1):
        model = compute_mean_code(chunk[:, None] + 1e9 * coarse_s[None, :], coarse_ns)
        model -= model.mean(axis=1, keepdims=True)
        length = np.sqrt((model**2).sum(axis=1, keepdims=True))
        correlation = (model / np.maximum(length, 1e-9)) @ series
        at, part = np.unravel_index(int(np.argmax(correlation)), correlation.shape)
        best = max(best, (float(correlation[at, part]), float(chunk[at]), int(part)))
    if best[0] < _PEAK_MIN:
        return None
    lamp = _normalize(brightness[:, best[2] : best[2] + 1])[:, 0]
    return _refine(film_s, lamp, best[1], interval_ns, best[0])


def _normalize(brightness: Floats) -> Floats:
    """Return series with mean 0 and length 1; constant ones are 0."""
    varying = brightness - brightness.mean(axis=0)
    length = np.sqrt((varying**2).sum(axis=0))
    return np.asarray(varying / np.where(length > 0, length, 1.0))


def _refine(
    film_s: Floats, series: Floats, coarse_ns: float, interval_ns: float, correlation: float
) -> LampPair:
    """Refine an offset within half a bit by the moments of its posterior."""
    rough_ns = coarse_ns + np.arange(-BIT_NS / 2, BIT_NS / 2, interval_ns / 2)
    near_ns = rough_ns[np.argmin(_compute_misfit(film_s, series, rough_ns, interval_ns))]
    step_ns = interval_ns * _SHARE_OF_INTERVAL
    offsets_ns = near_ns + np.arange(-2.0 * interval_ns, 2.0 * interval_ns, step_ns)
    misfit = np.stack(
        [_compute_misfit(film_s, series, offsets_ns, part * interval_ns) for part in _EXPOSURES],
        axis=1,
    )
    # The noise is unknown, too: integrated out, the posterior is a power of the misfit.
    log_posterior = -0.5 * (len(series) - 3) * np.log(np.maximum(misfit, 1e-9))
    weight = np.exp(log_posterior - log_posterior.max()).sum(axis=1)
    weight /= weight.sum()
    offset_ns = float(weight @ offsets_ns)
    variance = float(weight @ (offsets_ns - offset_ns) ** 2)
    middle_s = float(film_s.mean())
    return LampPair(
        film_s=middle_s,
        t_mono_ns=offset_ns + 1e9 * middle_s,
        sigma_ns=float(np.sqrt(variance + step_ns**2 / 12.0)),
        correlation=correlation,
    )


def _compute_misfit(
    film_s: Floats, series: Floats, offsets_ns: Floats, exposure_ns: float
) -> Floats:
    """Compute the squared misfit of a normalized series to the code, for each offset."""
    model = compute_mean_code(offsets_ns[:, None] + 1e9 * film_s[None, :], exposure_ns)
    model -= model.mean(axis=1, keepdims=True)
    gain = (model @ series) / np.maximum((model**2).sum(axis=1), 1e-9)
    return np.asarray(((series - gain[:, None] * model) ** 2).sum(axis=1))
