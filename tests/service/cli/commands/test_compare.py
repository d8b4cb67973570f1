"""`foottile compare` as a user meets it, on an emulated foot whose truth plays the force plate."""

from __future__ import annotations

import json
import shutil
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet as pq
import pytest

from storage.documents import read_checksummed_json
from tests.service.cli.outcome import Run, scene_text
from tests.storage.formats.readers.test_rosbag import Sample, write_bag1

pytestmark = pytest.mark.slow

LAG_S = 3.21
LAB = ("--map", "time_s=Time,grf_n=Fz,cop_x_m=COPx,cop_y_m=COPy", "--units", "grf=N,cop=mm")


@pytest.fixture
def plate(session: Path, tmp_path: Path) -> Path:
    """What a plate would have written of our own estimate, later, turned, and with an offset."""
    table = pq.read_table(session)
    t_s = (table["t_ns"].to_numpy() - table["t_ns"][0].as_py()) * 1e-9
    known = np.isfinite(table["grf_n"].to_numpy().astype(float))
    grf_n = table["grf_n"].to_numpy().astype(float)[known]
    at_s = np.arange(t_s[known][0] + 0.3, t_s[-1] - 0.3, 0.001)
    noise_n = 0.01 * np.ptp(grf_n) * np.random.default_rng(1).normal(size=len(at_s))
    columns = {
        "Time": at_s + LAG_S,
        "Fz": -np.interp(at_s, t_s[known], grf_n) - 1.2 + noise_n,
        "COPx": np.full(len(at_s), 12.0),
        "COPy": np.zeros(len(at_s)),
    }
    path = tmp_path / "plate.csv"
    pyarrow.csv.write_csv(pa.table(columns), path)
    return path


def test_a_plate_is_aligned_and_compared_in_three_files(
    run: Run, session: Path, plate: Path, tmp_path: Path
) -> None:
    asked = (*LAB, "--sign", "-", "--remove-offset", "--reference-sigma-n", "0.5")
    outcome = run("compare", session, "--reference", plate, *asked, "--out", "new/one", "--json")
    folder = tmp_path / "new" / "one"
    content = json.loads((folder / "compare.json").read_text())
    del content["check"]
    assert outcome.printed() == content
    low_s, high_s = content["alignment"]["lag_s"]["interval_95"]
    assert low_s < LAG_S < high_s
    assert high_s - low_s < 5e-3
    assert content["alignment"]["offset_n"]["value"] == pytest.approx(1.2, abs=0.1)
    # The plate repeats what our estimate still reads in flight: the paper's curve knows no creep.
    assert content["alignment"]["offset_in_flight_n"]["value"] == pytest.approx(1.2, abs=0.3)
    assert content["alignment"]["scale"]["value"] == pytest.approx(1.0, abs=0.02)
    assert content["alignment"]["offset_removed"]
    assert content["figures"]["grf_r2"]["mean"] > 0.99
    assert content["trials_are"] == "each contiguous recording"
    assert "`grf_mae_n`" in (folder / "compare.md").read_text()
    assert (folder / "compare.png").read_bytes().startswith(b"\x89PNG")


def test_the_session_itself_is_a_reference_with_its_truth_and_without_a_lag(
    run: Run, session: Path
) -> None:
    truth = "grf_n=true_grf_n,cop_x_m=true_cop_x_m,cop_y_m=true_cop_y_m"
    outcome = run(
        "compare", session, "--reference", session, "--map", truth, "--out", "o", "--json"
    )
    content = outcome.printed()
    assert abs(content["alignment"]["lag_s"]["value"]) < 0.03
    assert any("assumed scale" in note for note in content["notes"])


def test_without_a_folder_it_is_kept_with_the_session(
    run: Run, session: Path, plate: Path, tmp_path: Path
) -> None:
    asked = ("--reference", plate, *LAB, "--sign", "-", "--lag-range-s", "3,4")
    run("compare", session, *asked).fails(2, "is a single file")
    folder = tmp_path / "20200101T000000Z-000000"
    folder.mkdir()
    shutil.copy(session, folder / "frames.parquet")
    (folder / "session.json").write_text("{}")
    assert run("compare", folder, *asked).code == 0
    kept = folder / "comparisons" / "plate"
    assert {path.name for path in kept.iterdir()} == {
        *("compare.json", "compare.md", "compare.png"),
        "series.parquet",
    }
    read_checksummed_json(kept / "compare.json")


