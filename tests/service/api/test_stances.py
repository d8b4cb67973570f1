"""Stances of sealed sessions: in a file, over REST, overlaid, and rebuilt."""

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


def record_stances(node: FakeNode) -> Recording:
    """Record and seal two stances of 80 N and 80 frames."""
    session = node.record()
    for _ in range(2):
        node.send(100, [0.0, 0.0])
        node.send(80, [20.0, 60.0])
    node.deliver(100, [0.0, 0.0])
    node.finish(session)
    return session


def get(session: Recording, rest: str = "", **headers: str) -> Any:
    return session.running.http.get(f"{session.url}/stances{rest}", headers=headers)


def compute_rows(session: Recording) -> list[dict[str, Any]]:
    """Compute the stances from all frames of the sealed file at once."""
    names = ("seq", "t_ns", "part", *STANCE_INPUT_COLUMNS)
    with session.reader() as file:
        (piece,) = file.read_quantities(*names)
    columns = {name: v.astype(float) if v.dtype == "f4" else v for name, v in piece.items()}
    stances = compute_stances(columns["seq"], columns["t_ns"], columns)
    return [
        {name: None if isinstance(v, float) and math.isnan(v) else v for name, v in row.items()}
        for row in (stance.as_dict() for stance in stances)
    ]


def test_stances_are_stored_with_a_session(tared: FakeNode) -> None:
    session = record_stances(tared)
    stored = read_stances(session.folder / "stances.parquet")
    assert stored.frames_sha256 == session.now()["sha256"]
    rows = get(session).json()
    assert [row["number"] for row in rows] == [1, 2]
    assert rows == stored.table.to_pylist() == compute_rows(session)
    for row in rows:
        assert row["peak_grf_n"] == pytest.approx(80.0, abs=0.1)
        assert row["impulse_n_s"] == pytest.approx(80.0 * row["duration_s"], rel=0.05)
        assert row["frames"] == pytest.approx(80, abs=4)
        assert row["is_whole"]
    arrow = get(session, Accept=ARROW)
    assert arrow.headers["content-type"] == ARROW
    assert pa.ipc.open_stream(arrow.content).read_all().to_pylist() == rows
    report = verify_session(session.folder)
    assert (report.problems, report.unproven) == ([], [])


def test_missing_damaged_and_foreign_stances_are_rebuilt(tared: FakeNode) -> None:
    session, other = record_stances(tared), record_stances(tared)
    path = session.folder / "stances.parquet"
    whole, rows = path.read_bytes(), get(session).json()
    damaged = whole[:100] + bytes([whole[100] ^ 1]) + whole[101:]
    foreign = (other.folder / path.name).read_bytes()
    unproven = ["stances.parquet: it is of other frames, and nobody reads it"]
    for content, is_damaged, expected in (
        (None, False, []),
        (damaged, True, None),
        (foreign, False, unproven),
    ):
        path.unlink()
        if content is not None:
            path.write_bytes(content)
        assert get(session).json() == rows
        assert (path.read_bytes() if path.exists() else None) == content  # no GET writes
        report = verify_session(session.folder)
        problems = [text.partition(": ")[0] for text in report.problems]
        assert problems == ["stances.parquet"] * is_damaged
        assert expected is None or report.unproven == expected
        load_stances(session.folder, store=True)
        assert path.read_bytes() == whole


@pytest.mark.parametrize(
    ("owner", "name", "failing", "reason"),
    [
        pytest.param(
            *(service.sessions.stances, "write_stances"),
            refusing(StorageError, "cannot be written: No space left on device"),
            "stances.parquet was not written, and is rebuilt",
            id="full disk",
        ),
        pytest.param(
            *(StanceDetector, "add_frames", refusing(ZeroDivisionError, "a bug"), "a bug"), id="bug"
        ),
    ],
)
def test_a_seal_succeeds_without_its_stances(
    tared: FakeNode,
    monkeypatch: pytest.MonkeyPatch,
    owner: Any,
    name: str,
    failing: Any,
    reason: str,
) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(owner, name, failing)
        session = record_stances(tared)
    sealed = session.now()
    assert (sealed["state"], sealed["complete"]) == ("sealed", True)
    assert reason in sealed["problem"]
    assert not (session.folder / "stances.parquet").exists()
    assert len(get(session).json()) == 2


