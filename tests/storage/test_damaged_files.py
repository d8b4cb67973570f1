"""Files that prove themselves: damage is refused by name, and nothing else is read."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st

from devices.errors import DamagedFileError, FileFormatError
from storage.documents import (
    append_json_checksum,
    read_checksummed_json,
    verify_and_strip_json_checksum,
    write_checksummed_json,
)
from storage.durable_files import set_aside_damaged
from storage.parquet_hash import read_hashed_table, write_hashed_table
from storage.sessions.reader import SealedFileReader
from storage.verify.sealed_file import verify_sealed_file
from tests.builders.frames import assert_same_bits
from tests.storage.sessions.session_files import frames, read, write

TABLE = pa.table({"label": ["a", "slip"], "t_ns": pa.array([1, 2**62], pa.int64())})
Kind = tuple[Callable[[Path], object], Callable[[Path], object], type[FileFormatError], str]


def write_frames(path: Path) -> object:
    return write(path, frames(100), {"seed": 7})


KINDS: dict[str, Kind] = {
    "document.json": (
        lambda path: write_checksummed_json(path, json.dumps({"a": 1, "ä": [None]}).encode()),
        read_checksummed_json,
        DamagedFileError,
        "",
    ),
    "table.parquet": (
        lambda path: write_hashed_table(path, TABLE),
        read_hashed_table,
        DamagedFileError,
        "",
    ),
    "frames.parquet": (write_frames, read, FileFormatError, "cannot be read as Parquet"),
}
"""How a file is written and read, the error when it is damaged, and what it says of rubbish."""
EACH = pytest.mark.parametrize("name", KINDS)
IS_ALL = pytest.mark.parametrize("is_all", [False, pytest.param(True, marks=pytest.mark.soak)])
RUBBISH = [
    *(b"", b" \n", bytes(300), b"\xff" * 300, b"null", b"[" * 100_000, b'{"a": 1}'),
    *(b"PAR1", b"PAR1" * 50, b"time_s,fz_n\n0,1\n", bytes(5000)),
]


def damaged(whole: bytes, every_bytes: int, bits: int) -> Iterator[bytes]:
    """Yield flipped bits, cuts, cuts with zeros behind them, and a byte less or more."""
    for number, at in enumerate(range(0, len(whole), every_bytes)):
        for bit in range(number, number + bits):
            yield whole[:at] + bytes([whole[at] ^ 1 << bit % 8]) + whole[at + 1 :]
        yield whole[:at]
        yield whole[:at] + bytes(len(whole) - at)
        yield whole[:at] + whole[at + 1 :]
        yield whole[:at] + b"x" + whole[at:]
    yield from (whole[:-1], whole + b"\0", whole * 2)


def damage_of(path: Path, is_all: bool) -> Iterator[None]:
    """Yield with each damage done to the file: to about 150 of its bytes, or to all of them."""
    whole = path.read_bytes()
    every_bytes = 1 if is_all else 1 + len(whole) // 150
    for content in damaged(whole, every_bytes, 8 if is_all else 1):
        path.write_bytes(content)
        yield


@EACH
@IS_ALL
def test_any_damage_is_refused_by_name(tmp_path: Path, name: str, is_all: bool) -> None:
    path, (make, open_and_read, error, of_rubbish) = tmp_path / name, KINDS[name]
    make(path)
    open_and_read(path)
    for _ in damage_of(path, is_all):
        with pytest.raises(error, match=re.escape(str(path))):
            open_and_read(path)
    for content in RUBBISH:
        path.write_bytes(content)
        with pytest.raises(error, match=f"{re.escape(str(path))}.*{of_rubbish}"):
            open_and_read(path)


@IS_ALL
def test_damage_of_a_sealed_file_is_a_problem_of_its_verification(
    tmp_path: Path, is_all: bool
) -> None:
    write_frames(path := tmp_path / "frames.parquet")
    assert verify_sealed_file(path).problems == []
    for _ in damage_of(path, is_all):
        assert verify_sealed_file(path).problems


@IS_ALL
def test_a_slice_of_a_damaged_file_is_refused_or_has_the_same_bits(
    tmp_path: Path, is_all: bool
) -> None:
    write_frames(path := tmp_path / "frames.parquet")
    for _ in damage_of(path, is_all):
        with (
            suppress(FileFormatError),
            SealedFileReader(path, only_slices=True) as reader,
        ):
            assert_same_bits(reader.read_frames(), frames(100))


def _folder(path: Path) -> None:
    path.unlink()
    path.mkdir()


def _link(path: Path) -> None:
    path.rename(path.with_name("elsewhere"))
    path.symlink_to("elsewhere")


def _dangling(path: Path) -> None:
    path.unlink()
    path.symlink_to("nowhere")


def _pipe(path: Path) -> None:
    path.unlink()
    os.mkfifo(path)


@pytest.mark.parametrize("name", ["document.json", "table.parquet"])
@pytest.mark.parametrize("change", [_folder, _link, _dangling, _pipe])
def test_a_folder_link_or_pipe_is_damage_and_set_aside(
    tmp_path: Path, name: str, change: Callable[[Path], None]
) -> None:
    path, (make, open_and_read, error, _) = tmp_path / name, KINDS[name]
    with pytest.raises(FileNotFoundError):
        open_and_read(path)
    for number in (1, 2):
        make(path)
        change(path)
        with pytest.raises(error, match=f"{name}.*not a file"):
            open_and_read(path)
        assert set_aside_damaged(path).name == f"{name}.damaged-{number}"
        make(path)
        open_and_read(path)
        path.unlink()
        path.with_name("elsewhere").unlink(missing_ok=True)


def test_a_folder_or_a_missing_file_is_no_sealed_file(tmp_path: Path) -> None:
    nothing = tmp_path / "nothing.parquet"
    for path in (tmp_path, nothing):
        for open_and_read in (read, verify_sealed_file):
            with pytest.raises(FileFormatError, match=re.escape(str(path))):
                open_and_read(path)
    with pytest.raises(FileFormatError, match="cannot be read as Parquet"):
        read(nothing)


objects = st.dictionaries(
    st.text(max_size=5).filter(lambda key: key != "check"),
    st.one_of(st.text(max_size=10), st.integers(), st.none(), st.lists(st.booleans(), max_size=2)),
    min_size=1,
    max_size=4,
)


@given(objects, st.sampled_from([None, 0, 1]), st.data())
def test_any_object_has_one_key_more_and_no_other_byte(
    content: dict[str, object], indent: int | None, data: st.DataObject
) -> None:
    text = append_json_checksum(json.dumps(content, indent=indent).encode())
    found = json.loads(text)
    assert len(found.pop("check")) == 64
    assert found == content
    assert json.loads(verify_and_strip_json_checksum(text, where="")) == content
    at = data.draw(st.integers(0, len(text) - 1))
    for changed in damaged(text[at:], len(text), 8):
        with pytest.raises(DamagedFileError, match=r"a\.json"):
            verify_and_strip_json_checksum(text[:at] + changed, where="a.json")


def test_a_table_is_read_by_any_program_and_damaged_without_its_hash(tmp_path: Path) -> None:
    path = tmp_path / "small.parquet"
    write_hashed_table(path, TABLE.replace_schema_metadata({"foottile.streams": "[]"}))
    found: Any = read_hashed_table(path)
    assert found.to_pylist() == TABLE.to_pylist() == pq.read_table(path).to_pylist()
    assert found.schema.metadata[b"foottile.streams"] == b"[]"
    pq.write_table(pq.read_table(path), path)
    with pytest.raises(DamagedFileError, match="its hash is gone"):
        read_hashed_table(path)
