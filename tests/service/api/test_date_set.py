"""A node whose date is set between two parts of a session: one time axis everywhere."""

from __future__ import annotations

import csv
import io
import time
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

import foottile
from service.pull import pull_export
from storage.formats.load_trace import read_load_to_emulate
from storage.formats.slice import Slice
from storage.formats.writers.registry import get_format
from tests.builders.arrays import PERIOD_NS
from tests.service.fake_node import FakeNode
from tests.service.recording import Recording
from tests.service.running import Running

WRONG_NS = 56 * 365 * 86_400 * 1_000_000_000
"""A Pi without a clock, in its first year."""
GAP_NS = 3_000_000_000
FIRST, SECOND = 200, 150


def connect(node: FakeNode, wrong_ns: int, *, is_measured: bool = True) -> None:
    """Connect with a date that is behind the server's."""
    node.utc_offset_ns -= wrong_ns
    node.greet()
    if is_measured:
        node.say_clock(wrong_ns, uncertainty_ns=9, t_mono_ns=time.monotonic_ns())


@pytest.fixture
def recording(node: FakeNode) -> Recording:
    """A session that goes on: one part in 1970, another one, 3 s later, in the present."""
    connect(node, WRONG_NS)
    node.tared()
    node.acknowledged(69)
    session = node.record()
    node.deliver(FIRST, [20.0, 10.0])
    end_ns = node.next_t_mono_ns
    node.restart()
    connect(node, 0)
    node.next_t_mono_ns = end_ns + GAP_NS
    node.deliver(SECOND, [10.0, 20.0])
    return session


@pytest.fixture
def sealed(node: FakeNode, recording: Recording) -> Recording:
    node.finish(recording)
    return recording


BEGIN_S = (FIRST * PERIOD_NS + GAP_NS) * 1e-9
"""Of the second part, on the axis."""
END_S = BEGIN_S + (SECOND - 1) * PERIOD_NS * 1e-9
SOON_S = 0.005
"""By so much may the two anchors to the node's date differ that the fake node takes."""

LAG_S = 0.011
"""Of a session that is recorded, the newest frames wait for those behind them."""


def table(answer: httpx.Response) -> dict[str, list[str]]:
    rows = list(csv.DictReader(io.StringIO(answer.text)))
    return {name: [row[name] for row in rows] for name in rows[0]} if rows else {}


def overview(session: Recording, **query: Any) -> dict[str, Any]:
    answer = session.running.http.get(f"{session.url}/timeseries", params=query)
    assert answer.status_code == 200, answer.text
    content: dict[str, Any] = answer.json()
    return content


def assert_one_axis(session: Recording) -> None:
    whole = overview(session)
    assert whole["duration_s"] == pytest.approx(END_S, abs=SOON_S + LAG_S)
    assert [part["by"] for part in whole["time_axis"]] == ["node", "server"]
    assert (np.diff(whole["columns"]["t_first_s"]) > 0).all()
    # The second part is asked for, and there is nothing between the two.
    for points in (1, 1000):
        later = overview(session, start_s=BEGIN_S - 1, end_s=BEGIN_S + 0.1, points=points)
        assert set(later["columns"]["part"]) == {1}
        assert min(later["columns"]["t_first_s"]) == pytest.approx(BEGIN_S, abs=SOON_S)
    query = {"format": "csv", "columns": "part,time_s,t_ns,seq"}
    all_of_it = table(session.data(**query))
    assert np.diff(np.array(all_of_it["time_s"], float)).min() > 0
    later = table(session.data(**query, start_s=BEGIN_S - 1))
    assert later["seq"] == [str(i) for i in range(SECOND)]
    earlier = table(session.data(**query, end_s=BEGIN_S - 1))
    assert earlier["part"] == ["0"] * FIRST
    # What the node said stays what it said.
    t_ns = np.array(all_of_it["t_ns"], dtype=np.int64)
    assert np.diff(t_ns).max() > WRONG_NS


def test_a_session_that_is_still_recorded_has_one_time_axis(recording: Recording) -> None:
    assert_one_axis(recording)


def test_a_sealed_session_has_one_time_axis(sealed: Recording) -> None:
    assert_one_axis(sealed)


def test_a_slice_behind_the_end_says_when_the_session_ends(sealed: Recording) -> None:
    answer = sealed.running.http.get(
        f"{sealed.url}/data", params={"format": "csv", "start_s": END_S + 10}
    )
    assert answer.status_code == 422
    assert f"ends at {END_S:.3f}"[:-1] in answer.json()["detail"]


@pytest.mark.parametrize("at_s", [0.1, BEGIN_S + 0.1])
def test_a_mark_is_at_a_frame_of_its_own_part(
    running: Running, sealed: Recording, at_s: float
) -> None:
    query = {"format": "csv", "clock": "server", "columns": "part,time_s,t_server_ns"}
    rows = table(sealed.data(**query))
    row = int(np.argmin(np.abs(np.array(rows["time_s"], float) - at_s)))
    marker = {"label": "here", "t_ns": int(rows["t_server_ns"][row])}
    assert running.http.post(f"{sealed.url}/markers", json=marker).status_code == 201
    part = {"start_s": max(0.0, at_s - 0.05), "end_s": at_s + 0.05}
    marked = table(sealed.data(format="csv", columns="part,time_s,marker", **part))
    (event,) = [i for i, label in enumerate(marked["marker"]) if label]
    assert marked["part"][event] == rows["part"][row]
    assert float(marked["time_s"][event]) == pytest.approx(float(rows["time_s"][row]), abs=1e-6)


def test_no_format_fills_the_years_between(sealed: Recording) -> None:
    frames_of_gap = GAP_NS // PERIOD_NS + FIRST + SECOND
    for name in ("c3d", "opensim", "mcap", "xdf", "mat"):
        for clock in ("node", "server"):
            size = len(sealed.data(format=name, clock=clock).content)
            assert size < 400 * frames_of_gap + 100_000, (name, clock)


def test_a_load_has_no_years_between(sealed: Recording) -> None:
    load = read_load_to_emulate(sealed.folder / "frames.parquet")
    gap_s = (GAP_NS + PERIOD_NS) * 1e-9
    assert np.diff(load.time_s).max() == pytest.approx(gap_s, abs=SOON_S)


def test_the_client_and_pull_give_both_clocks(
    running: Running, sealed: Recording, tmp_path: Path
) -> None:
    with foottile.connect(running.url) as server:
        later = server.session(sealed.id).open("part", start_s=BEGIN_S - 1, clock="server")
        assert set(later["part"]) == {1}
        part = Slice(BEGIN_S - 1, None, ("time_s", "t_server_ns"))
        pulled = pull_export(server, sealed.id, tmp_path, part, get_format("csv"), clock="server")
    with Path(pulled["path"]).open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == SECOND
    steps = np.diff([int(row["t_server_ns"]) for row in rows])
    assert (np.abs(steps - PERIOD_NS) < 10_000).all()


def test_without_a_comparison_the_parts_are_end_to_end(node: FakeNode) -> None:
    connect(node, WRONG_NS)
    node.tared()
    node.acknowledged(69)
    session = node.record()
    node.deliver(FIRST, [20.0, 10.0])
    node.restart()
    connect(node, 0, is_measured=False)
    node.deliver(SECOND, [10.0, 20.0])
    whole = overview(session)
    assert [part["by"] for part in whole["time_axis"]] == ["node", "joined"]
    length_s = (FIRST + SECOND - 1) * PERIOD_NS * 1e-9
    assert whole["duration_s"] == pytest.approx(length_s, abs=LAG_S)