def test_a_session_without_stances_has_a_reason(
    running: Running, tared: FakeNode, node_of: NodeOf
) -> None:
    unknown = running.session("20200101T000000Z-00000a")
    assert_refused(get(unknown), 404, "no session")
    session = tared.record()
    assert_refused(get(session), 409, "available when it is sealed")
    assert_refused(get(session, "/overlay"), 409, "Stop it")
    tared.deliver(30, [0.0, 0.0])
    tared.finish(session)
    assert get(session).json() == []
    overlay = get(session, "/overlay").json()
    assert (overlay["overlaid"], overlay["curves"]) == (0, [])
    assert overlay["spread"]["grf_n"]["mean"] == [None] * 101
    bare = node_of(running, "bare", calibration=None)
    bare.connect()
    bare.deliver(10)
    raw = bare.record_sealed(20)
    assert not (raw.folder / "stances.parquet").exists()
    for rest in ("", "/overlay"):
        assert_refused(get(raw, rest), 404, "no estimates: the node had no calibration")


def test_an_overlay_has_the_curves_of_the_file_and_their_spread(tared: FakeNode) -> None:
    session = tared.record()
    for force_n in (60.0, 70.0, 80.0):
        tared.send(100, [0.0, 0.0])
        tared.send(80, [20.0, force_n - 20.0], alive=True)
    tared.send(100, [0.0, 0.0])
    tared.deliver(20, [20.0, 60.0])  # the session ends before this stance
    tared.finish(session)
    rows, overlay = get(session).json(), get(session, "/overlay").json()
    assert (overlay["overlaid"], overlay["not_whole"], overlay["too_short"]) == (3, 1, 0)
    assert [curve["number"] for curve in overlay["curves"]] == [1, 2, 3]
    table = pq.read_table(session.folder / "frames.parquet").to_pydict()
    for row, curve in zip(rows, overlay["curves"], strict=False):
        begin_ns, end_ns = row["begin_t_ns"], row["end_t_ns"]
        since_ns = np.linspace(0.0, 1.0, 101) * (end_ns - begin_ns)
        true_n = np.interp(since_ns, np.array(table["t_ns"]) - begin_ns, table["grf_n"])
        assert curve["grf_n"] == pytest.approx(true_n, abs=1e-3)
    curves = np.array([curve["grf_n"] for curve in overlay["curves"]])
    spread = overlay["spread"]["grf_n"]
    assert spread["mean"] == pytest.approx(curves.mean(axis=0), abs=1e-5)
    assert spread["sd"] == pytest.approx(curves.std(axis=0, ddof=1), abs=1e-5)
    assert spread["count"] == [3] * 101


def test_an_overlay_has_some_curves_and_the_mean_of_all(
    tared: FakeNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    session = record_stances(tared)
    answer = get(session, "/overlay?curves=1&points=11")
    found = answer.json()
    expected = {"points": 11, "whole": 2, "overlaid": 2}
    assert {name: found[name] for name in expected} == expected
    assert len(found["curves"]) == 1
    assert found["spread"]["grf_n"]["count"] == [2] * 11
    with monkeypatch.context() as patch:
        patch.setattr(service.sessions.stances, "STANCES_MAX", 1)
        fewer = get(session, "/overlay?points=11").json()
    assert (fewer["whole"], fewer["overlaid"], fewer["not_whole"]) == (2, 1, 0)
    assert fewer["spread"]["grf_n"]["count"] == [1] * 11
    tag = answer.headers["etag"]
    again = get(session, "/overlay?curves=1&points=11", **{"If-None-Match": tag})
    assert again.status_code == 304
    assert get(session, "/overlay?curves=2").headers["etag"] != tag
    assert_refused(get(session, "/overlay?points=1"), 422, "points")
