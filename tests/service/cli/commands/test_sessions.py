"""The main path: bench, session, estimate; and that it closes."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from service.offline.simulation import START_NS
from storage.schema import ESTIMATE_COLUMNS, MEASURED_COLUMNS, TRUTH_COLUMNS
from tests.service.cli.outcome import Run, faulty, scene_text, static_only

pytestmark = pytest.mark.slow

QUIET = """
[emulation]
noise_kpa = 0.0
gas = false
rubber = false
hysteresis = false
"""


def test_the_same_command_gives_the_same_bytes(run: Run, tmp_path: Path) -> None:
    simulate = ("simulate", "--scene", "rolling", "--seconds", 3, "--truth")
    for name, seed in (("a.parquet", 5), ("b.parquet", 5), ("c.parquet", 6)):
        outcome = run(*simulate, "--seed", seed, "--out", name)
        assert outcome.code == 0, outcome.err
    a, b, c = ((tmp_path / f"{name}.parquet").read_bytes() for name in "abc")
    assert a == b
    assert a != c


def test_a_fresh_bench_and_a_kept_one_give_the_same_bytes(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "one.toml").write_text(scene_text("standing", tiles=1))
    arguments = ("simulate", "--scene", "one.toml", "--seconds", 2, "--out")
    assert run(*arguments, "kept.parquet").code == 0
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "empty"))
    assert run(*arguments, "fresh.parquet").code == 0
    assert (tmp_path / "kept.parquet").read_bytes() == (tmp_path / "fresh.parquet").read_bytes()


@pytest.mark.parametrize(
    ("schedule", "limit_hz"),
    [("sequential", 132.45), ("simultaneous", 394.87), ("pipelined", 544.2)],
)
def test_frames_come_at_the_limit_of_the_bus(
    run: Run, tmp_path: Path, schedule: str, limit_hz: float
) -> None:
    outcome = run(
        *("simulate", "--scene", "standing", "--seconds", 4, "--schedule", schedule, "--json"),
        *("--out", "s.parquet"),
    )
    assert outcome.code == 0, outcome.err
    # hardware.md 4; measured conversion times are a little longer than true ones, and every second
    # one of them is tried anew.
    assert 0.98 * limit_hz < json.loads(outcome.out)["rate_hz"] <= limit_hz
    t_ns = pq.read_table(tmp_path / "s.parquet")["t_ns"].to_numpy()
    assert np.median(np.diff(t_ns)) == pytest.approx(1e9 / limit_hz, rel=0.01)


def test_a_session_has_raw_columns_then_estimates_then_truth(run: Run, tmp_path: Path) -> None:
    run("simulate", "--scene", "standing", "--seconds", 2, "--truth", "--out", "s.parquet")
    names = pq.read_schema(tmp_path / "s.parquet").names
    expected = [
        flat
        for c in (*MEASURED_COLUMNS, *ESTIMATE_COLUMNS, *TRUTH_COLUMNS)
        for flat in c.flat_names(4)
    ]
    assert sorted(names) == sorted(expected)
    assert names[0] == "seq"
    assert names.index("pressure_raw_0") < names.index("gauge_kpa_0")


def test_no_estimates_leaves_raw_frames_only(run: Run, tmp_path: Path) -> None:
    run("simulate", "--scene", "standing", "--seconds", 2, "--no-estimates", "--out", "s.parquet")
    names = pq.read_schema(tmp_path / "s.parquet").names
    assert sorted(names) == sorted(flat for c in MEASURED_COLUMNS for flat in c.flat_names(4))


def test_bench_to_session_to_estimate_closes_on_a_quiet_dome(run: Run, tmp_path: Path) -> None:
    bench = scene_text("indentation").split("[emulation]")[0] + QUIET
    bench = bench.replace('"indentation"\n[', '"indentation"\nrepeats = 2\nstroke_s = 1.5\n[')
    (tmp_path / "bench.toml").write_text(bench)
    assert run("simulate", "--scene", "bench.toml", "--out", "bench.parquet").code == 0
    outcome = run("calibrate", "bench.parquet", "--out", "cal.json", "--json")
    assert min(tile["r2"] for tile in outcome.printed()["tiles"]) > 0.9999
    (tmp_path / "foot.toml").write_text(static_only(scene_text("standing")) + QUIET)
    options = ("--seconds", 5, "--truth", "--no-estimates", "--out", "s.parquet")
    run("simulate", "--scene", "foot.toml", *options)
    outcome = run(
        "estimate", "s.parquet", "--out", "e.parquet", "--calibration", "cal.json", "--json"
    )
    accuracy = outcome.printed()["accuracy"]
    assert accuracy["grf_mae_n"] < 0.15
    assert abs(accuracy["flight_mean_n"]) < 0.02
    assert accuracy["cop_p95_m"] < 0.0005


def test_measured_jumps_through_all_effects_stay_within_the_papers_errors(
    run: Run, recording: Callable[[str], Path]
) -> None:
    outcome = run(
        *("simulate", "--scene", "standing", "--truth", "--json"),
        *("--load", recording("squat_jump_plate1.csv"), "--load-scale", 0.03, "--cop-scale", 0.2),
    )
    accuracy = outcome.printed()["accuracy"]
    assert accuracy["grf_mae_n"] < 1.0
    assert accuracy["cop_p95_m"] < 0.004
    assert accuracy["stances"] >= 3


def test_measured_walking_is_pressed_cell_by_cell(
    run: Run, recording: Callable[[str], Path], tmp_path: Path
) -> None:
    outcome = run(
        *("simulate", "--scene", "insole", "--load", recording("insole_walk_left.csv")),
        *("--load-scale", 0.05, "--truth", "--no-estimates"),
        *("--seconds", 6, "--out", "walk.parquet"),
    )
    assert outcome.code == 0, outcome.err
    table = pq.read_table(tmp_path / "walk.parquet")
    t_ns = table["t_ns"].to_numpy() - START_NS
    t_s = t_ns * 1e-9 - 1.01  # lead, and the touch-down before row 1
    trace = np.genfromtxt(recording("insole_walk_left.csv"), delimiter=",", names=True)
    inside = (t_s > 0) & (t_s < trace["time_s"][-1])
    for cell in range(8):
        wanted = 0.05 * np.interp(t_s[inside], trace["time_s"], trace[f"cell{cell + 1}_N"])
        pressed = table[f"true_force_n_{cell}"].to_numpy()[inside]
        np.testing.assert_allclose(pressed, wanted, atol=1e-6)


def test_estimate_says_which_models_a_recording_asks_for_and_what_they_are_good_for(
    run: Run, recording: Callable[[str], Path]
) -> None:
    jumps = ("--load", recording("squat_jump_plate1.csv"), "--load-scale", 0.03, "--cop-scale", 0.2)
    run("simulate", "--scene", "standing", *jumps, "--truth", "--out", "s.parquet")
    whole = run("estimate", "s.parquet", "--out", "e.parquet", "--json").printed()
    assert whole["omitted_effects_n"] == {}
    few = ("estimate", "s.parquet", "--models", "unwrap,static,denoise", "--out", "e.parquet")
    bare = run(*few, "--json").printed()
    assert (
        {"rubber", "hysteresis"}
        <= set(bare["omitted_effects_n"])
        <= {"gas", "rubber", "hysteresis"}
    )
    said = run(*few).err
    for name, newtons in bare["omitted_effects_n"].items():
        assert f"model {name!r} is inactive; it would change the GRF by {newtons:.2f} N" in said
    # Each is expected beside all others, so together they are more than what is gained.
    gained_n = bare["accuracy"]["grf_mae_n"] - whole["accuracy"]["grf_mae_n"]
    assert 0.5 * gained_n < sum(bare["omitted_effects_n"].values()) < 4.0 * gained_n


def test_estimating_anew_gives_the_bits_of_the_simulation(run: Run, tmp_path: Path) -> None:
    run("simulate", "--scene", "rolling", "--seconds", 4, "--out", "s.parquet")
    assert run("estimate", "s.parquet", "--out", "e.parquet").code == 0
    before, after = (pq.read_table(tmp_path / name) for name in ("s.parquet", "e.parquet"))
    for name in before.column_names:
        assert before[name].equals(after[name]), name


def test_an_assumed_scale_is_said_on_the_terminal_and_in_the_file(run: Run, tmp_path: Path) -> None:
    run("simulate", "--scene", "standing", "--seconds", 2, "--no-estimates", "--out", "s.parquet")
    paper = ("--calibration", "paper-eq2-shape", "--models", "unwrap,static")
    outcome = run("estimate", "s.parquet", "--out", "e.parquet", *paper)
    assert outcome.code == 0, outcome.err
    assert "assumed" in outcome.out
    table = pq.read_table(tmp_path / "e.parquet")
    assert (table["estimate_flags"].to_numpy() & 64 == 64).all()
    assert json.loads(table.schema.metadata[b"foottile.notes"])["absolute_scale"] == "assumed"


def test_a_fault_of_the_scene_is_null_and_flagged_while_the_others_go_on(
    run: Run, tmp_path: Path
) -> None:
    fault = faulty("no_answer", tile="T02", t_s=1.5, duration_s=0.5)
    (tmp_path / "faulty.toml").write_text(scene_text("standing") + fault)
    outcome = run("simulate", "--scene", "faulty.toml", "--seconds", 3, "--out", "s.parquet")
    assert outcome.code == 0, outcome.err
    table = pq.read_table(tmp_path / "s.parquet")
    silent = table["tile_flags_1"].to_numpy() & 1 == 1
    assert 0.4 < silent.mean() * 3 < 0.6
    assert table["pressure_raw_1"].null_count == silent.sum()
    assert table["grf_n"].null_count == silent.sum()
    assert table["pressure_raw_0"].null_count == table["force_n_0"].null_count == 0
    assert (table["estimate_flags"].to_numpy()[silent] & 32 == 32).all()


def test_a_tile_pressed_until_its_count_wraps_is_a_lower_bound_and_no_light_touch(
    run: Run, tmp_path: Path
) -> None:
    (tmp_path / "foot.toml").write_text(scene_text("standing").replace("T01", "T09"))
    rows = "".join(f"{0.01 * i:.2f},110,5,5,5\n" for i in range(100))
    (tmp_path / "load.csv").write_text("time_s,cell1_n,cell2_n,cell3_n,cell4_n\n" + rows)
    simulate = ("simulate", "--scene", "foot.toml", "--load", "load.csv", "--out", "s.parquet")
    assert run(*simulate, "--truth").code == 0
    table = pq.read_table(tmp_path / "s.parquet")
    pressed = table["true_force_n_0"].to_numpy() == 110.0
    wrapped = pressed & (table["pressure_raw_0"].to_numpy() > 900)
    assert wrapped.sum() > 100
    assert (table["tile_flags_0"].to_numpy()[wrapped] & 16 == 16).all()
    assert (table["estimate_flags"].to_numpy()[pressed] & 1 == 1).all()
    assert (table["force_n_0"].to_numpy()[pressed] > 15.0).all()  # as creep may have left it
    assert np.isnan(table["force_sigma_n_0"].to_numpy()[pressed]).all()
    # Without the model it is no force at all.
    outcome = run("estimate", "s.parquet", "--models", "static", "--out", "e.parquet")
    assert outcome.code == 0, outcome.err
    assert np.isnan(pq.read_table(tmp_path / "e.parquet")["force_n_0"].to_numpy()[wrapped]).all()


def test_a_rate_that_the_bus_cannot_keep_is_said_and_gives_exit_code_3(
    run: Run, tmp_path: Path
) -> None:
    text = scene_text("standing").replace('name = "standing"', 'name = "fast"\nrate_hz = 1000')
    (tmp_path / "fast.toml").write_text(text)
    outcome = run("simulate", "--scene", "fast.toml", "--seconds", 3, "--out", "s.parquet")
    assert outcome.code == 3
    assert "slots were missed" in outcome.out
    table = pq.read_table(tmp_path / "s.parquet")
    overrun = table["frame_flags"].to_numpy() & 1 == 1
    assert overrun.mean() > 0.5
    # What is lost is lost at the sensor: no frame is taken to be missing, and contact is seen.
    assert (table["estimate_flags"].to_numpy() & 8 == 0).mean() > 0.99
    assert table["contact"].to_numpy().max() == 1


def test_json_is_on_stdout_alone(run: Run) -> None:
    outcome = run("simulate", "--scene", "standing", "--seconds", 2, "--json")
    assert json.loads(outcome.out)["frames"] > 700


def test_calibrate_prints_the_contract_and_draws(run: Run, tmp_path: Path, bench: bytes) -> None:
    (tmp_path / "bench.parquet").write_bytes(bench)
    outcome = run("calibrate", "bench.parquet", "--out", "cal.json", "--plot", "cal.png", "--json")
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
    assert json.loads((tmp_path / "cal.json").read_text())["id"] == printed["id"]
    assert (tmp_path / "cal.png").read_bytes().startswith(b"\x89PNG")


def test_what_befell_a_tile_is_said_on_the_terminal(run: Run, tmp_path: Path) -> None:
    fault = faulty("unplugged", tile="T02", t_s=0.5, duration_s=0.5)
    (tmp_path / "faulty.toml").write_text(scene_text("standing") + fault)
    arguments = ("simulate", "--scene", "faulty.toml", "--seconds", 2, "--no-estimates")
    assert "tile T02: of " in run(*arguments).out
    flags = json.loads(run(*arguments, "--json").out)["flags"]
    assert list(flags) == ["T02"]
    # Half a second at 540 frames a second, and until it is found again.
    assert 250 < flags["T02"]["no_answer"] < 500


def test_a_part_that_could_not_be_measured_is_said_on_the_terminal(
    run: Run, tmp_path: Path
) -> None:
    fault = faulty("stale", tile="T03", t_s=0.0, duration_s=0.5)
    (tmp_path / "faulty.toml").write_text(scene_text("standing") + fault)
    arguments = ("simulate", "--scene", "faulty.toml", "--seconds", 1, "--no-estimates")
    said = "tile T03: conversion time not measurable; 3 ms assumed"
    assert said in run(*arguments).out
    assert json.loads(run(*arguments, "--json").out)["unmeasured"] == ["T03"]
    healthy = run("simulate", "--scene", "standing", "--seconds", 1, "--no-estimates", "--json")
    assert json.loads(healthy.out)["unmeasured"] == []
