"""Sums and centres of pressure worked out by hand, where there is none, and the ground frame."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from devices.flags import EstimateFlag, FrameFlag
from devices.frames import NO_SERVO_COUNTS
from service.estimation.calibration import make_paper_shape_preset
from service.estimation.records import Estimates
from tests.builders.arrays import COUNT_KPA, array_at, make_servo
from tests.builders.calibrations import newton_tile
from tests.builders.estimates import estimate, newton_plan
from tests.builders.frames import loaded_frames
from tests.service.estimation.feet import COP, SQUARE, held

LINE = [(-0.021, 0.0, -0.15), (-0.007, 0.0, -0.15), (0.007, 0.0, -0.15), (0.021, 0.0, -0.15)]


# --- sums and centres -----------------------------------------------------------------------------


def test_the_sum_is_never_clamped() -> None:
    forces_n = np.array([[k, -k, k - 1, 2 * k] for k in range(-4, 5)], dtype=np.float64)
    grf_n = estimate(newton_plan(array_at(SQUARE)), loaded_frames(forces_n)).grf_n
    assert grf_n == pytest.approx([3 * k - 1 for k in range(-4, 5)], abs=1e-10)


def test_in_flight_the_sum_is_unbiased() -> None:
    # The paper's curve, 0.2 N a count, under 1.3 counts of noise: 0.5 N in all, so the mean of
    # 40,000 frames is good to 0.003 N. Clipped at zero it would be 0.4 N.
    noise = np.random.default_rng(5).normal(0, 1.3, (40_000, 4))
    plan = newton_plan(array_at(SQUARE), tiles=make_paper_shape_preset().tiles, sigma_n=1.3)
    e = estimate(plan, loaded_frames(noise))
    assert abs(e.grf_n.mean()) < 0.01
    assert abs((e.grf_n < -0.1).mean() - (e.grf_n > 0.1).mean()) < 0.02
    assert e.grf_n.std() == pytest.approx(e.grf_sigma_n.mean(), rel=0.1)


def test_zero_load_has_no_centre_and_no_warning() -> None:
    plan = newton_plan(array_at(SQUARE))
    exact = replace(
        plan.tare, baseline_kpa=plan.compensation.compute_kpa([[500] * 4], [[480] * 4])[0]
    )
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
    assert np.isnan(e.cop_y_m).all()
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
        assert e.estimate_flags[-1] == 0
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


def masked(e: Estimates, measured: str = "xy") -> list[bool]:
    """Which rows have no centre; the flag and all its columns along measured axes must agree."""
    out = (e.estimate_flags & EstimateFlag.COP_MASKED) != 0
    for name in COP:
        axis = name.removesuffix("_m")[-1]
        is_there = axis in measured or "index" in name
        expected = out if is_there else np.ones(len(e), dtype=bool)
        assert np.isnan(getattr(e, name)).tolist() == expected.tolist(), name
    return [bool(row) for row in out]


def test_no_centre_without_contact_however_good_it_would_be() -> None:
    e = estimate(newton_plan(array_at(SQUARE)), loaded_frames(held([30] * 4, 12)))
    assert masked(e) == [True] * 5 + [False] * 7


def test_no_centre_that_is_too_uncertain() -> None:
    # Tiles 200 mm apart with 0.5 N each: sigma is 100 mm * sqrt(2) * 0.5 N / GRF, 3 mm at 23.6 N.
    far = array_at([(-0.1, 0.0, -0.15), (0.1, 0.0, -0.15)])
    near_enough = estimate(newton_plan(far), loaded_frames(held([12, 12])))
    assert near_enough.cop_sigma_x_m[-1] == pytest.approx(0.1 * math.sqrt(0.5) / 24)
    assert not masked(near_enough, "x")[-1]
    assert masked(estimate(newton_plan(far), loaded_frames(held([11, 11]))), "x")[-1]
    across = array_at([(0.0, -0.1, -0.15), (0.0, 0.1, -0.15)])
    assert not masked(estimate(newton_plan(across), loaded_frames(held([12, 12]))), "y")[-1]
    assert masked(estimate(newton_plan(across), loaded_frames(held([11, 11]))), "y")[-1]


def test_no_centre_below_five_sigma_of_load() -> None:
    # Tiles a millimetre apart, so that the centre itself is certain; sigma of the sum 1.41 N.
    # Contact holds down to 3 sigma (4.24 N), a centre only to 5 sigma (7.07 N).
    close = array_at([(0.0, 0.0, -0.15), (0.001, 0.0, -0.15)])
    forces_n = np.concatenate([held([20, 20], 10), held([4, 4], 10), held([4, 3], 10)])
    e = estimate(newton_plan(close, sigma_n=1.0), loaded_frames(forces_n))
    assert (e.contact[10:] == 1).all()
    assert masked(e, "x")[10:] == [False] * 10 + [True] * 10


def test_no_centre_outside_the_tiles_except_by_noise() -> None:
    # 40 N here and -k there puts it 14 mm * k / (40 - k) beyond the last tile, with a sigma of
    # about 14 mm * 0.5 N / 40 N: three of them are let through, so -1 N is and -2 N is not.
    pair = array_at([(0.0, 0.0, -0.15), (0.014, 0.0, -0.15)])
    plan = newton_plan(pair, sigma_n=0.5)
    assert not masked(estimate(plan, loaded_frames(held([40, 0]))), "x")[-1]
    by_noise = estimate(plan, loaded_frames(held([40, -1])))
    assert not masked(by_noise, "x")[-1]
    assert by_noise.cop_x_m[-1] == pytest.approx(-0.014 / 39)
    assert masked(estimate(plan, loaded_frames(held([40, -2]))), "x")[-1]


# --- servo and ground frame -----------------------------------------------------------------------


def test_a_foot_without_servo_has_no_angle_and_no_ground_frame() -> None:
    e = estimate(
        newton_plan(array_at(SQUARE)), loaded_frames(held([9] * 4), servo_counts=[2048] * 12)
    )
    assert np.isnan(e.angle_rad).all()
    assert np.isnan(e.cop_ground_x_m).all()
    assert np.isnan(e.cop_ground_y_m).all()


@pytest.mark.parametrize("degrees", [-80, -45, 0, 8, 45, 80])
def test_a_rolling_foot_stands_where_its_ankle_is(degrees: int) -> None:
    # Tiles about a place on an arc of 150 mm touch at its own arc angle, right under an ankle
    # that has come 150 mm a radian. 4096 counts a turn: 8 degrees are 91 counts, to a half.
    counts = round(degrees / 360 * 4096)
    arc_rad = counts / 4096 * 2 * math.pi
    info = array_at(
        [
            (
                0.15 * math.sin(arc_rad) + along_m * math.cos(arc_rad),
                y_m,
                along_m * math.sin(arc_rad) - 0.15 * math.cos(arc_rad),
            )
            for y_m in (-0.01, 0.01)
            for along_m in (-0.005, 0.005)
        ],
        servo=make_servo(),
    )
    e = estimate(
        newton_plan(info),
        loaded_frames(held([15, 15, 5, 5]), servo_counts=np.full(12, 2048 + counts)),
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
        {"servo_counts": [2048] * 12, "frame_flags": [FrameFlag.SERVO_STALE] * 12},
        {"servo_counts": [2048] * 12, "frame_flags": [FrameFlag.SERVO_TURN_UNKNOWN] * 12},
    ],
)
def test_a_servo_whose_position_or_turn_is_not_known_gives_nan_and_the_foot_goes_on(
    columns: dict[str, list[int]],
) -> None:
    e = estimate(
        newton_plan(array_at(SQUARE, servo=make_servo())), loaded_frames(held([9] * 4), **columns)
    )
    assert np.isnan(e.angle_rad).all()
    assert np.isnan(e.cop_ground_x_m).all()
    assert e.cop_x_m[-1] == pytest.approx(0.01)
    assert e.estimate_flags[-1] == 0


def test_an_angle_goes_on_over_the_end_of_a_turn() -> None:
    counts = [4094, 4095, 4096, 4097, 8191, 8192, 1, 0, -1, -2, -4096, -4097]
    plan = newton_plan(array_at(SQUARE, servo=make_servo(ratio=0.1)))
    angle_rad = estimate(plan, loaded_frames(held([9] * 4), servo_counts=counts)).angle_rad
    expected = [0.1 * (c - 2048) / 4096 * 2 * math.pi for c in counts]
    assert angle_rad == pytest.approx(expected, abs=1e-15)


def test_the_sum_of_tiles_on_an_arc_is_less_certain_by_what_their_axes_leave_open() -> None:
    arc_rad = np.array([-0.2, -0.07, 0.07, 0.2])
    arc = [(0.15 * math.sin(a), 0.0, -0.15 * math.cos(a)) for a in arc_rad.tolist()]
    forces_n = [5.0, 20.0, 20.0, 5.0]
    flat, curved = (
        estimate(newton_plan(array_at(places)), loaded_frames(held(forces_n)))
        for places in ([(x, y, -0.15) for x, y, _ in arc], arc)
    )
    assert curved.grf_n.tolist() == flat.grf_n.tolist()
    more_n = math.sqrt(float(curved.grf_sigma_n[-1] ** 2 - flat.grf_sigma_n[-1] ** 2))
    lost_n = sum(f * (1.0 - math.cos(a)) for f, a in zip(forces_n, arc_rad.tolist(), strict=True))
    assert more_n == pytest.approx(lost_n, rel=0.1)
    # A tile's own force is along its own axis.
    assert curved.force_sigma_n.tolist() == flat.force_sigma_n.tolist()
