"""The file of a sealed session: columns and groups, when it appears, what a failure leaves."""

from __future__ import annotations

import os
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from devices.errors import FileFormatError
from devices.flags import CONTACT_UNKNOWN
from devices.frames import NO_SERVO_AGE, NO_SERVO_COUNTS, NOT_READ, FrameBatch
from storage.durable_files import remove_dead_process_temporaries
from storage.sessions import reader
from storage.sessions.reader import SealedFileReader
from storage.sessions.writer import SealedFileWriter
from tests.builders.arrays import make_array
from tests.builders.frames import any_frames, assert_same_bits
from tests.storage.faulty_disk import disk_with_room_for
from tests.storage.sessions.session_files import frames, read, write


@settings(max_examples=30)
@given(
    rows=st.integers(1, 40),
    tiles=st.integers(1, 9),
    seed=st.integers(0, 2**32 - 1),
    cut=st.integers(0, 40),
)
def test_frames_survive_the_file(
    tmp_path_factory: pytest.TempPathFactory, rows: int, tiles: int, seed: int, cut: int
) -> None:
    path = tmp_path_factory.mktemp("round") / "session.parquet"
    rng = np.random.default_rng(seed)
    batch = any_frames(
        rows,
        tiles,
        seed,
        t_mono_ns=np.sort(rng.integers(0, 10**15, rows)),
        # Of all that is not a number the file keeps only that it is none.
        reference_force_n=rng.choice([np.nan, np.inf, -np.inf, -0.0, 1e-40, 29.97], rows),
    )
    with SealedFileWriter(path, make_array(tiles), {}) as writer:
        for piece in (batch.slice_rows(0, cut), batch.slice_rows(cut, rows)):
            if len(piece):
                writer.append_frames(piece, {})
    with SealedFileReader(path) as session:
        assert session.info == make_array(tiles)
        assert session.frame_count == rows
        assert_same_bits(session.read_frames(), batch)


def test_the_columns_are_flat_and_those_of_the_contract_in_order(tmp_path: Path) -> None:
    schema = pq.read_schema(write(tmp_path / "s.parquet", frames(5)))
    assert " ".join(schema.names) == (
        "seq t_mono_ns t_ns pressure_raw_0 pressure_raw_1 temperature_raw_0 temperature_raw_1 "
        "sample_offset_us_0 sample_offset_us_1 servo_counts servo_age_us tile_flags_0 tile_flags_1 "
        "frame_flags reference_force_n"
    )
    types = {name: str(schema.field(name).type) for name in schema.names}
    assert types["seq"] == "uint64"
    assert types["t_ns"] == "int64"
    assert types["pressure_raw_1"] == "uint16"
    assert types["sample_offset_us_0"] == types["servo_counts"] == "int32"
    assert types["tile_flags_1"] == types["frame_flags"] == "uint8"
    assert types["reference_force_n"] == "float"


def test_integers_are_delta_encoded_or_in_dictionaries_floats_split(tmp_path: Path) -> None:
    path = tmp_path / "s.parquet"
    known: dict[str, Any] = {"part": np.zeros(500, np.uint16), "contact": np.ones(500, np.uint8)}
    known |= {"estimate_flags": np.ones(500, np.uint16), "phase": np.array(["rest"] * 500)}
    grf_n = np.random.default_rng(0).normal(size=500)
    write(path, frames(500), grf_n=grf_n, true_grf_n=grf_n, **known)
    group = pq.ParquetFile(path).metadata.row_group(0)
    found: dict[str, set[str]] = {}
    for chunk in (group.column(i) for i in range(group.num_columns)):
        assert chunk.compression == "ZSTD"
        # Levels and dictionaries, too, have encodings, which everybody reads.
        (encoding,) = set(chunk.encodings) - {"RLE", "PLAIN"}
        found.setdefault(encoding, set()).add(chunk.path_in_schema)
    assert found["BYTE_STREAM_SPLIT"] == {"reference_force_n", "grf_n", "true_grf_n"}
    assert found["DELTA_BINARY_PACKED"] == {
        *("seq", "t_mono_ns", "t_ns", "pressure_raw_0", "pressure_raw_1", "servo_counts"),
        *("servo_age_us", "part"),
    }
    assert len(found) == 3
    assert {"temperature_raw_0", "tile_flags_1", "contact", "phase"} <= found["RLE_DICTIONARY"]


