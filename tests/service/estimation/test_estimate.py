"""`step` and `finish`: any split the same bits, every flag, COP by hand, honest uncertainty.

Tiles read one newton a count (see tests/builders), so forces below are what the tiles see.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Collection, Sequence
from dataclasses import fields, replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from devices.chips.compensation import Compensation
from devices.frames import (
    NO_SERVO_COUNTS,
    NOT_READ,
    FrameBatch,
    FrameStatus,
    TileStatus,
)
from service.estimation.calibration import paper_eq2_shape
from service.estimation.estimate import EstimationState, finish, step
from service.estimation.estimates import Estimates, EstimateStatus
from service.estimation.lower import ApparentForces
from service.estimation.models.temperature import Temperature
from service.estimation.plan import make_plan
from service.estimation.tare.recorded import take_tare
from tests.builders.arrays import COUNT_KPA, DATA_SHEET_CHIP, FORUM_CHIP, array_at, make_servo
from tests.builders.calibrations import make_calibration, newton_tile
from tests.builders.estimates import estimate, newton_plan
from tests.builders.frames import LAYOUTS, assert_same_bits, cut_up, loaded_frames, with_columns

Position = tuple[float, float, float]

SQUARE = [(0.0, 0.0, -0.15), (0.02, 0.0, -0.15), (0.0, 0.01, -0.15), (0.02, 0.01, -0.15)]
LINE = [(-0.021, 0.0, -0.15), (-0.007, 0.0, -0.15), (0.007, 0.0, -0.15), (0.021, 0.0, -0.15)]
HALF_HOUR_NS = 1_800_000_000_000

COP = ("cop_x_m", "cop_y_m", "cop_sigma_x_m", "cop_sigma_y_m", "cop_index_x", "cop_index_y")


def held(forces_n: Sequence[float], rows: int = 12) -> np.ndarray:
    """The same forces for so many frames, 2 ms each: with 12, contact is believed at the end."""
    return np.tile(np.array(forces_n, dtype=np.float64), (rows, 1))


# --- any split, any memory order ------------------------------------------------------------------


def wild_frames(rows: int, tiles: int, seed: int) -> FrameBatch:
    """Loads that come and go, faults of every kind, gaps, servo drop-outs, tares grown old."""
    rng = np.random.default_rng(seed)
    on = np.repeat(rng.integers(0, 2, rows), rng.integers(1, 9, rows))[:rows]
    forces_n = on[:, None] * rng.integers(0, 70, tiles) + rng.normal(0, 1.5, (rows, tiles))
    forces_n[rng.random((rows, tiles)) < 0.03] = np.nan
    forces_n[rng.random((rows, tiles)) < 0.02] = rng.choice([130.0, 200.0, 499.0, 501.0, 510.0])
    frames = loaded_frames(forces_n)
    steps_ns = rng.choice([2_000_000] * 9 + [2_000_007, 900_000, 3_100_000, 60_000_000_000], rows)
    t_mono_ns = np.cumsum(steps_ns)
    # Readings 1 to 9 ms apart, each for several frames; some jump by more than half a turn.
    since_ns = np.cumsum(np.minimum(steps_ns, 4_000_000))
    sampled_ns = np.cumsum(rng.integers(1_000_000, 9_000_000, 4 * rows + 9)) - 9_000_000
    newest = np.clip(np.searchsorted(sampled_ns, since_ns) - 1, 0, None)
    counts = np.cumsum(rng.choice([-700, -1, 0, 3, 900, 3000], len(sampled_ns)))
    age_us = np.clip((since_ns - sampled_ns[newest]) // 1000, 0, None)
    status = frames.status | np.where(
        rng.random((rows, tiles)) < 0.05, 2 ** rng.integers(0, 6, (rows, tiles)), 0
    )
    return with_columns(
        frames,
        seq=np.cumsum(rng.choice([1] * 20 + [2, 900], rows)),
        t_mono_ns=t_mono_ns,
        tadc=np.where(frames.tadc == NOT_READ, NOT_READ, rng.integers(440, 560, (rows, tiles))),
        status=status,
        frame_status=np.where(rng.random(rows) < 0.1, rng.integers(0, 32, rows), 0),
        servo_counts=np.where(rng.random(rows) < 0.05, NO_SERVO_COUNTS, counts[newest]),
        servo_age_us=np.where(rng.random(rows) < 0.05, rng.integers(-1, 3000, rows), age_us),
        reference_force_n=rng.choice([np.nan, np.inf, 3.0], rows),
    )


@pytest.mark.parametrize("lag_ms", [0, 5, 10, 100])
@settings(max_examples=100, deadline=None)
@given(
    rows=st.integers(1, 70),
    tiles=st.integers(1, 5),
    seed=st.integers(0, 2**32 - 1),
    models=st.sampled_from([("unwrap", "static"), ("static",)]),
    cuts=st.one_of(st.just(range(70)), st.sets(st.integers(1, 69))),
    how=st.sampled_from(list(LAYOUTS)),
)
def test_any_split_in_any_memory_order_gives_the_assert_same_bits(
    lag_ms: float,
    rows: int,
    tiles: int,
    seed: int,
    models: tuple[str, ...],
    cuts: Collection[int],
    how: str,
) -> None:
    rng = np.random.default_rng(seed)
    positions = [(0.013 * i, 0.01 * (i % 2), -0.15) for i in range(tiles)]
    info = array_at(
        positions,
        servo=make_servo(ratio=0.1),
        references=[tiles - 1] if tiles > 2 else [],
        chips=[DATA_SHEET_CHIP, FORUM_CHIP] * 3 if seed % 2 else None,
    )
    curves = [
        newton_tile(
            serial,
            coefficients=(0.1, rng.uniform(1, 2), rng.uniform(0, 0.01), rng.uniform(0, 1e-4)),
            covariance=tuple(tuple(row) for row in (1e-3 * np.eye(3)).tolist()),
            relative_misfit=0.01,
        )
        for serial in info.serials
    ]
    plan = newton_plan(info, lag_ms=lag_ms, models=models, tiles=curves)
    frames = wild_frames(rows, tiles, seed)
    whole, split = estimate(plan, frames), estimate(plan, *cut_up(frames, cuts, how))
    assert_same_bits(whole, split)
    assert split.seq.tolist() == frames.seq.tolist()
    assert split.t_ns.tolist() == frames.t_ns.tolist()


def test_long_batches_give_the_bits_of_short_ones() -> None:
    # Long enough for every vector width and its remainder, and for the blocks numpy works in.
    plan = newton_plan(array_at(SQUARE, servo=make_servo()), lag_ms=10)
    frames = wild_frames(20_011, 4, 1)
    edges = [0, 1, 8, 17, 33, 64, 1000, 8191, 8192, 16_385, 20_011]
    pieces = [frames.rows(*pair) for pair in pairwise(edges)]
    assert_same_bits(estimate(plan, frames), estimate(plan, *pieces))


@pytest.mark.parametrize("first", [2**53 - 3, 2**63 - 3, 2**63, 2**64 - 10])
def test_numbers_of_frames_may_be_as_great_as_their_type_holds(first: int) -> None:
    plan = newton_plan(array_at(SQUARE))
    seq = np.uint64(first) + np.arange(9, dtype=np.uint64)
    frames = loaded_frames(held([0] * 4, 9), seq=seq)
    whole = estimate(plan, frames)
    assert not (whole.estimate_status & EstimateStatus.GAP).any()
    assert_same_bits(whole, estimate(plan, *(frames.rows(i, i + 1) for i in range(9))))


@pytest.mark.parametrize("start_ns", [0, -5_000_000_000, 2**62])
def test_time_may_begin_anywhere(start_ns: int) -> None:
    plan = newton_plan(array_at(SQUARE), lag_ms=20)
    forces_n = np.concatenate([held([0] * 4, 10), held([9] * 4, 10), held([0] * 4, 10)])
    t_ns = start_ns + 2_000_000 * np.arange(30, dtype=np.int64)
    frames = loaded_frames(forces_n, t_mono_ns=t_ns, t_ns=t_ns)
    assert estimate(plan, frames).contact.tolist() == [0] * 10 + [1] * 10 + [0] * 10


# --- steps and states -----------------------------------------------------------------------------


def test_estimates_come_when_their_look_ahead_is_complete() -> None:
    plan, frames = newton_plan(array_at(SQUARE), lag_ms=10), loaded_frames(held([0] * 4, 9))
    state, due = EstimationState(), []
    for i in range(9):
        estimates, state = step(plan, frames.rows(i, i + 1), state)
        due.append(estimates.seq.tolist())
    assert due == [[], [], [], [], [], [0], [1], [2], [3]]  # frame 0 at 0 ms, due at 10 ms
    last = finish(plan, state)
    assert last is not None
    assert last.seq.tolist() == [4, 5, 6, 7, 8]


def test_without_look_ahead_nothing_waits() -> None:
    plan = newton_plan(array_at(SQUARE))
    estimates, state = step(plan, loaded_frames(held([0] * 4, 3)), EstimationState())
    assert len(estimates) == 3
    assert finish(plan, state) is None
    assert finish(plan, EstimationState()) is None


def test_a_step_changes_neither_its_frames_nor_its_state() -> None:
    plan = newton_plan(array_at(SQUARE, servo=make_servo()), lag_ms=10)
    frames = wild_frames(60, 4, 3)
    _, state = step(plan, frames.rows(0, 30), EstimationState())
    before, kept = copy.deepcopy(state), copy.deepcopy(frames)
    first, after = step(plan, frames.rows(30, 60), state)
    finish(plan, state)
    again, after_again = step(plan, frames.rows(30, 60), state)
    assert_same_bits(first, again)
    assert state.pending is not None
    assert before.pending is not None
    for f in fields(ApparentForces):
        kept_values, values = (
            getattr(before.pending.forces, f.name),
            getattr(state.pending.forces, f.name),
        )
        assert values.tobytes() == kept_values.tobytes(), f.name
    assert (state.contact_run, state.contact, state.last_seq, state.last_t_ns) == (
        before.contact_run,
        before.contact,
        before.last_seq,
        before.last_t_ns,
    )
    assert (after.contact_run, after.contact) == (after_again.contact_run, after_again.contact)
    for f in fields(FrameBatch):
        assert getattr(frames, f.name).tobytes() == getattr(kept, f.name).tobytes(), f.name


def test_a_batch_of_no_frames_gives_none_and_changes_nothing() -> None:
    plan = newton_plan(array_at(SQUARE, servo=make_servo()), lag_ms=10)
    frames = wild_frames(30, 4, 4)
    nothing = frames.rows(0, 0)
    pieces = [nothing, frames.rows(0, 20), nothing, nothing, frames.rows(20, 30), nothing]
    assert_same_bits(estimate(plan, *pieces), estimate(plan, frames))


@pytest.mark.parametrize(
    ("lag_ms", "first_in_contact"), [(0, 15), (4, 13), (8, 11), (10, 10), (50, 10)]
)
def test_contact_is_dated_back_by_the_look_ahead(lag_ms: float, first_in_contact: int) -> None:
    # loaded from frame 10 on, believed after 10 ms, which are five frames
    plan = newton_plan(array_at(SQUARE), lag_ms=lag_ms)
    frames = loaded_frames(np.concatenate([held([0] * 4, 10), held([8] * 4, 20)]))
    contact = estimate(plan, frames).contact
    assert contact.tolist() == [0] * first_in_contact + [1] * (30 - first_in_contact)


def test_contact_is_unknown_where_there_is_no_force_and_goes_on_after_it() -> None:
    forces_n = held([8] * 4, 20)
    forces_n[12:15, 2] = np.nan
    contact = estimate(newton_plan(array_at(SQUARE), lag_ms=50), loaded_frames(forces_n)).contact
    assert contact.tolist() == [1] * 12 + [255] * 3 + [1] * 5


# --- faults ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "fault",
    [TileStatus.NO_ANSWER, TileStatus.STALE, TileStatus.IMPLAUSIBLE, TileStatus.NOT_CONVERTED],
)
def test_a_faulty_tile_is_nan_and_a_flag_and_its_neighbours_go_on(fault: TileStatus) -> None:
    status = np.zeros((12, 4))
    status[11, 1] = fault | TileStatus.RETRIED
    e = estimate(newton_plan(array_at(SQUARE)), loaded_frames(held([7, 8, 9, 10]), status=status))
    assert e.force_n[11] == pytest.approx([7, np.nan, 9, 10], nan_ok=True)
    assert e.gauge_kpa[11] / COUNT_KPA == pytest.approx([7, np.nan, 9, 10], nan_ok=True)
    assert np.isnan([e.grf_n[11], e.grf_sigma_n[11], *(getattr(e, name)[11] for name in COP)]).all()
    assert e.contact[11] == 255
    assert e.estimate_status[11] == EstimateStatus.TILE_MISSING | EstimateStatus.COP_MASKED
    assert e.grf_n[10] == pytest.approx(34)


def test_a_tile_that_answered_late_or_reads_high_is_not_missing() -> None:
    status = np.full((12, 4), TileStatus.RETRIED | TileStatus.OVER_RANGE)
    e = estimate(newton_plan(array_at(SQUARE)), loaded_frames(held([7, 8, 9, 10]), status=status))
    assert e.grf_n == pytest.approx([34.0] * 12)


def test_counts_that_were_not_read_are_missing_whatever_their_status_says() -> None:
    frames = loaded_frames(held([7, 8, 9, 10]))
    frames.padc[11, 0] = 65535
    e = estimate(newton_plan(array_at(SQUARE)), frames)
    assert np.isnan(e.grf_n[11])
    assert e.estimate_status[11] & EstimateStatus.TILE_MISSING


def test_a_temperature_that_was_not_read_is_that_of_the_frame_before_and_none_at_first() -> None:
    frames = loaded_frames(held([7, 8, 9, 10]))
    frames.tadc[0, 0] = frames.tadc[11, 0] = 65535
    e = estimate(newton_plan(array_at(SQUARE)), frames)
    assert np.isnan(e.grf_n[0])
    assert e.grf_n[1:] == pytest.approx([34.0] * 11)


@pytest.mark.parametrize("padc", [894, 1000, 1022, 1023])
def test_a_wrapped_tile_is_a_lower_bound_with_unwrap_and_missing_without(padc: int) -> None:
    # 893.5 counts are 50 kPa: what reads below has fallen through zero
    frames = loaded_frames(held([7, 8, 9, 10]))
    frames.padc[:, 0] = padc
    with_it = estimate(newton_plan(array_at(SQUARE)), frames)
    assert with_it.force_n[:, 0] == pytest.approx([150.0] * 12)
    assert with_it.grf_n == pytest.approx([177.0] * 12)
    assert (with_it.estimate_status & EstimateStatus.SATURATED).all()
    without = estimate(newton_plan(array_at(SQUARE), models=("static",)), frames)
    assert np.isnan(without.grf_n).all()
    assert (without.estimate_status & EstimateStatus.TILE_MISSING).all()
    assert not (without.estimate_status & EstimateStatus.EXTRAPOLATED).any()


@settings(max_examples=60, deadline=None)
@given(st.data())
def test_no_counts_no_bits_and_no_float_make_an_exception_or_a_warning(data: st.DataObject) -> None:
    def drawn(low: int, high: int) -> np.ndarray:
        edges = st.sampled_from([low, high, (low + high) // 2])
        return np.array(
            data.draw(st.lists(st.one_of(edges, st.integers(low, high)), min_size=9, max_size=9))
        )

    def per_tile(low: int, high: int) -> np.ndarray:
        return np.resize(drawn(low, high), (12, 3))

    chip = tuple(data.draw(st.tuples(*[st.integers(0, 65535)] * 4)))
    plan = newton_plan(array_at(SQUARE[:3], servo=make_servo(), chips=[chip] * 3), lag_ms=5)
    frames = loaded_frames(
        np.zeros((12, 3)),
        padc=per_tile(0, 65535),
        tadc=per_tile(0, 65535),
        status=per_tile(0, 255),
        frame_status=np.resize(drawn(0, 255), 12),
        servo_counts=np.resize(drawn(-(2**31), 2**31 - 1), 12),
        reference_force_n=[np.nan, np.inf, -np.inf] * 4,
    )
    e = estimate(plan, frames)
    assert len(e) == 12
    assert not np.isinf(e.force_n).any()
    stated = np.isfinite(e.cop_x_m)
    assert (np.abs(e.cop_x_m[stated]) < 0.1).all()


# --- flags, one by one ----------------------------------------------------------------------------


def test_a_good_frame_in_stance_has_no_flag() -> None:
    assert (
        estimate(newton_plan(array_at(SQUARE)), loaded_frames(held([9] * 4))).estimate_status[-1]
        == 0
    )


def test_saturated_says_that_force_and_sum_are_lower_bounds() -> None:
    # the calibration ends at 150 N
    e = estimate(newton_plan(array_at(SQUARE)), loaded_frames(held([151, 9, 9, 9])))
    assert e.estimate_status[-1] == EstimateStatus.SATURATED | EstimateStatus.COP_MASKED
    assert e.force_n[-1] == pytest.approx([150, 9, 9, 9])
    assert np.isnan(e.force_sigma_n[-1]).tolist() == [True, False, False, False]
    assert e.grf_n[-1] == pytest.approx(177)
    assert np.isnan(e.grf_sigma_n[-1])
    assert e.contact[-1] == 1
    at_the_end = estimate(newton_plan(array_at(SQUARE)), loaded_frames(held([150, 9, 9, 9])))
    assert not at_the_end.estimate_status[-1] & EstimateStatus.SATURATED


def test_all_tiles_saturated_are_a_lower_bound_in_contact() -> None:
    e = estimate(newton_plan(array_at(SQUARE)), loaded_frames(held([400] * 4)))
    assert e.grf_n == pytest.approx([600.0] * 12)
    assert e.contact[-1] == 1


def test_over_rated_is_above_115_kpa_and_within_the_calibration() -> None:
    # 115 kPa is Pcomp 1023: 1787 - 2 padc at 382 counts, which are 118 N
    plan = newton_plan(array_at(SQUARE))
    above = estimate(plan, loaded_frames(held([119, 115, 115, 115])))
    assert above.estimate_status[-1] == EstimateStatus.OVER_RATED
    assert above.grf_n[-1] == pytest.approx(464)
    assert estimate(plan, loaded_frames(held([118, 115, 115, 115]))).estimate_status[-1] == 0


def test_extrapolated_is_five_sigma_below_the_calibration() -> None:
    plan = newton_plan(array_at(SQUARE), sigma_n=0.5)  # 2.5 N
    below = estimate(plan, loaded_frames(held([-3, 30, 30, 30])))
    assert below.estimate_status[-1] & EstimateStatus.EXTRAPOLATED
    assert below.force_n[-1, 0] == pytest.approx(-3)
    noise = estimate(plan, loaded_frames(held([-2, 30, 30, 30])))
    assert not noise.estimate_status[-1] & EstimateStatus.EXTRAPOLATED


def test_gap_marks_the_frame_after_a_missing_number() -> None:
    frames = loaded_frames(held([9] * 4), seq=[0, 1, 2, 3, 4, 5, 7, 8, 9, 10, 11, 12])
    status = estimate(newton_plan(array_at(SQUARE)), frames).estimate_status
    assert np.flatnonzero(status & EstimateStatus.GAP).tolist() == [6]


def test_gap_marks_a_frame_more_than_half_a_period_late() -> None:
    steps_ns = np.array([2, 2, 3, 2, 3, 2, 2]) * 1_000_000
    steps_ns[4] += 1
    frames = loaded_frames(held([9] * 4, 7), t_mono_ns=np.cumsum(steps_ns))
    status = estimate(newton_plan(array_at(SQUARE)), frames).estimate_status
    assert np.flatnonzero(status & EstimateStatus.GAP).tolist() == [4]


def test_a_gap_of_a_minute_between_two_batches_is_seen_and_breaks_the_run() -> None:
    # 8 ms of load on each side of it are no contact
    first = loaded_frames(np.concatenate([held([0] * 4, 3), held([9] * 4, 5)]))
    later = replace(
        first.rows(3, 8),
        seq=first.seq[3:8] + np.uint64(30_000),
        t_mono_ns=first.t_mono_ns[3:8] + 60_000_000_000,
    )
    for lag_ms in (0, 100):
        e = estimate(newton_plan(array_at(SQUARE), lag_ms=lag_ms), first, later)
        assert np.flatnonzero(e.estimate_status & EstimateStatus.GAP).tolist() == [8]
        assert e.contact.tolist() == [0] * 13


def test_the_first_frame_of_a_stream_comes_after_no_gap() -> None:
    frames = loaded_frames(held([9] * 4), seq=np.arange(12) + 77_777)
    assert not (estimate(newton_plan(array_at(SQUARE)), frames).estimate_status & 8).any()


def test_cop_masked_is_flight() -> None:
    e = estimate(newton_plan(array_at(SQUARE)), loaded_frames(held([0] * 4)))
    assert (e.estimate_status == EstimateStatus.COP_MASKED).all()
    assert (e.contact == 0).all()


def test_assumed_scale_marks_every_frame() -> None:
    tiles = [newton_tile(f"T{i + 1:02}", absolute_scale="assumed") for i in range(4)]
    e = estimate(newton_plan(array_at(SQUARE), tiles=tiles), loaded_frames(held([9] * 4)))
    assert (e.estimate_status & EstimateStatus.ASSUMED_SCALE).all()
    assert e.estimate_status[-1] == EstimateStatus.ASSUMED_SCALE


def test_a_tare_is_old_after_half_an_hour() -> None:
    plan = newton_plan(array_at(SQUARE))
    t_ns = plan.tare.t_ns + HALF_HOUR_NS + np.arange(-11, 1) * 2_000_000
    frames = replace(loaded_frames(held([9] * 4)), t_ns=t_ns)
    assert estimate(plan, frames).estimate_status[-1] == 0
    status = estimate(plan, replace(frames, t_ns=t_ns + 1)).estimate_status
    assert np.flatnonzero(status & EstimateStatus.TARE_OLD).tolist() == [11]


def test_a_tare_at_another_temperature_is_flagged_like_an_old_one() -> None:
    # Tared at 480 counts; four are let pass, and a fifth is not, whichever way.
    plan = newton_plan(array_at(SQUARE, references=[3]))
    tadc = np.full((12, 4), 480)
    tadc[3, 1], tadc[4, 1], tadc[5, 2], tadc[6, 2] = 476, 475, 484, 485
    tadc[7, 3] = 300  # of a tile that bears no load it does not matter
    frames = replace(loaded_frames(held([9] * 4)), tadc=tadc.astype(np.uint16))
    status = estimate(plan, frames).estimate_status
    assert np.flatnonzero(status & EstimateStatus.TARE_OLD).tolist() == [4, 6]
    model = Temperature(
        *(np.zeros(3), np.zeros(3), np.ones(3), np.zeros(3)), np.full(3, 480.0), np.full(3, 100.0)
    )
    corrected = replace(plan, ladder=replace(plan.ladder, temperature=model))
    assert not (estimate(corrected, frames).estimate_status & EstimateStatus.TARE_OLD).any()
    unknown = replace(plan, tare=replace(plan.tare, tadc_counts=np.full(4, np.nan)))
    assert not (estimate(unknown, frames).estimate_status & EstimateStatus.TARE_OLD).any()


# --- sums and centres -----------------------------------------------------------------------------


def test_the_sum_is_never_clamped() -> None:
    forces_n = np.array([[k, -k, k - 1, 2 * k] for k in range(-4, 5)], dtype=np.float64)
    grf_n = estimate(newton_plan(array_at(SQUARE)), loaded_frames(forces_n)).grf_n
    assert grf_n == pytest.approx([3 * k - 1 for k in range(-4, 5)], abs=1e-10)


def test_in_flight_the_sum_is_unbiased() -> None:
    # The paper's curve, 0.2 N a count, under 1.3 counts of noise: 0.5 N in all, so the mean of
    # 40,000 frames is good to 0.003 N. Clipped at zero it would be 0.4 N.
    noise = np.random.default_rng(5).normal(0, 1.3, (40_000, 4))
    plan = newton_plan(array_at(SQUARE), tiles=paper_eq2_shape().tiles, sigma_n=1.3)
    e = estimate(plan, loaded_frames(noise))
    assert abs(e.grf_n.mean()) < 0.01
    assert abs((e.grf_n < -0.1).mean() - (e.grf_n > 0.1).mean()) < 0.02
    assert e.grf_n.std() == pytest.approx(e.grf_sigma_n.mean(), rel=0.1)


def test_zero_load_has_no_centre_and_no_warning() -> None:
    plan = newton_plan(array_at(SQUARE))
    exact = replace(plan.tare, baseline_kpa=plan.compensation.kpa([[500] * 4], [[480] * 4])[0])
    e = estimate(replace(plan, tare=exact), loaded_frames(held([0] * 4)))
    assert e.grf_n.tolist() == [0.0] * 12
    assert all(np.isnan(getattr(e, name)).all() for name in COP)


def test_the_centre_of_pressure_on_a_grid_is_that_worked_out_by_hand() -> None:
    # 10 and 20 N at y = 0, 30 and 40 N at y = 10 mm; 60 of 100 N at x = 20 mm
    e = estimate(newton_plan(array_at(SQUARE)), loaded_frames(held([10, 20, 30, 40])))
    assert e.cop_x_m[-1] == pytest.approx(0.012, abs=1e-12)
    assert e.cop_y_m[-1] == pytest.approx(0.007, abs=1e-12)
    assert e.cop_index_x[-1] == pytest.approx(1.6, abs=1e-10)
    assert e.cop_index_y[-1] == pytest.approx(1.7, abs=1e-10)
    assert np.isnan(e.cop_x_m[:5]).all()  # contact is not believed yet


def test_the_centre_of_pressure_on_a_line_is_that_worked_out_by_hand() -> None:
    # (-21 * 4 - 7 * 8 + 7 * 12 + 21 * 16) / 40 mm; index (1 * 4 + 2 * 8 + 3 * 12 + 4 * 16) / 40
    e = estimate(newton_plan(array_at(LINE)), loaded_frames(held([4, 8, 12, 16])))
    assert e.cop_x_m[-1] == pytest.approx(0.007, abs=1e-12)
    assert e.cop_y_m[-1] == pytest.approx(0.0, abs=1e-12)
    assert e.cop_index_x[-1] == pytest.approx(3.0, abs=1e-10)
    assert e.cop_index_y[-1] == pytest.approx(1.0, abs=1e-10)


def test_the_papers_index_weighs_with_pressure_and_counts_from_one() -> None:
    # The right tile needs three times the force for the same pressure: 10 and 30 N at 10 counts.
    tiles = [newton_tile("T01"), newton_tile("T02", f_scale_n=3.0)]
    positions = [(0.0, 0.0, -0.15), (0.02, 0.0, -0.15)]
    e = estimate(newton_plan(array_at(positions), tiles=tiles), loaded_frames(held([10, 10])))
    assert e.grf_n[-1] == pytest.approx(40)
    assert e.cop_x_m[-1] == pytest.approx(0.015)
    assert e.cop_index_x[-1] == pytest.approx(1.5)


def test_tiles_that_fill_no_grid_have_a_centre_and_no_index() -> None:
    e = estimate(newton_plan(array_at(SQUARE[:3])), loaded_frames(held([10, 20, 30])))
    assert e.cop_x_m[-1] == pytest.approx(0.02 * 20 / 60)
    assert np.isnan(e.cop_index_x).all()
    assert np.isnan(e.cop_index_y).all()


def test_a_reference_tile_is_in_no_sum_and_flags_nothing() -> None:
    plan = newton_plan(array_at([*SQUARE, (0.9, 0.9, -0.15)], references=[4]))
    for surroundings in (80.0, 300.0, -90.0, np.nan):
        e = estimate(plan, loaded_frames(held([10, 20, 30, 40, surroundings])))
        assert e.estimate_status[-1] == 0
        assert e.grf_n[-1] == pytest.approx(100)
        assert e.grf_sigma_n[-1] == pytest.approx(1.0)  # four times 0.5 N
        assert e.cop_x_m[-1] == pytest.approx(0.012)
        assert e.cop_index_x[-1] == pytest.approx(1.6)
        assert np.isnan(e.force_n[-1, 4])
        assert np.isnan(e.force_sigma_n[-1, 4])
        if not np.isnan(surroundings):
            assert e.gauge_kpa[-1, 4] == pytest.approx(surroundings * COUNT_KPA)


def test_sigma_of_sum_and_centre_are_those_of_independent_tiles() -> None:
    # COP at 12 and 7 mm of 100 N; each newton moves it by (x - 12 mm) / 100 N, likewise y
    e = estimate(newton_plan(array_at(SQUARE), sigma_n=0.5), loaded_frames(held([10, 20, 30, 40])))
    assert e.force_sigma_n[-1] == pytest.approx([0.5] * 4)
    assert e.grf_sigma_n[-1] == pytest.approx(1.0)
    by_x_m = math.sqrt(2 * 0.012**2 + 2 * 0.008**2) * 0.5 / 100
    by_y_m = math.sqrt(2 * 0.007**2 + 2 * 0.003**2) * 0.5 / 100
    assert e.cop_sigma_x_m[-1] == pytest.approx(by_x_m)
    assert e.cop_sigma_y_m[-1] == pytest.approx(by_y_m)


def test_a_punctured_tile_pulls_the_sum_and_raises_no_flag() -> None:
    e = estimate(newton_plan(array_at(SQUARE)), loaded_frames(held([0, 20, 30, 40])))
    assert e.grf_n[-1] == pytest.approx(90)
    assert e.cop_x_m[-1] == pytest.approx(0.02 * 60 / 90)


# --- where there is no centre of pressure ---------------------------------------------------------


def masked(e: Estimates) -> list[bool]:
    """Which rows have no centre; all its columns and the flag must agree."""
    out = np.isnan(e.cop_x_m)
    for name in COP:
        assert np.isnan(getattr(e, name)).tolist() == out.tolist(), name
    assert ((e.estimate_status & EstimateStatus.COP_MASKED) != 0).tolist() == out.tolist()
    return [bool(row) for row in out]


def test_no_centre_without_contact_however_good_it_would_be() -> None:
    e = estimate(newton_plan(array_at(SQUARE)), loaded_frames(held([30] * 4, 12)))
    assert masked(e) == [True] * 5 + [False] * 7


def test_no_centre_that_is_too_uncertain() -> None:
    # Tiles 200 mm apart with 0.5 N each: sigma is 100 mm * sqrt(2) * 0.5 N / GRF, 3 mm at 23.6 N.
    far = array_at([(-0.1, 0.0, -0.15), (0.1, 0.0, -0.15)])
    near_enough = estimate(newton_plan(far), loaded_frames(held([12, 12])))
    assert near_enough.cop_sigma_x_m[-1] == pytest.approx(0.1 * math.sqrt(0.5) / 24)
    assert not masked(near_enough)[-1]
    assert masked(estimate(newton_plan(far), loaded_frames(held([11, 11]))))[-1]
    across = array_at([(0.0, -0.1, -0.15), (0.0, 0.1, -0.15)])
    assert not masked(estimate(newton_plan(across), loaded_frames(held([12, 12]))))[-1]
    assert masked(estimate(newton_plan(across), loaded_frames(held([11, 11]))))[-1]


def test_no_centre_below_five_sigma_of_load() -> None:
    # Tiles a millimetre apart, so that the centre itself is certain; sigma of the sum 1.41 N.
    # Contact holds down to 3 sigma (4.24 N), a centre only to 5 sigma (7.07 N).
    close = array_at([(0.0, 0.0, -0.15), (0.001, 0.0, -0.15)])
    forces_n = np.concatenate([held([20, 20], 10), held([4, 4], 10), held([4, 3], 10)])
    e = estimate(newton_plan(close, sigma_n=1.0), loaded_frames(forces_n))
    assert (e.contact[10:] == 1).all()
    assert masked(e)[10:] == [False] * 10 + [True] * 10


def test_no_centre_outside_the_tiles_except_by_noise() -> None:
    # 40 N here and -k there puts it 14 mm * k / (40 - k) beyond the last tile, with a sigma of
    # about 14 mm * 0.5 N / 40 N: three of them are let through, so -1 N is and -2 N is not.
    pair = array_at([(0.0, 0.0, -0.15), (0.014, 0.0, -0.15)])
    plan = newton_plan(pair, sigma_n=0.5)
    assert not masked(estimate(plan, loaded_frames(held([40, 0]))))[-1]
    by_noise = estimate(plan, loaded_frames(held([40, -1])))
    assert not masked(by_noise)[-1]
    assert by_noise.cop_x_m[-1] == pytest.approx(-0.014 / 39)
    assert masked(estimate(plan, loaded_frames(held([40, -2]))))[-1]


# --- servo and ground frame -----------------------------------------------------------------------


def test_a_foot_without_servo_has_no_angle_and_no_ground_frame() -> None:
    e = estimate(
        newton_plan(array_at(SQUARE)), loaded_frames(held([9] * 4), servo_counts=[2048] * 12)
    )
    assert np.isnan(e.angle_rad).all()
    assert np.isnan(e.cop_ground_x_m).all()
    assert np.isnan(e.cop_ground_y_m).all()


@pytest.mark.parametrize("degrees", [-90, -45, 0, 8, 45, 90])
def test_a_rolling_foot_stands_where_its_ankle_is(degrees: int) -> None:
    # Two tiles side by side on an arc of 150 mm touch at their own arc angle, right under an ankle
    # that has come 150 mm a radian. 4096 counts a turn: 8 degrees are 91 counts, to a half.
    counts = round(degrees / 360 * 4096)
    arc_rad = counts / 4096 * 2 * math.pi
    x_m, z_m = 0.15 * math.sin(arc_rad), -0.15 * math.cos(arc_rad)
    info = array_at([(x_m, -0.01, z_m), (x_m, 0.01, z_m)], servo=make_servo())
    e = estimate(
        newton_plan(info), loaded_frames(held([30, 10]), servo_counts=np.full(12, 2048 + counts))
    )
    assert e.angle_rad[-1] == pytest.approx(arc_rad, abs=1e-15)
    assert e.cop_ground_x_m[-1] == pytest.approx(0.15 * arc_rad, abs=1e-12)
    assert e.cop_ground_y_m[-1] == pytest.approx(-0.005, abs=1e-12)


def test_the_ground_frame_uses_the_height_of_the_centre() -> None:
    # Centre at x = 15 mm, z = -0.145 m; at 30 degrees with an ankle that stays where it is
    info = array_at(
        [(0.0, 0.0, -0.16), (0.02, 0.0, -0.14)],
        servo=make_servo(ratio=1 / 3, ankle_travel_m_per_rad=0.0),
    )
    e = estimate(
        newton_plan(info), loaded_frames(held([10, 30]), servo_counts=np.full(12, 2048 + 1024))
    )
    assert e.angle_rad[-1] == pytest.approx(math.pi / 6)
    expected_m = 0.015 * math.cos(math.pi / 6) - 0.145 * 0.5
    assert e.cop_ground_x_m[-1] == pytest.approx(expected_m, abs=1e-12)


def test_unknown_travel_leaves_the_angle_and_no_ground_frame() -> None:
    plan = newton_plan(array_at(SQUARE, servo=make_servo(ankle_travel_m_per_rad=None)))
    e = estimate(plan, loaded_frames(held([9] * 4), servo_counts=[2048] * 12))
    assert e.angle_rad.tolist() == [0.0] * 12
    assert np.isfinite(e.cop_x_m[-1])
    assert np.isnan(e.cop_ground_x_m).all()
    assert np.isnan(e.cop_ground_y_m).all()


@pytest.mark.parametrize(
    "columns",
    [
        {"servo_counts": [NO_SERVO_COUNTS] * 12},
        {"servo_counts": [2048] * 12, "frame_status": [FrameStatus.SERVO_STALE] * 12},
    ],
)
def test_a_servo_that_is_silent_or_stale_gives_nan_and_the_foot_goes_on(
    columns: dict[str, list[int]],
) -> None:
    e = estimate(
        newton_plan(array_at(SQUARE, servo=make_servo())), loaded_frames(held([9] * 4), **columns)
    )
    assert np.isnan(e.angle_rad).all()
    assert np.isnan(e.cop_ground_x_m).all()
    assert e.cop_x_m[-1] == pytest.approx(0.01)
    assert e.estimate_status[-1] == 0


def test_an_angle_goes_on_over_the_end_of_a_turn() -> None:
    counts = [4094, 4095, 4096, 4097, 8191, 8192, 1, 0, -1, -2, -4096, -4097]
    plan = newton_plan(array_at(SQUARE, servo=make_servo(ratio=0.1)))
    angle_rad = estimate(plan, loaded_frames(held([9] * 4), servo_counts=counts)).angle_rad
    expected = [0.1 * (c - 2048) / 4096 * 2 * math.pi for c in counts]
    assert angle_rad == pytest.approx(expected, abs=1e-15)


# --- honest uncertainty ---------------------------------------------------------------------------


def test_with_white_noise_and_a_perfect_curve_intervals_cover_what_they_say() -> None:
    # Noise of 1.3 counts (0.165 kPa), rounding, and a tare from half a second of the same.
    rng = np.random.default_rng(20)
    info = array_at(SQUARE)
    compensation = Compensation(info.tiles)
    calibration = make_calibration(
        *(newton_tile(serial, coefficients=(0.0, 1.0, 0.002, 1e-5)) for serial in info.serials)
    )
    within: dict[str, list[np.ndarray]] = {name: [] for name in ("grf_n", "cop_x_m", "cop_y_m")}
    for _ in range(60):
        load = rng.uniform(8.0, 60.0, 4) * rng.uniform(0.9, 1.1, (200, 4))
        counts = np.concatenate([np.zeros((250, 4)), load])
        frames = loaded_frames(counts + rng.normal(0, 1.3, counts.shape))
        tare = take_tare(frames, compensation, calibration, info.serials, interval_s=(0.0, 0.499))
        plan = make_plan(info, calibration, tare, models=("static",))
        e = estimate(plan, frames).rows(256, 450)
        force_n = counts + 0.002 * counts**2 + 1e-5 * counts**3
        truth_n = force_n[256:].sum(axis=1)
        for name, truth, sigma in (
            ("grf_n", truth_n, e.grf_sigma_n),
            ("cop_x_m", force_n[256:, [1, 3]].sum(axis=1) * 0.02 / truth_n, e.cop_sigma_x_m),
            ("cop_y_m", force_n[256:, [2, 3]].sum(axis=1) * 0.01 / truth_n, e.cop_sigma_y_m),
        ):
            stated = np.isfinite(getattr(e, name))
            error = np.abs(getattr(e, name) - truth)[stated]
            within[name].append(error <= 1.96 * sigma[stated])
    for name, parts in within.items():
        covered = np.concatenate(parts)
        assert len(covered) > 11_000, name
        assert 0.93 <= covered.mean() <= 0.97, name


@pytest.mark.parametrize("status", list(EstimateStatus))
def test_every_flag_has_a_bit_of_its_own(status: EstimateStatus) -> None:
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
    }
    assert bits[str(status.name).lower()] == status


def test_a_link_that_loses_every_third_frame_still_sees_the_contact() -> None:
    frames = loaded_frames(held([9] * 4, rows=60))
    kept = FrameBatch.concatenate([frames.rows(i, i + 2) for i in range(0, 60, 3)])
    e = estimate(newton_plan(array_at(SQUARE), lag_ms=10), kept)
    assert (e.contact[1:] == 1).all()
    assert (e.estimate_status & EstimateStatus.GAP).any(), "the gaps are flagged all the same"
    # After a hundred milliseconds without a frame the foot may have been lifted and put down again.
    long_ago = replace(frames, t_mono_ns=frames.t_mono_ns + 100_000_000 * (frames.seq >= 58))
    assert estimate(newton_plan(array_at(SQUARE)), long_ago).contact[57:59].tolist() == [1, 1]
