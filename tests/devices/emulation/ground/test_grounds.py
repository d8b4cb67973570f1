"""What the foot stands on: forces that are the truth of a scene have to be right by themselves."""

from __future__ import annotations

import math
from typing import Any

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


@pytest.mark.parametrize(
    "ground",
    [
        {"kind": "none"},
        {"kind": "plate"},
        {"kind": "rolling"},
        {"kind": "indentation"},
    ],
    ids=lambda ground: ground["kind"],
)
@pytest.mark.parametrize("lead_s", [0.5, 2.0])
def test_before_it_begins_nothing_is_loaded_and_afterwards_no_force_is_negative(
    ground: dict[str, Any], lead_s: float
) -> None:
    made = ground_of(make_scene(ground=ground), lead_s=lead_s)
    lead = made.forces_n(np.linspace(0, lead_s, 100, endpoint=False))
    np.testing.assert_array_equal(lead, np.zeros((100, 4)))
    forces_n = made.forces_n(np.linspace(lead_s, lead_s + 40, 4_001))
    assert forces_n.shape == (4_001, 4)
    assert (forces_n >= 0).all()
    assert np.isfinite(forces_n).all()
    assert (forces_n.max() > 0) == (ground["kind"] != "none")


def test_a_foot_in_the_air_has_neither_load_nor_angle_nor_end() -> None:
    made = ground_of(make_scene())
    assert made.duration_s is None
    assert made.angle_rad(at(0.0, 1.0)) is None


def test_a_recorded_load_has_to_be_given() -> None:
    with pytest.raises(UsageError, match="--load"):
        ground_of(make_scene(ground={"kind": "trace"}))


# Standing


def test_who_stands_weighs_the_same_all_the_time() -> None:
    made = ground_of(make_scene(ground={"kind": "plate", "load_n": 40.0}))
    t_s = np.linspace(1.5, 60.0, 2_000)
    np.testing.assert_allclose(made.forces_n(t_s).sum(axis=1), 40.0, atol=1e-9)
    assert made.duration_s is None
    assert made.angle_rad(t_s) is None


def test_who_stands_sways_along_the_array_and_no_farther_than_said() -> None:
    scene = make_scene(ground={"kind": "plate", "sway_m": 0.004})
    cop = cop_m(ground_of(scene).forces_n(np.linspace(2.0, 200.0, 20_000)), scene)
    assert np.abs(cop[:, 0]).max() <= 0.004 + 1e-9
    assert np.abs(cop[:, 0]).max() > 0.0035
    assert abs(cop[:, 0].mean()) < 0.0005
    np.testing.assert_allclose(cop[:, 1], 0.0, atol=1e-12)


def test_who_stands_spreads_the_load_with_the_least_squares() -> None:
    scene = make_scene(ground={"kind": "plate"})
    forces_n = ground_of(scene).forces_n(np.linspace(2.0, 30.0, 50))
    x_m = get_tile_positions_m(scene.tile)[:, 0]
    rows = np.vstack([np.ones(4), x_m])
    expected = (np.linalg.pinv(rows) @ np.vstack([forces_n.sum(1), forces_n @ x_m])).T
    np.testing.assert_allclose(forces_n, expected, atol=1e-9)


def test_who_does_not_sway_loads_every_tile_alike() -> None:
    made = ground_of(make_scene(ground={"kind": "plate", "load_n": 20.0, "sway_m": 0.0}))
    np.testing.assert_allclose(made.forces_n(at(2.0, 9.0)), 5.0)


def test_the_foot_is_put_down_within_0_3_s() -> None:
    made = ground_of(make_scene(ground={"kind": "plate", "load_n": 20.0}), lead_s=1.0)
    total = made.forces_n(at(1.0, 1.15, 1.3, 1.4)).sum(axis=1)
    np.testing.assert_allclose(total, [0, 10, 20, 20], atol=1e-9)


def test_a_seed_sways_differently() -> None:
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


def test_a_reference_tile_under_a_standing_foot_bears_nothing() -> None:
    scene = with_reference(make_scene(ground={"kind": "plate", "load_n": 30.0}), 3)
    forces_n = ground_of(scene).forces_n(np.linspace(2, 20, 50))
    np.testing.assert_array_equal(forces_n[:, 3], 0)
    np.testing.assert_allclose(forces_n.sum(axis=1), 30.0)


def test_a_single_tile_can_be_stood_on() -> None:
    scene = make_scene(FOUR[:1], ground={"kind": "plate", "load_n": 12.0})
    np.testing.assert_allclose(ground_of(scene).forces_n(at(3.0, 4.0)), [[12.0], [12.0]])


# Rolling


@pytest.fixture(scope="module")
def rolling() -> Rolling:
    made = ground_of(load_scene("rolling"), lead_s=0.0)
    assert isinstance(made, Rolling)
    return made


def stance(made: Rolling) -> Floats:
    """Times of the first roll, from after the lowering to before the lifting."""
    arc_m = 2 * (math.asin(0.0209315 / 0.150) * 0.150 + 0.006)  # outer tiles, half a patch beyond
    return np.linspace(0.2, 0.2 + arc_m / 0.02, 500)


