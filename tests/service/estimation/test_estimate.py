"""`ModelEstimator`: batches, states, contact, pressures, and valid uncertainty.

Tiles read one newton a count (see tests/builders), so forces below are their loads.
"""

from __future__ import annotations

import copy
from dataclasses import fields, replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from devices.chips.mpl115a2 import PRESSURE_MIN_KPA, Coefficients, compute_padc
from devices.chips.pressure_chips import Compensation
from devices.flags import EstimateFlag
from devices.frames import NOT_READ, FrameBatch, hold_temperature
from service.estimation.estimate import ModelEstimator
from service.estimation.pipeline.params import MODEL_NAMES
from service.estimation.pipeline.plan import make_plan
from service.estimation.tare.unloaded_windows import compute_recording_tare
from tests.builders.arrays import COUNT_KPA, DATA_SHEET_CHIP, FORUM_CHIP, array_at, make_servo
from tests.builders.calibrations import make_calibration, make_effects, make_tare, newton_tile
from tests.builders.estimates import estimate, joined, newton_plan, with_params
from tests.builders.frames import assert_same_bits, cut_up, loaded_frames
from tests.service.estimation.feet import SQUARE, draw_wild_frames, estimate_load, repeat_load

# --- batches --------------------------------------------------------------------------------------


def test_long_batches_give_the_bits_of_short_ones() -> None:
    # Long enough for every vector width and its remainder, and for the blocks numpy works in.
    plan = newton_plan(array_at(SQUARE, servo=make_servo()), lag_ms=10)
    frames = draw_wild_frames(20_011, 4, 1)
    cuts = [1, 8, 17, 33, 64, 1000, 8191, 8192, 16_385]
    assert_same_bits(estimate(plan, frames), estimate(plan, *cut_up(frames, cuts)))


@pytest.mark.parametrize("first", [2**53 - 3, 2**63 - 3, 2**63, 2**64 - 10])
def test_any_frame_number_of_the_type_is_valid(first: int) -> None:
    plan = newton_plan(array_at(SQUARE))
    seq = np.uint64(first) + np.arange(9, dtype=np.uint64)
    frames = loaded_frames(repeat_load([0] * 4, 9), seq=seq)
    whole = estimate(plan, frames)
    assert not (whole.estimate_flags & EstimateFlag.GAP).any()
    assert_same_bits(whole, estimate(plan, *cut_up(frames, range(9))))


@pytest.mark.parametrize("start_ns", [0, -5_000_000_000, 2**62])
def test_time_may_begin_anywhere(start_ns: int) -> None:
    plan = newton_plan(array_at(SQUARE), lag_ms=20)
    forces_n = np.concatenate(
        [repeat_load([0] * 4, 10), repeat_load([9] * 4, 10), repeat_load([0] * 4, 10)]
    )
    t_ns = start_ns + 2_000_000 * np.arange(30, dtype=np.int64)
    frames = loaded_frames(forces_n, t_mono_ns=t_ns, t_ns=t_ns)
    assert estimate(plan, frames).contact.tolist() == [0] * 10 + [1] * 10 + [0] * 10


@settings(max_examples=20, deadline=None)
@given(
    cuts=st.sets(st.integers(1, 2999), min_size=1, max_size=5),
    seed=st.integers(0, 9),
    lag_ms=st.sampled_from([0.0, 20.0, 3000.0]),
    models=st.sampled_from([("unwrap", "static"), tuple(m for m in MODEL_NAMES if m != "ambient")]),
)
def test_an_estimator_continues_from_a_state_with_the_same_bits(
    cuts: set[int], seed: int, lag_ms: float, models: tuple[str, ...]
) -> None:
    info = array_at(SQUARE, servo=make_servo())
    known = [newton_tile(serial, effects=make_effects()) for serial in info.serials]
    plan = newton_plan(info, models=models, lag_ms=lag_ms, tiles=known)
    frames = draw_wild_frames(3000, 4, seed)
    estimator, found = ModelEstimator(plan), []
    for begin, end in pairwise([0, *sorted(cuts), 3000]):
        estimator = ModelEstimator.from_state(plan, estimator.state_dict())
        found.append(estimator.process_frames(frames.slice_rows(begin, end)))
    last = estimator.finish()
    assert_same_bits(joined(found if last is None else [*found, last]), estimate(plan, frames))


