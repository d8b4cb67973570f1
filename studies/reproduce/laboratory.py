"""Laboratory for emulated feet: a server, nodes on plates, and their recordings.

Server and nodes are processes on loopback, started by their commands; their output goes to log
files beside the sessions.
"""

from __future__ import annotations

import os
import secrets
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import foottile
from devices.errors import FootTileError, LinkError
from service.pull import pull_session
from storage.sessions.folder import FRAMES_NAME

_SERVER_START_TIMEOUT_S = 120.0
"""Timeout of the server's start, which compiles models on a new machine."""
_NODE_START_TIMEOUT_S = 60.0
_SEAL_TIMEOUT_S = 60.0
_STOP_TIMEOUT_S = 15.0
"""Timeout of a node's end, at which it writes the files of its plates."""
_POLL_S = 0.05
PRE_ROLL_S = 5.0
"""Longest pre-roll, which includes the lead and thus the tare."""
_ADDRESS_PREFIX = "FootTile is at "
_PYTHON_CODE = (
    "from devices.realtime import terminate_with_parent; terminate_with_parent(); "
    "from service.cli.main import main; main()"
)


@dataclass(frozen=True)
class RecordingJob:
    """Recording to make of an emulated foot.

    Attributes:
        name: name of node and session.
        arguments: arguments of `foottile node`: scene, seeds, plates.
        seconds: recorded time after the node has connected.
        expected_files: files that the node writes.
    """

    name: str
    arguments: Sequence[str]
    seconds: float
    expected_files: Sequence[Path]


@dataclass(frozen=True)
class RecordedTrial:
    """Downloaded session of a trial.

    Attributes:
        path: file of its frames.
        session: metadata of the server.
        lost_frames: number of lost frames.
        missed_slots: number of slots without a frame.
    """

    path: Path
    session: Mapping[str, Any]
    lost_frames: int
    missed_slots: int


class Laboratory:
    """Running server with a folder for all files; a context manager.

    Args:
        folder: existing folder for data, journals, downloads and logs.

    Raises:
        FootTileError: the server does not start.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._stack = ExitStack()
        self._url = ""
        self._token = secrets.token_urlsafe(18)
        self._nodes: list[subprocess.Popen[bytes]] = []
        self._is_closed = False
        self._lock = threading.Lock()

    def __enter__(self) -> Self:
        try:
            arguments = ("serve", "--host=127.0.0.1", "--port=0", f"--data={self._folder / 'data'}")
            server = self._start("server", arguments)
            self._url = self._wait_for_address(server)
        except BaseException:
            self._stack.close()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        self.stop_nodes()
        self._stack.close()

    def stop_nodes(self) -> None:
        """Stop all nodes and start no more; this ends pending `record` calls."""
        with self._lock:
            self._is_closed = True
            for node in self._nodes:
                _stop_process(node)

    def record(self, trial: RecordingJob) -> RecordedTrial:
        """Run a node, record it and download the sealed session; calls may run in parallel.

        Raises:
            FootTileError: the node ends early, the session is not sealed, or a file is missing.
        """
        own = (f"--server={self._url}", f"--name={trial.name}", "--end-with-parent")
        journal = self._folder / "nodes" / trial.name
        with self._lock:
            if self._is_closed:
                raise FootTileError(f"trial {trial.name} was not started: the laboratory is closed")
            arguments = ("node", *own, f"--journal={journal}", *trial.arguments)
            node = self._start(trial.name, arguments)
            self._nodes.append(node)
        try:
            with foottile.connect(self._url, self._token) as server:
                session = self._start_recording(server, trial.name, node)
                _check_keeps_running(trial.seconds, node, trial.name)
                sealed = session.stop().wait_until_sealed(_SEAL_TIMEOUT_S).metadata
                missed = server.node(trial.name)["missed_slots"]
                pulled = pull_session(server, session.id, self._folder / "sessions")
        except foottile.FootTileError as error:
            raise LinkError(f"trial {trial.name}: {error}") from error
        finally:
            code = _stop_process(node)
        missing_files = [path for path in trial.expected_files if not path.is_file()]
        if code != 0 or missing_files:
            raise FootTileError(
                f"node {trial.name} ended with code {code}"
                + "".join(f", and without {path.name}" for path in missing_files),
                where=str(self._log_path(trial.name)),
            )
        return RecordedTrial(
            path=self._folder / "sessions" / session.id / FRAMES_NAME,
            session=pulled,
            lost_frames=sum(sealed["lost"].values()),
            missed_slots=int(missed or 0),
        )

    def _start(self, name: str, arguments: Sequence[str]) -> subprocess.Popen[bytes]:
        log = self._log_path(name)
        log.parent.mkdir(parents=True, exist_ok=True)
        with log.open("wb") as file:
            process = subprocess.Popen(  # noqa: S603  # our own program and arguments
                [sys.executable, "-c", _PYTHON_CODE, *arguments],
                env={**os.environ, "PYTHONUNBUFFERED": "1", "FOOTTILE_TOKEN": self._token},
                stdin=subprocess.DEVNULL,
                stdout=file,
                stderr=subprocess.STDOUT,
                start_new_session=True,  # Ctrl-C reaches this process, which stops the node
            )
        self._stack.callback(_stop_process, process)
        return process

    def _log_path(self, name: str) -> Path:
        return self._folder / "logs" / f"{name}.log"

    def _wait_for_address(self, server: subprocess.Popen[bytes]) -> str:
        deadline_s = time.monotonic() + _SERVER_START_TIMEOUT_S
        while time.monotonic() < deadline_s and server.poll() is None:
            for line in self._log_path("server").read_text(errors="replace").splitlines():
                if line.startswith(_ADDRESS_PREFIX):
                    return line.removeprefix(_ADDRESS_PREFIX).strip().rstrip("/")
            time.sleep(_POLL_S)
        raise FootTileError("the server does not start", where=str(self._log_path("server")))

    def _start_recording(
        self, server: foottile.Server, name: str, process: subprocess.Popen[bytes]
    ) -> foottile.Session:
        """Start recording as soon as the node is connected."""
        deadline_s, reason = time.monotonic() + _NODE_START_TIMEOUT_S, ""
        while time.monotonic() < deadline_s and process.poll() is None:
            try:
                return server.record(name, name, pre_roll_s=PRE_ROLL_S)
            except foottile.FootTileError as error:  # not connected yet
                reason = str(error)
                time.sleep(_POLL_S)
        raise FootTileError(f"node {name} does not come: {reason}", where=str(self._log_path(name)))


def _check_keeps_running(seconds: float, process: subprocess.Popen[bytes], name: str) -> None:
    """Wait while a node runs; fail if it ends.

    Raises:
        FootTileError: the node ended.
    """
    try:
        code = process.wait(seconds)
    except subprocess.TimeoutExpired:
        return
    raise FootTileError(f"node {name} has ended by itself, with code {code}")


def _stop_process(process: subprocess.Popen[bytes]) -> int:
    """Stop a process and return its exit code."""
    if process.poll() is None:
        with suppress(ProcessLookupError):
            process.send_signal(signal.SIGTERM)
        try:
            process.wait(_STOP_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            process.kill()
    return process.wait()
