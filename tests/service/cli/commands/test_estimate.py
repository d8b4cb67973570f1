"""`foottile estimate` states its look-ahead, what it changes, and the file that it writes."""

from __future__ import annotations

from pathlib import Path

import pyarrow.parquet as pq
import pytest

from tests.service.cli.outcome import Run, scene_text, static_only

pytestmark = pytest.mark.slow


def test_another_look_ahead_is_stated_with_what_it_changes(run: Run) -> None:
    preset = 'calibration = "paper-eq2-shape"\n'
    Path("small.toml").write_text(preset + static_only(scene_text("rolling", 2)))
    made = ("--scene", "small.toml", "--seconds", 4)
    assert run("simulate", *made, "--out", "s.parquet").code == 0
    same = run("estimate", "s.parquet", "--out", "same.parquet", "--json").printed()["change"]
    outcome = run("estimate", "s.parquet", "--lag-ms", 0, "--out", "other")
    assert outcome.code == 0, outcome.err
    assert "look-ahead 0 ms (before: 100 ms)" in outcome.out
    assert "other.parquet: " in outcome.out
    assert same["lag_before_ms"] == 100.0
    assert (same["grf_most_n"], same["contact_frames"]) == (0.0, 0)
    other = run("estimate", "other.parquet", "--out", "again.parquet", "--json").printed()["change"]
    assert other["lag_before_ms"] == 0.0
    assert other["grf_rms_n"] > 0.0 or other["contact_frames"] > 0
    assert pq.read_metadata("other.parquet").num_rows == same["frames"]
