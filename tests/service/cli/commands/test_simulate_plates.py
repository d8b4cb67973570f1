"""`foottile simulate` over an emulated force plate."""

from __future__ import annotations

import json
from pathlib import Path

from tests.service.cli.outcome import Run


def test_files_of_a_plate_are_named_with_the_injected_truth(run: Run, tmp_path: Path) -> None:
    asked = ("--scene", "standing", "--seconds", "1.5", "--no-estimates", "--force-plate", "fp.csv")
    done = run("simulate", *asked)
    assert done.code == 0, done.err
    assert "fp.csv: the force plate; fp.injected.json: what was injected" in done.out
    assert "instrument" in json.loads((tmp_path / "fp.injected.json").read_text())
    assert run("simulate", *asked, "--json").printed()["plates"] == ["fp.csv"]
