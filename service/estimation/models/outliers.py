"""Outlier replacement: 1.2 % of a real chip's readings are far off, mostly low.

See hardware.md 1.3. Part of the model `denoise`, before every model with a state. A reading is an
outlier if it lies far from the mean of its two neighbours, which lie near each other; that mean
replaces it. It needs the next reading, so frames wait for one more.
"""

from __future__ import annotations

import math

import numpy as np

from devices.arrays import Bools, Floats
from devices.jit import jit_cached

OUTLIER_SIGMAS = 3.0
"""In units of the noise that a reading has about the mean of two; one healthy reading in 600."""
_ABOUT_MEAN = math.sqrt(1.5)  # of a reading's own noise and that of a mean of two


def find_outliers(kpa: Floats, noise_kpa: Floats) -> Bools:
    """Return a mask of the outliers, (n, tiles); the first and the last row have none.

    Args:
        kpa: (n, tiles), NaN where there is none.
        noise_kpa: (tiles,), standard deviation of a reading.
    """
    found = np.zeros(kpa.shape, dtype=bool)
    _fill_outlier_mask(kpa, noise_kpa, found)
    return found


@jit_cached
def is_outlier(before: float, kpa: float, after: float, noise_kpa: float) -> bool:
    """Return whether a reading is an outlier between its neighbours; False beside a NaN."""
    off_kpa = abs(kpa - 0.5 * (before + after))
    return off_kpa > OUTLIER_SIGMAS * _ABOUT_MEAN * noise_kpa and abs(after - before) < off_kpa


@jit_cached
def _fill_outlier_mask(kpa: Floats, noise_kpa: Floats, found: Bools) -> None:
    n, tiles = kpa.shape
    for i in range(1, n - 1):
        for j in range(tiles):
            found[i, j] = is_outlier(kpa[i - 1, j], kpa[i, j], kpa[i + 1, j], noise_kpa[j])
