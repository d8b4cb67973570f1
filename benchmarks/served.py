"""A server of ours as a process of its own, and what the system says of a process."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx

COMMAND = [sys.executable, "-c", "from service.cli.main import main; main()"]
SEALED_S, END_S = 300.0, 30.0
_CREATED = 201
TOKEN = os.environ.setdefault("FOOTTILE_TOKEN", "a-token-of-all-benchmarks")
"""Of every server, node and client of a benchmark, which have it from the environment."""
_TICKS = os.sysconf("SC_CLK_TCK")


def cpu_s(pid: int) -> float:
    """CPU time of all threads of a process so far."""
    fields = Path(f"/proc/{pid}/stat").read_text().rsplit(") ", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / _TICKS


def children(pid: int) -> list[int]:
    """Processes that a process has started."""
    tasks = Path(f"/proc/{pid}/task").glob("*/children")
    return [int(word) for task in tasks for word in task.read_text().split()]


def api_of(url: str) -> httpx.Client:
    """A client of a server's API, with its token."""
    return httpx.Client(
        base_url=f"{url}/api/v1",
        headers={"Authorization": f"Bearer {TOKEN}"},
        trust_env=False,
        timeout=60.0,
    )


class Server:
    """`foottile serve` as a process."""

    def __init__(self, data: Path) -> None:
        self.process = subprocess.Popen(
            [*COMMAND, "serve", "--port=0", f"--data={data}"],
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
        )
        assert self.process.stdout is not None
        self.url = self.process.stdout.readline().split()[-1].rstrip("/")
        self.http = api_of(self.url)

    @property
    def cpu_s(self) -> float:
        """CPU time of all its threads so far."""
        return cpu_s(self.process.pid)

    @property
    def rss_mb(self) -> float:
        """Memory that it holds."""
        fields = Path(f"/proc/{self.process.pid}/statm").read_text().split()
        return int(fields[1]) * os.sysconf("SC_PAGE_SIZE") * 1e-6

    def nodes(self) -> list[dict[str, Any]]:
        """As its API has them."""
        items: list[dict[str, Any]] = self.http.get("/nodes").json()["items"]
        return items

    def record(self) -> list[str]:
        """Record every node; the sessions' ids."""
        found = []
        for node in self.nodes():
            answer = self.http.post("/sessions", json={"node": node["node"], "name": "many"})
            assert answer.status_code == _CREATED, answer.text
            found.append(answer.json()["id"])
        return found

    def sealed(self, sessions: list[str]) -> list[dict[str, Any]]:
        """The sessions, once they are sealed."""
        end_s = time.monotonic() + SEALED_S
        while time.monotonic() < end_s:
            found = [self.http.get(f"/sessions/{session}").json() for session in sessions]
            if all(each["state"] == "sealed" for each in found):
                return found
            time.sleep(0.5)
        raise TimeoutError("not sealed")

    def close(self) -> None:
        """End it."""
        self.http.close()
        self.process.terminate()
        try:
            self.process.wait(END_S)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
        assert self.process.stdout is not None
        self.process.stdout.close()


@contextlib.contextmanager
def served(data: Path) -> Iterator[Server]:
    """A server, and its end."""
    server = Server(data)
    try:
        yield server
    finally:
        server.close()
