"""`temperature`: the baseline of a sealed bubble, which follows p/T of its gas (hardware.md 9).

The raw temperature is the chip's. Gas and chip follow the surroundings one behind the other, by a
lag of some seconds that is measured per tile in the rig's thermal soak. Where the gas lags, it
follows its chip as through a low-pass, which suppresses the noise of a reading. Where the chip
lags, the gas is ahead: its rise goes on for the lag. Only the past is known, so the rise is that of
a chip smoothed twice, over an eighth of the lag, which keeps the remaining noise below that of a
reading. The uncertainty of the lag times the rise is part of sigma.

Pressure is referred to the tare's temperature in proportion to itself, because a warmer gas also
responds to a squeeze more strongly.
"""

from __future__ import annotations

import math
from typing import NamedTuple, Self

import numpy as np

from devices.arrays import Floats, Times
from devices.jit import jit_cached
from service.estimation.effects import parameter_values
from service.estimation.models import LoadBearingTiles, ModelParams
from service.estimation.records import KernelRecord, RecordArray

STARTUP_S = 0.5
"""Time at first for which the chip's mean temperature stands for the gas."""
START_TOLERANCE_K = 2.0 / 5.35  # two counts of an MPL115A2
"""Largest distance from the tare's temperature at which a starting gas is as warm as its chip."""
SMOOTHING_MIN_S = 0.1
"""Shortest time over which a chip's temperature is smoothed for its rise."""
SMOOTHING_PER_LAG = 0.125
"""Smoothing time of a chip that lags its gas, as a part of the lag."""


class TemperatureParams(ModelParams):
    """Parameters of a tile; the last two follow from the others and the chip."""

    effect = "temperature"
    is_needed_of_every_tile = True

    kpa_per_count: float  # rise of the baseline for a raw count of the gas; negative
    relative_sigma: float  # standard uncertainty of that, relative
    lag_s: float  # of the gas behind its chip; negative where the chip lags
    lag_sigma_s: float
    tare_counts: float  # mean raw temperature during the tare
    baseline_kpa: float  # absolute pressure at the tare
    start_tolerance_counts: float
    smoothing_s: float
    noise_counts: float

    @classmethod
    def make(cls, tiles: LoadBearingTiles) -> RecordArray[Self]:
        """Make the parameters of load-bearing tiles, (tiles,)."""
        found = [e for tile in tiles.calibrations if (e := tile.effects.temperature) is not None]
        lag_s = parameter_values(e.lag_s for e in found)
        return cls.array(
            len(found),
            kpa_per_count=parameter_values(e.kpa_per_k for e in found) / tiles.counts_per_kelvin,
            relative_sigma=[e.kpa_per_k.sigma / e.kpa_per_k.value for e in found],
            lag_s=lag_s,
            lag_sigma_s=[e.lag_s.sigma for e in found],
            tare_counts=tiles.tare_counts,
            baseline_kpa=tiles.baseline_kpa,
            start_tolerance_counts=START_TOLERANCE_K * np.abs(tiles.counts_per_kelvin),
            smoothing_s=compute_smoothing_s(lag_s),
            noise_counts=compute_gas_temperature_noise_counts(
                lag_s, tiles.step_s, tiles.temperature_noise_counts
            ),
        )

    @classmethod
    def longest_time_constant_s(cls, params: RecordArray[Self]) -> float:
        """Return the longest lag of a tile."""
        return float(np.abs(params["lag_s"]).max())


class TemperatureState(KernelRecord):
    """State of a tile; NaN before the first reading."""

    smoothed_counts: float = np.nan  # the chip's, through one low-pass
    smoothed_twice_counts: float = np.nan  # and through a second one
    chip_counts: float = np.nan
    first_counts: float = np.nan
    first_ns: int
    t_ns: int
    gas_counts: float = np.nan
    rise_counts_per_s: float = np.nan  # of the gas


def compute_smoothing_s(lag_s: Floats) -> Floats:
    """Return the smoothing time of the chip's temperature: the lag, or an eighth of a lead."""
    time_s = np.where(lag_s >= 0.0, lag_s, -SMOOTHING_PER_LAG * lag_s)
    return np.asarray(np.maximum(time_s, SMOOTHING_MIN_S))


def compute_gas_temperature_noise_counts(
    gas_lag_s: Floats, step_s: float, reading_counts: Floats | float
) -> Floats:
    """Return the noise of the gas' counts by that of a chip's reading; 0 where the gas lags."""
    time_s = compute_smoothing_s(gas_lag_s)
    lead = np.where(gas_lag_s < 0.0, 1.0 - gas_lag_s / time_s, 0.0)
    # (1 + (1 + lead) S s)/(1 + S s)^2 of white noise; the low-pass of a lag removes nearly all.
    power = step_s * (1.0 + (1.0 + lead) ** 2) / (4.0 * time_s)
    return np.asarray(
        np.where(gas_lag_s < 0.0, reading_counts * np.sqrt(np.minimum(power, 4.0)), 0.0)
    )


