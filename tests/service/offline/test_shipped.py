"""Calibrations that come with the program: of a built-in scene's tiles, for each chip, and not old.

`FOOTTILE_WRITE_RIG=1 sh scripts/test tests/service/offline/test_shipped.py` makes them anew.
"""

from __future__ import annotations

import hashlib
import os
import shutil
from itertools import product
from pathlib import Path
from typing import Any

import pytest

from devices.chips.pressure_chips import PRESSURE_CHIPS
from devices.scene.scene_file import list_builtin_scenes, load_scene
from service.estimation.calibration import Calibration, TileCalibration
from service.offline import calibration_lookup
from service.offline.calibration_lookup import EMULATED_RIG, SHIPPED_FOLDER, find_calibration

TILES = sorted(
    {
        tile.serial
        for name in list_builtin_scenes()
        if (scene := load_scene(name)).calibration == EMULATED_RIG
        for tile in scene.tile
        if not tile.reference
    }
)


def refuse(message: str) -> None:
    pytest.fail(f"a first start waits: {message}")


def pressed(serial: str, chip: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Calibration:
    """A tile on the bench, as if none had come with the program."""
    monkeypatch.setattr(calibration_lookup, "SHIPPED_FOLDER", tmp_path / "nothing")
    return find_calibration(
        EMULATED_RIG, [serial], chips={serial: chip}, cache_folder=tmp_path / "cache"
    )


@pytest.mark.skipif("FOOTTILE_WRITE_RIG" not in os.environ, reason="writes them")
def test_shipped_calibrations_are_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for serial, chip in product(TILES, PRESSURE_CHIPS):
        pressed(serial, chip, tmp_path, monkeypatch)
    shutil.rmtree(SHIPPED_FOLDER, ignore_errors=True)
    shutil.copytree(tmp_path / "cache", SHIPPED_FOLDER)


def test_no_built_in_scene_waits_for_the_mill(tmp_path: Path) -> None:
    assert [f"T0{number}" for number in range(1, 9)] == TILES
    for chip in PRESSURE_CHIPS:
        chips = dict.fromkeys(TILES, chip)
        find_calibration(
            EMULATED_RIG, TILES, chips=chips, cache_folder=tmp_path, on_progress=refuse
        )
    assert list(tmp_path.iterdir()) == []
    # None is left of a version before.
    assert len(list(SHIPPED_FOLDER.iterdir())) == len(TILES) * len(PRESSURE_CHIPS)


def test_a_changed_default_names_another_calibration(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    hashed: list[bytes] = []

    def compute_hash(content: bytes) -> Any:
        hashed.append(content)
        return hashlib.new("sha256", content)

    monkeypatch.setattr(hashlib, "sha256", compute_hash)
    find_calibration(EMULATED_RIG, TILES[:1], cache_folder=tmp_path, on_progress=refuse)
    scene = load_scene("indentation")
    for section in (scene.emulation, scene.ground, scene.array):
        assert section.model_dump_json().encode() in hashed[0]


@pytest.mark.slow(parts=8)
@pytest.mark.parametrize("chip", PRESSURE_CHIPS)
@pytest.mark.parametrize(
    "serial", [TILES[0], *(pytest.param(each, marks=pytest.mark.soak) for each in TILES[1:])]
)
def test_pressed_anew_a_tile_is_as_it_was(
    serial: str, chip: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (shipped,) = find_calibration(
        EMULATED_RIG, [serial], chips={serial: chip}, cache_folder=tmp_path / "empty"
    ).tiles
    (anew,) = pressed(serial, chip, tmp_path, monkeypatch).tiles
    (numbers, words), (as_numbers, as_words) = map(told, (shipped, anew))
    assert as_words == words
    # Processors round sums and products differently, and the fits end elsewhere by 3e-5 at most.
    assert as_numbers == pytest.approx(numbers, rel=1e-3, abs=1e-9)


def told(tile: TileCalibration) -> tuple[dict[str, float], dict[str, object]]:
    """Its numbers, and all else, by where they are."""
    left: list[tuple[str, object]] = [("", tile.model_dump())]
    numbers, words = dict[str, float](), dict[str, object]()
    while left:
        name, value = left.pop()
        if isinstance(value, dict):
            left += [(f"{name}/{key}", each) for key, each in value.items()]
        elif isinstance(value, list | tuple):
            left += [(f"{name}/{i}", each) for i, each in enumerate(value)]
        elif isinstance(value, float):
            numbers[name] = value
        else:
            words[name] = value
    return numbers, words
