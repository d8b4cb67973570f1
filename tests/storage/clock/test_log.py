"""Clock rows on disk: appended, read back, and never misread."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from devices.errors import StorageError
from storage.clock.log import ClockLog, ClockLogContent, ClockOffset
from tests.storage.faulty_disk import IO_ERROR, NO_SPACE, failing_if, refusing

INT64 = st.integers(-(2**63), 2**63 - 1)


def row(number: int) -> ClockOffset:
    return ClockOffset(
        stream_id="a" * 32,
        t_mono_ns=10**10 * number,
        server_minus_node_ns=-(10**18) - number,
        uncertainty_ns=1_000_000 + number,
    )


@pytest.fixture
def log(tmp_path: Path) -> ClockLog:
    return ClockLog(tmp_path / "stream")


def filled(log: ClockLog, n: int) -> list[ClockOffset]:
    rows = [row(i) for i in range(n)]
    for one in rows:
        log.append(one)
    return rows


def test_a_log_without_rows_is_empty_and_makes_no_file(log: ClockLog) -> None:
    log.sync()
    assert log.read_undamaged_rows() == ()
    assert not log.path.parent.exists()


@given(
    rows=st.lists(
        st.builds(
            ClockOffset,
            stream_id=st.text(),
            t_mono_ns=INT64,
            server_minus_node_ns=INT64,
            uncertainty_ns=INT64,
        ),
        max_size=4,
    )
)
def test_rows_come_back_in_order(
    tmp_path_factory: pytest.TempPathFactory, rows: list[ClockOffset]
) -> None:
    log = ClockLog(tmp_path_factory.mktemp("log"))
    for one in rows:
        log.append(one)
    log.sync()
    assert list(ClockLog(log.path.parent).read_undamaged_rows()) == rows


def test_a_torn_last_line_costs_that_row_only(log: ClockLog) -> None:
    rows = filled(log, 3)
    whole = log.path.read_bytes()
    begin = whole.rindex(b"\n", 0, -1) + 1
    for end in range(begin, len(whole)):
        log.path.write_bytes(whole[:end])
        assert list(log.read_undamaged_rows())[:2] == rows[:2]
        assert len(log.read_undamaged_rows()) in ({2, 3} if end == len(whole) - 1 else {2})
        log.append(row(9))
        assert log.read_undamaged_rows()[-1] == row(9)
        assert set(log.read_undamaged_rows()) <= {*rows, row(9)}


@pytest.mark.parametrize("every_bit", [False, pytest.param(True, marks=pytest.mark.soak)])
def test_a_flipped_bit_makes_no_other_row(log: ClockLog, every_bit: bool) -> None:
    rows = filled(log, 3)
    whole = log.path.read_bytes()
    first, second = (at for at, byte in enumerate(whole[:-1]) if byte == 10)
    for at in range(len(whole)):
        # Every bit of a row in the middle and of the line ends around it; of its like one of each.
        for bit in range(8) if every_bit or first <= at <= second else (at % 8,):
            damaged = bytearray(whole)
            damaged[at] ^= 1 << bit
            log.path.write_bytes(damaged)
            read = log.read_undamaged_rows()
            assert set(read) <= set(rows)
            assert len(read) >= (1 if whole[at] == 10 else 2)


def test_lines_torn_by_a_power_cut_are_cut_off_before_the_next(log: ClockLog) -> None:
    rows = filled(log, 5)
    whole = log.path.read_bytes()
    begin = 1 + [at for at, byte in enumerate(whole) if byte == 10][1]
    log.path.write_bytes(whole[:begin] + bytes(70) + b"\n" + bytes(5000) + b"\n[]\n" + bytes(9))
    assert log.read_rows_and_damage() == ClockLogContent(
        tuple(rows[:2]), damaged_lines=0, is_torn=True
    )
    log.append(row(9))
    assert log.read_rows_and_damage() == ClockLogContent((*rows[:2], row(9)))
    assert log.path.read_bytes()[:begin] == whole[:begin]


@pytest.mark.parametrize(
    "rubbish",
    [b"\0" * 5000, b"[" * 100_000, b"{}", b"null", b'{"crc32":1}', b"\xff\xfe", b"1e999"],
    ids=["zeros", "deep", "object", "null", "crc", "bytes", "infinity"],
)
def test_rubbish_is_skipped(log: ClockLog, rubbish: bytes) -> None:
    filled(log, 2)
    with log.path.open("ab") as file:
        file.write(rubbish)
    log.append(row(7))
    assert list(log.read_undamaged_rows()) == [row(0), row(1), row(7)]


def test_a_full_disk_keeps_earlier_rows(log: ClockLog, monkeypatch: pytest.MonkeyPatch) -> None:
    rows = filled(log, 3)
    before = log.path.read_bytes()
    row_bytes = len(before) // 3
    write = os.write
    full = failing_if(
        lambda _, data: len(data) < row_bytes, lambda to, data: write(to, data[:11]), *NO_SPACE
    )
    with monkeypatch.context() as patched:
        patched.setattr(os, "write", full)
        with pytest.raises(StorageError, match="No space left") as caught:
            log.append(row(8))
    assert "clock.jsonl" in caught.value.where
    assert log.path.read_bytes() == before
    log.append(row(9))
    assert list(log.read_undamaged_rows()) == [*rows, row(9)]


def test_a_read_only_disk_keeps_the_rows(log: ClockLog, monkeypatch: pytest.MonkeyPatch) -> None:
    rows = filled(log, 3)
    write = os.write

    def full(descriptor: int, data: memoryview) -> int:
        if len(data) > 50:
            return write(descriptor, data[:50])
        raise OSError(errno.EIO, "Input/output error")

    with monkeypatch.context() as patched:
        patched.setattr(os, "write", full)
        patched.setattr(os, "ftruncate", refusing(*IO_ERROR))
        with pytest.raises(StorageError):
            log.append(row(8))
    log.append(row(9))
    assert [r for r in log.read_undamaged_rows() if r != row(8)] == [*rows, row(9)]


def test_appending_reads_only_the_end(log: ClockLog, monkeypatch: pytest.MonkeyPatch) -> None:
    filled(log, 1000)
    read = 0
    pread = os.pread

    def counted(descriptor: int, length: int, offset: int) -> bytes:
        nonlocal read
        read += length
        return pread(descriptor, length, offset)

    monkeypatch.setattr(os, "pread", counted)
    size = log.path.stat().st_size
    log.append(row(1000))
    assert read <= 1024
    assert log.path.stat().st_size - size < 300
