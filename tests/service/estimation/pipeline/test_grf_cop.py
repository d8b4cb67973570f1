"""GRF and centre of pressure worked out by hand, masks of the COP, and the ground frame."""

from __future__ import annotations

import math
from dataclasses import fields, replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from devices.chips.pressure_chips import Compensation
from devices.flags import EstimateFlag, FrameFlag
from devices.frames import NO_SERVO_COUNTS
from service.estimation.calibration import make_paper_shape_preset
from service.estimation.pipeline.plan import make_plan
from service.estimation.records import Estimates
from tests.builders.arrays import COUNT_KPA, array_at, make_servo
from tests.builders.calibrations import newton_tile
from tests.builders.estimates import estimate, newton_plan
from tests.builders.frames import cut_up, loaded_frames
from tests.service.estimation.feet import (
    COP,
    SQUARE,
    draw_wild_frames,
    estimate_load,
    repeat_load,
)

LINE = [(-0.021, 0.0, -0.15), (-0.007, 0.0, -0.15), (0.007, 0.0, -0.15), (0.021, 0.0, -0.15)]

# --- sums and centres -----------------------------------------------------------------------------


def test_the_sum_has_no_bias_in_flight() -> None:
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
    unloaded_kpa = Compensation(plan.info.tiles).law.compute_kpa([[500] * 4], [[480] * 4])[0]
    tare = replace(plan.tare, baseline_kpa=unloaded_kpa)
    plan = make_plan(plan.info, plan.calibration, tare, models=plan.models)
    e = estimate_load([0] * 4, plan)
    assert e.grf_n.tolist() == [0.0] * 12
    assert all(np.isnan(getattr(e, name)).all() for name in COP)


@pytest.mark.parametrize(
    ("positions", "forces_n", "cop_x_m", "cop_y_m", "index"),
    [
        # 10 and 20 N at y = 0, 30 and 40 N at y = 10 mm; 60 of 100 N at x = 20 mm
        (SQUARE, [10, 20, 30, 40], 0.012, 0.007, (1.6, 1.7)),
        # (-21 * 4 - 7 * 8 + 7 * 12 + 21 * 16) / 40 mm; index (1 * 4 + 2 * 8 + 3 * 12 + 4 * 16) / 40
        (LINE, [4, 8, 12, 16], 0.007, np.nan, (3.0, 1.0)),
        (SQUARE[:3], [10, 20, 30], 0.02 * 20 / 60, 0.01 * 30 / 60, (np.nan, np.nan)),
        (SQUARE, [0, 20, 30, 40], 0.02 * 60 / 90, 0.01 * 70 / 90, (1 + 60 / 90, 1 + 70 / 90)),
    ],
    ids=["grid", "line", "no grid", "a punctured tile"],
)
def test_sum_and_centre_are_as_worked_out_by_hand(
    positions: list[tuple[float, float, float]],
    forces_n: list[float],
    cop_x_m: float,
    cop_y_m: float,
    index: tuple[float, float],
) -> None:
    e = estimate_load(forces_n, newton_plan(array_at(positions)))
    assert e.grf_n[-1] == pytest.approx(sum(forces_n))
    found = [e.cop_x_m[-1], e.cop_y_m[-1], e.cop_index_x[-1], e.cop_index_y[-1]]
    assert found == pytest.approx([cop_x_m, cop_y_m, *index], abs=1e-10, nan_ok=True)
    assert np.isnan(e.cop_x_m[:5]).all(), "contact is not certain yet"


def test_the_papers_index_weighs_with_pressure_and_counts_from_one() -> None:
    # The right tile needs three times the force for the same pressure: 10 and 30 N at 10 counts.
    tiles = [newton_tile("T01"), newton_tile("T02", f_scale_n=3.0)]
    e = estimate_load([10, 10], newton_plan(array_at(SQUARE[:2]), tiles=tiles))
    assert [e.grf_n[-1], e.cop_x_m[-1], e.cop_index_x[-1]] == pytest.approx([40, 0.015, 1.5])


