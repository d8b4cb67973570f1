"""Two nodes' sessions on one time axis, with the uncertainty that is stated."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from devices.errors import FileFormatError
from devices.types import OFFSET_NS_END, T_MONO_NS_END, T_NS_END
from storage.clock.bounds import OffsetRows
from storage.clock.log import ClockOffset
from storage.clock.table import ClockTable, StreamClockFacts, group_rows_by_stream
from storage.schema import UNKNOWN_T_NS

SECOND = 1_000_000_000
HOUR = 3600 * SECOND
SERVER_NS = 1_767_225_600 * SECOND
"""The server's UTC when the experiment begins: 2026."""


class NodeClock:
    """A node's clock with its drift, and the rows its server has of it.

    Args:
        booted_ns: how long it had been running when the experiment began.
        wrong_ns: what its UTC is behind the server's then.
        drift_ppm: how much faster the server's clock is.
    """

    def __init__(self, booted_ns: int, wrong_ns: int, drift_ppm: float) -> None:
        self.booted_ns = booted_ns
        self.rate = 1 + drift_ppm * 1e-6
        self.utc_offset_ns = SERVER_NS - wrong_ns - booted_ns

    def t_mono_ns(self, since_ns: int) -> int:
        """What it reads so long after the beginning, by the server's clock."""
        return self.booted_ns + round(since_ns / self.rate)

    def rows(self, stream_id: str, seed: int, *, n: int = 30) -> list[ClockOffset]:
        random = np.random.default_rng(seed)
        rows = []
        for i in range(n):
            go, back = random.exponential((2e6, 7e6)) + 3e5
            asked_ns = i * 10 * SECOND
            sent, came = self.t_mono_ns(asked_ns), self.t_mono_ns(asked_ns + round(go + back))
            middle = (sent + came) // 2
            read_ns = SERVER_NS + asked_ns + round(go)
            rows.append(
                ClockOffset(
                    stream_id=stream_id,
                    t_mono_ns=middle,
                    server_minus_node_ns=read_ns - middle - self.utc_offset_ns,
                    uncertainty_ns=(came - sent + 1) // 2,
                )
            )
        return rows

    def table(self, stream_id: str, seed: int, *, clock_set: bool = True) -> ClockTable:
        facts = StreamClockFacts(stream_id, self.utc_offset_ns, clock_set)
        return ClockTable(group_rows_by_stream(self.rows(stream_id, seed)), [facts], [stream_id])

    def server_ns(self, table: ClockTable, since_ns: int) -> tuple[int, int]:
        """Server's time and bound of a frame that was taken then."""
        t_mono_ns = np.array([self.t_mono_ns(since_ns)])
        columns = table.compute_server_time_columns(t_mono_ns, t_mono_ns + self.utc_offset_ns, None)
        return int(columns["t_server_ns"][0]), int(columns["t_server_uncertainty_ns"][0])


@given(seed=st.integers(0, 2**32), since_s=st.floats(-20, 320))
def test_two_nodes_that_saw_the_same_event_agree_on_when_it_was(seed: int, since_s: float) -> None:
    # One is an hour behind, and its crystal slow; nobody ever set the other's, and it is fast.
    since_ns = round(since_s * SECOND)
    told = []
    for number, node in enumerate(
        (
            NodeClock(booted_ns=300 * SECOND, wrong_ns=HOUR, drift_ppm=40.0),
            NodeClock(booted_ns=900_000 * SECOND, wrong_ns=SERVER_NS - 5 * SECOND, drift_ppm=-25.0),
        )
    ):
        table = node.table(f"boot-{number}", seed + number, clock_set=number == 0)
        t_server_ns, bound_ns = node.server_ns(table, since_ns)
        assert abs(t_server_ns - (SERVER_NS + since_ns)) <= bound_ns
        assert bound_ns < 12_000_000
        told.append((t_server_ns, bound_ns))
    (one_ns, one_bound_ns), (other_ns, other_bound_ns) = told
    assert abs(one_ns - other_ns) <= one_bound_ns + other_bound_ns


