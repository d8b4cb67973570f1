"""Which part of an unloaded tile's noise lasts, and what a mean leaves of it."""

from __future__ import annotations

import json
import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from devices.chips.compensation import Compensation
from devices.errors import TareError
from service.estimation.pipeline.plan import make_plan
from service.estimation.tare.tare import Tare
from service.estimation.tare.unloaded_windows import (
    compute_recording_tare,
    compute_variance_inflation,
    fit_correlated_variance_fraction_and_decay,
)
from tests.builders.arrays import COUNT_KPA, PERIOD_NS, make_array
from tests.builders.calibrations import make_calibration, newton_tile
from tests.builders.frames import loaded_frames


def readings_of(
    n: int, *, part: float, readings: float, seed: int, tiles: int = 1, count_kpa: float = 0.0
) -> np.ndarray:
    """Unloaded readings (n, tiles), of which a part of the variance decays over `readings`."""
    rng = np.random.default_rng(seed)
    phi = math.exp(-1.0 / readings)
    lasts = np.empty((n, tiles))
    lasts[0] = rng.normal(size=tiles)
    for i in range(1, n):
        lasts[i] = phi * lasts[i - 1] + math.sqrt(1.0 - phi**2) * rng.normal(size=tiles)
    off = math.sqrt(part) * lasts + math.sqrt(1.0 - part) * rng.normal(size=(n, tiles))
    kpa = 100.0 + 0.165 * off
    return np.round(kpa / count_kpa) * count_kpa if count_kpa else kpa


@pytest.mark.parametrize("count_kpa", [0.0, 0.1])
@pytest.mark.parametrize("n", [40, 300, 1000])
def test_white_noise_lasts_in_no_more_than_two_tares_of_a_thousand(
    n: int, count_kpa: float
) -> None:
    kpa = readings_of(n, part=0.0, readings=1.0, seed=n, tiles=2000, count_kpa=count_kpa)
    part = fit_correlated_variance_fraction_and_decay(kpa).fraction
    assert (part > 0.0).mean() <= 2e-3


@pytest.mark.parametrize(("part", "readings"), [(1.0, 5.5), (0.5, 5.5), (0.5, 20.0), (0.3, 10.0)])
def test_the_variance_of_a_mean_is_found_from_half_a_second(part: float, readings: float) -> None:
    kpa = readings_of(300, part=part, readings=readings, seed=3, tiles=400, count_kpa=0.1)
    found = compute_variance_inflation(*fit_correlated_variance_fraction_and_decay(kpa), 16)
    true = float(compute_variance_inflation(np.array([part]), np.array([readings]), 16)[0])
    assert np.median(found) == pytest.approx(true, rel=0.12)
    assert (found == 1.0).mean() < 0.1  # taken for white


def test_the_formula_is_the_sum_over_all_pairs() -> None:
    part, readings, n = 0.4, 7.0, 23
    phi = math.exp(-1.0 / readings)
    apart = np.abs(np.subtract.outer(np.arange(n), np.arange(n)))
    covariance = np.where(apart == 0, 1.0, part * phi**apart)
    found = compute_variance_inflation(np.array([part]), np.array([readings]), n)
    assert found[0] == pytest.approx(covariance.sum() / n, rel=1e-12)


@given(
    part=st.floats(0.0, 1.0),
    readings=st.floats(0.1, 1000.0),
    n=st.integers(1, 10_000),
)
def test_a_mean_leaves_no_less_than_of_white_noise_and_no_more_than_a_single_one(
    part: float, readings: float, n: int
) -> None:
    (left,) = compute_variance_inflation(np.array([part]), np.array([readings]), n)
    assert 1.0 - 1e-9 <= left <= n * (1.0 + 1e-9)


def test_a_tile_that_says_nothing_or_the_same_or_too_little_has_white_noise() -> None:
    kpa = readings_of(300, part=1.0, readings=8.0, seed=1, tiles=3)
    kpa[:, 0] = np.nan
    kpa[:, 1] = 100.0
    part, readings = fit_correlated_variance_fraction_and_decay(kpa)
    assert part[:2].tolist() == readings[:2].tolist() == [0.0, 0.0]
    assert part[2] > 0.5
    assert fit_correlated_variance_fraction_and_decay(kpa[:31]).fraction.tolist() == [0.0, 0.0, 0.0]


