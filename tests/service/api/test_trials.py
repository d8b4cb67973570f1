"""The list of trials over HTTP: recorded by a press or a contact, stopped in time, kept."""

from __future__ import annotations

import json
import time
from typing import Any

import pytest

from tests.service.fake_node import FakeNode, NodeOf, Play
from tests.service.running import Running, assert_refused, content_of, receive_live
from tests.waiting import PATIENCE_S, until


def get(running: Running) -> dict[str, Any]:
    view: dict[str, Any] = content_of(running.http.get("/trials"))
    return view


def put(running: Running, text: str) -> dict[str, Any]:
    headers = {"Content-Type": "text/plain"}
    view: dict[str, Any] = content_of(
        running.http.put("/trials", content=text.encode(), headers=headers)
    )
    return view


def change(running: Running, **changes: object) -> dict[str, Any]:
    view: dict[str, Any] = content_of(running.http.patch("/trials", json=changes))
    return view


def record(running: Running, key: str | None = None) -> dict[str, Any]:
    headers = {} if key is None else {"Idempotency-Key": key}
    answer = running.http.post("/trials/record", json={}, headers=headers)
    view: dict[str, Any] = content_of(answer)
    return view


def stop(running: Running, view: dict[str, Any]) -> None:
    content_of(running.http.post(f"/takes/{view['take']}/stop"))


def test_rows_are_recorded_skipped_and_repeated_and_every_page_is_told(
    running: Running, tared: FakeNode
) -> None:
    assert get(running)["next_name"] is None
    with running.socket("/api/v1/live") as live:
        hello = json.loads(live.recv(timeout=PATIENCE_S))
        assert hello["trials"]["trials"] == []
        view = put(running, "mud 1; wet, deep\nmud 2, plate 1\n")
        assert (view["next_name"], view["text"]) == ("mud 1", "mud 1; wet, deep\nmud 2\nplate 1\n")
        told = receive_live(live, lambda message: message["type"] == "trials")
        assert told["trials"] == view
        first = record(running, "key-1")
        assert record(running, "key-1") == first
        assert (first["next_name"], first["trials"][0]["state"]) == ("mud 2", "recording")
        (session,) = running.sessions()
        assert (session["name"], session["tags"]) == ("mud 1", ["wet", "deep"])
        assert session["take"] == first["take"]
        answer = running.http.post("/trials/record", json={})
        assert_refused(answer, 409, "“mud 1” is being recorded")
        tared.deliver(50)
        stop(running, first)
        tared.send(30, now=True)
        receive_live(
            live,
            lambda message: (
                message["type"] == "trials"
                and message["trials"]["trials"][0]["state"] == "complete"
            ),
        )
    repeated = change(running, next_index=get(running)["last_index"])
    assert repeated["next_name"] == "mud 1 (2)"
    second = record(running)
    assert second["next_name"] == "mud 2"
    stop(running, second)
    skipped = change(running, next_index=2)
    assert [row["state"] for row in skipped["trials"]][1:] == ["skipped", "open"]
    running.restart()
    tared.come_back()
    assert get(running)["text"] == skipped["text"]
    assert (get(running)["next_index"], get(running)["trials"][0]["recordings"]) == (2, 2)


def test_what_is_no_list_is_refused_with_its_line(running: Running) -> None:
    headers = {"Content-Type": "text/plain"}
    answer = running.http.put("/trials", content=b"mud 1\n; wet\n", headers=headers)
    assert_refused(answer, 422, "line 2", "name; tag, tag")
    rows = {"trials": [{"name": "a", "tags": ["x"], "subject": "S1", "notes": "n"}]}
    assert content_of(running.http.put("/trials", json=rows))["trials"][0]["subject"] == "S1"
    lists: list[Any] = [{"trials": [{"name": ""}]}, {"trials": [{"name": "a;b"}]}, {"rows": []}, 7]
    for bad in lists:
        assert running.http.put("/trials", json=bad).status_code == 422, bad
    changes: list[Any] = [{"next_index": 2}, {"next_index": -1}, {"stop_after_s": 0}]
    for bad in (*changes, {"is_armed": True}):
        assert running.http.patch("/trials", json=bad).status_code == 422, bad
    assert_refused(running.http.patch("/trials", json={"node": "nobody"}), 404, "nobody")
    answer = running.http.post("/trials/record", json={})
    assert_refused(answer, 409, "no node is connected")
    assert get(running)["next_index"] == 0
    assert put(running, "")["trials"] == []
    put(running, "a")
    change(running, next_index=1)
    assert_refused(running.http.post("/trials/record", json={}), 409, "no trial is left")


@pytest.mark.real_time
def test_a_contact_starts_an_armed_trial_with_a_pre_roll_and_the_time_stops_it(
    running: Running, tared: FakeNode, node_of: NodeOf
) -> None:
    other = node_of(running, "other")
    other.connect()
    other.tared()
    put(running, "mud 1, mud 2")
    change(running, node="bench", start_at_contact=True, stop_after_s=1)
    with Play(tared, 15.0) as play:
        time.sleep(1.5)  # frames for the pre-roll
        assert record(running)["is_armed"]
        time.sleep(0.5)
        assert running.sessions() == []  # it stands already
        play.force_n = 0.0
        time.sleep(0.5)
        assert running.sessions() == []
        play.force_n = 15.0
        until(running.sessions)
        view = get(running)
        assert (view["is_armed"], view["next_name"]) == (False, "mud 2")
        session = running.session(running.sessions()[0]["id"])
        assert session.now()["node"] == "bench"
        play.force_n = 0.0
        until(lambda: session.now()["state"] == "sealed")
        assert get(running)["trials"][0]["state"] == "complete"
        lasted_s = session.now()["duration_s"]
        assert 1.9 < lasted_s < 8.0  # beside other tests
        play.force_n = 15.0
        time.sleep(0.5)
        assert len(running.sessions()) == 1  # once per arming
    record(running)
    tared.leave()
    until(lambda: not get(running)["is_armed"])
    assert "no node is connected" in get(running)["problem"]


def test_a_restart_keeps_the_time_of_the_stop_but_waits_for_no_contact(
    running: Running, tared: FakeNode
) -> None:
    put(running, "mud 1, mud 2")
    change(running, stop_after_s=2)
    ends_t_ns = record(running)["stop_at_t_ns"]
    running.restart()
    tared.come_back()
    assert get(running)["stop_at_t_ns"] == ends_t_ns
    (session,) = running.sessions()
    until(lambda: running.session(session["id"]).now()["state"] != "recording")
    assert get(running)["stop_at_t_ns"] is None
    change(running, start_at_contact=True)
    tared.deliver(10)
    assert record(running)["is_armed"]
    assert not change(running, is_armed=False)["is_armed"]
    assert record(running)["is_armed"]
    running.restart()
    assert not get(running)["is_armed"]
