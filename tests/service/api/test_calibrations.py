"""Calibrations over REST: uploaded, listed, downloaded, fitted here, and used for a node."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

from service.estimation.calibration import UNPROVEN_SUFFIX, Calibration
from service.server import calibrations as book
from service.sessions.calibration_file import encode_calibration, parse_calibration
from service.sessions.sealing import rebuild_damaged_session_json
from storage.sessions.folder import SessionsFolder
from tests.builders.calibrations import make_calibration
from tests.service import benches
from tests.service.fake_node import FakeNode, NodeOf
from tests.service.recording import Recording
from tests.service.running import Running, ServeWith, assert_refused
from tests.waiting import until

NONE = "0" * 16


def stiffer(*serials: str, name: str = "stiffer") -> Calibration:
    """Twice the newtons for a pressure."""
    made = make_calibration(*serials)
    tiles = tuple(tile.model_copy(update={"f_scale_n": 2 * tile.f_scale_n}) for tile in made.tiles)
    return made.model_copy(update={"tiles": tiles, "name": name})


def upload(running: Running, content: bytes | Calibration) -> httpx.Response:
    sent = encode_calibration(content) if isinstance(content, Calibration) else content
    headers = {"Content-Type": "application/json"}
    return running.http.post("/calibrations", content=sent, headers=headers)


def listed(running: Running) -> list[dict[str, Any]]:
    items: list[dict[str, Any]] = running.http.get("/calibrations").json()["items"]
    return items


def test_a_file_is_uploaded_listed_and_downloaded_as_it_was_also_after_a_restart(
    running: Running, tmp_path: Path
) -> None:
    calibration = stiffer("T01", "T02")
    answer = upload(running, calibration)
    assert answer.status_code == 201, answer.text
    url = f"/calibrations/{calibration.id}"
    assert answer.headers["location"] == f"/api/v1{url}"
    said = answer.json()
    assert (said["id"], said["name"], said["serials"]) == (
        calibration.id,
        "stiffer",
        ["T01", "T02"],
    )
    assert upload(running, calibration).json() == said
    running.restart()
    assert listed(running) == [said]
    got = running.http.get(url)
    assert got.content == encode_calibration(calibration)
    assert parse_calibration(got.content, where="here") == calibration
    matching = {"If-None-Match": got.headers["etag"]}
    assert running.http.get(url, headers=matching).status_code == 304
    assert running.http.delete(url).status_code == 204
    assert listed(running) == []
    for method in ("GET", "DELETE"):
        assert_refused(running.http.request(method, url), 404, calibration.id)


def test_one_that_was_written_by_hand_is_called_unproven(running: Running) -> None:
    content = json.dumps(stiffer("T01").model_dump(mode="json")).encode()
    assert upload(running, content).json()["name"] == "stiffer" + UNPROVEN_SUFFIX


def broken() -> dict[str, bytes]:
    whole = encode_calibration(stiffer("T01"))
    plain = stiffer("T01").model_dump(mode="json")
    tile = plain["tiles"][0]
    return {
        "nothing": b"",
        "no JSON": b"{",
        "a list": b"[]",
        "a flipped bit": whole.replace(b"stiffer", b"stiffes"),
        "cut off": whole[:-40],
        "an unknown field": json.dumps(plain | {"colour": "red"}).encode(),
        "an unknown field of a tile": json.dumps(
            plain | {"tiles": [tile | {"gain": 2.0}]}
        ).encode(),
        "a number that is none": json.dumps(
            plain | {"tiles": [tile | {"f_scale_n": float("nan")}]}
        ).encode(),
        "no text": json.dumps(plain | {"name": 5}).encode(),
        "a deep one": b"[" * 100_000,
        "bytes": bytes(range(256)),
        "another id": json.dumps(plain | {"id": NONE}).encode(),
    }


def test_what_is_no_calibration_is_refused_and_leaves_nothing(running: Running) -> None:
    for what, content in broken().items():
        answer = upload(running, content)
        says = "its id says" if what == "another id" else "not a calibration"
        assert_refused(answer, 422, says)
    assert listed(running) == []
    assert not (running.data / "calibrations").exists()


def test_files_that_are_too_long_or_too_many_are_refused(
    running: Running, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert upload(running, b" " * (book.CONTENT_BYTES_MAX + 1)).status_code == 413
    monkeypatch.setattr(book, "CALIBRATIONS_MAX", 1)
    assert upload(running, stiffer("T01")).status_code == 201
    assert_refused(upload(running, stiffer("T02")), 409, "keeps 1 calibrations")
    assert upload(running, stiffer("T01")).status_code == 201


def test_one_that_is_damaged_on_the_disk_is_set_aside_and_said(running: Running) -> None:
    calibration = stiffer("T01")
    upload(running, calibration)
    path = running.data / "calibrations" / f"{calibration.id}.json"
    path.write_bytes(path.read_bytes().replace(b"stiffer", b"stiffes"))
    assert_refused(running.http.get(f"/calibrations/{calibration.id}"), 409, "Upload it again")
    running.restart()
    assert listed(running) == []
    (problem,) = running.http.get("/health").json()["problems"]
    assert "damaged" in problem
    assert upload(running, calibration).status_code == 201


# --- a node's ---------------------------------------------------------------------------------


def assign(running: Running, calibration: Calibration, **headers: str) -> httpx.Response:
    upload(running, calibration)
    body = {"id": calibration.id}
    return running.http.put("/nodes/bench/calibration", json=body, headers=headers)


def middle_n(session: Recording) -> float:
    """Of the last frames, which are all the same but for the least count."""
    return float(np.median(session.column("grf_n")[-50:-10]))


def test_what_is_assigned_counts_from_then_on_and_what_is_being_recorded_keeps_its_own(
    running: Running, tared: FakeNode
) -> None:
    own = running.node()["calibration"]["id"]
    before = tared.record(name="before")
    tared.deliver(100, [20.0, 60.0], alive=True)
    calibration = stiffer("T01", "T02")
    said = assign(running, calibration)
    assert said.status_code == 200, said.text
    view = said.json()
    assert (view["source"], view["calibration"]["id"], view["own_id"]) == (
        "server",
        calibration.id,
        own,
    )
    after = tared.record(name="after")
    tared.deliver(200, [20.0, 60.0], alive=True)
    first, second = tared.finish(before), tared.finish(after)
    assert (first["calibration_id"], first["calibration_source"]) == (own, "node")
    assert (second["calibration_id"], second["calibration_source"]) == (calibration.id, "server")
    assert middle_n(after) == pytest.approx(2 * middle_n(before), rel=0.01)
    made_again = restore_of(running, after)
    assert (made_again["calibration_source"], made_again["calibration_id"]) == (
        "server",
        calibration.id,
    )


def restore_of(running: Running, session: Recording) -> dict[str, Any]:
    """What is made again of it from its sealed file alone."""
    (session.folder / "session.json").unlink()
    made = rebuild_damaged_session_json(SessionsFolder(running.data / "sessions"), session.id)
    assert made is not None
    return made.model_dump()


def test_the_tare_and_the_last_seconds_outlive_the_change(
    running: Running, tared: FakeNode
) -> None:
    tare = running.node()["tare"]["id"]
    tared.deliver(300, alive=True)
    assert assign(running, stiffer("T01", "T02")).status_code == 200
    node = running.node()
    assert (node["tare"]["id"], node["calibration_problem"]) == (tare, None)
    # No frame has come since.
    assert running.http.post("/nodes/bench/tare").status_code == 201


def test_the_choice_outlives_restarts_and_its_file_and_is_taken_back(
    running: Running, tared: FakeNode
) -> None:
    own, calibration = running.node()["calibration"]["id"], stiffer("T01", "T02")
    assign(running, calibration)
    running.http.delete(f"/calibrations/{calibration.id}")
    tared.leave()
    running.restart()
    assert running.node()["calibration"]["id"] == calibration.id
    tared.restart()
    tared.connect()
    assert running.node()["calibration"]["id"] == calibration.id
    url = "/nodes/bench/calibration"
    for _ in range(2):
        view = running.http.delete(url).json()
        assert (view["source"], view["calibration"]["id"]) == ("node", own)
    tared.leave()
    running.restart()
    assert running.http.get(url).json()["calibration"]["id"] == own


def test_a_node_without_a_calibration_of_its_own_gets_one(
    running: Running, node_of: NodeOf
) -> None:
    node = node_of(running, calibration=None)
    node.connect()
    node.send(60, lead=True)
    node.send(20)
    node.taken_in()
    assert running.node()["calibration_problem"] == "for this test"
    refused = assign(running, stiffer("T01", "T02"), **{"If-Match": NONE})
    assert_refused(refused, 412, "changed by another client")
    view = assign(running, stiffer("T01", "T02"), **{"If-Match": "none"}).json()
    assert (view["problem"], view["own_id"]) == (None, None)
    node.send(20)
    until(lambda: running.node()["tare"])  # by the lead, which nobody could look at before


def test_two_people_do_not_overwrite_each_others_choice(running: Running, tared: FakeNode) -> None:
    seen = running.node()["calibration"]["id"]
    first = stiffer("T01", "T02", name="first")
    assert assign(running, first, **{"If-Match": f'"{seen}"'}).status_code == 200
    second = assign(running, stiffer("T01", "T02", name="second"), **{"If-Match": seen})
    assert_refused(second, 412, "changed by another client")
    back = running.http.delete("/nodes/bench/calibration", headers={"If-Match": seen})
    assert_refused(back, 412, "changed by another client")
    assert running.node()["calibration"]["name"] == "first"


def test_what_does_not_fit_the_tiles_is_refused_and_changes_nothing(
    running: Running, tared: FakeNode
) -> None:
    before = running.node()["calibration"]
    assert_refused(
        assign(running, stiffer("T01")), 422, "does not fit", "it covers T01, but not T02"
    )
    body = {"id": NONE}
    assert_refused(running.http.put("/nodes/bench/calibration", json=body), 404, NONE)
    assert_refused(running.http.put("/nodes/nobody/calibration", json=body), 404, "nobody")
    assert running.node()["calibration"] == before
    assert not (running.data / "nodes" / "bench" / "assigned.json").exists()


def test_a_choice_that_is_damaged_is_no_other_ones(running: Running, tared: FakeNode) -> None:
    assign(running, stiffer("T01", "T02"))
    tared.leave()
    running.stop()
    path = running.data / "nodes" / "bench" / "assigned.json"
    path.write_bytes(path.read_bytes().replace(b"stiffer", b"stiffes"))
    for _ in range(2):  # set aside by the first start, missed by the second
        running.start()
        view = running.http.get("/nodes/bench/calibration").json()
        assert (view["source"], view["calibration"]) == ("server", None)
        assert "lost" in view["problem"]
        assert any("assigned" in text for text in running.http.get("/health").json()["problems"])
        running.stop()
    running.start()
    back = running.http.delete("/nodes/bench/calibration").json()
    assert (back["source"], back["problem"]) == ("node", None)
    running.restart()
    assert running.node()["calibration_problem"] is None


# --- fitted here ------------------------------------------------------------------------------


@pytest.fixture
def with_bench(bench_cache: Path, tmp_path: Path, serve_with: ServeWith) -> Running:
    """A server with a bench recording, sealed, with the mill's steps as markers."""
    benches.put(benches.pressed(bench_cache), tmp_path / "data-0")
    return serve_with()


