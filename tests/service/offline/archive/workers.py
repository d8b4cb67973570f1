"""What workers are given to do in tests: by name, as another process imports it."""

from __future__ import annotations

import os
import signal
from pathlib import Path

from service.offline.process_pool import Unfinished


def squared(number: int) -> int:
    return number * number


def raising(number: int) -> int:
    if number == 2:
        raise ValueError("two")
    return number


def counted(path: Path) -> int | Unfinished:
    """Goes on as often as its name says, then says how often it was called."""
    calls = 1 + (int(path.read_text()) if path.exists() else 0)
    path.write_text(str(calls))
    return calls if calls > int(path.name) else Unfinished()


def killed_once(marker: Path) -> str:
    """Killed the first time."""
    if not marker.exists():
        marker.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return marker.name


def killed_at_two(number: int) -> int:
    if number == 2:
        os.kill(os.getpid(), signal.SIGKILL)
    return number
