"""Instants of touchdown in a film, from the height of the foot's lower marker.

In flight the marker moves on a parabola. On touchdown its fall ends: at once on a plate, within
some milliseconds on soft ground. So around each end of a fall the height is fitted by

    parabola + A (t' - s (1 - exp(-t' / s))) + B t'^2,   t' = max(t - touchdown, 0)

on a grid of instants and of times `s`. Instant and uncertainty are the moments of the posterior:
where the film does not tell a hard stop from a soft one, the uncertainty says so.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from devices.arrays import Floats

_BEFORE_S, _AFTER_S = 0.14, 0.08
"""Time that is fitted around a touchdown, and at least so many pictures:"""
_BEFORE_PICTURES, _AFTER_PICTURES = 6, 5
_STOPS_S = np.concatenate([[0.0], np.geomspace(2e-4, 2e-2, 20)])
"""Times in which a fall may end."""
_SLOPE_S, _SLOPE_PICTURES = 0.02, 3
"""Time, and at least so many pictures, over which a speed is measured to find ends of falls."""
_SPAN_MAX = 1.5
"""Largest time of these pictures, relative to that without a dropped one."""
_FALL_SHARE = 0.5
"""Least part of a change of speed that ends a fall: a lift-off begins from rest."""
_STRONG_SHARE = 0.3
"""Least change of speed, relative to the film's strongest: steps are alike."""
_NOISE_RATIO = 8.0
"""Least change of speed, in standard deviations of its noise."""
_STEPS = 12
"""Instants of the grid in an interval of pictures, unless they were closer than `_SIGMA_MIN_S`."""
_SIGMA_MIN_PICTURES, _SIGMA_MIN_S = 0.05, 2e-4
"""Least uncertainty: no foot stops exactly as the model does."""


class Touchdown(NamedTuple):
    """Instant of the film, in s from its first picture, with its standard deviation."""

    film_s: float
    sigma_s: float


def find_touchdowns(film_s: Floats, height: Floats) -> list[Touchdown]:
    """Find the touchdowns in a marker's height.

    Args:
        film_s: (pictures,), rising.
        height: (pictures,), upwards in any unit; NaN where the marker is hidden.

    Returns:
        Touchdowns in order of time; none of those around which the marker is hidden.
    """
    seen = np.isfinite(height)
    film_s, height = film_s[seen], height[seen]
    if len(film_s) < _BEFORE_PICTURES + _AFTER_PICTURES:
        return []
    interval_s = float(np.median(np.diff(film_s)))
    noise = _measure_noise(height)
    found = []
    for index in _find_ends_of_falls(film_s, height, interval_s, noise):
        touchdown = _refine(film_s, height, float(film_s[index]), interval_s, noise)
        if touchdown is not None:
            found.append(touchdown)
    return found


def _measure_noise(height: Floats) -> float:
    """Measure the noise of a picture's height: the median third difference."""
    return float(np.median(np.abs(np.diff(height, 3)))) / 0.6745 / math.sqrt(20.0)


def _find_ends_of_falls(
    film_s: Floats, height: Floats, interval_s: float, noise: float
) -> list[int]:
    """Return pictures at which a fall ends, some pictures away at most."""
    count = max(_SLOPE_PICTURES, round(_SLOPE_S / interval_s))
    x = (np.arange(count) - (count - 1) / 2) * interval_s
    slopes = np.correlate(height, x, "valid") / float(x @ x)
    before, after = slopes[:-count], slopes[count:]
    change = after - before
    is_end = film_s[2 * count - 1 :] - film_s[: 1 - 2 * count] < _SPAN_MAX * 2 * count * interval_s
    is_end &= before < -_FALL_SHARE * change
    is_end &= change > _NOISE_RATIO * noise * math.sqrt(2.0 / float(x @ x))
    is_end &= change > _STRONG_SHARE * change.max(initial=0.0, where=is_end)
    found: list[int] = []
    for at in np.argsort(-np.where(is_end, change, -np.inf))[: int(is_end.sum())]:
        if all(abs(film_s[at + count] - film_s[other]) > _BEFORE_S for other in found):
            found.append(int(at) + count)
    return sorted(found)


def _refine(
    film_s: Floats, height: Floats, rough_s: float, interval_s: float, noise: float
) -> Touchdown | None:
    reach_s = 3.0 * interval_s + float(_STOPS_S[-1])
    before_s = max(_BEFORE_S, (_BEFORE_PICTURES + 0.5) * interval_s)
    after_s = max(_AFTER_S, (_AFTER_PICTURES + 0.5) * interval_s)
    rows = (film_s > rough_s - before_s) & (film_s < rough_s + after_s)
    t_s, y = film_s[rows] - rough_s, height[rows]
    if len(t_s) < _BEFORE_PICTURES + _AFTER_PICTURES or np.diff(t_s).max() > 3.5 * interval_s:
        return None  # the marker is hidden
    step_s = max(interval_s / _STEPS, _SIGMA_MIN_S)
    instants_s = np.arange(-reach_s, reach_s, step_s)
    since_s = np.maximum(t_s - instants_s[:, None, None], 0.0)
    soft_s = np.maximum(_STOPS_S, 1e-9)[:, None]
    end = since_s + soft_s * np.expm1(-since_s / soft_s)
    basis, _ = np.linalg.qr(np.stack([np.ones(len(t_s)), t_s, t_s**2], axis=1))

    def leave(columns: Floats) -> Floats:
        return np.asarray(columns - (columns @ basis) @ basis.T)

    y_left, end_left, bend_left = leave(y), leave(end), leave(since_s**2)
    bend_left = bend_left / np.maximum(np.linalg.norm(bend_left, axis=-1, keepdims=True), 1e-12)
    end_left = end_left - (end_left * bend_left).sum(axis=-1, keepdims=True) * bend_left
    end_left /= np.maximum(np.linalg.norm(end_left, axis=-1, keepdims=True), 1e-12)
    by_end = end_left @ y_left
    misfit = y_left @ y_left - by_end**2 - (bend_left @ y_left) ** 2
    degrees = len(t_s) - 5
    variance = max(noise**2, float(misfit.min()) / degrees)
    weight = np.exp(-0.5 * (misfit - misfit.min()) / variance) * (by_end > 0)
    weight = weight.sum(axis=1)
    if not weight.sum() > 0:
        return None
    weight /= weight.sum()
    offset_s = float(weight @ instants_s)
    spread_s2 = float(weight @ (instants_s - offset_s) ** 2)
    return Touchdown(
        rough_s + offset_s,
        math.sqrt(spread_s2 + (_SIGMA_MIN_PICTURES * interval_s) ** 2 + _SIGMA_MIN_S**2),
    )
