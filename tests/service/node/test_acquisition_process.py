"""Acquisition that is held up, killed or fails: what is said, and what becomes of node and link."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest

import service.node.acquisition
from devices.errors import FootTileError
from devices.scene.file import load_scene
from service.rig.options import RigOptions
from tests.builders.scenes import ONE_TILE_FILE
from tests.service.process import Process, Start, acquisition_of
from tests.service.running import Running
from tests.waiting import until

pytestmark = pytest.mark.real_time


@pytest.fixture
def process(running: Running, foottile: Start, tmp_path: Path) -> Process:
    """A node that streams."""
    path = tmp_path / "one.toml"
    path.write_text(ONE_TILE_FILE)
    started = foottile("node", "--scene", path, "--server", running.url, "--name", "leg")
    started.said("connected to")
    until(lambda: (running.node("leg")["last_seq"] or 0) > 100)
    return started


def test_acquisition_that_is_held_up_is_said_everywhere_and_goes_on_in_the_same_stream(
    running: Running, process: Process
) -> None:
    before = running.node("leg")
    child = acquisition_of(process)
    os.kill(child, signal.SIGSTOP)
    try:
        process.said("acquisition is held up")
        until(lambda: running.node("leg")["troubles"])
        held_up = running.node("leg")
    finally:
        os.kill(child, signal.SIGCONT)
    assert held_up["connected"], "the node itself is heard of"
    assert "no frames for" in held_up["troubles"][0]
    assert held_up["rate_hz"] == 0.0
    until(lambda: running.node("leg")["last_seq"] > held_up["last_seq"] + 100)
    process.said("no longer: acquisition is held up")
    until(lambda: not running.node("leg")["troubles"])
    after = running.node("leg")
    assert after["boot_id"] == before["boot_id"]
    assert after["missed_slots"] > before["missed_slots"], "what was missed is counted"


def test_acquisition_that_is_killed_ends_the_node_with_the_reason(
    running: Running, process: Process
) -> None:
    os.kill(acquisition_of(process), signal.SIGKILL)
    assert process.ended(20.0) == 1
    assert any("acquisition process was killed by SIGKILL" in line for line in process.err)
    assert any("Start the node again" in line for line in process.err)
    until(lambda: not running.node("leg")["connected"])


class _Tells:
    """The parent's end of the pipe."""

    def __init__(self) -> None:
        self.got: list[Any] = []

    def send(self, message: Any) -> None:
        self.got.append(message)

    def recv(self) -> Any:
        threading.Event().wait(0.5)
        raise EOFError


def test_a_bug_in_acquisition_is_said_before_anything_is_closed_that_may_hang(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    connection = _Tells()
    said_when_closed: list[int] = []

    def broken(options: RigOptions, stack: ExitStack) -> None:
        stack.callback(lambda: said_when_closed.append(len(connection.got)))
        raise ValueError("dome pressure was asked for too late")

    monkeypatch.setattr(service.node.acquisition, "Rig", broken)
    monkeypatch.setattr(signal, "signal", lambda *_: None)
    service.node.acquisition._run(
        RigOptions(load_scene("standing"), "leg"),
        connection,  # type: ignore[arg-type]  # that much of it is used
    )
    (failed,) = connection.got
    assert isinstance(failed.error, FootTileError)
    assert "ValueError: dome pressure was asked for too late" in str(failed.error)
    assert said_when_closed == [1]
    assert "Traceback" in capfd.readouterr().err, "whoever mends it needs to know where"


def test_a_parent_that_has_died_is_no_bug(monkeypatch: pytest.MonkeyPatch) -> None:
    ours, theirs = multiprocessing.Pipe()
    theirs.close()
    monkeypatch.setattr(signal, "signal", lambda *_: None)

    def streams(rig: object, connection: Any, stop: threading.Event) -> None:
        connection.send("frames")

    monkeypatch.setattr(service.node.acquisition, "Rig", lambda options, stack: None)
    monkeypatch.setattr(service.node.acquisition, "_stream", streams)
    with ours:
        service.node.acquisition._run(RigOptions(load_scene("standing"), "leg"), ours)
