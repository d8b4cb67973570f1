"""Every flag of an estimate, one by one, and what a faulty tile does."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from devices.flags import EstimateFlag, TileFlag
from service.estimation.models.temperature import TemperatureModel
from service.estimation.pipeline.model_set import MODEL_NAMES
from service.estimation.pipeline.plan import make_plan
from service.estimation.tare.tare import Tare
from tests.builders.arrays import COUNT_KPA, array_at, make_servo
from tests.builders.calibrations import make_effects, newton_tile
from tests.builders.estimates import estimate, newton_plan
from tests.builders.frames import loaded_frames
from tests.service.estimation.feet import COP, SQUARE, held

HALF_HOUR_NS = 1_800_000_000_000


# --- faults ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "fault",
    [TileFlag.NO_ANSWER, TileFlag.STALE, TileFlag.IMPLAUSIBLE, TileFlag.NOT_CONVERTED],
)
def test_a_faulty_tile_is_nan_and_a_flag_and_its_neighbours_go_on(fault: TileFlag) -> None:
    status = np.zeros((12, 4))
    status[11, 1] = fault | TileFlag.RETRIED
    e = estimate(
        newton_plan(array_at(SQUARE)), loaded_frames(held([7, 8, 9, 10]), tile_flags=status)
    )
    assert e.force_n[11] == pytest.approx([7, np.nan, 9, 10], nan_ok=True)
    assert e.gauge_kpa[11] / COUNT_KPA == pytest.approx([7, np.nan, 9, 10], nan_ok=True)
    assert np.isnan([e.grf_n[11], e.grf_sigma_n[11], *(getattr(e, name)[11] for name in COP)]).all()
    # Of three tiles the noise is 0.5 N each.
    assert e.grf_lower_bound_n[11] == pytest.approx(26 - 2.33 * 0.5 * np.sqrt(3))
    assert e.contact[11] == 1
    assert e.estimate_flags[11] == EstimateFlag.TILE_MISSING | EstimateFlag.COP_MASKED
    assert e.grf_n[10] == pytest.approx(34)


def test_a_tile_that_answered_late_or_reads_high_is_not_missing() -> None:
    status = np.full((12, 4), TileFlag.RETRIED | TileFlag.OVER_RANGE)
    e = estimate(
        newton_plan(array_at(SQUARE)), loaded_frames(held([7, 8, 9, 10]), tile_flags=status)
    )
    assert e.grf_n == pytest.approx([34.0] * 12)


def test_counts_that_were_not_read_are_missing_whatever_their_status_says() -> None:
    frames = loaded_frames(held([7, 8, 9, 10]))
    frames.pressure_raw[11, 0] = 65535
    e = estimate(newton_plan(array_at(SQUARE)), frames)
    assert np.isnan(e.grf_n[11])
    assert e.estimate_flags[11] & EstimateFlag.TILE_MISSING


# --- flags, one by one ----------------------------------------------------------------------------


def test_a_good_frame_in_stance_has_no_flag() -> None:
    assert (
        estimate(newton_plan(array_at(SQUARE)), loaded_frames(held([9] * 4))).estimate_flags[-1]
        == 0
    )


def test_saturated_says_that_force_is_a_lower_bound_and_so_is_all_that_is_known_of_the_sum() -> (
    None
):
    # the calibration ends at 150 N
    e = estimate(newton_plan(array_at(SQUARE)), loaded_frames(held([151, 9, 9, 9])))
    assert e.estimate_flags[-1] == EstimateFlag.SATURATED | EstimateFlag.COP_MASKED
    assert e.force_n[-1] == pytest.approx([150 - 2.33 * 0.5, 9, 9, 9])  # of noise: 0.5 N
    assert np.isnan(e.force_sigma_n[-1]).tolist() == [True, False, False, False]
    assert np.isnan([e.grf_n[-1], e.grf_sigma_n[-1]]).all()
    assert e.grf_lower_bound_n[-1] == pytest.approx(177 - 2.33 * 0.5 * 2)
    assert e.contact[-1] == 1
    at_the_end = estimate(newton_plan(array_at(SQUARE)), loaded_frames(held([150, 9, 9, 9])))
    assert not at_the_end.estimate_flags[-1] & EstimateFlag.SATURATED


def test_all_tiles_saturated_are_a_lower_bound_in_contact() -> None:
    e = estimate(newton_plan(array_at(SQUARE)), loaded_frames(held([400] * 4)))
    assert np.isnan(e.grf_n).all()
    assert e.grf_lower_bound_n == pytest.approx([600.0 - 2.33] * 12)
    assert e.contact[-1] == 1


def test_over_rated_is_above_115_kpa_and_within_the_calibration() -> None:
    # 115 kPa is Pcomp 1023: 1787 - 2 pressure_raw at 382 counts, which are 118 N
    plan = newton_plan(array_at(SQUARE))
    above = estimate(plan, loaded_frames(held([119, 115, 115, 115])))
    assert above.estimate_flags[-1] == EstimateFlag.OVER_RATED
    assert above.grf_n[-1] == pytest.approx(464)
    assert estimate(plan, loaded_frames(held([118, 115, 115, 115]))).estimate_flags[-1] == 0


def test_extrapolated_is_five_sigma_below_the_calibration() -> None:
    plan = newton_plan(array_at(SQUARE), sigma_n=0.5)  # 2.5 N
    below = estimate(plan, loaded_frames(held([-3, 30, 30, 30])))
    assert below.estimate_flags[-1] & EstimateFlag.EXTRAPOLATED
    assert below.force_n[-1, 0] == pytest.approx(-3)
    noise = estimate(plan, loaded_frames(held([-2, 30, 30, 30])))
    assert not noise.estimate_flags[-1] & EstimateFlag.EXTRAPOLATED


def test_gap_marks_the_frame_after_a_missing_number() -> None:
    frames = loaded_frames(held([9] * 4), seq=[0, 1, 2, 3, 4, 5, 7, 8, 9, 10, 11, 12])
    status = estimate(newton_plan(array_at(SQUARE)), frames).estimate_flags
    assert np.flatnonzero(status & EstimateFlag.GAP).tolist() == [6]


def test_gap_marks_a_frame_more_than_half_a_period_late() -> None:
    steps_ns = np.array([2, 2, 3, 2, 3, 2, 2]) * 1_000_000
    steps_ns[4] += 1
    frames = loaded_frames(held([9] * 4, 7), t_mono_ns=np.cumsum(steps_ns))
    status = estimate(newton_plan(array_at(SQUARE)), frames).estimate_flags
    assert np.flatnonzero(status & EstimateFlag.GAP).tolist() == [4]


def test_a_gap_of_a_minute_between_two_batches_is_seen_and_breaks_the_run() -> None:
    # 8 ms of load on each side of it are no contact
    first = loaded_frames(np.concatenate([held([0] * 4, 3), held([9] * 4, 5)]))
    later = replace(
        first.slice_rows(3, 8),
        seq=first.seq[3:8] + np.uint64(30_000),
        t_mono_ns=first.t_mono_ns[3:8] + 60_000_000_000,
    )
    for lag_ms in (0, 100):
        e = estimate(newton_plan(array_at(SQUARE), lag_ms=lag_ms), first, later)
        assert np.flatnonzero(e.estimate_flags & EstimateFlag.GAP).tolist() == [8]
        assert e.contact.tolist() == [0] * 13


def test_the_first_frame_of_a_stream_comes_after_no_gap() -> None:
    frames = loaded_frames(held([9] * 4), seq=np.arange(12) + 77_777)
    assert not (estimate(newton_plan(array_at(SQUARE)), frames).estimate_flags & 8).any()


def test_cop_masked_is_flight() -> None:
    e = estimate(newton_plan(array_at(SQUARE)), loaded_frames(held([0] * 4)))
    assert (e.estimate_flags == EstimateFlag.COP_MASKED).all()
    assert (e.contact == 0).all()


def test_assumed_scale_marks_every_frame() -> None:
    tiles = [newton_tile(f"T{i + 1:02}", absolute_scale="assumed") for i in range(4)]
    e = estimate(newton_plan(array_at(SQUARE), tiles=tiles), loaded_frames(held([9] * 4)))
    assert (e.estimate_flags & EstimateFlag.ASSUMED_SCALE).all()
    assert e.estimate_flags[-1] == EstimateFlag.ASSUMED_SCALE


def test_a_tare_is_old_after_half_an_hour() -> None:
    plan = newton_plan(array_at(SQUARE))
    t_ns = plan.tare.t_ns + HALF_HOUR_NS + np.arange(-11, 1) * 2_000_000
    frames = replace(loaded_frames(held([9] * 4)), t_ns=t_ns)
    assert estimate(plan, frames).estimate_flags[-1] == 0
    status = estimate(plan, replace(frames, t_ns=t_ns + 1)).estimate_flags
    assert np.flatnonzero(status & EstimateFlag.TARE_OLD).tolist() == [11]


def test_a_tare_at_another_temperature_is_flagged_like_an_old_one() -> None:
    # Tared at 480 counts; four are let pass, and a fifth is not, whichever way.
    plan = newton_plan(array_at(SQUARE, references=[3]))
    temperature_raw = np.full((12, 4), 480)
    temperature_raw[3, 1], temperature_raw[4, 1], temperature_raw[5, 2], temperature_raw[6, 2] = (
        476,
        475,
        484,
        485,
    )
    temperature_raw[7, 3] = 300  # of a tile that bears no load it does not matter
    frames = replace(
        loaded_frames(held([9] * 4)), temperature_raw=temperature_raw.astype(np.uint16)
    )
    status = estimate(plan, frames).estimate_flags
    assert np.flatnonzero(status & EstimateFlag.TARE_OLD).tolist() == [4, 6]
    none, tare = np.zeros(3), np.full(3, 480.0)
    model = TemperatureModel(none, none, np.ones(3), none, tare, np.full(3, 100.0), step_s=0.002)
    corrected = replace(
        plan, model_set=replace(plan.model_set, temperature=model)
    )  # ANY: fields of EstimationPlan
    assert not (estimate(corrected, frames).estimate_flags & EstimateFlag.TARE_OLD).any()
    unknown = replace(plan, tare=replace(plan.tare, temperature_raw_counts=np.full(4, np.nan)))
    assert not (estimate(unknown, frames).estimate_flags & EstimateFlag.TARE_OLD).any()


@pytest.mark.parametrize("flag", list(EstimateFlag))
def test_every_flag_has_a_bit_of_its_own(flag: EstimateFlag) -> None:
    # design section 4
    bits = {
        "saturated": 1,
        "extrapolated": 2,
        "outlier_replaced": 4,
        "gap": 8,
        "cop_masked": 16,
        "tile_missing": 32,
        "assumed_scale": 64,
        "tare_old": 128,
        "over_rated": 256,
        "tare_lost": 512,
        "after_saturation": 1024,
        "stuck": 2048,
        "clipped": 4096,
        "baseline_lost": 8192,
    }
    assert bits[str(flag.name).lower()] == flag


@pytest.mark.parametrize("lag_ms", [0.0, 10.0])
def test_with_a_tare_that_is_lost_nothing_is_known_but_the_angle_and_a_flag_says_so(
    lag_ms: float,
) -> None:
    info, chips = array_at(SQUARE, servo=make_servo()), loaded_frames(held([9] * 4))
    models = [name for name in MODEL_NAMES if name != "ambient"]
    tiles = [newton_tile(serial, effects=make_effects()) for serial in info.serials]
    plan = newton_plan(info, models=models, tiles=tiles, lag_ms=lag_ms)
    lost = make_plan(
        info,
        plan.calibration,
        Tare.make_lost(tiles=4, t_ns=0),
        models=models,
        lag_ms=lag_ms,
    )
    whole, e = estimate(plan, chips), estimate(lost, chips)
    grf = ("grf_n", "grf_sigma_n", "grf_lower_bound_n")
    for name in ("gauge_kpa", "force_n", "force_sigma_n", *grf, *COP):
        assert np.isnan(getattr(e, name)).all(), name
        assert np.isfinite(getattr(whole, name)).any() or "ground" in name, name
    assert (e.contact == 255).all()
    assert (e.estimate_flags == EstimateFlag.TARE_LOST | EstimateFlag.COP_MASKED).all()
    assert e.angle_rad.tobytes() == whole.angle_rad.tobytes()


def test_a_tile_that_is_missing_is_said_even_if_the_tare_is_lost() -> None:
    flag = np.zeros((12, 4))
    flag[11, 1] = TileFlag.NO_ANSWER
    info = array_at(SQUARE)
    plan = make_plan(
        info, newton_plan(info).calibration, Tare.make_lost(tiles=4, t_ns=0), models=("static",)
    )
    e = estimate(plan, loaded_frames(held([9] * 4), tile_flags=flag))
    missing = e.estimate_flags & EstimateFlag.TILE_MISSING
    assert np.flatnonzero(missing).tolist() == [11]
