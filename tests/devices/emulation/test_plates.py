"""Emulated force and pressure plates: the load of a foot, and the errors of their data sheets."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from devices.clock import VirtualClock
from devices.emulation import plates
from devices.emulation.ground.ground import Ground
from devices.emulation.parts import make_rng
from devices.emulation.plates import (
    ForcePlate,
    PlateClock,
    PlateLoad,
    PressurePlate,
    check_plate_usable,
    compute_patch_radius_m,
)
from devices.emulation.world import World
from devices.errors import UsageError
from devices.scene.scene_file import load_scene

Array = npt.NDArray[np.float64]
T_NS = np.linspace(0, 5_500_000_000, 400).astype(np.int64)
T_S = np.asarray(T_NS * 1e-9, dtype=np.float64)
STEP = plates.RANGE / 2 ** (plates.BITS - 1)
CELL_N = 1e3 * plates.PITCH_M**2
"""A kilopascal on a cell."""


class ConstantGround(Ground):
    """A ground under constant forces."""

    def __init__(self, *force_n: float) -> None:
        self._force_n = np.array(force_n)

    def forces_n(self, t_s: Array) -> Array:
        return np.tile(self._force_n, (len(t_s), 1))


# Load of a foot


@pytest.mark.parametrize("name", ["rolling", "poppy", "mud", "standing"])
def test_the_vertical_force_is_that_on_the_whole_foot(name: str) -> None:
    world = World(load_scene(name), VirtualClock())
    truth = world.compute_truth(T_NS)
    assert world.plate_load.compute_wrench(T_S)[:, 2] == pytest.approx(truth.true_plate_n, abs=1e-9)
    assert world.plate_load.compute_vertical_n(T_S).sum(axis=1) == pytest.approx(
        truth.true_grf_n, abs=1e-9
    )


def test_a_foot_that_rolls_comes_down_where_its_arc_is_long() -> None:
    world = World(load_scene("rolling"), VirtualClock())
    wrench = world.plate_load.compute_wrench(T_S)
    loaded = wrench[:, 2] > 1.0
    truth = world.compute_truth(T_NS)
    cop_m = -wrench[loaded, 4] / wrench[loaded, 2]
    # On the plate it is the arc's length, in the foot its projection: 0.07 mm less at the ends.
    assert cop_m == pytest.approx(truth.true_cop_x_m[loaded], abs=8e-5)
    assert wrench[:, 3] == pytest.approx(0.0)
    assert np.abs(wrench[:, 0]).max() > 0.1, "domes that are aslant push along the plate"


def test_moments_are_those_of_a_known_load_at_a_known_place() -> None:
    foot = PlateLoad(ConstantGround(0.0, 10.0), np.array([[0.01, 0.0, -0.1], [0.02, -0.03, -0.1]]))
    (wrench,) = foot.compute_wrench(np.zeros(1))
    assert wrench == pytest.approx([0.0, 0.0, 10.0, -0.3, -0.2, 0.0])


@pytest.mark.parametrize(
    ("instrument", "name"),
    [("pressure plate", "poppy"), ("pressure plate", "mud"), ("force plate", "indentation")],
)
def test_a_plate_that_would_see_nothing_of_the_foot_is_refused(instrument: str, name: str) -> None:
    with pytest.raises(UsageError, match="sees nothing of the foot"):
        check_plate_usable(instrument, load_scene(name))


# Force plate


def drawn(number: int = 0) -> ForcePlate:
    return ForcePlate.draw(make_rng(f"plate {number}"), make_rng(f"trial {number}"))


def ideal() -> ForcePlate:
    """Return a plate with no errors but noise, filter and converter."""
    return ForcePlate(PlateClock(1000.0, 0.0, 0.0), np.eye(6), np.zeros(6), np.zeros(6))


def constant(load: Array) -> Callable[[Array], Array]:
    return lambda t_s: np.tile(load, (len(t_s), 1))


def recorded(
    plate: ForcePlate, wrench: Callable[[Array], Array], end_s: float = 4.0
) -> tuple[Array, Array]:
    return plate.simulate_recording(wrench, end_s, make_rng("noise"))


@pytest.mark.parametrize("load", range(6))
def test_every_channel_shows_a_load_as_the_plate_mixes_it(load: int) -> None:
    plate = replace(drawn(), creep_per_s=np.zeros(6))
    wrench = np.zeros(6)
    wrench[load] = 0.4 * plates.RANGE[load]
    _, channels = recorded(plate, constant(wrench), 20.0)
    expected = plate.sensitivity @ wrench + plate.offset
    # Slow noise lasts 3 s: of 20 s its mean keeps about half of its deviation.
    assert channels.mean(axis=0) == pytest.approx(
        expected, abs=2 * plates.SLOW * plates.RANGE.max()
    )
    assert (np.abs(channels.mean(axis=0) - expected) < 2.0 * plates.SLOW * plates.RANGE).all()


def test_no_plate_mixes_more_than_its_data_sheet_allows() -> None:
    for number in range(50):
        mixing = drawn(number).sensitivity
        off = mixing - np.diag(np.diag(mixing))
        assert (np.abs(np.diag(mixing) - 1.0) <= plates.GAIN).all()
        assert (np.abs(off[:, 2][:2]) <= plates.CROSSTALK_OF_VERTICAL).all()
        assert (np.abs(off[:3, :2]) <= plates.CROSSTALK).all()
        assert (np.abs(off[3:, :3]) <= plates.LEVER_M).all()
        assert (off[:3, 3:] == 0.0).all(), "no force is made of a moment"


def test_noise_is_as_large_as_stated_and_partly_slow() -> None:
    _, channels = recorded(ideal(), constant(np.zeros(6)), 100.0)
    white = np.std(np.diff(channels, axis=0), axis=0) / np.sqrt(2.0)
    assert white == pytest.approx(np.hypot(plates.WHITE * plates.RANGE, STEP / 12**0.5), rel=0.02)
    of_seconds = channels.reshape(-1, 500, 6).mean(axis=1)
    # Six channels of some thirty times its memory each.
    slow = np.sqrt(((of_seconds / plates.RANGE) ** 2).mean())
    assert slow == pytest.approx(plates.SLOW, rel=0.3)


def test_every_reading_is_a_step_of_the_converter_and_none_is_beyond_its_end() -> None:
    _, channels = recorded(drawn(), constant(2.0 * plates.RANGE), 1.0)
    steps = channels / STEP
    assert steps == pytest.approx(np.rint(steps), abs=1e-6)
    assert (channels <= plates.RANGE).all()
    assert channels[-1, 2] == pytest.approx(plates.RANGE[2], abs=1.5 * STEP[2])


def test_a_ramp_is_shown_as_late_as_the_plate_says() -> None:
    plate = ideal()

    def ramp(t_s: Array) -> Array:
        return np.outer(100.0 * t_s, [0, 0, 1, 0, 0, 0])

    time_s, channels = recorded(plate, ramp, 2.0)
    behind_n = 100.0 * time_s - channels[:, 2]
    assert behind_n[200:1800].mean() == pytest.approx(100.0 * plate.delay_s, abs=0.03)


def test_a_step_rings_at_the_plates_own_frequency() -> None:
    plate = replace(ideal(), clock=PlateClock(8000.0, 0.0, 0.0))  # to see what 1 kHz cannot show

    def step(t_s: Array) -> Array:
        return np.outer(np.where(t_s >= 0.5, 100.0, 0.0), [0, 0, 1, 0, 0, 0])

    time_s, channels = recorded(plate, step, 1.0)
    ringing = channels[(time_s > 0.503) & (time_s < 0.52), 2] - 100.0
    crossings = np.flatnonzero(np.diff(np.sign(ringing)) > 0)
    hz = 8000.0 * (len(crossings) - 1) / (crossings[-1] - crossings[0])
    assert hz == pytest.approx(plates.NATURAL_HZ, rel=0.03)


def test_the_clock_of_a_plate_starts_late_and_goes_as_fast_as_it_drifts() -> None:
    clock = PlateClock(1000.0, start_s=0.25, drift_ppm=100.0)
    time_s, t_s = clock.compute_sample_times(100.25)
    assert len(time_s) == 100_010
    assert t_s[0] == 0.25
    assert (time_s[-1] - (t_s[-1] - t_s[0])) / (t_s[-1] - t_s[0]) == pytest.approx(1e-4, rel=1e-3)
    assert t_s[-1] <= 100.25


def test_a_recording_that_ends_before_its_start_is_empty() -> None:
    time_s, channels = recorded(drawn(), constant(np.ones(6)), 0.01)
    assert time_s.shape == (0,)
    assert channels.shape == (0, 6)


# Pressure plate


def foot_of(*domes: tuple[float, float, float]) -> PlateLoad:
    """Return a foot of domes of (x in mm, y in mm, newtons)."""
    places_m = np.array([(1e-3 * x, 1e-3 * y, -0.1) for x, y, _ in domes])
    return PlateLoad(ConstantGround(*(force_n for *_, force_n in domes)), places_m)


def even(foot: PlateLoad) -> PressurePlate:
    """Return a plate of equal cells, with the foot on its marker."""
    plate = PressurePlate.draw(foot.dome_places_m, make_rng("plate"), make_rng("trial"))
    return replace(
        plate,
        clock=PlateClock(100.0, 0.0, 0.0),
        gains=np.ones_like(plate.gains),
        placed_m=np.zeros(2),
        turned_rad=0.0,
    )


def seen(plate: PressurePlate, foot: PlateLoad, seconds: float = 1.0) -> Array:
    return plate.simulate_recording(foot, seconds, make_rng("noise"))[1]


def cop_m(plate: PressurePlate, force_n: Array) -> Array:
    x_m, y_m = (
        o + plates.PITCH_M * np.arange(n)
        for o, n in zip(plate.origin_m, force_n.shape[1:], strict=True)
    )
    total_n = force_n.sum(axis=(1, 2))
    return np.stack(
        [force_n.sum(axis=2) @ x_m / total_n, force_n.sum(axis=1) @ y_m / total_n], axis=1
    )


@settings(max_examples=25, deadline=None)
@given(x_mm=st.floats(-21.0, 21.0), y_mm=st.floats(-10.0, 10.0), force_n=st.floats(3.0, 15.0))
def test_the_sum_of_cells_is_the_load_and_their_middle_its_place(
    x_mm: float, y_mm: float, force_n: float
) -> None:
    foot = foot_of((x_mm, y_mm, force_n))
    plate = even(foot)
    force = seen(plate, foot).mean(axis=0, keepdims=True)
    # Cells at the patch's edge stay below their threshold of a quarter of a newton.
    assert force.sum() == pytest.approx(force_n, abs=6 * plates.THRESHOLD_KPA * CELL_N)
    # A patch of 2 mm between cells of 5 mm has its middle known to a part of a cell.
    off_m = cop_m(plate, force)[0] - np.array([1e-3 * x_mm, 1e-3 * y_mm])
    assert np.hypot(*off_m) < 0.5 * plates.PITCH_M


def test_domes_that_share_a_load_have_its_middle_between_them() -> None:
    foot = foot_of((-7.0, 0.0, 2.0), (7.0, 0.0, 6.0))
    plate = even(foot)
    (cop,) = cop_m(plate, seen(plate, foot).mean(axis=0, keepdims=True))
    assert cop == pytest.approx([0.0035, 0.0], abs=1e-3)


def test_a_patch_grows_with_the_cube_root_of_the_force_until_the_dome_is_flat() -> None:
    (small_m, large_m, flat_m) = compute_patch_radius_m(np.array([1.0, 8.0, 1e4]))
    assert large_m == pytest.approx(2.0 * small_m)
    # Johnson, Contact Mechanics, 4.22: a^3 = 3 P R / (4 E*)
    assert small_m == pytest.approx((0.75 * 5.5e-3 / 2.893e6) ** (1 / 3), rel=1e-3)
    assert flat_m == 5.5e-3


def test_a_foot_is_seen_in_its_place_and_orientation() -> None:
    foot = foot_of((-20.0, 0.0, 5.0), (20.0, 0.0, 5.0))
    straight = even(foot)
    aslant = replace(straight, placed_m=np.array([0.010, 0.0]), turned_rad=np.pi / 6)
    alone = PlateLoad(ConstantGround(0.0, 5.0), np.array([[-0.02, 0, -0.1], [0.02, 0, -0.1]]))
    (cop,) = cop_m(straight, seen(aslant, alone).mean(axis=0, keepdims=True))
    expected = [0.010 + 0.020 * np.cos(np.pi / 6), 0.020 * np.sin(np.pi / 6)]
    assert cop == pytest.approx(expected, abs=1.5e-3)


def test_pressure_below_the_threshold_is_zero_and_above_the_range_its_end() -> None:
    foot = foot_of((2.5, 2.5, 0.15))  # on one cell: 6 kPa
    assert (seen(even(foot), foot) == 0.0).mean() > 0.999
    foot = foot_of((2.5, 2.5, 500.0))
    force = seen(even(foot), foot)
    assert force.max() == pytest.approx(plates.END_KPA * CELL_N, abs=plates.STEP_KPA * CELL_N)


def test_readings_are_steps_and_cells_differ_as_stated() -> None:
    foot = foot_of((-100.0, -100.0, 5.0), (100.0, 100.0, 5.0))
    plate = PressurePlate.draw(foot.dome_places_m, make_rng("plate"), make_rng("trial"))
    assert plate.gains.size > 2000
    assert plate.gains.std() / plate.gains.mean() == pytest.approx(plates.CELL_GAIN, rel=0.1)
    steps = seen(plate, foot) / (plates.STEP_KPA * CELL_N)
    assert steps == pytest.approx(np.rint(steps), abs=1e-6)
