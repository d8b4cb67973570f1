"""Disks that are slow, full or failing, in this process only."""

from __future__ import annotations

import os
import resource
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import pytest


@contextmanager
def disk_with_room_for(size: int) -> Iterator[None]:
    """No file may grow beyond `size` bytes: a write fails as it does on a full disk."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def before_each_sync_of_frames(monkeypatch: pytest.MonkeyPatch, act: Callable[[], None]) -> None:
    """Have `act` run before every fsync of a segment; what it raises is the disk's answer."""
    real = os.fsync

    def fsync(descriptor: int) -> None:
        if "arrows" in os.readlink(f"/proc/self/fd/{descriptor}"):
            act()
        real(descriptor)

    monkeypatch.setattr(os, "fsync", fsync)
