"""`temperature`: the baseline of a sealed bubble, which follows p/T of its gas (hardware.md 9).

`tadc` is the chip's temperature. Gas and chip follow what is around them one behind the other, by a
lag of some seconds that is measured per tile in the bench's soak. Where the gas is behind, it
follows its chip as through a low-pass, in which the half count of noise of `tadc` drowns. Where the
chip is behind, the gas is where the chip will be: its rise goes on for the lag. Only the past is
known, so the rise is that of a chip smoothed twice, over an eighth of the lag, which keeps what is
left of the noise below that of a reading. What a wrong lag makes of the rise is uncertain.

Pressure is taken back to what it would be at the tare's temperature, in proportion to itself,
because a warmer gas answers a squeeze more strongly, too.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from devices.arrays import Arrays, Floats, Times
from devices.compiled import compiled

SETTLE_S = 0.5
"""How long the mean of the chip's temperature is taken as that of the gas."""
NEAR_COUNTS = 2.0
"""If a chip begins this near its temperature at the tare, its gas is as near."""
SMOOTH_LEAST_S = 0.1
"""Shortest time over which a chip's temperature is smoothed to tell its rise."""
SMOOTH_PART = 0.125
"""Of the lag of a chip that is behind its gas: the time over which it is smoothed."""
NOISE_COUNTS = 0.5
"""Of a reading of `tadc` (hardware.md 1.3)."""


@dataclass(frozen=True)
class TemperatureState(Arrays):
    """Of every tile: counts of its chip, smoothed once, twice and not, the first, and instants.

    NaN before the first reading.
    """

    once_counts: Floats
    twice_counts: Floats
    chip_counts: Floats
    first_counts: Floats
    first_ns: Times
    t_ns: Times


def at_rest(tiles: int) -> TemperatureState:
    """Before the first reading."""
    unknown, never = np.full(tiles, np.nan), np.zeros(tiles, dtype=np.int64)
    return TemperatureState(unknown, unknown, unknown, unknown, never, never)


@dataclass(frozen=True)
class Temperature:
    """Parameters over tiles.

    Attributes:
        kpa_per_count: rise of the baseline for a count of the gas' `tadc`; negative.
        relative_sigma: its standard uncertainty, relative.
        lag_s: how long the gas is behind its chip; negative where the chip is behind.
        lag_sigma_s: its standard uncertainty.
        tare_counts: mean `tadc` while it was tared.
        baseline_kpa: absolute pressure at the tare.
        step_s: between two readings, typically.
    """

    kpa_per_count: Floats
    relative_sigma: Floats
    lag_s: Floats
    lag_sigma_s: Floats
    tare_counts: Floats
    baseline_kpa: Floats
    step_s: float

    def at_tare(
        self, kpa: Floats, tadc: Floats, t_ns: Times, state: TemperatureState
    ) -> tuple[Floats, Floats, TemperatureState]:
        """Pressures as they would be at the tare's temperature.

        Args:
            kpa: absolute pressures (n, tiles).
            tadc: counts (n, tiles), NaN where there are none.
            t_ns: instants (n, tiles).
            state: from the readings before.

        Returns:
            The pressures, their standard uncertainty from temperature, and the next state.
        """
        gas, rise, after = followed(tadc, t_ns, self.lag_s, state)
        # Where the chip began away from the tare's temperature, it is not known how far the gas is
        # from it: all of that is uncertain, and less so with every lag that passes.
        since_s = np.maximum(t_ns - after.first_ns, 0) * 1e-9
        away = after.first_counts - self.tare_counts
        gone = np.exp(-since_s / np.maximum(np.abs(self.lag_s), SMOOTH_LEAST_S))
        unknown = np.where(np.abs(away) > NEAR_COUNTS, away, 0.0) * gone
        noise = noise_counts(self.lag_s, self.step_s)
        warmed_kpa = self.kpa_per_count * (gas - self.tare_counts)
        scale = 1.0 + warmed_kpa / self.baseline_kpa
        sigma_kpa = np.sqrt(
            (self.relative_sigma * warmed_kpa) ** 2
            + (self.kpa_per_count * self.lag_sigma_s * rise) ** 2
            + (self.kpa_per_count * unknown) ** 2
            + (self.kpa_per_count * noise) ** 2
        )
        # Counts below absolute zero are not valid.
        return kpa / np.where(scale > 0.0, scale, np.nan), sigma_kpa, after


