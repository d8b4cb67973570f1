"""From pressure to counts: noise as measured on a real part, wrap, clip, temperature.

Figures: hardware.md 1.3 (0.165 kPa in all, 1.2 % of samples more than 0.5 kPa off) and 1.2.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from devices.chips.mpl115a2 import Coefficients
from devices.emulation.chips.mpl115a2 import ChipProperties, FrontEnd
from devices.emulation.fault_timing import FaultTiming
from devices.emulation.surroundings import ChipSite, Surroundings
from devices.scene.emulation_sections import EmulationSection
from tests.builders.arrays import DATA_SHEET_CHIP
from tests.devices.emulation.domes import PART

Floats = npt.NDArray[np.float64]

DATA_SHEET = Coefficients.from_words(DATA_SHEET_CHIP)
# With -5.35 counts per kelvin this chip reads 507, the data sheet's example, at 21 degC.
CHIP = ChipProperties(DATA_SHEET, conversion_ns=1_600_000, tadc_at_25_degc=507 - 4 * 5.35)
STEP_NS = 1_000_000
LAGS_S = PART.chip_lag_s, PART.gas_lag_s
COUNT_KPA = 0.1255  # hardware.md 1.3


def front_end(
    pressure: float | Callable[[float], float] = 96.587326,
    label: str = "test",
    over_range: FaultTiming | None = None,
    frozen: FaultTiming | None = None,
    **emulation: Any,
) -> FrontEnd:
    """Return a sense in a scene that begins at 7 us."""
    scene = EmulationSection(**emulation)
    site = ChipSite(
        pressure if callable(pressure) else (lambda _: pressure),
        LAGS_S,
        Surroundings(scene),
        scene,
        label,
        over_range=over_range,
        frozen=frozen,
    )
    site.begin_scene_time(7_000)
    return FrontEnd(CHIP, site)


def counts(sense: FrontEnd, n: int, step_ns: int = STEP_NS) -> tuple[Floats, Floats]:
    """Return `padc` and `tadc` of n conversions, `step_ns` apart, from power-up on."""
    read = np.array([sense(7_000 + i * step_ns) for i in range(n)], dtype=np.float64)
    return read[:, 0], read[:, 1]


def kpa(padc: Floats, tadc: Floats) -> Floats:
    return DATA_SHEET.make_law().compute_kpa(padc, tadc)


# Noise


@pytest.fixture(scope="module")
def recording() -> Floats:
    """Errors of a long recording of an unloaded tile, in kPa."""
    # The pressure moves slowly between two counts, so that rounding has no bias.
    padc, tadc = counts(front_end(lambda t_s: 96.0 + 0.01 * t_s), 60_000)
    return kpa(padc, tadc) - (96.0 + 0.01 * np.arange(60_000) * STEP_NS * 1e-9)


def test_the_noise_is_that_of_a_real_part(recording: Floats) -> None:
    # hardware.md 1.3
    assert recording.std() == pytest.approx(0.165, rel=0.05)
    assert abs(recording.mean()) < 0.02
    off = np.abs(recording) > 0.5
    assert off.mean() == pytest.approx(0.012, rel=0.2)
    assert (recording[off] < 0).mean() > 0.7, "most outliers are low"
    assert (recording[off] > 0).any()
    assert 1.0 < np.abs(recording).max() < 2.0, "outliers to 1.2 kPa, and the core"
    assert recording[~off].std() == pytest.approx(0.14, abs=0.015)


def test_noise_is_white_and_outliers_are_independent(recording: Floats) -> None:
    for lag in (1, 2, 10):
        r = np.corrcoef(recording[:-lag], recording[lag:])[0, 1]
        assert abs(r) < 5 / math.sqrt(len(recording))
    off = np.abs(recording) > 0.5
    expected = len(off) * off.mean() ** 2
    assert (off[:-1] & off[1:]).sum() < expected + 5 * math.sqrt(expected)


@pytest.mark.parametrize("noise_kpa", [0.1, 1.0])
def test_the_noise_has_the_amplitude_of_the_scene(noise_kpa: float) -> None:
    padc, tadc = counts(front_end(noise_kpa=noise_kpa), 20_000)
    assert kpa(padc, tadc).std() == pytest.approx(noise_kpa, rel=0.06)


def test_some_readings_of_a_healthy_part_equal_the_one_before() -> None:
    padc, tadc = counts(front_end(), 20_000)  # hardware.md 1.3: about one in nine
    assert 0.05 < ((np.diff(padc) == 0) & (np.diff(tadc) == 0)).mean() < 0.2


def autocovariance(x: Floats, lag: int) -> float:
    x = x - x.mean()
    return float((x[: len(x) - lag] * x[lag:]).mean())


def test_correlated_noise_has_its_correlation_time_and_the_same_variance() -> None:
    padc, tadc = counts(front_end(noise_kpa=0.33, correlated_ms=10.0), 150_000)
    error = kpa(padc, tadc)
    assert error.std() == pytest.approx(0.33, rel=0.05)
    # The core alone is correlated; outliers and rounding add to lag 0 only.
    at = {lag: autocovariance(error, lag) for lag in (1, 5, 10, 20)}
    core = at[1] * math.exp(0.1)
    assert 0.5 < core / error.var() < 0.9
    assert at[5] / at[1] == pytest.approx(math.exp(-0.4), abs=0.03)
    assert at[10] / at[1] == pytest.approx(math.exp(-0.9), abs=0.04)
    assert at[20] / at[1] == pytest.approx(math.exp(-1.9), abs=0.05)


@pytest.mark.parametrize("step_ms", [2.5, 30.0])
def test_noise_is_correlated_in_time_and_not_in_readings(step_ms: float) -> None:
    sense = front_end(noise_kpa=1.0, correlated_ms=10.0)
    error = kpa(*counts(sense, 20_000, step_ns=round(step_ms * 1e6)))
    core_share = 0.1295**2 / 0.165**2  # the share of the core by hardware.md 1.3
    r = autocovariance(error, 1) / error.var()
    assert r == pytest.approx(core_share * math.exp(-step_ms / 10.0), abs=0.07)


# Pressure


@pytest.mark.parametrize(
    ("pressure_kpa", "padc"), [(96.587326, 410), (148.17, 1023), (150.0, 1008), (19.52, 0)]
)
def test_counts_without_noise_are_those_of_the_data_sheet_and_wrap(
    pressure_kpa: float, padc: int
) -> None:
    # Count 0 is at 148.045 kPa, count 1023 at 19.65 (hardware.md 1.3); one count is 0.1255 kPa.
    read, tadc = counts(front_end(pressure_kpa, noise_kpa=0.0), 2_000)
    assert set(read.tolist()) == {float(padc)}
    # The temperature word keeps the half count of noise of a chip (hardware.md 1.6).
    assert tadc.mean() == pytest.approx(507, abs=0.05)
    assert tadc.std() == pytest.approx(math.hypot(0.5, 1 / math.sqrt(12)), rel=0.1)


@pytest.mark.parametrize(
    ("pressure_kpa", "clipped_kpa"), [(114.0, 114.0), (115.0, 115.0), (160.0, 115.0)]
)
def test_an_analogue_clip_limits_the_pressure(pressure_kpa: float, clipped_kpa: float) -> None:
    padc, tadc = counts(front_end(pressure_kpa, noise_kpa=0.0, clip_kpa=115.0), 50)
    assert kpa(padc, tadc).mean() == pytest.approx(clipped_kpa, abs=COUNT_KPA)


def test_a_tile_over_its_range_reads_45_kpa_more() -> None:
    fault = FaultTiming()
    sense = front_end(100.0, over_range=fault, noise_kpa=0.0)
    assert kpa(*counts(sense, 1))[0] == pytest.approx(100.0, abs=0.15)
    with fault.inject():
        assert kpa(*counts(sense, 1))[0] == pytest.approx(145.0, abs=0.15)
    assert kpa(*counts(sense, 1))[0] == pytest.approx(100.0, abs=0.15)


def test_a_frozen_pressure_is_constant_while_the_temperature_is_not() -> None:
    frozen = FaultTiming()
    sense = front_end(lambda t_s: 100.0 + t_s, frozen=frozen)
    before = sense(0)[0]
    with frozen.inject():
        padc, tadc = counts(sense, 500, 2_000_000)
    assert (padc == before).all()
    assert len(np.unique(tadc)) > 1
    assert sense(10_000_000_000)[0] < before - 40  # 10 kPa


def test_the_pressure_is_that_of_the_scene_time_and_constant_before_it() -> None:
    asked: list[float] = []

    def pressure(t_s: float) -> float:
        asked.append(t_s)
        return 100.0

    scene = EmulationSection()
    site = ChipSite(pressure, LAGS_S, Surroundings(scene), scene, "test")
    sense = FrontEnd(CHIP, site)
    sense(5_000_000_000)
    site.begin_scene_time(6_000_000_000)
    sense(5_999_999_000)  # a conversion under way
    sense(8_000_000_000)
    assert asked == pytest.approx([0.0, 0.0, 2.0])


# Temperature


@pytest.mark.parametrize(
    ("degc", "tadc"),
    [(25.0, 485.6), (15.0, 539.1), (-75.0, 1020.6), (-100.0, 1023), (130.0, 0)],
)
def test_the_temperature_word_falls_by_5_35_counts_per_kelvin_within_ten_bits(
    degc: float, tadc: float
) -> None:
    _, read = counts(front_end(ambient_degc=degc), 2_000)
    assert read.mean() == pytest.approx(tadc, abs=0.1)


def test_a_temperature_step_reaches_the_chip_with_its_lag_and_is_compensated() -> None:
    sense = front_end(
        noise_kpa=0.0, temperature_step_k=-10.0, temperature_step_s=1.0, ambient_degc=21.0
    )
    padc, tadc = counts(sense, 8_000)
    assert tadc[:1_000].mean() == pytest.approx(507, abs=0.1)
    # 63 % of 53.5 counts one second (the chip's lag) after the step, all of it in the end
    assert tadc[1_950:2_050].mean() == pytest.approx(507 + 53.5 * 0.632, abs=0.5)
    assert tadc[7_900:].mean() == pytest.approx(507 + 53.5, abs=0.3)
    assert len(set(padc.tolist())) > 10
    # Half a count of pressure, and the temperature word's own noise at 0.0379 kPa per count
    assert np.abs(kpa(padc, tadc) - 96.587326).max() < COUNT_KPA / 2 + 3 * 0.0379
