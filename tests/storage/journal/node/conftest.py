"""A node's journal that writes, and the stream that it was begun with."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from storage.journal.node import journal as node_journal
from storage.journal.node import retention
from storage.journal.node.journal import NodeJournal
from storage.journal.node.stream import NodeStream
from tests.builders.arrays import make_array
from tests.storage.journal.node.leg import Start


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(node_journal, "SYNC_INTERVAL_S", 0.02)
    monkeypatch.setattr(node_journal, "_CLEANUP_INTERVAL_S", 0.02)
    monkeypatch.setattr(node_journal, "_RETRY_INTERVAL_S", 0.02)
    monkeypatch.setattr(retention, "_BUDGET_CHECK_INTERVAL_S", 0.02)


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Start]:
    """A node's journal that writes; ended with the test."""
    running: list[NodeJournal] = []

    def begin(**options: Any) -> NodeJournal:
        running.append(NodeJournal(tmp_path, "leg", **options))
        running[-1].start_writer()
        return running[-1]

    yield begin
    for journal in running:
        journal.end_streams_and_close()
    assert not any(thread.name == "journal" for thread in threading.enumerate())


@pytest.fixture
def journal(start: Start) -> NodeJournal:
    """A journal that writes."""
    return start()


@pytest.fixture
def stream(journal: NodeJournal) -> NodeStream:
    """Its stream, of which nothing has been taken yet."""
    return journal.switch_to_new_stream(make_array())
