"""Angle of a rolling foot by a rendered film: as good as the paper needs, and what it costs."""

from __future__ import annotations

import math

import pytest

from devices.scene.scene_file import load_scene
from service.offline.calibration_lookup import EMULATED_RIG, find_calibration
from studies.reproduce.video_angle import SERVO, VIDEO, compare_angle_sources


@pytest.mark.slow(parts=8)
def test_the_films_angle_is_within_a_fifth_of_a_degree_and_the_cop_within_a_tenth_of_a_mm() -> None:
    scene = load_scene("rolling")
    serials = [tile.serial for tile in scene.tile]
    calibration = find_calibration(EMULATED_RIG, serials, on_progress=lambda _: None)
    found = compare_angle_sources(scene, calibration, seconds=2.5, seed=1, parts_seed=0)
    assert found.pictures == 126
    assert math.degrees(found.angle_most_rad[VIDEO]) < 0.2
    assert found.cop_apart_m < 1e-4
    assert found.cop_rms_m[VIDEO] < found.cop_rms_m[SERVO] + 1e-5
