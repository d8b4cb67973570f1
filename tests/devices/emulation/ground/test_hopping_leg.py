"""A hopping leg obeys mechanics on any ground; soft grounds resist, drag and suck."""

from __future__ import annotations

import contextlib

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st

from devices.emulation.ground import hopping as hopping_leg
from devices.emulation.ground.ground import GRAVITY_M_S2, SoftGround
from devices.emulation.ground.hopping import LEG_M, LegProperties, LegSimulation, Strip
from devices.errors import SceneError
from devices.scene.emulation_sections import MudGround, PoppyGround

Floats = npt.NDArray[np.float64]

LEG = LegProperties(
    0.909, 600.0, tuple(Strip(x_m, -0.149, 0.001) for x_m in (-0.02, -0.007, 0.007, 0.02))
)
POPPY = SoftGround.from_scene(PoppyGround(kind="poppy"))
MUD = SoftGround.from_scene(MudGround(kind="mud"))
BOTH = pytest.mark.parametrize("ground", [POPPY, MUD], ids=["poppy", "mud"])


def upright(t_s: float) -> float:
    return 0.0


def dropped(ground: SoftGround, *, stand_s: float = 2.0, leg: LegProperties = LEG) -> LegSimulation:
    """Return a leg that was dropped from 10 cm and then left to itself."""
    hopping = LegSimulation(leg, 0.10, 0.0)
    hopping.simulate_fall(ground, upright)
    hopping.simulate_stance(ground, upright, hopping.motion.t_s + stand_s)
    return hopping


def column(hopping: LegSimulation, name: str) -> Floats:
    return np.array([getattr(step, name) for step in hopping.recorded_steps])


def ground_n(hopping: LegSimulation) -> Floats:
    """Return the vertical force of the ground on an upright leg."""
    shares = [s.area_m2 * -s.z_m / s.radius_m for s in hopping.leg.strips]
    return column(hopping, "stress_pa") @ shares + column(hopping, "force_beside_strips_n")


def energy_j(hopping: LegSimulation) -> Floats:
    leg = hopping.leg
    pressed_m = LEG_M - (column(hopping, "body_m") - column(hopping, "ankle_m"))
    stiffness = np.where(pressed_m > 0, 1.0, hopping_leg._STOP) * leg.stiffness_n_m
    return np.asarray(
        0.5 * leg.body_kg * column(hopping, "body_m_s") ** 2
        + 0.5 * leg.foot_kg * column(hopping, "ankle_m_s") ** 2
        + leg.body_kg * GRAVITY_M_S2 * column(hopping, "body_m")
        + leg.foot_kg * GRAVITY_M_S2 * column(hopping, "ankle_m")
        + 0.5 * stiffness * pressed_m**2
    )


@BOTH
def test_a_leg_falls_as_galileo_says(ground: SoftGround) -> None:
    hopping = LegSimulation(LEG, 0.10, 0.0)
    hopping.simulate_fall(ground, upright)
    assert hopping.motion.t_s == pytest.approx((2 * 0.10 / 9.81) ** 0.5, abs=0.001)
    assert hopping.compute_rise_m_s(hopping.motion) == pytest.approx(
        -((2 * 9.81 * 0.10) ** 0.5), rel=0.01
    )


@BOTH
def test_a_leg_left_to_itself_rests_on_its_weight(ground: SoftGround) -> None:
    hopping = dropped(ground)
    assert abs(hopping.motion.body_m_s) < 1e-3
    assert ground_n(hopping)[-1] == pytest.approx(0.909 * 9.81, rel=0.01)


@BOTH
def test_without_push_off_energy_decreases(ground: SoftGround) -> None:
    hopping = dropped(ground)
    energy = energy_j(hopping)
    # The ground returns the energy that it stored: force squared over twice its stiffness.
    sole_m2 = sum(strip.area_m2 for strip in LEG.strips)
    stiffness = ground.strength_pa_m * ground.unloading_stiffness_ratio * sole_m2
    stored = ground_n(hopping).max() ** 2 / (2 * stiffness)
    later = np.maximum.accumulate(energy[::-1])[::-1]
    assert (later - energy).max() < 1.1 * stored + 0.005
    assert energy[-1] < energy[0] - 0.7 * 0.909 * 9.81 * 0.10
    landed = column(hopping, "stress_pa").max(axis=1) > 0
    first = int(np.flatnonzero(landed)[0])
    assert column(hopping, "body_m")[first:].max() < LEG_M + 0.149 + 0.10 - 0.05, (
        "it hardly bounces"
    )


@BOTH
def test_the_grounds_impulse_is_weight_and_change_of_momentum(ground: SoftGround) -> None:
    hopping = dropped(ground, stand_s=0.3)
    momentum = LEG.body_kg * column(hopping, "body_m_s") + LEG.foot_kg * column(
        hopping, "ankle_m_s"
    )
    for end in (600, 800, 1200, len(momentum) - 1):
        impulse = ground_n(hopping)[:end].sum() * hopping_leg.STEP_S
        fallen = 0.909 * 9.81 * end * hopping_leg.STEP_S
        assert momentum[end] - momentum[0] == pytest.approx(impulse - fallen, abs=1e-6)


