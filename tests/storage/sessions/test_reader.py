"""Sealed files read: which are refused and why, and what a server keeps of those it opens often."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from devices.errors import FileFormatError
from storage.parquet_hash import read_stated_and_actual_hash
from storage.sessions import footer, reader
from storage.sessions.footer import SealedFileFooter
from storage.sessions.reader import SealedFileReader, VerifiedFileCache
from tests.builders.arrays import make_array
from tests.builders.frames import assert_same_bits
from tests.storage.sessions.session_files import frames, read, refused, rewritten, write


def test_somebody_elses_parquet_is_refused_by_name(tmp_path: Path) -> None:
    path = tmp_path / "s.parquet"
    pq.write_table(pa.table({"seq": [1, 2], "grf_n": [1.0, 2.0]}), path)
    refused(path, "states no format.*written by foottile")


NEWER = json.dumps(json.loads(make_array().model_dump_json()) | {"hall_sensors": 4}).encode()
TYPES: list[tuple[str, pa.DataType]] = [
    *(("seq", pa.int64()), ("t_ns", pa.float64()), ("pressure_raw_0", pa.int32())),
    *(("pressure_raw_1", pa.string()), ("tile_flags_0", pa.uint16())),
    ("reference_force_n", pa.float64()),
]


def with_type(name: str, type_: pa.DataType) -> Callable[[pa.Table], pa.Table]:
    return lambda table: table.set_column(
        table.schema.get_field_index(name), name, table.column(name).cast(type_, safe=False)
    )


def with_empty(name: str) -> Callable[[pa.Table], pa.Table]:
    return lambda table: table.set_column(
        table.schema.get_field_index(name),
        name,
        pa.array([1, None, 2, 3, 4], table.schema.field(name).type),
    )


@pytest.mark.parametrize(
    ("change", "metadata", "says"),
    [
        (None, {"format": b"3"}, "format.*3.*Update foottile"),
        (None, {"format": b"3", "array_info": NEWER}, "Update foot"),
        (None, {"format": None}, "format"),
        *(
            (None, {key: text}, None)
            for key in ("notes", "array_info")
            for text in (None, b"", b"{", b"\xff", b"[1]")
        ),
        # a COP of half of the foot would look right
        (None, {"array_info": make_array(1).model_dump_json().encode()}, "1 tiles"),
        (lambda table: table.slice(0, 0), {}, None),
        *(
            (lambda table, name=name: table.drop_columns([name]), {}, name)
            for name in ("seq", "t_ns", "pressure_raw_1", "tile_flags_0", "servo_counts")
        ),
        *((with_type(name, type_), {}, name) for name, type_ in TYPES),
        *(
            (with_empty(name), {}, f"{name} has 1 empty")
            for name in ("seq", "t_mono_ns", "tile_flags_1", "sample_offset_us_0")
        ),
    ],
)
def test_a_table_that_is_none_of_ours_is_refused_although_its_hashes_are_right(
    tmp_path: Path,
    change: Callable[[pa.Table], pa.Table] | None,
    metadata: dict[str, bytes | None],
    says: str | None,
) -> None:
    table = pq.read_table(write(tmp_path / "s.parquet", frames(5)))
    changed = change(table) if change else table
    refused(rewritten(tmp_path / "other.parquet", changed, **metadata), says)


def test_the_keys_of_the_metadata_are_those_of_the_format(tmp_path: Path) -> None:
    metadata = pq.read_schema(write(tmp_path / "s.parquet", frames(5), {"seed": 7})).metadata
    assert metadata[b"foottile.format"] == b"2"
    assert json.loads(metadata[b"foottile.array_info"])["tiles"][1]["serial"] == "T02"
    assert json.loads(metadata[b"foottile.notes"]) == {"seed": 7}


def test_a_column_that_was_asked_for_and_is_not_there_is_refused(tmp_path: Path) -> None:
    path = write(tmp_path / "s.parquet", frames(3))
    with SealedFileReader(path) as session, pytest.raises(FileFormatError, match="grf_n"):
        next(session.read_batches("grf_n"))


def test_a_file_rewritten_by_another_program_is_refused(tmp_path: Path) -> None:
    # Nobody knows what else it has changed.
    path = write(tmp_path / "s.parquet", frames(5))
    pq.write_table(pq.read_table(path), path)
    refused(path, "another program has rewritten it.*pull it again, or use a copy; export it")


def test_columns_that_are_not_ours_are_left_out(tmp_path: Path) -> None:
    batch = frames(5)
    table = pq.read_table(write(tmp_path / "s.parquet", batch))
    table = table.append_column("my_filter_n", pa.array(np.arange(5.0)))
    assert_same_bits(read(rewritten(tmp_path / "more.parquet", table)), batch)


# --- files that a server opens often --------------------------------------------------------------


@pytest.fixture
def hashed(monkeypatch: pytest.MonkeyPatch) -> list[Path]:
    """The files of which all bytes were held against a hash, each time."""
    looked: list[Path] = []

    def counted(path: Path) -> tuple[str, str] | None:
        looked.append(path)
        return read_stated_and_actual_hash(path)

    monkeypatch.setattr(footer, "read_stated_and_actual_hash", counted)
    return looked


def test_a_file_is_hashed_once_and_anew_if_it_changed(tmp_path: Path, hashed: list[Path]) -> None:
    path, files = write(tmp_path / "s.parquet", frames(20)), VerifiedFileCache()
    for _ in range(3):
        files.open_reader(path).close()
    assert hashed == [path]
    whole = path.read_bytes()
    changed = whole.replace(b"temperature_raw_0", b"temperature_raw_x").replace(
        b"temperature_raw_1", b"temperature_raw_0"
    )
    path.write_bytes(
        changed.replace(b"temperature_raw_x", b"temperature_raw_1")
    )  # every page is as it was
    os.utime(path, ns=(1, 1))  # a kernel's ticks are milliseconds
    for _ in range(2):
        for only_slices in (False, True):
            with pytest.raises(FileFormatError, match="changed since it was sealed"):
                files.open_reader(path, only_slices=only_slices)
    path.write_bytes(whole)
    os.utime(path, ns=(2, 2))
    files.open_reader(path).close()
    assert hashed == [path, path]  # of the changed one its footer's own hash was enough


def test_slices_need_the_footers_hash_only(tmp_path: Path, hashed: list[Path]) -> None:
    path, files = write(tmp_path / "s.parquet", frames(20)), VerifiedFileCache()
    for _ in range(2):
        files.open_reader(path, only_slices=True).close()
    assert hashed == []
    for _ in range(2):
        files.open_reader(path).close()
        files.open_reader(path, only_slices=True).close()
    assert hashed == [path]


def test_a_footer_is_read_once_and_anew_if_it_changed(tmp_path: Path) -> None:
    path, files = write(tmp_path / "s.parquet", frames(20)), VerifiedFileCache()
    kept = [files.open_reader(path, only_slices=True).footer for _ in range(2)]
    assert kept[0] is kept[1]
    write(path, frames(30))
    with files.open_reader(path, only_slices=True) as session:
        assert session.footer is not kept[0]
        assert len(session.read_frames()) == 30


def test_a_file_replaced_on_opening_is_read_by_its_own_footer(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, files = write(tmp_path / "s.parquet", frames(20)), VerifiedFileCache()
    files.open_reader(path, only_slices=True).close()
    opened: list[bool] = []

    def replaced(*args: Any, footer: SealedFileFooter | None, **options: Any) -> SealedFileReader:
        if not opened:
            write(path, frames(30))
        opened.append(footer is not None)
        return SealedFileReader(*args, footer=footer, **options)

    monkeypatch.setattr(reader, "SealedFileReader", replaced)
    with files.open_reader(path, only_slices=True) as session:
        assert len(session.read_frames()) == 30
    assert opened == [True, False]


def test_kept_footers_are_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reader, "_MAX_ENTRIES", 2)
    files = VerifiedFileCache()
    for number in range(4):
        files.open_reader(write(tmp_path / f"{number}.parquet", frames(5))).close()
    assert len(files._verified_stamps) == len(files._footers) == 2
    with pytest.raises(FileFormatError, match="cannot be read"):
        files.open_reader(tmp_path / "none.parquet")


def test_the_bytes_of_kept_footers_are_bounded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, hashed: list[Path]
) -> None:
    paths = [write(tmp_path / f"{number}.parquet", frames(5)) for number in range(3)]
    files = VerifiedFileCache()
    first = files.open_reader(paths[0]).footer
    monkeypatch.setattr(reader, "_MAX_FOOTER_BYTES", 2 * first.size_bytes + 100)
    files.open_reader(paths[1]).close()
    assert files.open_reader(paths[0]).footer is first
    files.open_reader(paths[2]).close()
    assert files.open_reader(paths[0]).footer is first
    assert len(files._footers) == 2
    files.open_reader(paths[1]).close()
    assert hashed == paths  # what was forgotten is where its columns are, not that it is whole


def test_a_file_replaced_behind_its_footer_is_read_anew(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write(tmp_path / "s.parquet", frames(20))
    footers: list[SealedFileFooter] = []

    def replaced(*args: Any, **options: Any) -> SealedFileFooter:
        footers.append(SealedFileFooter(*args, **options))
        if len(footers) == 1:
            write(path, frames(30))
        return footers[-1]

    monkeypatch.setattr(reader, "SealedFileFooter", replaced)
    with SealedFileReader(path, only_slices=True) as session:
        assert len(session.read_frames()) == 30
    assert len(footers) == 2
