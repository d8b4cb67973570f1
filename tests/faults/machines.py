"""The two machines of a round: a server and a node, each with processes, a disk and a clock."""

from __future__ import annotations

import os
import random
import signal
import socket
import subprocess
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, TypeVar

import httpx

from tests.faults.clock_step import WallClock
from tests.faults.disk import SlowSync
from tests.faults.power import Disk
from tests.faults.product import NODE, REPOSITORY, clean_environment, command, hand_over
from tests.tokens import SHARED_BEARER, SHARED_TOKEN
from tests.waiting import PATIENCE_S

T = TypeVar("T")


class RoundError(Exception):
    """A round cannot go on: something did not happen in time."""


def wait_for(what: str, condition: Callable[[], T], timeout_s: float) -> T:
    """What `condition` gives as soon as that is true.

    Raises:
        RoundError: it is not within the time.
    """
    end_s = time.monotonic() + timeout_s
    while not (found := condition()):
        if time.monotonic() > end_s:
            raise RoundError(f"not within {timeout_s:g} s: {what}")
        time.sleep(0.02)
    return found


class Machine:
    """Processes with one data folder, which can be killed alone or together, or lose power.

    Args:
        name: for messages.
        folder: where everything of it is, the data folder in `root`.
        small: a mounted small disk, if the data folder is to be there.
    """

    def __init__(self, name: str, folder: Path, small: Path | None = None) -> None:
        self.name = name
        folder.mkdir(parents=True)
        self.disk = Disk(
            (small or folder) / "root", (small or folder) / "beside", folder / "synced"
        )
        self.clock = WallClock(folder / "clock")
        self.slow = SlowSync(folder / "slow")
        self.arm = folder / "kill"
        """What is written here is the call at which the next kill comes (`fault_recorder`)."""
        self.said = folder / "said.txt"
        self._process: subprocess.Popen[bytes] | None = None
        self._arguments: tuple[object, ...] = ()

    @property
    def root(self) -> Path:
        """Its data folder."""
        return self.disk.root

    @property
    def is_alive(self) -> bool:
        """Does its first process run?"""
        return self._process is not None and self._process.poll() is None

    def start(self, kill_at: str = "") -> None:
        """Start its command of the product; what was running has to be dead.

        Args:
            kill_at: a call at which it is killed (`bootstrap/fault_recorder.py`).
        """
        self.arm.unlink(missing_ok=True)
        environment = {
            **clean_environment(),
            **self.disk.environment(),
            **self.clock.environment(),
            **self.slow.environment(),
            "FOOTTILE_TOKEN": SHARED_TOKEN,
            "XDG_STATE_HOME": str(self.arm.parent / "state"),
            "FAULTS_KILL_FILE": str(self.arm),
            "FAULTS_KILL": kill_at,
            "FAULTS_PARENT": str(os.getpid()),
        }
        with self.said.open("ab") as said:
            self._process = subprocess.Popen(
                command(*self._arguments),
                cwd=REPOSITORY,
                env=environment,
                stdin=subprocess.DEVNULL,
                stdout=said,
                stderr=said,
                start_new_session=True,
            )

    def kill_at(self, spec: str) -> None:
        """Have it killed at a call to come."""
        hand_over(self.arm, spec + "\n")

    def children(self) -> list[int]:
        """Processes that its first process has started, oldest first."""
        if self._process is None:
            return []
        pid = self._process.pid
        with suppress(OSError):
            text = Path(f"/proc/{pid}/task/{pid}/children").read_text()
            return [int(word) for word in text.split() if _does(int(word), "spawn_main")]
        return []

    def stop_for(self, length_s: float) -> None:
        """SIGSTOP to all its processes, and SIGCONT after a while."""
        if self._process is None:
            return
        os.killpg(self._process.pid, signal.SIGSTOP)
        try:
            time.sleep(length_s)
        finally:
            os.killpg(self._process.pid, signal.SIGCONT)

    def kill(self) -> None:
        """SIGKILL to all its processes; return when they are gone."""
        if self._process is None:
            return
        with suppress(ProcessLookupError):
            os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait(10.0)
        group = self._process.pid
        wait_for(f"the processes of the {self.name} end", lambda: not _group(group), 10.0)

    def kill_first(self) -> None:
        """SIGKILL to its first process only; return when the others have followed."""
        assert self._process is not None
        self._process.kill()
        self._process.wait(10.0)
        group = self._process.pid
        wait_for(f"the children of the {self.name} end with it", lambda: not _group(group), 10.0)

    def terminate(self, timeout_s: float = PATIENCE_S) -> int:
        """End it gently; its exit code.

        Raises:
            RoundError: it does not end.
        """
        assert self._process is not None
        self._process.send_signal(signal.SIGTERM)
        try:
            return self._process.wait(timeout_s)
        except subprocess.TimeoutExpired as error:
            raise RoundError(f"the {self.name} does not end within {timeout_s:g} s") from error

    def cut_power(self, rng: random.Random) -> str:
        """Kill everything, and leave on the disk what a disk may hold then."""
        self.kill()
        return self.disk.cut_power(rng)


