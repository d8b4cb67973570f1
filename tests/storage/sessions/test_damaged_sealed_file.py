"""Which session files are refused, by name and with the reason."""

from __future__ import annotations

import json
from dataclasses import fields
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from devices.errors import FileFormatError
from devices.frames import (
    FrameBatch,
)
from storage.parquet_hash import FORMAT_KEY
from storage.schema import ARRAY_INFO_KEY
from storage.sessions.footer import NOTES_KEY
from storage.sessions.reader import SealedFileReader
from tests.builders.arrays import make_array
from tests.builders.frames import assert_same_bits
from tests.storage.sessions.session_files import frames, read, refused, rewritten, write


def test_a_file_that_is_not_there_is_refused_by_name(tmp_path: Path) -> None:
    refused(tmp_path / "nothing.parquet", "cannot be read as Parquet")


@pytest.mark.parametrize("content", [b"", b"PAR1", b"time_s,fz_n\n0,1\n", b"\0" * 5000])
def test_a_file_that_is_no_parquet_is_refused_by_name(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "s.parquet"
    path.write_bytes(content)
    refused(path, "cannot be read as Parquet")


def test_a_folder_is_refused_by_name(tmp_path: Path) -> None:
    refused(tmp_path)


def test_somebody_elses_parquet_is_refused_by_name(tmp_path: Path) -> None:
    path = tmp_path / "s.parquet"
    pq.write_table(pa.table({"seq": [1, 2], "grf_n": [1.0, 2.0]}), path)
    refused(path, "states no format.*written by foottile")


def test_a_truncated_file_is_refused_by_name(tmp_path: Path) -> None:
    whole = write(tmp_path / "s.parquet", frames(200)).read_bytes()
    path = tmp_path / "cut.parquet"
    for size in range(0, len(whole), 97):
        path.write_bytes(whole[:size])
        refused(path)


def outcome(path: Path, expected: FrameBatch) -> str:
    """What becomes of a damaged file: an error of ours, an unexpected one, or other values."""
    try:
        batch = read(path)
    except FileFormatError as error:
        return "refused" if str(path) in str(error) else f"refused without its name: {error}"
    except Exception as error:  # whatever it is, it is the finding
        return repr(error)
    columns = [(getattr(batch, f.name), getattr(expected, f.name)) for f in fields(FrameBatch)]
    return "read" if all(np.array_equal(a, b) for a, b in columns) else "changed unnoticed"


def test_no_flipped_bit_is_an_unexpected_error(tmp_path: Path) -> None:
    batch = frames(100)
    whole = write(tmp_path / "s.parquet", batch, {"seed": 7}).read_bytes()
    path, outcomes = tmp_path / "flipped.parquet", {}
    for at in range(0, len(whole), 13):
        damaged = bytearray(whole)
        damaged[at] ^= 0x80 if at % 2 else 0x01
        path.write_bytes(damaged)
        outcomes[at] = outcome(path, batch)
    unexpected = set(outcomes.values()) - {"refused", "read", "changed unnoticed"}
    assert unexpected == set()


def test_no_flipped_bit_of_the_data_changes_a_value_unnoticed(tmp_path: Path) -> None:
    # Parquet pages can carry a checksum. Without, a flip in packed integers is another integer.
    batch = frames(100)
    path = write(tmp_path / "s.parquet", batch)
    whole = path.read_bytes()
    metadata = pq.ParquetFile(path).metadata
    last = metadata.row_group(0).column(metadata.num_columns - 1)
    unnoticed = []
    for at in range(4, last.data_page_offset + last.total_compressed_size, 11):
        damaged = bytearray(whole)
        damaged[at] ^= 0x10
        path.write_bytes(damaged)
        if outcome(path, batch) == "changed unnoticed":
            unnoticed.append(at)
    assert unnoticed == []


def test_a_later_format_says_so_and_what_to_do(tmp_path: Path) -> None:
    table = pq.read_table(write(tmp_path / "s.parquet", frames(5)))
    refused(rewritten(tmp_path / "later.parquet", table, format=b"3"), "format.*3.*Update foottile")
    refused(rewritten(tmp_path / "none.parquet", table, format=None), "format")


def test_a_later_format_says_so_even_if_it_describes_its_array_in_a_new_way(
    tmp_path: Path,
) -> None:
    table = pq.read_table(write(tmp_path / "s.parquet", frames(5)))
    info = json.loads(make_array().model_dump_json()) | {"hall_sensors": 4}
    path = tmp_path / "later.parquet"
    rewritten(path, table, format=b"3", array_info=json.dumps(info).encode())
    refused(path, "Update foottile")


@pytest.mark.parametrize("notes", [None, b"", b"{", b"\xff", b"[1]", b"3"])
def test_notes_that_are_missing_or_damaged_are_refused_by_name(
    tmp_path: Path, notes: bytes | None
) -> None:
    table = pq.read_table(write(tmp_path / "s.parquet", frames(5)))
    refused(rewritten(tmp_path / "other.parquet", table, notes=notes))


@pytest.mark.parametrize("info", [None, b"", b"{}", b"\xff"])
def test_an_array_that_is_missing_or_damaged_is_refused_by_name(
    tmp_path: Path, info: bytes | None
) -> None:
    table = pq.read_table(write(tmp_path / "s.parquet", frames(5)))
    refused(rewritten(tmp_path / "other.parquet", table, array_info=info))


def test_the_keys_of_the_metadata_are_those_of_the_format(tmp_path: Path) -> None:
    metadata = pq.read_schema(write(tmp_path / "s.parquet", frames(5))).metadata
    assert (FORMAT_KEY, ARRAY_INFO_KEY, NOTES_KEY) == (
        b"foottile.format",
        b"foottile.array_info",
        b"foottile.notes",
    )
    assert metadata[FORMAT_KEY] == b"2"
    assert json.loads(metadata[ARRAY_INFO_KEY])["tiles"][1]["serial"] == "T02"


@pytest.mark.parametrize("name", ["seq", "t_ns", "pressure_raw_1", "tile_flags_0", "servo_counts"])
def test_a_file_without_one_of_the_columns_is_refused(tmp_path: Path, name: str) -> None:
    table = pq.read_table(write(tmp_path / "s.parquet", frames(5)))
    refused(rewritten(tmp_path / "other.parquet", table.drop_columns([name])), name)


@pytest.mark.parametrize(
    ("name", "type_"),
    [
        ("seq", pa.int64()),
        ("t_ns", pa.float64()),
        ("pressure_raw_0", pa.int32()),
        ("pressure_raw_1", pa.string()),
        ("tile_flags_0", pa.uint16()),
        ("reference_force_n", pa.float64()),
    ],
)
def test_a_file_with_a_column_of_another_type_is_refused(
    tmp_path: Path, name: str, type_: pa.DataType
) -> None:
    table = pq.read_table(write(tmp_path / "s.parquet", frames(5)))
    at = table.schema.get_field_index(name)
    changed = table.set_column(at, name, table.column(name).cast(type_, safe=False))
    refused(rewritten(tmp_path / "other.parquet", changed), name)


@pytest.mark.parametrize("name", ["seq", "t_mono_ns", "tile_flags_1", "sample_offset_us_0"])
def test_a_file_with_an_empty_value_where_none_may_be_is_refused(tmp_path: Path, name: str) -> None:
    table = pq.read_table(write(tmp_path / "s.parquet", frames(3)))
    at = table.schema.get_field_index(name)
    type_ = table.schema.field(name).type
    changed = table.set_column(at, name, pa.array([1, None, 2], type_))
    refused(rewritten(tmp_path / "other.parquet", changed), f"{name} has 1 empty")


def test_a_column_that_was_asked_for_and_is_not_there_is_refused(tmp_path: Path) -> None:
    path = write(tmp_path / "s.parquet", frames(3))
    with SealedFileReader(path) as session, pytest.raises(FileFormatError, match="grf_n"):
        next(session.read_batches("grf_n"))


def test_a_file_that_another_program_has_rewritten_is_refused_and_says_what_to_do(
    tmp_path: Path,
) -> None:
    # Nobody knows what else it has changed.
    path = write(tmp_path / "s.parquet", frames(5))
    pq.write_table(pq.read_table(path), path)
    refused(path, "another program has rewritten it.*pull it again, or use a copy; export it")


def test_columns_that_are_not_ours_are_left_out(tmp_path: Path) -> None:
    batch = frames(5)
    table = pq.read_table(write(tmp_path / "s.parquet", batch))
    table = table.append_column("my_filter_n", pa.array(np.arange(5.0)))
    assert_same_bits(read(rewritten(tmp_path / "more.parquet", table)), batch)


def test_a_file_that_describes_fewer_tiles_than_it_has_is_refused(tmp_path: Path) -> None:
    # a COP of half of the foot would look right
    table = pq.read_table(write(tmp_path / "s.parquet", frames(5, 4)))
    two = make_array(2).model_dump_json().encode()
    refused(rewritten(tmp_path / "two.parquet", table, array_info=two), "2 tiles")


def test_a_file_whose_rows_were_all_filtered_away_is_refused_by_name(tmp_path: Path) -> None:
    table = pq.read_table(write(tmp_path / "s.parquet", frames(5)))
    refused(rewritten(tmp_path / "none.parquet", table.slice(0, 0)))
