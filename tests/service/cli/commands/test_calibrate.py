"""`foottile calibrate`: several files, refusals, and the marker of an assumed scale."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from tests.service.cli.outcome import Run, scene_text, static_only
from tests.storage.sessions.session_files import rewritten

pytestmark = pytest.mark.slow


def test_calibrate_merges_files_and_its_tables_fit_a_narrow_terminal(
    run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    short = scene_text("indentation").replace(
        'kind = "indentation"', 'kind = "indentation"\nrepeats = 2\nstroke_s = 1.5'
    )
    Path("short.toml").write_text(short)
    for seed in (1, 2):
        out = f"{seed}.parquet"
        run("simulate", "--scene", "short.toml", "--tiles", "T01", "--seed", seed, "--out", out)
    monkeypatch.setenv("COLUMNS", "80")
    outcome = run("calibrate", "1.parquet", "2.parquet", "--out", "cal.json")
    assert outcome.code == 0, outcome.err
    assert "4 in 2" in outcome.out
    assert "…" not in outcome.out
    assert max(len(line) for line in outcome.out.splitlines()) <= 80
    twice = run("calibrate", "1.parquet", "1.parquet", "--out", "twice.json")
    twice.fails(1, "the same frames occur twice")
    parts = ("--parts-seed", 9, "--seconds", 3, "--out", "parts.parquet")
    run("simulate", "--scene", "short.toml", "--tiles", "T01", *parts)
    other = run("calibrate", "1.parquet", "parts.parquet", "--out", "other.json")
    other.fails(1, "tile T01 has another chip")
    assert not Path("other.json").exists()


def test_a_tile_without_a_curve_is_named_and_the_others_are_written(run: Run, bench: bytes) -> None:
    Path("bench.parquet").write_bytes(bench)
    table = pq.read_table("bench.parquet")
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
    estimate = run("estimate", "bench.parquet", "--out", "e.parquet", "--calibration", "cal.json")
    estimate.fails(1, "it covers T01, but not T02; T02 was refused: ")


def test_an_assumed_scale_is_said_in_text_json_and_file(run: Run) -> None:
    scene = 'calibration = "paper-eq2-shape"\n' + static_only(scene_text("standing"))
    Path("paper.toml").write_text(scene)
    arguments = ("simulate", "--scene", "paper.toml", "--seconds", 1, "--out", "paper.parquet")
    assert "scale of this calibration is assumed" in run(*arguments).out
    assert json.loads(run(*arguments, "--json").out)["absolute_scale"] == "assumed"
    table = pq.read_table("paper.parquet")
    assert json.loads(table.schema.metadata[b"foottile.notes"])["absolute_scale"] == "assumed"
    assert (table["estimate_flags"].to_numpy() & 64 == 64).all()
