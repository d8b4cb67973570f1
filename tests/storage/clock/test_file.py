"""`clock.parquet` beside a session: rows, facts of streams, and what is no clock table."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest

from devices.errors import FileFormatError, UsageError
from storage.clock.log import ClockOffset
from storage.clock.table import StreamClockFacts, read_clock_file, write_clock_file
from storage.parquet_hash import write_hashed_table
from storage.sessions.metadata import load_clock_table
from storage.sessions.reader import SealedFileReader
from storage.sessions.writer import SealedFileWriter
from tests.builders.arrays import make_array
from tests.builders.frames import make_frames

SECOND = 1_000_000_000


def measured(stream_id: str, n: int) -> list[ClockOffset]:
    return [
        ClockOffset(
            stream_id=stream_id,
            t_mono_ns=i * 10 * SECOND,
            server_minus_node_ns=1000 + i,
            uncertainty_ns=50,
        )
        for i in range(n)
    ]


def test_the_file_gives_back_rows_and_facts(tmp_path: Path) -> None:
    rows = [*measured("one", 3), *measured("two", 2)]
    facts = [
        StreamClockFacts("one", 5, True),
        StreamClockFacts("two"),
        StreamClockFacts("three", -7, False),
    ]
    write_clock_file(tmp_path / "clock.parquet", rows, facts)
    stored = read_clock_file(tmp_path / "clock.parquet")
    read = stored.rows_by_stream
    assert stored.offsets == tuple(rows)
    assert {name: len(own) for name, own in read.items()} == {"one": 3, "two": 2}
    assert read["one"].offset_ns.tolist() == [row.server_minus_node_ns for row in rows[:3]]
    assert list(stored.facts.values()) == facts


def test_a_table_without_rows_is_one(tmp_path: Path) -> None:
    write_clock_file(tmp_path / "clock.parquet", [], [StreamClockFacts("one", 5, False)])
    stored = read_clock_file(tmp_path / "clock.parquet")
    assert stored.rows_by_stream == {}
    assert stored.facts["one"].clock_set is False


def numbers(**changed: pa.Array[Any]) -> dict[str, pa.Array[Any]]:
    one = pa.array([1], pa.int64())
    columns: dict[str, pa.Array[Any]] = {
        "stream_id": pa.array(["b"]),
        "t_mono_ns": one,
        "server_minus_node_ns": one,
        "uncertainty_ns": one,
    }
    return columns | changed


@pytest.mark.parametrize(
    "columns",
    [
        {"stream_id": pa.array(["b"])},
        numbers(t_mono_ns=pa.array([None], pa.int64())),
        numbers(stream_id=pa.array([None], pa.string())),
        numbers(uncertainty_ns=pa.array(["much"])),
        numbers(uncertainty_ns=pa.array([0.5])),
    ],
    ids=["columns missing", "empty instant", "empty stream", "text", "fraction"],
)
def test_a_file_that_is_no_clock_table_is_refused(
    tmp_path: Path, columns: dict[str, pa.Array[Any]]
) -> None:
    path = tmp_path / "clock.parquet"
    table = pa.table(columns).replace_schema_metadata({"foottile.streams": "[]"})
    write_hashed_table(path, table)
    with pytest.raises(FileFormatError, match=r"clock\.parquet"):
        read_clock_file(path)


@pytest.mark.parametrize("content", [b"", b"PAR1", b"x" * 1000])
def test_a_file_that_is_no_parquet_is_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "clock.parquet"
    path.write_bytes(content)
    with pytest.raises(FileFormatError):
        read_clock_file(path)


def test_facts_that_are_not_understood_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "clock.parquet"
    for metadata in ({"foottile.streams": json.dumps([1])}, None):
        write_hashed_table(path, pa.table(numbers()).replace_schema_metadata(metadata))
        with pytest.raises(FileFormatError, match="clock table"):
            read_clock_file(path)


# --- beside a session -----------------------------------------------------------------------------


def sealed(folder: Path, notes: dict[str, object]) -> Path:
    info = make_array(1, stream_id="one", nominal_rate_hz=1.0, utc_offset_ns=7, clock_set=False)
    path = folder / "frames.parquet"
    with SealedFileWriter(path, info, notes) as writer:
        frames = make_frames(4, 1, period_ns=SECOND, utc_offset_ns=7)
        writer.append_frames(frames, {"part": np.array([0, 0, 1, 1], dtype=np.uint16)})
    return path


def parts(*stream_ids: str) -> dict[str, object]:
    return {"session": {"parts": [{"stream_id": stream_id} for stream_id in stream_ids]}}


def test_each_part_of_a_session_has_the_clock_of_its_stream(tmp_path: Path) -> None:
    path = sealed(tmp_path, parts("one", "two"))
    facts = [StreamClockFacts("one", 7, False), StreamClockFacts("two", 9, True)]
    write_clock_file(tmp_path / "clock.parquet", measured("two", 3), facts)
    with SealedFileReader(path) as reader:
        table = load_clock_table(reader)
    one, two = table.summarize_streams().streams
    assert (one.stream_id, one.state, one.rows) == ("one", "unsynchronised", 0)
    assert (two.stream_id, two.state, two.rows) == ("two", "measured", 3)
    assert two.stretches[0].begin_t_ns == 9


def test_a_file_that_was_never_recorded_is_of_one_stream(tmp_path: Path) -> None:
    path = sealed(tmp_path, {})
    facts = [StreamClockFacts("one", 7, False)]
    write_clock_file(tmp_path / "clock.parquet", measured("one", 3), facts)
    with SealedFileReader(path) as reader:
        (stream,) = load_clock_table(reader).summarize_streams().streams
    assert (stream.stream_id, stream.state) == ("one", "measured")
    assert stream.stretches[0].begin_t_ns == 7


def test_a_lone_file_has_no_servers_time_and_says_what_is_missing(tmp_path: Path) -> None:
    with (
        SealedFileReader(sealed(tmp_path, {})) as reader,
        pytest.raises(UsageError, match=r"no clock\.parquet beside frames\.parquet"),
    ):
        load_clock_table(reader)


@pytest.mark.parametrize("session", [1, {"parts": 5}, {"parts": [{}]}, {}])
def test_notes_that_name_no_streams_are_refused(tmp_path: Path, session: object) -> None:
    path = sealed(tmp_path, {"session": session})
    write_clock_file(tmp_path / "clock.parquet", measured("one", 3), [])
    with SealedFileReader(path) as reader, pytest.raises(FileFormatError, match="which streams"):
        load_clock_table(reader)
