"""One array on its scenes, with a preset for a calibration; and what is judged of a recording."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from devices.clock import VirtualClock
from devices.emulation.world import World
from devices.flags import EstimateFlag
from devices.scene.scene_file import Scene, load_scene
from service.estimation.calibration import PRESETS
from studies.broad.arrays import CLEAN, _evaluate_case, _iterate_cases, evaluate_estimates
from studies.broad.results import make_case_key

SEED = 1_000_003


def broad(name: str) -> Scene:
    return next(scene for scene, condition in _iterate_cases(0.02) if scene.name == name)


def test_every_condition_differs_from_the_clean_one_in_one_thing_only() -> None:
    cases = {(scene.name, condition): scene.emulation for scene, condition in _iterate_cases(0.02)}
    clean = cases["rolling", CLEAN]
    assert (clean.family, clean.repeatability, clean.gain_drift, clean.correlated_ms) == (
        *("broad", 0.0),
        *(0.0, 0.0),
    )
    assert cases["mud", "repeatability"] == cases["mud", CLEAN].model_copy(
        update={"repeatability": 0.02}
    )
    assert cases["mud", "correlated"].correlated_ms == 10.0
    assert cases["mud", "drift"].gain_drift == 0.01
    assert len(cases) == 13


@pytest.mark.slow
def test_an_array_is_judged_in_both_modes_and_its_tiles_are_told() -> None:
    scene = broad("poppy").model_copy(update={"models": ("unwrap", "static")})
    found, tiles = _evaluate_case(scene, CLEAN, SEED, PRESETS["paper-eq2-shape"]())
    assert set(found) == {make_case_key("poppy", CLEAN, mode) for mode in ("live", "offline")}
    live = found["poppy/clean/live"]
    assert live.frames > 2000
    assert sum(phase.frames for phase in live.phases.values()) == live.frames
    assert live.grf_mae_n is not None
    assert [tile.serial for tile in tiles] == ["*"] * 4, "the preset is one for all"
    for tile, part in zip(
        tiles, World(scene, VirtualClock(), parts_seed=SEED).dome_parts, strict=True
    ):
        assert tile.given == ()
        assert tile.drawn["loop_n"] == part.loop_n
        for name, lacks in (
            ("gas", part.kappa == 0.0),
            ("rubber", not part.creep_s),
            ("hysteresis", part.loop_n == part.viscous_n == 0.0),
        ):
            assert (name in tile.lacks) == lacks
            assert (tile.effect_n[name] > 0.01) == (not lacks)


def columns(**changes: npt.NDArray[Any]) -> dict[str, npt.NDArray[Any]]:
    """Twenty frames of two tiles that bear 5 N each, estimated exactly."""
    n = 20
    return {
        "t_ns": 10_000_000 * np.arange(n, dtype=np.int64),
        "true_grf_n": np.full(n, 10.0),
        "grf_n": np.full(n, 10.0),
        "grf_sigma_n": np.full(n, 0.1),
        "grf_lower_bound_n": np.full(n, 9.8),
        "true_cop_x_m": np.zeros(n),
        "true_cop_y_m": np.zeros(n),
        "cop_x_m": np.zeros(n),
        "cop_y_m": np.zeros(n),
        "cop_sigma_x_m": np.full(n, 1e-4),
        "estimate_flags": np.zeros(n, dtype=np.uint16),
        "force_n": np.full((n, 2), 5.0),
        "force_sigma_n": np.full((n, 2), 0.07),
        "true_force_n": np.full((n, 2), 5.0),
    } | changes


def test_a_tile_called_saturated_below_its_end_is_counted_and_so_is_a_bound_that_holds() -> None:
    sigma_n = np.full((20, 2), 0.07)
    sigma_n[:10, 0] = np.nan
    force_n = np.full((20, 2), 5.0)
    force_n[:2, 0] = 5.5  # more than there is: no lower bound
    status = np.zeros(20, dtype=np.uint16)
    status[:10] = EstimateFlag.SATURATED
    below_end = np.zeros((20, 2), dtype=bool)
    below_end[:4] = True
    found = evaluate_estimates(
        columns(force_sigma_n=sigma_n, force_n=force_n, estimate_flags=status),
        lambda: below_end,
    )
    assert (found.saturated_frames, found.saturated_tile_frames) == (10, 10)
    assert (found.wrongly, found.held) == (4, 8)
    assert found.phases["mid_stance"].frames == 10


def test_sums_of_squares_are_of_the_frames_that_count() -> None:
    error_n = np.where(np.arange(20) < 10, 0.3, 0.0)
    found = evaluate_estimates(columns(grf_n=10.0 + error_n), lambda: np.ones((20, 2), dtype=bool))
    phase = found.phases["mid_stance"]
    assert (phase.frames, phase.within) == (20, 10)
    assert phase.error2 == pytest.approx(10 * 0.09)
    assert phase.sigma2 == pytest.approx(20 * 0.01)
    assert phase.sigma_over_rms == pytest.approx(np.sqrt(0.2 / 0.9))
    assert found.wrongly == 0, "no tile was called saturated"


def test_each_time_that_a_tile_is_said_to_be_wrong_is_an_alarm() -> None:
    status = np.zeros(20, dtype=np.uint16)
    status[0:2] = EstimateFlag.STUCK
    status[5:9] = EstimateFlag.BASELINE_LOST | EstimateFlag.SATURATED
    status[7:12] |= np.uint16(EstimateFlag.CLIPPED)
    status[15:] |= np.uint16(EstimateFlag.CLIPPED)
    found = evaluate_estimates(columns(estimate_flags=status), lambda: np.ones((20, 2), dtype=bool))
    assert found.alarms == 4
    assert found.seconds == pytest.approx(0.19)


def test_a_missing_tile_is_no_bound() -> None:
    nothing = np.full((20, 2), np.nan)
    missing = columns(force_n=nothing, force_sigma_n=nothing)
    assert (
        evaluate_estimates(missing, lambda: np.ones((20, 2), dtype=bool)).saturated_tile_frames == 0
    )


def test_what_a_dome_settles_at_is_the_pressure_without_the_gas() -> None:
    world = World(load_scene("poppy"), VirtualClock(), lead_s=0.2)
    t_ns = np.arange(0, 1_500_000_000, 2_000_000)
    whole = world.compute_dome_kpa(t_ns)
    settled = world.compute_dome_kpa(t_ns, without_effects={"gas"})
    bare = world.compute_dome_kpa(
        t_ns, without_effects=("gas", "rubber", "hysteresis", "surroundings")
    )
    force_n = world.compute_truth(t_ns).true_force_n
    for i, part in enumerate(world.dome_parts):
        np.testing.assert_allclose(
            part.compute_static_force_n(bare[:, i]), force_n[:, i], atol=0.05
        )
    assert np.abs(whole - settled).max() > 0.3
    assert np.abs(settled - bare).max() > 0.2
    np.testing.assert_allclose(whole[0], bare[0])