def smoothing_s(lag_s: Floats) -> Floats:
    """Over what time a chip with such a lag is smoothed: the lag itself, if the gas is behind."""
    behind = np.where(lag_s >= 0.0, lag_s, -SMOOTH_PART * lag_s)
    return np.asarray(np.maximum(behind, SMOOTH_LEAST_S))


def noise_counts(lag_s: Floats, step_s: float) -> Floats:
    """What is left of the noise of `tadc` in the counts of a gas that leads its chip."""
    time_s = smoothing_s(lag_s)
    lead = np.where(lag_s < 0.0, 1.0 - lag_s / time_s, 0.0)
    # (1 + (1 + lead) S s)/(1 + S s)^2 of white noise; the low-pass of a lag leaves next to nothing.
    power = step_s * (1.0 + (1.0 + lead) ** 2) / (4.0 * time_s)
    return np.asarray(np.where(lag_s < 0.0, NOISE_COUNTS * np.sqrt(np.minimum(power, 4.0)), 0.0))


def followed(
    tadc: Floats, t_ns: Times, lag_s: Floats, state: TemperatureState
) -> tuple[Floats, Floats, TemperatureState]:
    """Counts of every tile's gas, how fast they rise in counts a second, and the next state.

    Args:
        tadc: counts of the chips (n, tiles), NaN where there are none.
        t_ns: instants (n, tiles).
        lag_s: (tiles,), negative where the chip is behind.
        state: from the readings before.
    """
    gas, rise = np.empty(tadc.shape), np.empty(tadc.shape)
    after = state.copy()
    _follow(
        np.ascontiguousarray(tadc),
        np.ascontiguousarray(t_ns),
        lag_s,
        smoothing_s(lag_s),
        after.once_counts,
        after.twice_counts,
        after.chip_counts,
        after.first_counts,
        after.first_ns,
        after.t_ns,
        gas,
        rise,
    )
    return gas, rise, after


@compiled
def _follow(
    tadc: Floats,
    t_ns: Times,
    lag_s: Floats,
    time_s: Floats,
    once_counts: Floats,
    twice_counts: Floats,
    chip_counts: Floats,
    first_counts: Floats,
    first_ns: Times,
    last_ns: Times,
    gas: Floats,
    rise: Floats,
) -> None:
    n, tiles = tadc.shape
    for j in range(tiles):
        once, twice, chip = once_counts[j], twice_counts[j], chip_counts[j]
        lag, smooth = lag_s[j], time_s[j]
        for i in range(n):
            counts = tadc[i, j]
            if math.isfinite(counts):
                if math.isnan(once):  # as warm as its chip, as far as one can know
                    once, twice = counts, counts
                    first_counts[j], first_ns[j] = counts, t_ns[i, j]
                else:
                    dt = max(0.0, (t_ns[i, j] - last_ns[j]) * 1e-9)
                    known_s = (t_ns[i, j] - first_ns[j]) * 1e-9
                    # At first a plain mean: a single noisy count would stay for the whole lag.
                    time = smooth if known_s > SETTLE_S else min(smooth, max(dt, known_s))
                    if dt > 0.0:
                        # Exact for a chip whose temperature is linear between readings; so is taken
                        # what is smoothed once.
                        decay = math.exp(-dt / time)
                        mean = -math.expm1(-dt / time) * time / dt
                        before = once
                        once = decay * once + (mean - decay) * chip + (1.0 - mean) * counts
                        twice = decay * twice + (mean - decay) * before + (1.0 - mean) * once
                chip, last_ns[j] = counts, t_ns[i, j]
            if lag >= 0.0:
                gas[i, j] = once + (1.0 - lag / smooth) * (chip - once)
                rise[i, j] = (chip - once) / smooth
            else:
                gas[i, j] = once + (1.0 - lag / smooth) * (once - twice)
                rise[i, j] = (once - twice) / smooth
        once_counts[j], twice_counts[j], chip_counts[j] = once, twice, chip
