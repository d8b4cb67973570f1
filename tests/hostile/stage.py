"""A server as a process, a node that records on it, and a screen: what attacks disturb."""

from __future__ import annotations

import json
import os
import resource
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from urllib.parse import urlsplit

from websockets.exceptions import ConnectionClosed

from tests.hostile.attack import Outcome
from tests.service.fake_node import FakeNode, Play
from tests.service.process import Process
from tests.service.running import Running
from tests.waiting import until


class Served(Running):
    """`foottile serve` (or `demo`) as a process, with what a test may do to a server over HTTP.

    Args:
        folder: for its data and its output.
        arguments: the command and its options.
        outcome: has a failure if the log speaks of a bug in the end.
        files_max: how many descriptors it may open.
        environment: of its own.
    """

    def __init__(
        self,
        folder: Path,
        *arguments: object,
        outcome: Outcome | None = None,
        files_max: int | None = None,
        **environment: str,
    ) -> None:
        super().__init__(folder / "data", token=environment.get("FOOTTILE_TOKEN"))
        self._arguments = arguments or ("serve",)
        self._outcome = outcome
        self._files_max = files_max
        self._environment = environment
        self.process: Process
        self._folder = folder

    def __enter__(self) -> Served:
        # Entered once more, after it was killed, it is where it was.
        options = (*self._arguments, "--port", self.port, "--data", self.data)
        self.process = Process(*options, folder=self._folder / "cwd", **self._environment)
        if self._files_max is not None:
            # It has asked for as many as it may when it comes to listen.
            resource.prlimit(self.process.pid, resource.RLIMIT_NOFILE, (self._files_max,) * 2)
        line = self.process.said("FootTile is at ", 60.0)
        self.port = urlsplit(line.split()[-1]).port or 0
        self.http = self.client()
        return self

    def __exit__(self, *_: object) -> None:
        if self._outcome is not None:
            self._outcome.failures += [f"the log: {line}" for line in traces(self)[:5]]
        self.http.close()
        self.process.process.terminate()
        with suppress(Exception):
            self.process.ended(15.0)
        self.process.close()

    @property
    def log(self) -> list[str]:
        """What it has said to its standard error."""
        return self.process.err

    @property
    def rss_mb(self) -> float:
        """Memory that it has in use."""
        text = Path(f"/proc/{self.process.pid}/status").read_text()
        (line,) = [line for line in text.splitlines() if line.startswith("VmRSS")]
        return int(line.split()[1]) / 1024

    @property
    def files(self) -> int:
        """Descriptors that it has open."""
        return len(os.listdir(f"/proc/{self.process.pid}/fd"))


class Screen:
    """A viewer that notes the longest pause before a frame, the first one included."""

    def __init__(self, served: Served) -> None:
        self._sockets = ExitStack()
        self._socket = self._sockets.enter_context(served.socket("/api/v1/live"))
        self.frames = 0
        self.gap_s = 0.0
        self.is_gone = False
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="screen")
        self._thread.start()

    def close(self) -> None:
        self._stop.set()
        self._thread.join(10.0)
        self._sockets.close()

    def _run(self) -> None:
        last_s = time.monotonic()
        while not self._stop.is_set():
            try:
                message = json.loads(self._socket.recv(timeout=0.5))
            except TimeoutError:
                message = {}
            except ConnectionClosed:
                self.is_gone = True
                return
            now_s = time.monotonic()
            self.gap_s = max(self.gap_s, now_s - last_s)
            if message.get("type") == "frame":
                self.frames += 1
                last_s = now_s


@contextmanager
def recording(served: Served, outcome: Outcome, *, token: str | None = None) -> Iterator[FakeNode]:
    """While the block runs a node records at 500 frames/s and a screen watches.

    Then the recording is stopped and has to be complete; that it is not, that its node was cut
    off, or that the screen saw nothing, is a failure of the outcome.
    """
    node = FakeNode(served, token=token)
    try:
        node.connect()
        node.tared()
        with Play(node, 20.0) as play:
            until(lambda: served.node()["last_seq"] > 500)
            session, screen, began_s = node.record(), Screen(served), time.monotonic()
            try:
                yield node
                outcome.figures["longest pause of a screen"] = f"{screen.gap_s:.2f} s"
                if screen.is_gone:
                    outcome.failures.append("the screen that watched before was turned out")
                time.sleep(0.3)  # some frames of after
                stopped = until(lambda: session.stop() or True, 20.0)
                assert stopped
                # An attack of an hour makes a session of an hour.
                sealed = session.sealed(20.0 + 0.2 * (time.monotonic() - began_s))
            finally:
                screen.close()
        outcome.figures["frames recorded"] = str(sealed["frames"])
        if not screen.frames:
            outcome.failures.append("the screen that watched saw no frame")
        if play.problem is not None:
            outcome.failures.append(f"the node was cut off: {play.problem}")
        if sealed["complete"] is not True or sealed["lost"]:
            outcome.failures.append(f"the recording is not complete: {sealed}")
    finally:
        node.close()


def traces(served: Served) -> list[str]:
    """Lines of its log that speak of a bug."""
    return [line for line in served.log if "this is a bug" in line or "Traceback" in line]


def asked(port: int, request: bytes, timeout_s: float = 5.0) -> bytes:
    """All that a server answers to these bytes until it hangs up or falls silent."""
    said = b""
    with socket.create_connection(("127.0.0.1", port), timeout=timeout_s) as connection:
        with suppress(OSError):
            connection.sendall(request)
        with suppress(OSError):
            while piece := connection.recv(65536):
                said += piece
    return said
