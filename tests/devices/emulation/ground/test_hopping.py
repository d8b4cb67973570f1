"""Three hops on soft ground: the truth of domes, plate and reference tile."""

from __future__ import annotations

from functools import cache
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from devices.clock import VirtualClock
from devices.emulation.ground.hopping import HOPS, STEP_S, Hopping
from devices.emulation.world import GroundTruth, World
from devices.errors import SceneError
from devices.scene.scene_file import Scene, load_scene

Floats = npt.NDArray[np.float64]
BOTH = pytest.mark.parametrize("name", ["poppy", "mud"])
LEAD_S = 1.0
WEIGHT_N = 0.909 * 9.81


def with_ground(scene: Scene, **keys: Any) -> Scene:
    facts = scene.model_dump()
    facts["ground"] |= keys
    return Scene.model_validate(facts)


def world_of(scene: Scene, *, seed: int = 0, is_repeated: bool = False) -> World:
    return World(scene, VirtualClock(), seed=seed, lead_s=LEAD_S, is_repeated=is_repeated)


@cache
def hopping(name: str, seed: int = 0) -> tuple[World, Hopping]:
    world = world_of(load_scene(name), seed=seed)
    assert isinstance(world.ground, Hopping)
    return world, world.ground


def truth_at(world: World, t_s: Floats) -> GroundTruth:
    return world.compute_truth(world.epoch_ns + np.round(t_s * 1e9).astype(np.int64))


def all_of(ground: Hopping, step_s: float = STEP_S) -> Floats:
    assert ground.duration_s is not None
    return np.arange(0.0, ground.duration_s, step_s)


@cache
def whole_truth(name: str, seed: int = 0) -> tuple[Hopping, Floats, GroundTruth]:
    """Return the ground of a scene, all its times and the truth at them."""
    world, ground = hopping(name, seed)
    t_s = all_of(ground)
    return ground, t_s, truth_at(world, t_s)


def is_in_ground(ground: Hopping, t_s: Floats) -> npt.NDArray[np.bool_]:
    """Return whether the foot is in the ground, from first touch to last."""
    stances = zip(ground.touch_down_s, ground.lift_off_s, strict=True)
    return np.asarray(np.any([(t_s >= a) & (t_s <= b) for a, b in stances], axis=0))


@BOTH
def test_a_leg_hops_three_times_and_is_in_the_air_between_the_hops(name: str) -> None:
    ground, t_s, truth = whole_truth(name)
    assert len(ground.touch_down_s) == len(ground.lift_off_s) == HOPS == 3
    # Galileo: 143 ms for 10 cm
    assert ground.touch_down_s[0] == pytest.approx(LEAD_S + (2 * 0.10 / 9.81) ** 0.5, abs=0.005)
    flights_s = [b - a for a, b in zip(ground.lift_off_s, ground.touch_down_s[1:], strict=False)]
    assert min(flights_s) > 0.1
    assert ground.duration_s is not None
    assert ground.duration_s - ground.lift_off_s[-1] >= 1.5
    in_the_air = ~is_in_ground(ground, t_s)
    np.testing.assert_allclose(truth.true_force_n[in_the_air], 0.0, atol=1e-9)
    np.testing.assert_allclose(truth.true_plate_n[in_the_air], 0.0, atol=1e-9)
    assert np.isnan(truth.true_cop_x_m[in_the_air]).mean() > 0.999


@BOTH
def test_each_hop_reaches_about_10_cm_again(name: str) -> None:
    _, ground = hopping(name)
    for begin, end in zip(ground.lift_off_s, [*ground.touch_down_s[1:], 9.0], strict=True):
        flight = np.arange(begin, end, 0.001)
        clear_m = -ground.compute_depth_m(flight).max(axis=1)
        assert clear_m.max() == pytest.approx(0.10, abs=0.015)


@BOTH
def test_the_grounds_impulse_between_two_tops_is_weight_times_time(name: str) -> None:
    world, ground = hopping(name)
    body = np.array([step.body_m_s for step in ground.recorded_steps])
    ankle = np.array([step.ankle_m_s for step in ground.recorded_steps])
    momentum = 0.909 * (0.87 * body + 0.13 * ankle)
    times = np.array([step.t_s for step in ground.recorded_steps])
    tops = [times[0]]
    for begin, end in zip(ground.lift_off_s, [*ground.touch_down_s[1:], times[-1]], strict=True):
        flight = (times > begin) & (times <= end)
        tops.append(times[flight][np.abs(momentum[flight]).argmin()])
    for begin, end in pairwise(tops):
        t_s = np.arange(begin, end, STEP_S / 2)
        impulse = np.trapezoid(truth_at(world, t_s).true_plate_n, t_s)
        assert impulse == pytest.approx(WEIGHT_N * (end - begin), rel=0.005)


