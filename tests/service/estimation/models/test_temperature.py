"""`temperature`: the gas follows its chip with one lag, and its baseline follows the gas."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.estimation.models.temperature import (
    READING_NOISE_COUNTS,
    STARTUP_S,
    TemperatureModel,
    compute_gas_temperature_noise_counts,
    initial_state,
    refer_to_tare_temperature_with_sigma,
)
from tests.builders.readings import through

LAG_S, LAG_SIGMA_S, KPA_PER_COUNT, BASE_KPA, TARE = 3.0, 0.3, -0.056, 100.0, 480.0


def model(*, lag_s: float = LAG_S, kpa_per_count: float = KPA_PER_COUNT) -> TemperatureModel:
    values = (kpa_per_count, 0.02, lag_s, LAG_SIGMA_S, TARE, BASE_KPA)
    per_count, relative, lag, lag_sigma, tare, base = (np.array([x]) for x in values)
    return TemperatureModel(per_count, relative, lag, lag_sigma, tare, base, 0.002)


def taken_back(
    of: TemperatureModel, kpa: Any, temperature_raw: Any, t_ns: Any
) -> tuple[np.ndarray, np.ndarray]:
    """Pressures as they would be at the tare's temperature, and their uncertainty."""
    out, sigma_kpa = through(
        refer_to_tare_temperature_with_sigma,
        of.to_records(),
        initial_state(1),
        kpa,
        temperature_raw,
        t_ns,
    ).T
    return out, sigma_kpa


def followed(
    temperature_raw: Any, t_s: Any, kpa: float = BASE_KPA, **changes: float
) -> tuple[np.ndarray, np.ndarray]:
    """Counts of the gas that the corrected pressures show, and their uncertainty."""
    t_ns = np.rint(1e9 * np.asarray(t_s, dtype=float)).astype(np.int64)
    out, sigma_kpa = taken_back(
        model(**changes), kpa, np.asarray(temperature_raw, dtype=float), t_ns
    )
    per_count = changes.get("kpa_per_count", KPA_PER_COUNT)
    return TARE + BASE_KPA / per_count * (kpa / out - 1), sigma_kpa


def test_behind_a_chip_that_warms_evenly_the_gas_is_late_by_its_lag() -> None:
    # lag x' = chip - x: behind by rate lag (1 - exp(-t/lag)); irregular steps are no matter.
    rng = np.random.default_rng(0)
    still_s = np.linspace(0.0, 2 * STARTUP_S, 50)
    ramp_s = np.cumsum(rng.choice([0.001, 0.002, 0.3], 100))
    chip = np.concatenate([np.full(50, TARE), TARE - 2.0 * ramp_s])
    counts, _ = followed(chip, np.concatenate([still_s, still_s[-1] + ramp_s]))
    expected = TARE - 2.0 * (ramp_s - LAG_S * (1 - np.exp(-ramp_s / LAG_S)))
    assert counts[50:] == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize("lag_s", [-3.0, -0.5, -0.01])
def test_a_gas_that_leads_its_chip_is_where_an_even_rise_will_have_brought_the_chip(
    lag_s: float,
) -> None:
    t_s = np.arange(0.0, 12.0, 0.002)
    counts, _ = followed(TARE - 2.0 * np.maximum(t_s - 1.0, 0.0), t_s, lag_s=lag_s)
    assert counts[-1] == pytest.approx(TARE - 2.0 * (11.0 - 0.002 - lag_s), abs=0.01)
    assert counts[:500] == pytest.approx(np.full(500, TARE), abs=1e-9)


@pytest.mark.parametrize("lag_s", [-10.0, -2.0, -0.3])
def test_noise_of_a_chip_that_is_behind_its_gas_stays_below_that_of_a_reading(lag_s: float) -> None:
    rng = np.random.default_rng(1)
    t_s = np.arange(0.0, 200.0, 0.002)
    counts, sigma_kpa = followed(
        TARE + rng.normal(0, READING_NOISE_COUNTS, len(t_s)), t_s, lag_s=lag_s
    )
    left = counts[10_000:].std()
    assert left < READING_NOISE_COUNTS
    assert left == pytest.approx(
        compute_gas_temperature_noise_counts(np.array([lag_s]), 0.002)[0], rel=0.2
    )
    assert np.median(sigma_kpa) >= 0.95 * abs(KPA_PER_COUNT) * left


@pytest.mark.parametrize(("lag_s", "left_kpa"), [(-2.0, 0.12), (-1.0, 0.06), (1.0, 0.02)])
def test_after_a_cold_shock_a_chip_that_is_behind_its_gas_is_nearly_made_up_for(
    lag_s: float, left_kpa: float
) -> None:
    # Two lags one behind the other in closed form, of 1.2 s and of the lag, by 4 K: 1.2 kPa.
    t_s = np.arange(0.0, 20.0, 0.002)
    since_s, (a, b) = np.maximum(t_s - 5.0, 0.0), (1.2, abs(lag_s))
    first = 21.4 * (1 - np.exp(-since_s / a))
    second = 21.4 * (1 - (a * np.exp(-since_s / a) - b * np.exp(-since_s / b)) / (a - b))
    chip, gas = (first, second) if lag_s > 0.0 else (second, first)
    counts, sigma_kpa = followed(TARE + chip, t_s, lag_s=lag_s)
    off_kpa = np.abs(KPA_PER_COUNT * (counts - TARE - gas))
    shock = since_s > 0.0
    assert off_kpa[shock].mean() < left_kpa
    without_kpa = np.abs(KPA_PER_COUNT * (chip - gas))
    assert off_kpa[shock].mean() < 0.3 * without_kpa[shock].mean()
    # A lag that is that uncertain accounts for it.
    assert (off_kpa[shock] < 1.96 * sigma_kpa[shock] + 0.02).mean() > 0.8