def test_a_reference_tile_is_in_no_sum_and_raises_no_flag() -> None:
    plan = newton_plan(array_at([*SQUARE, (0.9, 0.9, -0.15)], references=[4]))
    for ambient_counts in (80.0, 300.0, -90.0, np.nan):
        e = estimate_load([10, 20, 30, 40, ambient_counts], plan)
        assert e.estimate_flags[-1] == 0
        found = [e.grf_n[-1], e.grf_sigma_n[-1], e.cop_x_m[-1], e.cop_index_x[-1]]
        assert found == pytest.approx([100, 1.0, 0.012, 1.6])  # four times 0.5 N
        assert np.isnan([e.force_n[-1, 4], e.force_sigma_n[-1, 4]]).all()
        expected_kpa = ambient_counts * COUNT_KPA
        assert e.gauge_kpa[-1, 4] == pytest.approx(expected_kpa, nan_ok=True)


def test_sigmas_of_sum_and_centre_are_of_independent_tiles() -> None:
    # COP at 12 and 7 mm of 100 N; each newton moves it by (x - 12 mm) / 100 N, likewise y
    e = estimate_load([10, 20, 30, 40], newton_plan(array_at(SQUARE), sigma_n=0.5))
    assert e.force_sigma_n[-1] == pytest.approx([0.5] * 4)
    assert e.grf_sigma_n[-1] == pytest.approx(1.0)
    of_x_m = math.sqrt(2 * 0.012**2 + 2 * 0.008**2) * 0.5 / 100
    of_y_m = math.sqrt(2 * 0.007**2 + 2 * 0.003**2) * 0.5 / 100
    assert [e.cop_sigma_x_m[-1], e.cop_sigma_y_m[-1]] == pytest.approx([of_x_m, of_y_m])


# --- masks of the centre --------------------------------------------------------------------------


def find_masked(e: Estimates, measured: str) -> list[bool]:
    """Find frames without a centre; the flag and all columns along measured axes must agree."""
    masked = (e.estimate_flags & EstimateFlag.COP_MASKED) != 0
    for name in COP:
        is_measured = name.removesuffix("_m")[-1] in measured or "index" in name
        expected = masked if is_measured else np.ones(len(e), dtype=bool)
        assert np.isnan(getattr(e, name)).tolist() == expected.tolist(), name
    return [bool(row) for row in masked]


def test_a_load_without_contact_has_no_centre() -> None:
    assert find_masked(estimate_load([30] * 4), "xy") == [True] * 5 + [False] * 7


NEAR = [(0.0, 0.0, -0.15), (0.014, 0.0, -0.15)]
FAR = [(-0.1, 0.0, -0.15), (0.1, 0.0, -0.15)]
ACROSS = [(0.0, -0.1, -0.15), (0.0, 0.1, -0.15)]


@pytest.mark.parametrize(
    ("positions", "measured", "forces_n", "is_masked"),
    [
        # Tiles 200 mm apart with 0.5 N each: sigma is 100 mm * sqrt(2) * 0.5 N / GRF, 3 mm at
        # 23.6 N.
        (FAR, "x", [12, 12], False),
        (FAR, "x", [11, 11], True),
        (ACROSS, "y", [12, 12], False),
        (ACROSS, "y", [11, 11], True),
        # 40 N here and -k there is 14 mm * k / (40 - k) beyond the last tile, with a sigma of about
        # 14 mm * 0.5 N / 40 N, of which three may be chance.
        (NEAR, "x", [40, 0], False),
        (NEAR, "x", [40, -1], False),
        (NEAR, "x", [40, -2], True),
    ],
)
def test_an_uncertain_centre_or_one_outside_the_tiles_is_masked(
    positions: list[tuple[float, float, float]],
    measured: str,
    forces_n: list[float],
    is_masked: bool,
) -> None:
    e = estimate_load(forces_n, newton_plan(array_at(positions)))
    assert find_masked(e, measured)[-1] == is_masked


