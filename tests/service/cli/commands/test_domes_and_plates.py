"""`foottile domes`, and files of emulated plates that `foottile simulate` writes."""

from __future__ import annotations

import json
from pathlib import Path

from tests.service.cli.outcome import Run


def test_files_of_a_plate_are_named_with_the_injected_truth(run: Run, tmp_path: Path) -> None:
    asked = ("--scene", "standing", "--seconds", "1.5", "--no-estimates", "--force-plate", "fp.csv")
    done = run("simulate", *asked).succeeds()
    assert "fp.csv: the force plate; fp.injected.json: what was injected" in done.out
    assert "instrument" in json.loads((tmp_path / "fp.injected.json").read_text())
    assert run("simulate", *asked, "--json").printed()["plates"] == ["fp.csv"]


def test_domes_names_one_for_a_load_and_marks_estimates(run: Run) -> None:
    outcome = run("domes", "--load-n", 24)
    assert outcome.code == 0
    assert "For 24 N: v60-11 (paper)." in outcome.out
    assert outcome.out.count("estimate ") >= 5
    assert run("domes", "--load-n", 50).code == 3
    printed = json.loads(run("domes", "--load-n", 30, "--json").out)
    assert (printed["dome"], printed["verdict"]) == ("v60-11", "perhaps")


def test_domes_bear_more_over_a_chip_of_a_wider_range(run: Run) -> None:
    assert "tiles, or --chip bmp581." in run("domes", "--load-n", 50).out
    printed = run("domes", "--load-n", 35, "--chip", "bmp581", "--json").printed()
    assert (printed["full_scale_kpa"], printed["dome"], printed["basis"]) == (
        *(125.0, "v60-11", "estimate"),
    )
    assert "bmp581, reaches its 125 kPa" in run("domes", "--chip", "bmp581").out
    run("domes", "--chip", "bmp999").fails(2, "one of mpl115a2, bmp581")
