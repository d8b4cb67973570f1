"""Marks that are renamed, moved and removed, and what two people change at once."""

from __future__ import annotations

import pytest

from storage.sessions.metadata import read_existing_markers
from storage.verify.session import verify_session
from tests.service.fake_node import FakeNode
from tests.service.recording import Recording
from tests.service.running import Running, assert_refused


@pytest.fixture
def session(tared: FakeNode) -> Recording:
    """A sealed session of 200 frames with two markers, of which nobody cares when."""
    session = tared.record()
    tared.deliver(200, [20.0, 60.0], alive=True)
    tared.finish(session)
    for label in ("a stone", "mud"):
        answer = session.running.http.post(f"{session.url}/markers", json={"label": label})
        assert answer.status_code == 201
    return session


def markers(session: Recording) -> dict[str, dict[str, object]]:
    items = session.running.http.get(f"{session.url}/markers").json()["items"]
    return {item["label"]: item for item in items}


def test_a_mark_is_renamed_and_moved_also_in_the_table_beside_and_in_downloads(
    session: Recording,
) -> None:
    http, before = session.running.http, markers(session)
    url = f"{session.url}/markers/{before['a stone']['id']}"
    renamed = http.patch(url, json={"label": "a boulder"}).json()
    assert renamed["t_ns"] == before["a stone"]["t_ns"]
    assert renamed["revision"] != before["a stone"]["revision"]
    clock = session.clock()["streams"][0]["stretches"][0]
    t_ns = int(session.column("t_ns")[50]) + clock["offset_ns"]
    moved = http.patch(url, json={"t_ns": t_ns}).json()
    assert (moved["label"], moved["t_ns"]) == ("a boulder", t_ns)
    assert {m["label"]: m["t_ns"] for m in markers(session).values()} == {
        "a boulder": t_ns,
        "mud": before["mud"]["t_ns"],
    }
    stored = read_existing_markers(session.folder / "markers.parquet")
    assert {(event.label, event.t_ns) for event in stored} >= {("a boulder", t_ns)}
    assert verify_session(session.folder).problems == []
    content = session.data(format="csv").content
    assert content.count(b"a boulder") == 1
    assert b"a stone" not in content


def test_a_mark_is_removed(session: Recording) -> None:
    http, before = session.running.http, markers(session)
    url = f"{session.url}/markers/{before['mud']['id']}"
    assert http.delete(url).status_code == 204
    assert list(markers(session)) == ["a stone"]
    assert session.now()["marker_count"] == 1
    assert_refused(http.delete(url), 404, "no marker")
    assert_refused(http.patch(url, json={"label": "x"}), 404, "no marker")
    assert http.delete("/sessions/none/markers/0").status_code == 404
    for wrong in ({"label": ""}, {"t_ns": -1}, {"t_ns": 1.5}, {"name": "x"}):
        url = f"{session.url}/markers/{before['a stone']['id']}"
        assert http.patch(url, json=wrong).status_code == 422, wrong


def test_who_changes_what_somebody_else_has_changed_meanwhile_is_told(session: Recording) -> None:
    http, marker = session.running.http, markers(session)["mud"]
    url = f"{session.url}/markers/{marker['id']}"
    mine = {"If-Match": f'"{marker["revision"]}"'}
    assert http.patch(url, json={"label": "water"}, headers=mine).status_code == 200
    late = http.patch(url, json={"label": "sand"}, headers=mine)
    assert_refused(late, 412, "changed by another client")
    assert_refused(http.delete(url, headers=mine), 412, "changed by another client")
    assert set(markers(session)) == {"a stone", "water"}

    said = {"If-Match": session.now()["revision"]}
    assert http.patch(session.url, json={"notes": "mine"}, headers=said).status_code == 200
    late = http.patch(session.url, json={"notes": "yours"}, headers=said)
    assert_refused(late, 412, "changed by another client")
    assert session.now()["notes"] == "mine"
    # A marker is another thing, and who does not care says nothing.
    now = {"If-Match": session.now()["revision"]}
    http.post(f"{session.url}/markers", json={"label": "a third"})
    assert http.patch(session.url, json={"tags": ["wet"]}, headers=now).status_code == 200
    for headers in ({}, {"If-Match": "*"}):
        assert http.patch(session.url, json={"name": "x"}, headers=headers).status_code == 200


def test_a_session_that_somebody_else_has_renamed_is_not_deleted(session: Recording) -> None:
    http, seen = session.running.http, session.now()["revision"]
    http.patch(session.url, json={"name": "the best one"})
    answer = http.delete(session.url, headers={"If-Match": f'"{seen}"'})
    assert_refused(answer, 412, "changed by another client")
    assert session.now()["name"] == "the best one"
    assert (
        http.delete(session.url, headers={"If-Match": session.now()["revision"]}).status_code == 204
    )


def test_a_tare_that_another_one_has_followed_is_neither_replaced_nor_undone_unseen(
    running: Running, tared: FakeNode
) -> None:
    seen = running.node()["tare"]["id"]
    url, matching = "/nodes/bench/tare", {"If-Match": seen}
    tared.deliver(200, alive=True)
    other = running.http.post(url, headers=matching)
    assert other.status_code == 201, other.text
    assert_refused(running.http.post(url, headers=matching), 412, "changed by another client")
    undo = f"/nodes/bench/tares/{other.json()['id']}"
    assert_refused(running.http.delete(undo, headers=matching), 412, "changed by another client")
    assert running.node()["tare"]["id"] == other.json()["id"]
    matching = {"If-Match": f'"{other.json()["id"]}"'}
    assert running.http.delete(undo, headers=matching).status_code == 204
    assert running.node()["tare"]["id"] == seen
