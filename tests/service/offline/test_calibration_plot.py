"""The picture of a calibration, and the fast loads that are replayed in it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from devices.scene.scene_file import load_scene, validate_scene
from service.estimation.calibration import Calibration
from service.estimation.fitting.effects_fit import (
    fit_determined_effects,
    simulate_release_and_tap_pressure,
)
from service.estimation.fitting.rig.indentation import Indentation
from service.offline.calibration_fit import fit_calibration, read_indentations
from service.offline.calibration_lookup import replace_tiles
from service.offline.simulation import SimulationOptions, run_simulation

pytestmark = pytest.mark.slow

Bench = tuple[Calibration, dict[str, list[Indentation]]]


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Bench:
    """One tile of the emulated bench."""
    path = Path(tmp_path_factory.mktemp("bench")) / "bench.parquet"
    scene = replace_tiles(load_scene("indentation"), ["T01"])
    quick = scene.model_dump() | {"ground": scene.ground.model_dump() | {"stroke_s": 2.0}}
    run_simulation(SimulationOptions(validate_scene(quick, where="quick")), path, None)
    pressed = read_indentations([path])
    calibration = fit_calibration(pressed, name="bench", reference_name="indenter")
    return calibration, {"T01": [one.indentation for one in pressed["T01"]]}


@pytest.mark.slow(parts=8)
def test_a_release_and_a_tap_are_replayed_better_with_effects_than_without(bench: Bench) -> None:
    calibration, recordings = bench
    found = simulate_release_and_tap_pressure(
        recordings["T01"], calibration.get_tile_or_wildcard("T01")
    )
    assert set(found) == {"release", "tap"}
    for replay in found.values():
        known = np.isfinite(replay.measured_kpa)
        with_effects, without = (
            np.sqrt(np.mean((modelled[known] - replay.measured_kpa[known]) ** 2))
            for modelled in (replay.modelled_kpa, replay.static_kpa)
        )
        assert with_effects < 0.25  # the noise of a reading is 0.165 kPa
        assert with_effects < without


def test_a_recording_without_fast_loads_has_nothing_to_replay(bench: Bench) -> None:
    calibration, recordings = bench
    (recording,) = recordings["T01"]
    slow = np.isin(recording.phase, ("rest", "load", "unload"))
    last = int(np.flatnonzero(~slow)[0])
    columns: dict[str, Any] = {
        n: v[:last] for n, v in vars(recording).items() if isinstance(v, np.ndarray)
    }
    only_slow = replace(recording, **columns)
    assert (
        simulate_release_and_tap_pressure([only_slow], calibration.get_tile_or_wildcard("T01"))
        == {}
    )


@pytest.mark.slow(parts=8)
def test_a_soak_in_a_file_of_its_own_tells_the_same_of_warmth(bench: Bench) -> None:
    calibration, (recording,) = bench[0], bench[1]["T01"]
    soaks = recording.phase == "soak"

    def part(rows: np.ndarray) -> Indentation:
        return Indentation(
            **{
                name: value[rows] if isinstance(value, np.ndarray) else value
                for name, value in vars(recording).items()
            },
        )

    tile = calibration.get_tile_or_wildcard("T01")
    without = fit_determined_effects([part(~soaks)], tile)
    assert without.temperature is None
    apart = fit_determined_effects([part(~soaks), part(soaks)], tile)
    assert apart.temperature is not None
    assert tile.effects.temperature is not None
    assert apart.temperature.kpa_per_k.value == pytest.approx(
        tile.effects.temperature.kpa_per_k.value, rel=1e-3
    )


@pytest.mark.parametrize("tiles", [1, 5])
def test_a_picture_holds_any_number_of_tiles(bench: Bench, tiles: int) -> None:
    pytest.importorskip("matplotlib", reason="pictures need the extra `plot`")
    from service.offline.calibration_plot import plot_calibration

    calibration, recordings = bench
    entry = calibration.get_tile_or_wildcard("T01")
    serials = [f"T{i:02}" for i in range(tiles)]
    many = calibration.model_copy(
        update={"tiles": tuple(entry.model_copy(update={"serial": s}) for s in serials)}
    )
    png = plot_calibration(many, dict.fromkeys(serials, recordings["T01"]))
    assert png.startswith(b"\x89PNG")
