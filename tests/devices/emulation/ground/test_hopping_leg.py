"""A hopping leg obeys mechanics on any ground."""

from __future__ import annotations

import contextlib

import numpy as np
import numpy.typing as npt
import pytest

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
