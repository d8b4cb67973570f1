"""Single readings far off: 1.2 % of a real chip's, most of them low (hardware.md 1.3).

Part of the model `denoise`, before anything that remembers. A reading counts as an outlier if it
lies far from the mean of its two neighbours, which lie near each other, and takes that mean. It
needs the reading after it, so frames wait for one more.
"""

from __future__ import annotations

import numpy as np

from devices.arrays import Bools, Floats

FAR = 3.0
"""In units of the noise that a reading has about the mean of two; one healthy reading in 600."""
_ABOUT_MEAN = np.sqrt(1.5)  # of a reading's own noise and that of a mean of two


def spikes(kpa: Floats, noise_kpa: Floats) -> Bools:
    """Which readings are outliers; the first and the last are never.

    Args:
        kpa: (n, tiles), NaN where there is none.
        noise_kpa: (tiles,), standard deviation of a reading.
    """
    found = np.zeros(kpa.shape, dtype=bool)
    if len(kpa) > 2:
        found[1:-1] = _is_spike(kpa[:-2], kpa[1:-1], kpa[2:], noise_kpa)
    return found


def despiked(kpa: Floats, before: Floats, after: Floats, noise_kpa: Floats) -> tuple[Floats, Bools]:
    """Readings with outliers replaced, and which those are.

    Args:
        kpa: (n, tiles).
        before: the readings before each, as they came.
        after: the readings after each.
        noise_kpa: (tiles,).
    """
    found = _is_spike(before, kpa, after, noise_kpa)
    return np.where(found, 0.5 * (before + after), kpa), found


def _is_spike(before: Floats, kpa: Floats, after: Floats, noise_kpa: Floats) -> Bools:
    with np.errstate(invalid="ignore"):
        off_kpa = np.abs(kpa - 0.5 * (before + after))
        return np.asarray(
            (off_kpa > FAR * _ABOUT_MEAN * noise_kpa) & (np.abs(after - before) < off_kpa)
        )
