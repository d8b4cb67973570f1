"""Sessions in other formats: the same values in each, in pieces, and only what was asked for."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from devices.arrays import Times
from devices.errors import UsageError
from devices.flags import CONTACT_UNKNOWN
from devices.frames import NO_SERVO_COUNTS, NOT_READ, ArrayInfo
from storage.clock.bounds import OffsetRows
from storage.clock.table import ClockTable, StreamClockFacts
from storage.formats.export import make_one_pass_frame_source
from storage.formats.slice import Slice
from storage.schema import ARRAY_INFO_KEY, MEASURED_COLUMNS
from storage.sessions.footer import NOTES_KEY
from tests.builders.arrays import PERIOD_NS, UTC_NS, make_array
from tests.builders.frames import make_frames
from tests.storage.clock.clocks import BEGIN_NS, HOUR, SECOND, Clock, every
from tests.storage.formats.exports import (
    NOTES,
    ROWS,
    TABLES,
    Piece,
    cut,
    export,
    exported,
    extra,
    frames,
    names,
    read,
    values,
)
from tests.storage.formats.walks import DOCUMENT

# --- the same in every format ---------------------------------------------------------------------


@pytest.mark.slow
@settings(max_examples=25)
@given(
    every=st.sampled_from([1, 7, 20, ROWS]),
    start=st.one_of(st.none(), st.integers(0, 2 * ROWS - 2)),
    length=st.one_of(st.none(), st.integers(1, 120)),
    columns=st.lists(
        st.sampled_from(["seq", "t_ns", "pressure_raw_1", "force_n", "grf_n", "contact", "phase"]),
        unique=True,
    ),
)
def test_a_slice_is_the_same_in_each_table_with_its_start_and_without_its_end(
    every: int, start: int | None, length: int | None, columns: list[str]
) -> None:
    # In halves of a period: at frames, and between two of them.
    end = None if length is None else (start or 0) + length
    part = Slice(
        None if start is None else start * PERIOD_NS * 0.5e-9,
        None if end is None else end * PERIOD_NS * 0.5e-9,
        tuple(columns),
    )
    tables = {to: read(exported(to, part, every=every), to) for to in TABLES}
    begin = ((start or 0) + 1) // 2
    expected = range(begin, ROWS if end is None else min((end + 1) // 2, ROWS))
    for to, table in tables.items():
        assert table.num_rows == len(expected), to
        assert table.column_names == tables["arrow"].column_names, to
        if expected:
            assert values(table) == values(tables["arrow"]), to
    if "seq" in tables["arrow"].column_names:
        assert tables["arrow"].column("seq").to_pylist() == [2**60 + i for i in expected]


@pytest.mark.parametrize("to", TABLES)
def test_no_frames_and_a_slice_after_the_end_are_refused_first(to: str) -> None:
    content = make_one_pass_frame_source(cut(frames(), extra(), 20))
    chunks = export(content, make_array(), NOTES, to, Slice(ROWS * 2e-3 + 1))
    with pytest.raises(UsageError, match=r"starts at 1\.1 s, and the session ends at 0\.098 s"):
        next(chunks)
    with pytest.raises(UsageError, match="no frames"):
        next(export(make_one_pass_frame_source([]), make_array(), {}, to, Slice()))


@pytest.mark.parametrize(
    ("start_s", "end_s"),
    [
        *[(bad, None) for bad in (np.nan, np.inf, -np.inf, -1.0, -1e-9, 1e10, 1e308)],
        *[(None, bad) for bad in (np.nan, np.inf, -1.0, 0.0, 1e308)],
        *[(2.0, 1.0), (1.0, 1.0), (0.0, 0.0)],
    ],
)
def test_a_slice_of_no_time_is_refused(start_s: float | None, end_s: float | None) -> None:
    with pytest.raises(UsageError, match=r"the slice"):
        Slice(start_s, end_s)


def test_values_are_the_sessions_and_unknown_ones_are_null() -> None:
    batch, columns = frames(), extra()
    table = read(exported("arrow"), "arrow")
    pressure_raw = [None if v == NOT_READ else v for v in batch.pressure_raw[:, 1].tolist()]
    assert table.column("pressure_raw_1").to_pylist() == pressure_raw
    servo = [None if v == NO_SERVO_COUNTS else v for v in batch.servo_counts.tolist()]
    assert table.column("servo_counts").to_pylist() == servo
    contact = [None if v == CONTACT_UNKNOWN else v for v in columns["contact"].tolist()]
    assert table.column("contact").to_pylist() == contact
    force_n = [None if np.isnan(v) else np.float32(v) for v in columns["force_n"][:, 0]]
    assert table.column("force_n_0").to_pylist() == force_n
    assert table.column("reference_force_n").null_count == ROWS
    assert table.column("t_ns").to_pylist() == batch.t_ns.tolist()
    assert table.column("phase").to_pylist() == columns["phase"].tolist()


def test_all_columns_come_in_the_order_of_a_sealed_file() -> None:
    flat = [f for column in MEASURED_COLUMNS for f in column.flat_names(2)]
    further = ["part", "force_n_0", "force_n_1", "grf_n", "contact", "estimate_flags", "phase"]
    for to in TABLES:
        assert names(Slice(), to) == flat + further


@pytest.mark.parametrize("to", ["parquet", "arrow"])
def test_units_array_and_notes_go_with_it(to: str) -> None:
    schema = read(exported(to, Slice(columns=("force_n", "t_ns"))), to).schema
    units = {field.name: (field.metadata or {}).get(b"unit") for field in schema}
    assert units["force_n_1"] == b"N"
    assert units["t_ns"] == b"ns"
    assert all((field.metadata or {}).get(b"description") for field in schema)
    assert schema.metadata is not None
    assert ArrayInfo.model_validate_json(schema.metadata[ARRAY_INFO_KEY]) == make_array()
    assert json.loads(schema.metadata[NOTES_KEY]) == NOTES


def test_csv_is_lines_with_a_header() -> None:
    part = Slice(0.0, 0.004, ("seq", "contact", "phase"))
    lines = exported("csv", part).decode().splitlines()
    assert [line.replace('"', "") for line in lines[:1]] == ["seq,contact,phase"]
    assert lines[1].startswith(f'{2**60},,"a ""tap')  # the first contact is not known
    assert len(lines) == 3


# --- the server's time ----------------------------------------------------------------------------


def clock() -> ClockTable:
    """The server's clock was set by an hour between the rows at 20 and at 60 ms."""
    hour_ns = 3_600_000_000_000
    rows = OffsetRows(
        np.array([0, 20_000_000, 60_000_000]), np.array([5, 5, 5 + hour_ns]), np.array([100] * 3)
    )
    return ClockTable(
        {"0" * 32: rows}, [StreamClockFacts("0" * 32, 10**18, True)], ["0" * 32, "other"]
    )


