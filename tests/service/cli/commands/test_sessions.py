"""`simulate`, `calibrate`, `estimate`: what is in a session, and what a second estimate says."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest

from devices.errors import CalibrationError
from service.offline.estimate import preparation
from service.offline.simulation import START_NS
from storage.schema import ESTIMATE_COLUMNS, MEASURED_COLUMNS, TRUTH_COLUMNS, Column
from storage.sessions.reader import SealedFileReader
from tests.service.cli.outcome import Run, Simulate, faulty, scene_text, short_rig, static_only
from tests.storage.faulty_disk import flip_bits

pytestmark = pytest.mark.slow

QUIET = """
[emulation]
noise_kpa = 0.0
gas = false
rubber = false
hysteresis = false
"""


ROLLING = ("rolling", "--seconds", 2, "--truth")


def test_the_same_seed_gives_the_same_bytes(run: Run, simulate: Simulate) -> None:
    rolling = simulate("kept.parquet", *ROLLING).read_bytes()
    for seed, is_same in ((0, True), (6, False)):
        run("simulate", "--scene", *ROLLING, "--seed", seed, "--out", "s.parquet").succeeds()
        assert (Path("s.parquet").read_bytes() == rolling) == is_same


@pytest.mark.parametrize(
    ("schedule", "limit_hz"),
    [("sequential", 132.45), ("simultaneous", 394.87), ("pipelined", 544.2)],
)
def test_frames_come_at_the_limit_of_the_bus(run: Run, schedule: str, limit_hz: float) -> None:
    outcome = run(
        *("simulate", "--scene", "standing", "--seconds", 2, "--schedule", schedule, "--json"),
        *("--no-estimates", "--out", "s.parquet"),
    )
    # hardware.md 4; measured conversion times are a little longer than true ones, and every second
    # one of them is tried anew.
    printed = outcome.printed()
    assert 0.98 * limit_hz < printed["rate_hz"] <= limit_hz
    assert (printed["flags"], printed["unmeasured"]) == ({}, [])
    t_ns = pq.read_table("s.parquet")["t_ns"].to_numpy()
    assert printed["frames"] == len(t_ns)
    assert np.median(np.diff(t_ns)) == pytest.approx(1e9 / limit_hz, rel=0.01)


@pytest.mark.parametrize(
    ("options", "groups"),
    [
        (("--truth",), (MEASURED_COLUMNS, ESTIMATE_COLUMNS, TRUTH_COLUMNS)),
        (("--no-estimates",), (MEASURED_COLUMNS,)),
    ],
    ids=["with estimates and truth", "raw"],
)
def test_a_session_has_the_columns_that_were_asked_for(
    simulate: Simulate, options: tuple[str, ...], groups: tuple[tuple[Column, ...], ...]
) -> None:
    names = pq.read_schema(simulate("s.parquet", "rolling", "--seconds", 2, *options)).names
    assert sorted(names) == sorted(
        flat for group in groups for column in group for flat in column.flat_names(4)
    )
    assert names[0] == "seq"
    # Estimates come behind raw columns.
    assert names.index("pressure_raw_0") < (names.index("gauge_kpa_0") if groups[1:] else 99)


@pytest.mark.slow(parts=8)
def test_a_quiet_dome_from_rig_to_estimate_gives_the_true_force(run: Run) -> None:
    Path("rig.toml").write_text(short_rig().split("[emulation]")[0] + QUIET)
    assert run("simulate", "--scene", "rig.toml", "--out", "rig.parquet").code == 0
    outcome = run("calibrate", "rig.parquet", "--out", "cal.json", "--json")
    assert min(tile["r2"] for tile in outcome.printed()["tiles"]) > 0.9999
    foot = static_only(scene_text("standing")) + QUIET
    Path("foot.toml").write_text(foot)
    options = ("--seconds", 5, "--truth", "--no-estimates", "--out", "s.parquet")
    run("simulate", "--scene", "foot.toml", *options)
    calibrated = ("--out", "e.parquet", "--calibration", "cal.json")
    accuracy = run("estimate", "s.parquet", *calibrated, "--json").printed()["accuracy"]
    assert accuracy["grf_mae_n"] < 0.15
    assert abs(accuracy["flight_mean_n"]) < 0.02
    assert accuracy["cop_p95_m"] < 0.0005


def test_measured_jumps_stay_within_the_papers_errors_and_omitted_models_are_named(
    run: Run, recording: Callable[[str], Path]
) -> None:
    jumps = ("--load", recording("squat_jump_plate1.csv"), "--load-scale", 0.03, "--cop-scale", 0.2)
    options = ("--truth", "--json", "--out", "s.parquet")
    whole = run("simulate", "--scene", "standing", *jumps, *options).printed()["accuracy"]
    assert whole["grf_mae_n"] < 1.0
    assert whole["cop_p95_m"] < 0.004
    assert whole["stances"] >= 3
    again = run("estimate", "s.parquet", "--out", "e.parquet", "--json").printed()
    assert (again["omitted_effects_n"], again["accuracy"]) == ({}, whole)
    few = ("estimate", "s.parquet", "--models", "unwrap,static,denoise", "--out", "e.parquet")
    bare = run(*few, "--json").printed()
    omitted_n = bare["omitted_effects_n"]
    assert {"rubber", "hysteresis"} <= set(omitted_n) <= {"gas", "rubber", "hysteresis"}
    remarks = run(*few).err
    for name, newtons in omitted_n.items():
        assert f"model {name!r} is inactive; it would change the GRF by {newtons:.2f} N" in remarks
    # Each is estimated beside all others, so together they exceed the gain.
    gained_n = bare["accuracy"]["grf_mae_n"] - whole["grf_mae_n"]
    assert 0.5 * gained_n < sum(omitted_n.values()) < 4.0 * gained_n


def test_measured_walking_is_pressed_cell_by_cell(
    run: Run, recording: Callable[[str], Path], tmp_path: Path
) -> None:
    run(
        *("simulate", "--scene", "insole", "--load", recording("insole_walk_left.csv")),
        *("--load-scale", 0.05, "--truth", "--no-estimates"),
        *("--seconds", 4, "--out", "walk.parquet"),
    ).succeeds()
    table = pq.read_table(tmp_path / "walk.parquet")
    t_ns = table["t_ns"].to_numpy() - START_NS
    t_s = t_ns * 1e-9 - 1.01  # lead, and the touch-down before row 1
    trace = np.genfromtxt(recording("insole_walk_left.csv"), delimiter=",", names=True)
    inside = (t_s > 0) & (t_s < trace["time_s"][-1])
    for cell in range(8):
        wanted = 0.05 * np.interp(t_s[inside], trace["time_s"], trace[f"cell{cell + 1}_N"])
        pressed = table[f"true_force_n_{cell}"].to_numpy()[inside]
        np.testing.assert_allclose(pressed, wanted, atol=1e-6)


def test_estimating_again_gives_the_bits_of_the_simulation(run: Run, simulate: Simulate) -> None:
    rolling = simulate("s.parquet", *ROLLING)
    assert run("estimate", rolling, "--out", "e.parquet").code == 0
    before, after = (pq.read_table(path) for path in (rolling, "e.parquet"))
    for name in before.column_names:
        assert before[name].equals(after[name]), name


def test_another_estimator_is_noted_in_its_file_until_the_models_estimate_again(run: Run) -> None:
    preset = 'calibration = "paper-eq2-shape"\n' + static_only(scene_text("standing"))
    Path("paper.toml").write_text(preset)
    run("simulate", "--scene", "paper.toml", "--seconds", 3, "--out", "s.parquet").succeeds()
    low_pass = ("--estimator", "low-pass", "--out", "low.parquet")
    printed = run("estimate", "s.parquet", *low_pass, "--json").printed()
    assert (printed["estimator"], printed["models"], printed["lag_ms"]) == (
        "low-pass",
        ["static"],
        0,
    )
    run("estimate", "low.parquet", "--out", "again.parquet").succeeds()
    notes = {}
    for name in ("s", "low", "again"):
        with SealedFileReader(Path(f"{name}.parquet")) as session:
            notes[name] = session.notes.get("estimator")
    assert notes == {"s": None, "low": "low-pass", "again": None}
    before, low, again = (pq.read_table(f"{name}.parquet")["grf_n"] for name in notes)
    assert before.equals(again)
    assert not before.equals(low)
    run("estimate", "s.parquet", *low_pass, "--models", "static").fails(2, "one or the other")


def test_an_assumed_scale_is_named_on_the_terminal_and_in_the_file(run: Run) -> None:
    Path("paper.toml").write_text(
        'calibration = "paper-eq2-shape"\n' + static_only(scene_text("standing"))
    )
    simulated = run("simulate", "--scene", "paper.toml", "--seconds", 2, "--out", "s.parquet")
    assert "scale of this calibration is assumed" in simulated.out
    estimated = run("estimate", "s.parquet", "--out", "e.parquet", "--json").printed()
    assert estimated["absolute_scale"] == "assumed"
    for name in ("s.parquet", "e.parquet"):
        table = pq.read_table(name)
        assert (table["estimate_flags"].to_numpy() & 64 == 64).all()
        assert json.loads(table.schema.metadata[b"foottile.notes"])["absolute_scale"] == "assumed"


def test_a_rate_beyond_the_bus_is_named_with_exit_code_3(run: Run, tmp_path: Path) -> None:
    text = scene_text("standing").replace('name = "standing"', 'name = "fast"\nrate_hz = 1000')
    (tmp_path / "fast.toml").write_text(text)
    outcome = run("simulate", "--scene", "fast.toml", "--seconds", 2, "--out", "s.parquet")
    assert outcome.code == 3
    assert "slots were missed" in outcome.out
    table = pq.read_table(tmp_path / "s.parquet")
    overrun = table["frame_flags"].to_numpy() & 1 == 1
    assert overrun.mean() > 0.5
    # Missed slots are no lost frames, and contact is seen.
    assert (table["estimate_flags"].to_numpy() & 8 == 0).mean() > 0.99
    assert table["contact"].to_numpy().max() == 1


def test_faults_of_tiles_are_counted_and_named_on_the_terminal(run: Run) -> None:
    faults = faulty("unplugged", tile="T02", t_s=0.5, duration_s=0.5)
    faults += faulty("stale", tile="T03", duration_s=0.5)
    Path("faulty.toml").write_text(scene_text("standing") + faults)
    arguments = ("simulate", "--scene", "faulty.toml", "--seconds", 1.5, "--no-estimates")
    text = run(*arguments).out
    assert "tile T02: of " in text
    assert "tile T03: conversion time not measurable; the longest is assumed" in text
    printed = run(*arguments, "--json").printed()
    assert printed["unmeasured"] == ["T03"]
    assert {"T02"} <= set(printed["flags"]) <= {"T02", "T03"}
    # Half a second, and until it is found again.
    assert 0.45 < printed["flags"]["T02"]["no_answer"] / printed["rate_hz"] < 0.9


# --- estimated again ------------------------------------------------------------------------------


def test_another_look_ahead_is_stated_with_what_it_changes(run: Run) -> None:
    preset = 'calibration = "paper-eq2-shape"\n'
    Path("small.toml").write_text(preset + static_only(scene_text("rolling", 2)))
    made = ("--scene", "small.toml", "--seconds", 4)
    assert run("simulate", *made, "--out", "s.parquet").code == 0
    same = run("estimate", "s.parquet", "--out", "same.parquet", "--json").printed()["change"]
    outcome = run("estimate", "s.parquet", "--lag-ms", 0, "--out", "other").succeeds()
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
    at = grf.data_page_offset + grf.total_compressed_size // 2
    flip_bits(Path("s.parquet"), at, 0xFF)
    outcome = run(
        "estimate", "s.parquet", "--end-s", 2, "--out", "part.parquet", "--json"
    ).succeeds()
    assert outcome.printed()["change"] is None
    with SealedFileReader(Path("part.parquet")) as part:
        assert part.has_columns("grf_n")


@pytest.mark.parametrize("family", ["default", "broad"])
def test_a_session_is_estimated_with_a_bench_of_its_own_family(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, family: str
) -> None:
    asked: list[Any] = []

    def no_bench(*_: object, **options: Any) -> object:
        asked.append((options["family"], options["parts_seed"]))
        raise CalibrationError("no bench here")

    monkeypatch.setattr(preparation, "find_calibration", no_bench)
    scene = tmp_path / "family.toml"
    scene.write_text(scene_text("standing") + f'\n[emulation]\nfamily = "{family}"\n')
    simulate = ("simulate", "--scene", scene, "--seconds", 0.5, "--parts-seed", 5)
    run(*simulate, "--no-estimates", "--out", "s.parquet").fails(0)
    again = ("estimate", "s.parquet", "--calibration", "emulated-rig", "--out", "e.parquet")
    run(*again).fails(1, "no bench here")
    assert asked == [(family, 5)]
