"""Soft ground: its forces on a strip of a sole and on the whole foot."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from devices.emulation.ground.ground import SoftGround
from devices.scene.emulation_sections import MudGround, PoppyGround

POPPY = SoftGround.from_scene(PoppyGround(kind="poppy"))
MUD = SoftGround.from_scene(MudGround(kind="mud"))
BOTH = pytest.mark.parametrize("ground", [POPPY, MUD], ids=["poppy", "mud"])
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


@given(GROUNDS, DEPTHS, st.floats(1.01, 3.0), st.floats(0.0, 3.0))
def test_resistance_rises_with_depth(
    ground: SoftGround, depth_m: float, deeper: float, sinking_m_s: float
) -> None:
    shallow, _ = ground.compute_stress_pa(depth_m, sinking_m_s, 0.0)
    assert ground.compute_stress_pa(depth_m * deeper, sinking_m_s, 0.0)[0] > shallow


@given(GROUNDS, DEPTHS, st.floats(0.0, 3.0), st.floats(0.01, 2.0))
def test_resistance_rises_with_speed(
    ground: SoftGround, depth_m: float, sinking_m_s: float, faster_m_s: float
) -> None:
    slow, _ = ground.compute_stress_pa(depth_m, sinking_m_s, 0.0)
    assert ground.compute_stress_pa(depth_m, sinking_m_s + faster_m_s, 0.0)[0] > slow


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
