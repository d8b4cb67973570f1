"""Stances of sealed sessions: beside the frames, over REST, and made again."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

import service.sessions.stances
from devices.errors import StorageError
from service.estimation.stances import STANCE_INPUT_COLUMNS, StanceDetector, compute_stances
from service.sessions.stances import load_stances
from storage.sessions.stances import read_stances
from storage.verify.session import verify_session
from tests.service.fake_node import FakeNode, NodeOf
from tests.service.recording import Recording
from tests.service.running import Running, assert_refused
from tests.storage.faulty_disk import refusing

ARROW = "application/vnd.apache.arrow.stream"


def hopped(node: FakeNode) -> Recording:
    """A sealed session: twice down with 80 N for 80 frames."""
    session = node.record()
    for _ in range(2):
        node.send(100, [0.0, 0.0])
        node.send(80, [20.0, 60.0])
    node.deliver(100, [0.0, 0.0])
    node.finish(session)
    return session


def stances_over_rest(session: Recording, **headers: str) -> Any:
    return session.running.http.get(f"{session.url}/stances", headers=headers)


def from_its_frames(session: Recording) -> list[dict[str, Any]]:
    """By the definition, from the columns of the sealed file all at once."""
    names = ("seq", "t_ns", "part", *STANCE_INPUT_COLUMNS)
    with session.reader() as file:
        pieces = list(file.read_quantities(*names))
    assert len(pieces) == 1
    columns = {
        name: values.astype(float) if values.dtype == "f4" else values
        for name, values in pieces[0].items()
    }
    found = compute_stances(columns["seq"], columns["t_ns"], columns)
    return [
        {name: None if isinstance(v, float) and math.isnan(v) else v for name, v in row.items()}
        for row in (stance.as_dict() for stance in found)
    ]


def test_a_sealed_session_has_its_stances_beside_its_frames_and_over_rest(
    tared: FakeNode,
) -> None:
    session = hopped(tared)
    beside = read_stances(session.folder / "stances.parquet")
    assert beside.frames_sha256 == session.now()["sha256"]
    rows = stances_over_rest(session).json()
    assert [row["number"] for row in rows] == [1, 2]
    assert rows == beside.table.to_pylist() == from_its_frames(session)
    for row in rows:
        assert row["peak_grf_n"] == pytest.approx(80.0, abs=0.1)
        assert row["impulse_n_s"] == pytest.approx(80.0 * row["duration_s"], rel=0.05)
        assert row["frames"] == pytest.approx(80, abs=4)
        assert row["is_whole"]
    arrow = stances_over_rest(session, Accept=ARROW)
    assert arrow.headers["content-type"] == ARROW
    assert pa.ipc.open_stream(arrow.content).read_all().to_pylist() == rows
    assert verify_session(session.folder).problems == []
    assert verify_session(session.folder).unproven == []


def test_stances_that_are_gone_or_damaged_are_made_again_to_the_byte(tared: FakeNode) -> None:
    session = hopped(tared)
    path = session.folder / "stances.parquet"
    whole, rows = path.read_bytes(), stances_over_rest(session).json()
    path.unlink()
    assert stances_over_rest(session).json() == rows
    assert not path.exists()  # no GET writes
    assert verify_session(session.folder).problems == []
    load_stances(session.folder, store=True)
    assert path.read_bytes() == whole
    damaged = whole[:100] + bytes([whole[100] ^ 1]) + whole[101:]
    path.write_bytes(damaged)
    assert stances_over_rest(session).json() == rows
    (said,) = verify_session(session.folder).problems
    assert said.startswith("stances.parquet: ")
    load_stances(session.folder, store=True)
    assert path.read_bytes() == whole


def test_stances_of_other_frames_are_not_read(tared: FakeNode) -> None:
    one, other = hopped(tared), hopped(tared)
    path = one.folder / "stances.parquet"
    whole, rows = path.read_bytes(), stances_over_rest(one).json()
    path.write_bytes((other.folder / path.name).read_bytes())
    assert stances_over_rest(one).json() == rows
    report = verify_session(one.folder)
    assert report.problems == []
    assert report.unproven == ["stances.parquet: it is of other frames, and nobody reads it"]
    load_stances(one.folder, store=True)
    assert path.read_bytes() == whole


def test_a_disk_that_does_not_take_the_stances_holds_no_session_up(
    tared: FakeNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        full = refusing(StorageError, "cannot be written: No space left on device")
        patch.setattr(service.sessions.stances, "write_stances", full)
        session = hopped(tared)
    sealed = session.now()
    assert (sealed["state"], sealed["complete"]) == ("sealed", True)
    assert "stances.parquet was not written, and is rebuilt" in sealed["problem"]
    assert not (session.folder / "stances.parquet").exists()
    assert len(stances_over_rest(session).json()) == 2


def test_what_fails_while_stances_are_gathered_holds_no_session_up(
    tared: FakeNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        fails = refusing(ZeroDivisionError, "a bug")
        patch.setattr(StanceDetector, "add_frames", fails)
        session = hopped(tared)
    assert session.now()["state"] == "sealed"
    assert "a bug" in session.now()["problem"]
    assert len(stances_over_rest(session).json()) == 2


def test_a_session_without_estimates_has_no_stances_and_says_why(
    running: Running, node_of: NodeOf
) -> None:
    node = node_of(running, calibration=None)
    node.connect()
    node.deliver(10)
    session = node.record()
    node.deliver(50, [0.0, 0.0])
    node.finish(session)
    assert not (session.folder / "stances.parquet").exists()
    assert_refused(stances_over_rest(session), 404, "no estimates: the node had no calibration")


def test_stances_are_counted_when_the_session_is_sealed(tared: FakeNode) -> None:
    session = tared.record()
    assert_refused(stances_over_rest(session), 409, "available when it is sealed")
    assert_refused(
        session.running.http.get("/sessions/20200101T000000Z-00000a/stances"), 404, "no session"
    )
    tared.deliver(10)
    tared.finish(session)
    assert stances_over_rest(session).json() == []


def test_stances_one_upon_another_are_those_of_the_file(tared: FakeNode) -> None:
    session = tared.record()
    for force_n in (60.0, 70.0, 80.0):
        tared.send(100, [0.0, 0.0])
        tared.send(80, [20.0, force_n - 20.0], alive=True)
    tared.send(100, [0.0, 0.0])
    tared.deliver(20, [20.0, 60.0])  # ends in the air: nobody saw this one lift off
    tared.finish(session)
    rows = stances_over_rest(session).json()
    found = session.running.http.get(f"{session.url}/stances/overlay").json()
    assert (found["overlaid"], found["not_whole"], found["too_short"]) == (3, 1, 0)
    assert [curve["number"] for curve in found["curves"]] == [1, 2, 3]
    table = pq.read_table(session.folder / "frames.parquet").to_pydict()
    for row, curve in zip(rows, found["curves"], strict=False):
        begin_ns, end_ns = row["begin_t_ns"], row["end_t_ns"]
        since_ns = np.linspace(0.0, 1.0, 101) * (end_ns - begin_ns)
        true_n = np.interp(since_ns, np.array(table["t_ns"]) - begin_ns, table["grf_n"])
        assert curve["grf_n"] == pytest.approx(true_n, abs=1e-3)
    curves = np.array([curve["grf_n"] for curve in found["curves"]])
    spread = found["spread"]["grf_n"]
    assert spread["mean"] == pytest.approx(curves.mean(axis=0), abs=1e-5)
    assert spread["sd"] == pytest.approx(curves.std(axis=0, ddof=1), abs=1e-5)
    assert spread["count"] == [3] * 101


def test_of_many_stances_some_are_there_one_by_one_and_the_mean_is_of_all(
    tared: FakeNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    session = hopped(tared)
    http, url = session.running.http, f"{session.url}/stances/overlay"
    answer = http.get(url, params={"curves": 1, "points": 11})
    found = answer.json()
    assert (found["points"], found["overlaid"], len(found["curves"])) == (11, 2, 1)
    assert found["spread"]["grf_n"]["count"] == [2] * 11
    assert found["whole"] == 2
    with monkeypatch.context() as patch:
        patch.setattr(service.sessions.stances, "STANCES_MAX", 1)
        fewer = http.get(url, params={"points": 11}).json()
    assert (fewer["whole"], fewer["overlaid"], fewer["not_whole"]) == (2, 1, 0)
    assert fewer["spread"]["grf_n"]["count"] == [1] * 11
    tag = answer.headers["etag"]
    again = http.get(url, params={"curves": 1, "points": 11}, headers={"If-None-Match": tag})
    assert again.status_code == 304
    assert http.get(url, params={"curves": 2}).headers["etag"] != tag
    assert_refused(http.get(url, params={"points": 1}), 422, "points")


def test_nothing_is_overlaid_of_what_has_no_stances(
    tared: FakeNode, running: Running, node_of: NodeOf
) -> None:
    session = tared.record()
    assert_refused(running.http.get(f"{session.url}/stances/overlay"), 409, "Stop it")
    tared.deliver(30, [0.0, 0.0])
    tared.finish(session)
    found = running.http.get(f"{session.url}/stances/overlay").json()
    assert (found["overlaid"], found["curves"]) == (0, [])
    assert found["spread"]["grf_n"]["mean"] == [None] * 101
    bare = node_of(running, "bare", calibration=None)
    bare.connect()
    bare.deliver(10)
    raw = bare.record()
    bare.deliver(20)
    bare.finish(raw)
    assert_refused(running.http.get(f"{raw.url}/stances/overlay"), 404, "no estimates")
