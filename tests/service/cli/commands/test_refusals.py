"""What no command does: wrong requests, half a file on a full disk, an output over an input.

Each is refused with a reason, the right exit code, and no file changed.
"""

from __future__ import annotations

import os
import shlex
from pathlib import Path
from typing import Any

import pytest

from tests.builders.calibrations import make_calibration
from tests.service.cli.outcome import Run, Simulate, scene_text, static_only
from tests.storage.faulty_disk import NO_SPACE, refusing

STANDING = static_only(scene_text("standing"))
GOOD_TRACE = "time_s,fz_n,cop_x_m,cop_y_m\n" + "".join(
    f"{0.01 * i:.2f},{10 + i},0.0,0.0\n" for i in range(50)
)
LONE = "there is no session in these places, but files by themselves: a.parquet and 1 more"
PRESET = "--calibration paper-eq2-shape"
ESTIMATE = "estimate s.parquet --out e.parquet"
MANY = "estimate 'lone/*.parquet' --out o"
UNNAMED = "session and reference are not named, or twice"
STAND = "simulate --scene standing"
WEIGH = "calibrate --out cal.json"
OF_A_PLATE = ("--per-tile", "--shear", "--map grf_n=Fz", "--reference-gain-sigma 0.1")
REFUSED: tuple[tuple[str | int, ...], ...] = (
    (f"{STAND} --out s2.parquet", 2, "--seconds"),
    ("simulate --scene nowhere", 2, "nowhere", "standing"),
    ("simulate --scene insole", 2, "--load"),
    ("simulate --scene wrong.toml --seconds 2", 2, "array.conversoin_ms", "spelling"),
    ("simulate --scene gone.toml --seconds 2 --out s2.parquet", 1, "gone.json"),
    ("simulate --scene bare.toml --seconds 2 --out s2.parquet", 2, "static"),
    ("simulate --scene magic.toml --seconds 2 --out s2.parquet", 2, "magic", "unwrap"),
    (f"{STAND} --seconds -1", 2, "--seconds"),
    (f"{STAND} --seconds nan", 2, "--seconds"),
    (f"{STAND} --seconds 0.02", 1, "T01", "20"),
    (f"{STAND} --seconds 2 --schedule fast", 2, "simultaneous"),
    (f"{STAND} --seconds 2 --tiles T01", 2, "--tiles"),
    (f"{STAND} --seconds 2 --skip-rows 1", 2, "--load"),
    (f"{STAND} --seconds 2 --map grf_n=Fz", 2, "--load"),
    (f"{STAND} --seconds 2 --cop-offset-m 1", 2, "--cop-offset-m"),
    (f"{STAND} --seconds 2 --out gone/s.parquet", 2, "gone"),
    (f"{STAND} --load gone.csv", 1, "gone.csv"),
    (f"{STAND} --load gone.csv --decimal ';'", 2, "--decimal"),
    (f"{STAND} --load load.csv --cop-axes xx", 2, "--cop-axes"),
    (f"{STAND} --load wrong.csv --out s2.parquet", 1, "wrong.csv", "time_s", "time_ms"),
    (f"{STAND} --load cells.csv --out s2.parquet", 1, "2 cell columns", "4 tiles"),
    (f"{STAND} --load bytes.csv --out s2.parquet", 1, "bytes.csv", "cannot be read", "expected"),
    ("simulate --scene indentation --tiles ''", 2, "tile.0.serial = ''", "at least 1 item"),
    ("simulate --scene indentation --tiles T01,T01", 2, "'T01' appears twice"),
    ("simulate --scene indentation --tiles ../x", 2, "tile.0.serial = '../x'", "pattern"),
    (ESTIMATE, 1, "--calibration"),
    (f"{ESTIMATE} --calibration gone.json", 1, "gone.json", "paper-eq2-shape"),
    (f"{ESTIMATE} --calibration other.json", 1, "T01", "T09", "foottile calibrate"),
    (f"{ESTIMATE} --calibration broken.json", 1, "broken.json"),
    (f"{ESTIMATE} {PRESET}", 1, "'gas'", "Leave the model out"),
    (f"{ESTIMATE} {PRESET} --models magic", 2, "magic"),
    (f"{ESTIMATE} {PRESET} --lag-ms -1", 2, "look-ahead"),
    (f"{ESTIMATE} {PRESET} --tare-s 1", 2, "--tare-s"),
    (f"{ESTIMATE} {PRESET} --tare-s 1,0", 2, "--tare-s"),
    (f"{ESTIMATE} {PRESET} --models static --tare-s 5,6", 1, "T01", "--tare-s"),
    (f"{ESTIMATE} {PRESET} --scene insole", 2, "T08"),
    ("estimate no.parquet --out e.parquet", 1, "no.parquet"),
    ("estimate gone.parquet --out e.parquet", 1, "gone.parquet"),
    ("estimate --out o", 2, "no session is named", "--manifest"),
    ("estimate lone nowhere --out o", 2, "nowhere"),
    ("estimate s.parquet --out o --manifest list.csv", 2, "--manifest and sessions exclude"),
    ("estimate --out o --manifest gone.csv", 2, "--manifest 'gone.csv' cannot be read"),
    (f"{MANY} --jobs 1 --scheduler tcp://127.0.0.1:1", 2, "--jobs and --scheduler exclude"),
    (f"{MANY} --scene gone", 2, "no file 'gone' and no built-in scene"),
    ("estimate . --out o", 2, LONE.replace("a.parquet", "no.parquet")),
    ("estimate empty --out o", 2, "there is no session in these places"),
    ("estimate lone --out o", 2, LONE),
    (f"{WEIGH} s.parquet", 1, "not an indentation"),
    *((f"{WEIGH} s.parquet {option}", 2, "--reference") for option in OF_A_PLATE),
    (f"{WEIGH} s.parquet s.parquet --reference load.csv", 2, "one session"),
    (f"{WEIGH} s.parquet --reference load.csv --plot c.png", 2, "without --plot"),
    (f"{WEIGH} --live", 2, "--live goes with --tile"),
    (f"{WEIGH} --tile T01", 2, "no recording is named"),
    (f"{WEIGH} x.parquet --tile T01", 2, "go with --live"),
    (f"{WEIGH} --live --tile T01 --weights 200g,much", 2, "'much' is no weight"),
    ("compare", 2, UNNAMED),
    ("compare s.parquet", 2, UNNAMED),
    ("compare --manifest list.csv", 2, UNNAMED),
    ("compare --manifest list.csv --out o --reference x.csv", 2, UNNAMED),
    ("compare --manifest list.csv --out o --units grf", 2, "--units 'grf'; expected NAME=VALUE"),
    ("compare --manifest list.csv --out o --decimal ';'", 2, "--decimal ';'; expected a comma"),
    ("benchmark --out o --scene nowhere", 2, "nowhere"),
    ("benchmark --out o --scene rolling --scene rolling", 2, "each scene once"),
    ("benchmark --out o --scene rolling --seconds 0", 2, "--seconds 0"),
    ("benchmark --out o --scene rolling --draws 0", 2, "draws"),
    ("benchmark --out o --scene real.toml", 2, "only emulates"),
    ("benchmark --out o --family odd", 2, "--family odd"),
    ("benchmark --out o --family broad --seeds mine", 2, "--seeds mine"),
    ("benchmark --out o --family broad --scene rolling", 2, "--scene and --family broad"),
    ("benchmark --out o --family broad --full-only", 2, "--full-only and --family broad"),
    ("doctor", 2, "--bus"),
    ("doctor --bus /dev/i2c-99", 1, "/dev/i2c-99", "ENOENT", "dtparam=i2c_arm=on"),
    ("domes --load-n -1", 2, "--load-n -1.0 is not a load", "above 0"),
    ("query 'SELECT nope FROM stances' data", 2, 'column "nope" not found'),
    ("query 'DELETE FROM stances' data", 2, "the question is DELETE; expected one SELECT"),
    ("query 'SELECT 1 AS a' nowhere", 2, "no session or folder 'nowhere'"),
    ("query 'SELECT 1 AS a' data --json --csv", 2, "--csv, --json and --out exclude"),
    ("query 'SELECT 1 AS a' data --out answer.txt", 2, "'answer.txt'", "ends with .parquet"),
    ("query 'SELECT 1 AS a' data --data data", 2, "--data and places exclude"),
    ("query 'SELECT 1 AS a' empty", 2, "there is no session in these places"),
    ("query 'SELECT 1 AS a' lone", 2, LONE),
    ("export s.parquet --format xlsx --out x", 2, "one of parquet, arrow, csv"),
    ("export s.parquet --format csv --columns nonsense --out x", 2, "no column 'nonsense'"),
    ("export nothere --format csv --out x", 2, "`foottile pull ID"),
    ("export nosuch://a/b --out o --format csv", 2, "nosuch", "Install the package that opens it"),
    ("verify", 2, "no session is named", "--manifest"),
    ("verify nothere", 2, "`foottile pull ID"),
    ("verify 'empty/x*'", 2, "no session or folder 'empty/x*'"),
    ("recover nothere", 2, "no data folder 'nothere'", "`journal` and `sessions`"),
    ("recover lone", 2, "no data folder 'lone'", "`journal` and `sessions`"),
    ("node --scene leg.toml", 2, "no file 'leg.toml' and no built-in scene"),
    ("node --scene .", 2, "scene '.' cannot be read"),
    ("node --scene standing --server nonsense", 2, "no server address"),
    ("node --scene standing --name ../x", 2, "--name"),
    ("node --scene standing --servo /dev/ttyUSB9", 2, "has no servo"),
    ("node --scene insole", 2, "--load"),
    ("node --scene standing --server https://127.0.0.1:1 --ca no.pem", 2, "no.pem"),
    ("node --scene standing --ca no.pem", 2, "no.pem"),
    ("node --scene standing --record a --ca no.pem", 2, "https://"),
    ("demo --scene nonsense", 2, "no file 'nonsense'"),
    ("sessions --server http://127.0.0.1:1", 1, "no answer"),
    ("sessions --server ftp://x", 2, "no server address"),
    ("sessions --data /nowhere", 2, "no data folder"),
    ("stream --server http://127.0.0.1:1", 1, "no answer"),
    ("pull --out here", 2, "nothing to pull is named"),
    ("pull a --take b --out here", 2, "--take exclude each other"),
    ("pull ../../etc --server http://127.0.0.1:1 --out here", 2, "foottile sessions"),
    ("serve --config /nowhere.toml", 2, "no settings file"),
    ("serve --config wrong.toml", 2, "wrong.toml"),
    ("serve --host 192.0.2.1 --port 0", 1, "192.0.2.1"),
    ("serv", 2, "Did you mean 'serve'?"),
)
"""What a user types, the exit code, and words of the answer."""


