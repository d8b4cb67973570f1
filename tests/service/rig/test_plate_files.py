"""Files of emulated plates are read as any reference's, and lie beside what was injected."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from devices.clock import VirtualClock
from devices.emulation.world import World
from devices.scene.scene_file import load_scene
from service.rig.emulated_foot import (
    RECORDED_MAX_S,
    PlateFiles,
    make_injected_path,
    write_plate_files,
)
from storage.formats.reference import ReferenceOptions, read_reference

SECOND_NS = 1_000_000_000
BEGAN_NS = 7 * SECOND_NS


def world_of(name: str, *, begins_now: bool = True) -> World:
    return World(load_scene(name), VirtualClock(BEGAN_NS), seed=3, begins_now=begins_now)


def write(files: PlateFiles, world: World, seconds: float) -> None:
    end_ns = BEGAN_NS + round(seconds * SECOND_NS)
    write_plate_files(files, world, end_ns, seed=3, parts_seed=0)


def test_a_force_plates_file_says_all_that_a_comparison_needs(tmp_path: Path) -> None:
    path = tmp_path / "plate.csv"
    write(PlateFiles(force_plate=path), world_of("standing"), 5.0)
    data = read_reference(path, ReferenceOptions({"grf_n": "fz_n"}))
    injected = json.loads(make_injected_path(path).read_text())
    assert data.epoch_ns is None, "its clock is its own"
    assert len(data.time_s) == pytest.approx(
        5000 - (injected["zero_t_mono_ns"] - BEGAN_NS) / 1e6, abs=2
    )
    stands = data.time_s > 2.0
    expected_n = 40.0 * injected["gain"] + injected["offset_n"]
    assert data.grf_n[stands].mean() == pytest.approx(expected_n, abs=0.2)


def test_a_pressure_plates_file_is_read_without_a_word_more(tmp_path: Path) -> None:
    path = tmp_path / "plate.npz"
    write(PlateFiles(pressure_plate=path), world_of("rolling"), 4.5)
    data = read_reference(path, ReferenceOptions())
    loaded = data.grf_n > 8.0
    assert data.grf_n[loaded].mean() == pytest.approx(8.92, rel=0.04)
    assert data.cop_m is not None
    assert np.ptp(data.cop_m[loaded, 0]) == pytest.approx(0.042, abs=0.003)


def test_the_same_trial_is_the_same_file_and_another_trial_of_one_plate_is_not(
    tmp_path: Path,
) -> None:
    injected = []
    for name, seed in (("a", 1), ("b", 1), ("c", 2)):
        path = tmp_path / f"{name}.csv"
        write_plate_files(
            PlateFiles(force_plate=path),
            world_of("rolling"),
            BEGAN_NS + SECOND_NS,
            seed=seed,
            parts_seed=0,
        )
        injected.append(json.loads(make_injected_path(path).read_text()))
    assert (tmp_path / "a.csv").read_bytes() == (tmp_path / "b.csv").read_bytes()
    assert injected[0]["gain"] == injected[2]["gain"], "it is the same plate"
    assert injected[0]["offset_n"] != injected[2]["offset_n"], "set to zero anew"


def test_a_plate_stops_by_itself_and_one_whose_foot_never_moved_is_empty(tmp_path: Path) -> None:
    path = tmp_path / "plate.npz"
    write(PlateFiles(pressure_plate=path), world_of("standing"), 10 * RECORDED_MAX_S)
    assert np.load(path)["time_s"][-1] < RECORDED_MAX_S
    write(PlateFiles(pressure_plate=path), world_of("standing", begins_now=False), 5.0)
    assert len(np.load(path)["time_s"]) == 0