def delta_encoded(schema: pa.Schema) -> dict[str, Any]:
    floats = [pa.types.is_floating(field.type) for field in schema]
    names = ["BYTE_STREAM_SPLIT" if is_float else "DELTA_BINARY_PACKED" for is_float in floats]
    return {
        "compression": "zstd",
        "use_dictionary": False,
        "write_page_checksum": True,
        "column_encoding": dict(zip(schema.names, names, strict=True)),
    }


def test_older_encodings_are_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    now = write(tmp_path / "now.parquet", frames(500))
    monkeypatch.setattr("storage.sessions.writer.parquet_options", delta_encoded)
    before = write(tmp_path / "before.parquet", frames(500))
    with SealedFileReader(now) as one, SealedFileReader(before) as other:
        assert_same_bits(one.read_frames(), other.read_frames())
        assert one.content_sha256 == other.content_sha256


def test_a_column_says_to_what_it_was_rounded(tmp_path: Path) -> None:
    path = tmp_path / "s.parquet"
    notes = {"rounded_to": {"grf_n": 0.0625, "pressure_raw": "much"}}
    with SealedFileWriter(path, make_array(), notes) as writer:
        writer.append_frames(frames(5), {"grf_n": np.zeros(5), "grf_sigma_n": np.zeros(5)})
    said = {field.name: field.metadata or {} for field in pq.read_schema(path)}
    assert said["grf_n"][b"rounded_to"] == b"0.0625"
    assert [name for name, metadata in said.items() if b"rounded_to" in metadata] == ["grf_n"]


def test_a_quiet_hour_is_small(tmp_path: Path) -> None:
    # performance.md: some 6 bytes a frame of four tiles where CSV takes 54
    rng = np.random.default_rng(3)
    rows = 20_000
    quiet = replace(
        frames(rows, 4),
        pressure_raw=(380 + np.rint(rng.normal(0, 1.3, (rows, 4)))).astype(np.uint16),
        temperature_raw=(480 + np.rint(rng.normal(0, 0.5, (rows, 4)))).astype(np.uint16),
        sample_offset_us=np.tile(np.array([0, 0, 0, 0], dtype=np.int32), (rows, 1)),
        servo_counts=np.full(rows, NO_SERVO_COUNTS, dtype=np.int32),
        servo_age_us=np.full(rows, NO_SERVO_AGE, dtype=np.int32),
        tile_flags=np.zeros((rows, 4), dtype=np.uint8),
        frame_flags=np.zeros(rows, dtype=np.uint8),
        reference_force_n=np.full(rows, np.nan, dtype=np.float32),
    )
    assert write(tmp_path / "s.parquet", quiet).stat().st_size < 8 * rows


def test_unknown_values_are_null_in_the_file_only(tmp_path: Path) -> None:
    batch = replace(
        frames(4),
        pressure_raw=np.array([[300, NOT_READ]] * 4, dtype=np.uint16),
        temperature_raw=np.array([[NOT_READ, 480]] * 4, dtype=np.uint16),
        servo_counts=np.array([0, NO_SERVO_COUNTS, -1, 7], dtype=np.int32),
        servo_age_us=np.array([NO_SERVO_AGE, 0, 5, 5], dtype=np.int32),
        reference_force_n=np.array([np.nan, 0.0, -1.0, np.inf], dtype=np.float32),
    )
    contact = np.array([0, 1, CONTACT_UNKNOWN, 1], dtype=np.uint8)
    grf_n = np.array([np.nan, 1.0, -0.0, np.inf])
    path = write(tmp_path / "s.parquet", batch, contact=contact, grf_n=grf_n)
    table = pq.read_table(path)
    nulls = {
        name: [row for row, value in enumerate(table.column(name).to_pylist()) if value is None]
        for name in table.column_names
    }
    assert {name: rows for name, rows in nulls.items() if rows} == {
        "pressure_raw_1": [0, 1, 2, 3],
        "temperature_raw_0": [0, 1, 2, 3],
        "servo_counts": [1],
        "servo_age_us": [0],
        "reference_force_n": [0],
        "contact": [2],
        "grf_n": [0],
    }
    with SealedFileReader(path) as session:
        ((back, extra),) = session.read_batches("contact", "grf_n")
    assert_same_bits(back, batch)
    assert extra["contact"].tolist() == contact.tolist()
    np.testing.assert_array_equal(extra["grf_n"], grf_n)


def test_what_is_always_known_cannot_be_null(tmp_path: Path) -> None:
    schema = pq.read_schema(write(tmp_path / "s.parquet", frames(3)))
    known = {name for name in schema.names if not schema.field(name).nullable}
    assert known == {
        *("seq", "t_mono_ns", "t_ns", "frame_flags", "tile_flags_0", "tile_flags_1"),
        *("sample_offset_us_0", "sample_offset_us_1"),
    }


