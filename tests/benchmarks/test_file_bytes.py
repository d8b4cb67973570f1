"""The benchmark of sealed files' bytes still runs, and what it finds adds up. Nothing is timed."""

from __future__ import annotations

import importlib
from pathlib import Path

import pytest

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"


def test_every_quantity_is_counted_and_now_less_than_before(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    file_bytes, data = (importlib.import_module(n) for n in ("file_bytes", "recording_data"))
    lines = file_bytes.measured(data.emulated(4, 4.0), tmp_path, with_ladder=False)
    cells = [line.strip("| ").split(" | ") for line in lines if line.startswith("| ")][1:]
    rows = {name.strip("*`"): [float(x.strip("*")) for x in found] for name, *found in cells}
    assert {"t_ns", "pressure_raw", "force_sigma_n", "cop_ground_x_m", "contact"} <= set(rows)
    for way in (0, 1):
        parts = rows["all raw"][way] + rows["all estimates"][way]
        assert parts == pytest.approx(rows["all"][way], abs=0.02)
        of_columns = sum(found[way] for name, found in rows.items() if not name.startswith("all"))
        assert of_columns == pytest.approx(rows["all"][way], abs=0.2)
    before, now = rows["all"]
    assert now < 0.6 * before
