"""Marks in downloads: also those made after sealing, whatever the node's clock says."""

from __future__ import annotations

import csv
import io
import json
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

import foottile
from devices.errors import StorageError
from service.pull import pull_session
from storage.sessions.folder import Session
from storage.sessions.metadata import read_existing_markers, write_markers
from tests.service.command import command
from tests.service.fake_node import FakeNode
from tests.service.recording import Recording
from tests.service.running import Running, assert_refused
from tests.waiting import until

HOUR_NS = 3_600_000_000_000
MARKED = 50


@pytest.fixture
def session(running: Running, node: FakeNode) -> Recording:
    """A sealed session of 200 frames of a node whose clock is an hour behind."""
    node.utc_offset_ns -= HOUR_NS
    node.greet()
    node.say_clock(HOUR_NS, uncertainty_ns=1000)
    until(lambda: running.node(node.name)["clock"] is not None)
    node.tared()
    session = node.record()
    node.send(200, [20.0, 60.0])
    node.taken_in()
    node.finish(session)
    return session


def marker(session: Recording, label: str, *, frame: int = MARKED, **body: Any) -> dict[str, Any]:
    """Mark the instant of a frame, in the server's time."""
    t_ns = int(session.column("t_ns")[frame]) + HOUR_NS
    answer = session.running.http.post(
        f"{session.url}/markers", json={"label": label, "t_ns": t_ns} | body
    )
    assert answer.status_code == 201, answer.text
    event: dict[str, Any] = answer.json()
    return event


def labels(table: pa.Table) -> dict[int, str]:
    return {i: label for i, label in enumerate(table["marker"].to_pylist()) if label is not None}


def test_a_mark_made_after_sealing_is_at_its_frame_in_every_format(session: Recording) -> None:
    sealed = session.data().content
    marker(session, "a stone")
    arrow = session.data(format="arrow")
    assert labels(pa.ipc.open_file(arrow.content).read_all()) == {MARKED: "a stone"}
    parquet = session.data(markers="true")
    assert labels(pq.read_table(io.BytesIO(parquet.content))) == {MARKED: "a stone"}
    rows = list(csv.DictReader(io.StringIO(session.data(format="csv").text)))
    assert {i: row["marker"] for i, row in enumerate(rows) if row["marker"]} == {MARKED: "a stone"}
    for answer in (arrow, parquet):
        assert answer.headers["foottile-markers"] == "placed=1, left-out=0"
    assert session.data().content == sealed  # as it was sealed, with the hash that it had


def test_marks_can_be_left_out_and_parquet_has_them_on_request_only(session: Recording) -> None:
    marker(session, "a stone")
    for query in (
        {},
        {"format": "csv", "markers": "false"},
        {"format": "arrow", "markers": "false"},
    ):
        answer = session.data(**query)
        assert "foottile-markers" not in answer.headers
        assert b"marker" not in answer.content[:1000]
    refused = session.running.http.get(
        f"{session.url}/data", params={"columns": "marker", "format": "parquet"}
    )
    assert_refused(refused, 422, "marker", "markers")


def test_all_other_columns_have_the_bits_of_the_sealed_file(session: Recording) -> None:
    marker(session, "a stone")
    whole = session.data(markers="true", format="parquet")
    table = pq.read_table(io.BytesIO(whole.content)).drop_columns(["marker", "time_s", "time_utc"])
    assert table.equals(
        pq.read_table(io.BytesIO(session.data().content)).select(table.column_names)
    )


def test_the_tag_changes_with_every_mark_and_not_without_one(session: Recording) -> None:
    url = f"{session.url}/data"
    for query in ({"format": "csv"}, {"format": "arrow"}, {"markers": "true"}):
        tag = session.data(**query).headers["etag"]
        assert tag.startswith('"')
        seen = {"If-None-Match": tag}
        assert session.running.http.get(url, params=query, headers=seen).status_code == 304
        marker(session, "one more")
        again = session.running.http.get(url, params=query, headers=seen)
        assert again.status_code == 200
        assert again.headers["etag"] != tag
    assert session.data().headers["etag"] == f'"{session.now()["sha256"]}"'
    plain = {"format": "csv", "markers": "false"}
    tag = session.data(**plain).headers["etag"]
    marker(session, "of no concern")
    assert session.data(**plain).headers["etag"] == tag


