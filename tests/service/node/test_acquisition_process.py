"""Acquisition that is held up, killed or fails: what is said, and what becomes of node and link."""

from __future__ import annotations

import errno
import multiprocessing
import os
import signal
import subprocess
import threading
import time
from contextlib import ExitStack
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import service.node.acquisition_process
from devices.errors import (
    BusFaultError,
    BusMisuseError,
    BusSetupError,
    FootTileError,
    NoAcknowledgeError,
    SceneError,
    ServoSetupError,
    TileSetupError,
)
from devices.scene.scene_file import load_scene
from service.node.acquisition_process import WaitingForArray
from service.rig.emulated_foot import RigOptions
from tests.builders.scenes import ONE_TILE_FILE, make_scene
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


@pytest.mark.slow
def test_acquisition_that_is_held_up_is_said_everywhere_and_goes_on_in_the_same_stream(
    running: Running, process: Process
) -> None:
    before = running.node("leg")
    child = acquisition_of(process)
    os.kill(child, signal.SIGSTOP)
    try:
        process.said("acquisition is held up")
        until(lambda: running.node("leg")["warnings"])
        held_up = running.node("leg")
    finally:
        os.kill(child, signal.SIGCONT)
    assert held_up["connected"], "the node itself is heard of"
    assert "no frames for" in held_up["warnings"][0]
    assert held_up["rate_hz"] == 0.0
    until(lambda: running.node("leg")["last_seq"] > held_up["last_seq"] + 100)
    process.said("no longer: acquisition is held up")
    until(lambda: not running.node("leg")["warnings"])
    after = running.node("leg")
    assert after["stream_id"] == before["stream_id"]
    assert after["missed_slots"] > before["missed_slots"], "what was missed is counted"


@pytest.mark.slow
@pytest.mark.parametrize("stopped_s", [1.0, pytest.param(61.0, marks=pytest.mark.soak)])
def test_a_session_in_which_the_node_was_stopped_is_complete_and_verifies(
    running: Running, foottile: Start, tmp_path: Path, stopped_s: float
) -> None:
    """Tiles that are read one after another: nearly every stop is within a frame."""
    scene = tmp_path / "in_turn.toml"
    text = (resources.files("devices.scene") / "builtin" / "standing.toml").read_text()
    scene.write_text(text.replace("[array]", '[array]\nschedule = "sequential"'))
    node = foottile("node", "--scene", scene, "--server", running.url, "--name", "leg")
    node.said("connected to")
    until(lambda: (running.node("leg")["last_seq"] or 0) > 20)
    session = running.record("leg", name="trial")
    processes = (node.pid, acquisition_of(node))
    for _ in range(3 if stopped_s < 5.0 else 1):
        begin_seq = running.node("leg")["last_seq"]
        for pid in processes:
            os.kill(pid, signal.SIGSTOP)
        time.sleep(stopped_s)
        for pid in processes:
            os.kill(pid, signal.SIGCONT)
        until(lambda seq=begin_seq: running.node("leg")["last_seq"] > seq + 50)  # type: ignore[misc]
    session.stop()
    found = session.sealed()
    assert (found["complete"], found["problem"]) == (True, None)
    frames = session.frames()
    assert np.diff(frames.t_mono_ns).max() > 0.8e9 * stopped_s, "the time of the stop has no frame"
    assert np.abs(frames.sample_offset_us).max() < 1_100_000
    assert foottile("verify", session.folder).ended(30.0) == 0


@pytest.mark.slow
def test_acquisition_that_is_killed_ends_the_node_with_the_reason(
    running: Running, process: Process
) -> None:
    os.kill(acquisition_of(process), signal.SIGKILL)
    assert process.ended() == 1
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

    monkeypatch.setattr(service.node.acquisition_process, "Rig", broken)
    monkeypatch.setattr(signal, "signal", lambda *_: None)
    service.node.acquisition_process._run_child(
        RigOptions(load_scene("standing"), "leg"),
        connection,  # type: ignore[arg-type]  # that much of it is used
    )
    (failed,) = connection.got
    assert isinstance(failed.error, FootTileError)
    assert "ValueError: dome pressure was asked for too late" in str(failed.error)
    assert said_when_closed == [1]
    assert "Traceback" in capfd.readouterr().err, "whoever mends it needs to know where"


def refusal(number: int) -> BusSetupError:
    """As `open_bus` raises it."""
    error = BusSetupError("the bus cannot be used", where="/dev/i2c-9", errno=number)
    error.__cause__ = OSError(number, os.strerror(number))
    return error


