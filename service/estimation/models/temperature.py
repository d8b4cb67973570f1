"""`temperature`: the baseline of a sealed bubble, which follows p/T of its gas (hardware.md 9).

`tadc` is the chip's temperature. The gas follows its chip with one lag of some seconds, measured
per tile in the bench's soak, in which the half count of noise of `tadc` drowns: it needs no
smoothing, which would only be late in a cold shock. Pressure is taken back to what it would be at
the tare's temperature, in proportion to itself, because a warmer gas answers a squeeze more
strongly, too. While chip and gas differ, how far is itself uncertain.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from devices.arrays import Arrays, Floats, Times
from service.estimation.compiled import compiled

SETTLE_S = 0.5
"""How long the mean of the chip's temperature is taken as that of the gas."""
NEAR_COUNTS = 2.0
"""If a chip begins this near its temperature at the tare, its gas is as near."""


@dataclass(frozen=True)
class TemperatureState(Arrays):
    """Of every tile: counts of its gas, its chip, the first ones and when, and when the last.

    NaN before the first reading.
    """

    gas_counts: Floats
    chip_counts: Floats
    first_counts: Floats
    first_ns: Times
    t_ns: Times


def at_rest(tiles: int) -> TemperatureState:
    """Before the first reading."""
    unknown, never = np.full(tiles, np.nan), np.zeros(tiles, dtype=np.int64)
    return TemperatureState(unknown, unknown, unknown, never, never)


@dataclass(frozen=True)
class Temperature:
    """Parameters over tiles.

    Attributes:
        kpa_per_count: rise of the baseline for a count of the gas' `tadc`; negative.
        relative_sigma: its standard uncertainty, relative.
        lag_s: how long the gas follows its chip.
        relative_lag_sigma: likewise.
        tare_counts: mean `tadc` while it was tared.
        baseline_kpa: absolute pressure at the tare.
    """

    kpa_per_count: Floats
    relative_sigma: Floats
    lag_s: Floats
    relative_lag_sigma: Floats
    tare_counts: Floats
    baseline_kpa: Floats

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
        gas, chip = np.empty(kpa.shape), np.empty(kpa.shape)
        after = state.copy()
        _follow(
            np.ascontiguousarray(tadc),
            np.ascontiguousarray(t_ns),
            self.lag_s,
            after.gas_counts,
            after.chip_counts,
            after.first_counts,
            after.first_ns,
            after.t_ns,
            gas,
            chip,
        )
        # Where the chip began away from the tare's temperature, it is not known how far the gas had
        # followed: all of that is uncertain, and less so with every lag that passes.
        since_s = np.maximum(t_ns - after.first_ns, 0) * 1e-9
        away = after.first_counts - self.tare_counts
        unknown = np.where(np.abs(away) > NEAR_COUNTS, away, 0.0) * np.exp(-since_s / self.lag_s)
        warmed_kpa = self.kpa_per_count * (gas - self.tare_counts)
        scale = 1.0 + warmed_kpa / self.baseline_kpa
        sigma_kpa = np.sqrt(
            (self.relative_sigma * warmed_kpa) ** 2
            + (self.relative_lag_sigma * self.kpa_per_count * (chip - gas)) ** 2
            + (self.kpa_per_count * unknown) ** 2
        )
        # Counts below absolute zero are not valid.
        return kpa / np.where(scale > 0.0, scale, np.nan), sigma_kpa, after


@compiled
def _follow(
    tadc: Floats,
    t_ns: Times,
    lag_s: Floats,
    gas_counts: Floats,
    chip_counts: Floats,
    first_counts: Floats,
    first_ns: Times,
    last_ns: Times,
    gas: Floats,
    chip: Floats,
) -> None:
    n, tiles = tadc.shape
    for j in range(tiles):
        now, before = gas_counts[j], chip_counts[j]
        for i in range(n):
            counts = tadc[i, j]
            if math.isfinite(counts):
                if math.isnan(now):  # as warm as its chip, as far as one can know
                    now, first_counts[j], first_ns[j] = counts, counts, t_ns[i, j]
                else:
                    dt = max(0.0, (t_ns[i, j] - last_ns[j]) * 1e-9)
                    known_s = (t_ns[i, j] - first_ns[j]) * 1e-9
                    # At first a plain mean: a single noisy count would stay for the whole lag.
                    lag = lag_s[j] if known_s > SETTLE_S else min(lag_s[j], max(dt, known_s))
                    if dt > 0.0:
                        # Exact for a chip whose temperature is linear between readings.
                        decay = math.exp(-dt / lag)
                        mean = -math.expm1(-dt / lag) * lag / dt
                        now = decay * now + (mean - decay) * before + (1.0 - mean) * counts
                before, last_ns[j] = counts, t_ns[i, j]
            gas[i, j], chip[i, j] = now, before
        gas_counts[j], chip_counts[j] = now, before
