"""`foottile calibrate`: the printed figures, several files, and refusals."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from devices.flags import EstimateFlag, TileFlag
from tests.service.cli.outcome import Run, Simulate, short_rig
from tests.storage.sessions.session_files import rewritten

pytestmark = pytest.mark.slow


@pytest.mark.slow(parts=8)
def test_several_files_of_a_tile_are_merged_in_a_table_for_a_narrow_terminal(
    run: Run, simulate: Simulate, monkeypatch: pytest.MonkeyPatch
) -> None:
    for seed in (1, 2):
        simulate(f"{seed}.parquet", short_rig(), "--tiles", "T01", "--seed", seed)
    monkeypatch.setenv("COLUMNS", "80")
    reference = "load cell [/dev/ttyUSB0]"
    options = ("--out", "cal.json", "--sensor", reference)
    outcome = run("calibrate", "1.parquet", "2.parquet", *options).succeeds()
    assert "4 in 2" in outcome.out
    assert reference in outcome.out, "brackets are no markup"
    assert "…" not in outcome.out
    assert max(len(line) for line in outcome.out.splitlines()) <= 80


@pytest.mark.slow(parts=8)
def test_files_that_do_not_go_together_are_refused(run: Run, simulate: Simulate) -> None:
    first = simulate("1.parquet", short_rig(), "--tiles", "T01", "--seed", 1)
    simulate("again.parquet", short_rig(), "--tiles", "T01", "--seed", 1)
    parts = ("--tiles", "T01", "--parts-seed", 9, "--seconds", 3)
    simulate("parts.parquet", short_rig(), *parts)
    for other, words in (
        ("again.parquet", ("the same frames occur twice", "T01", "1.parquet", "again.parquet")),
        ("parts.parquet", ("tile T01 has another chip",)),
    ):
        run("calibrate", first, other, "--out", "cal.json").fails(1, *words)
        assert not Path("cal.json").exists()
    simulate(
        "light.parquet", short_rig().replace("repeats", "load_n = 0.2\nrepeats"), "--tiles", "T01"
    )
    light = run("calibrate", "light.parquet", "--out", "cal.json", "--plot", "cal.png")
    light.fails(1, "never loads the tile", "T01")
    assert not [*Path().glob("cal.*")]


@pytest.mark.slow(parts=8)
def test_a_tile_without_a_curve_is_named_and_the_others_are_written(run: Run, bench: Path) -> None:
    table = pq.read_table(bench)
    force = table["reference_force_n"].to_numpy().copy()
    second = np.array([name == "T02" for name in table["pressed_tile"].to_pylist()])
    force[second] = np.minimum(force[second], 10.0)
    column = table.schema.get_field_index("reference_force_n")
    field = table.schema.field(column)
    table = table.set_column(column, field, pa.array(force, field.type))
    rewritten(Path("limited.parquet"), table)
    outcome = run("calibrate", "limited.parquet", "--out", "cal.json", "--json")
    printed = outcome.printed(3)
    assert [tile["serial"] for tile in printed["tiles"]] == ["T01"]
    assert "saturated" in printed["refused"]["T02"]
    assert "tile T02 refused" in outcome.err
    estimate = run("estimate", bench, "--out", "e.parquet", "--calibration", "cal.json")
    estimate.fails(1, "it covers T01, but not T02; T02 was refused: ")


@pytest.mark.slow(parts=8)
def test_calibrate_prints_each_tiles_fit_and_draws_it(run: Run, bench: Path) -> None:
    outcome = run("calibrate", bench, "--out", "cal.json", "--plot", "cal.png", "--json")
    printed = outcome.printed()
    assert [tile["serial"] for tile in printed["tiles"]] == ["T01", "T02"]
    tile = printed["tiles"][0]
    assert set(tile) >= {
        *("serial", "r2", "rmse_n", "cv_rmse_n", "hysteresis_n", "range_kpa"),
        *("monotonic", "coefficients"),
    }
    assert tile["rig"]["ended_by"] == "load"
    assert tile["absolute_scale"] == "measured"
    low_ms, high_ms = tile["effects"]["gas_tau_ms"]["interval_95"]
    assert low_ms < tile["effects"]["gas_tau_ms"]["value"] < high_ms
    assert printed["refused"] == {}
    assert json.loads(Path("cal.json").read_text())["id"] == printed["id"]
    assert Path("cal.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.slow(parts=8)
def test_a_curve_reaches_the_end_of_a_wider_chip_and_flags_tell_what_is_beyond(
    run: Run, simulate: Simulate
) -> None:
    harder = short_rig().replace("repeats", "load_n = 120\nrepeats").replace("30.303", "84.0")
    rig = simulate("rig.parquet", harder, "--tiles", "T01", "--chip", "bmp581")
    (tile,) = run("calibrate", rig, "--out", "cal.json", "--json").printed()["tiles"]
    assert tile["rig"]["end_absolute_kpa"] > 125.0
    assert tile["noise_kpa"] < 0.002
    run("estimate", rig, "--out", "e.parquet", "--calibration", "cal.json").succeeds()
    frames = pq.read_table("e.parquet")
    kpa = frames["pressure_raw_0"].to_numpy() / 64_000
    is_over = (frames["tile_flags_0"].to_numpy() & TileFlag.OVER_RANGE) != 0
    assert (is_over == (kpa > 125.0)).all()
    beyond = EstimateFlag.OVER_RATED | EstimateFlag.SATURATED
    assert (frames["estimate_flags"].to_numpy()[kpa > 125.1] & beyond != 0).all()
    assert np.isfinite(frames["force_n_0"].to_numpy()[kpa < 125.0]).all()