def fit(running: Running, **body: object) -> httpx.Response:
    asked = {"sessions": [benches.SESSION_ID], "name": "left, =leg", "reference": "the mill"}
    return running.http.post("/calibrations/jobs", json=asked | body)


def ended(running: Running, begun: httpx.Response) -> dict[str, Any]:
    assert begun.status_code == 202, begun.text
    url = begun.headers["location"].removeprefix("/api/v1")
    until(lambda: running.http.get(url).json()["state"] != "running", timeout_s=300.0)
    said: dict[str, Any] = running.http.get(url).json()
    return said


@pytest.mark.slow
@pytest.mark.process
def test_a_bench_session_is_fitted_here_and_what_cannot_be_says_why(with_bench: Running) -> None:
    running = with_bench
    begun = fit(running)
    assert_refused(fit(running), 409, "left, =leg", "being fitted")
    done = ended(running, begun)
    assert (done["state"], done["problem"]) == ("done", None), done
    assert any(line.startswith("tile T01, 1 of 1: curve to") for line in done["log"])
    (kept,) = listed(running)
    assert (kept["id"], kept["name"]) == (done["calibration_id"], "left, =leg")
    assert (kept["reference"], kept["serials"]) == ("the mill", ["T01"])

    session = running.http.get(f"/sessions/{benches.SESSION_ID}/markers").json()["items"]
    step = next(marker for marker in session if marker["label"] == "T01 load")
    url = f"/sessions/{benches.SESSION_ID}/markers/{step['id']}"
    running.http.patch(url, json={"label": "T01 laod"})
    failed = ended(running, fit(running))
    assert failed["state"] == "failed"
    assert "'T01 laod' is no calibration step" in failed["problem"]
    assert len(listed(running)) == 1
    assert [one["state"] for one in running.http.get("/calibrations/jobs").json()["items"]] == [
        "failed",
        "done",
    ]


