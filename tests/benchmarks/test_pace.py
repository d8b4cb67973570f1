"""The benchmark of real-time emulation runs, and gives a row for each scene."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path

import pytest

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"


def test_each_scene_has_its_row(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    pace = importlib.import_module("pace")
    monkeypatch.setattr(pace, "SCENES", dict(list(pace.SCENES.items())[:1]))
    monkeypatch.setattr(sys, "argv", ["pace.py", "0.2"])
    pace.main()
    assert "| standing, 4 tiles | pipelined |" in capsys.readouterr().out
