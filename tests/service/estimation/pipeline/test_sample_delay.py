"""When tiles are sampled: an instant that is uncertain makes a force that changes uncertain."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from devices.arrays import Floats
from devices.frames import FrameBatch
from service.estimation.effects import Effects, Parameter
from service.estimation.pipeline.plan import EstimationPlan
from service.estimation.records import Estimates
from tests.builders.arrays import array_at
from tests.builders.calibrations import newton_tile
from tests.builders.estimates import estimate, newton_plan
from tests.builders.frames import assert_same_bits, loaded_frames

PLACES = ((0.0, 0.0, -0.15), (0.1, 0.0, -0.15))
RISE_N = np.array([3.0, 1.0])  # of either tile from one frame to the next


def late_plan(own_s: float, common_s: float) -> EstimationPlan:
    effects = Effects(late_s=Parameter(value=0.0, sigma=own_s), late_common_s=common_s)
    tiles = [newton_tile(serial, effects=effects) for serial in array_at(PLACES).serials]
    return newton_plan(array_at(PLACES), tiles=tiles)


def ramp() -> FrameBatch:
    steps = np.concatenate([np.zeros(5), np.arange(20.0), np.full(5, 19.0)])
    return loaded_frames(10.0 + steps[:, None] * RISE_N)


def step_s(frames: FrameBatch) -> Floats:
    return 1e-9 * np.diff(frames.t_mono_ns).astype(np.float64)


def beyond_noise(estimates: Estimates) -> Floats:
    """What of the GRF's variance is more than when nothing changes."""
    return np.asarray(estimates.grf_sigma_n**2 - estimates.grf_sigma_n[0] ** 2)


def test_what_each_tile_has_of_its_own_adds_up_as_squares() -> None:
    frames = ramp()
    rates = RISE_N / step_s(frames).mean()
    found = beyond_noise(estimate(late_plan(1e-4, 0.0), frames))
    assert found[10:20] == pytest.approx(np.full(10, (1e-8 * rates**2).sum()), rel=1e-6)


def test_what_tiles_share_with_the_reference_adds_up_as_it_is() -> None:
    frames = ramp()
    rates = RISE_N / step_s(frames).mean()
    found = beyond_noise(estimate(late_plan(0.0, 1e-4), frames))
    assert found[10:20] == pytest.approx(np.full(10, (1e-4 * rates.sum()) ** 2), rel=1e-6)


def test_a_load_that_rests_does_not_care_when_it_is_sampled() -> None:
    found = beyond_noise(estimate(late_plan(1e-3, 1e-3), ramp()))
    assert found[:5] == pytest.approx(np.zeros(5), abs=1e-12)
    assert found[-4:] == pytest.approx(np.zeros(4), abs=1e-12)


@settings(max_examples=10)
@given(cut=st.integers(1, 28))
def test_cut_anywhere_it_is_as_uncertain_to_the_bit(cut: int) -> None:
    frames, plan = ramp(), late_plan(1e-4, 2e-4)
    parts = frames.slice_rows(0, cut), frames.slice_rows(cut, len(frames))
    assert_same_bits(estimate(plan, *parts), estimate(plan, frames))


def test_a_tile_that_did_not_answer_has_no_rate_and_spoils_none_after_it() -> None:
    forces_n = 10.0 + np.arange(12.0)[:, None] * RISE_N
    forces_n[6, 0] = np.nan
    found = estimate(late_plan(0.0, 1e-4), loaded_frames(forces_n))
    assert np.isfinite(found.grf_sigma_n[8:]).all()
    assert found.grf_sigma_n[9] == pytest.approx(found.grf_sigma_n[4])
