"""A server, nodes and processes that end with the test, and leave no thread behind."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.service.fake_node import FakeNode, NodeOf
from tests.service.patient import be_patient
from tests.service.process import Process, Start
from tests.service.running import Running, ServeWith
from tests.waiting import PATIENCE_S, until


@pytest.fixture
def no_threads_left() -> Iterator[None]:
    """Fail if a thread outlives what a test has started."""
    before = set(threading.enumerate())
    yield

    def left() -> list[threading.Thread]:
        return [thread for thread in threading.enumerate() if thread not in before]

    until(lambda: not left())


@pytest.fixture
def silence_s() -> float:
    """Seconds of silence after which a server lets a node go: nodes of tests wait for a core."""
    return PATIENCE_S


@pytest.fixture
def serve_with(
    no_threads_left: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, silence_s: float
) -> Iterator[ServeWith]:
    """Start a server of the test's own, with any options of `Running`."""
    # A fake node sends the frames that pass a stop only after the stop was answered.
    be_patient(monkeypatch, settle_s=0.02, silence_s=silence_s)
    started: list[Running] = []

    def start(**options: Any) -> Running:
        running = Running(tmp_path / f"data-{len(started)}", **options)
        started.append(running)
        running.start()
        return running

    yield start
    for running in started:
        running.stop()


@pytest.fixture
def running(serve_with: ServeWith) -> Running:
    """A server on loopback."""
    return serve_with()


@pytest.fixture
def node_of(no_threads_left: None) -> Iterator[NodeOf]:
    """A fake node of a server, not yet connected."""
    nodes: list[FakeNode] = []

    def make(running: Running, *arguments: Any, **options: Any) -> FakeNode:
        nodes.append(FakeNode(running, *arguments, **options))
        return nodes[-1]

    yield make
    for node in nodes:
        node.close()


@pytest.fixture
def node(running: Running, node_of: NodeOf) -> FakeNode:
    """A fake node, not yet connected."""
    return node_of(running)


@pytest.fixture
def tared(node: FakeNode) -> FakeNode:
    """A connected node with a tare; its 70 frames are acknowledged."""
    node.connect()
    node.tared()
    node.acknowledged(69)
    return node


@pytest.fixture
def foottile(no_threads_left: None, tmp_path: Path) -> Iterator[Start]:
    """Start `foottile` as a process."""
    processes: list[Process] = []

    def start(*arguments: object, **environment: str) -> Process:
        processes.append(Process(*arguments, folder=tmp_path / "cwd", **environment))
        return processes[-1]

    yield start
    for process in processes:
        process.close()