def test_what_has_marks_has_no_ranges_and_is_never_pieced_together(session: Recording) -> None:
    marker(session, "a stone")
    whole = session.data(markers="true")
    assert whole.headers["accept-ranges"] == "none"
    sealed = session.now()["sha256"]
    for tag in (whole.headers["etag"], f'"{sealed}"'):
        answer = session.running.http.get(
            f"{session.url}/data",
            params={"markers": "true"},
            headers={"Range": "bytes=0-9", "If-Range": tag},
        )
        assert answer.status_code == 200
        assert answer.content == whole.content
    for tag in (whole.headers["etag"], f'"{"0" * 64}"'):  # of something else
        answer = session.running.http.get(
            f"{session.url}/data", headers={"Range": "bytes=0-9", "If-Range": tag}
        )
        assert answer.status_code == 200


def test_a_mark_far_from_every_frame_is_counted_as_left_out(session: Recording) -> None:
    marker(session, "years ago", t_ns=5)
    marker(session, "a stone")
    answer = session.data(format="arrow")
    assert answer.headers["foottile-markers"] == "placed=1, left-out=1"
    table = pa.ipc.open_file(answer.content).read_all()
    assert labels(table) == {MARKED: "a stone"}
    early, _ = json.loads(table.schema.metadata[b"foottile.notes"])["markers"]
    assert (early["label"], early["left_out"]) == ("years ago", "no frame within a second of it")
    sliced = session.data(format="csv", end_s=0.01, columns="seq,marker")
    assert sliced.headers["foottile-markers"] == "placed=0, left-out=2"


def test_a_session_that_is_still_recorded_has_its_marks_at_their_frames(
    session: Recording, node: FakeNode
) -> None:
    recording = node.record()
    node.deliver(100, [5.0, 0.0])
    before = pa.ipc.open_file(recording.data(format="arrow").content).read_all()
    assert labels(before) == {}
    t_ns = int(before["t_ns"][7].as_py()) + HOUR_NS
    answer = node.running.http.post(
        f"{recording.url}/markers", json={"label": "a stone", "t_ns": t_ns}
    )
    assert answer.status_code == 201
    after = recording.data(format="arrow")
    assert labels(pa.ipc.open_file(after.content).read_all()) == {7: "a stone"}
    assert after.headers["etag"].startswith('W/"')


def test_a_session_says_how_many_marks_it_has(session: Recording) -> None:
    assert session.now()["marker_count"] == 0
    event = marker(session, "a stone")
    marker(session, "a stone", id=event["id"])  # sent twice is marked once
    marker(session, "another")
    assert session.now()["marker_count"] == 2
    assert [s["marker_count"] for s in session.running.sessions()] == [2]


@pytest.mark.parametrize("label", ["\ud800", "ab\udfff", ""])
def test_a_label_that_is_no_text_is_refused(session: Recording, label: str) -> None:
    content = json.dumps({"label": label})
    answer = session.running.http.post(
        f"{session.url}/markers", content=content, headers={"Content-Type": "application/json"}
    )
    assert_refused(answer, 422, "label")
    assert session.now()["marker_count"] == 0


def test_a_mark_that_is_sent_again_after_a_full_disk_is_in_the_table_too(
    session: Recording, monkeypatch: pytest.MonkeyPatch
) -> None:
    full = [True]

    def write(changed: Session, folder: Path) -> None:
        if full[0]:
            raise StorageError("cannot be written: no space", where=str(folder))
        write_markers(changed, folder)

    monkeypatch.setattr("service.server.session_store.write_markers", write)
    body = {"label": "a stone", "id": "0123456789ab"}
    assert session.running.http.post(f"{session.url}/markers", json=body).status_code == 507
    full[0] = False
    assert session.running.http.post(f"{session.url}/markers", json=body).status_code == 201
    stored = read_existing_markers(session.folder / "markers.parquet")
    assert [event.label for event in stored] == ["a stone"]


def test_the_table_of_events_is_given_as_it_is_stored(session: Recording, node: FakeNode) -> None:
    marker(session, "a stone")
    answer = session.running.http.get(f"{session.url}/markers", params={"format": "parquet"})
    assert answer.content == (session.folder / "markers.parquet").read_bytes()
    recording = node.record()
    for table in ("markers", "clock"):
        refused = session.running.http.get(f"{recording.url}/{table}?format=parquet")
        assert_refused(refused, 409, "not written yet")


# --- from files -----------------------------------------------------------------------------------


