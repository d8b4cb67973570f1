"""GPIO chip of files for processes, through `emulated_gpiod` on their PYTHONPATH."""

from __future__ import annotations

import os
import struct
import time
from collections.abc import Iterable
from pathlib import Path

EMULATED_GPIOD = Path(__file__).parent / "emulated_gpiod"
"""Folder for the PYTHONPATH of a process."""
_RECORD = struct.Struct("<qIB")


class FileChip:
    """Chip in a folder; `path` is the scene's `gpiochip`.

    A process has one request of each input line: edges of a line that nobody has requested wait
    in its FIFO, up to 5000.
    """

    def __init__(self, folder: Path, inputs: Iterable[int] = (17,)) -> None:
        self.path = folder
        folder.mkdir(parents=True, exist_ok=True)
        for line in inputs:
            os.mkfifo(folder / f"line{line}")

    @property
    def environment(self) -> dict[str, str]:
        """Environment of a process that uses this chip."""
        return {"PYTHONPATH": str(EMULATED_GPIOD)}

    def send_edge(
        self,
        t_mono_ns: int | None = None,
        *,
        line: int = 17,
        is_rising: bool = True,
        lost_before: int = 0,
    ) -> int:
        """Send an edge, now by default, after some that the kernel has dropped; return its time."""
        t_mono_ns = time.monotonic_ns() if t_mono_ns is None else t_mono_ns
        fd = os.open(self.path / f"line{line}", os.O_RDWR | os.O_NONBLOCK)
        try:
            os.write(fd, _RECORD.pack(t_mono_ns, lost_before, is_rising))
        finally:
            os.close(fd)
        return t_mono_ns

    def is_high(self, line: int) -> bool:
        """Return the level of an output line."""
        path = self.path / f"line{line}"
        return path.exists() and path.read_text() == "1"

    def read_levels(self, line: int) -> list[tuple[int, bool]]:
        """Return when an output line was driven, and to which level."""
        rows = (self.path / f"line{line}.log").read_text().splitlines()
        return [(int(t_ns), level == "1") for t_ns, level in map(str.split, rows)]
