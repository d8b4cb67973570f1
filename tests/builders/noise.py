"""Noise of unloaded tiles."""

from __future__ import annotations

import math

import numpy as np
from scipy.signal import lfilter

from devices.arrays import Floats


def draw_lasting_noise(
    n: int, tiles: int, *, part: float, readings: float, seed: int = 0
) -> Floats:
    """Draw noise (n, tiles) of variance 1, a part of which decays over so many readings."""
    rng = np.random.default_rng(seed)
    phi = math.exp(-1.0 / readings)
    driven = math.sqrt(1.0 - phi**2) * rng.normal(size=(n, tiles))
    driven[0] = rng.normal(size=tiles)
    lasting = lfilter([1.0], [1.0, -phi], driven, axis=0)
    white = rng.normal(size=(n, tiles))
    return np.asarray(math.sqrt(part) * lasting + math.sqrt(1.0 - part) * white)