@pytest.fixture
def place(simulate: Simulate, tmp_path: Path) -> Path:
    """A folder with a raw session and with wrong files."""
    simulate("s.parquet", "standing", "--seconds", 2, "--no-estimates")
    other = make_calibration("T09").to_json()
    texts = {
        "wrong.toml": STANDING.replace("conversion_ms =", "conversoin_ms =", 1),
        "gone.toml": f'calibration = "gone.json"\n{STANDING}',
        "bare.toml": STANDING.replace('["unwrap", "static"]', '["unwrap"]'),
        "magic.toml": STANDING.replace('["unwrap", "static"]', '["static", "magic"]'),
        "real.toml": scene_text("rolling") + '\n[array]\nbus = "/dev/i2c-1"\n',
        "load.csv": GOOD_TRACE,
        "wrong.csv": GOOD_TRACE.replace("time_s", "time_ms"),
        "cells.csv": "time_s,cell1_n,cell2_n\n0,1,1\n1,1,1\n",
        "bytes.csv": "\x00\xff\x00",
        "list.csv": "session,reference\na.parquet,b.csv\n",
        "other.json": other,
        "broken.json": other.replace("by hand", "by foot"),
        "no.parquet": "PAR1 not really PAR1",
        **{f"lone/{name}.parquet": "PAR1" for name in ("a", "b")},
    }
    for folder in ("lone", "empty", "data/sessions"):
        (tmp_path / folder).mkdir(parents=True)
    for name, text in texts.items():
        (tmp_path / name).write_bytes(text.encode("latin-1"))
    return tmp_path