def test_a_centre_outside_the_tiles_by_chance_is_not_clamped() -> None:
    e = estimate_load([40, -1], newton_plan(array_at(NEAR)))
    assert e.cop_x_m[-1] == pytest.approx(-0.014 / 39)


def test_a_load_below_five_sigma_has_no_centre() -> None:
    # Tiles a millimetre apart, so that the centre itself is certain; sigma of the sum 1.41 N.
    # Contact lasts down to 3 sigma (4.24 N), a centre only to 5 sigma (7.07 N).
    close = array_at([(0.0, 0.0, -0.15), (0.001, 0.0, -0.15)])
    loads_n = [repeat_load(forces_n, 10) for forces_n in ([20, 20], [4, 4], [4, 3])]
    e = estimate(newton_plan(close, sigma_n=1.0), loaded_frames(np.concatenate(loads_n)))
    assert (e.contact[10:] == 1).all()
    assert find_masked(e, "x")[10:] == [False] * 10 + [True] * 10


# --- axes that a layout measures ------------------------------------------------------------------

ALONG = {
    "x": ("cop_x_m", "cop_sigma_x_m", "cop_ground_x_m"),
    "y": ("cop_y_m", "cop_sigma_y_m", "cop_ground_y_m"),
}


@pytest.mark.parametrize(
    ("positions", "measured"),
    [(SQUARE, "xy"), (SQUARE[2:], "x"), ([SQUARE[1], SQUARE[3]], "y"), (SQUARE[3:], "")],
    ids=["square", "row along x", "row along y", "one tile"],
)
@pytest.mark.parametrize("degrees", [0, 20])
def test_a_centre_is_a_number_along_measured_axes_only(
    positions: list[tuple[float, float, float]], measured: str, degrees: int
) -> None:
    # A bare tile elsewhere bears no load, and measures no axis.
    places = [*positions, (0.3, 0.3, -0.15)]
    info = array_at(places, references=[len(positions)], servo=make_servo())
    counts = 2048 + round(4096 * degrees / 360)
    e = estimate_load([30.0] * len(positions) + [0.0], newton_plan(info), servo_counts=counts)
    assert (e.contact[-1], e.estimate_flags[-1]) == (1, 0), "a frame in contact is not masked"
    for axis, names in ALONG.items():
        for name in names:
            values = getattr(e, name)
            assert np.isfinite(values[-1]) == (axis in measured), name
            assert axis in measured or np.isnan(values).all(), name
            assert axis not in measured or "sigma" not in name or values[-1] > 0.0


@pytest.mark.parametrize(("apart_m", "is_row"), [(1e-6, True), (2e-6, False)])
def test_tiles_a_micrometre_apart_are_in_one_row(apart_m: float, is_row: bool) -> None:
    pair = array_at([(0.0, 0.0, -0.15), (0.02, apart_m, -0.15)])
    assert newton_plan(pair).cop_measured == (True, not is_row)


PLACES_M = st.sampled_from([-0.012, 0.0, 0.009, 0.02])


@settings(max_examples=25, deadline=None)
@given(
    places=st.lists(st.tuples(PLACES_M, PLACES_M), min_size=1, max_size=5),
    seed=st.integers(0, 2**32 - 1),
    lag_ms=st.sampled_from([0.0, 20.0]),
)
def test_an_axis_that_is_not_measured_changes_no_other_bit(
    places: list[tuple[float, float]], seed: int, lag_ms: float
) -> None:
    info = array_at([(x_m, y_m, -0.15) for x_m, y_m in places], servo=make_servo())
    plan = newton_plan(info, lag_ms=lag_ms)
    frames = draw_wild_frames(120, len(places), seed)
    found = estimate(plan, *cut_up(frames, [7, 40]))
    with_both_axes = estimate(replace(plan, cop_measured=(True, True)), frames)
    is_row = dict(
        zip("xy", (len(set(axis)) == 1 for axis in zip(*places, strict=True)), strict=True)
    )
    unmeasured = {name for axis in "xy" if is_row[axis] for name in ALONG[axis]}
    for field in fields(Estimates):
        values = getattr(found, field.name)
        if field.name in unmeasured:
            assert np.isnan(values).all(), field.name
        else:
            assert values.tobytes() == getattr(with_both_axes, field.name).tobytes(), field.name
    masked = (found.estimate_flags & EstimateFlag.COP_MASKED) != 0
    for axis, is_unmeasured in is_row.items():
        assert is_unmeasured or (np.isnan(getattr(found, f"cop_{axis}_m")) == masked).all()