class ServerMachine(Machine):
    """The server, and what its API says."""

    def __init__(self, folder: Path, small: Path | None = None) -> None:
        super().__init__("server", folder, small)
        self.port = free_port()
        self._arguments = ("serve", "--port", self.port, "--data", self.root)
        self._http = httpx.Client(
            base_url=f"http://127.0.0.1:{self.port}/api/v1",
            headers=SHARED_BEARER,
            timeout=PATIENCE_S,
            trust_env=False,
        )

    def wait_ready(self, timeout_s: float = PATIENCE_S) -> None:
        """Until it answers.

        Raises:
            RoundError: it does not, or has ended.
        """

        def ready() -> bool:
            if not self.is_alive:
                raise RoundError(f"the server has ended: {self.said.read_text()[-2000:]}")
            with suppress(httpx.HTTPError):
                return self._http.get("/health").status_code == 200
            return False

        wait_for("the server answers", ready, timeout_s)

    def get(self, path: str) -> Any:
        """A resource.

        Raises:
            RoundError: it is refused.
        """
        return self._answer(self._http.get(path))

    def post(self, path: str, **body: object) -> Any:
        """Ask for a change.

        Raises:
            RoundError: it is refused.
        """
        return self._answer(self._http.post(path, json=body or None))

    def download(self, path: str) -> httpx.Response:
        """A file."""
        return self._http.get(path)

    def node(self) -> dict[str, Any] | None:
        """The node as the server sees it; None if it does not know it, or does not answer."""
        with suppress(httpx.HTTPError):
            answer = self._http.get(f"/nodes/{NODE}")
            return answer.json() if answer.status_code == 200 else None
        return None

    def close(self) -> None:
        """Kill it and let go of it."""
        self.kill()
        self._http.close()

    @staticmethod
    def _answer(answer: httpx.Response) -> Any:
        if answer.is_error:
            raise RoundError(f"{answer.request.method} {answer.request.url}: {answer.text}")
        return answer.json()


class NodeMachine(Machine):
    """The node.

    Args:
        folder: where everything of it is.
        scene: its scene file.
        port: where it finds its server; None: it has none, and records by itself.
        small: a mounted small disk, if its journal is to be there.
    """

    def __init__(
        self, folder: Path, scene: Path, port: int | None, small: Path | None = None
    ) -> None:
        super().__init__("node", folder, small)
        link = ("--record", "round") if port is None else ("--server", f"http://127.0.0.1:{port}")
        self._arguments = ("node", "--scene", scene, "--name", NODE, *link, "--journal", self.root)


def free_port() -> int:
    """A port that nobody else is given meanwhile: below those that the kernel deals out."""
    rng = random.Random(os.urandom(8))  # noqa: S311  # no secret
    while True:
        port = rng.randrange(20_000, 30_000)
        with suppress(OSError), socket.create_server(("127.0.0.1", port)):
            return port


def _group(number: int) -> list[int]:
    """Living processes of a process group."""
    found = []
    for path in Path("/proc").glob("[0-9]*/stat"):
        with suppress(OSError):
            fields = path.read_text().rsplit(")", 1)[1].split()
            if int(fields[2]) == number and fields[0] != "Z":
                found.append(int(path.parent.name))
    return found


def _does(pid: int, word: str) -> bool:
    with suppress(OSError):
        return word.encode() in Path(f"/proc/{pid}/cmdline").read_bytes()
    return False
