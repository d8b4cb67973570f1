"""A small table proves itself: no flip and no cut is read as another table."""

from __future__ import annotations

import os
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from devices.errors import DamagedFileError
from storage.parquet_hash import read_hashed_table, write_hashed_table

TABLE = pa.table({"label": ["a", "slip"], "t_ns": pa.array([1, 2**62], pa.int64())})


@pytest.fixture
def path(tmp_path: Path) -> Path:
    path = tmp_path / "small.parquet"
    write_hashed_table(path, TABLE.replace_schema_metadata({"foottile.streams": "[]"}))
    return path


def test_what_is_written_is_read_and_proven_by_any_program(path: Path) -> None:
    read = read_hashed_table(path)
    assert read.to_pylist() == TABLE.to_pylist()
    assert read.schema.metadata[b"foottile.streams"] == b"[]"
    assert pq.read_table(path).to_pylist() == TABLE.to_pylist()


@pytest.mark.parametrize("every_bit", [False, pytest.param(True, marks=pytest.mark.soak)])
def test_no_flipped_bit_is_read(path: Path, every_bit: bool) -> None:
    whole = path.read_bytes()
    for at in range(len(whole)):
        for bit in range(8) if every_bit else (at % 8,):
            damaged = bytearray(whole)
            damaged[at] ^= 1 << bit
            path.write_bytes(damaged)
            with pytest.raises(DamagedFileError, match=r"small\.parquet"):
                read_hashed_table(path)


@pytest.mark.parametrize("every_bytes", [7, pytest.param(1, marks=pytest.mark.soak)])
def test_no_cut_or_longer_file_is_read(path: Path, every_bytes: int) -> None:
    whole = path.read_bytes()
    cut = [whole[:end] for end in range(0, len(whole), every_bytes)]
    for content in (*cut, whole + b"\0", whole * 2):
        path.write_bytes(content)
        with pytest.raises(DamagedFileError):
            read_hashed_table(path)


def test_a_table_without_a_hash_is_damaged(path: Path) -> None:
    pq.write_table(pq.read_table(path), path)
    with pytest.raises(DamagedFileError, match="its hash is gone"):
        read_hashed_table(path)


def test_what_is_no_file_is_not_read(path: Path, tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        read_hashed_table(tmp_path / "none")
    (tmp_path / "link").symlink_to(path)
    (tmp_path / "folder").mkdir()
    os.mkfifo(tmp_path / "pipe")
    for name in ("link", "folder", "pipe"):
        with pytest.raises(DamagedFileError, match="not a file"):
            read_hashed_table(tmp_path / name)
