"""Correlated noise of an unloaded tile.

White noise averages away with the number of readings; noise of a supply, a cable or the ground does
not. Model: a part c of the variance whose correlation over k readings is phi^k, and a white rest.
Then the mean of n readings has the variance s^2/n times::

    1 + 2 c (phi/(1-phi) - phi (1-phi^n) / (n (1-phi)^2))

(Bartlett 1946; the same sum as for the variance of a mean in Box, Jenkins, Reinsel, ch. 2).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from devices.arrays import Floats

_LAGS = 64
"""Largest lag of the correlation, in readings; a quarter of the readings if there are fewer."""
_TESTED = 8
_CHANCE = 3.5
"""Least sum of rho over `_TESTED` readings that is significant, in standard deviations."""
_TIMES = np.geomspace(1.0, _LAGS, 25)


class CorrelatedNoise(NamedTuple):
    """Correlated part c of the variance, (tiles,), and its time constant; 0: not significant."""

    fraction: Floats
    decay_readings: Floats


def fit_correlated_noise(kpa: Floats) -> CorrelatedNoise:
    """Fit the correlated part of the variance of unloaded readings.

    Args:
        kpa: (n, tiles), evenly spaced, NaN where a tile gave none.
    """
    n, tiles = kpa.shape
    noise = CorrelatedNoise(np.zeros(tiles), np.zeros(tiles))
    lags = np.arange(1, min(_LAGS, n // 4) + 1)
    if len(lags) < _TESTED:
        return noise
    for tile in range(tiles):
        known = np.isfinite(kpa[:, tile])
        if not known.any() or np.ptp(kpa[known, tile]) == 0.0:
            continue
        off = np.where(known, kpa[:, tile] - kpa[known, tile].mean(), 0.0)
        # What is missing adds nothing to the sums, which makes them a little too small.
        rho = np.array([np.dot(off[:-k], off[k:]) for k in lags.tolist()]) / np.dot(off, off)
        if rho[:_TESTED].sum() >= _CHANCE * np.sqrt(_TESTED / known.sum()):
            noise.fraction[tile], noise.decay_readings[tile] = _fit_decay(rho, int(known.sum()))
    return noise


def _fit_decay(rho: Floats, n: int) -> tuple[float, float]:
    decays = np.exp(-np.arange(1, len(rho) + 1) / _TIMES[:, None])
    squares = (decays**2).sum(axis=1)
    part = readings = np.zeros(1)
    for _ in range(3):
        # About the readings' own mean, which goes with them, all of it is smaller by its variance.
        about_true = rho + compute_variance_inflation(part, readings, n) / n
        parts = np.clip((decays * about_true).sum(axis=1) / squares, 0.0, 1.0)
        misfit = parts**2 * squares - 2.0 * parts * (decays * about_true).sum(axis=1)
        best = int(np.argmin(misfit))
        part, readings = parts[[best]], _TIMES[[best]]
    return float(part[0]), float(readings[0]) if part[0] > 0.0 else 0.0


def compute_variance_inflation(
    correlated_fraction: Floats, decay_readings: Floats, n_readings: npt.ArrayLike
) -> Floats:
    """Return the variance of a mean of n readings over that of white noise.

    Args:
        correlated_fraction: (tiles,), correlated part of the variance.
        decay_readings: (tiles,), time constant in readings; 0 for white noise.
        n_readings: 1 or more, broadcast with (tiles,).
    """
    count = np.asarray(n_readings, dtype=np.float64)
    phi = np.exp(-1.0 / np.where(decay_readings > 0.0, decay_readings, 1.0))
    lasts = phi / (1.0 - phi) - phi * (1.0 - phi**count) / (count * (1.0 - phi) ** 2)
    return np.asarray(1.0 + 2.0 * np.where(decay_readings > 0.0, correlated_fraction, 0.0) * lasts)
