"""The benchmark of intervals still runs. What it finds is in docs/results/compare.md."""

from __future__ import annotations

import importlib
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[2]
BENCHMARKS = ROOT / "benchmarks"


@pytest.fixture
def bench(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    return importlib.import_module("compare_alignment")


def walk(seconds: float) -> tuple[np.ndarray, np.ndarray]:
    """Steps of 0.6 s, each a little higher and later than the last."""
    t_s = np.arange(0.0, seconds, 0.01)
    steps = np.sin(np.pi * np.clip((t_s % 1.1) / 0.6, 0.0, 1.0))
    return t_s, steps * (15.0 + 5.0 * np.sin(t_s))


def test_a_row_has_the_part_of_draws_whose_intervals_have_the_truth(
    bench: ModuleType, tmp_path: Path
) -> None:
    t_s, force_n = walk(15.0)
    rows = "\n".join(f"{t:.2f},{f:.3f},," for t, f in zip(t_s, force_n, strict=True))
    (tmp_path / "walk.csv").write_text(f"time_s,fz_n,cop_x_m,cop_y_m\n{rows}\n")
    load = bench.Load("walk", "walk.csv", 1.0, None)
    line = bench.row("walk", bench.drawn_alone(load, tmp_path, 3))
    cells = [cell.strip() for cell in line.strip("|").split("|")]
    assert cells[:2] == ["walk", "3"]
    assert [cell.partition(" %")[0] for cell in cells[2:6]].count("0.0") == 0
    assert cells[6] == "none"
