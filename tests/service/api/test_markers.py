"""Markers: in downloads and exports at their frames, changed, moved and removed."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

import foottile
from devices.errors import StorageError
from devices.frames import Edge
from devices.types import T_NS_END
from service.pull import pull_session
from storage.journal.journal import Journal
from storage.schema import wire_schema
from storage.sessions.metadata import read_existing_markers, write_markers
from storage.verify.session import verify_session
from storage.wire import encode_frames
from tests.service.command import command
from tests.service.fake_node import FakeNode
from tests.service.recording import Recording
from tests.service.running import Running, assert_refused, content_of
from tests.storage.faulty_disk import failing_if, failing_once
from tests.waiting import until

HOUR_NS = 3_600_000_000_000
MARKED = 50


@pytest.fixture(scope="module")
def behind(shared: Running) -> Iterator[FakeNode]:
    """A tared node whose clock is an hour behind."""
    node = FakeNode(shared)
    node.utc_offset_ns -= HOUR_NS
    node.greet()
    node.say_clock(HOUR_NS, uncertainty_ns=1000)
    until(lambda: shared.node(node.name)["clock"] is not None)
    node.tared()
    yield node
    node.close()


@pytest.fixture(scope="module")
def unmarked(behind: FakeNode) -> Recording:
    session = behind.record()
    behind.send(200, [20.0, 60.0])
    behind.taken_in()
    behind.finish(session)
    return session


@pytest.fixture
def session(unmarked: Recording) -> Iterator[Recording]:
    """A sealed session of 200 frames, whose markers go with the test."""
    yield unmarked
    for marker in list_markers(unmarked):
        unmarked.running.http.delete(f"{unmarked.url}/markers/{marker['id']}")


def list_markers(session: Recording) -> list[dict[str, Any]]:
    items: list[dict[str, Any]] = session.running.http.get(f"{session.url}/markers").json()["items"]
    return items


def mark(session: Recording, label: str, **body: Any) -> dict[str, Any]:
    """Mark a frame of the middle, in the server's time."""
    t_ns = int(session.column("t_ns")[MARKED]) + HOUR_NS
    body = {"label": label, "t_ns": t_ns} | body
    return dict(content_of(session.running.http.post(f"{session.url}/markers", json=body), 201))


def labels_in(answer: httpx.Response, to: str) -> dict[int, str]:
    """Return the labels of a download by their rows."""
    if to == "csv":
        labels = [row["marker"] or None for row in csv.DictReader(io.StringIO(answer.text))]
    elif to == "arrow":
        labels = pa.ipc.open_file(answer.content).read_all()["marker"].to_pylist()
    else:
        labels = pq.read_table(io.BytesIO(answer.content))["marker"].to_pylist()
    return {i: label for i, label in enumerate(labels) if label is not None}


def test_a_marker_after_the_seal_is_at_its_frame_in_every_table(session: Recording) -> None:
    sealed = session.data().content
    mark(session, "a stone")
    for to in ("arrow", "csv", "parquet"):
        answer = session.data(format=to, markers="true")
        assert labels_in(answer, to) == {MARKED: "a stone"}
        assert answer.headers["foottile-markers"] == "placed=1, left-out=0"
    table = pq.read_table(io.BytesIO(answer.content))
    table = table.drop_columns(["marker", "time_s", "time_utc"])
    assert table.equals(pq.read_table(io.BytesIO(sealed)).select(table.column_names))
    assert session.data().content == sealed
    for query in ({}, *({"format": to, "markers": "false"} for to in ("csv", "arrow"))):
        answer = session.data(**query)
        assert "foottile-markers" not in answer.headers
        assert b"marker" not in answer.content[:1000]
    query = {"columns": "marker", "format": "parquet"}
    refused = session.running.http.get(f"{session.url}/data", params=query)
    assert_refused(refused, 422, "marker", "markers")


def test_a_marker_changes_the_tag_of_downloads_that_have_it(session: Recording) -> None:
    http, url = session.running.http, f"{session.url}/data"
    for query in ({"format": "csv"}, {"format": "arrow"}, {"markers": "true"}):
        tag = session.data(**query).headers["etag"]
        assert tag.startswith('"')
        known = {"If-None-Match": tag}
        assert http.get(url, params=query, headers=known).status_code == 304
        mark(session, "one more")
        again = http.get(url, params=query, headers=known)
        assert (again.status_code, again.headers["etag"] != tag) == (200, True)
    plain = {"format": "csv", "markers": "false"}
    tag = session.data(**plain).headers["etag"]
    mark(session, "elsewhere")
    assert session.data(**plain).headers["etag"] == tag
    assert session.data().headers["etag"] == f'"{session.now()["sha256"]}"'