def test_a_limit_that_is_missed_is_named_and_code_3_and_all_is_written(
    run: Run, session: Path, plate: Path, tmp_path: Path
) -> None:
    limits = "grf_mae_n=0.001,grf_r2=0.9,stances=99"
    asked = (*LAB, "--sign", "-", "--limits", limits)
    outcome = run("compare", session, "--reference", plate, *asked, "--out", "o")
    outcome.fails(3, "limit missed: grf_mae_n is ")
    assert "was to be at most 0.001" in outcome.err
    assert "was to be at least 99" in outcome.err  # of what is good, less is missed
    assert "grf_r2" not in outcome.err
    assert len(json.loads((tmp_path / "o" / "compare.json").read_text())["missed"]) == 2


def test_a_limit_without_its_reference_column_is_missed(
    run: Run, session: Path, plate: Path
) -> None:
    force = ("--map", "time_s=Time,grf_n=Fz", "--units", "grf=N", "--sign", "-")
    asked = (*force, "--limits", "cop_p95_m=1", "--out", "o")
    run("compare", session, "--reference", plate, *asked).fails(
        3, "cop_p95_m is not known here, and was limited to 1: the reference has no centre"
    )


@pytest.mark.parametrize(
    ("arguments", "code", "says"),
    [
        ((*LAB,), 2, "sign of column 'Fz' is not stated"),
        ((*LAB[:2], "--sign", "-"), 2, "unit of column 'Fz' is not stated"),
        ((*LAB[:2], "--units", "grf=mN,cop=mm", "--sign", "-"), 1, "Its unit may be kN"),
        ((*LAB, "--sign", "-", "--limits", "grf=1"), 2, "a limit of grf_frames"),
        ((*LAB, "--sign", "-", "--limits", "grf_mae_n"), 2, "NAME=VALUE"),
        ((*LAB, "--sign", "-", "--sole-m", "260"), 2, "--sole-m '260' is not a size of an insole"),
        ((*LAB, "--sign", "-", "--sole-m", "0.2,x"), 2, "is not a size of an insole"),
    ],
)
def test_an_impossible_comparison_is_named_and_leaves_no_file(
    run: Run,
    session: Path,
    plate: Path,
    tmp_path: Path,
    arguments: tuple[str, ...],
    code: int,
    says: str,
) -> None:
    run("compare", session, "--reference", plate, *arguments, "--out", "o").fails(code, says)
    assert not (tmp_path / "o").exists()


def test_a_session_without_estimates_is_refused_with_a_remedy(
    run: Run, session: Path, plate: Path, tmp_path: Path
) -> None:
    (tmp_path / "scene.toml").write_text(scene_text("standing"))
    raw = ("--scene", "scene.toml", "--seconds", "1", "--no-estimates", "--out", "raw.parquet")
    assert run("simulate", *raw).code == 0
    asked = (*LAB, "--sign", "-", "--out", "o")
    run("compare", "raw.parquet", "--reference", plate, *asked).fails(1, "foottile estimate")


