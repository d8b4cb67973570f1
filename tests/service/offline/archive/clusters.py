"""A real Dask cluster on this machine: a scheduler and workers, each a process of its own."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from tests.waiting import until

ROOT = Path(__file__).resolve().parents[4]


class Cluster:
    """A scheduler with workers of one thread each, which nobody starts again when they are killed.

    Use as a context manager.
    """

    def __init__(self, folder: Path, workers: int) -> None:
        self._folder = folder
        self._said = folder / "scheduler.json"
        self._started: list[subprocess.Popen[bytes]] = []
        self.workers: list[subprocess.Popen[bytes]] = []
        self._wanted = workers

    @property
    def address(self) -> str:
        import json

        return str(json.loads(self._said.read_text())["address"])

    def add_worker(self, **environment: str) -> None:
        words = ("worker", "--scheduler-file", self._said, "--no-nanny", "--nthreads", 1)
        where = ("--local-directory", self._folder / f"worker{len(self._started)}")
        self.workers.append(self._start(*words, *where, "--no-dashboard", **environment))

    def __enter__(self) -> Cluster:
        host = ("--host", "127.0.0.1", "--port", 0, "--no-dashboard", "--no-show")
        self._start("scheduler", *host, "--scheduler-file", self._said)
        until(lambda: self._said.exists() and self._said.stat().st_size > 0)
        for _ in range(self._wanted):
            self.add_worker()
        return self

    def __exit__(self, *_: object) -> None:
        for process in reversed(self._started):
            process.kill()
            process.wait()

    def end_scheduler(self) -> None:
        self._started[0].kill()
        self._started[0].wait()

    def _start(self, *words: object, **environment: str) -> subprocess.Popen[bytes]:
        log = (self._folder / f"{len(self._started)}.log").open("wb")
        with log:
            process = subprocess.Popen(
                [sys.executable, "-m", "dask", *map(str, words)],
                cwd=self._folder,
                env={**os.environ, "PYTHONPATH": str(ROOT), **environment},
                stdout=log,
                stderr=log,
            )
        self._started.append(process)
        return process