def test_a_download_with_markers_has_no_ranges(session: Recording) -> None:
    mark(session, "a stone")
    whole = session.data(markers="true")
    assert whole.headers["accept-ranges"] == "none"
    marked, sealed, other = whole.headers["etag"], f'"{session.now()["sha256"]}"', f'"{"0" * 64}"'
    for markers, tag in (("true", marked), ("true", sealed), ("false", marked), ("false", other)):
        answer = session.running.http.get(
            f"{session.url}/data",
            params={"markers": markers},
            headers={"Range": "bytes=0-9", "If-Range": tag},
        )
        assert answer.status_code == 200
        assert markers == "false" or answer.content == whole.content


def test_a_marker_without_a_frame_is_counted(session: Recording) -> None:
    mark(session, "years ago", t_ns=5)
    mark(session, "a stone")
    answer = session.data(format="arrow")
    assert answer.headers["foottile-markers"] == "placed=1, left-out=1"
    assert labels_in(answer, "arrow") == {MARKED: "a stone"}
    metadata = pa.ipc.open_file(answer.content).schema.metadata
    early, _ = json.loads(metadata[b"foottile.notes"])["markers"]
    assert (early["label"], early["left_out"]) == ("years ago", "no frame within a second of it")
    part = session.data(format="csv", end_s=0.01, columns="seq,marker")
    assert part.headers["foottile-markers"] == "placed=0, left-out=2"


def test_a_recording_session_has_its_markers_and_no_table_yet(
    behind: FakeNode, unmarked: Recording
) -> None:
    http, session = behind.running.http, behind.record()
    behind.deliver(100, [5.0, 0.0])
    before = session.data(format="arrow")
    assert labels_in(before, "arrow") == {}
    t_ns = int(pa.ipc.open_file(before.content).read_all()["t_ns"][7].as_py()) + HOUR_NS
    answer = http.post(f"{session.url}/markers", json={"label": "a stone", "t_ns": t_ns})
    assert answer.status_code == 201
    after = session.data(format="arrow")
    assert labels_in(after, "arrow") == {7: "a stone"}
    assert after.headers["etag"].startswith('W/"')
    for table in ("markers", "clock"):
        refused = http.get(f"{session.url}/{table}?format=parquet")
        assert_refused(refused, 409, "not written yet")
    behind.finish(session)
    stored = read_existing_markers(session.folder / "markers.parquet")
    assert [marker.label for marker in stored] == ["a stone"]


def test_a_marker_is_counted_once_and_in_order_of_time(session: Recording) -> None:
    assert session.now()["marker_count"] == 0
    first = mark(session, "after")
    assert mark(session, "again", id=first["id"]) == first  # a repeated request
    answer = session.running.http.post(f"{session.url}/markers", json={"label": "x", "id": "no"})
    assert answer.status_code == 422
    mark(session, "before", t_ns=1)
    assert session.now()["marker_count"] == 2
    assert [marker["label"] for marker in list_markers(session)] == ["before", "after"]
    path = session.folder / "markers.parquet"
    assert sorted(marker.label for marker in read_existing_markers(path)) == ["after", "before"]
    answer = session.running.http.get(f"{session.url}/markers", params={"format": "parquet"})
    assert answer.content == path.read_bytes()


def test_a_repeated_marker_is_stored_when_the_disk_has_space(
    session: Recording, monkeypatch: pytest.MonkeyPatch
) -> None:
    fail_once = failing_once(write_markers, StorageError, "cannot be written: no space")
    monkeypatch.setattr("service.server.session_store.write_markers", fail_once)
    body = {"label": "a stone", "id": "0123456789ab"}
    for status in (507, 201):
        answer = session.running.http.post(f"{session.url}/markers", json=body)
        assert answer.status_code == status
    stored = read_existing_markers(session.folder / "markers.parquet")
    assert [marker.label for marker in stored] == ["a stone"]


