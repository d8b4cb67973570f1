"""A foot that walks, each step a little other than the last, and a reference that watches it."""

from __future__ import annotations

import numpy as np
from scipy.interpolate import PchipInterpolator
from scipy.signal import lfilter

from devices.arrays import Floats
from service.offline.compare.signals import ForceSignal

OURS_HZ, REFERENCE_HZ = 447.0, 1000.0


def correlated(rng: np.random.Generator, n: int, memory: float, deviation: float) -> Floats:
    """Noise (n,) that forgets over so many samples."""
    kept = np.exp(-1.0 / memory)
    fresh = deviation * np.sqrt(1.0 - kept**2) * rng.normal(size=n)
    return np.asarray(lfilter([1.0], [1.0, -kept], fresh))


class Gait:
    """True force over time: stances of about 0.6 s with two humps, flights between them."""

    def __init__(self, rng: np.random.Generator, seconds: float, *, repeats: bool = False) -> None:
        t_s, force_n, now = [0.0], [0.0], 0.3
        step = rng.normal(size=4)
        while now < seconds - 1.2:
            if not repeats:
                step = rng.normal(size=4)
            length, peak = 0.6 + 0.03 * step[0], 20.0 + 2.0 * step[1]
            shape = np.array([0.0, 1.0, 0.7 + 0.05 * step[2], 0.95, 0.0]) * peak
            t_s += list(now + length * np.array([0.0, 0.15, 0.5, 0.8, 1.0]))
            force_n += list(shape)
            now += length + 0.4 + 0.03 * step[3]
        self.seconds = seconds
        self._force = PchipInterpolator([*t_s, seconds], [*force_n, 0.0])

    def at(self, t_s: Floats) -> Floats:
        """Force at instants (n,)."""
        return np.asarray(self._force(t_s))


def seen(
    rng: np.random.Generator,
    gait: Gait,
    *,
    lag_s: float = 0.0,
    drift_ppm: float = 0.0,
    offset_n: float = 0.0,
    scale: float = 1.0,
    noise: float = 1.0,
) -> tuple[ForceSignal, ForceSignal]:
    """Our force and the reference's: `ours = scale (reference - offset)`, the lag at half time."""
    t_s = np.arange(0.0, gait.seconds, 1.0 / OURS_HZ)
    true_n = gait.at(t_s)
    own_n = true_n + noise * (
        0.1 * rng.normal(size=len(t_s))
        + correlated(rng, len(t_s), 0.05 * OURS_HZ, 0.1)
        + 0.02 * true_n * correlated(rng, len(t_s), 0.3 * OURS_HZ, 1.0)
    )
    at_s = np.arange(0.0, gait.seconds, 1.0 / REFERENCE_HZ)
    read_n = offset_n + gait.at(at_s) / scale
    read_n += noise * 0.3 * rng.normal(size=len(at_s))
    clock_s = at_s + lag_s + 1e-6 * drift_ppm * (at_s - 0.5 * gait.seconds)
    return ForceSignal(t_s, own_n), ForceSignal(clock_s, read_n)