# --- servo and ground frame -----------------------------------------------------------------------


@pytest.mark.parametrize("degrees", [-80, -45, 0, 8, 45, 80])
def test_a_rolling_foot_stands_under_its_ankle(degrees: int) -> None:
    # Tiles about a place on an arc of 150 mm touch at its own arc angle, right under an ankle
    # that has come 150 mm a radian. 4096 counts a turn: 8 degrees are 91 counts, to a half.
    counts = round(degrees / 360 * 4096)
    arc_rad = counts / 4096 * 2 * math.pi
    sin, cos = math.sin(arc_rad), math.cos(arc_rad)
    places = [
        (0.15 * sin + along_m * cos, y_m, along_m * sin - 0.15 * cos)
        for y_m in (-0.01, 0.01)
        for along_m in (-0.005, 0.005)
    ]
    plan = newton_plan(array_at(places, servo=make_servo()))
    e = estimate_load([15, 15, 5, 5], plan, servo_counts=2048 + counts)
    found = [e.angle_rad[-1], e.cop_ground_x_m[-1], e.cop_ground_y_m[-1]]
    assert found == pytest.approx([arc_rad, 0.15 * arc_rad, -0.005], abs=1e-12)


def test_the_ground_frame_uses_the_height_of_the_centre() -> None:
    # Centre at x = 15 mm, z = -0.145 m; at 30 degrees with an ankle that stays where it is
    servo = make_servo(ratio=1 / 3, ankle_travel_m_per_rad=0.0)
    info = array_at([(0.0, 0.0, -0.16), (0.02, 0.0, -0.14)], servo=servo)
    e = estimate_load([10, 30], newton_plan(info), servo_counts=2048 + 1024)
    assert e.angle_rad[-1] == pytest.approx(math.pi / 6)
    expected_m = 0.015 * math.cos(math.pi / 6) - 0.145 * 0.5
    assert e.cop_ground_x_m[-1] == pytest.approx(expected_m, abs=1e-12)


UNKNOWN_TRAVEL = make_servo(ankle_travel_m_per_rad=None)


@pytest.mark.parametrize(
    ("servo", "columns", "angle_rad"),
    [
        (None, {"servo_counts": 2048}, np.nan),
        (UNKNOWN_TRAVEL, {"servo_counts": 2048}, 0.0),
        (make_servo(), {"servo_counts": NO_SERVO_COUNTS}, np.nan),
        (make_servo(), {"servo_counts": 2048, "frame_flags": FrameFlag.SERVO_STALE}, np.nan),
        (make_servo(), {"servo_counts": 2048, "frame_flags": FrameFlag.SERVO_TURN_UNKNOWN}, np.nan),
    ],
    ids=["no servo", "unknown travel", "no counts", "stale", "unknown turn"],
)
def test_a_foot_of_unknown_angle_or_travel_has_no_ground_frame(
    servo: Any, columns: dict[str, int], angle_rad: float
) -> None:
    e = estimate_load([9] * 4, newton_plan(array_at(SQUARE, servo=servo)), **columns)
    assert e.angle_rad == pytest.approx([angle_rad] * 12, nan_ok=True)
    assert np.isnan(e.cop_ground_x_m).all()
    assert np.isnan(e.cop_ground_y_m[-1]) == (servo in (None, UNKNOWN_TRAVEL))
    assert e.cop_x_m[-1] == pytest.approx(0.01)
    assert e.estimate_flags[-1] == 0
