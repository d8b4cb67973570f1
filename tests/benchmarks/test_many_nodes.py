"""The benchmark of many nodes runs: nothing is lost, and every number of nodes has its row."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path

import pytest

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"

pytestmark = [pytest.mark.process, pytest.mark.real_time]


def played(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, *options: str
) -> str:
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    many_nodes = importlib.import_module("many_nodes")
    monkeypatch.setattr(many_nodes, "SETTLE_S", 0.5)
    monkeypatch.setattr(sys, "argv", ["many_nodes.py", *options])
    many_nodes.main()
    return capsys.readouterr().out


def rows(said: str) -> list[str]:
    return [line.split()[1] for line in said.splitlines() if line[:3] in ("| 1", "| 2")]


@pytest.mark.slow
def test_each_number_of_nodes_has_its_row_and_no_frame_is_lost(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    said = played(capsys, monkeypatch, "--nodes", "1", "2", "--seconds", "0.5")
    assert rows(said) == ["1", "2"]
    assert said.count(" frames 0 are lost") == 2


@pytest.mark.slow
def test_a_long_run_ends_with_whole_sessions_and_a_download(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    options = ["--soak", "--nodes", "2", "--seconds", "3", "--viewers", "2", "--download-mb", "1"]
    said = played(capsys, monkeypatch, *options, "--tiles", "64")
    assert rows(said) == ["2"]
    assert "downloaded 1 MB" in said
    assert said.count(": complete") == 2