def test_a_state_of_another_plan_is_refused() -> None:
    plan, wider = newton_plan(array_at(SQUARE)), newton_plan(array_at((*SQUARE, (0.3, 0.0, 0.0))))
    estimator = ModelEstimator(plan)
    estimator.process_frames(draw_wild_frames(50, 4, 1))
    state = estimator.state_dict()
    with pytest.raises(ValueError, match="tile_states is uint8"):
        ModelEstimator.from_state(wider, state)
    with pytest.raises(ValueError, match="rows is uint8"):
        ModelEstimator.from_state(plan, state | {"rows": state["rows"][:-1]})
    foot_state = np.zeros_like(state["foot_state"])
    foot_state[:] = 0xFF
    with pytest.raises(ValueError, match="its rows are -1"):
        ModelEstimator.from_state(plan, state | {"foot_state": foot_state})


# --- steps and states -----------------------------------------------------------------------------


def test_estimates_come_when_their_look_ahead_is_complete() -> None:
    plan, frames = newton_plan(array_at(SQUARE), lag_ms=10), loaded_frames(repeat_load([0] * 4, 9))
    estimator = ModelEstimator(plan)
    due = [estimator.process_frames(frames.slice_rows(i, i + 1)).seq.tolist() for i in range(9)]
    assert due == [[], [], [], [], [], [0], [1], [2], [3]]  # frame 0 at 0 ms, due at 10 ms
    last = estimator.finish()
    assert last is not None
    assert last.seq.tolist() == [4, 5, 6, 7, 8]


def test_estimates_without_look_ahead_come_at_once() -> None:
    plan = newton_plan(array_at(SQUARE))
    estimator = ModelEstimator(plan)
    assert len(estimator.process_frames(loaded_frames(repeat_load([0] * 4, 3)))) == 3
    assert estimator.finish() is None
    assert ModelEstimator(plan).finish() is None


def test_a_step_changes_neither_its_frames_nor_earlier_estimates() -> None:
    plan = newton_plan(array_at(SQUARE, servo=make_servo()), lag_ms=10)
    frames = draw_wild_frames(60, 4, 3)
    before, estimator = copy.deepcopy(frames), ModelEstimator(plan)
    first = estimator.process_frames(frames.slice_rows(0, 30))
    given = copy.deepcopy(first)
    estimator.process_frames(frames.slice_rows(30, 60))
    estimator.finish()
    assert_same_bits(first, given)
    for f in fields(FrameBatch):
        assert getattr(frames, f.name).tobytes() == getattr(before, f.name).tobytes(), f.name


@pytest.mark.parametrize("lag_ms", [0.0, 10.0, 3000.0])
@pytest.mark.parametrize("models", [("static",), ("static", "denoise")])
def test_a_growing_buffer_gives_the_same_bits(lag_ms: float, models: tuple[str, ...]) -> None:
    # The buffer of frames is full, and grows, several times.
    plan = newton_plan(array_at(SQUARE), models=models, lag_ms=lag_ms)
    forces_n = np.random.default_rng(2).normal(9.0, 1.0, (9000, 4))
    frames = loaded_frames(forces_n)
    whole = estimate(plan, frames)
    for cuts in ([1, 5001, 5003, 5010, 6510, 6511], range(0, 9000, 3)):
        assert_same_bits(whole, estimate(plan, *cut_up(frames, cuts)))


@pytest.mark.parametrize(
    ("lag_ms", "first_in_contact"), [(0, 15), (4, 13), (8, 11), (10, 10), (50, 10)]
)
def test_contact_is_dated_back_by_the_look_ahead(lag_ms: float, first_in_contact: int) -> None:
    # loaded from frame 10 on, believed after 10 ms, which are five frames
    plan = newton_plan(array_at(SQUARE), lag_ms=lag_ms)
    frames = loaded_frames(np.concatenate([repeat_load([0] * 4, 10), repeat_load([8] * 4, 20)]))
    contact = estimate(plan, frames).contact
    unknown = first_in_contact - 10  # until 10 ms have shown that it is unloaded
    assert contact.tolist() == (
        [255] * unknown + [0] * (first_in_contact - unknown) + [1] * (30 - first_in_contact)
    )


def test_a_pause_after_one_unloaded_frame_does_not_end_contact() -> None:
    # 32 N, a frame of 0 N, 20 ms without a frame, 4 N (between the thresholds), and 32 N again
    forces_n = np.concatenate(
        [
            repeat_load([8] * 4, 20),
            repeat_load([0] * 4, 1),
            repeat_load([1] * 4, 2),
            repeat_load([8] * 4, 20),
        ]
    )
    frames = loaded_frames(forces_n)
    paused = replace(frames, t_mono_ns=frames.t_mono_ns + 20_000_000 * (frames.seq >= 21))
    assert (estimate(newton_plan(array_at(SQUARE), lag_ms=100), paused).contact == 1).all()