def test_a_summary_says_drift_and_offset_of_every_stream() -> None:
    node = NodeClock(booted_ns=300 * SECOND, wrong_ns=HOUR, drift_ppm=40.0)
    (stream,) = node.table("b", 1).summarize_streams().streams
    assert (stream.stream_id, stream.state, stream.rows, stream.steps) == ("b", "measured", 30, ())
    (stretch,) = stream.stretches
    assert stretch.drift_ppm is not None
    assert stretch.drift_uncertainty_ppm is not None
    assert abs(stretch.drift_ppm - 40.0) <= stretch.drift_uncertainty_ppm < 20
    assert abs(stretch.offset_ns - HOUR - 145 * SECOND * 40e-6) < stretch.uncertainty_ns
    assert stretch.begin_t_ns is not None
    assert stretch.end_t_ns is not None
    assert abs(stretch.begin_t_ns - (SERVER_NS - HOUR)) < SECOND
    assert stretch.end_t_ns - stretch.begin_t_ns == pytest.approx(290 * SECOND, rel=1e-3)


def test_the_servers_clock_set_by_an_hour_is_a_step_in_the_summary() -> None:
    node = NodeClock(booted_ns=300 * SECOND, wrong_ns=0, drift_ppm=-25.0)
    rows = [
        row.model_copy(update={"server_minus_node_ns": row.server_minus_node_ns + (i >= 12) * HOUR})
        for i, row in enumerate(node.rows("b", 1))
    ]
    table = ClockTable(
        group_rows_by_stream(rows), [StreamClockFacts("b", node.utc_offset_ns)], ["b"]
    )
    (stream,) = table.summarize_streams().streams
    assert [stretch.rows for stretch in stream.stretches] == [12, 18]
    (step,) = stream.steps
    assert abs(step.jump_ns - HOUR) <= step.jump_uncertainty_ns < 30_000_000
    assert step.after_t_ns == rows[11].t_mono_ns + node.utc_offset_ns
    assert step.before_t_ns == rows[12].t_mono_ns + node.utc_offset_ns
    _, before = node.server_ns(table, 105 * SECOND)
    _, torn = node.server_ns(table, 115 * SECOND)
    assert before < 20_000_000
    assert torn > HOUR / 2


def test_a_node_that_was_started_anew_an_hour_off_has_two_streams_and_no_step() -> None:
    first = NodeClock(booted_ns=300 * SECOND, wrong_ns=0, drift_ppm=40.0)
    second = NodeClock(booted_ns=20 * SECOND, wrong_ns=HOUR, drift_ppm=40.0)
    table = ClockTable(
        group_rows_by_stream([*second.rows("two", 2), *first.rows("one", 1)]),
        [
            StreamClockFacts("one", first.utc_offset_ns),
            StreamClockFacts("two", second.utc_offset_ns),
        ],
        ["one", "two"],
    )
    assert [len(stream.steps) for stream in table.summarize_streams().streams] == [0, 0]
    t_mono_ns = np.array([first.t_mono_ns(SECOND), second.t_mono_ns(SECOND)])
    t_ns = t_mono_ns + np.array([first.utc_offset_ns, second.utc_offset_ns])
    columns = table.compute_server_time_columns(t_mono_ns, t_ns, np.array([0, 1], dtype=np.uint16))
    errors = columns["t_server_ns"] - (SERVER_NS + SECOND)
    assert (np.abs(errors) <= columns["t_server_uncertainty_ns"]).all()
    assert t_ns[0] - t_ns[1] == HOUR  # raw stays as it was


@pytest.mark.parametrize(
    ("clock_set", "state"),
    [(True, "unmeasured"), (None, "unmeasured"), (False, "unsynchronised")],
)
def test_a_stream_that_nobody_measured_gets_no_time(clock_set: bool | None, state: str) -> None:
    node = NodeClock(booted_ns=300 * SECOND, wrong_ns=0, drift_ppm=0.0)
    table = ClockTable(
        group_rows_by_stream(node.rows("other", 1)),
        [StreamClockFacts("other", node.utc_offset_ns), StreamClockFacts("mine", 0, clock_set)],
        ["other", "mine"],
    )
    assert [stream.state for stream in table.summarize_streams().streams] == ["measured", state]
    t_mono_ns = np.array([node.t_mono_ns(0)] * 3)
    part = np.array([0, 1, 7], dtype=np.uint16)
    columns = table.compute_server_time_columns(t_mono_ns, t_mono_ns, part)
    for values in columns.values():
        assert (values == UNKNOWN_T_NS).tolist() == [False, True, True]


