"""`foottile estimate` states its look-ahead, what it changes, and the file that it writes."""

from __future__ import annotations

from pathlib import Path

import pyarrow.parquet as pq
import pytest

from storage.sessions.reader import SealedFileReader
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


def test_a_part_with_damaged_estimates_is_estimated_again(run: Run) -> None:
    preset = 'calibration = "paper-eq2-shape"\n'
    Path("small.toml").write_text(preset + static_only(scene_text("standing", 1)))
    assert run("simulate", "--scene", "small.toml", "--seconds", 3, "--out", "s.parquet").code == 0
    group = pq.read_metadata("s.parquet").row_group(0)
    (grf,) = (c for c in map(group.column, range(group.num_columns)) if c.path_in_schema == "grf_n")
    content = bytearray(Path("s.parquet").read_bytes())
    content[grf.data_page_offset + grf.total_compressed_size // 2] ^= 0xFF
    Path("s.parquet").write_bytes(content)
    outcome = run("estimate", "s.parquet", "--end-s", 2, "--out", "part.parquet", "--json")
    assert outcome.code == 0, outcome.err
    assert outcome.printed()["change"] is None
    with SealedFileReader(Path("part.parquet")) as part:
        assert part.has_columns("grf_n")
