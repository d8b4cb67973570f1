"""The broad family holds what a real batch of tiles may be, and draws from all of it.

The ranges are those that were asked for (issue 14); the default family's are in hardware.md.
"""

from __future__ import annotations

from dataclasses import asdict, replace

import numpy as np
import pytest

from devices.clock import VirtualClock
from devices.emulation.parts import (
    DomeProperties,
    draw_chip,
    draw_dome,
    draw_family_chip,
    draw_family_dome,
)
from devices.emulation.world import World
from devices.errors import SceneError
from devices.scene.scene_file import Scene, load_scene
from tests.devices.emulation.domes import static_kpa
from tests.devices.feet import foot

DOMES = [draw_family_dome("broad", f"T{i:02d}", seed) for i in range(20) for seed in range(100)]


def fills(values: list[float], low: float, high: float) -> None:
    """All of them lie between, and some near either end."""
    near = 0.02 * (high - low)
    assert low <= min(values) < low + near
    assert high - near < max(values) <= high


def full_scale_n(part: DomeProperties) -> float:
    """The slow force at 115 kPa."""
    force_n = np.linspace(10.0, 50.0, 4001)
    return float(np.interp(115.0, static_kpa(force_n, part), force_n))


def test_the_default_family_is_the_usual_draw() -> None:
    assert draw_family_chip("default", "T01", 3) == draw_chip("T01", 3)
    assert draw_family_dome("default", "T01", 3) == draw_dome("T01", 3)


def test_a_broad_serial_is_the_same_part_for_ever() -> None:
    # As of the default family: what was measured with it can be measured again.
    assert draw_family_dome("broad", "T01", 0).seal_kpa == pytest.approx(100.011395, abs=1e-6)
    assert draw_family_chip("broad", "T01", 0).sample_delay_ns == 211931


def test_stiffness_differs_by_a_factor_of_two() -> None:
    fills([full_scale_n(part) for part in DOMES[:400]], 20.0, 40.0)


def test_gas_is_of_any_gamma_and_time() -> None:
    gassy = [part for part in DOMES if part.kappa]
    fills([1.0 / (1.0 - part.kappa) for part in gassy], 1.1, 1.4)
    fills([float(np.log(part.conduction_s)) for part in gassy], np.log(0.005), np.log(0.060))


def test_creep_is_of_one_to_four_terms_from_10_ms_to_10_s() -> None:
    creeping = [part for part in DOMES if part.creep_s]
    assert {len(part.creep_s) for part in creeping} == {1, 2, 3, 4}
    fills([float(np.log(t)) for part in creeping for t in part.creep_s], np.log(0.01), np.log(10))
    fills([sum(part.creep_parts) for part in creeping], 0.02, 0.15)
    assert all(len(part.creep_parts) == len(part.creep_s) for part in creeping)


def test_the_loop_is_1_to_5_percent_and_any_part_of_it_viscous() -> None:
    looped = [part for part in DOMES if part.loop_n]
    half_n = [part.loop_n + part.viscous_n for part in looped]
    full_n = [full_scale_n(part) for part in looped]
    fills([2 * n / full for n, full in zip(half_n, full_n, strict=True)], 0.01, 0.05)
    fills([part.viscous_n / n for part, n in zip(looped, half_n, strict=True)], 0.0, 1.0)
    fills([part.flow_part for part in DOMES], 0.04, 0.12)
    fills([part.flow_power for part in DOMES], 3.0, 6.0)


def test_the_chip_is_before_or_behind_its_gas_by_up_to_3_s() -> None:
    fills([part.gas_lag_s for part in DOMES], -3.0, 3.0)


def test_a_chip_samples_up_to_300_us_off_and_never_before_it_was_asked() -> None:
    chips = [draw_family_chip("broad", f"T{i:02d}", seed) for i in range(20) for seed in range(100)]
    fills([chip.sample_delay_ns / 1000.0 for chip in chips], -300.0, 300.0)
    assert all(
        0 < chip.conversion_ns // 4 + chip.sample_delay_ns < chip.conversion_ns for chip in chips
    )


def test_one_dome_in_twenty_lacks_an_effect_each() -> None:
    for lacks in (
        [part.kappa == 0.0 for part in DOMES],
        [part.creep_s == () for part in DOMES],
        [part.loop_n == part.viscous_n == 0.0 for part in DOMES],
    ):
        assert np.mean(lacks) == pytest.approx(0.05, abs=0.02)


def of_family(scene: Scene, family: str) -> Scene:
    emulation = scene.emulation.model_copy(update={"family": family})
    return scene.model_copy(update={"emulation": emulation})


def test_a_scene_says_of_which_family_its_parts_are() -> None:
    rolling = load_scene("rolling")
    assert rolling.emulation.family == "default"
    counts = {
        family: foot(of_family(rolling, family)).run_for(0.2).pressure_raw
        for family in ("default", "broad")
    }
    assert (counts["default"] != counts["broad"]).any()


def test_the_driver_does_not_know_when_a_broad_chip_samples() -> None:
    rolling = load_scene("rolling")
    frames = {
        family: foot(of_family(rolling, family)).run_for(0.02) for family in ("default", "broad")
    }
    for column in ("t_mono_ns", "sample_offset_us"):
        np.testing.assert_array_equal(
            getattr(frames["default"], column), getattr(frames["broad"], column)
        )


@pytest.mark.parametrize("name", ["rolling", "poppy", "mud"])
def test_every_scene_runs_with_broad_parts_and_reads_plausible_pressures(name: str) -> None:
    frames = foot(of_family(load_scene(name), "broad")).run_for(1.0)
    assert not frames.tile_flags.any()
    assert ((frames.pressure_raw > 100) & (frames.pressure_raw < 600)).all()


def test_the_truth_of_a_scene_does_not_depend_on_the_family() -> None:
    t_ns = np.arange(0, 3_000_000_000, 10_000_000)
    truths = [
        asdict(World(of_family(load_scene("poppy"), family), VirtualClock()).compute_truth(t_ns))
        for family in ("default", "broad")
    ]
    for name, values in truths[0].items():
        np.testing.assert_array_equal(values, truths[1][name])


def test_a_dome_of_table_1_reads_full_scale_at_the_casting_s_force_times_modulus_and_area() -> None:
    casting_n = float(draw_dome("table-1", 7).compute_static_force_n(np.array([115.0]))[0])
    for serial, stiffer in (("v40-10", 0.69 / 2.17 * 100 / 121), ("v60-12", 144 / 121)):
        part = draw_family_dome("table-1", serial, 7)
        assert float(part.compute_static_force_n(np.array([115.0]))[0]) == pytest.approx(
            stiffer * casting_n
        )


def test_the_paper_s_own_dome_is_the_casting_and_a_softer_wall_gives_way_more() -> None:
    casting, own = draw_dome("table-1", 0), draw_family_dome("table-1", "v60-11", 0)
    assert replace(own, stiffening=casting.stiffening) == casting
    assert own.stiffening == pytest.approx(casting.stiffening)
    # hardware.md 9: 0.00389 and 0.00124 per kPa
    softer = draw_family_dome("table-1", "v40-11", 0)
    assert softer.wall_per_kpa / casting.wall_per_kpa == pytest.approx(3.14, abs=0.01)


def test_a_serial_that_names_no_dome_of_table_1_is_refused() -> None:
    with pytest.raises(SceneError, match="no dome of the paper's Table I"):
        draw_family_dome("table-1", "T01", 0)