@BOTH
@pytest.mark.parametrize("seed", [0, 1])
def test_no_dome_is_pulled_or_pressed_beyond_its_range(name: str, seed: int) -> None:
    forces_n = whole_truth(name, seed)[2].true_force_n
    assert (forces_n >= 0.0).all()
    assert np.isfinite(forces_n).all()
    # paper III-A: 25 to 35 N wanted
    assert 4.0 < forces_n.max() < 25.0


@BOTH
def test_a_plate_bears_domes_and_the_rest_of_the_sole(name: str) -> None:
    ground, t_s, truth = whole_truth(name)
    np.testing.assert_allclose(
        truth.true_plate_n, truth.true_grf_n + ground.force_beside_domes_n(t_s), atol=1e-9
    )
    upright = np.cos(ground.arc_rad - truth.true_angle_rad[:, None])
    np.testing.assert_allclose(
        truth.true_grf_n, (truth.true_force_n * upright).sum(axis=1), atol=1e-9
    )
    if name == "poppy":  # nothing but the sole: of each newton the domes bear 0.8
        np.testing.assert_allclose(truth.true_grf_n, 0.8 * truth.true_plate_n, atol=1e-9)


def test_only_mud_pulls_and_only_at_lift_off() -> None:
    assert (whole_truth("poppy")[2].true_plate_n >= -1e-9).all()
    ground, t_s, truth = whole_truth("mud")
    pulled = truth.true_plate_n < -0.5
    assert pulled.any()
    last = np.any([(t_s > leave - 0.1) & (t_s <= leave) for leave in ground.lift_off_s], axis=0)
    assert last[pulled].all()
    assert ground.forces_n(t_s[pulled]).max() < 1e-3, "then no dome bears anything"
    rising = np.diff(ground.compute_depth_m(t_s)[:, 4]) < 0
    assert rising[pulled[:-1]].all()
    without = world_of(with_ground(load_scene("mud"), suction_kpa=0.0))
    least_n = truth_at(without, t_s).true_plate_n.min()
    assert truth.true_plate_n.min() < least_n - 3.0


def test_the_foot_sinks_about_5_cm_in_mud_and_less_in_poppy_seeds() -> None:
    sunk_m = {}
    for name in ("poppy", "mud"):
        _, ground = hopping(name)
        sunk_m[name] = ground.compute_depth_m(all_of(ground)).max()
    assert sunk_m["mud"] == pytest.approx(0.05, abs=0.01)
    assert 0.01 < sunk_m["poppy"] < 0.04


def test_the_head_is_proportional_to_the_depth_of_each_tile() -> None:
    world, ground = hopping("mud")
    t_s = all_of(ground, 0.001)
    head_kpa, depth_m = ground.compute_head_kpa(t_s), ground.compute_depth_m(t_s)
    np.testing.assert_allclose(head_kpa, 16.5 * np.maximum(depth_m, 0.0))
    assert (head_kpa[~is_in_ground(ground, t_s)] < 0.02).all()
    assert head_kpa.max() == pytest.approx(0.8, abs=0.2)
    poppy = hopping("poppy")[1]
    assert (poppy.compute_head_kpa(t_s) == 0).all(), "grains are no liquid"
    surroundings = world._make_surroundings("any")
    np.testing.assert_array_equal(surroundings.compute_head_kpa(t_s), head_kpa)


def test_the_reference_tile_bears_nothing_and_reads_the_atmosphere_plus_the_head() -> None:
    scene = load_scene("mud")
    quiet = scene.emulation.model_copy(update={"noise_kpa": 0.0, "ambient_kpa": 99.7})
    world = world_of(scene.model_copy(update={"emulation": quiet}))
    ground = world.ground
    assert isinstance(ground, Hopping)
    t_s = all_of(ground, 0.01)
    assert (ground.forces_n(t_s)[:, 4] == 0).all()
    read_kpa = [world._domes.compute_pressure_kpa(4, float(t)) for t in t_s[t_s < 2.5]]
    # Linear between grid points of 0.5 ms, in which the foot sinks by 0.7 mm: 0.01 kPa
    np.testing.assert_allclose(
        read_kpa, 99.7 + ground.compute_head_kpa(t_s[t_s < 2.5])[:, 4], atol=0.01
    )


def test_mud_is_cold_from_the_first_touch_on() -> None:
    world, ground = hopping("mud")
    surroundings = world._make_surroundings("any")
    assert surroundings.compute_chip_degc(ground.touch_down_s[0], 1.0, 4.0) == pytest.approx(21.0)
    assert surroundings.compute_chip_degc(ground.touch_down_s[0] + 1.0, 1.0, 4.0) == pytest.approx(
        21.0 - 4.0 * (1 - np.exp(-1.0)), abs=1e-6
    )
    assert hopping("poppy")[0]._make_surroundings("any").is_temperature_constant


