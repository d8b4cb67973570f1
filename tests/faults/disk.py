"""Bad disks: really full, really read-only (a small tmpfs of its own), and slow at syncing."""

from __future__ import annotations

import os
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest

from tests.faults.product import hand_over

_FILLER = ".filler"


class SmallDisk:
    """A mounted tmpfs.

    Args:
        folder: where it is mounted.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    @property
    def free_bytes(self) -> int:
        """What can still be written."""
        found = os.statvfs(self.folder)
        return found.f_bavail * found.f_frsize

    def fill(self, leave_bytes: int = 0) -> None:
        """Take all its room but `leave_bytes`."""
        with (self.folder / _FILLER).open("ab", buffering=0) as file, suppress(OSError):
            while (left := self.free_bytes - leave_bytes) > 0:
                file.write(bytes(min(left, 1 << 20)))

    def free(self) -> None:
        """Give back what `fill` took."""
        (self.folder / _FILLER).unlink(missing_ok=True)

    @contextmanager
    def read_only(self) -> Iterator[None]:
        """As a card is that has gone bad: what is open for writing has to be closed before."""
        _run("mount", "-o", "remount,ro", str(self.folder))
        try:
            yield
        finally:
            _run("mount", "-o", "remount,rw", str(self.folder))


@contextmanager
def small_disk(folder: Path, size_bytes: int) -> Iterator[SmallDisk]:
    """A disk of this size at `folder`, which is made; skips the test where that is not allowed."""
    if os.geteuid() != 0:
        pytest.skip("to mount a small disk one has to be root")
    folder.mkdir(parents=True, exist_ok=True)
    mounted = _mount("-t", "tmpfs", "-o", f"size={size_bytes}", "foottile-test", str(folder))
    if mounted.returncode:
        pytest.skip(f"no small disk can be mounted here: {mounted.stderr.strip()}")
    try:
        yield SmallDisk(folder)
    finally:
        _unmount(folder)


class SlowSync:
    """Makes every fsync of a watched process take longer (`bootstrap/fault_recorder.py`).

    Args:
        file: where the seconds are handed over; made.
    """

    def __init__(self, file: Path) -> None:
        self._file = file
        self.set_s(0.0)

    def set_s(self, seconds: float) -> None:
        """From the next fsync on each takes so much longer."""
        hand_over(self._file, str(seconds) if seconds else "")

    def environment(self) -> dict[str, str]:
        """What a process needs in its environment, beside what makes it watched."""
        return {"FAULTS_SLOW": str(self._file)}


def _mount(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(["mount", *arguments], capture_output=True, text=True, check=False)


def _unmount(folder: Path) -> None:
    for _ in range(50):  # a killed process may still be on its way out
        ended = subprocess.run(["umount", str(folder)], capture_output=True, check=False)
        if ended.returncode == 0:
            return
        time.sleep(0.1)
    _run("umount", "--lazy", str(folder))


def _run(*command: str) -> None:
    subprocess.run(command, check=True, capture_output=True, timeout=20.0)
