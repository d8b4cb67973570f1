"""Calibrations over REST: uploaded, assigned to a node, and fitted from sessions."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

from service.estimation.calibration import UNPROVEN_SUFFIX, Calibration
from service.server import calibrations
from service.sessions.calibration_file import encode_calibration, parse_calibration
from service.sessions.sealing import rebuild_damaged_session_json
from storage.sessions.folder import SessionsFolder
from tests.builders.calibrations import make_calibration
from tests.service import benches
from tests.service.fake_node import FakeNode, NodeOf
from tests.service.recording import Recording
from tests.service.running import Running, ServeWith, assert_refused, content_of
from tests.waiting import until

UNKNOWN = "0" * 16
ASSIGNED = "/nodes/bench/calibration"


def stiffer(*serials: str, name: str = "stiffer") -> Calibration:
    """Return a calibration with twice the force of the usual one."""
    made = make_calibration(*serials)
    tiles = tuple(tile.model_copy(update={"f_scale_n": 2 * tile.f_scale_n}) for tile in made.tiles)
    return made.model_copy(update={"tiles": tiles, "name": name})


def upload(running: Running, content: bytes | Calibration) -> httpx.Response:
    if isinstance(content, Calibration):
        content = encode_calibration(content)
    headers = {"Content-Type": "application/json"}
    return running.http.post("/calibrations", content=content, headers=headers)


def list_all(running: Running) -> list[dict[str, Any]]:
    items: list[dict[str, Any]] = running.http.get("/calibrations").json()["items"]
    return items


def damage(path: Path) -> None:
    path.write_bytes(path.read_bytes().replace(b"stiffer", b"stiffes"))


def test_an_uploaded_file_is_listed_and_downloaded_unchanged(running: Running) -> None:
    calibration = stiffer("T01", "T02")
    answer = upload(running, calibration)
    assert answer.status_code == 201, answer.text
    url = f"/calibrations/{calibration.id}"
    assert answer.headers["location"] == f"/api/v1{url}"
    facts = answer.json()
    expected = {"id": calibration.id, "name": "stiffer", "serials": ["T01", "T02"]}
    assert {name: facts[name] for name in expected} == expected
    assert upload(running, calibration).json() == facts
    running.restart()
    assert list_all(running) == [facts]
    got = running.http.get(url)
    assert got.content == encode_calibration(calibration)
    assert parse_calibration(got.content, where="here") == calibration
    known = {"If-None-Match": got.headers["etag"]}
    assert running.http.get(url, headers=known).status_code == 304
    assert running.http.delete(url).status_code == 204
    assert list_all(running) == []
    for method in ("GET", "DELETE"):
        assert_refused(running.http.request(method, url), 404, calibration.id)
    by_hand = json.dumps(stiffer("T01").model_dump(mode="json")).encode()
    assert upload(running, by_hand).json()["name"] == "stiffer" + UNPROVEN_SUFFIX


WHOLE = encode_calibration(stiffer("T01"))
PLAIN = stiffer("T01").model_dump(mode="json")
TILE = PLAIN["tiles"][0]


@pytest.mark.parametrize(
    "content",
    [
        *(b"", b"{", b"[]", b"[" * 100_000, bytes(range(256)), WHOLE[:-40]),
        WHOLE.replace(b"stiffer", b"stiffes"),
        PLAIN | {"colour": "red"},
        PLAIN | {"tiles": [TILE | {"gain": 2.0}]},
        PLAIN | {"tiles": [TILE | {"f_scale_n": float("nan")}]},
        PLAIN | {"name": 5},
        PLAIN | {"id": UNKNOWN},
    ],
    ids=[
        *("empty", "a part of JSON", "a list", "nested", "bytes", "cut off", "a flipped bit"),
        *("an unknown field", "an unknown field of a tile", "NaN", "a number as name", "its id"),
    ],
)
def test_a_wrong_file_is_refused(shared: Running, content: bytes | dict[str, Any]) -> None:
    is_wrong_id = isinstance(content, dict) and content.get("id") == UNKNOWN
    answer = upload(shared, content if isinstance(content, bytes) else json.dumps(content).encode())
    assert_refused(answer, 422, "its id says" if is_wrong_id else "not a calibration")
    assert list_all(shared) == []
    assert not (shared.data / "calibrations").exists()


def test_size_and_number_of_files_are_limited(
    running: Running, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert upload(running, b" " * (calibrations.CONTENT_BYTES_MAX + 1)).status_code == 413
    monkeypatch.setattr(calibrations, "CALIBRATIONS_MAX", 1)
    assert upload(running, stiffer("T01")).status_code == 201
    assert_refused(upload(running, stiffer("T02")), 409, "keeps 1 calibrations")
    assert upload(running, stiffer("T01")).status_code == 201


def test_a_damaged_file_is_set_aside_and_reported(running: Running) -> None:
    calibration = stiffer("T01")
    upload(running, calibration)
    damage(running.data / "calibrations" / f"{calibration.id}.json")
    answer = running.http.get(f"/calibrations/{calibration.id}")
    assert_refused(answer, 409, "Upload it again")
    running.restart()
    assert list_all(running) == []
    (problem,) = running.http.get("/health").json()["problems"]
    assert "damaged" in problem
    assert upload(running, calibration).status_code == 201


# --- assigned to a node ---------------------------------------------------------------------------


def assign(running: Running, calibration: Calibration, **headers: str) -> httpx.Response:
    upload(running, calibration)
    return running.http.put(ASSIGNED, json={"id": calibration.id}, headers=headers)


def median_n(session: Recording) -> float:
    """Return the force of the last frames, which differ by a count at most."""
    return float(np.median(session.column("grf_n")[-50:-10]))


def test_an_assigned_calibration_counts_for_later_sessions(
    running: Running, tared: FakeNode
) -> None:
    node = running.node()
    own, tare = node["calibration"]["id"], node["tare"]["id"]
    before = tared.record(name="before")
    tared.deliver(300, [0.0, 0.0], alive=True)
    tared.deliver(100, [20.0, 60.0], alive=True)
    calibration = stiffer("T01", "T02")
    view = content_of(assign(running, calibration))
    ids = (view["source"], view["calibration"]["id"], view["own_id"])
    assert ids == ("server", calibration.id, own)
    node = running.node()
    assert (node["tare"]["id"], node["calibration_problem"]) == (tare, None)
    after = tared.record(name="after")
    tared.deliver(200, [20.0, 60.0], alive=True)
    first, second = tared.finish(before), tared.finish(after)
    assert (first["calibration_id"], first["calibration_source"]) == (own, "node")
    assert (second["calibration_id"], second["calibration_source"]) == (calibration.id, "server")
    assert median_n(after) == pytest.approx(2 * median_n(before), rel=0.01)
    (after.folder / "session.json").unlink()
    rebuilt = rebuild_damaged_session_json(SessionsFolder(running.data / "sessions"), after.id)
    assert rebuilt is not None
    assert (rebuilt.calibration_source, rebuilt.calibration_id) == ("server", calibration.id)


def test_a_tare_needs_no_frame_after_an_assignment(running: Running, tared: FakeNode) -> None:
    tared.deliver(300, alive=True)
    assert assign(running, stiffer("T01", "T02")).status_code == 200
    assert running.http.post("/nodes/bench/tare").status_code == 201


def test_an_assignment_survives_restarts_and_its_file_until_it_is_undone(
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
    for _ in range(2):
        view = running.http.delete(ASSIGNED).json()
        assert (view["source"], view["calibration"]["id"]) == ("node", own)
    tared.leave()
    running.restart()
    assert running.http.get(ASSIGNED).json()["calibration"]["id"] == own


def test_a_node_without_calibration_is_tared_from_its_lead_after_an_assignment(
    running: Running, node_of: NodeOf
) -> None:
    node = node_of(running, calibration=None)
    node.connect()
    node.send(60, lead=True)
    node.send(20)
    node.taken_in()
    assert running.node()["calibration_problem"] == "for this test"
    refused = assign(running, stiffer("T01", "T02"), **{"If-Match": UNKNOWN})
    assert_refused(refused, 412, "changed by another client")
    view = assign(running, stiffer("T01", "T02"), **{"If-Match": "none"}).json()
    assert (view["problem"], view["own_id"]) == (None, None)
    node.send(20)
    until(lambda: running.node()["tare"])


def test_an_assignment_needs_a_fitting_calibration_and_the_one_that_its_client_saw(
    running: Running, tared: FakeNode
) -> None:
    before = running.node()["calibration"]
    refused = assign(running, stiffer("T01"))
    assert_refused(refused, 422, "does not fit", "it covers T01, but not T02")
    body = {"id": UNKNOWN}
    assert_refused(running.http.put(ASSIGNED, json=body), 404, UNKNOWN)
    assert_refused(running.http.put("/nodes/nobody/calibration", json=body), 404, "nobody")
    assert running.node()["calibration"] == before
    assert not (running.data / "nodes" / "bench" / "assigned.json").exists()
    first = stiffer("T01", "T02", name="first")
    assert assign(running, first, **{"If-Match": f'"{before["id"]}"'}).status_code == 200
    late = {"If-Match": before["id"]}
    second = assign(running, stiffer("T01", "T02", name="second"), **late)
    assert_refused(second, 412, "changed by another client")
    undone = running.http.delete(ASSIGNED, headers=late)
    assert_refused(undone, 412, "changed by another client")
    assert running.node()["calibration"]["name"] == "first"


def test_a_damaged_assignment_is_replaced_by_no_other(running: Running, tared: FakeNode) -> None:
    assign(running, stiffer("T01", "T02"))
    tared.leave()
    running.stop()
    damage(running.data / "nodes" / "bench" / "assigned.json")
    for _ in range(2):  # the first start sets it aside, the second one misses it
        running.start()
        view = running.http.get(ASSIGNED).json()
        assert (view["source"], view["calibration"]) == ("server", None)
        assert "lost" in view["problem"]
        assert any("assigned" in text for text in running.http.get("/health").json()["problems"])
        running.stop()
    running.start()
    view = running.http.delete(ASSIGNED).json()
    assert (view["source"], view["problem"]) == ("node", None)
    running.restart()
    assert running.node()["calibration_problem"] is None


# --- fitted from sessions -------------------------------------------------------------------------


@pytest.fixture
def with_rig(bench_cache: Path, tmp_path: Path, serve_with: ServeWith) -> Running:
    """A server with a sealed rig recording, whose steps are markers."""
    benches.put(benches.pressed(bench_cache), tmp_path / "data-0")
    return serve_with()


def fit(running: Running, **body: object) -> httpx.Response:
    body = {"sessions": [benches.SESSION_ID], "name": "left, =leg", "reference": "a mill"} | body
    return running.http.post("/calibrations/jobs", json=body)


def url_of(job: httpx.Response) -> str:
    assert job.status_code == 202, job.text
    return job.headers["location"].removeprefix("/api/v1")


def wait_for_end(running: Running, job: httpx.Response) -> dict[str, Any]:
    url = url_of(job)
    until(lambda: running.http.get(url).json()["state"] != "running", timeout_s=300.0)
    ended: dict[str, Any] = running.http.get(url).json()
    return ended


@pytest.mark.slow(parts=8)
@pytest.mark.process
def test_a_rig_session_is_fitted_or_the_fit_has_a_reason(with_rig: Running) -> None:
    running = with_rig
    job = fit(running)
    assert_refused(fit(running), 409, "left, =leg", "being fitted")
    done = wait_for_end(running, job)
    assert (done["state"], done["problem"]) == ("done", None), done
    assert any(line.startswith("tile T01, 1 of 1: curve to") for line in done["log"])
    (stored,) = list_all(running)
    assert (stored["id"], stored["name"]) == (done["calibration_id"], "left, =leg")
    assert (stored["reference"], stored["serials"]) == ("a mill", ["T01"])
    url = f"/sessions/{benches.SESSION_ID}/markers"
    markers = running.http.get(url).json()["items"]
    step = next(marker for marker in markers if marker["label"] == "T01 load")
    running.http.patch(f"{url}/{step['id']}", json={"label": "T01 laod"})
    failed = wait_for_end(running, fit(running))
    assert failed["state"] == "failed"
    assert "'T01 laod' is no calibration step" in failed["problem"]
    assert len(list_all(running)) == 1
    jobs = running.http.get("/calibrations/jobs").json()["items"]
    assert [job["state"] for job in jobs] == ["failed", "done"]


@pytest.mark.process
def test_a_fit_is_cancelled_by_hand_and_by_the_end_of_the_server(with_rig: Running) -> None:
    running = with_rig
    url = url_of(fit(running))
    for _ in range(2):
        assert running.http.delete(url).json()["state"] == "cancelled"
    assert fit(running).status_code == 202
    running.restart()  # fails if a task or a thread is left over
    assert list_all(running) == []
    assert_refused(running.http.get(url), 404, "since the server was started")


def test_an_impossible_fit_is_refused_at_once(
    with_rig: Running, monkeypatch: pytest.MonkeyPatch
) -> None:
    running = with_rig
    assert_refused(fit(running, sessions=[benches.SESSION_ID] * 2), 422, "named twice")
    assert_refused(fit(running, sessions=["20200101T000000Z-000000"]), 404, "20200101")
    wrong: tuple[dict[str, Any], ...] = (
        {"sessions": []},
        {"sessions": ["x"] * 33},
        {"name": ""},
        {"name": "two\nlines"},
        {"reference_delay_ms": 1e9},
        {"out": "/etc/passwd"},
    )
    for body in wrong:
        assert fit(running, **body).status_code == 422, body
    monkeypatch.setattr(calibrations, "FRAMES_MAX", 10)
    assert_refused(fit(running), 422, "at most 10 in one fit")
    assert running.http.get("/calibrations/jobs").json()["items"] == []
