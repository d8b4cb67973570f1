"""The benchmark of screens runs against every server that is installed."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path

import pytest

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"

pytestmark = [pytest.mark.process, pytest.mark.real_time]


@pytest.mark.slow
def test_each_server_tells_its_screens(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    fanout = importlib.import_module("fanout")
    monkeypatch.setattr(sys, "argv", ["fanout.py", "2", "0.5", "1"])
    fanout.main()
    rows = [line for line in capsys.readouterr().out.splitlines() if line.startswith("| ")]
    assert {"| ours", "| uvicorn", "| websockets"} <= {row.split(" |")[0] for row in rows}
    assert all(row.split()[-2].isdigit() for row in rows[1:])