@BOTH
def test_the_load_travels_forward_over_the_foot(name: str) -> None:
    world, ground = hopping(name)
    for touch in ground.touch_down_s:
        early, late = (
            truth_at(world, np.linspace(touch + a, touch + b, 50)).true_cop_x_m.mean()
            for a, b in ((0.01, 0.04), (0.42, 0.48))
        )
        assert late - early > 0.010


@pytest.mark.slow
@BOTH
def test_the_same_seed_is_the_same_hop_to_the_bit_and_another_is_not(name: str) -> None:
    t_s = np.arange(0.0, 5.0, 0.001)
    first, again, other = (
        truth_at(world_of(load_scene(name), seed=seed), t_s).true_plate_n for seed in (3, 3, 4)
    )
    np.testing.assert_array_equal(first, again)
    assert np.abs(first - other).max() > 0.5


@BOTH
@settings(max_examples=20, deadline=None, suppress_health_check=[HealthCheck.differing_executors])
@given(cuts=st.lists(st.integers(0, 2_000), max_size=6))
def test_truth_is_the_same_however_its_times_are_split(name: str, cuts: list[int]) -> None:
    world, _ = hopping(name)
    t_s = np.linspace(1.1, 2.3, 2_000)
    whole = truth_at(world, t_s)
    pieces = [truth_at(world, piece) for piece in np.split(t_s, sorted(cuts)) if len(piece)]
    for column in ("true_force_n", "true_plate_n", "true_cop_x_m", "true_angle_rad"):
        joined = np.concatenate([getattr(piece, column) for piece in pieces])
        np.testing.assert_array_equal(joined, getattr(whole, column))


@BOTH
def test_a_leg_that_is_dropped_repeatedly_hops_the_same_each_time(name: str) -> None:
    world, once = world_of(load_scene(name), is_repeated=True), hopping(name)[1]
    ground = world.ground
    assert isinstance(ground, Hopping)
    assert ground.duration_s is None
    assert once.duration_s is not None
    t_s = np.arange(LEAD_S, once.duration_s, 0.001)
    round_s = once.duration_s - LEAD_S
    np.testing.assert_allclose(ground.forces_n(t_s + 7 * round_s), once.forces_n(t_s), atol=1e-6)
    ends = ground.angle_rad(np.array([LEAD_S + round_s - 1e-9, LEAD_S + round_s + 1e-9]))
    assert ends[0] == pytest.approx(ends[1]), "the segment does not jump"


@BOTH
def test_tiles_side_by_side_share_a_strip(name: str) -> None:
    scene = load_scene(name)
    doubled = [
        tile.model_copy(update={"serial": f"D{i}", "mux": 0x71, "y_m": 0.014})
        for i, tile in enumerate(scene.tile)
        if not tile.reference
    ]
    world = world_of(scene.model_copy(update={"tile": (*scene.tile, *doubled)}))
    one, t_s = hopping(name)[0], np.linspace(1.1, 1.6, 200)
    both, alone = truth_at(world, t_s), truth_at(one, t_s)
    np.testing.assert_allclose(both.true_grf_n, alone.true_grf_n, atol=1e-6)
    np.testing.assert_allclose(both.true_force_n[:, 0], 0.5 * alone.true_force_n[:, 0], atol=1e-6)


def test_a_flat_insole_does_not_hop() -> None:
    facts = load_scene("insole").model_dump() | {"ground": {"kind": "poppy"}}
    with pytest.raises(SceneError, match="arc below the ankle"):
        world_of(Scene.model_validate(facts))


@pytest.mark.slow
@settings(max_examples=8, deadline=None)
@given(
    st.fixed_dictionaries(
        {
            "mass_kg": st.floats(0.3, 20.0),
            "drop_m": st.floats(0.01, 0.5),
            "leg_n_per_m": st.floats(100.0, 5_000.0),
            "stand_s": st.floats(0.2, 1.0),
            "pitch_rad": st.floats(0.0, 0.3),
            "sole_m2": st.floats(0.0005, 0.02),
            "strength_n_per_cm3": st.floats(0.02, 3.0),
            "viscosity_pa_s": st.floats(0.0, 100.0),
            "suction_kpa": st.floats(0.0, 50.0),
        }
    )
)
def test_a_leg_of_any_scene_hops_or_is_refused(keys: dict[str, float]) -> None:
    try:
        world = world_of(with_ground(load_scene("mud"), **keys))
    except SceneError:
        return
    ground = world.ground
    assert isinstance(ground, Hopping)
    truth = truth_at(world, all_of(ground, 0.002))
    assert (truth.true_force_n >= 0).all()
    assert np.isfinite(truth.true_plate_n).all()
    # No force is beyond that of a fall on a hard stop.
    assert np.abs(truth.true_plate_n).max() < 300 * keys["mass_kg"] * 9.81
