"""`temperature`: the gas follows its chip with a lag, and its baseline follows the gas."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from devices.chips.mpl115a2 import MPL115A2
from service.estimation.models.temperature import (
    START_TOLERANCE_K,
    TemperatureParams,
    TemperatureState,
    compute_gas_temperature_noise_counts,
    compute_smoothing_s,
    refer_to_tare_temperature_with_sigma,
)
from tests.builders.readings import through

LAG_S, LAG_SIGMA_S, KPA_PER_COUNT, BASE_KPA, TARE = 3.0, 0.3, -0.056, 100.0, 480.0


def refer(
    kpa: Any,
    temperature_raw: Any,
    t_s: Any,
    *,
    lag_s: float = LAG_S,
    kpa_per_count: float = KPA_PER_COUNT,
) -> tuple[np.ndarray, np.ndarray]:
    """Refer pressures to the tare's temperature; return them and their uncertainty."""
    lag = np.array([lag_s])
    model = TemperatureParams.array(
        1,
        kpa_per_count=kpa_per_count,
        relative_sigma=0.02,
        lag_s=lag,
        lag_sigma_s=LAG_SIGMA_S,
        tare_counts=TARE,
        baseline_kpa=BASE_KPA,
        smoothing_s=compute_smoothing_s(lag),
        start_tolerance_counts=abs(START_TOLERANCE_K * MPL115A2.counts_per_kelvin),
        noise_counts=compute_gas_temperature_noise_counts(
            lag, 0.002, MPL115A2.temperature_noise_counts
        ),
    )
    t_ns = np.rint(1e9 * np.asarray(t_s, dtype=float)).astype(np.int64)
    readings = kpa, np.asarray(temperature_raw, dtype=float), t_ns
    referred = through(
        refer_to_tare_temperature_with_sigma, model, TemperatureState.array(1), *readings
    )
    return referred[:, 0], referred[:, 1]


def follow(
    temperature_raw: Any, t_s: Any, *, lag_s: float = LAG_S
) -> tuple[np.ndarray, np.ndarray]:
    """Return the counts of the gas by which pressures were corrected, and their uncertainty."""
    out, sigma_kpa = refer(BASE_KPA, temperature_raw, t_s, lag_s=lag_s)
    return TARE + BASE_KPA / KPA_PER_COUNT * (BASE_KPA / out - 1), sigma_kpa


@pytest.mark.parametrize("lag_s", [-3.0, -0.5, -0.01])
def test_a_gas_leads_an_evenly_warming_chip_with_a_negative_lag(lag_s: float) -> None:
    t_s = np.arange(0.0, 12.0, 0.002)
    counts, _ = follow(TARE - 2.0 * np.maximum(t_s - 1.0, 0.0), t_s, lag_s=lag_s)
    assert counts[-1] == pytest.approx(TARE - 2.0 * (11.0 - 0.002 - lag_s), abs=0.01)
    assert counts[:500] == pytest.approx(np.full(500, TARE), abs=1e-9)


@pytest.mark.parametrize("lag_s", [-10.0, -2.0, -0.3])
def test_the_noise_of_a_leading_gas_is_less_than_that_of_a_reading(lag_s: float) -> None:
    rng = np.random.default_rng(1)
    t_s = np.arange(0.0, 100.0, 0.002)
    chip = TARE + rng.normal(0, MPL115A2.temperature_noise_counts, len(t_s))
    counts, sigma_kpa = follow(chip, t_s, lag_s=lag_s)
    left = counts[10_000:].std()
    noise_counts = MPL115A2.temperature_noise_counts
    stated = compute_gas_temperature_noise_counts(np.array([lag_s]), 0.002, noise_counts)[0]
    assert left < MPL115A2.temperature_noise_counts
    assert left == pytest.approx(stated, rel=0.2)
    assert np.median(sigma_kpa) >= 0.95 * abs(KPA_PER_COUNT) * left


@pytest.mark.parametrize(("lag_s", "left_kpa"), [(-2.0, 0.12), (-1.0, 0.06), (1.0, 0.02)])
def test_a_cold_shock_is_nearly_corrected(lag_s: float, left_kpa: float) -> None:
    # Two lags one behind the other in closed form, of 1.2 s and of the lag, by 4 K: 1.2 kPa.
    t_s = np.arange(0.0, 20.0, 0.002)
    since_s, (a, b) = np.maximum(t_s - 5.0, 0.0), (1.2, abs(lag_s))
    first = 21.4 * (1 - np.exp(-since_s / a))
    second = 21.4 * (1 - (a * np.exp(-since_s / a) - b * np.exp(-since_s / b)) / (a - b))
    chip, gas = (first, second) if lag_s > 0.0 else (second, first)
    counts, sigma_kpa = follow(TARE + chip, t_s, lag_s=lag_s)
    shock = since_s > 0.0
    off_kpa = np.abs(KPA_PER_COUNT * (counts - TARE - gas))[shock]
    uncorrected_kpa = np.abs(KPA_PER_COUNT * (chip - gas))[shock]
    assert off_kpa.mean() < min(left_kpa, 0.3 * uncorrected_kpa.mean())
    # The uncertainty of the lag accounts for the rest.
    assert (off_kpa < 1.96 * sigma_kpa[shock] + 0.02).mean() > 0.8


def test_a_correction_is_in_proportion_to_the_pressure() -> None:
    # Ten counts colder are 0.56 kPa at the baseline, and a fifth more at 120 kPa.
    out, _ = refer(119.328, TARE + 10, np.arange(5))
    assert out == pytest.approx(np.full(5, 120.0), abs=1e-12)


def test_a_pressure_without_a_possible_temperature_is_nan() -> None:
    out, _ = refer(100.0, [math.nan, TARE], [0.0, 0.002])
    assert np.isnan(out).tolist() == [True, False]
    # 0.2 kPa a count over 543 counts is more than the whole baseline: below absolute zero.
    out, _ = refer(100.0, [1023.0], [0.0], kpa_per_count=-0.2)
    assert np.isnan(out).all()


def test_the_difference_of_chip_and_gas_is_uncertain() -> None:
    chip = np.where(np.arange(2000) < 1000, TARE, TARE - 20)
    counts, sigma_kpa = follow(chip, 0.002 * np.arange(2000))
    expected_kpa = np.hypot(
        0.02 * KPA_PER_COUNT * (counts - TARE), 0.1 * KPA_PER_COUNT * (chip - counts)
    )
    assert sigma_kpa == pytest.approx(expected_kpa, abs=1e-9)
    assert sigma_kpa[999:1001] == pytest.approx([0.0, 0.1 * 0.056 * 20], rel=0.01, abs=1e-9)


def test_a_start_away_from_the_tares_temperature_is_uncertain_for_some_lags() -> None:
    # Twenty counts away: the gas may be anywhere between, 1.1 kPa.
    t_s = np.arange(0.0, 20.0, 0.01)
    _, sigma_kpa = follow(np.full(len(t_s), TARE + 20.0), t_s)
    far_kpa = abs(KPA_PER_COUNT) * 20.0
    assert sigma_kpa[0] > 0.99 * far_kpa
    assert sigma_kpa[int(LAG_S / 0.01)] == pytest.approx(far_kpa * math.exp(-1), rel=0.01)
    assert sigma_kpa[-1] < 0.03 * far_kpa
    _, near_kpa = follow([TARE + 1.0] * 9, 0.002 * np.arange(9))
    assert (near_kpa < 0.01).all()