def on_servers_axis(to: str, part: Slice | None = None, *, every: int = 20) -> bytes:
    columns = extra()
    columns["part"][30:] = 1
    content = make_one_pass_frame_source(cut(frames(), columns, every))
    return b"".join(export(content, make_array(), NOTES, to, part or Slice(), clock()))


@pytest.mark.parametrize("to", TABLES)
def test_the_servers_time_is_added_and_raw_time_stays(to: str) -> None:
    table = read(on_servers_axis(to), to)
    assert table.column_names[-2:] == ["t_server_ns", "t_server_uncertainty_ns"]
    assert table.column("t_ns").to_pylist() == frames().t_ns.tolist()
    t_server_ns = table.column("t_server_ns").to_pylist()
    bound_ns = table.column("t_server_uncertainty_ns").to_pylist()
    assert t_server_ns[:10] == [t_ns + 5 for t_ns in frames().t_ns[:10].tolist()]
    bounds = table.column("t_server_uncertainty_ns").to_numpy()
    assert (bounds[:10] > 100).all()
    assert (bounds[:10] < 2000).all()
    assert (bounds[10:30] > 1_800_000_000_000).all()
    assert t_server_ns[30:] == bound_ns[30:] == [None] * (ROWS - 30)  # the stream was not measured


@pytest.mark.parametrize("to", TABLES)
def test_any_pieces_give_the_same_servers_time(to: str) -> None:
    part = Slice(columns=("t_server_ns", "t_server_uncertainty_ns"))
    found = read(on_servers_axis(to, part, every=7), to)
    assert found.column_names == list(part.columns)
    assert values(found) == values(read(on_servers_axis(to, part, every=ROWS), to))