@BOTH
def test_a_push_off_reaches_its_height(ground: SoftGround) -> None:
    strokes = []
    for higher_m in (0.0, 0.02):
        hopping = dropped(ground, stand_s=0.5)
        strokes.append(hopping.simulate_push_off(ground, upright, hopping.drop_centre_m + higher_m))
        assert ground_n(hopping)[-1] == pytest.approx(0.0, abs=1e-9)
        hopping.simulate_flight_up(ground, upright)
        top_m = hopping.compute_centre_m(hopping.motion)
        assert top_m == pytest.approx(hopping.drop_centre_m + higher_m, abs=0.003)
    assert strokes[1] > strokes[0] > 0.03


def test_a_leg_that_cannot_leave_the_ground_is_refused() -> None:
    glue = SoftGround.from_scene(MudGround(kind="mud", suction_kpa=50.0))
    hopping = dropped(glue, stand_s=0.5)
    with pytest.raises(SceneError, match="does not get out of this ground"):
        hopping.simulate_push_off(glue, upright, hopping.drop_centre_m)


@pytest.mark.parametrize("suction_kpa", [8.0, 10.0, 20.0])
def test_a_leg_that_stands_stretched_in_mud_has_not_hopped(suction_kpa: float) -> None:
    # As high as a stretched leg reaches without leaving: that is not a hop.
    glue = SoftGround.from_scene(MudGround(kind="mud", suction_kpa=suction_kpa))
    hopping = dropped(glue, stand_s=0.5)
    with contextlib.suppress(SceneError):  # it may be refused, too
        hopping.simulate_push_off(glue, upright, hopping.compute_centre_m(hopping.motion) + 0.06)
        assert ground_n(hopping)[-1] == pytest.approx(0.0, abs=1e-9)


def test_a_leg_that_is_too_soft_is_refused() -> None:
    with pytest.raises(SceneError, match="folds up") as caught:
        dropped(POPPY, leg=LegProperties(20.0, 100.0, LEG.strips))
    assert "leg_n_per_m" in caught.value.expected


@BOTH
def test_half_the_step_is_the_same_motion(
    ground: SoftGround, monkeypatch: pytest.MonkeyPatch
) -> None:
    coarse = dropped(ground, stand_s=0.4)
    monkeypatch.setattr(hopping_leg, "STEP_S", hopping_leg.STEP_S / 4)
    fine = dropped(ground, stand_s=0.4)
    t_s = np.arange(0.0, 0.5, 0.001)
    forces_n = [np.interp(t_s, column(h, "t_s"), ground_n(h)) for h in (coarse, fine)]
    difference_n = np.abs(forces_n[0] - forces_n[1])
    assert difference_n.mean() < 0.05
    assert np.percentile(difference_n, 99) < 0.5


# Soft ground: its forces on a strip of a sole and on the whole foot

GROUNDS = st.sampled_from([POPPY, MUD])
DEPTHS = st.floats(1e-6, 0.2)
SPEEDS = st.floats(-3.0, 3.0)
SOLE_M2 = 0.004


def test_the_strength_of_poppy_seeds_is_the_measured_one() -> None:
    # Li, Zhang and Goldman 2013: of the order of 0.3 N/cm^3, so 0.9 N/cm^2 at 3 cm
    stress_pa, _ = POPPY.compute_stress_pa(0.03, 0.0, 0.0)
    assert stress_pa * 1e-4 == pytest.approx(0.9)


def test_poppy_seeds_and_mud_have_their_weight() -> None:
    assert 0 < POPPY.inertia_kg_m3 < 2 * 1000, "grains of 1 g/cm^3 and a drag coefficient near 1"
    assert POPPY.head_pa_m == 0.0
    # hardware.md 9: 1.5 to 1.8 kPa per 0.1 m
    assert 15_000 <= MUD.head_pa_m <= 18_000


@given(GROUNDS, DEPTHS, st.floats(1.01, 3.0), st.floats(0.0, 3.0), st.floats(0.01, 2.0))
def test_resistance_rises_with_depth_and_with_speed(
    ground: SoftGround, depth_m: float, deeper: float, sinking_m_s: float, faster_m_s: float
) -> None:
    stress_pa, _ = ground.compute_stress_pa(depth_m, sinking_m_s, 0.0)
    assert ground.compute_stress_pa(depth_m * deeper, sinking_m_s, 0.0)[0] > stress_pa
    assert ground.compute_stress_pa(depth_m, sinking_m_s + faster_m_s, 0.0)[0] > stress_pa


def test_drag_of_grains_goes_with_the_square_of_the_speed() -> None:
    still, one, two = (POPPY.compute_stress_pa(0.03, v, 0.0)[0] for v in (0.0, 0.7, 1.4))
    assert (two - still) / (one - still) == pytest.approx(4.0)