def test_contact_ends_with_the_load_though_domes_recover_for_seconds() -> None:
    effects = make_effects()
    assert effects.rubber is not None
    rows, rise = 1000, 500
    force_n = np.where(np.arange(rows) < rise, 80.0, 0.0)
    crept_n = np.zeros(rows)  # as rubber.py says, with steps of 2 ms
    for part, tau_s in zip(effects.rubber.part, effects.rubber.tau_s, strict=True):
        lagging_n = 0.0
        for i in range(rows):
            lagging_n += (force_n[i] - lagging_n) * -np.expm1(-0.002 / tau_s.value)
            crept_n[i] += part.value * (force_n[i] - lagging_n)
    frames = loaded_frames(np.tile((force_n - crept_n)[:, None], 4))
    info = array_at(SQUARE)
    tiles = [newton_tile(serial, effects=effects) for serial in info.serials]
    bare, full = (
        newton_plan(info, sigma_n=0.1, lag_ms=50, models=["unwrap", "static", *more], tiles=tiles)
        for more in ([], ["rubber"])
    )
    expected = [1] * rise + [0] * (rows - rise)
    without_share = {"contact_on_share": 0.0, "contact_off_share": 0.0}
    assert estimate(full, frames).contact.tolist() == expected
    assert estimate(with_params(full, foot=without_share), frames).contact.tolist() == expected
    # Without the model a share of the load stands for what is left of it, 7 % at first.
    contact = estimate(bare, frames).contact
    assert contact.tolist()[:rise] == expected[:rise]
    assert not contact[rise + 50 :].any()
    assert estimate(with_params(bare, foot=without_share), frames).contact.all()


def test_contact_is_unknown_without_forces_and_continues_after_them() -> None:
    forces_n = repeat_load([8, 0, 0, 0], 20)
    forces_n[12:15, 0] = np.nan
    contact = estimate(newton_plan(array_at(SQUARE), lag_ms=50), loaded_frames(forces_n)).contact
    assert contact.tolist() == [1] * 12 + [255] * 3 + [1] * 5


@pytest.mark.parametrize("lag_ms", [0.0, 50.0])
def test_contact_is_known_by_the_tiles_beside_a_missing_one(lag_ms: float) -> None:
    forces_n = np.concatenate(
        [repeat_load([0] * 4), repeat_load([8] * 4, 20), repeat_load([0] * 4)]
    )
    forces_n[:, 2] = np.nan
    e = estimate(newton_plan(array_at(SQUARE), lag_ms=lag_ms), loaded_frames(forces_n))
    begin = 12 if lag_ms else 17
    assert (e.contact[begin:32] == 1).all()
    assert (e.contact[:begin] == 255).all()
    assert (e.contact[32:] == 255).all()  # the missing tile may bear the whole load
    assert np.isnan(e.grf_n).all()
    assert np.isnan(e.cop_x_m).all()


def test_an_impossible_suction_is_missing() -> None:
    e = estimate_load([7, 8, 9, -78])  # 9.9 kPa below the baseline
    assert (e.estimate_flags & EstimateFlag.EXTRAPOLATED).all()
    assert e.force_n[:, 3] == pytest.approx([-78.0] * 12)
    e = estimate_load([7, 8, 9, -79])
    assert np.isnan(e.force_n[:, 3]).all()
    assert e.gauge_kpa[:, 3] / COUNT_KPA == pytest.approx([-79.0] * 12)
    assert (e.estimate_flags & EstimateFlag.TILE_MISSING).all()
    assert e.grf_lower_bound_n == pytest.approx([24 - 2.33 * 0.5 * np.sqrt(3)] * 12)