NOT_YET = [
    TileSetupError("tile A17 does not answer"),
    NoAcknowledgeError("no acknowledge"),
    BusFaultError("the bus failed"),
    refusal(errno.ENOENT),
    refusal(errno.ENODEV),
    refusal(errno.EBUSY),
    BusSetupError("no I2C adapter with these ids is plugged in", errno=errno.ENOENT),
]
NEVER = [
    BusMisuseError("the adapter refused the transfer"),
    refusal(errno.EACCES),
    refusal(errno.ENOTTY),
    ServoSetupError("an MX-28 answers"),
    SceneError("schedule"),
]


def opened_after(
    errors: list[FootTileError], monkeypatch: pytest.MonkeyPatch, bus: str = "/dev/i2c-9"
) -> tuple[list[Any], list[str]]:
    """What the parent got while the array could not be opened at first, and what was closed."""
    connection, coming, closed = _Tells(), iter(errors), list[str]()

    def rig(options: RigOptions, stack: ExitStack) -> str:
        attempt = f"attempt {len(connection.got)}"
        stack.callback(lambda: closed.append(attempt))
        if (error := next(coming, None)) is not None:
            raise error
        return attempt

    def streams(rig: str, connection: Any, stop: threading.Event) -> None:
        connection.send((rig, list(closed)))
        stop.set()

    monkeypatch.setattr(service.node.acquisition_process, "Rig", rig)
    monkeypatch.setattr(service.node.acquisition_process, "_acquire_stream", streams)
    monkeypatch.setattr(service.node.acquisition_process, "REOPEN_INTERVAL_S", 0.0)
    monkeypatch.setattr(service.node.acquisition_process, "_await_stop", lambda *_: None)
    monkeypatch.setattr(signal, "signal", lambda *_: None)
    scene = make_scene(array={"bus": bus})
    service.node.acquisition_process._run_child(RigOptions(scene, "leg"), connection)  # type: ignore[arg-type]  # double
    return connection.got, closed


def test_an_array_that_is_not_there_yet_is_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    got, closed = opened_after([*NOT_YET], monkeypatch)
    n = len(NOT_YET)
    assert got[:n] == [WaitingForArray(str(error)) for error in NOT_YET]
    # What an attempt opened is closed before the next; what is used, at the end.
    assert got[n] == (f"attempt {n}", [f"attempt {i}" for i in range(n)])
    assert got[n + 1].error is None
    assert closed[-1] == f"attempt {n}"


@pytest.mark.parametrize("error", NEVER, ids=lambda error: f"{type(error).__name__} {error}")
def test_an_error_that_waiting_does_not_mend_ends_the_node(
    error: FootTileError, monkeypatch: pytest.MonkeyPatch
) -> None:
    (failed,), _ = opened_after([error], monkeypatch)
    assert failed.error is error


def test_emulated_tiles_are_not_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    (failed,), _ = opened_after([NOT_YET[0]], monkeypatch, bus="emulated")
    assert failed.error is NOT_YET[0]


@pytest.mark.slow
def test_a_node_waits_for_its_bus_says_so_once_and_stops_when_told(
    foottile: Start, tmp_path: Path
) -> None:
    path = tmp_path / "one.toml"
    path.write_text(ONE_TILE_FILE + f'\n[array]\nbus = "{tmp_path}/i2c-9"\n')
    process = foottile("node", "--scene", path, "--record", "first")
    process.said("waits for the array, and asks again each second")
    with pytest.raises(subprocess.TimeoutExpired):
        process.process.wait(2.5)
    assert sum("ENOENT" in line for line in process.err) == 1
    process.process.send_signal(signal.SIGTERM)
    assert process.ended() == 0, process.err


def test_a_parent_that_has_died_is_no_bug(monkeypatch: pytest.MonkeyPatch) -> None:
    ours, theirs = multiprocessing.Pipe()
    theirs.close()
    monkeypatch.setattr(signal, "signal", lambda *_: None)

    def streams(rig: object, connection: Any, stop: threading.Event) -> None:
        connection.send("frames")

    monkeypatch.setattr(service.node.acquisition_process, "Rig", lambda options, stack: None)
    monkeypatch.setattr(service.node.acquisition_process, "_acquire_stream", streams)
    with ours:
        service.node.acquisition_process._run_child(RigOptions(load_scene("standing"), "leg"), ours)
