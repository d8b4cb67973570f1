"""A pressure plate sees the patches under a foot, cell by cell."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from devices.emulation import plates
from devices.emulation.ground.ground import Ground
from devices.emulation.parts import make_rng
from devices.emulation.plates import PlateClock, PlateLoad, PressurePlate, compute_patch_radius_m

Array = npt.NDArray[np.float64]
CELL_N = 1e3 * plates.PITCH_M**2
"""A kilopascal on a cell."""


class Constant(Ground):
    """Domes that bear what they bear."""

    def __init__(self, *force_n: float) -> None:
        self._force_n = np.array(force_n)

    def forces_n(self, t_s: Array) -> Array:
        return np.tile(self._force_n, (len(t_s), 1))


def foot_of(*domes: tuple[float, float, float]) -> PlateLoad:
    """Domes of (x in mm, y in mm, newtons)."""
    places_m = np.array([(1e-3 * x, 1e-3 * y, -0.1) for x, y, _ in domes])
    return PlateLoad(Constant(*(force_n for *_, force_n in domes)), places_m)


def even(foot: PlateLoad) -> PressurePlate:
    """A plate whose cells are all alike, with the foot right on its marker."""
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


def test_the_foot_is_seen_where_it_was_put_and_as_it_was_turned() -> None:
    foot = foot_of((-20.0, 0.0, 5.0), (20.0, 0.0, 5.0))
    straight = even(foot)
    aslant = replace(straight, placed_m=np.array([0.010, 0.0]), turned_rad=np.pi / 6)
    alone = PlateLoad(Constant(0.0, 5.0), np.array([[-0.02, 0, -0.1], [0.02, 0, -0.1]]))
    (cop,) = cop_m(straight, seen(aslant, alone).mean(axis=0, keepdims=True))
    expected = [0.010 + 0.020 * np.cos(np.pi / 6), 0.020 * np.sin(np.pi / 6)]
    assert cop == pytest.approx(expected, abs=1.5e-3)


def test_too_little_is_nothing_and_too_much_is_the_end() -> None:
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
