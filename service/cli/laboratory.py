"""A laboratory for emulated feet: a server, nodes with plates under them, and what they recorded.

Server and nodes are processes of their own, started as a user starts them, on loopback. What they
say goes to files beside the sessions.
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

_SERVER_S = 120.0
"""On a new machine its models are compiled first."""
_NODE_S = 60.0
_SEALED_S = 60.0
_END_S = 15.0
"""A node writes what its plates have seen before it ends."""
_LOOK_S = 0.05
PRE_ROLL_S = 5.0
"""A recording begins so much earlier, if the node has run that long: with the lead, the tare."""
_AT = "FootTile is at "
_CODE = (
    "from devices.realtime import terminate_with_parent; terminate_with_parent(); "
    "from service.cli.main import main; main()"
)


@dataclass(frozen=True)
class Trial:
    """One recording of an emulated foot.

    Attributes:
        name: of node and session.
        arguments: of `foottile node`: its scene, seeds, plates.
        seconds: recorded after the node has appeared.
        writes: files that it leaves behind.
    """

    name: str
    arguments: Sequence[str]
    seconds: float
    writes: Sequence[Path]


@dataclass(frozen=True)
class Recorded:
    """A trial's session, downloaded.

    Attributes:
        path: of its frames.
        session: what the server says of it.
        lost_frames: that no file has.
        missed_slots: in which no frame was taken.
    """

    path: Path
    session: Mapping[str, Any]
    lost_frames: int
    missed_slots: int


class Laboratory:
    """A running server, and a folder for everything. Use as a context manager.

    Args:
        folder: for data, journals, downloads and logs; is there.

    Raises:
        FootTileError: the server does not start.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._stack = ExitStack()
        self._url = ""
        self._token = secrets.token_urlsafe(18)
        self._nodes: list[subprocess.Popen[bytes]] = []
        self._is_over = False
        self._lock = threading.Lock()

    def __enter__(self) -> Self:
        try:
            arguments = ("serve", "--host=127.0.0.1", "--port=0", f"--data={self._folder / 'data'}")
            server = self._start("server", arguments)
            self._url = self._address(server)
        except BaseException:
            self._stack.close()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        self.end_nodes()
        self._stack.close()

    def end_nodes(self) -> None:
        """End all nodes and start no other: whoever waits for a trial need not wait any longer."""
        with self._lock:
            self._is_over = True
            for node in self._nodes:
                _end(node)

    def record(self, trial: Trial) -> Recorded:
        """Run a node, record it, and download what was sealed; several may run at the same time.

        Raises:
            FootTileError: the node ends by itself, nothing is sealed, or a file is missing.
        """
        own = (f"--server={self._url}", f"--name={trial.name}", "--end-with-parent")
        journal = self._folder / "nodes" / trial.name
        with self._lock:
            if self._is_over:
                raise FootTileError(f"trial {trial.name} was not begun: the laboratory is closed")
            arguments = ("node", *own, f"--journal={journal}", *trial.arguments)
            node = self._start(trial.name, arguments)
            self._nodes.append(node)
        try:
            with foottile.connect(self._url, self._token) as server:
                session = self._started(server, trial.name, node)
                _wait(trial.seconds, node, trial.name)
                sealed = session.stop().wait_until_sealed(_SEALED_S).metadata
                missed = server.node(trial.name)["missed_slots"]
                pulled = pull_session(server, session.id, self._folder / "sessions")
        except foottile.FootTileError as error:
            raise LinkError(f"trial {trial.name}: {error}") from error
        finally:
            code = _end(node)
        absent = [path for path in trial.writes if not path.is_file()]
        if code != 0 or absent:
            raise FootTileError(
                f"node {trial.name} ended with code {code}"
                + "".join(f", and without {path.name}" for path in absent),
                where=str(self._log(trial.name)),
            )
        return Recorded(
            path=self._folder / "sessions" / session.id / FRAMES_NAME,
            session=pulled,
            lost_frames=sum(sealed["lost"].values()),
            missed_slots=int(missed or 0),
        )

    def _start(self, name: str, arguments: Sequence[str]) -> subprocess.Popen[bytes]:
        log = self._log(name)
        log.parent.mkdir(parents=True, exist_ok=True)
        with log.open("wb") as file:
            process = subprocess.Popen(  # noqa: S603  # ourselves, with arguments of our own
                [sys.executable, "-c", _CODE, *arguments],
                env={**os.environ, "PYTHONUNBUFFERED": "1", "FOOTTILE_TOKEN": self._token},
                stdin=subprocess.DEVNULL,
                stdout=file,
                stderr=subprocess.STDOUT,
                start_new_session=True,  # Ctrl-C is for us, who end it
            )
        self._stack.callback(_end, process)
        return process

    def _log(self, name: str) -> Path:
        return self._folder / "logs" / f"{name}.log"

    def _address(self, server: subprocess.Popen[bytes]) -> str:
        until_s = time.monotonic() + _SERVER_S
        while time.monotonic() < until_s and server.poll() is None:
            for line in self._log("server").read_text(errors="replace").splitlines():
                if line.startswith(_AT):
                    return line.removeprefix(_AT).strip().rstrip("/")
            time.sleep(_LOOK_S)
        raise FootTileError("the server does not start", where=str(self._log("server")))

    def _started(
        self, server: foottile.Server, name: str, process: subprocess.Popen[bytes]
    ) -> foottile.Session:
        """The session that is recorded, as soon as the node is there."""
        until_s, why = time.monotonic() + _NODE_S, ""
        while time.monotonic() < until_s and process.poll() is None:
            try:
                return server.record(name, name, pre_roll_s=PRE_ROLL_S)
            except foottile.FootTileError as error:  # the server does not know it yet
                why = str(error)
                time.sleep(_LOOK_S)
        raise FootTileError(f"node {name} does not come: {why}", where=str(self._log(name)))


def _wait(seconds: float, process: subprocess.Popen[bytes], name: str) -> None:
    """Let a node run; it is not to end meanwhile."""
    try:
        code = process.wait(seconds)
    except subprocess.TimeoutExpired:
        return
    raise FootTileError(f"node {name} has ended by itself, with code {code}")


def _end(process: subprocess.Popen[bytes]) -> int:
    """End a process, if it has not ended; its exit code."""
    if process.poll() is None:
        with suppress(ProcessLookupError):
            process.send_signal(signal.SIGTERM)
        try:
            process.wait(_END_S)
        except subprocess.TimeoutExpired:
            process.kill()
    return process.wait()
