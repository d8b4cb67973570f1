"""Tares: their file, the drift that temperature explains, and the trend of a history."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from devices.chips.mpl115a2 import TADC_PER_KELVIN
from devices.chips.pressure_chips import Compensation
from devices.errors import TareError
from service.estimation.pipeline.plan import make_plan
from service.estimation.tare.tare import (
    TREND_OVER_NS,
    TREND_SPAN_MIN_NS,
    Tare,
    compute_sealed_gas_shift_kpa,
    compute_temperature_change_max_counts,
    compute_warming_k,
    fit_recent_baseline_trend,
    has_temperature_changed,
)
from service.estimation.tare.unloaded_windows import compute_recording_tare
from tests.builders.arrays import COUNT_KPA, PERIOD_NS, UTC_NS, make_array
from tests.builders.calibrations import make_calibration, make_tare
from tests.builders.frames import loaded_frames
from tests.builders.noise import draw_lasting_noise

HOUR_NS = 3_600_000_000_000
INFO = make_array(2)
PER_KELVIN = Compensation(INFO.tiles).counts_per_kelvin
CALIBRATION = make_calibration(*INFO.serials)


@pytest.fixture(scope="module")
def lasting_tare() -> Tare:
    """Tare of 2 s in which most noise of T01 lasts and that of T02 is white."""
    parts = [
        draw_lasting_noise(1000, 1, part=part, readings=6.0, seed=seed)
        for part, seed in ((0.9, 0), (0.0, 6))
    ]
    frames = loaded_frames(0.165 / COUNT_KPA * np.concatenate(parts, axis=1))
    chips = Compensation(INFO.tiles)
    return compute_recording_tare(frames, chips, CALIBRATION, INFO.serials, interval_s=(0.0, 60.0))


def test_a_tare_states_lasting_noise_and_is_less_certain_by_it(lasting_tare: Tare) -> None:
    tare = lasting_tare
    assert tare.noise_lasting is not None
    assert tare.noise_lasting_s is not None
    assert tare.noise_lasting.tolist() == [pytest.approx(0.9, abs=0.15), 0.0]
    assert tare.noise_lasting_s.tolist() == [pytest.approx(6 * PERIOD_NS * 1e-9, rel=0.4), 0.0]
    of_noise = tare.baseline_sigma_kpa / tare.noise_kpa * math.sqrt(1000)
    assert of_noise.tolist() == [pytest.approx(math.sqrt(11.0), rel=0.25), pytest.approx(1.0)]


def test_a_tare_is_read_as_written_and_an_older_one_has_white_noise(lasting_tare: Tare) -> None:
    content = json.loads(json.dumps(lasting_tare.as_dict()))
    assert Tare.from_dict(content, tiles=2).as_dict() == content
    older = Tare.from_dict(content | {"noise_lasting": None, "noise_lasting_s": None}, tiles=2)
    white, lasting = (
        make_plan(INFO, CALIBRATION, each, models=["static", "denoise"]).load_bearing_params[
            "variance_inflation"
        ]
        for each in (older, lasting_tare)
    )
    assert (white == 1.0).all()
    assert lasting[0, 16] > 2.0


@pytest.mark.parametrize(
    ("name", "wrong"),
    [
        *(("noise_lasting", x) for x in ([0.5], [1.5, 0.0], [-0.1, 0.0], [None, 0.0], "a")),
        ("noise_lasting", [[0.5, 0.5]]),
        *(("baseline_kpa", [100.0, x]) for x in (-1.0, 1e300)),
        *(("baseline_sigma_kpa", [0.1, x]) for x in (-1e-3, 1e300)),
        *(("noise_kpa", [0.1, x]) for x in (-0.1, 1e200)),
        *(("temperature_raw_counts", [480.0, x]) for x in (-1.0, 1e300)),
    ],
)
def test_an_impossible_tare_is_refused(lasting_tare: Tare, name: str, wrong: Any) -> None:
    with pytest.raises(TareError, match="not readable"):
        Tare.from_dict(lasting_tare.as_dict() | {name: wrong}, tiles=2)


# --- drift ----------------------------------------------------------------------------------------


def tare_at(
    hours: float = 0.0,
    *,
    kpa: Sequence[float] = (100.0, 96.0),
    temperature_raw: Sequence[float] = (480.0, 500.0),
) -> Tare:
    return make_tare(
        2,
        baseline_kpa=kpa,
        baseline_sigma_kpa=0.01,
        temperature_raw_counts=temperature_raw,
        t_ns=UTC_NS + round(hours * HOUR_NS),
    )


def test_five_kelvin_are_27_counts_less_and_1_7_kilopascals_more() -> None:
    # 100 kPa sealed at 298 K: 0.3356 kPa/K
    warmer = compute_warming_k(tare_at(), np.array([480.0 - 26.75, 500.0]), PER_KELVIN)
    assert warmer == pytest.approx([5.0, 0.0])
    assert compute_sealed_gas_shift_kpa(tare_at(), warmer) == pytest.approx([500.0 / 298.0, 0.0])


def test_a_temperature_has_changed_beyond_the_limit() -> None:
    most = float(compute_temperature_change_max_counts(PER_KELVIN)[0])
    assert most == 4.0
    counts = [
        [480.0 - most, 500.0 + most],
        [480.0 - most - 0.5, 500.0 + most + 0.5],
        [480.0, np.nan],
        [400.0, 500.0],
    ]
    expected = [[False, False], [True, True], [False, False], [True, False]]
    assert has_temperature_changed(tare_at(), counts, PER_KELVIN).tolist() == expected
    unknown = tare_at(temperature_raw=(np.nan, 500.0))
    assert has_temperature_changed(unknown, [0.0, 0.0], PER_KELVIN).tolist() == [False, True]


def test_a_trend_is_the_straight_line_through_the_baselines() -> None:
    # +0.3 kPa and -2 counts an hour on T01, nothing on T02
    tares = [
        tare_at(h, kpa=(100 + 0.3 * h, 96.0), temperature_raw=(480 - 2 * h, 500.0))
        for h in (0, 0.5, 2, 3)
    ]
    found = fit_recent_baseline_trend(tares, counts_per_kelvin=PER_KELVIN)
    assert found.kpa_per_hour == pytest.approx([0.3, 0.0], abs=1e-9)
    assert found.kelvin_per_hour == pytest.approx([-2.0 / TADC_PER_KELVIN, 0.0], abs=1e-9)
    # least squares: sigma / sqrt(sum of squared distances from the mean of 1.375 h)
    hours = np.array([0.0, 0.5, 2.0, 3.0]) - 1.375
    assert found.sigma_kpa_per_hour == pytest.approx([0.01 / np.sqrt((hours**2).sum())] * 2)


def test_a_trend_needs_ten_minutes_and_two_tares() -> None:
    short = (TREND_SPAN_MIN_NS - 1e9) / HOUR_NS
    for hours in ([], [0.0], [0.0, short], [0.0, 0.0]):
        found = fit_recent_baseline_trend([tare_at(h) for h in hours], counts_per_kelvin=PER_KELVIN)
        for values in (found.kpa_per_hour, found.sigma_kpa_per_hour, found.kelvin_per_hour):
            assert np.isnan(values).tolist() == [True, True]
    found = fit_recent_baseline_trend(
        [tare_at(), tare_at(short + 1 / 60)], counts_per_kelvin=PER_KELVIN
    )
    assert np.isfinite(found.kpa_per_hour).all()


def test_a_tare_of_unknown_temperature_has_a_pressure_trend_only() -> None:
    unknown = tare_at(temperature_raw=(np.nan, np.nan))
    found = fit_recent_baseline_trend([unknown, tare_at(1.0)], counts_per_kelvin=PER_KELVIN)
    assert np.isfinite(found.kpa_per_hour).all()
    assert np.isnan(found.kelvin_per_hour).all()


def test_a_trend_is_of_the_last_hours() -> None:
    old = TREND_OVER_NS / HOUR_NS + 1.5
    tares = [tare_at(-old, kpa=(50.0, 50.0)), tare_at(-1.0), tare_at(0.0, kpa=(100.5, 96.0))]
    found = fit_recent_baseline_trend(tares, counts_per_kelvin=PER_KELVIN)
    assert found.kpa_per_hour == pytest.approx([0.5, 0.0], abs=1e-9)