def test_estimates_are_single_truth_is_double_precision(tmp_path: Path) -> None:
    third = np.full(3, 1 / 3)
    path = write(
        tmp_path / "s.parquet",
        frames(3),
        force_n=np.array([[1 / 3, np.nan], [2e-3, 0.1], [1e9, -1.0]]),
        true_grf_n=third,
        pressed_tile=np.array(["T01", None, "T02"], dtype=object),
        estimate_flags=np.array([0, 511, 3], dtype=np.uint16),
    )
    with SealedFileReader(path) as session:
        assert session.has_columns("force_n", "true_grf_n", "pressed_tile")
        assert not session.has_columns("force_n", "grf_n")
        ((_, extra),) = session.read_batches(
            "force_n", "true_grf_n", "pressed_tile", "estimate_flags"
        )
    assert extra["force_n"].dtype == np.float32
    np.testing.assert_array_equal(
        extra["force_n"], np.array([[1 / 3, np.nan], [2e-3, 0.1], [1e9, -1.0]], np.float32)
    )
    assert extra["true_grf_n"].tobytes() == third.tobytes()
    assert extra["pressed_tile"].tolist() == ["T01", None, "T02"]
    assert extra["estimate_flags"].tolist() == [0, 511, 3]


def test_notes_survive_and_may_be_added_late(tmp_path: Path) -> None:
    path = tmp_path / "s.parquet"
    with SealedFileWriter(path, make_array(), {"seed": 7, "scene": {"name": "mud"}}) as writer:
        writer.append_frames(frames(3), {})
        writer.add_notes_before_first_row_group({"lag_ms": 9.2})
    with SealedFileReader(path) as session:
        assert session.notes == {"seed": 7, "scene": {"name": "mud"}, "lag_ms": 9.2}


def test_the_same_session_is_the_same_bytes(tmp_path: Path) -> None:
    notes: dict[str, object] = {"b": 1, "a": 2}
    one = write(tmp_path / "one.parquet", frames(300), notes)
    two = write(tmp_path / "two.parquet", frames(300), dict(reversed(notes.items())))
    assert one.read_bytes() == two.read_bytes()


def test_an_integer_too_large_for_its_column_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(pa.ArrowInvalid):
        write(tmp_path / "s.parquet", frames(2), estimate_flags=np.array([1, 65536 + 1]))
    assert list(tmp_path.iterdir()) == []


def test_a_session_that_was_read_is_closed(tmp_path: Path) -> None:
    path = write(tmp_path / "s.parquet", frames(3))

    def is_open() -> bool:
        return str(path) in {os.path.realpath(fd) for fd in Path("/proc/self/fd").iterdir()}

    with SealedFileReader(path) as session:
        assert len(session.read_frames()) == 3
        assert is_open()
    assert not is_open()


def group_seconds(path: Path) -> list[float]:
    with SealedFileReader(path) as session:
        return [
            float(batch.t_mono_ns[-1] - batch.t_mono_ns[0]) * 1e-9
            for batch, _ in session.read_batches()
        ]


@pytest.mark.parametrize(("period_ns", "rows"), [(50_000_000, 20), (200_000_000, 3000)])
def test_a_row_group_is_about_a_minute(tmp_path: Path, period_ns: int, rows: int) -> None:
    """Also of one long batch: who reads it a group at a time would hold all of it at once."""
    path, batch = tmp_path / "s.parquet", frames(3000, period_ns=period_ns)
    with SealedFileWriter(path, make_array(), {}) as writer:
        for begin in range(0, 3000, rows):
            writer.append_frames(batch.slice_rows(begin, begin + rows), {})
    assert all(59.0 <= s <= 62.0 for s in group_seconds(path)[:-1])
    assert_same_bits(read(path), batch)


def test_row_groups_grow_to_five_minutes(tmp_path: Path) -> None:
    # a footer costs every reader time for each of them
    batch = frames(10 * 3600, period_ns=1_000_000_000)
    path = write(tmp_path / "s.parquet", batch)
    groups = pq.ParquetFile(path).metadata
    rows = [groups.row_group(i).num_rows for i in range(groups.num_row_groups)]
    assert rows[:59] == [60] * 59
    assert max(rows) == 300
    assert len(rows) < 200
    assert_same_bits(read(path), batch)