def test_an_unsynchronised_node_that_was_measured_is_measured() -> None:
    node = NodeClock(booted_ns=300 * SECOND, wrong_ns=0, drift_ppm=0.0)
    table = node.table("b", 1, clock_set=False)
    assert table.summarize_streams().streams[0].state == "measured"


def test_instants_that_are_none_get_no_servers_time() -> None:
    rows = {"b": OffsetRows(np.array([0]), np.array([2**60 - 1]), np.array([0]))}
    table = ClockTable(rows, [StreamClockFacts("b")], ["b"])
    end = T_NS_END
    ends = np.array([-(2**63), 2**63 - 1, end, -end, end - 1, 0])
    columns = table.compute_server_time_columns(np.zeros(6, dtype=np.int64), ends, None)
    assert (columns["t_server_ns"] == UNKNOWN_T_NS).tolist() == [True] * 4 + [False] * 2
    assert columns["t_server_ns"][-1] == 2**60 - 1
    end = T_MONO_NS_END
    ends = np.array([-(2**63), 2**63 - 1, end, -end, end - 1, 0])
    columns = table.compute_server_time_columns(ends, np.zeros(6, dtype=np.int64), None)
    assert (columns["t_server_ns"] == UNKNOWN_T_NS).tolist() == [True] * 4 + [False] * 2


def test_a_sum_that_is_no_instant_is_none() -> None:
    begin_ns = 2**62 - 3 * 10**9
    rows = OffsetRows(np.array([0, 10**14]), begin_ns + np.array([0, 2 * 10**9]), np.array([0, 0]))
    table = ClockTable({"b": rows}, [StreamClockFacts("b")], ["b"])
    t_ns = np.array([2**62 - 1, 0])
    columns = table.compute_server_time_columns(np.array([2**59, 2**59]), t_ns, None)
    assert (columns["t_server_ns"] == UNKNOWN_T_NS).tolist() == [True, False]
    assert (columns["t_server_uncertainty_ns"] == UNKNOWN_T_NS).tolist() == [True, False]


def test_frames_without_parts_are_of_the_first() -> None:
    rows = {
        name: OffsetRows(np.array([0]), np.array([i]), np.array([0])) for i, name in enumerate("ab")
    }
    table = ClockTable(rows, [StreamClockFacts("a"), StreamClockFacts("b")], ["a", "b"])
    columns = table.compute_server_time_columns(np.array([0]), np.array([7]), None)
    assert columns["t_server_ns"].tolist() == [7]


@pytest.mark.parametrize(
    ("t_mono_ns", "offset_ns", "uncertainty_ns", "named"),
    [
        (-T_MONO_NS_END, 0, 0, "t_mono_ns"),
        (T_MONO_NS_END, 0, 0, "t_mono_ns"),
        (2**63 - 1, 0, 0, "t_mono_ns"),
        (0, -(2**63), 0, "server_minus_node_ns"),
        (0, OFFSET_NS_END, 0, "server_minus_node_ns"),
        (0, 0, -1, "uncertainty_ns"),
        (0, 0, 2**63 - 1, "uncertainty_ns"),
        (0, 2**63, 0, "out of range"),
    ],
)
def test_a_row_that_cannot_be_is_refused_by_name(
    t_mono_ns: int, offset_ns: int, uncertainty_ns: int, named: str
) -> None:
    row = ClockOffset(
        stream_id="b",
        t_mono_ns=t_mono_ns,
        server_minus_node_ns=offset_ns,
        uncertainty_ns=uncertainty_ns,
    )
    with pytest.raises(FileFormatError, match=named):
        ClockTable(group_rows_by_stream([row]), [StreamClockFacts("b")], ["b"])