def read_contents(folder: Path) -> dict[Path, bytes | None]:
    """Return the bytes of each file by its path; None for a folder."""
    return {path: path.read_bytes() if path.is_file() else None for path in folder.rglob("*")}


@pytest.mark.parametrize("refused", REFUSED, ids=lambda refused: refused[0])
def test_a_wrong_command_is_refused_with_its_reason_and_changes_no_file(
    run: Run, place: Path, monkeypatch: pytest.MonkeyPatch, refused: tuple[Any, ...]
) -> None:
    home = place.with_name(f"{place.name}-home")
    monkeypatch.setenv("XDG_DATA_HOME", str(home))
    typed, code, *says = refused
    before = read_contents(place)
    outcome = run(*shlex.split(typed))
    outcome.fails(code, *says)
    lines = outcome.err.splitlines()
    assert len(lines) == 1 or lines[0].startswith("Usage: ")
    assert lines[-1].startswith(("foottile: ", "Error: "))
    assert "Traceback" not in outcome.err
    assert read_contents(place) == before
    assert not [path for path in home.rglob("*") if path.is_file()]


def test_a_full_disk_is_an_error_and_leaves_nothing(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "fsync", refusing(*NO_SPACE))
    simulate = ("simulate", "--scene", "standing", "--seconds", 0.2, "--no-estimates")
    run(*simulate, "--out", "s.parquet").fails(1, "No space left")
    assert list(tmp_path.iterdir()) == []


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
