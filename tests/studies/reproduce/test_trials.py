"""Scenes of the reproduction are the built-in ones, with what is said of them and no more."""

from __future__ import annotations

from pathlib import Path

import pytest

from devices.scene.scene_file import load_scene
from studies.reproduce.experiments import (
    POPPY,
    POPPY_RIM,
    SETUPS,
    ExperimentSetup,
    compose_scene_toml,
    plan_trials,
)
from studies.reproduce.result import compute_not_borne_n


@pytest.mark.parametrize("setup", SETUPS, ids=lambda setup: setup.name)
def test_a_scene_differs_from_the_built_in_one_in_what_is_said_only(
    setup: ExperimentSetup, tmp_path: Path
) -> None:
    path = tmp_path / "scene.toml"
    path.write_text(compose_scene_toml(setup, tmp_path / 'a "calibration".json'))
    scene, original = load_scene(str(path)), load_scene(setup.scene)
    assert scene.calibration == str(tmp_path / 'a "calibration".json')
    assert scene.emulation.repeatability == 0.03
    ground = original.ground
    if setup.domes_cover_sole:
        ground = ground.model_copy(update={"dome_share": 1.0})
    emulation = original.emulation.model_copy(update={"repeatability": 0.03})
    update = {"calibration": scene.calibration, "ground": ground, "emulation": emulation}
    assert scene == original.model_copy(update=update)


def test_what_no_dome_bears_is_nothing_on_seeds_but_for_a_rim(tmp_path: Path) -> None:
    found = {}
    for setup in (POPPY, POPPY_RIM):
        path = tmp_path / f"{setup.name}.toml"
        path.write_text(compose_scene_toml(setup, tmp_path / "cal.json"))
        found[setup] = compute_not_borne_n(load_scene(str(path)), 1, setup.trial_seconds)
    assert found[POPPY] == 0.0
    assert found[POPPY_RIM] == pytest.approx(2.52, abs=0.05)


def test_every_trial_has_a_name_a_seed_and_a_file_of_its_own_in_its_setup(tmp_path: Path) -> None:
    planned = plan_trials(SETUPS, 4, 10, tmp_path)
    assert (
        len({plan.session_name for plan in planned})
        == len({p.reference_path for p in planned})
        == 16
    )
    for setup in SETUPS:
        assert [plan.seed for plan in planned if plan.setup is setup] == [11, 12, 13, 14]
