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

from devices.arrays import Floats, Times
from devices.compiled import compiled
from service.estimation.records import Record, Records, record_type, records

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


LAW = record_type(
    [
        ("kpa_per_count", np.float64),
        ("relative_sigma", np.float64),
        ("lag_s", np.float64),
        ("lag_sigma_s", np.float64),
        ("tare_counts", np.float64),
        ("baseline_kpa", np.float64),
        ("smoothing_s", np.float64),
        ("noise_counts", np.float64),
    ]
)
"""Constants of a tile, as in `Temperature`; the last two follow from the others."""
STATE = record_type(
    [
        ("once_counts", np.float64),
        ("twice_counts", np.float64),
        ("chip_counts", np.float64),
        ("first_counts", np.float64),
        ("first_ns", np.int64),
        ("t_ns", np.int64),
        ("gas_counts", np.float64),
        ("rise_per_s", np.float64),
    ]
)
"""Of a tile: counts of its chip, smoothed once, twice and not, the first, and instants; and what
follows for its gas: counts, and how fast they rise. NaN before the first reading."""


def at_rest(tiles: int) -> Records:
    """Before the first reading."""
    unknown = ("once", "twice", "chip", "first", "gas")
    return records(
        STATE, tiles, **{f"{name}_counts": np.nan for name in unknown}, rise_per_s=np.nan
    )


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

    def laws(self) -> Records:
        """The constants, tile by tile."""
        given = {name: value for name, value in vars(self).items() if name != "step_s"}
        return records(
            LAW,
            len(self.lag_s),
            **given,
            smoothing_s=smoothing_s(self.lag_s),
            noise_counts=noise_counts(self.lag_s, self.step_s),
        )


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


def followed(tadc: Floats, t_ns: Times, lag_s: Floats) -> tuple[Floats, Floats]:
    """Counts of every tile's gas from rest on, and how fast they rise in counts a second.

    Args:
        tadc: counts of the chips (n, tiles), NaN where there are none.
        t_ns: instants (n, tiles).
        lag_s: (tiles,), negative where the chip is behind.
    """
    gas, rise = np.empty(tadc.shape), np.empty(tadc.shape)
    laws = records(LAW, len(lag_s), lag_s=lag_s, smoothing_s=smoothing_s(lag_s))
    _follow(laws, at_rest(len(lag_s)), tadc, t_ns, gas, rise)
    return gas, rise


@compiled
def at_tare(law: Record, state: Record, kpa: float, tadc: float, t_ns: int) -> tuple[float, float]:
    """Pressure as it would be at the tare's temperature, and its uncertainty from temperature.

    Args:
        law: constants of the tile.
        state: from its readings before; becomes that after this one.
        kpa: absolute pressure.
        tadc: counts, NaN if there are none.
        t_ns: instant.
    """
    follow(law, state, tadc, t_ns)
    # Where the chip began away from the tare's temperature, it is not known how far the gas is
    # from it: all of that is uncertain, and less so with every lag that passes.
    away = state.first_counts - law.tare_counts
    unknown = 0.0
    if abs(away) > NEAR_COUNTS:
        since_s = max(t_ns - state.first_ns, 0) * 1e-9
        unknown = away * math.exp(-since_s / max(abs(law.lag_s), SMOOTH_LEAST_S))
    warmed_kpa = law.kpa_per_count * (state.gas_counts - law.tare_counts)
    sigma_kpa = math.sqrt(
        (law.relative_sigma * warmed_kpa) ** 2
        + (law.kpa_per_count * law.lag_sigma_s * state.rise_per_s) ** 2
        + (law.kpa_per_count * unknown) ** 2
        + (law.kpa_per_count * law.noise_counts) ** 2
    )
    scale = 1.0 + warmed_kpa / law.baseline_kpa
    # Counts below absolute zero are not valid.
    return kpa / scale if scale > 0.0 else math.nan, sigma_kpa


@compiled
def follow(law: Record, state: Record, tadc: float, t_ns: int) -> None:
    """Take another reading of the chip, or none (NaN), for what its gas does."""
    smooth = law.smoothing_s
    if math.isfinite(tadc):
        if math.isnan(state.once_counts):  # as warm as its chip, as far as one can know
            state.once_counts = state.twice_counts = state.first_counts = tadc
            state.first_ns = t_ns
        else:
            dt = max(0.0, (t_ns - state.t_ns) * 1e-9)
            known_s = (t_ns - state.first_ns) * 1e-9
            # At first a plain mean: a single noisy count would stay for the whole lag.
            time = smooth if known_s > SETTLE_S else min(smooth, max(dt, known_s))
            if dt > 0.0:
                # Exact for a chip whose temperature is linear between readings; so is taken what
                # is smoothed once.
                decay = math.exp(-dt / time)
                mean = -math.expm1(-dt / time) * time / dt
                before, twice = state.once_counts, state.twice_counts
                once = decay * before + (mean - decay) * state.chip_counts + (1.0 - mean) * tadc
                state.twice_counts = decay * twice + (mean - decay) * before + (1.0 - mean) * once
                state.once_counts = once
        state.chip_counts, state.t_ns = tadc, t_ns
    once, ahead = state.once_counts, state.chip_counts - state.once_counts
    if law.lag_s < 0.0:
        ahead = once - state.twice_counts
    state.gas_counts = once + (1.0 - law.lag_s / smooth) * ahead
    state.rise_per_s = ahead / smooth


@compiled
def _follow(
    laws: Records, state: Records, tadc: Floats, t_ns: Times, gas: Floats, rise: Floats
) -> None:
    n, tiles = tadc.shape
    for i in range(n):
        for j in range(tiles):
            follow(laws[j], state[j], tadc[i, j], t_ns[i, j])
            gas[i, j], rise[i, j] = state[j].gas_counts, state[j].rise_per_s
