"""The loop that reads a node's vitals goes on, whatever a machine says."""

from __future__ import annotations

import asyncio
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from devices.vitals import Vitals
from service.node import running_node
from service.node.running_node import RunningNode


def test_vitals_that_cannot_be_read_are_unknown_until_they_can(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    good, bad = Vitals(cpu_celsius=40.0), ValueError("no number")
    results: list[Vitals | Exception] = [good, bad, bad, good]
    seen: list[Vitals | None] = []
    reports: list[str] = []

    def read(*_: object) -> Vitals:
        seen.append(node._vitals)
        if not results:
            raise SystemExit
        if isinstance(result := results.pop(0), Exception):
            raise result
        return result

    monkeypatch.setattr(running_node, "read_vitals", read)
    monkeypatch.setattr(running_node, "VITALS_INTERVAL_S", 0.0)
    node: Any = SimpleNamespace(
        _queued_bytes=0,
        _options=SimpleNamespace(node_folder=tmp_path),
        _report=reports.append,
        _vitals=None,
    )
    with pytest.raises(SystemExit):
        asyncio.run(RunningNode._watch_vitals(node))
    assert seen == [None, good, None, None, good]
    assert reports == ["the vitals of this machine cannot be read: no number"]