@pytest.fixture
def pulled(session: Recording, tmp_path: Path) -> Path:
    """The session's folder with two markers, one of them at no frame, pulled."""
    marker(session, "a stone")
    marker(session, "years ago", t_ns=5)
    with foottile.connect(session.running.url) as server:
        pull_session(server, session.id, tmp_path / "out")
    return tmp_path / "out" / session.id


@pytest.mark.parametrize("to", ["parquet", "arrow", "csv"])
def test_an_export_of_a_pulled_session_has_the_marks_and_names_those_it_has_not(
    session: Recording,
    pulled: Path,
    tmp_path: Path,
    to: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    out = tmp_path / f"out.{to}"
    assert command(monkeypatch, "export", pulled, "--format", to, "--out", out) == 0
    assert "'years ago' is left out: no frame within a second" in capsys.readouterr().err
    asked = {} if to == "arrow" else {"markers": "true"}
    assert out.read_bytes() == session.data(format=to, **asked).content
    bare = tmp_path / f"bare.{to}"
    assert (
        command(monkeypatch, "export", pulled, "--format", to, "--no-markers", "--out", bare) == 0
    )
    assert bare.read_bytes() != out.read_bytes()


def test_an_export_of_a_file_without_its_folder_says_that_it_has_no_marks(
    pulled: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    alone = tmp_path / "alone.parquet"
    alone.write_bytes((pulled / "frames.parquet").read_bytes())
    arguments = (alone, "--format", "csv", "--out", tmp_path / "out.csv")
    assert command(monkeypatch, "export", *arguments) == 0
    assert "without markers" in capsys.readouterr().err
    assert command(monkeypatch, "export", *arguments, "--markers") == 2
    assert "markers.parquet" in capsys.readouterr().err


def test_marks_without_a_clock_table_are_at_no_frame_and_that_is_said(
    pulled: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    (pulled / "clock.parquet").unlink()
    assert (
        command(monkeypatch, "export", pulled, "--format", "csv", "--out", tmp_path / "out.csv")
        == 0
    )
    assert "'a stone' is left out: there is no clock.parquet" in capsys.readouterr().err


def test_a_damaged_table_of_events_is_an_error_and_marks_can_be_left_out(
    pulled: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    path = pulled / "markers.parquet"
    path.write_bytes(path.read_bytes()[:-9])
    arguments = (pulled, "--format", "csv", "--out", tmp_path / "out.csv")
    assert command(monkeypatch, "export", *arguments) == 1
    assert "markers.parquet" in capsys.readouterr().err
    assert not (tmp_path / "out.csv").exists()
    assert command(monkeypatch, "export", *arguments, "--no-markers") == 0


SET: dict[str, list[dict[str, object]]] = {
    "PATCH": [{"name": "{}"}, {"subject": "{}"}, {"tags": ["{}"]}, {"notes": "{}"}],
    "POST": [{"label": "{}"}],
}


@pytest.mark.parametrize(
    "wrong",
    [
        "a\x1b[2J",
        "a\x07b",
        "a\x00b",
        "a\x7fb",
        "a\x9bb",
        "a\u202eb",
        "a\u2066b",
        "\ufeffa",
    ],
)
def test_a_text_that_cannot_be_seen_is_refused_wherever_it_is_set(
    session: Recording, wrong: str
) -> None:
    path = f"/sessions/{session.id}"
    for method, bodies in SET.items():
        for body in bodies:
            content = json.dumps(body).replace('"{}"', json.dumps(wrong))
            url = f"{path}/markers" if method == "POST" else path
            answer = session.running.http.request(
                method, url, content=content, headers={"Content-Type": "application/json"}
            )
            assert_refused(answer, 422, "U+")


def test_a_line_break_is_for_notes_only(session: Recording) -> None:
    http, path = session.running.http, f"/sessions/{session.id}"
    assert http.patch(path, json={"notes": "one\n\ttwo"}).json()["notes"] == "one\n\ttwo"
    for body in ({"name": "one\ntwo"}, {"subject": "one\ttwo"}, {"tags": ["one\ntwo"]}):
        assert_refused(http.patch(path, json=body), 422, "line break or tab")
    assert_refused(http.post(f"{path}/markers", json={"label": "one\ntwo"}), 422, "line break")
    words = "\u0645\u06cc\u200c\u062e \U0001f469\u200d\U0001f52c"  # with joiners
    assert http.patch(path, json={"name": words}).json()["name"] == words