def test_a_missing_matplotlib_is_named_with_the_extra_that_brings_it(
    run: Run, session: Path, plate: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    asked = (*LAB, "--sign", "-", "--out", "o")
    run("compare", session, "--reference", plate, *asked).fails(2, "pip install 'foottile[plot]'")


def test_a_session_in_the_place_of_its_reference_is_called_swapped(
    run: Run, session: Path, plate: Path
) -> None:
    done = run("compare", plate, "--reference", session, "--out", "o")
    done.fails(1, "plate.csv: it is not a session, and session.parquet is one", "swapped?")


def test_a_range_without_the_true_lag_is_refused_with_the_lag_that_fits(
    run: Run, session: Path, plate: Path
) -> None:
    asked = (*LAB, "--sign", "-", "--lag-range-s", "-0.2,0.1", "--out", "o")
    said = "Without --lag-range-s 3.21 s fits best"
    run("compare", session, "--reference", plate, *asked).fails(1, said)


def test_an_insole_gives_cop_with_its_size(run: Run, session: Path, tmp_path: Path) -> None:
    table = pq.read_table(session)
    time_s = (table["t_ns"].to_numpy() - table["t_ns"][0].as_py()) * 1e-9
    names = "# time\tleft total force[N]" + "".join(
        f"\tleft center of pressure {axis}[-0.5...+0.5]" for axis in "XY"
    )
    rows = zip(time_s.tolist(), table["true_grf_n"].to_pylist(), strict=True)
    lines = (f"{t:.4f}\t{force_n:.3f}\t0.1\t0" for t, force_n in rows if t > 0.3)
    (tmp_path / "walk.txt").write_text("\n".join(["# Duration: 00:10.000", names, *lines]) + "\n")
    asked = ("--reference", "walk.txt", "--map", "cop_x_m=left_cop_x", "--out", "o")
    run("compare", session, *asked).fails(2, "Add --sole-m LENGTH, of the insole in metres")
    assert run("compare", session, *asked, "--sole-m", "0.26").code == 0
    content = json.loads((tmp_path / "o" / "compare.json").read_text())
    assert "the centre of pressure is known along x only" in content["notes"]
    series = pq.read_table(tmp_path / "o" / "series.parquet")["reference_cop_x_m"].to_numpy()
    np.testing.assert_allclose(series[np.isfinite(series)], 0.026, atol=1e-9)


def test_the_lag_of_a_ros_bag_is_that_of_the_clocks(
    run: Run, session: Path, tmp_path: Path
) -> None:
    table = pq.read_table(session)
    late_ns = table["t_ns"].to_numpy() + 300_000_000
    forces_n = table["true_grf_n"].to_numpy()
    samples = [
        Sample("/foot", int(t_ns), (0.0, 0.0, -float(force_n), 0.0, 0.0, 0.0))
        for t_ns, force_n in zip(late_ns, forces_n, strict=True)
        if np.isfinite(force_n)
    ]
    bag = write_bag1(tmp_path, samples)
    assert run("compare", session, "--reference", bag, "--out", "o").code == 0
    lag_s = json.loads((tmp_path / "o" / "compare.json").read_text())["alignment"]["lag_s"]
    low_s, high_s = lag_s["interval_95"]
    assert low_s < 0.3 < high_s
    assert high_s - low_s < 0.01


# --- many sessions --------------------------------------------------------------------------------


def write_noisy_plate(session: Path, path: Path, *, unit: float = 1.0) -> None:
    """Write what a plate would have of our own estimate, with noise."""
    table = pq.read_table(session)
    t_s = (table["t_ns"].to_numpy() - table["t_ns"][0].as_py()) * 1e-9
    grf_n = table["grf_n"].to_numpy().astype(float)
    known = np.isfinite(grf_n)
    noise_n = 0.01 * np.ptp(grf_n[known]) * np.random.default_rng(1).normal(size=known.sum())
    rows = zip(t_s[known], (grf_n[known] + noise_n) * unit, strict=True)
    path.write_text("t,F\n" + "".join(f"{t:.6f},{f:.9f}\n" for t, f in rows))


def test_each_row_is_compared_and_a_bad_one_fails_alone(
    run: Run, session: Path, tmp_path: Path
) -> None:
    write_noisy_plate(session, tmp_path / "newtons.csv")
    write_noisy_plate(session, tmp_path / "kilo.csv", unit=1e-3)
    kilo = (tmp_path / "kilo.csv").read_text()
    (tmp_path / "kilo.csv").write_text("a,b\n1,2\n" + kilo)
    rows = [
        "session,reference,name,units,sign,skip_rows,encoding",
        "session.parquet,newtons.csv,first,,,,",
        'session.parquet,kilo.csv,second,"grf=kN,time=s",,2,cp1252',
        "session.parquet,gone.csv,third,,,,",
        "session.parquet,newtons.csv,fourth,grf,,,",
        "session.parquet,newtons.csv,../fifth,,,,",
        "session.parquet,,sixth,,,,",
        "session.parquet,newtons.csv,seventh,,,1.5,",
    ]
    (tmp_path / "trials.csv").write_text("\n".join(rows) + "\n")
    asked = ("--map", "time_s=t,grf_n=F", "--units", "grf=N,time=s", "--sign", "+")
    words = ("compare", "--manifest", "trials.csv", "--out", "out", *asked, "--jobs", 1)
    done = run(*words, "--json")
    assert done.code == 3
    said: dict[str, list[dict[str, Any]]] = {}
    for line in map(json.loads, done.out.splitlines()):
        said.setdefault(line["name"], []).append(line)
    assert said["first"][0]["state"] == said["second"][0]["state"] == "made", [
        e.get("reason") for v in said.values() for e in v
    ]
    first, second = (said[name][0]["facts"]["means"] for name in ("first", "second"))
    assert first["grf_mae_n"] == pytest.approx(second["grf_mae_n"], rel=0.01)
    assert {p.name for p in (tmp_path / "out" / "first").iterdir()} == {
        "compare.json",
        "compare.md",
        "compare.png",
        "series.parquet",
        "compare.made.json",
    }
    reasons = [line["reason"] for lines in said.values() for line in lines if "reason" in line]
    assert len(reasons) == 5
    for word in ("no such file", "--units 'grf'", "../fifth", "no reference", "--skip-rows '1.5'"):
        assert any(word in reason for reason in reasons), reasons
    again = run(*words)
    assert "0 made, 2 there before, 5 failed" in again.out
    missed = run(*words, "--limits", "grf_mae_n=1e-9")
    assert "2 made, 0 there before, 5 failed; 2 limit missed" in missed.out
