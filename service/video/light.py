"""Lamp of the node in a film: the part of the picture whose brightness follows its code.

A picture shows the mean of the code over its exposure, which is unknown. So for each window of the
film the misfit is computed over a grid of offsets and exposures, and offset and uncertainty are the
moments of its posterior: without a difference between pictures of one interval the offset is
uncertain by that interval, and says so.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from devices.arrays import Floats
from devices.lamp_code import BIT_NS, CODE_BITS, make_code

_WINDOW_S = 6.0
"""Length of a window: 64 bits. In a shorter one chance finds the code anywhere."""
_EDGE_S = 0.1
"""Time that a film may lack of its last window."""
_PICTURES_PER_S_MIN = 10.0
_PEAK_MIN, _NEXT_PEAK_MIN = 0.8, 0.6
"""Least correlation with the code, in the first window and, at an offset near its, in others.

By chance motions of 2 Hz in 1000 parts reach 0.67 in the offsets of an hour.
"""
_GRID_STEPS = 96
"""Offsets of the fine grid."""
_PARTS_MAX = 1024
"""Parts of the picture in which the code is looked for: those with the greatest changes."""
_CHUNK = 4096
"""Offsets that are tried at once."""
_ROUGH_PICTURES = 24
"""Pictures of a bit that are enough to see its edges."""
_NEAR_INTERVALS = 4.0
"""Distance from an edge, in intervals, within which pictures are fitted."""
_EXPOSURES = np.concatenate([[1 / 24, 1 / 12], np.linspace(1 / 8, 1.0, 8)])
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
    times_s: Floats,
    brightness: npt.NDArray[np.floating],
    begin_ns: float,
    end_ns: float,
    report_progress: Callable[[], None] = lambda: None,
) -> list[LampPair]:
    """Find the lamp in the brightness of a film's parts, one pair a window.

    Args:
        times_s: (pictures,), rising.
        brightness: (pictures, parts).
        begin_ns: earliest possible instant of the film's first picture, by the node's clock.
        end_ns: latest one.
        report_progress: called every few seconds.

    Returns:
        Pairs of the windows in which a part follows the code; empty if none does.
    """
    found: list[LampPair] = []
    begin_s, last_s = float(times_s[0]), float(times_s[-1])
    edge_s = begin_s
    while edge_s + _WINDOW_S <= last_s + _EDGE_S:
        rows = (times_s >= edge_s) & (times_s <= edge_s + _WINDOW_S)
        within, peak_min = (begin_ns, end_ns), _PEAK_MIN
        if found:  # later windows follow within the drift of any camera
            expected_ns = found[0].t_mono_ns + 1e9 * (begin_s - found[0].film_s)
            margin_ns = 1e-3 * 1e9 * (edge_s - found[0].film_s) + 2 * BIT_NS
            within, peak_min = (expected_ns - margin_ns, expected_ns + margin_ns), _NEXT_PEAK_MIN
        pair = None
        if rows.sum() >= _PICTURES_PER_S_MIN * _WINDOW_S:
            part = np.asarray(brightness[rows], dtype=np.float64)
            since_s = times_s[rows] - begin_s
            pair = _find_in_window(since_s, part, *within, peak_min, report_progress)
        if pair is not None:
            found.append(pair._replace(film_s=pair.film_s + begin_s))
            edge_s += _WINDOW_S
        else:
            # The lamp may begin anywhere: windows overlap until it is found, and at the end.
            end_s = last_s - _WINDOW_S
            edge_s = end_s if edge_s < end_s < edge_s + _WINDOW_S / 2 else edge_s + _WINDOW_S / 2
    return found


def _find_in_window(
    film_s: Floats,
    brightness: Floats,
    begin_ns: float,
    end_ns: float,
    peak_min: float,
    report_progress: Callable[[], None],
) -> LampPair | None:
    # Coarse: a quarter of a bit is enough to see a peak, in pictures and in offsets.
    step_ns = BIT_NS / 4
    count = int(1e9 * (film_s[-1] - film_s[0]) / step_ns)
    binned = _average_bins(film_s, brightness, count)
    most_varying = np.argsort(-(np.diff(binned, axis=0) ** 2).sum(axis=0))[:_PARTS_MAX]
    series = _normalize(binned[:, most_varying]).astype(np.float32)
    bins_ns = begin_ns + 1e9 * film_s[0] + step_ns * (np.arange(0.0, count) + 0.5)
    best = 0.0, 0.0, 0
    for chunk_ns in range(0, max(1, round(end_ns - begin_ns)), _CHUNK * round(step_ns)):
        report_progress()
        offsets = min(_CHUNK, int((end_ns - begin_ns - chunk_ns) / step_ns) + 2)
        code_ns = bins_ns[0] + chunk_ns + step_ns * np.arange(0.0, offsets + count - 1)
        code = compute_mean_code(code_ns, step_ns).astype(np.float32)
        model = np.lib.stride_tricks.sliding_window_view(code, count)
        # The series' mean is 0, so only the model's length needs its own.
        length = np.sqrt(count) * np.maximum(model.std(axis=1), 1e-6)
        correlation = (model @ series) / length[:, None]
        at, part = np.unravel_index(int(np.argmax(correlation)), correlation.shape)
        offset_ns = begin_ns + chunk_ns + step_ns * float(at)
        best = max(best, (float(correlation[at, part]), offset_ns, int(most_varying[part])))
    if best[0] < peak_min:
        return None
    interval_ns = 1e9 * float(np.median(np.diff(film_s)))
    lamp = _normalize(brightness[:, best[2] : best[2] + 1])[:, 0]
    return _refine(film_s, lamp, best[1], interval_ns, best[0])


def _average_bins(film_s: Floats, brightness: Floats, count: int) -> Floats:
    """Average series over `count` equal bins, whatever the pictures' times: (bins, parts)."""
    width_s = np.diff(film_s)[:, None]
    steps = 0.5 * (brightness[1:] + brightness[:-1]) * width_s
    sums = np.concatenate([np.zeros((1, brightness.shape[1])), np.cumsum(steps, axis=0)])
    edges_s = film_s[0] + (BIT_NS / 4e9) * np.arange(count + 1)
    rows = np.interp(edges_s, film_s, np.arange(0.0, len(film_s)))
    low = np.minimum(rows.astype(int), len(film_s) - 2)
    part = (rows - low)[:, None]
    return np.asarray(np.diff(sums[low] + part * steps[low], axis=0))


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
    some = slice(None, None, max(1, int(BIT_NS / _ROUGH_PICTURES / interval_ns)))
    misfit = _compute_misfit(film_s[some], series[some], rough_ns, interval_ns)
    near_ns = rough_ns[np.argmin(misfit)]
    # Only pictures near the edges tell more: of fast films that is a small part.
    t_ns = near_ns + 1e9 * film_s
    spread = compute_mean_code(t_ns, 2.0 * _NEAR_INTERVALS * interval_ns)
    is_near = (spread > 0) & (spread < 1)
    if is_near.any():
        film_s, series = film_s[is_near], _normalize(series[is_near, None])[:, 0]
    offset_ns, reach_ns, exposures = float(near_ns), 2.0 * interval_ns, _EXPOSURES
    for _ in range(2):  # the second time on a grid as fine as the posterior is narrow
        step_ns = 2.0 * reach_ns / _GRID_STEPS
        offsets_ns = offset_ns + np.arange(-reach_ns, reach_ns, step_ns)
        misfit = np.stack(
            [_compute_misfit(film_s, series, offsets_ns, p * interval_ns) for p in exposures],
            axis=1,
        )
        # The noise is unknown, too: integrated out, the posterior is a power of the misfit.
        log_posterior = -0.5 * (len(series) - 3) * np.log(np.maximum(misfit, 1e-9))
        weight = np.exp(log_posterior - log_posterior.max())
        weight /= weight.sum()
        offset_ns, sigma_ns = _compute_moments(weight.sum(axis=1), offsets_ns)
        exposure, width = _compute_moments(weight.sum(axis=0), exposures)
        reach_ns = 6.0 * sigma_ns
        around = exposure + 4.0 * width * np.linspace(-1.0, 1.0, len(_EXPOSURES))
        exposures = np.clip(around, _EXPOSURES[0], 1.0)
    # At the mean instant of all that tells the offset, a drift does not change it.
    shift_ns = max(sigma_ns, interval_ns / _GRID_STEPS)
    change = np.subtract(
        *(
            compute_mean_code(offset_ns + side_ns + 1e9 * film_s, exposure * interval_ns)
            for side_ns in (-shift_ns, shift_ns)
        )
    )
    at_s = float(np.average(film_s, weights=change**2 + 1e-12))
    return LampPair(
        film_s=at_s,
        t_mono_ns=offset_ns + 1e9 * at_s,
        sigma_ns=sigma_ns,
        correlation=correlation,
    )


def _compute_moments(weight: Floats, values: Floats) -> tuple[float, float]:
    """Compute mean and standard deviation over a grid, with what its steps hide."""
    mean = float(weight @ values)
    step = float(values[-1] - values[0]) / (len(values) - 1)
    return mean, math.sqrt(float(weight @ (values - mean) ** 2) + step**2 / 12.0)


def _compute_misfit(
    film_s: Floats, series: Floats, offsets_ns: Floats, exposure_ns: float
) -> Floats:
    """Compute the squared misfit of a normalized series to the code, for each offset."""
    model = compute_mean_code(offsets_ns[:, None] + 1e9 * film_s[None, :], exposure_ns)
    model -= model.mean(axis=1, keepdims=True)
    gain = (model @ series) / np.maximum((model**2).sum(axis=1), 1e-9)
    return np.asarray(((series - gain[:, None] * model) ** 2).sum(axis=1))
