"""`foottile calibrate --reference`: a mounted foot on a plate that sees its rim as well."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet as pq
import pytest

from tests.service.cli.outcome import Run

pytestmark = pytest.mark.slow

LAG = ("--lag-range-s", "1,2")


@pytest.fixture
def plate(session: Path, tmp_path: Path) -> Path:
    """What a plate under the whole foot reads: its own clock, zero and noise."""
    table = pq.read_table(session)
    t_s = (table["t_ns"].to_numpy() - table["t_ns"][0].as_py()) * 1e-9
    at_s = np.arange(0.1, t_s[-1] - 0.1, 0.001)
    read_n = np.interp(at_s, t_s, table["true_plate_n"].to_numpy()) + 0.7
    read_n += 0.1 * np.random.default_rng(1).normal(size=len(at_s))
    path = tmp_path / "plate.csv"
    pyarrow.csv.write_csv(pa.table({"time_s": at_s + 1.5, "grf_n": read_n}), path)
    return path


def test_a_gain_in_situ_makes_newtons_of_an_assumed_curve_those_of_the_plate(
    run: Run, session: Path, plate: Path
) -> None:
    said = run("calibrate", session, "--reference", plate, "--out", "cal.json", *LAG, "--json")
    found = said.printed()
    assert "the plate's gain is assumed exact" in said.err
    assert set(found["gains"]) == {"T01", "T02", "T03", "T04"}
    assert found["mae_after_n"] < 0.8 * found["mae_before_n"]
    run("estimate", session, "--calibration", "cal.json", "--out", "mounted.parquet").succeeds()
    run("compare", "mounted.parquet", "--reference", plate, *LAG, "--remove-offset", "--out", "c")
    compared = json.loads(Path("c/compare.json").read_text())
    assert abs(compared["figures"]["grf_mae_n"]["mean"] - found["mae_after_n"]) < 0.2
    assert not any("assumed scale" in note for note in compared["notes"])


def test_gains_of_a_session_that_was_estimated_with_gains_are_gains_to_the_bench(
    run: Run, session: Path, plate: Path
) -> None:
    once = run("calibrate", session, "--reference", plate, "--out", "1.json", *LAG, "--json")
    run("estimate", session, "--calibration", "1.json", "--out", "mounted.parquet")
    asked = (
        "calibrate",
        "mounted.parquet",
        "--reference",
        plate,
        "--out",
        "2.json",
        *LAG,
        "--json",
    )
    first, second = once.printed(), run(*asked).printed()
    assert second["gains"]["T01"]["value"] == pytest.approx(
        first["gains"]["T01"]["value"], rel=0.02
    )
    assert second["mae_before_n"] == pytest.approx(second["mae_after_n"], rel=0.2)


def test_a_shear_that_three_hops_do_not_determine_is_refused_and_nothing_is_written(
    run: Run, session: Path, plate: Path
) -> None:
    asked = ("calibrate", session, "--reference", plate, "--out", "cal.json", *LAG, "--shear")
    run(*asked).fails(1, "does not determine the shear")
    assert not Path("cal.json").exists()