def test_readings_that_are_missing_change_little() -> None:
    kpa = readings_of(1000, part=0.8, readings=6.0, seed=2)
    holes = kpa.copy()
    holes[np.random.default_rng(0).random(1000) < 0.05] = np.nan
    assert compute_variance_inflation(
        *fit_correlated_variance_fraction_and_decay(holes), 16
    ) == pytest.approx(
        compute_variance_inflation(*fit_correlated_variance_fraction_and_decay(kpa), 16), rel=0.2
    )


# --- in a tare ------------------------------------------------------------------------------------


def tare_of(kpa: np.ndarray) -> Tare:
    """From readings of a stream without load."""
    frames = loaded_frames((kpa - 100.0) / COUNT_KPA)
    info = make_array(frames.tile_count)
    calibration = make_calibration(*(newton_tile(serial) for serial in info.serials))
    chips = Compensation(info.tiles)
    return compute_recording_tare(frames, chips, calibration, info.serials, interval_s=(0.0, 60.0))


def test_a_tare_says_what_lasts_and_is_itself_that_much_more_uncertain() -> None:
    kpa = readings_of(1000, part=0.9, readings=6.0, seed=5, tiles=2)
    kpa[:, 1] = readings_of(1000, part=0.0, readings=1.0, seed=6)[:, 0]
    tare = tare_of(kpa)
    assert tare.noise_lasting is not None
    assert tare.noise_lasting_s is not None
    assert tare.noise_lasting.tolist() == [pytest.approx(0.9, abs=0.15), 0.0]
    assert tare.noise_lasting_s.tolist() == [pytest.approx(6 * PERIOD_NS * 1e-9, rel=0.4), 0.0]
    by_noise = tare.baseline_sigma_kpa / tare.noise_kpa * math.sqrt(1000)
    assert by_noise.tolist() == [pytest.approx(math.sqrt(11.0), rel=0.25), pytest.approx(1.0)]


def test_a_tare_is_read_as_it_was_written_and_one_without_them_has_white_noise() -> None:
    tare = tare_of(readings_of(300, part=0.9, readings=6.0, seed=5, tiles=2))
    content = json.loads(json.dumps(tare.as_dict()))
    assert Tare.from_dict(content, tiles=2).as_dict() == tare.as_dict()
    white = Tare.from_dict(content | {"noise_lasting": None, "noise_lasting_s": None}, tiles=2)
    info = make_array(2)
    calibration = make_calibration(*(newton_tile(serial) for serial in info.serials))
    plan = make_plan(info, calibration, white, models=["static", "denoise"])
    assert (plan.variance_inflation == 1.0).all()
    now = make_plan(info, calibration, tare, models=["static", "denoise"])
    assert (now.variance_inflation[:, 16] > 2.0).all()


@pytest.mark.parametrize("wrong", [[0.5], [1.5, 0.0], [-0.1, 0.0], [None, 0.0], "a", [[0.5, 0.5]]])
def test_a_tare_with_an_impossible_noise_is_refused(wrong: Any) -> None:
    content = tare_of(readings_of(300, part=0.9, readings=6.0, seed=5, tiles=2)).as_dict()
    with pytest.raises(TareError, match="not readable"):
        Tare.from_dict({**content, "noise_lasting": wrong}, tiles=2)


@pytest.mark.parametrize(
    ("name", "wrong"),
    [
        ("baseline_kpa", -1.0),
        ("baseline_kpa", 1e300),
        ("baseline_sigma_kpa", -1e-3),
        ("baseline_sigma_kpa", 1e300),
        ("noise_kpa", -0.1),
        ("noise_kpa", 1e200),
        ("temperature_raw_counts", 1e300),
        ("temperature_raw_counts", -1.0),
    ],
)
def test_a_tare_that_no_chip_gives_is_refused(name: str, wrong: float) -> None:
    content = tare_of(readings_of(300, part=0.9, readings=6.0, seed=5, tiles=2)).as_dict()
    with pytest.raises(TareError, match="not readable"):
        Tare.from_dict({**content, name: [content[name][0], wrong]}, tiles=2)
