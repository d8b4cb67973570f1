"""Grounds of a foot: their forces are the truth of a scene."""

from __future__ import annotations

import math
from itertools import groupby

import numpy as np
import numpy.typing as npt
import pytest

from devices.emulation.ground.ground import Ground
from devices.emulation.ground.grounds import Rolling, TraceLoad, get_tile_positions_m, make_ground
from devices.emulation.ground.indenter import IndentationProgramme
from devices.emulation.ground.load_trace import TileLoad
from devices.errors import SceneError, UsageError
from devices.scene.scene_file import Scene, load_scene
from tests.builders.scenes import make_scene

Floats = npt.NDArray[np.float64]
FOUR = ((0x70, 0), (0x70, 1), (0x70, 2), (0x70, 3))


def ground_of(scene: Scene, *, seed: int = 0, lead_s: float = 1.0) -> Ground:
    return make_ground(scene, seed=seed, lead_s=lead_s, tile_load=None)


def cop_m(forces_n: Floats, scene: Scene) -> Floats:
    return np.asarray(
        forces_n @ get_tile_positions_m(scene.tile) / forces_n.sum(axis=1, keepdims=True)
    )


def at(*t_s: float) -> Floats:
    return np.array(t_s, dtype=np.float64)


def with_reference(scene: Scene, tile: int) -> Scene:
    tiles = list(scene.tile)
    tiles[tile] = tiles[tile].model_copy(update={"reference": True})
    return scene.model_copy(update={"tile": tuple(tiles)})


@pytest.mark.parametrize("kind", ["none", "plate", "rolling", "indentation"])
@pytest.mark.parametrize("lead_s", [0.5, 2.0])
def test_a_ground_bears_nothing_in_the_lead_and_no_negative_force_after_it(
    kind: str, lead_s: float
) -> None:
    made = ground_of(make_scene(ground={"kind": kind}), lead_s=lead_s)
    lead = made.forces_n(np.linspace(0, lead_s, 100, endpoint=False))
    np.testing.assert_array_equal(lead, np.zeros((100, 4)))
    forces_n = made.forces_n(np.linspace(lead_s, lead_s + 40, 4_001))
    assert forces_n.shape == (4_001, 4)
    assert (forces_n >= 0).all()
    assert np.isfinite(forces_n).all()
    assert (forces_n.max() > 0) == (kind != "none")
    if kind in ("none", "plate"):
        assert made.duration_s is None
        assert made.angle_rad(at(0.0, 1.0)) is None


def test_a_recorded_load_must_be_given() -> None:
    with pytest.raises(UsageError, match="--load"):
        ground_of(make_scene(ground={"kind": "trace"}))


@pytest.mark.parametrize("kind", ["plate", "rolling", "indentation"])
def test_a_reference_tile_bears_nothing(kind: str) -> None:
    scene = make_scene(FOUR[:3], ground={"kind": kind, "load_n": 30.0})
    made = ground_of(with_reference(scene, 1), lead_s=0.0)
    forces_n = made.forces_n(np.linspace(1, 60, 5_000))
    assert (forces_n[:, 1] == 0).all()
    assert (forces_n[:, [0, 2]].max(axis=0) > 10).all()
    if kind == "plate":
        np.testing.assert_allclose(forces_n.sum(axis=1), 30.0)


# Standing


def test_a_standing_foot_has_its_weight_spread_by_least_squares() -> None:
    scene = make_scene(ground={"kind": "plate", "load_n": 40.0})
    forces_n = ground_of(scene).forces_n(np.linspace(1.5, 60.0, 2_000))
    np.testing.assert_allclose(forces_n.sum(axis=1), 40.0, atol=1e-9)
    x_m = get_tile_positions_m(scene.tile)[:, 0]
    rows = np.vstack([np.ones(4), x_m])
    expected = (np.linalg.pinv(rows) @ np.vstack([forces_n.sum(1), forces_n @ x_m])).T
    np.testing.assert_allclose(forces_n, expected, atol=1e-9)
    one = ground_of(make_scene(FOUR[:1], ground={"kind": "plate", "load_n": 12.0}))
    np.testing.assert_allclose(one.forces_n(at(3.0, 4.0)), [[12.0], [12.0]])


