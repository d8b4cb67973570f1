"""The bad disks by themselves."""

from __future__ import annotations

import errno
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.faults.disk import SlowSync, SmallDisk, small_disk
from tests.faults.power import Disk

Run = Callable[..., Any]
MIB = 1 << 20


@pytest.fixture
def small(tmp_path: Path) -> Iterator[SmallDisk]:
    with small_disk(tmp_path / "mnt", 2 * MIB) as disk:
        yield disk


def test_a_full_disk_takes_nothing_more_until_it_is_freed(small: SmallDisk) -> None:
    small.fill()
    with pytest.raises(OSError, match="No space") as refused:
        (small.folder / "a").write_bytes(bytes(5000))
    assert refused.value.errno == errno.ENOSPC
    small.free()
    (small.folder / "a").write_bytes(bytes(5000))


def test_a_disk_can_be_left_with_a_little_room(small: SmallDisk) -> None:
    small.fill(leave_bytes=64 << 10)
    assert 0 < small.free_bytes <= 64 << 10
    (small.folder / "a").write_bytes(bytes(32 << 10))


def test_a_read_only_disk_gives_but_does_not_take(small: SmallDisk) -> None:
    (small.folder / "a").write_bytes(b"old")
    with small.read_only():
        assert (small.folder / "a").read_bytes() == b"old"
        with pytest.raises(OSError, match="Read-only"):
            (small.folder / "b").write_bytes(b"new")
    (small.folder / "b").write_bytes(b"new")


def test_a_watched_folder_on_a_full_disk_gets_its_room_back_by_deleting(
    small: SmallDisk, tmp_path: Path, run_on: Run
) -> None:
    watched = Disk(small.folder / "data", small.folder / "beside", tmp_path / "synced")
    code = """
import os
open("a", "wb").write(bytes(1 << 20))
os.unlink("a")
fd = os.open(".", os.O_RDONLY); os.fsync(fd)
"""
    assert run_on(watched, code).code == 0
    assert small.free_bytes > 1.5 * MIB


def test_a_slow_disk_is_slow_from_when_it_is_told_until_it_is_told_otherwise(
    run: Run, tmp_path: Path
) -> None:
    slow = SlowSync(tmp_path / "slow")
    code = """
import os, time
f = open("a", "wb")
begin = time.monotonic()
os.fsync(f)
print(time.monotonic() - begin)
"""
    slow.set_s(0.3)
    assert float(run(code, **slow.environment()).out) >= 0.3
    slow.set_s(0.0)
    run(code, **slow.environment())
