"""Noise that lasts: which part of an unloaded tile's scatter is still there some readings later.

White noise averages away with the number of readings; what a supply, a cable or the ground gives
does not. It is taken for a part c of the variance that decays with a time, over k readings with
phi^k, beside a white rest. Then the mean of n readings has the variance s^2/n times::

    1 + 2 c (phi/(1-phi) - phi (1-phi^n) / (n (1-phi)^2))

(Bartlett 1946; the same sum as for the variance of a mean in Box, Jenkins, Reinsel, ch. 2).
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from devices.arrays import Floats

_LAGS = 64
"""Correlation over so many readings is looked at, or over a quarter of those that are there."""
_TESTED = 8
_CHANCE = 3.5
"""Standard deviations of the sum of rho over `_TESTED` readings: what does not add up averages."""
_TIMES = np.geomspace(1.0, _LAGS, 25)


def lasting(kpa: Floats) -> tuple[Floats, Floats]:
    """The part of the variance that lasts, and how long, of unloaded readings.

    Args:
        kpa: (n, tiles), evenly spaced, NaN where a tile gave none.

    Returns:
        Part c (tiles,), 0 where chance alone would do, and time in readings (tiles,), 0 there.
    """
    n, tiles = kpa.shape
    part, readings = np.zeros(tiles), np.zeros(tiles)
    lags = np.arange(1, min(_LAGS, n // 4) + 1)
    if len(lags) < _TESTED:
        return part, readings
    for tile in range(tiles):
        known = np.isfinite(kpa[:, tile])
        if not known.any() or np.ptp(kpa[known, tile]) == 0.0:
            continue
        off = np.where(known, kpa[:, tile] - kpa[known, tile].mean(), 0.0)
        # What is missing adds nothing to the sums, which makes them a little too small.
        rho = np.array([np.dot(off[:-k], off[k:]) for k in lags.tolist()]) / np.dot(off, off)
        if rho[:_TESTED].sum() >= _CHANCE * np.sqrt(_TESTED / known.sum()):
            part[tile], readings[tile] = _fitted(rho, int(known.sum()))
    return part, readings


def _fitted(rho: Floats, n: int) -> tuple[float, float]:
    decays = np.exp(-np.arange(1, len(rho) + 1) / _TIMES[:, None])
    squares = (decays**2).sum(axis=1)
    part = readings = np.zeros(1)
    for _ in range(3):
        # About the readings' own mean, which goes with them, all of it is smaller by its variance.
        about_true = rho + left_by_mean(part, readings, n) / n
        parts = np.clip((decays * about_true).sum(axis=1) / squares, 0.0, 1.0)
        misfit = parts**2 * squares - 2.0 * parts * (decays * about_true).sum(axis=1)
        best = int(np.argmin(misfit))
        part, readings = parts[[best]], _TIMES[[best]]
    return float(part[0]), float(readings[0]) if part[0] > 0.0 else 0.0


def left_by_mean(part: Floats, readings: Floats, n: npt.ArrayLike) -> Floats:
    """How much greater the variance of a mean of n readings is than that of white noise.

    Args:
        part: (tiles,), from `lasting`.
        readings: (tiles,), likewise; 0 where nothing lasts.
        n: 1 or more, of a shape that goes with (tiles,).
    """
    count = np.asarray(n, dtype=np.float64)
    phi = np.exp(-1.0 / np.where(readings > 0.0, readings, 1.0))
    lasts = phi / (1.0 - phi) - phi * (1.0 - phi**count) / (count * (1.0 - phi) ** 2)
    return np.asarray(1.0 + 2.0 * np.where(readings > 0.0, part, 0.0) * lasts)
