"""What comes down on a plate is what the foot bears, where it bears it."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest

from devices.clock import VirtualClock
from devices.emulation.ground.ground import Ground
from devices.emulation.plates import PlateLoad, check_plate_usable
from devices.emulation.world import World
from devices.errors import UsageError
from devices.scene.scene_file import load_scene

T_NS = np.linspace(0, 5_500_000_000, 400).astype(np.int64)
T_S = np.asarray(T_NS * 1e-9, dtype=np.float64)


def world_of(name: str) -> World:
    return World(load_scene(name), VirtualClock())


@pytest.mark.parametrize("name", ["rolling", "poppy", "mud", "standing"])
def test_the_vertical_force_is_that_on_the_whole_foot(name: str) -> None:
    world = world_of(name)
    truth = world.compute_truth(T_NS)
    assert world.plate_load.compute_wrench(T_S)[:, 2] == pytest.approx(truth.true_plate_n, abs=1e-9)
    assert world.plate_load.compute_vertical_n(T_S).sum(axis=1) == pytest.approx(
        truth.true_grf_n, abs=1e-9
    )


def test_a_foot_that_rolls_comes_down_where_its_arc_is_long() -> None:
    world = world_of("rolling")
    wrench = world.plate_load.compute_wrench(T_S)
    loaded = wrench[:, 2] > 1.0
    truth = world.compute_truth(T_NS)
    cop_m = -wrench[loaded, 4] / wrench[loaded, 2]
    # On the plate it is the arc's length, in the foot its projection: 0.07 mm less at the ends.
    assert cop_m == pytest.approx(truth.true_cop_x_m[loaded], abs=8e-5)
    assert wrench[:, 3] == pytest.approx(0.0)
    assert np.abs(wrench[:, 0]).max() > 0.1, "domes that are aslant push along the plate"


class OneDome(Ground):
    """The second of two domes bears ten newtons."""

    def forces_n(self, t_s: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        return np.tile([0.0, 10.0], (len(t_s), 1))


def test_moments_are_those_of_a_known_load_at_a_known_place() -> None:
    foot = PlateLoad(OneDome(), np.array([[0.01, 0.0, -0.1], [0.02, -0.03, -0.1]]))
    (wrench,) = foot.compute_wrench(np.zeros(1))
    assert wrench == pytest.approx([0.0, 0.0, 10.0, -0.3, -0.2, 0.0])


@pytest.mark.parametrize(
    ("instrument", "name"),
    [("pressure plate", "poppy"), ("pressure plate", "mud"), ("force plate", "indentation")],
)
def test_a_plate_that_would_see_nothing_of_the_foot_is_refused(instrument: str, name: str) -> None:
    with pytest.raises(UsageError, match="sees nothing of the foot"):
        check_plate_usable(instrument, load_scene(name))