class GasTemperatures(NamedTuple):
    """Temperatures of the tiles' gas, (n, tiles) each."""

    counts: Floats
    rise_counts_per_s: Floats


def compute_gas_counts_and_rise_per_s(
    temperature_raw: Floats, t_ns: Times, gas_lag_s: Floats
) -> GasTemperatures:
    """Compute every tile's gas temperature, from rest.

    Args:
        temperature_raw: (n, tiles), raw temperatures of the chips, NaN where there are none.
        t_ns: (n, tiles), instants.
        gas_lag_s: (tiles,), negative where the chip lags.
    """
    gas, rise = np.empty(temperature_raw.shape), np.empty(temperature_raw.shape)
    params = TemperatureParams.array(
        len(gas_lag_s), lag_s=gas_lag_s, smoothing_s=compute_smoothing_s(gas_lag_s)
    )
    _update_gas_temperatures(
        params, TemperatureState.array(len(gas_lag_s)), temperature_raw, t_ns, gas, rise
    )
    return GasTemperatures(gas, rise)


@jit_cached
def refer_to_tare_temperature_with_sigma(
    params: TemperatureParams,
    state: TemperatureState,
    kpa: float,
    temperature_raw: float,
    t_ns: int,
) -> tuple[float, float]:
    """Refer a pressure to the tare's temperature; return it and the uncertainty of that in kPa.

    Args:
        params: of the tile.
        state: after the tile's readings before; updated.
        kpa: absolute pressure.
        temperature_raw: counts, NaN if there are none.
        t_ns: instant.
    """
    _update_gas_temperature(params, state, temperature_raw, t_ns)
    # A chip that starts away from the tare's temperature says nothing of its gas: all of the
    # distance is uncertain, and less so with every lag that passes.
    start_counts = state.first_counts - params.tare_counts
    unknown_counts = 0.0
    if abs(start_counts) > params.start_tolerance_counts:
        since_s = max(t_ns - state.first_ns, 0) * 1e-9
        unknown_counts = start_counts * math.exp(-since_s / max(abs(params.lag_s), SMOOTHING_MIN_S))
    warmed_kpa = params.kpa_per_count * (state.gas_counts - params.tare_counts)
    sigma_kpa = math.sqrt(
        (params.relative_sigma * warmed_kpa) ** 2
        + (params.kpa_per_count * params.lag_sigma_s * state.rise_counts_per_s) ** 2
        + (params.kpa_per_count * unknown_counts) ** 2
        + (params.kpa_per_count * params.noise_counts) ** 2
    )
    scale = 1.0 + warmed_kpa / params.baseline_kpa
    # Counts below absolute zero are not valid.
    return kpa / scale if scale > 0.0 else math.nan, sigma_kpa


@jit_cached
def _update_gas_temperature(
    params: TemperatureParams, state: TemperatureState, temperature_raw: float, t_ns: int
) -> None:
    """Update the gas' temperature with a reading of the chip, or without one (NaN)."""
    smooth = params.smoothing_s
    if math.isfinite(temperature_raw):
        if math.isnan(state.smoothed_counts):  # the best assumption: as warm as its chip
            state.smoothed_counts = state.smoothed_twice_counts = temperature_raw
            state.first_counts, state.first_ns = temperature_raw, t_ns
        else:
            dt = max(0.0, (t_ns - state.t_ns) * 1e-9)
            known_s = (t_ns - state.first_ns) * 1e-9
            # At first a plain mean: a single noisy count would stay for the whole lag.
            time = smooth if known_s > STARTUP_S else min(smooth, max(dt, known_s))
            if dt > 0.0:
                # Exact for a chip whose temperature is linear between readings; the smoothed one
                # is taken for linear, too.
                decay = math.exp(-dt / time)
                mean = -math.expm1(-dt / time) * time / dt
                before, twice = state.smoothed_counts, state.smoothed_twice_counts
                once = (
                    decay * before
                    + (mean - decay) * state.chip_counts
                    + (1.0 - mean) * temperature_raw
                )
                state.smoothed_twice_counts = (
                    decay * twice + (mean - decay) * before + (1.0 - mean) * once
                )
                state.smoothed_counts = once
        state.chip_counts, state.t_ns = temperature_raw, t_ns
    once, ahead = state.smoothed_counts, state.chip_counts - state.smoothed_counts
    if params.lag_s < 0.0:
        ahead = once - state.smoothed_twice_counts
    state.gas_counts = once + (1.0 - params.lag_s / smooth) * ahead
    state.rise_counts_per_s = ahead / smooth


@jit_cached
def _update_gas_temperatures(
    params: RecordArray[TemperatureParams],
    states: RecordArray[TemperatureState],
    temperature_raw: Floats,
    t_ns: Times,
    gas: Floats,
    rise: Floats,
) -> None:
    n, tiles = temperature_raw.shape
    for i in range(n):
        for j in range(tiles):
            _update_gas_temperature(params[j], states[j], temperature_raw[i, j], t_ns[i, j])
            gas[i, j], rise[i, j] = states[j].gas_counts, states[j].rise_counts_per_s