@pytest.mark.parametrize("chip", [DATA_SHEET_CHIP, FORUM_CHIP])
@pytest.mark.parametrize("models", [("unwrap", "static"), ("static",)])
def test_no_sum_is_stated_with_a_load_beyond_the_range(
    chip: tuple[int, int, int, int], models: tuple[str, ...]
) -> None:
    # Up to twice the greatest load; counts fall through zero.
    info = array_at(SQUARE, chips=[chip] * 4)
    part = Coefficients.from_words(chip)
    kpa = np.linspace(115.5, 100.0 + 2 * 30.0, 400)
    pressure_raw = np.full((400, 4), round(float(compute_padc(100.0, 480, part))))
    pressure_raw[:, 0] = np.rint(compute_padc(kpa, 480, part)) % 1024
    unloaded_kpa = part.make_law().compute_kpa(pressure_raw[0, 1], 480)
    tare = make_tare(4, baseline_kpa=unloaded_kpa, noise_kpa=0.05)
    tiles = [newton_tile(s, range_kpa=(0.0, 14.0)) for s in info.serials]
    plan = make_plan(info, make_calibration(*tiles), tare, models=models)
    e = estimate(plan, loaded_frames(np.zeros((400, 4)), pressure_raw=pressure_raw))
    true_n = (kpa - 100.0) / COUNT_KPA
    known = np.isfinite(e.grf_n)
    assert not known.any()
    assert (e.grf_lower_bound_n <= true_n).all()
    doubt = EstimateFlag.SATURATED | EstimateFlag.TILE_MISSING
    assert ((e.estimate_flags & doubt) != 0).all()


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_pressures_have_the_bits_of_those_for_tare_and_calibration(seed: int) -> None:
    # Compiled here, numpy there: unread temperatures, faults of every kind, pauses of a minute.
    rng = np.random.default_rng(seed)
    frames = draw_wild_frames(60, 4, seed)
    frames.temperature_raw[rng.random(frames.temperature_raw.shape) < 0.5] = NOT_READ
    plan = newton_plan(array_at(SQUARE), models=("static",))
    kpa = Compensation(plan.info.tiles).compute_usable_kpa(hold_temperature(frames)[0])
    kpa[~(kpa >= PRESSURE_MIN_KPA)] = np.nan
    gauge_kpa = estimate(with_params(plan, foot={"has_fault_detection": 0}), frames).gauge_kpa
    assert gauge_kpa.tobytes() == (kpa - plan.tare.baseline_kpa).tobytes()


def test_frames_of_another_number_of_tiles_are_refused() -> None:
    for tiles in (3, 5):
        with pytest.raises(ValueError, match=f"frames of {tiles} tiles, a plan of 4"):
            estimate_load([0] * tiles)


@pytest.mark.parametrize("pressure_raw", [894, 1000, 1022, 1023])
def test_a_wrapped_tile_is_a_lower_bound_with_unwrap_and_missing_without(pressure_raw: int) -> None:
    # 893.5 counts are 50 kPa: what reads below has fallen through zero
    frames = loaded_frames(repeat_load([7, 8, 9, 10]))
    frames.pressure_raw[:, 0] = pressure_raw
    with_it = estimate(newton_plan(array_at(SQUARE)), frames)
    assert with_it.force_n[:, 0] == pytest.approx([150.0 - 2.33 * 0.5] * 12)
    assert np.isnan(with_it.grf_n).all()
    assert with_it.grf_lower_bound_n == pytest.approx([177.0 - 2.33] * 12)  # of four tiles: 1 N
    assert (with_it.estimate_flags & EstimateFlag.SATURATED).all()
    without = estimate(newton_plan(array_at(SQUARE), models=("static",)), frames)
    assert np.isnan(without.grf_n).all()
    assert (without.estimate_flags & EstimateFlag.TILE_MISSING).all()
    assert not (without.estimate_flags & EstimateFlag.EXTRAPOLATED).any()


# --- valid uncertainty ----------------------------------------------------------------------------


def test_intervals_under_white_noise_cover_95_percent() -> None:
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
        tare = compute_recording_tare(
            frames, compensation, calibration, info.serials, interval_s=(0.0, 0.499)
        )
        plan = make_plan(info, calibration, tare, models=("static",))
        e = estimate(plan, frames).slice_rows(256, 450)
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


def test_contact_survives_the_loss_of_every_third_frame() -> None:
    frames = loaded_frames(repeat_load([9] * 4, 60))
    kept = FrameBatch.concatenate([frames.slice_rows(i, i + 2) for i in range(0, 60, 3)])
    e = estimate(newton_plan(array_at(SQUARE), lag_ms=10), kept)
    assert (e.contact[1:] == 1).all()
    assert (e.estimate_flags & EstimateFlag.GAP).any(), "gaps are flagged"
    # After a hundred milliseconds without a frame the foot may have been lifted and put down again.
    long_ago = replace(frames, t_mono_ns=frames.t_mono_ns + 100_000_000 * (frames.seq >= 58))
    assert estimate(newton_plan(array_at(SQUARE)), long_ago).contact[57:59].tolist() == [1, 1]