def test_pressure_is_taken_back_in_proportion_to_itself() -> None:
    # Ten counts colder are 0.56 kPa at the baseline, and a fifth more at 120 kPa.
    out, _ = taken_back(model(), 119.328, TARE + 10, np.arange(5))
    assert out == pytest.approx(np.full(5, 120.0), abs=1e-12)


def test_at_first_the_gas_is_taken_to_be_as_warm_as_the_mean_of_its_chip() -> None:
    # Noise of the first count would otherwise stay for the whole lag.
    temperature_raw = TARE + np.array([8.0, *np.tile([-1.0, 1.0], 120)])
    counts, _ = followed(temperature_raw, 0.002 * np.arange(241))
    assert abs(counts[-1] - TARE) < 0.1


def test_while_chip_and_gas_differ_how_far_is_uncertain() -> None:
    chip = np.where(np.arange(2000) < 1000, TARE, TARE - 20)
    counts, sigma_kpa = followed(chip, 0.002 * np.arange(2000))
    expected = np.hypot(
        0.02 * KPA_PER_COUNT * (counts - TARE), 0.1 * KPA_PER_COUNT * (chip - counts)
    )
    assert sigma_kpa == pytest.approx(expected, abs=1e-9)
    assert sigma_kpa[1000] == pytest.approx(0.1 * 0.056 * 20, rel=0.01)
    assert sigma_kpa[999] == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("back_s", [0.0, 0.001, 100.0])
def test_time_that_stands_still_or_goes_back_warms_nothing(back_s: float) -> None:
    counts, _ = followed([TARE, TARE, TARE - 30], [0.0, 2.0, 2.0 - back_s])
    assert counts == pytest.approx([TARE] * 3, abs=1e-9)


@pytest.mark.parametrize("nothing", [math.nan, math.inf, -math.inf])
def test_a_temperature_that_is_none_leaves_the_gas_as_it_was(nothing: float) -> None:
    chip = TARE - np.arange(9.0)
    chip[4] = nothing
    t_s, rest = 1.5 * np.arange(9), np.arange(9) != 4
    counts, _ = followed(chip, t_s)
    assert counts[4] == counts[3]
    assert counts[rest].tolist() == followed(chip[rest], t_s[rest])[0].tolist()


def test_before_the_first_temperature_there_is_no_pressure() -> None:
    out, _ = taken_back(model(), 100.0, np.array([math.nan, TARE]), np.arange(2))
    assert np.isnan(out).tolist() == [True, False]


def test_counts_below_absolute_zero_are_none() -> None:
    # 0.2 kPa a count over 543 counts is more than the whole baseline.
    out, _ = taken_back(model(kpa_per_count=-0.2), 100.0, 1023.0, np.zeros(1, np.int64))
    assert np.isnan(out).all()


@given(
    temperature_raw=st.lists(st.integers(0, 1023), min_size=1, max_size=40),
    step_s=st.sampled_from([0.0, 1e-9, 0.002, 1.0, 60.0, 1e6]),
    lag_s=st.sampled_from([0.0, 1e-9, 0.3, 30.0, 1e9]),
)
def test_the_gas_is_never_outside_what_its_chip_has_been(
    temperature_raw: list[int], step_s: float, lag_s: float
) -> None:
    t_s = step_s * np.arange(len(temperature_raw))
    counts, _ = followed(temperature_raw, t_s, lag_s=lag_s, kpa_per_count=-0.05)
    assert (counts >= min(temperature_raw) - 1e-9).all()
    assert (counts <= max(temperature_raw) + 1e-9).all()


def test_an_estimate_that_begins_away_from_the_tares_temperature_says_that_it_does_not_know() -> (
    None
):
    # Twenty counts away: the gas may be anywhere between, 1.1 kPa, and is there after some lags.
    t_s = np.arange(0.0, 20.0, 0.01)
    _, sigma_kpa = followed(np.full(len(t_s), TARE + 20.0), t_s)
    far_kpa = abs(KPA_PER_COUNT) * 20.0
    assert sigma_kpa[0] > 0.99 * far_kpa
    at_a_lag = int(LAG_S / 0.01)
    assert sigma_kpa[at_a_lag] == pytest.approx(far_kpa * math.exp(-1), rel=0.01)
    assert sigma_kpa[-1] < 0.03 * far_kpa


def test_an_estimate_that_begins_at_the_tares_temperature_has_no_such_doubt() -> None:
    _, sigma_kpa = followed([TARE + 1.0] * 9, 0.002 * np.arange(9))
    assert (sigma_kpa < 0.01).all()