def test_in_stance_the_vertical_sum_is_the_weight_of_the_papers_leg(rolling: Rolling) -> None:
    t_s = stance(rolling)
    angle = rolling.angle_rad(t_s)
    arc = [math.asin(x / 0.150) for x in (-0.0209315, -0.00699746, 0.00699746, 0.0209315)]
    vertical = rolling.forces_n(t_s) * np.cos(np.array(arc) - angle[:, None])
    np.testing.assert_allclose(vertical.sum(axis=1), 8.92, atol=1e-3)


def test_the_contact_moves_forward_with_the_angle(rolling: Rolling) -> None:
    t_s = stance(rolling)
    angle = rolling.angle_rad(t_s)
    assert (np.diff(angle) > 0).all(), "rolling forward is a positive angle"
    cop_x = cop_m(rolling.forces_n(t_s), load_scene("rolling"))[:, 0]
    assert cop_x[0] < -0.015
    assert cop_x[-1] > 0.015
    assert np.corrcoef(cop_x, angle)[0, 1] > 0.99
    # The place of contact on the arc is R sin(angle); tiles of 14 mm pitch follow it in steps.
    assert np.abs(cop_x - 0.150 * np.sin(angle)).max() < 0.007


def test_the_foot_rolls_at_the_speed_of_the_scene(rolling: Rolling) -> None:
    angle = rolling.angle_rad(at(0.5, 1.5))
    assert (angle[1] - angle[0]) * 0.150 == pytest.approx(0.02, rel=1e-6)


def test_a_tile_is_pressed_only_while_the_patch_is_over_it(rolling: Rolling) -> None:
    t_s = stance(rolling)
    forces_n = rolling.forces_n(t_s)
    angle = rolling.angle_rad(t_s)
    arc = [math.asin(x / 0.150) for x in (-0.0209315, -0.00699746, 0.00699746, 0.0209315)]
    for tile in range(4):
        over = np.abs(angle - arc[tile]) < 0.012 / 0.150
        assert (forces_n[~over, tile] == 0).all()
        assert (forces_n[over, tile] > 0).all()


def test_the_foot_is_lifted_carried_back_and_rolls_again(rolling: Rolling) -> None:
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


def test_a_load_comes_and_goes_without_a_jump(rolling: Rolling) -> None:
    forces_n = rolling.forces_n(np.arange(0, 10, 0.001))
    assert np.abs(np.diff(forces_n, axis=0)).max() < 0.2


def test_a_reference_tile_on_a_rolling_foot_bears_nothing() -> None:
    made = ground_of(with_reference(load_scene("rolling"), 0), lead_s=0.0)
    assert (made.forces_n(np.linspace(0, 8, 500))[:, 0] == 0).all()


# A recorded load


def test_a_recorded_load_is_linear_between_samples_and_zero_outside() -> None:
    forces_n = np.array([[0.0] * 4, [1.0, 2.0, 3.0, 4.0], [3.0, 2.0, 1.0, 0.0], [0.0] * 4])
    angle_rad = np.array([0.1, 0.1, 0.3, 0.3])
    trace = TileLoad(np.array([1.0, 1.01, 2.01, 2.02]), forces_n, angle_rad, 0, 0)
    scene = make_scene(ground={"kind": "plate"})
    made = make_ground(scene, seed=0, lead_s=1.0, tile_load=trace)
    assert isinstance(made, TraceLoad), "a recorded load wins over the scene's ground"
    assert made.duration_s == 2.02
    np.testing.assert_allclose(
        made.forces_n(at(0.0, 0.999, 1.005, 1.01, 1.51, 2.02, 5.0)),
        [[0.0] * 4, [0.0] * 4, [0.5, 1, 1.5, 2], [1.0, 2, 3, 4], [2.0] * 4, [0.0] * 4, [0.0] * 4],
        atol=1e-9,
    )
    angle = made.angle_rad(at(0.0, 1.51, 9.0))
    assert angle is not None
    np.testing.assert_allclose(angle, [0.1, 0.2, 0.3])


def test_a_recorded_load_is_over_when_it_is_over() -> None:
    made = TraceLoad(TileLoad(at(1.0, 2.0), np.array([[5.0], [6.0]]), None, 0, 0))
    np.testing.assert_allclose(made.forces_n(at(0.9, 1.0, 2.0, 2.1)), [[0.0], [5.0], [6.0], [0.0]])


def test_a_recorded_load_without_an_angle_has_none() -> None:
    trace = TileLoad(at(1.0, 2.0), np.zeros((2, 1)), None, 0, 0)
    assert TraceLoad(trace).angle_rad(at(1.5)) is None


def test_a_looped_load_comes_again_after_a_second_in_the_air() -> None:
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


# The mill


@pytest.fixture
def mill() -> IndentationProgramme:
    made = ground_of(make_scene(FOUR[:2], ground={"kind": "indentation"}), lead_s=1.0)
    assert isinstance(made, IndentationProgramme)
    return made


