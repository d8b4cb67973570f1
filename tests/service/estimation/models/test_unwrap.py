"""`unwrap`: what reads below 50 kPa has fallen through zero."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from devices.chips.mpl115a2 import Coefficients, compensate_kpa, compute_kpa_per_padc
from service.estimation.pipeline.sample_stage import unwrap_pressure
from tests.builders.arrays import DATA_SHEET_CHIP, FORUM_CHIP

DATA_SHEET_PART = Coefficients.from_words(DATA_SHEET_CHIP)
FORUM_PART = Coefficients.from_words(FORUM_CHIP)


def kpa(counts: float, temperature_raw: int, c: Coefficients) -> float:
    """Data sheet eq. 1 and 2, written out once more; takes counts below zero too."""
    return (
        c.a0 + (c.b1 + c.c12 * temperature_raw) * counts + c.b2 * temperature_raw
    ) * 65 / 1023 + 50


def unwrapped(pressure_raw: int, temperature_raw: int, c: Coefficients) -> float:
    at_face_value = float(compensate_kpa(pressure_raw, temperature_raw, c.a0, c.b1, c.b2, c.c12))
    return float(
        unwrap_pressure(at_face_value, float(compute_kpa_per_padc(temperature_raw, c.b1, c.c12)))
    )


@given(
    past_zero=st.integers(1, 200),
    temperature_raw=st.integers(440, 560),
    part=st.sampled_from([DATA_SHEET_PART, FORUM_PART]),
)
def test_a_count_that_fell_through_zero_is_taken_back_below_zero(
    past_zero: int, temperature_raw: int, part: Coefficients
) -> None:
    pressure = unwrapped(1024 - past_zero, temperature_raw, part)
    assert abs(pressure - kpa(-past_zero, temperature_raw, part)) < 1e-9
    assert pressure > 120.0


@given(
    pressure_raw=st.integers(0, 740),
    temperature_raw=st.integers(440, 560),
    part=st.sampled_from([DATA_SHEET_PART, FORUM_PART]),
)
def test_a_count_of_the_chips_range_is_left_as_it_is(
    pressure_raw: int, temperature_raw: int, part: Coefficients
) -> None:
    assert unwrapped(pressure_raw, temperature_raw, part) == float(
        compensate_kpa(pressure_raw, temperature_raw, part.a0, part.b1, part.b2, part.c12)
    )


def test_full_load_of_a_real_part_reads_as_23_kpa_and_is_recognised() -> None:
    # hardware.md 1.3: cells pressed past their range came back 18 to 37 counts past zero
    assert kpa(1024 - 18, 500, DATA_SHEET_PART) < 24
    assert unwrapped(1024 - 18, 500, DATA_SHEET_PART) > 148.0 + 18 * 0.12


def test_one_count_past_zero_is_wrapped_already() -> None:
    # -1 comes back as 1023; a bus that nobody drives reads that in both words, and is flagged
    assert unwrapped(1023, 500, DATA_SHEET_PART) == pytest.approx(kpa(-1, 500, DATA_SHEET_PART))
    assert unwrapped(0, 500, DATA_SHEET_PART) == pytest.approx(kpa(0, 500, DATA_SHEET_PART))


def test_exactly_50_kpa_is_a_pressure_and_a_hair_less_is_none() -> None:
    less = float(np.nextafter(50.0, 0.0))
    assert unwrap_pressure(50.0, -0.125) == 50.0
    assert unwrap_pressure(less, -0.125) == less + 128.0


def test_nan_stays_nan() -> None:
    assert math.isnan(unwrap_pressure(math.nan, -0.1))