@pytest.mark.process
def test_a_fit_is_cancelled_by_hand_and_by_the_end_of_the_server(with_bench: Running) -> None:
    running = with_bench
    begun = fit(running)
    url = begun.headers["location"].removeprefix("/api/v1")
    for _ in range(2):
        assert running.http.delete(url).json()["state"] == "cancelled"
    assert fit(running).status_code == 202
    running.restart()  # which fails if a task or a thread is left over
    assert listed(running) == []
    assert_refused(running.http.get(url), 404, "since the server was started")


def test_what_cannot_be_fitted_is_refused_at_once(
    with_bench: Running, monkeypatch: pytest.MonkeyPatch
) -> None:
    running, twice = with_bench, [benches.SESSION_ID] * 2
    assert_refused(fit(running, sessions=twice), 422, "named twice")
    assert_refused(fit(running, sessions=["20200101T000000Z-000000"]), 404, "20200101")
    wrongs: tuple[dict[str, Any], ...] = (
        {"sessions": []},
        {"sessions": ["x"] * 33},
        {"name": ""},
        {"name": "two\nlines"},
        {"reference_delay_ms": 1e9},
        {"out": "/etc/passwd"},
    )
    for wrong in wrongs:
        assert fit(running, **wrong).status_code == 422, wrong
    monkeypatch.setattr("service.server.calibrations.FRAMES_MAX", 10)
    assert_refused(fit(running), 422, "at most 10 in one fit")
    assert running.http.get("/calibrations/jobs").json()["items"] == []
