"""Disks that are slow, full or failing, in this process only."""

from __future__ import annotations

import errno
import os
import resource
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NoReturn

import pytest

NO_SPACE = (OSError, errno.ENOSPC, "No space left on device")
IO_ERROR = (OSError, errno.EIO, "Input/output error")


def refusing(kind: type[BaseException], *facts: object, **more: object) -> Callable[..., NoReturn]:
    """A function that does nothing but fail with this error, each time with a new one."""

    def refuse(*_: object, **__: object) -> NoReturn:
        raise kind(*facts, **more)

    return refuse


def failing_if(
    fails: Callable[..., bool], function: Callable[..., Any], kind: type[Exception], *facts: object
) -> Callable[..., Any]:
    """The function, which fails with this error when `fails` says so of its arguments."""

    def call(*arguments: Any) -> Any:
        if fails(*arguments):
            raise kind(*facts)
        return function(*arguments)

    return call


def failing_once(
    function: Callable[..., Any], kind: type[Exception], *facts: object
) -> Callable[..., Any]:
    """The function, which fails with this error when it is called for the first time."""
    answers = iter([True])
    return failing_if(lambda *_: next(answers, False), function, kind, *facts)


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


def flip_bits(path: Path, at: int | None = None, bits: int = 1) -> None:
    """Flip bits of one byte of a file where it stands, by default of the middle one."""
    with path.open("r+b") as file:
        file.seek(path.stat().st_size // 2 if at is None else at)
        (byte,) = file.read(1)
        file.seek(-1, os.SEEK_CUR)
        file.write(bytes([byte ^ bits]))
