"""`temperature`: the baseline of a sealed bubble, which follows p/T of its gas (hardware.md 9).

`tadc` is the chip's temperature, noisy by half a count: it is averaged over a quarter of a second.
The gas follows its chip with one lag, measured per tile in the bench's soak. Pressure is taken back
to what it would be at the tare's temperature, in proportion to itself, because a warmer gas answers
a squeeze more strongly, too. While chip and gas differ, how far is itself uncertain.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from service.estimation.compiled import compiled

Floats = npt.NDArray[np.float64]
Times = npt.NDArray[np.int64]

SMOOTHING_S = 0.25
"""Longer, and a cold shock is noticed too late: 2 s cost 0.3 N (design)."""


@dataclass(frozen=True)
class TemperatureState:
    """Of every tile: averaged counts, how long they were averaged, the gas', and since when."""

    chip_counts: Floats
    averaged_s: Floats
    gas_counts: Floats
    t_ns: Times


def at_rest(tiles: int) -> TemperatureState:
    """Before the first reading."""
    nothing = np.full(tiles, np.nan)
    return TemperatureState(nothing, np.zeros(tiles), nothing.copy(), np.zeros(tiles, np.int64))


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
        chip, gas = np.empty_like(kpa), np.empty_like(kpa)
        mean, averaged_s = state.chip_counts.copy(), state.averaged_s.copy()
        follower, last_ns = state.gas_counts.copy(), state.t_ns.copy()
        _follow(
            np.ascontiguousarray(tadc),
            np.ascontiguousarray(t_ns),
            self.lag_s,
            mean,
            averaged_s,
            follower,
            last_ns,
            chip,
            gas,
        )
        warmed_kpa = self.kpa_per_count * (gas - self.tare_counts)
        part = warmed_kpa / self.baseline_kpa
        sigma_kpa = np.hypot(
            self.relative_sigma * warmed_kpa,
            self.relative_lag_sigma * self.kpa_per_count * (chip - gas),
        )
        return kpa / (1.0 + part), sigma_kpa, TemperatureState(mean, averaged_s, follower, last_ns)


@compiled
def _follow(
    tadc: Floats,
    t_ns: Times,
    lag_s: Floats,
    chip_counts: Floats,
    averaged_s: Floats,
    gas_counts: Floats,
    last_ns: Times,
    chip: Floats,
    gas: Floats,
) -> None:
    n, tiles = tadc.shape
    for j in range(tiles):
        mean, known_s, follower, before_ns = (
            chip_counts[j],
            averaged_s[j],
            gas_counts[j],
            last_ns[j],
        )
        for i in range(n):
            counts = tadc[i, j]
            if not math.isnan(counts):
                if math.isnan(mean):
                    mean, follower = counts, counts
                else:
                    dt = max(0.0, (t_ns[i, j] - before_ns) * 1e-9)
                    # What has been averaged for a short time is a plain mean of it.
                    known_s = min(known_s + dt, SMOOTHING_S)
                    new = -math.expm1(-dt / known_s) if known_s > 0.0 else 0.0
                    before = mean
                    mean += new * (counts - mean)
                    decay = math.exp(-dt / lag_s[j])
                    # Exact for a chip whose temperature is linear between readings.
                    drive = -math.expm1(-dt / lag_s[j]) * lag_s[j] / dt if dt > 0.0 else 1.0
                    follower = decay * follower + (drive - decay) * before + (1.0 - drive) * mean
                before_ns = t_ns[i, j]
            chip[i, j], gas[i, j] = mean, follower
        chip_counts[j], averaged_s[j], gas_counts[j] = mean, known_s, follower
        last_ns[j] = before_ns
