"""`unwrap`, and the uncertainty of the instants at which tiles are sampled."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from devices.arrays import Floats
from devices.chips.mpl115a2 import Coefficients
from service.estimation.effects import Effects, Parameter
from service.estimation.pipeline.plan import EstimationPlan
from service.estimation.pipeline.sample_stage import unwrap_pressure
from tests.builders.arrays import DATA_SHEET_CHIP, FORUM_CHIP, PERIOD_NS, array_at
from tests.builders.calibrations import newton_tile
from tests.builders.estimates import estimate, newton_plan
from tests.builders.frames import loaded_frames

# --- unwrap ---------------------------------------------------------------------------------------

DATA_SHEET_PART, FORUM_PART = map(Coefficients.from_words, (DATA_SHEET_CHIP, FORUM_CHIP))


def unwrap(pressure_raw: int, temperature_raw: int, c: Coefficients) -> float:
    law = c.make_law()
    kpa = float(law.compute_kpa(pressure_raw, temperature_raw))
    count_kpa = float(law.compute_kpa_per_count(temperature_raw))
    return float(unwrap_pressure(kpa, count_kpa, 50.0, 1024.0))


@given(
    counts=st.integers(-200, 740),
    temperature_raw=st.integers(440, 560),
    c=st.sampled_from([DATA_SHEET_PART, FORUM_PART]),
)
@example(counts=-1, temperature_raw=500, c=DATA_SHEET_PART)
@example(counts=0, temperature_raw=500, c=DATA_SHEET_PART)
def test_a_count_that_fell_through_zero_is_a_negative_one(
    counts: int, temperature_raw: int, c: Coefficients
) -> None:
    pressure = unwrap(counts % 1024, temperature_raw, c)
    # Data sheet eq. 1 and 2, for counts below zero, too.
    pcomp = c.a0 + (c.b1 + c.c12 * temperature_raw) * counts + c.b2 * temperature_raw
    assert pressure == pytest.approx(pcomp * 65 / 1023 + 50, abs=1e-9)
    assert counts >= 0 or pressure > 120.0


def test_a_wrapped_pressure_is_recognised_below_50_kpa() -> None:
    # hardware.md 1.3: cells pressed past their range came back 18 to 37 counts past zero
    assert unwrap(1024 - 18, 500, DATA_SHEET_PART) > 148.0 + 18 * 0.12
    less = float(np.nextafter(50.0, 0.0))
    assert unwrap_pressure(50.0, -0.125, 50.0, 1024.0) == 50.0
    assert unwrap_pressure(less, -0.125, 50.0, 1024.0) == less + 128.0
    assert math.isnan(unwrap_pressure(math.nan, -0.1, 50.0, 1024.0))


# --- sample delay ---------------------------------------------------------------------------------

PLACES = ((0.0, 0.0, -0.15), (0.1, 0.0, -0.15))
RISE_N = np.array([3.0, 1.0])  # of either tile from one frame to the next
RATES = RISE_N / (1e-9 * PERIOD_NS)
RAMP = loaded_frames(
    10.0 + np.concatenate([np.zeros(5), np.arange(20.0), np.full(5, 19.0)])[:, None] * RISE_N
)


def plan_with_delay(own_s: float, common_s: float) -> EstimationPlan:
    effects = Effects(late_s=Parameter(value=0.0, sigma=own_s), late_common_s=common_s)
    tiles = [newton_tile(serial, effects=effects) for serial in array_at(PLACES).serials]
    return newton_plan(array_at(PLACES), tiles=tiles)


def compute_added_variance(own_s: float, common_s: float) -> Floats:
    """Compute the GRF's variance on a ramp beyond that of a constant load."""
    sigma_n = estimate(plan_with_delay(own_s, common_s), RAMP).grf_sigma_n
    return np.asarray(sigma_n**2 - sigma_n[0] ** 2)


@pytest.mark.parametrize(
    ("own_s", "common_s", "expected"),
    [(1e-4, 0.0, (1e-8 * RATES**2).sum()), (0.0, 1e-4, (1e-4 * RATES.sum()) ** 2)],
    ids=["own delays add as squares", "a common delay adds as it is"],
)
def test_an_uncertain_delay_makes_a_changing_force_uncertain(
    own_s: float, common_s: float, expected: float
) -> None:
    added = compute_added_variance(own_s, common_s)
    assert added[10:20] == pytest.approx(np.full(10, expected), rel=1e-6)
    assert added[[*range(5), *range(-4, 0)]] == pytest.approx(np.zeros(9), abs=1e-12)


def test_a_silent_tile_has_no_rate_and_changes_no_later_one() -> None:
    forces_n = 10.0 + np.arange(12.0)[:, None] * RISE_N
    forces_n[6, 0] = np.nan
    sigma_n = estimate(plan_with_delay(0.0, 1e-4), loaded_frames(forces_n)).grf_sigma_n
    assert np.isfinite(sigma_n[8:]).all()
    assert sigma_n[9] == pytest.approx(sigma_n[4])