def test_a_standing_foot_sways_along_the_array_as_far_as_the_scene_allows() -> None:
    scene = make_scene(ground={"kind": "plate", "sway_m": 0.004})
    cop = cop_m(ground_of(scene).forces_n(np.linspace(2.0, 200.0, 20_000)), scene)
    assert np.abs(cop[:, 0]).max() <= 0.004 + 1e-9
    assert np.abs(cop[:, 0]).max() > 0.0035
    assert abs(cop[:, 0].mean()) < 0.0005
    np.testing.assert_allclose(cop[:, 1], 0.0, atol=1e-12)
    still = ground_of(make_scene(ground={"kind": "plate", "load_n": 20.0, "sway_m": 0.0}))
    np.testing.assert_allclose(still.forces_n(at(2.0, 9.0)), 5.0)


def test_a_foot_is_put_down_within_0_3_s() -> None:
    made = ground_of(make_scene(ground={"kind": "plate", "load_n": 20.0}), lead_s=1.0)
    total = made.forces_n(at(1.0, 1.15, 1.3, 1.4)).sum(axis=1)
    np.testing.assert_allclose(total, [0, 10, 20, 20], atol=1e-9)


def test_another_seed_sways_differently() -> None:
    scene = make_scene(ground={"kind": "plate"})
    t_s = np.linspace(2, 10, 50)
    first = ground_of(scene, seed=1).forces_n(t_s)
    np.testing.assert_array_equal(first, ground_of(scene, seed=1).forces_n(t_s))
    assert np.abs(first - ground_of(scene, seed=2).forces_n(t_s)).max() > 0.1


def test_a_sway_that_would_lift_a_tile_is_refused() -> None:
    # Even share 1/4; at the outer tile x / sum x^2 is 21 / (2 (21^2 + 7^2)) per mm.
    limit_m = 0.25 / (21 / 980) / 1000
    made = ground_of(make_scene(ground={"kind": "plate", "sway_m": limit_m * 0.999}))
    assert made.forces_n(np.linspace(2, 100, 5_000)).min() >= 0
    with pytest.raises(SceneError, match=r"ground\.sway_m") as caught:
        ground_of(make_scene(ground={"kind": "plate", "sway_m": limit_m * 1.001}))
    assert f"{limit_m:.4f}" in caught.value.expected
    assert caught.value.exit_code == 2


# Rolling


@pytest.fixture(scope="module")
def rolling() -> Rolling:
    made = ground_of(load_scene("rolling"), lead_s=0.0)
    assert isinstance(made, Rolling)
    return made


ARC_RAD = [math.asin(x / 0.150) for x in (-0.0209315, -0.00699746, 0.00699746, 0.0209315)]


def test_a_rolling_foot_bears_its_weight_on_a_patch_that_moves_with_the_angle(
    rolling: Rolling,
) -> None:
    # The first roll, from after the lowering to before the lifting: half a patch beyond the tiles.
    arc_m = 2 * (ARC_RAD[3] * 0.150 + 0.006)
    t_s = np.linspace(0.2, 0.2 + arc_m / 0.02, 500)
    forces_n, angle = rolling.forces_n(t_s), rolling.angle_rad(t_s)
    vertical_n = forces_n * np.cos(np.array(ARC_RAD) - angle[:, None])
    np.testing.assert_allclose(vertical_n.sum(axis=1), 8.92, atol=1e-3)  # of the paper's leg
    assert (np.diff(angle) > 0).all(), "rolling forward is a positive angle"
    cop_x = cop_m(forces_n, load_scene("rolling"))[:, 0]
    assert cop_x[0] < -0.015
    assert cop_x[-1] > 0.015
    assert np.corrcoef(cop_x, angle)[0, 1] > 0.99
    # The place of contact on the arc is R sin(angle); tiles of 14 mm pitch follow it in steps.
    assert np.abs(cop_x - 0.150 * np.sin(angle)).max() < 0.007
    for tile in range(4):
        is_over = np.abs(angle - ARC_RAD[tile]) < 0.012 / 0.150
        assert ((forces_n[:, tile] > 0) == is_over).all()