@pytest.mark.parametrize("to", ["parquet", "arrow"])
def test_notes_have_the_clock_of_the_servers_time(to: str) -> None:
    schema = read(on_servers_axis(to, Slice(columns=("t_server_ns",))), to).schema
    assert schema.field("t_server_ns").type == pa.int64()
    assert schema.field("t_server_ns").nullable
    assert schema.metadata is not None
    notes = json.loads(schema.metadata[NOTES_KEY])
    (stream,) = notes.pop("clock")["streams"]
    assert stream["state"] == "measured"
    assert [stretch["rows"] for stretch in stream["stretches"]] == [2, 1]
    assert abs(stream["steps"][0]["jump_ns"] - 3_600_000_000_000) < 10_000
    assert notes == NOTES


def test_the_servers_time_has_to_be_asked_for() -> None:
    assert "t_server_ns" not in names(Slice())
    with pytest.raises(UsageError, match="clock `server`"):
        exported("csv", Slice(columns=("t_server_ns",)))


# --- in pieces ------------------------------------------------------------------------------------


@pytest.mark.parametrize("to", TABLES)
def test_chunks_come_while_frames_are_read(to: str) -> None:
    """Of an endless session the beginning comes, and what was given away is kept no longer."""
    rows, asked = 500, 0
    piece = frames(rows)

    def endless() -> Iterator[Piece]:
        nonlocal asked
        while True:
            asked += 1
            later = (asked - 1) * rows * PERIOD_NS
            yield replace(piece, t_ns=piece.t_ns + later), {}

    chunks = export(make_one_pass_frame_source(endless()), make_array(), {}, to, Slice())
    sizes = []
    for number in range(1, 31):
        sizes.append(len(next(chunks)))
        assert asked <= number + 1
    assert all(0 < size < 200 * rows for size in sizes)
    assert max(sizes[1:]) < 1.5 * min(sizes[1:])


@pytest.mark.parametrize("to", TABLES)
def test_frames_outside_of_a_slice_make_no_chunks(to: str) -> None:
    part = Slice(0.09, None, ("seq",))
    content = make_one_pass_frame_source(cut(frames(), extra(), 1))
    chunks = list(export(content, make_array(), {}, to, part))
    assert len(chunks) <= 1 + 5 + 1
    assert read(b"".join(chunks), to).num_rows == 5


@pytest.mark.parametrize("to", TABLES)
def test_a_failing_source_is_no_end_of_file(to: str) -> None:
    def broken() -> Iterator[Piece]:
        yield frames(), {}
        raise OSError("the disk is gone")

    chunks = export(make_one_pass_frame_source(broken()), make_array(), {}, to, Slice())
    next(chunks)
    with pytest.raises(OSError, match="the disk is gone"):
        list(chunks)


# --- rows -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("to", TABLES)
@pytest.mark.parametrize("every", [20, ROWS])
def test_a_slice_between_two_frames_still_has_a_header(to: str, every: int) -> None:
    part = Slice(0.051, 0.0515, ("t_ns", "force_n"))
    table = read(exported(to, part, every=every), to)
    assert table.num_rows == 0
    assert table.column_names == ["t_ns", "force_n_0", "force_n_1"]


def test_only_a_slice_of_everything_is_unrestricted() -> None:
    slices = (Slice(), Slice(start_s=0.0), Slice(columns=("seq",)))
    assert [each.has_all_rows_and_columns for each in slices] == [True, False, False]


# --- columns --------------------------------------------------------------------------------------