def test_a_marker_is_renamed_moved_and_removed(session: Recording) -> None:
    http, before = session.running.http, mark(session, "a stone")
    mud = mark(session, "mud")
    url = f"{session.url}/markers/{before['id']}"
    renamed = http.patch(url, json={"label": "a boulder"}).json()
    assert renamed["t_ns"] == before["t_ns"]
    assert renamed["revision"] != before["revision"]
    t_ns = before["t_ns"] + 20_000_000
    moved = http.patch(url, json={"t_ns": t_ns}).json()
    assert (moved["label"], moved["t_ns"]) == ("a boulder", t_ns)
    expected = {("a boulder", t_ns), ("mud", mud["t_ns"])}
    assert {(marker["label"], marker["t_ns"]) for marker in list_markers(session)} == expected
    stored = read_existing_markers(session.folder / "markers.parquet")
    assert {(marker.label, marker.t_ns) for marker in stored} == expected
    assert verify_session(session.folder).problems == []
    labels = labels_in(session.data(format="csv"), "csv")
    assert labels == {MARKED: "mud", MARKED + 10: "a boulder"}
    for wrong in ({"label": ""}, {"t_ns": -1}, {"t_ns": 1.5}, {"t_ns": T_NS_END}, {"name": "x"}):
        assert http.patch(url, json=wrong).status_code == 422, wrong
        added = {"label": "x"} | wrong
        assert http.post(f"{session.url}/markers", json=added).status_code == 422, wrong
    assert http.delete(url).status_code == 204
    assert [marker["label"] for marker in list_markers(session)] == ["mud"]
    assert session.now()["marker_count"] == 1
    assert_refused(http.delete(url), 404, "no marker")
    assert_refused(http.patch(url, json={"label": "x"}), 404, "no marker")
    assert http.delete("/sessions/none/markers/0").status_code == 404


def test_a_change_needs_the_revision_that_its_client_saw(session: Recording) -> None:
    http, marker = session.running.http, mark(session, "mud")
    url, seen = f"{session.url}/markers/{marker['id']}", {"If-Match": f'"{marker["revision"]}"'}
    assert http.patch(url, json={"label": "water"}, headers=seen).status_code == 200
    late = http.patch(url, json={"label": "sand"}, headers=seen)
    assert_refused(late, 412, "changed by another client")
    assert_refused(http.delete(url, headers=seen), 412, "changed by another client")
    assert [marker["label"] for marker in list_markers(session)] == ["water"]


# --- exports of files -----------------------------------------------------------------------------


@pytest.fixture
def pulled(session: Recording, tmp_path: Path) -> Path:
    """A pulled session with two markers, one of them at no frame."""
    mark(session, "a stone")
    mark(session, "years ago", t_ns=5)
    with foottile.connect(session.running.url) as server:
        pull_session(server, session.id, tmp_path / "out")
    return tmp_path / "out" / session.id