def test_a_foot_rolls_at_the_speed_of_the_scene(rolling: Rolling) -> None:
    angle = rolling.angle_rad(at(0.5, 1.5))
    assert (angle[1] - angle[0]) * 0.150 == pytest.approx(0.02, rel=1e-6)


def test_a_foot_is_lifted_carried_back_and_rolls_again(rolling: Rolling) -> None:
    t_s = np.arange(0, 15, 0.001)
    loaded = rolling.forces_n(t_s).sum(axis=1) > 0
    touchdowns = t_s[1:][loaded[1:] & ~loaded[:-1]]
    periods = np.diff(touchdowns)
    assert len(touchdowns) >= 3
    np.testing.assert_allclose(periods, periods[0], atol=0.002)
    angle = rolling.angle_rad(t_s)
    assert (angle[~loaded].min(), angle[~loaded].max()) == pytest.approx(
        (angle.min(), angle.max()), abs=0.002
    )
    again = rolling.angle_rad(t_s[:2000] + periods[0])
    np.testing.assert_allclose(angle[:2000], again, atol=0.01)
    assert (np.diff(angle)[loaded[1:] & loaded[:-1]] >= -1e-12).all(), "never back under load"


def test_the_load_of_a_rolling_foot_has_no_jump(rolling: Rolling) -> None:
    forces_n = rolling.forces_n(np.arange(0, 10, 0.001))
    assert np.abs(np.diff(forces_n, axis=0)).max() < 0.2


# A recorded load


def test_a_recorded_load_is_linear_between_samples_and_zero_outside() -> None:
    forces_n = np.array([[0.0] * 4, [1.0, 2.0, 3.0, 4.0], [3.0, 2.0, 1.0, 0.0], [0.0] * 4])
    angle_rad = np.array([0.1, 0.1, 0.3, 0.3])
    trace = TileLoad(np.array([1.0, 1.01, 2.01, 2.02]), forces_n, angle_rad, 0, 0)
    scene = make_scene(ground={"kind": "plate"})
    made = make_ground(scene, seed=0, lead_s=1.0, tile_load=trace)
    assert isinstance(made, TraceLoad), "it replaces the ground of the scene"
    assert made.duration_s == 2.02
    np.testing.assert_allclose(
        made.forces_n(at(0.0, 0.999, 1.005, 1.01, 1.51, 2.02, 5.0)),
        [[0.0] * 4, [0.0] * 4, [0.5, 1, 1.5, 2], [1.0, 2, 3, 4], [2.0] * 4, [0.0] * 4, [0.0] * 4],
        atol=1e-9,
    )
    angle = made.angle_rad(at(0.0, 1.51, 9.0))
    assert angle is not None
    np.testing.assert_allclose(angle, [0.1, 0.2, 0.3])


def test_a_recorded_load_without_an_angle_has_none() -> None:
    made = TraceLoad(TileLoad(at(1.0, 2.0), np.array([[5.0], [6.0]]), None, 0, 0))
    np.testing.assert_allclose(made.forces_n(at(0.9, 1.0, 2.0, 2.1)), [[0.0], [5.0], [6.0], [0.0]])
    assert made.angle_rad(at(1.5)) is None


def test_a_repeated_load_begins_again_after_a_second_without_load() -> None:
    trace = TileLoad(at(1.0, 2.0, 3.0), np.array([[5.0], [6.0], [7.0]]), at(0.1, 0.2, 0.3), 0, 0)
    made = TraceLoad(trace, 1.0, is_repeated=True)
    assert made.duration_s is None
    t_s = at(0.5, 1.0, 1.5, 2.0, 2.999, 3.2, 3.9)
    once = made.forces_n(t_s)
    np.testing.assert_allclose(once[:, 0], [0.0, 5.0, 5.5, 6.0, 6.999, 0.0, 0.0])
    for round_s in (3.0, 300.0):  # two seconds of load, one in the air
        again = t_s[1:] + round_s
        np.testing.assert_allclose(made.forces_n(again), once[1:], atol=1e-9)
        angle, before = made.angle_rad(again), made.angle_rad(t_s[1:])
        assert angle is not None
        assert before is not None
        np.testing.assert_allclose(angle, before)


# Indenter