def programme(mill: IndentationProgramme) -> tuple[Floats, Floats, list[str], npt.NDArray[np.intp]]:
    """Times in ms, forces, phases and pressed tiles of all of it."""
    t_s = (np.arange(round(mill.duration_s * 1000)) + 0.5) / 1000
    phases = [mill.PHASES[i] for i in mill.find_phase_index(t_s).tolist()]
    return t_s, mill.forces_n(t_s), phases, mill.find_indented_tile(t_s)


def runs(phases: list[str]) -> list[tuple[str, int]]:
    """Phases in their order with their lengths."""
    found: list[tuple[str, int]] = []
    for phase in phases:
        if found and found[-1][0] == phase:
            found[-1] = (phase, found[-1][1] + 1)
        else:
            found.append((phase, 1))
    return found


def test_each_tile_is_pressed_in_turn_and_alone(mill: IndentationProgramme) -> None:
    _, forces_n, _, tile = programme(mill)
    assert (np.count_nonzero(forces_n, axis=1) <= 1).all()
    for i in range(2):
        assert (forces_n[tile != i, i] == 0).all()
        assert forces_n[:, i].max() == pytest.approx(30.0, abs=0.01)
    order = [int(i) for i in tile if i >= 0]
    assert order == sorted(order)
    assert mill.serials == ("T01", "T02")


def test_a_tile_gets_four_slow_repeats_five_holds_and_fifteen_taps(
    mill: IndentationProgramme,
) -> None:
    _, forces_n, phases, tile = programme(mill)
    of_first = [phase for phase, i in zip(phases, tile, strict=True) if i == 0]
    sequence = [phase for phase, _ in runs(of_first)]
    assert sequence == (
        ["rest", "load", "unload"] * 4
        + ["rest", "load", "hold", "release"] * 5
        + ["rest", "tap"] * 15
        + ["rest"]
    )
    force = forces_n[:, 0]
    held = force[[p == "hold" and i == 0 for p, i in zip(phases, tile, strict=True)]]
    np.testing.assert_allclose(held, held[0])
    assert held[0] > 10.0
    lengths = {phase: {n for p, n in runs(of_first) if p == phase} for phase in set(sequence)}
    assert lengths["release"] == {5}, "released within 5 ms"
    assert lengths["tap"] == {20}, "taps of 20 ms"
    assert max(lengths["load"]) == 4_000
    assert lengths["unload"] == {4_000}


def test_slow_strokes_go_up_and_down_at_a_constant_rate(mill: IndentationProgramme) -> None:
    _, forces_n, phases, tile = programme(mill)
    rows = [i for i, p in enumerate(phases) if p == "unload" and tile[i] == 0][:4_000]
    np.testing.assert_allclose(np.diff(forces_n[rows, 0]), -30.0 / 4_000, atol=1e-9)


def test_last_comes_a_soak_without_load_at_two_temperatures(mill: IndentationProgramme) -> None:
    t_s, forces_n, phases, tile = programme(mill)
    soak = np.array([p == "soak" for p in phases])
    assert soak[-1]
    assert (np.diff(np.flatnonzero(soak)) == 1).all(), "once, and at the end"
    assert (forces_n[soak] == 0).all()
    assert (tile[soak] == -1).all()
    assert t_s[soak][0] + 5 < mill.temperature_step_s < mill.duration_s - 5
    assert mill.soak_k == 4.0


def test_the_spindles_force_is_the_force_on_the_tile(mill: IndentationProgramme) -> None:
    t_s, forces_n, _, tile = programme(mill)
    for i in range(0, len(t_s), 37):
        spindle_n = mill.compute_spindle_force_n(float(t_s[i]))
        if tile[i] < 0:
            assert spindle_n is None
        else:
            assert spindle_n == pytest.approx(forces_n[i, tile[i]], abs=1e-9)
    assert mill.compute_spindle_force_n(mill.duration_s + 1) is None
    assert (mill.forces_n(at(mill.duration_s + 1)) == 0).all()


def test_the_mill_does_what_the_scene_says() -> None:
    keys = {"kind": "indentation", "load_n": 12.0, "stroke_s": 0.5, "repeats": 2, "soak_k": -3.0}
    made = ground_of(make_scene(FOUR[:1], ground=keys), lead_s=0.0)
    assert isinstance(made, IndentationProgramme)
    _, forces_n, phases, _ = programme(made)
    assert forces_n.max() == pytest.approx(12.0, abs=0.03)
    assert [p for p, _ in runs(phases)].count("unload") == 2
    assert made.soak_k == -3.0


def test_the_mill_leaves_a_reference_tile_alone() -> None:
    scene = with_reference(make_scene(FOUR[:3], ground={"kind": "indentation"}), 1)
    made = ground_of(scene)
    assert isinstance(made, IndentationProgramme)
    _, forces_n, _, tile = programme(made)
    assert set(tile.tolist()) == {-1, 0, 2}
    assert (forces_n[:, 1] == 0).all()
