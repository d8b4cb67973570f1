"""`foottile` as a process of its own."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest

from tests.tokens import SHARED_TOKEN
from tests.waiting import PATIENCE_S, until

BIN = Path(os.environ.get("FOOTTILE_BIN", Path(sys.executable).parent))
"""Where the command is that is tested: scripts/lowest has one of its own."""
Start = Callable[..., "Process"]


class Process:
    """`foottile` as a process; its output is read as it comes."""

    def __init__(
        self, *arguments: object, folder: Path, before: Sequence[str] = (), **environment: str
    ) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        # The package is found by where it is installed, not by the working directory.
        self.process = subprocess.Popen(
            [*before, str(BIN / "foottile"), *map(str, arguments)],
            cwd=folder,
            env={
                **os.environ,
                "COLUMNS": "200",
                "PYTHONUNBUFFERED": "1",
                "XDG_STATE_HOME": str(folder.parent / "state"),  # journals of nodes
                "FOOTTILE_TOKEN": SHARED_TOKEN,
                **environment,
            },
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        self.out: list[str] = []
        self.err: list[str] = []
        self._readers = [
            threading.Thread(target=self._read, args=(stream, lines), name="reader")
            for stream, lines in (
                (self.process.stdout, self.out),
                (self.process.stderr, self.err),
            )
        ]
        for reader in self._readers:
            reader.start()

    @property
    def pid(self) -> int:
        return self.process.pid

    def said(self, text: str, timeout_s: float = PATIENCE_S) -> str:
        """The first line of either stream with this text."""

        def found() -> str | None:
            lines = [line for line in (*self.out, *self.err) if text in line]
            if not lines and self.process.poll() is not None:
                pytest.fail(f"ended with {self.process.returncode}: {self.out} {self.err}")
            return lines[0] if lines else None

        line = until(found, timeout_s)
        assert line is not None
        return line

    def ended(self, timeout_s: float = PATIENCE_S) -> int:
        """Its exit code, once it has ended."""
        code = self.process.wait(timeout_s)
        for reader in self._readers:
            reader.join(PATIENCE_S)
        return code

    def close(self) -> None:
        if self.process.poll() is None:
            self.process.kill()
            self.process.wait(PATIENCE_S)
        for reader, stream in zip(
            self._readers, (self.process.stdout, self.process.stderr), strict=True
        ):
            reader.join(PATIENCE_S)
            assert stream is not None
            stream.close()
        # pytest shows it beside a failure.
        sys.stderr.write("".join(f"foottile: {line}\n" for line in (*self.out, *self.err)))

    def _read(self, stream: Any, lines: list[str]) -> None:
        with contextlib.suppress(ValueError):  # closed
            lines.extend(line.rstrip("\n") for line in iter(stream.readline, ""))


def acquisition_of(node: Process) -> int:
    """Id of the process that takes a node's frames."""
    text = Path(f"/proc/{node.pid}/task/{node.pid}/children").read_text()
    (found,) = (
        pid
        for pid in map(int, text.split())
        if b"spawn_main" in Path(f"/proc/{pid}/cmdline").read_bytes()
    )
    return found


def has_ended(pid: int) -> bool:
    """Return whether a process is gone, or a zombie."""
    with contextlib.suppress(FileNotFoundError, ProcessLookupError):
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] == "Z"
    return True