@pytest.mark.parametrize("to", ["parquet", "arrow", "csv"])
def test_an_export_of_a_pulled_session_is_its_download(
    session: Recording,
    pulled: Path,
    tmp_path: Path,
    to: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    out, bare = tmp_path / f"out.{to}", tmp_path / f"bare.{to}"
    assert command(monkeypatch, "export", pulled, "--format", to, "--out", out) == 0
    assert "'years ago' is left out: no frame within a second" in capsys.readouterr().err
    query = {} if to == "arrow" else {"markers": "true"}
    assert out.read_bytes() == session.data(format=to, **query).content
    options = ("--format", to, "--no-markers", "--out", bare)
    assert command(monkeypatch, "export", pulled, *options) == 0
    assert bare.read_bytes() != out.read_bytes()


def test_an_export_names_missing_and_damaged_tables(
    pulled: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def export(path: Path, *options: str) -> tuple[int, str]:
        arguments = (path, "--format", "csv", "--out", tmp_path / "out.csv", *options)
        return command(monkeypatch, "export", *arguments), capsys.readouterr().err

    alone = tmp_path / "alone.parquet"
    alone.write_bytes((pulled / "frames.parquet").read_bytes())
    code, text = export(alone)
    assert (code, "without markers" in text) == (0, True)
    code, text = export(alone, "--markers")
    assert (code, "markers.parquet" in text) == (2, True)
    (pulled / "clock.parquet").unlink()
    code, text = export(pulled)
    assert (code, "'a stone' is left out: there is no clock.parquet" in text) == (0, True)
    (tmp_path / "out.csv").unlink()
    path = pulled / "markers.parquet"
    path.write_bytes(path.read_bytes()[:-9])
    code, text = export(pulled)
    assert (code, "markers.parquet" in text) == (1, True)
    assert not (tmp_path / "out.csv").exists()
    assert export(pulled, "--no-markers")[0] == 0


def test_an_edge_is_shown_at_once_and_changed_only_once_it_is_sealed(shared: Running) -> None:
    node = FakeNode(shared, name="edges")
    node.utc_offset_ns -= HOUR_NS
    node.greet(scene={"sync": {"input_line": 17, "label": "TTL"}})
    node.say_clock(HOUR_NS, uncertainty_ns=1000)
    node.deliver(50, alive=True)
    session = node.record()
    batch = node.frames(20, alive=True)
    t_mono_ns = int(batch.t_mono_ns[7])
    stamps = [Edge(2, t_mono_ns, True), Edge(1, int(batch.t_mono_ns[0]) - 1, True)]
    payload = encode_frames(batch, wire_schema(node.info), stamps)
    for _ in range(2):
        node.socket.send(payload)
    until(lambda: list_markers(session))
    node.send(20, alive=True)
    (edge,) = list_markers(session)
    truth = t_mono_ns + node.info.utc_offset_ns + HOUR_NS
    assert abs(edge["t_ns"] - truth) <= edge["bound_ns"] < 10_000_000
    assert (edge["label"], edge["t_mono_ns"]) == ("TTL", t_mono_ns)
    url = f"{session.url}/markers/{edge['id']}"
    assert_refused(shared.http.patch(url, json={"t_ns": 5}), 409, "not sealed yet")
    assert_refused(shared.http.delete(url), 409, "not sealed yet")
    node.taken_in()
    node.finish(session)
    assert [marker["id"] for marker in list_markers(session)] == [edge["id"]]
    assert verify_session(session.folder).problems == []
    moved = content_of(shared.http.patch(url, json={"t_ns": edge["t_ns"] + 5}))
    assert (moved["stream_id"], moved["t_mono_ns"], moved["bound_ns"]) == (None, None, None)
    assert verify_session(session.folder).problems == []
    node.close()


def test_edges_of_refused_frames_are_no_markers_and_no_disk_is_asked(
    shared: Running, monkeypatch: pytest.MonkeyPatch
) -> None:
    node = FakeNode(shared, name="ahead")
    node.greet(scene={"sync": {"input_line": 17, "label": "TTL"}})
    node.deliver(50, alive=True)
    session = node.record()

    def send(t_mono_ns: int, number: int) -> None:
        batch = node.frames(20, alive=True)
        edge = Edge(number, t_mono_ns, True)
        node.socket.send(encode_frames(batch, wire_schema(node.info), [edge]))

    begin_ns = node.next_t_mono_ns
    refuse = failing_if(lambda *_: True, Journal.find_batch_t_ns_near, StorageError, "full")
    with monkeypatch.context() as full:
        full.setattr(Journal, "find_batch_t_ns_near", refuse)
        send(begin_ns, 1)
        until(lambda: len(shared.server.sessions.get_session(session.id).markers) == 1)
    true_at = node.seq, node.next_t_mono_ns
    node.seq += 10**9
    send(node.next_t_mono_ns, 2)
    node.seq, node.next_t_mono_ns = true_at
    send(node.next_t_mono_ns, 3)
    until(lambda: len(list_markers(session)) == 2)
    assert [marker["id"].rpartition("-")[2] for marker in list_markers(session)] == ["1", "3"]
    assert shared.node("ahead")["connected"]
    node.taken_in()
    node.finish(session)
    node.close()


def test_edges_are_shown_again_after_a_restart_of_the_server(running: Running) -> None:
    node = FakeNode(running)
    node.greet(scene={"sync": {"input_line": 17, "label": "TTL"}})
    node.deliver(50, alive=True)
    session = node.record()
    batch = node.frames(20, alive=True)
    edges = [Edge(n, int(batch.t_mono_ns[n]), True) for n in (1, 2)]
    node.socket.send(encode_frames(batch, wire_schema(node.info), edges))
    until(lambda: len(list_markers(session)) == 2)
    node.acknowledged(69)
    before = list_markers(session)
    node.leave()
    running.stop()
    running.start()
    until(lambda: list_markers(session) == before)
    node.close()
