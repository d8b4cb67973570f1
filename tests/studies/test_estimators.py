"""Laws of every estimator: any batches give the same bits, also through a state; NaN stays NaN."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from devices.errors import UsageError
from devices.flags import CONTACT_UNKNOWN, EstimateFlag, TileFlag
from devices.frames import NOT_READ, FrameBatch
from service.estimation.estimate import Estimator
from service.estimation.pipeline.plan import EstimationPlan
from service.estimation.records import Estimates
from studies.estimators import ESTIMATORS, TIME_CONSTANT_S, LowPassEstimator, get_estimator
from tests.builders.arrays import array_at, make_servo
from tests.builders.calibrations import make_effects, newton_tile
from tests.builders.estimates import joined, newton_plan
from tests.builders.frames import assert_same_bits, loaded_frames
from tests.service.estimation.feet import SQUARE, draw_wild_frames, repeat_load

each_estimator = pytest.mark.parametrize("make", ESTIMATORS.values(), ids=ESTIMATORS)
MODELS = ("unwrap", "gas", "static", "skew", "denoise", "hysteresis", "rubber")


def plan_with(*models: str, tiles: int = 4, lag_ms: float = 10.0) -> EstimationPlan:
    info = array_at([*SQUARE, (0.04, 0.0, -0.15)][:tiles], servo=make_servo())
    known = [newton_tile(serial, effects=make_effects()) for serial in info.serials]
    return newton_plan(info, models=models, lag_ms=lag_ms, tiles=known)


def run(estimator: Estimator, *batches: FrameBatch) -> Estimates:
    found = [estimator.process_frames(batch) for batch in batches]
    last = estimator.finish()
    return joined(found if last is None else [*found, last])


@each_estimator
@settings(max_examples=20, deadline=None)
@given(cuts=st.sets(st.integers(1, 799), max_size=6), seed=st.integers(0, 99))
def test_any_batches_and_any_states_between_them_give_the_same_bits(
    make: type[Estimator], cuts: set[int], seed: int
) -> None:
    plan, frames = plan_with(*MODELS), draw_wild_frames(800, 4, seed)
    whole = run(make(plan), frames)
    batches = [frames.slice_rows(a, b) for a, b in pairwise([0, *sorted(cuts), 800])]
    assert_same_bits(run(make(plan), *batches), whole)
    estimator, found = make(plan), []
    for batch in batches:
        estimator = make.from_state(plan, estimator.state_dict())
        found.append(estimator.process_frames(batch))
    last = estimator.finish()
    assert_same_bits(joined(found if last is None else [*found, last]), whole)


@each_estimator
def test_every_frame_has_one_estimate_in_order(make: type[Estimator]) -> None:
    frames = draw_wild_frames(300, 4, 7)
    found = run(make(plan_with(*MODELS)), frames)
    assert found.seq.tobytes() == frames.seq.tobytes()
    assert found.t_ns.tobytes() == frames.t_ns.tobytes()


@each_estimator
@pytest.mark.parametrize("models", [("static",), MODELS])
def test_a_missing_reading_is_nan_with_a_flag(
    make: type[Estimator], models: tuple[str, ...]
) -> None:
    frames = loaded_frames(repeat_load([9, 9, 9, 9], 60))
    frames.pressure_raw[30, 2], frames.tile_flags[30, 2] = NOT_READ, TileFlag.NO_ANSWER
    found = run(make(plan_with(*models)), frames)
    missing = np.arange(60) == 30
    assert np.isnan(found.force_n[30, 2])
    assert np.array_equal(found.estimate_flags & EstimateFlag.TILE_MISSING != 0, missing)
    assert np.array_equal(np.isnan(found.grf_n), missing)
    for column in (found.gauge_kpa, found.force_n, found.force_sigma_n):
        assert np.isnan(column).sum() == 1
    assert np.isnan(found.cop_x_m[30])


@each_estimator
def test_a_wrapped_count_is_a_missing_reading(make: type[Estimator]) -> None:
    frames = loaded_frames(repeat_load([9, 9, 9, 9], 60))
    frames.pressure_raw[30, 2] = 1000
    found = run(make(plan_with("static")), frames)
    wrapped = np.arange(60) == 30
    assert np.array_equal(np.isnan(found.force_n[:, 2]), wrapped)
    assert np.array_equal(found.estimate_flags & EstimateFlag.TILE_MISSING != 0, wrapped)


@each_estimator
def test_temperatures_that_are_read_now_and_then_are_held_between(make: type[Estimator]) -> None:
    frames, plan = loaded_frames(repeat_load([9, 9, 9, 9], 60)), plan_with("static")
    whole = run(make(plan), frames)
    frames.temperature_raw[np.arange(60) % 10 != 0] = NOT_READ
    batches = [frames.slice_rows(begin, begin + 7) for begin in range(0, 60, 7)]
    np.testing.assert_array_equal(run(make(plan), *batches).grf_n, whole.grf_n)


@each_estimator
def test_a_row_of_tiles_has_no_cop_across_it(make: type[Estimator]) -> None:
    info = array_at([(0.01 * i, 0.0, -0.15) for i in range(4)], servo=make_servo())
    tiles = [newton_tile(serial) for serial in info.serials]
    plan = newton_plan(info, models=("static",), lag_ms=10.0, tiles=tiles)
    found = run(make(plan), loaded_frames(repeat_load([9, 9, 9, 9], 60)))
    assert np.isfinite(found.cop_x_m[30:]).all()
    assert np.isfinite(found.cop_sigma_x_m[30:]).all()
    assert np.isnan(found.cop_y_m).all()


@each_estimator
def test_a_state_of_another_array_is_refused(make: type[Estimator]) -> None:
    state = make(plan_with("static")).state_dict()
    with pytest.raises(ValueError, match="not"):
        make.from_state(plan_with("static", tiles=5), state)


@each_estimator
def test_a_state_is_a_copy(make: type[Estimator]) -> None:
    plan, frames = plan_with(*MODELS), draw_wild_frames(200, 4, 3)
    estimator = make(plan)
    estimator.process_frames(frames.slice_rows(0, 100))
    state = estimator.state_dict()
    before = {name: column.tobytes() for name, column in state.items()}
    estimator.process_frames(frames.slice_rows(100, 200))
    make.from_state(plan, state).process_frames(frames.slice_rows(100, 200))
    assert {name: column.tobytes() for name, column in state.items()} == before


# --- low-pass -------------------------------------------------------------------------------------


def test_the_low_pass_approaches_a_step_within_its_time_constant() -> None:
    forces_n = np.repeat([0.0, 10.0], 200)[:, None] * np.ones(4)
    found = run(LowPassEstimator(plan_with("static")), loaded_frames(forces_n))
    step_s = 0.002
    k = np.arange(1, 21)
    rest = (TIME_CONSTANT_S / (TIME_CONSTANT_S + step_s)) ** k
    assert found.force_n[200:220, 0] == pytest.approx(10.0 * (1.0 - rest), abs=0.1)
    assert found.grf_n[-1] == pytest.approx(40.0, abs=0.1)
    assert found.cop_x_m[-1] == pytest.approx(0.01, abs=1e-4)
    assert (found.contact[0], found.contact[-1]) == (0, 1)


def test_a_saturated_tile_is_a_lower_bound_without_a_sum() -> None:
    found = run(LowPassEstimator(plan_with("static")), loaded_frames(repeat_load([400, 9, 9, 9])))
    assert (found.estimate_flags & EstimateFlag.SATURATED).all()
    assert np.isnan(found.force_sigma_n[:, 0]).all()
    assert np.isnan(found.grf_n).all()
    assert (found.contact == CONTACT_UNKNOWN).all()
    assert (found.grf_lower_bound_n[1:] > 27.0).all()


def test_an_unknown_estimator_is_refused() -> None:
    with pytest.raises(UsageError, match="unknown"):
        get_estimator("unknown")