@given(GROUNDS, st.floats(-0.1, 0.2), SPEEDS, st.floats(0.0, 0.2))
def test_ground_never_pulls_at_a_strip(
    ground: SoftGround, depth_m: float, sinking_m_s: float, set_m: float
) -> None:
    stress_pa, new_set_m = ground.compute_stress_pa(depth_m, sinking_m_s, set_m)
    assert stress_pa >= 0.0
    assert new_set_m >= set_m or new_set_m == pytest.approx(set_m)


@BOTH
def test_a_compacted_ground_stays_compacted(ground: SoftGround) -> None:
    loaded_pa, set_m = ground.compute_stress_pa(0.04, 0.0, 0.0)
    risen_m = 0.04 / ground.unloading_stiffness_ratio
    assert ground.compute_stress_pa(0.04 - 0.5 * risen_m, -0.1, set_m)[0] == pytest.approx(
        0.5 * loaded_pa
    )
    assert ground.compute_stress_pa(0.04 - 1.1 * risen_m, -0.1, set_m) == (0.0, set_m)
    assert ground.compute_stress_pa(0.04, 0.0, set_m)[0] == pytest.approx(loaded_pa)
    assert ground.compute_stress_pa(0.05, 0.0, set_m)[0] == pytest.approx(loaded_pa * 5 / 4)


@BOTH
@given(st.lists(st.floats(-0.01, 0.08), min_size=2, max_size=8))
def test_no_path_in_the_ground_gains_energy(ground: SoftGround, turns_m: list[float]) -> None:
    path_m = np.concatenate(
        [np.linspace(a, b, 400) for a, b in zip([0.0, *turns_m], [*turns_m, 0.0], strict=True)]
    )
    set_m, stresses = 0.0, []
    for depth_m, step_m in zip(path_m, np.gradient(path_m), strict=True):
        stress_pa, set_m = ground.compute_stress_pa(
            float(depth_m), float(np.sign(step_m)) * 1e-6, set_m
        )
        stresses.append(stress_pa)
    assert np.trapezoid(stresses, path_m) >= -1e-3 * max(stresses) * 0.08


def test_dry_grains_press_the_sole_only() -> None:
    for depth_m, sinking_m_s, gap_m in ((0.03, 1.0, 0.0), (0.03, -1.0, 0.01)):
        assert POPPY.compute_foot_force_n(depth_m, sinking_m_s, gap_m, SOLE_M2) == 0.0


@given(st.floats(-0.05, 0.0), SPEEDS, st.floats(0.0, 0.1))
def test_mud_exerts_no_force_on_a_foot_above_it(
    depth_m: float, speed_m_s: float, gap_m: float
) -> None:
    assert MUD.compute_foot_force_n(depth_m, speed_m_s, gap_m, SOLE_M2) == 0.0


@given(st.floats(0.001, 0.1), st.floats(0.001, 3.0), st.floats(1e-5, 0.05))
def test_mud_sucks_only_at_a_sole_that_comes_off_its_bed(
    depth_m: float, speed_m_s: float, gap_m: float
) -> None:
    def force_n(speed: float, gap: float) -> float:
        return MUD.compute_foot_force_n(depth_m, speed, gap, SOLE_M2)

    sucked_n = force_n(-speed_m_s, 0.0) - force_n(-speed_m_s, gap_m)
    assert 0.0 < sucked_n <= 2_500 * SOLE_M2 * 1.000001
    assert force_n(speed_m_s, gap_m) == force_n(speed_m_s, 0.0), "none while it sinks"


def test_suction_is_over_when_the_gap_has_filled() -> None:
    assert MUD.compute_suction_pa(0.05, 1.0) < 0.001 * MUD.compute_suction_pa(0.004, 1.0)


@given(st.floats(0.001, 0.1), st.floats(0.01, 3.0))
def test_mud_drags_against_the_motion_and_lifts_at_rest(depth_m: float, speed_m_s: float) -> None:
    at_rest_n = MUD.compute_foot_force_n(depth_m, 0.0, 0.0, SOLE_M2)
    # Archimedes: mud of 1.68 g/cm^3 and a foot 2 cm thick
    assert at_rest_n == pytest.approx(1_682 * 9.81 * SOLE_M2 * min(depth_m, 0.02), rel=1e-3)
    assert MUD.compute_foot_force_n(depth_m, speed_m_s, 0.0, SOLE_M2) > at_rest_n
    assert MUD.compute_foot_force_n(depth_m, -speed_m_s, 0.0, SOLE_M2) < at_rest_n


def test_a_firmer_place_is_stronger_and_not_heavier() -> None:
    firm = SoftGround.from_scene(PoppyGround(kind="poppy"), firmness=1.05)
    assert firm.strength_pa_m == pytest.approx(1.05 * POPPY.strength_pa_m)
    assert firm.inertia_kg_m3 == POPPY.inertia_kg_m3