@pytest.mark.parametrize("to", TABLES)
@pytest.mark.parametrize(
    ("asked", "expected"),
    [
        (("grf_n", "time_s"), "grf_n time_s"),
        (("force_n",), "force_n_0 force_n_1"),
        (("force_n_1",), "force_n_1"),
        (("t_ns", "seq"), "t_ns seq"),
        (("force_n_1", "seq", "force_n_0"), "force_n_1 seq force_n_0"),
        (("force_n_1", "grf_n", "force_n"), "force_n_1 grf_n force_n_0"),
        (("grf_n", "grf_n", "seq", "grf_n"), "grf_n seq"),
        (("phase", "pressure_raw", "phase"), "phase pressure_raw_0 pressure_raw_1"),
    ],
)
def test_columns_are_of_one_tile_or_of_all_in_the_order_asked_for(
    to: str, asked: tuple[str, ...], expected: str
) -> None:
    assert names(Slice(columns=asked), to) == expected.split()


@pytest.mark.parametrize(
    "unknown", ["magic", "force_n_2", "force_n_", "FORCE_N", "", "true_grf_n", "x" * 10_000, "a\0"]
)
def test_an_unknown_column_is_refused_before_the_first_chunk(unknown: str) -> None:
    content = make_one_pass_frame_source(cut(frames(), extra(), 20))
    chunks = export(content, make_array(), {}, "csv", Slice(columns=("seq", unknown)))
    with pytest.raises(UsageError, match="no column") as caught:
        next(chunks)
    assert len(str(caught.value)) < 1000
    assert "force_n" in caught.value.expected


SLOW_PERIOD_NS = 20_000_000
FRAMES = 3000


def write_export(path: Path, clock: Clock, *, late_ns: int, measured_parts: int) -> Times:
    """Write what `foottile export --clock server` does; return the server's times of frames."""
    t_mono_ns = BEGIN_NS + late_ns + SLOW_PERIOD_NS * np.arange(FRAMES, dtype=np.int64)
    utc_offset_ns = UTC_NS - clock.offset_ns
    info = make_array(
        1, node=path.stem, stream_id="first", utc_offset_ns=utc_offset_ns, clock_set=False
    )
    frames = make_frames(FRAMES, 1, t_mono_ns=t_mono_ns, utc_offset_ns=utc_offset_ns)
    part = (np.arange(FRAMES) >= FRAMES - 100).astype(np.uint16)
    names = ["first", "second"]
    rows = dict.fromkeys(names[:measured_parts], clock.measured(every(10, 7), late_ns, slow_ns=1e6))
    table = ClockTable(rows, [StreamClockFacts(name) for name in names], names)
    content = make_one_pass_frame_source(iter([(frames, {"part": part})]))
    path.write_bytes(b"".join(export(content, info, {}, "parquet", Slice(), table)))
    return t_mono_ns + utc_offset_ns + clock.at(t_mono_ns)


def test_the_documented_lines_put_two_sessions_on_one_axis(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The left clock is an hour behind and slow, the right one fast, and it was never set."""
    pytest.importorskip("pandas", reason="the lines for users need pandas, foottile does not")
    slow, fast = Clock((40.0,), HOUR), Clock((-25.0,), UTC_NS - SECOND)
    left_ns = write_export(tmp_path / "left.parquet", slow, late_ns=0, measured_parts=1)
    right_ns = write_export(tmp_path / "right.parquet", fast, late_ns=3_000_000, measured_parts=2)
    monkeypatch.chdir(tmp_path)
    section = DOCUMENT.read_text("utf-8").split("### Two sessions on one axis")[1]
    said: dict[str, Any] = {}
    exec(section.split("```python\n")[1].split("```")[0], said)  # noqa: S102  # our own page
    both = said["both"].astype({"seq_left": "int64"})
    assert both["seq_left"].tolist() == list(range(FRAMES - 100))  # the last part is unmeasured
    both = both.dropna(subset=["seq_right"]).astype({"seq_right": "int64"})
    assert len(both) == FRAMES - 100
    one, other, apart_ns, bound_ns = (
        both[name].to_numpy(dtype=np.int64)
        for name in ("seq_left", "seq_right", "apart_ns", "apart_uncertainty_ns")
    )
    assert (np.abs(apart_ns - (right_ns[other] - left_ns[one])) <= bound_ns).all()
    assert bound_ns.max() < 20_000_000
