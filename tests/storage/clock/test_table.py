"""Clock tables: the server's time of frames, summaries of streams, and `clock.parquet`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given
from hypothesis import strategies as st

from devices.errors import FileFormatError, UsageError
from devices.types import OFFSET_NS_END, T_MONO_NS_END, T_NS_END
from storage.clock.bounds import ClockOffsets, OffsetRows
from storage.clock.log import ClockOffset
from storage.clock.table import (
    ClockTable,
    StreamClockFacts,
    group_rows_by_stream_in_given_order,
    read_clock_file,
    write_clock_file,
)
from storage.parquet_hash import write_hashed_table
from storage.schema import UNKNOWN_T_NS
from storage.sessions.metadata import load_clock_table
from storage.sessions.reader import SealedFileReader
from storage.sessions.writer import SealedFileWriter
from tests.builders.arrays import UTC_NS, make_array
from tests.builders.frames import make_frames
from tests.storage.clock.clocks import BEGIN_NS, HOUR, SECOND, Clock, every, rows_of


def table_of(rows: OffsetRows) -> ClockTable:
    return ClockTable({"b": rows}, [StreamClockFacts("b", UTC_NS, True)], ["b"])


@given(
    drifts_ppm=st.tuples(st.floats(-40, 40), st.floats(-40, 40)),
    behind_ns=st.sampled_from([0, HOUR, UTC_NS]),
    seed=st.integers(0, 2**32),
    since_s=st.floats(-20, 320),
)
def test_frames_of_each_part_have_the_servers_time_within_its_bound(
    drifts_ppm: tuple[float, float], behind_ns: int, seed: int, since_s: float
) -> None:
    """The second stream's date is behind the server's by up to all of it."""
    clocks = [Clock((ppm,), n * behind_ns) for n, ppm in enumerate(drifts_ppm)]
    rows = {name: c.measured(every(10, 30), seed) for name, c in zip("ab", clocks, strict=True)}
    facts = [StreamClockFacts(name, UTC_NS, name == "a") for name in "ab"]
    table = ClockTable(rows, facts, ["a", "b"])
    assert [stream.steps for stream in table.summarize_streams().streams] == [(), ()]
    t_mono_ns = np.full(2, BEGIN_NS + round(since_s * SECOND))
    found = table.compute_server_time_columns_or_unknown(
        t_mono_ns, t_mono_ns + UTC_NS, np.array([0, 1], dtype=np.uint16)
    )
    true_ns = t_mono_ns + UTC_NS + np.concatenate([c.at(t_mono_ns[:1]) for c in clocks])
    assert (np.abs(found["t_server_ns"] - true_ns) <= found["t_server_uncertainty_ns"]).all()
    assert (found["t_server_uncertainty_ns"] < 20_000_000).all()


def test_a_summary_has_drift_and_offset_of_a_stream() -> None:
    rows = Clock((40.0,), HOUR).measured(every(10, 30), 1, slow_ns=1e5)
    (stream,) = table_of(rows).summarize_streams().streams
    assert (stream.stream_id, stream.state, stream.rows, stream.steps) == ("b", "measured", 30, ())
    (stretch,) = stream.stretches
    assert stretch.drift_ppm is not None
    assert stretch.drift_uncertainty_ppm is not None
    bounds = ClockOffsets(rows).stretches[0].narrowed_mean_rate_bounds or (0.0, 0.0)
    middle, half = stretch.drift_ppm, stretch.drift_uncertainty_ppm
    assert (middle - half, middle + half) == pytest.approx((1e6 * bounds[0], 1e6 * bounds[1]))
    assert abs(middle - 40.0) <= half < 10
    assert abs(stretch.offset_ns - HOUR - 145 * SECOND * 40e-6) < stretch.uncertainty_ns
    ends_ns = (rows.t_mono_ns[[0, -1]] + UTC_NS).tolist()
    assert [stretch.begin_t_ns, stretch.end_t_ns] == ends_ns


def test_a_server_set_by_an_hour_is_a_step_in_the_summary() -> None:
    rows = Clock((-25.0,), steps=((115 * SECOND, HOUR),)).measured(every(10, 30), 1)
    (stream,) = table_of(rows).summarize_streams().streams
    assert [stretch.rows for stretch in stream.stretches] == [12, 18]
    (step,) = stream.steps
    assert abs(step.jump_ns - HOUR) <= step.jump_uncertainty_ns < 30_000_000
    ends_ns = (rows.t_mono_ns[11:13] + UTC_NS).tolist()
    assert [step.after_t_ns, step.before_t_ns] == ends_ns


@pytest.mark.parametrize(
    ("clock_set", "state"), [(True, "unmeasured"), (None, "unmeasured"), (False, "unsynchronised")]
)
def test_an_unmeasured_stream_has_no_servers_time(clock_set: bool | None, state: str) -> None:
    rows = {"other": rows_of((BEGIN_NS, 5, 1000))}
    facts = [StreamClockFacts("other", UTC_NS, False), StreamClockFacts("mine", 0, clock_set)]
    table = ClockTable(rows, facts, ["other", "mine"])
    assert [stream.state for stream in table.summarize_streams().streams] == ["measured", state]
    at_ns = np.full(3, BEGIN_NS)
    part = np.array([0, 1, 7], dtype=np.uint16)
    for values in table.compute_server_time_columns_or_unknown(at_ns, at_ns, part).values():
        assert (values == UNKNOWN_T_NS).tolist() == [False, True, True]


def test_times_out_of_range_have_no_servers_time() -> None:
    table, zeros = table_of(rows_of((0, 2**60 - 1, 0))), np.zeros(6, dtype=np.int64)
    for end, is_t_ns in ((T_NS_END, True), (T_MONO_NS_END, False)):
        ends = np.array([-(2**63), 2**63 - 1, end, -end, end - 1, 0])
        t_mono_ns, t_ns = (zeros, ends) if is_t_ns else (ends, zeros)
        t_server_ns = table.compute_server_time_columns_or_unknown(t_mono_ns, t_ns, None)[
            "t_server_ns"
        ]
        assert (t_server_ns == UNKNOWN_T_NS).tolist() == [True] * 4 + [False] * 2
        assert t_server_ns[-1] == 2**60 - 1


def test_a_sum_out_of_range_is_no_time() -> None:
    begin_ns = 2**62 - 3 * 10**9
    table = table_of(rows_of((0, begin_ns, 0), (10**14, begin_ns + 2 * 10**9, 0)))
    found = table.compute_server_time_columns_or_unknown(
        np.full(2, 2**59), np.array([2**62 - 1, 0]), None
    )
    for values in found.values():
        assert (values == UNKNOWN_T_NS).tolist() == [True, False]


def test_frames_without_parts_are_of_the_first_stream() -> None:
    rows = {"a": rows_of((0, 0, 0)), "b": rows_of((0, 1, 0))}
    table = ClockTable(rows, [StreamClockFacts("a"), StreamClockFacts("b")], ["a", "b"])
    found = table.compute_server_time_columns_or_unknown(np.array([0]), np.array([7]), None)
    assert found["t_server_ns"].tolist() == [7]


@pytest.mark.parametrize(
    ("t_mono_ns", "offset_ns", "uncertainty_ns", "named"),
    [
        (-T_MONO_NS_END, 0, 0, "t_mono_ns"),
        (T_MONO_NS_END, 0, 0, "t_mono_ns"),
        (0, -(2**63), 0, "server_minus_node_ns"),
        (0, OFFSET_NS_END, 0, "server_minus_node_ns"),
        (0, 0, -1, "uncertainty_ns"),
        (0, 0, 2**63 - 1, "uncertainty_ns"),
        (0, 2**63, 0, "out of range"),
    ],
)
def test_a_row_out_of_range_is_refused_by_column(
    t_mono_ns: int, offset_ns: int, uncertainty_ns: int, named: str
) -> None:
    row = row_of("b", t_mono_ns, offset_ns, uncertainty_ns)
    with pytest.raises(FileFormatError, match=named):
        ClockTable(group_rows_by_stream_in_given_order([row]), [StreamClockFacts("b")], ["b"])


# --- clock.parquet --------------------------------------------------------------------------------


def row_of(stream_id: str, t_mono_ns: int, offset_ns: int, uncertainty_ns: int = 50) -> ClockOffset:
    return ClockOffset(
        stream_id=stream_id,
        t_mono_ns=t_mono_ns,
        server_minus_node_ns=offset_ns,
        uncertainty_ns=uncertainty_ns,
    )


def measured(stream_id: str, n: int) -> list[ClockOffset]:
    return [row_of(stream_id, i * 10 * SECOND, 1000 + i) for i in range(n)]


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "clock.parquet"


@pytest.mark.parametrize("counts", [(3, 2), (0, 0)], ids=["two streams", "no rows"])
def test_the_file_gives_back_rows_and_facts(path: Path, counts: tuple[int, int]) -> None:
    rows = [*measured("one", counts[0]), *measured("two", counts[1])]
    facts = [StreamClockFacts("one", 5, True), StreamClockFacts("two")]
    facts.append(StreamClockFacts("three", -7, False))
    write_clock_file(path, rows, facts)
    stored = read_clock_file(path)
    assert stored.offsets == tuple(rows)
    assert [len(own) for own in stored.rows_by_stream.values()] == [n for n in counts if n]
    for name, own in stored.rows_by_stream.items():
        expected = [row.server_minus_node_ns for row in rows if row.stream_id == name]
        assert own.offset_ns.tolist() == expected
    assert list(stored.facts.values()) == facts


def numbers(**changed: pa.Array[Any]) -> dict[str, pa.Array[Any]]:
    names = ("t_mono_ns", "server_minus_node_ns", "uncertainty_ns")
    columns: dict[str, pa.Array[Any]] = {"stream_id": pa.array(["b"])}
    return columns | {name: pa.array([1], pa.int64()) for name in names} | changed


@pytest.mark.parametrize(
    ("columns", "streams"),
    [
        ({"stream_id": pa.array(["b"])}, "[]"),
        (numbers(t_mono_ns=pa.array([None], pa.int64())), "[]"),
        (numbers(stream_id=pa.array([None], pa.string())), "[]"),
        (numbers(uncertainty_ns=pa.array(["much"])), "[]"),
        (numbers(uncertainty_ns=pa.array([0.5])), "[]"),
        (numbers(), json.dumps([1])),
        (numbers(), None),
    ],
    ids=["columns missing", "no instant", "no stream", "text", "fraction", "bad facts", "no facts"],
)
def test_another_table_is_refused(
    path: Path, columns: dict[str, pa.Array[Any]], streams: str | None
) -> None:
    metadata = None if streams is None else {"foottile.streams": streams}
    write_hashed_table(path, pa.table(columns).replace_schema_metadata(metadata))
    with pytest.raises(FileFormatError, match=r"clock\.parquet.*clock table"):
        read_clock_file(path)


def sealed(path: Path, notes: dict[str, object]) -> SealedFileReader:
    """Frames of two parts beside this clock file."""
    info = make_array(1, stream_id="one", nominal_rate_hz=1.0, utc_offset_ns=7, clock_set=False)
    with SealedFileWriter(path.with_name("frames.parquet"), info, notes) as writer:
        frames = make_frames(4, 1, period_ns=SECOND, utc_offset_ns=7)
        writer.append_frames(frames, {"part": np.array([0, 0, 1, 1], dtype=np.uint16)})
    return SealedFileReader(path.with_name("frames.parquet"))


def test_each_part_of_a_session_has_the_clock_of_its_stream(path: Path) -> None:
    facts = [StreamClockFacts("one", 7, False), StreamClockFacts("two", 9, True)]
    write_clock_file(path, measured("two", 3), facts)
    parts = [{"stream_id": "one"}, {"stream_id": "two"}]
    with sealed(path, {"session": {"parts": parts}}) as reader:
        one, two = load_clock_table(reader).summarize_streams().streams
    assert (one.stream_id, one.state, one.rows) == ("one", "unsynchronised", 0)
    assert (two.stream_id, two.state, two.rows) == ("two", "measured", 3)
    assert two.stretches[0].begin_t_ns == 9


def test_a_file_of_no_session_is_of_one_stream(path: Path) -> None:
    write_clock_file(path, measured("one", 3), [StreamClockFacts("one", 7, False)])
    with sealed(path, {}) as reader:
        (stream,) = load_clock_table(reader).summarize_streams().streams
    assert (stream.stream_id, stream.state) == ("one", "measured")
    assert stream.stretches[0].begin_t_ns == 7


def test_a_lone_file_says_that_its_clock_is_missing(path: Path) -> None:
    missing = r"no clock\.parquet beside frames\.parquet"
    with sealed(path, {}) as reader, pytest.raises(UsageError, match=missing):
        load_clock_table(reader)


@pytest.mark.parametrize("session", [1, {"parts": 5}, {"parts": [{}]}, {}])
def test_notes_without_streams_are_refused(path: Path, session: object) -> None:
    write_clock_file(path, measured("one", 3), [])
    with (
        sealed(path, {"session": session}) as reader,
        pytest.raises(FileFormatError, match="which streams"),
    ):
        load_clock_table(reader)
