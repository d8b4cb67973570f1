"""Wrong scenes, loads and options: a clear line, the right exit code, no file."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from tests.builders.calibrations import make_calibration
from tests.service.cli.outcome import Run, Simulate, scene_text, static_only

STANDING = static_only(scene_text("standing"))
GOOD_TRACE = "time_s,fz_n,cop_x_m,cop_y_m\n" + "".join(
    f"{0.01 * i:.2f},{10 + i},0.0,0.0\n" for i in range(50)
)


def left(folder: Path, *given: str) -> list[str]:
    """Return the names in a folder without those that the test put there."""
    return sorted(path.name for path in folder.iterdir() if path.name not in given)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (("conversion_ms =", "conversoin_ms ="), ["array.conversoin_ms", "spelling"]),
        (('serial = "T01"', "serial = 1"), ["tile.0.serial"]),
        (("conversion_ms = 1.6", 'conversion_ms = "1.6"'), ["array.conversion_ms", "'1.6'"]),
        (("channel = 1", "channel = 0"), ["0x70", "channel 0", "two tiles"]),
        (('serial = "T02"', 'serial = "T01"'), ["T01", "twice"]),
        (("x_m = -0.021", "x_m = -21.0"), ["tile.0.x_m", "-21"]),
        (('kind = "plate"', 'kind = "plates"'), ["ground", "plate"]),
        (("[array]", "[array"), ["not TOML"]),
        (('models = ["unwrap", "static"]', 'models = ["unwrap"]'), ["static"]),
        (('models = ["unwrap", "static"]', 'models = ["static", "magic"]'), ["magic", "unwrap"]),
        (('name = "standing"', 'name = "standing"\ncalibration = "gone.json"'), ["gone.json"]),
    ],
)
def test_a_wrong_scene_names_the_key(
    run: Run, tmp_path: Path, change: tuple[str, str], says: list[str]
) -> None:
    assert change[0] in STANDING
    (tmp_path / "scene.toml").write_text(STANDING.replace(*change, 1))
    outcome = run("simulate", "--scene", "scene.toml", "--seconds", 2, "--out", "s.parquet")
    assert outcome.code in (1, 2)
    assert outcome.err.startswith("foottile: ")
    assert "Traceback" not in outcome.err
    for word in says:
        assert word in outcome.err
    assert left(tmp_path, "scene.toml") == []


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (GOOD_TRACE.replace("time_s", "time_ms"), ["time_s", "time_ms"]),
        (GOOD_TRACE.replace("fz_n", "fz_kn"), ["fz_n", "fz_kn"]),
        (GOOD_TRACE.replace("0.20,", "0.10,"), ["row 21", "rise"]),
        (GOOD_TRACE.replace("0.20,30,", "0.20,nan,"), ["fz_n", "row 21"]),
        (GOOD_TRACE.replace("0.20,30,", "0.20,,"), ["fz_n", "row 21"]),
        (GOOD_TRACE.replace("0.20,30,0.0,0.0", "0.20,30,,"), ["row 21", "centre of pressure"]),
        (GOOD_TRACE.replace("0.20,30,", "0.20,much,"), ["fz_n"]),
        ("time_s,cell1_n,cell2_n\n0,1,1\n1,1,1\n", ["2 cell columns", "4 tiles"]),
        ("", ["cannot be read"]),
        ("\x00\xff\x00", ["cannot be read", "expected"]),
    ],
)
def test_a_wrong_load_trace_names_the_place(
    run: Run, tmp_path: Path, text: str, says: list[str]
) -> None:
    (tmp_path / "load.csv").write_bytes(text.encode("latin-1"))
    outcome = run("simulate", "--scene", "standing", "--load", "load.csv", "--out", "s.parquet")
    outcome.fails(1, "load.csv")
    for word in says:
        assert word in outcome.err
    assert left(tmp_path, "load.csv") == []


@pytest.mark.parametrize(
    ("arguments", "code", "says"),
    [
        (["--scene", "nowhere"], 2, ["nowhere", "standing"]),
        (["--scene", "insole"], 2, ["--load"]),
        (["--scene", "standing"], 2, ["--seconds"]),
        (["--scene", "standing", "--seconds", "-1"], 2, ["--seconds"]),
        (["--scene", "standing", "--seconds", "nan"], 2, ["--seconds"]),
        (["--scene", "standing", "--seconds", "2", "--schedule", "fast"], 2, ["simultaneous"]),
        (["--scene", "standing", "--seconds", "2", "--tiles", "T01"], 2, ["--tiles"]),
        (["--scene", "standing", "--load", "gone.csv"], 1, ["gone.csv"]),
        (["--scene", "standing", "--load", "gone.csv", "--decimal", ";"], 2, ["--decimal"]),
        (["--scene", "standing", "--seconds", "2", "--skip-rows", "1"], 2, ["--load"]),
        (["--scene", "standing", "--seconds", "2", "--map", "grf_n=Fz"], 2, ["--load"]),
        (["--scene", "standing", "--seconds", "2", "--out", "gone/s.parquet"], 2, ["gone"]),
        (["--scene", "standing", "--seconds", "2", "--cop-offset-m", "1"], 2, ["--cop-offset-m"]),
        (["--scene", "standing", "--seconds", "0.02"], 1, ["T01", "20"]),
    ],
)
def test_simulate_refuses(
    run: Run, tmp_path: Path, arguments: list[object], code: int, says: list[str]
) -> None:
    run("simulate", *arguments).fails(code, *says)
    assert left(tmp_path) == []


def test_an_axis_name_that_is_none_is_refused(run: Run, tmp_path: Path) -> None:
    (tmp_path / "load.csv").write_text(GOOD_TRACE)
    outcome = run("simulate", "--scene", "standing", "--load", "load.csv", "--cop-axes", "xx")
    outcome.fails(2, "--cop-axes")


@pytest.fixture
def session(simulate: Simulate) -> Path:
    return simulate("s.parquet", "standing", "--seconds", 2, "--no-estimates")


@pytest.mark.parametrize(
    ("arguments", "code", "says"),
    [
        ([], 1, ["--calibration"]),
        (["--calibration", "gone.json"], 1, ["gone.json", "paper-eq2-shape"]),
        (["--calibration", "other.json"], 1, ["T01", "T09", "foottile calibrate"]),
        (["--calibration", "broken.json"], 1, ["broken.json"]),
        (["--calibration", "paper-eq2-shape", "--models", "magic"], 2, ["magic"]),
        (["--calibration", "paper-eq2-shape", "--lag-ms", "-1"], 2, ["look-ahead"]),
        (["--calibration", "paper-eq2-shape", "--tare-s", "1"], 2, ["--tare-s"]),
        (
            ["--calibration", "paper-eq2-shape", "--models", "static", "--tare-s", "5,6"],
            1,
            ["T01", "--tare-s"],
        ),
        (["--calibration", "paper-eq2-shape"], 1, ["'gas'", "Leave the model out"]),
        (["--calibration", "paper-eq2-shape", "--tare-s", "1,0"], 2, ["--tare-s"]),
        (
            ["--scene", "rolling", "--calibration", "paper-eq2-shape", "--scene", "insole"],
            2,
            ["T08"],
        ),
    ],
)
def test_estimate_refuses(
    run: Run, tmp_path: Path, session: Path, arguments: list[object], code: int, says: list[str]
) -> None:
    other = make_calibration("T09").to_json()
    (tmp_path / "other.json").write_text(other)
    (tmp_path / "broken.json").write_text(other.replace("by hand", "by foot"))
    run("estimate", session, "--out", "e.parquet", *arguments).fails(code, *says)
    assert left(tmp_path, "s.parquet", "other.json", "broken.json") == []


def test_estimate_refuses_a_file_that_is_no_session(run: Run, tmp_path: Path) -> None:
    (tmp_path / "x.parquet").write_bytes(b"PAR1 not really PAR1")
    for name in ("x.parquet", "gone.parquet"):
        run("estimate", name, "--out", "e.parquet").fails(1, name)
    assert left(tmp_path, "x.parquet") == []


def test_calibrate_refuses_a_session_that_is_no_indentation(
    run: Run, tmp_path: Path, session: Path
) -> None:
    run("calibrate", session, "--out", "cal.json").fails(1, "not an indentation")
    assert left(tmp_path, "s.parquet") == []


def test_a_full_disk_is_an_error_and_leaves_nothing(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    simulate = ("simulate", "--scene", "standing", "--seconds", 0.2, "--no-estimates")
    run(*simulate, "--out", "s.parquet").fails(1, "No space left")
    assert left(tmp_path) == []


def test_a_tare_under_load_is_refused(run: Run, simulate: Simulate, tmp_path: Path) -> None:
    loaded = simulate("s.parquet", "standing", "--seconds", 4)
    run("estimate", loaded, "--tare-s", "2,3", "--out", "e.parquet").fails(1, "seems to be loaded")
    assert left(tmp_path, "s.parquet") == []


def test_no_output_takes_the_place_of_an_input_or_a_device(run: Run, tmp_path: Path) -> None:
    (tmp_path / "foot.toml").write_text(STANDING)
    (tmp_path / "load.csv").write_text(GOOD_TRACE)
    (tmp_path / "folder").mkdir()
    simulate = ("simulate", "--scene", "foot.toml", "--load", "load.csv", "--out")
    for target in ("foot.toml", "load.csv", "folder"):
        outcome = run(*simulate, target)
        assert outcome.code == 2, target
    os.mkfifo(tmp_path / "pipe")
    assert run(*simulate, "pipe").code == 2
    assert (tmp_path / "foot.toml").read_text() == STANDING
    assert (tmp_path / "load.csv").read_text() == GOOD_TRACE


def test_an_output_through_a_link_lands_where_the_link_points(run: Run, tmp_path: Path) -> None:
    (tmp_path / "real.parquet").write_bytes(b"")
    (tmp_path / "link.parquet").symlink_to("real.parquet")
    simulate = ("simulate", "--scene", "standing", "--seconds", 2, "--no-estimates", "--out")
    assert run(*simulate, "link.parquet").code == 0
    assert (tmp_path / "link.parquet").is_symlink()
    assert (tmp_path / "real.parquet").stat().st_size > 1000


@pytest.mark.parametrize("tiles", ["", "T01,T01", "../x"])
def test_a_wrong_list_of_tiles_is_refused(run: Run, tmp_path: Path, tiles: str) -> None:
    outcome = run("simulate", "--scene", "indentation", "--tiles", tiles)
    assert outcome.code == 2
    assert outcome.err.startswith("foottile: ")
    assert left(tmp_path) == []
