"""Frames in flight: what was taken before SIGKILL is there after it, and nothing else is."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from devices.errors import DamagedFileError
from devices.frames import FrameBatch
from storage.journal.node import in_flight
from storage.journal.node.in_flight import (
    ROW_COUNT,
    InFlightWriter,
    read_in_flight_of_this_boot,
    try_create_in_flight_writer,
    try_delete_in_flight_file,
)
from tests.builders.arrays import make_array
from tests.builders.frames import assert_same_bits
from tests.storage.faulty_disk import NO_SPACE, refusing
from tests.storage.journal.node.leg import frames, take_in_flight


def found(folder: Path) -> FrameBatch:
    left = read_in_flight_of_this_boot(folder)
    assert left is not None
    assert left[1] is not None
    return left[1]


@pytest.mark.parametrize("last", [0, 9, ROW_COUNT - 1, ROW_COUNT, 3 * ROW_COUNT + 17])
def test_the_newest_frames_are_there_whatever_came_before(tmp_path: Path, last: int) -> None:
    take_in_flight(tmp_path / "stream", frames(max(0, last - ROW_COUNT - 50), last))
    assert_same_bits(found(tmp_path / "stream"), frames(max(0, last - ROW_COUNT + 1), last))


def test_the_array_is_known_before_the_first_frame(tmp_path: Path) -> None:
    InFlightWriter(tmp_path, make_array(3)).close()
    assert read_in_flight_of_this_boot(tmp_path) == (make_array(3), None)


def test_after_a_reboot_nothing_is_trusted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    take_in_flight(tmp_path, frames(0, 99))
    monkeypatch.setattr(in_flight, "read_kernel_boot_id", lambda: "another start")
    assert read_in_flight_of_this_boot(tmp_path) is None


@settings(max_examples=60)
@given(data=st.data())
def test_a_damaged_row_never_gives_another_frame(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    folder = tmp_path_factory.mktemp("damaged")
    take_in_flight(folder, frames(0, 199))
    path = folder / "in_flight"
    content = bytearray(path.read_bytes())
    begin = len(content) - ROW_COUNT * ((len(content) - 1000) // ROW_COUNT)
    at = data.draw(st.integers(0, min(len(content) - 1, begin + 20_000)))
    content[at : at + 3] = data.draw(st.binary(min_size=3, max_size=3))
    path.write_bytes(content)
    try:
        left = read_in_flight_of_this_boot(folder)
    except DamagedFileError:
        return
    if left is None or left[1] is None:
        return
    first = int(left[1].seq[0])
    last = int(left[1].seq[-1])
    assert last >= 198 or first == 0
    assert_same_bits(left[1], frames(first, last))


def test_a_full_disk_leaves_nothing_behind(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without room that is reserved, the first write to a mapped page would end the process."""

    monkeypatch.setattr(os, "posix_fallocate", refusing(*NO_SPACE))
    assert try_create_in_flight_writer(tmp_path, make_array()) is None
    assert list(tmp_path.iterdir()) == []
    assert try_create_in_flight_writer(None, make_array()) is None


def test_what_is_no_such_file_is_nothing(tmp_path: Path) -> None:
    assert read_in_flight_of_this_boot(tmp_path) is None
    for content in (b"", bytes(5000)):  # begun, and nothing written yet
        (tmp_path / "in_flight").write_bytes(content)
        assert read_in_flight_of_this_boot(tmp_path) is None
    for content in (b"FootTile", b"FootTile in flight 2".ljust(5000)):
        (tmp_path / "in_flight").write_bytes(content)
        with pytest.raises(DamagedFileError, match="in_flight"):
            read_in_flight_of_this_boot(tmp_path)
    try_delete_in_flight_file(tmp_path)
    try_delete_in_flight_file(tmp_path)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.process
def test_a_killed_process_has_left_every_frame_that_it_had_taken(tmp_path: Path) -> None:
    code = """
import json, sys
from pathlib import Path
from devices.acquisition import AcquiredFrame
from devices.frames import ArrayInfo
from storage.journal.node.in_flight import InFlightWriter
info = ArrayInfo.model_validate_json(sys.stdin.readline())
keeper = InFlightWriter(Path(sys.argv[1]), info)
for seq in range(10_000_000):
    row = AcquiredFrame(seq, seq + 1, seq + 1, 0, 0, 0.0, 0, [1, 2], [3, 4], [5, 6], [0, 0])
    keeper.write_frame(row)
    if seq % 1000 == 999:
        print(seq, flush=True)
"""
    process = subprocess.Popen(
        [sys.executable, "-c", code, str(tmp_path)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert process.stdin is not None
    assert process.stdout is not None
    process.stdin.write(make_array().model_dump_json() + "\n")
    process.stdin.close()
    for _ in range(13):
        said = int(process.stdout.readline())
    process.send_signal(signal.SIGKILL)
    process.wait()
    rest = process.stdout.read().split()
    process.stdout.close()
    said = int(rest[-1]) if rest else said
    batch = found(tmp_path)
    assert int(batch.seq[-1]) >= said
    assert len(batch) in (ROW_COUNT, ROW_COUNT - 1)  # it may have been in the midst of a row
    np.testing.assert_array_equal(batch.t_ns, batch.seq.astype(np.int64) + 1)
