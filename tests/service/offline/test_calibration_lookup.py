"""Calibration files prove themselves: a user's is refused if not, a cached one made anew."""

from __future__ import annotations

import os
import re
from pathlib import Path
from random import Random

import pytest

from devices.errors import CalibrationError
from service.estimation.calibration import Calibration
from service.offline.calibration_lookup import find_calibration, read_calibration
from service.sessions.calibration_file import write_calibration
from storage.verify.data_folder import find_verdict, verify_path
from tests.builders.calibrations import make_calibration, newton_tile
from tests.hostile.damages import DAMAGES, Damage

CALIBRATION = make_calibration(newton_tile("T01"), newton_tile("T02", rmse_n=0.1))


def seeded() -> Random:
    return Random(1)  # noqa: S311  # no secret


@pytest.fixture
def path(tmp_path: Path) -> Path:
    path = tmp_path / "toe.json"
    write_calibration(path, CALIBRATION)
    return path


def test_a_written_calibration_is_read_and_every_byte_of_it_is_proven(
    path: Path, tmp_path: Path
) -> None:
    whole = path.read_bytes()
    assert read_calibration(path) == CALIBRATION
    (tmp_path / "link.json").symlink_to(path)
    assert read_calibration(tmp_path / "link.json") == CALIBRATION
    for at in range(0, len(whole), 3):
        damaged = bytearray(whole)
        damaged[at] ^= 1 << at % 8
        path.write_bytes(damaged)
        with pytest.raises(CalibrationError, match=r"toe\.json"):
            read_calibration(path)
    for end in range(0, len(whole), 97):
        path.write_bytes(whole[:end])
        with pytest.raises(CalibrationError, match=r"toe\.json"):
            read_calibration(path)


def test_verify_proves_it_and_a_folder_of_them(path: Path, tmp_path: Path) -> None:
    write_calibration(tmp_path / "heel.json", CALIBRATION)
    assert [find_verdict(verify_path(each)) for each in (path, tmp_path)] == ["complete"] * 2
    DAMAGES["a bit flipped"](path, seeded())
    assert [find_verdict(verify_path(each)) for each in (path, tmp_path)] == ["damaged"] * 2
    path.write_text(CALIBRATION.to_json())
    assert "it has no hash" in " ".join(verify_path(path).problems)


def test_an_edit_is_refused_until_the_user_says_that_it_is_meant(path: Path) -> None:
    edited = path.read_text().replace('"repeats": 4', '"repeats": 5')
    path.write_text(edited)
    with pytest.raises(CalibrationError, match='delete its lines "id" and "check"'):
        read_calibration(path)
    for name in ("id", "check"):
        lines = [line for line in edited.splitlines() if f'"{name}":' not in line]
        path.write_text("\n".join(lines))
        with pytest.raises(CalibrationError, match='delete its lines "id" and "check"'):
            read_calibration(path)
    edited = "\n".join(line for line in lines if '"id":' not in line)
    path.write_text(edited)
    meant = read_calibration(path)
    assert meant.name == f"{CALIBRATION.name}, unproven"
    assert meant.get_tile_or_wildcard("T01").repeats == 5
    write_calibration(path, meant)  # what is carried on still says so
    assert read_calibration(path) == meant


def test_a_calibration_that_is_no_file_is_refused(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "circle").symlink_to("circle")
    for name in (".", "pipe", "circle", "none"):
        with pytest.raises(CalibrationError):
            read_calibration(tmp_path / name)


@pytest.fixture
def pressed(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Stands for the emulated bench, which takes seconds for a tile."""
    from service.offline import calibration_fit, simulation

    names: list[str] = []

    def of_serial(recordings: object, *, name: str, **how: object) -> Calibration:
        names.append(name)
        return CALIBRATION.model_copy(update={"tiles": (newton_tile(name[-3:]),)})

    monkeypatch.setattr(simulation, "run_simulation", lambda *_: None)
    monkeypatch.setattr(calibration_fit, "read_indentations", lambda _: {})
    monkeypatch.setattr(calibration_fit, "fit_calibration", of_serial)
    return names


def _without_hashes(path: Path, _: Random) -> None:
    lines = path.read_text().splitlines()
    path.write_text("\n".join(line for line in lines if not re.search('"(id|check)":', line)))


def _of_another_tile(path: Path, _: Random) -> None:
    write_calibration(path, CALIBRATION.model_copy(update={"tiles": (newton_tile("T07"),)}))


FILES = ("a bit flipped", "emptied", "replaced by a folder", "replaced by a link to nowhere")


@pytest.mark.parametrize(
    "damage", [_without_hashes, _of_another_tile, *(DAMAGES[name] for name in FILES)]
)
def test_a_cached_calibration_that_does_not_prove_itself_is_set_aside_and_made_anew(
    tmp_path: Path, pressed: list[str], damage: Damage
) -> None:
    said: list[str] = []

    def found() -> Calibration:
        return find_calibration(
            "emulated-rig", ["A01"], cache_folder=tmp_path / "cache", on_progress=said.append
        )

    first = found()
    assert found() == first
    assert pressed == ["emulated-rig-A01"]
    (kept,) = (tmp_path / "cache").iterdir()
    damage(kept, seeded())
    said.clear()
    assert found() == first
    assert pressed == ["emulated-rig-A01"] * 2
    assert "is left out" in said[0]
    assert f"set aside as {kept.name}.damaged-1" in said[0]
    assert {path.name for path in kept.parent.iterdir()} == {kept.name, f"{kept.name}.damaged-1"}
    assert found() == first
    assert len(pressed) == 2


def test_each_family_of_parts_and_each_repeatability_has_a_bench_of_its_own(
    tmp_path: Path, pressed: list[str]
) -> None:
    for _ in range(2):
        find_calibration("emulated-rig", ["A01"], cache_folder=tmp_path)
        find_calibration("emulated-rig", ["A01"], cache_folder=tmp_path, family="broad")
        find_calibration(
            "emulated-rig", ["A01"], cache_folder=tmp_path, family="broad", repeatability=0.01
        )
    assert pressed == ["emulated-rig-A01"] * 3


def test_a_cache_that_cannot_be_written_is_said_and_no_reason_to_fail(
    tmp_path: Path, pressed: list[str]
) -> None:
    (tmp_path / "file").touch()
    said: list[str] = []
    cache = tmp_path / "file" / "cache"
    for _ in range(2):
        find_calibration("emulated-rig", ["A01"], cache_folder=cache, on_progress=said.append)
    assert pressed == ["emulated-rig-A01"] * 2
    assert any("is not cached" in line for line in said)