def test_long_row_groups_are_read_in_pieces(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    batch = frames(5000)
    path = write(tmp_path / "s.parquet", batch)
    monkeypatch.setattr(reader, "_PIECE_VALUES", 1)
    with SealedFileReader(path) as session:
        pieces = [piece for piece, _ in session.read_batches()]
    assert [len(piece) for piece in pieces] == [1024] * 4 + [904]
    assert_same_bits(FrameBatch.concatenate(pieces), batch)


def test_a_gap_of_an_hour_makes_no_group_of_each_frame(tmp_path: Path) -> None:
    batch = frames(300)
    t_mono_ns = batch.t_mono_ns + np.where(np.arange(300) >= 150, 3_600_000_000_000, 0)
    path = tmp_path / "s.parquet"
    with SealedFileWriter(path, make_array(), {}) as writer:
        for begin in range(0, 300, 10):
            writer.append_frames(
                replace(batch, t_mono_ns=t_mono_ns).slice_rows(begin, begin + 10), {}
            )
    assert pq.ParquetFile(path).num_row_groups <= 3


# --- when it appears ------------------------------------------------------------------------------


def names_in(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


@pytest.mark.parametrize("is_replaced", [False, True])
def test_the_file_appears_when_it_is_sealed(tmp_path: Path, is_replaced: bool) -> None:
    path, batch = tmp_path / "s.parquet", frames(3000, period_ns=50_000_000)
    old = write(path, frames(5)).read_bytes() if is_replaced else b""
    with SealedFileWriter(path, make_array(), {}) as writer:
        for begin in range(0, 3000, 300):
            writer.append_frames(batch.slice_rows(begin, begin + 300), {})
            assert (path.read_bytes() if path.exists() else b"") == old
        (name,) = set(names_in(tmp_path)) - {"s.parquet"}  # the first minute is on the disk
        assert name.startswith(f".s.parquet.{os.getpid()}.")
        assert remove_dead_process_temporaries(tmp_path) == []
    assert names_in(tmp_path) == ["s.parquet"]
    assert len(read(path)) == 3000


def fail(path: Path, batch: FrameBatch | None, error: type[BaseException]) -> None:
    """Write the batch, if there is one, and then fail within the block."""
    with SealedFileWriter(path, make_array(), {}) as writer:
        if batch is not None:
            writer.append_frames(batch, {})
        raise error


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt])
@pytest.mark.parametrize("rows", [0, 3000])
@pytest.mark.parametrize("is_there", [False, True])
def test_an_exception_in_the_block_leaves_what_was_there(
    tmp_path: Path, error: type[BaseException], rows: int, is_there: bool
) -> None:
    path, batch = tmp_path / "s.parquet", frames(rows, period_ns=50_000_000) if rows else None
    old = {"s.parquet": write(path, frames(5)).read_bytes()} if is_there else {}
    with pytest.raises(error):
        fail(path, batch, error)
    assert {each.name: each.read_bytes() for each in tmp_path.iterdir()} == old


def test_a_session_without_frames_is_refused_and_leaves_nothing(tmp_path: Path) -> None:
    path = tmp_path / "s.parquet"
    with (
        pytest.raises(FileFormatError, match="no frames"),
        SealedFileWriter(path, make_array(), {}),
    ):
        pass
    assert names_in(tmp_path) == []


def test_a_file_is_synced_before_its_name_and_the_folder_after(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, events = tmp_path / "s.parquet", []
    fsync = os.fsync

    def watched(descriptor: int) -> None:
        target = Path(os.readlink(f"/proc/self/fd/{descriptor}"))
        events.append(("folder" if target == tmp_path else "file", path.exists()))
        fsync(descriptor)

    monkeypatch.setattr(os, "fsync", watched)
    write(path, frames(5))
    assert events == [("file", False), ("folder", True)]


@pytest.mark.parametrize("room", [0, 100, 9000])
def test_a_full_disk_is_an_os_error_and_leaves_nothing_behind(tmp_path: Path, room: int) -> None:
    path, batch = tmp_path / "s.parquet", frames(2000)
    assert write(tmp_path / "whole.parquet", batch).stat().st_size > 10_000
    (tmp_path / "whole.parquet").unlink()
    with pytest.raises(OSError, match=r"[Ff]ile too large|EFBIG"), disk_with_room_for(room):
        write(path, batch)
    assert names_in(tmp_path) == []


def test_a_folder_that_is_not_there_is_an_os_error_that_names_it(tmp_path: Path) -> None:
    with pytest.raises(OSError, match=re.escape(str(tmp_path / "missing"))):
        write(tmp_path / "missing" / "s.parquet", frames(5))
