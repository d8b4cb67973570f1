"""How baselines move: what temperature explains since a tare, and the trend of a history."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from devices.chips.mpl115a2 import TADC_PER_KELVIN
from service.estimation.tare.tare import (
    TEMPERATURE_CHANGE_MAX_COUNTS,
    TREND_OVER_NS,
    TREND_SPAN_MIN_NS,
    Tare,
    compute_sealed_gas_shift_kpa,
    compute_warming_k,
    fit_recent_baseline_trend,
    has_temperature_changed,
)
from tests.builders.arrays import UTC_NS
from tests.builders.calibrations import make_tare

HOUR_NS = 3_600_000_000_000


def tare(
    hours: float = 0.0,
    *,
    kpa: Sequence[float] = (100.0, 96.0),
    temperature_raw: Sequence[float] = (480.0, 500.0),
    sigma_kpa: float = 0.01,
) -> Tare:
    return make_tare(
        len(kpa),
        baseline_kpa=kpa,
        baseline_sigma_kpa=sigma_kpa,
        temperature_raw_counts=temperature_raw,
        t_ns=UTC_NS + round(hours * HOUR_NS),
        source="unloaded",
    )


def test_five_kelvin_are_27_counts_less_and_1_7_kilopascals_more() -> None:
    # 100 kPa sealed at 298 K: 0.3356 kPa/K
    warmer = compute_warming_k(tare(), np.array([480.0 - 26.75, 500.0]))
    assert warmer == pytest.approx([5.0, 0.0])
    assert compute_sealed_gas_shift_kpa(tare(), warmer) == pytest.approx([500.0 / 298.0, 0.0])


def test_a_tile_has_warmed_once_its_chip_has_moved_by_more_than_the_bound() -> None:
    at, beyond = TEMPERATURE_CHANGE_MAX_COUNTS, TEMPERATURE_CHANGE_MAX_COUNTS + 0.5
    assert has_temperature_changed(tare(), [480.0 - at, 500.0 + at]).tolist() == [False, False]
    assert has_temperature_changed(tare(), [480.0 - beyond, 500.0 + beyond]).tolist() == [
        True,
        True,
    ]
    assert has_temperature_changed(tare(), [[480.0, np.nan], [400.0, 500.0]]).tolist() == [
        [False, False],
        [True, False],
    ]
    unknown = tare(temperature_raw=(np.nan, 500.0))
    assert has_temperature_changed(unknown, [0.0, 0.0]).tolist() == [False, True]


def test_a_trend_is_the_straight_line_through_the_baselines() -> None:
    # +0.3 kPa and -2 counts an hour on T01, nothing on T02
    tares = [
        tare(h, kpa=(100 + 0.3 * h, 96.0), temperature_raw=(480 - 2 * h, 500.0))
        for h in (0, 0.5, 2, 3)
    ]
    found = fit_recent_baseline_trend(tares, tiles=2)
    assert found.kpa_per_hour == pytest.approx([0.3, 0.0], abs=1e-9)
    assert found.kelvin_per_hour == pytest.approx([-2.0 / TADC_PER_KELVIN, 0.0], abs=1e-9)
    # least squares: sigma / sqrt(sum of squared distances from the mean of 1.375 h)
    hours = np.array([0.0, 0.5, 2.0, 3.0]) - 1.375
    assert found.sigma_kpa_per_hour == pytest.approx([0.01 / np.sqrt((hours**2).sum())] * 2)


def test_a_trend_needs_ten_minutes_and_two_tares() -> None:
    short = (TREND_SPAN_MIN_NS - 1e9) / HOUR_NS
    for tares in ([], [tare()], [tare(), tare(short)], [tare(), tare()]):
        found = fit_recent_baseline_trend(tares, tiles=2)
        for values in (found.kpa_per_hour, found.sigma_kpa_per_hour, found.kelvin_per_hour):
            assert np.isnan(values).tolist() == [True, True]
    assert np.isfinite(
        fit_recent_baseline_trend([tare(), tare(short + 1 / 60)], tiles=2).kpa_per_hour
    ).all()


def test_a_tare_of_unknown_temperature_leaves_the_pressure_trend() -> None:
    found = fit_recent_baseline_trend([tare(temperature_raw=(np.nan, np.nan)), tare(1.0)], tiles=2)
    assert np.isfinite(found.kpa_per_hour).all()
    assert np.isnan(found.kelvin_per_hour).all()


def test_what_was_before_the_last_hours_does_not_count() -> None:
    old = TREND_OVER_NS / HOUR_NS + 1.5
    tares = [tare(-old, kpa=(50.0, 50.0)), tare(-1.0), tare(0.0, kpa=(100.5, 96.0))]
    assert fit_recent_baseline_trend(tares, tiles=2).kpa_per_hour == pytest.approx(
        [0.5, 0.0], abs=1e-9
    )