def indenter_of(scene: Scene, lead_s: float = 1.0) -> IndentationProgramme:
    made = ground_of(scene, lead_s=lead_s)
    assert isinstance(made, IndentationProgramme)
    return made


def sample_programme(
    indenter: IndentationProgramme,
) -> tuple[Floats, Floats, npt.NDArray[np.str_], npt.NDArray[np.intp]]:
    """Return times, forces, phases and pressed tiles at each millisecond."""
    t_s = (np.arange(round(indenter.duration_s * 1000)) + 0.5) / 1000
    phases = np.array([indenter.PHASES[i] for i in indenter.find_phase_index(t_s).tolist()])
    return t_s, indenter.forces_n(t_s), phases, indenter.find_indented_tile(t_s)


def group_phases(phases: npt.NDArray[np.str_]) -> list[tuple[str, int]]:
    """Return phases in their order with their lengths."""
    return [(phase, len(list(group))) for phase, group in groupby(phases.tolist())]


def test_an_indenter_presses_each_tile_in_turn_and_alone_with_its_programme() -> None:
    indenter = indenter_of(make_scene(FOUR[:2], ground={"kind": "indentation"}))
    t_s, forces_n, phases, tile = sample_programme(indenter)
    assert indenter.serials == ("T01", "T02")
    assert (np.count_nonzero(forces_n, axis=1) <= 1).all()
    for i in range(2):
        assert (forces_n[tile != i, i] == 0).all()
        assert forces_n[:, i].max() == pytest.approx(30.0, abs=0.01)
    order = [int(i) for i in tile if i >= 0]
    assert order == sorted(order)
    first = group_phases(phases[tile == 0])
    assert [phase for phase, _ in first] == (
        ["rest", "load", "unload"] * 4
        + ["rest", "load", "hold", "release"] * 5
        + ["rest", "tap"] * 15
        + ["rest"]
    )
    lengths = {phase: {n for p, n in first if p == phase} for phase, _ in first}
    assert lengths["release"] == {5}
    assert lengths["tap"] == {20}
    assert max(lengths["load"]) == 4_000
    assert lengths["unload"] == {4_000}
    constant_n = forces_n[(phases == "hold") & (tile == 0), 0]
    np.testing.assert_allclose(constant_n, constant_n[0])
    assert constant_n[0] > 10.0
    unload_n = forces_n[(phases == "unload") & (tile == 0), 0][:4_000]
    np.testing.assert_allclose(np.diff(unload_n), -30.0 / 4_000, atol=1e-9)
    for i in range(0, len(t_s), 37):
        spindle_n = indenter.compute_spindle_force_n(float(t_s[i]))
        expected_n = None if tile[i] < 0 else pytest.approx(forces_n[i, tile[i]], abs=1e-9)
        assert spindle_n == expected_n
    assert indenter.compute_spindle_force_n(indenter.duration_s + 1) is None
    assert (indenter.forces_n(at(indenter.duration_s + 1)) == 0).all()
    # At the end a soak without load at two temperatures.
    soak = phases == "soak"
    assert soak[-1]
    assert (np.diff(np.flatnonzero(soak)) == 1).all()
    assert (forces_n[soak] == 0).all()
    assert (tile[soak] == -1).all()
    assert t_s[soak][0] + 5 < indenter.temperature_step_s < indenter.duration_s - 5
    assert indenter.soak_k == 4.0


def test_an_indenter_has_load_repeats_and_soak_of_the_scene() -> None:
    keys = {"kind": "indentation", "load_n": 12.0, "stroke_s": 0.5, "repeats": 2, "soak_k": -3.0}
    indenter = indenter_of(make_scene(FOUR[:1], ground=keys), lead_s=0.0)
    _, forces_n, phases, _ = sample_programme(indenter)
    assert forces_n.max() == pytest.approx(12.0, abs=0.03)
    assert [p for p, _ in group_phases(phases)].count("unload") == 2
    assert indenter.soak_k == -3.0


def test_an_indenter_skips_a_reference_tile() -> None:
    scene = with_reference(make_scene(FOUR[:3], ground={"kind": "indentation"}), 1)
    _, _, _, tile = sample_programme(indenter_of(scene))
    assert set(tile.tolist()) == {-1, 0, 2}
