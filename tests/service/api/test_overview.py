"""Overviews of sealed sessions over REST: every zoom, exact, made again if they are lost."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pyarrow as pa
import pytest

import service.sessions.overview
from devices.errors import StorageError
from storage.sessions.overview import open_overview
from storage.verify.session import verify_session
from tests.service.fake_node import FakeNode, NodeOf
from tests.service.recording import Recording
from tests.service.running import Running, assert_refused
from tests.storage.faulty_disk import refusing

ARROW = "application/vnd.apache.arrow.stream"


@pytest.fixture
def hopped(tared: FakeNode) -> Recording:
    """A sealed session of 1400 frames: up and down, with 80 N and a single peak of 90 N."""
    session = tared.record()
    for _ in range(6):
        tared.send(100, [0.0, 0.0])
        tared.send(100, [20.0, 60.0])
    tared.send(1, [20.0, 70.0])
    tared.deliver(199, [0.0, 0.0])
    tared.finish(session)
    return session


def asked(session: Recording, **query: Any) -> Any:
    answer = session.running.http.get(f"{session.url}/timeseries", params=query)
    assert answer.status_code == 200, answer.text
    return answer.json()


def frames(session: Recording, *names: str) -> dict[str, Any]:
    with session.reader() as file:
        pieces = list(file.read_quantities(*names))
    return {name: np.concatenate([piece[name] for piece in pieces]) for name in names}


def test_no_peak_hides_at_any_zoom(hopped: Recording) -> None:
    true = frames(hopped, "t_ns", "grf_n", "force_n")
    n = len(true["t_ns"])
    for points, in_bin in ((1, 64), (20, 64), (100, 4), (n, 1), (8000, 1)):
        found = asked(hopped, points=points)
        columns = found["columns"]
        assert found["frames_in_bin"] == in_bin
        assert sum(columns["frames"]) == n
        assert len(columns["frames"]) >= min(points, n)
        highest = max(value for value in columns["grf_n_max"] if value is not None)
        assert highest == pytest.approx(float(np.nanmax(true["grf_n"])), abs=1e-5)
        lowest = min(columns["force_n_1_min"])
        assert lowest == pytest.approx(float(true["force_n"][:, 1].min()), abs=1e-5)


def test_at_full_zoom_bins_are_the_frames_themselves(hopped: Recording) -> None:
    true = frames(hopped, "t_ns", "grf_n", "grf_sigma_n", "contact")
    found = asked(hopped, points=8000, start_s=0.5, end_s=0.7)
    since_s = (true["t_ns"] - true["t_ns"][0]) * 1e-9
    inside = (since_s >= 0.5) & (since_s < 0.7)
    columns = found["columns"]
    assert found["begin_t_ns"] == true["t_ns"][0]
    assert found["duration_s"] == pytest.approx(since_s[-1])
    assert columns["t_first_s"] == columns["t_last_s"] == pytest.approx(since_s[inside])
    assert columns["grf_n_min"] == columns["grf_n_max"]
    assert columns["grf_n_max"] == pytest.approx(true["grf_n"][inside], abs=1e-5)
    high_n = true["grf_n"] + np.float32(1.96) * true["grf_sigma_n"]
    assert columns["grf_high_n_max"] == pytest.approx(high_n[inside], abs=1e-5)
    assert columns["contact"] == [2 if one else 1 for one in true["contact"][inside]]


def test_some_columns_come_with_the_instants_and_as_arrow_they_are_the_same(
    hopped: Recording,
) -> None:
    query: dict[str, Any] = {"points": 50, "columns": "grf_n, force_n_1"}
    plain = asked(hopped, **query)
    names = {"t_first_s", "t_last_s", "force_n_1_min", "force_n_1_max"}
    names |= {"grf_n_min", "grf_n_max", "grf_n_max_t_s"}
    assert set(plain["columns"]) == names
    url = f"{hopped.url}/timeseries"
    answer = hopped.running.http.get(url, params=query, headers={"Accept": ARROW})
    with pa.ipc.open_stream(answer.content) as stream:
        table = stream.read_all()
    about = json.loads(table.schema.metadata[b"foottile.overview"])
    assert about == {name: value for name, value in plain.items() if name != "columns"}
    assert about["serials"] == ["T01", "T02"]
    for name in names:
        np.testing.assert_allclose(
            table[name].to_numpy(), np.array(plain["columns"][name], dtype=float), atol=1e-6
        )
    tag = answer.headers["etag"]
    again = hopped.running.http.get(
        url, params=query, headers={"Accept": ARROW, "If-None-Match": tag}
    )
    assert (again.status_code, again.content) == (304, b"")


def test_as_json_it_goes_compressed_to_who_takes_that_and_is_the_same(hopped: Recording) -> None:
    http, url = hopped.running.http, f"{hopped.url}/timeseries"
    packed = http.get(url, headers={"Accept-Encoding": "gzip"})
    plain = http.get(url, headers={"Accept-Encoding": "identity"})
    assert packed.headers["content-encoding"] == "gzip"
    assert "content-encoding" not in plain.headers
    assert packed.json() == plain.json()
    assert 2 * int(packed.headers["content-length"]) < int(plain.headers["content-length"])
    assert packed.headers["etag"] != plain.headers["etag"]
    assert packed.headers["vary"] == plain.headers["vary"] == "Accept, Accept-Encoding"
    asked = {"Accept-Encoding": "gzip", "If-None-Match": packed.headers["etag"]}
    again = http.get(url, headers=asked)
    assert (again.status_code, again.content) == (304, b"")
    assert again.headers["vary"] == packed.headers["vary"]
    arrow = http.get(url, headers={"Accept-Encoding": "gzip", "Accept": ARROW})
    assert "content-encoding" not in arrow.headers


def test_what_sealing_wrote_is_what_is_made_again_from_the_frames(
    hopped: Recording, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = hopped.folder / "overview.arrow"
    written, before = path.read_bytes(), asked(hopped, points=20)
    path.unlink()
    assert asked(hopped, points=20) == before
    assert path.read_bytes() == written
    damaged = bytearray(written)
    damaged[len(written) // 2] ^= 1
    path.write_bytes(damaged)
    assert any("overview.arrow" in said for said in verify_session(hopped.folder).problems)
    assert asked(hopped, points=20) == before
    assert path.read_bytes() == written
    path.unlink()
    monkeypatch.setattr(service.sessions.overview, "write_overview", refusing(StorageError, "full"))
    assert asked(hopped, points=20) == before
    assert not path.exists()


def test_it_is_proven_by_verify_and_of_its_frames(hopped: Recording) -> None:
    with open_overview(hopped.folder / "overview.arrow") as overview:
        assert overview.index.frames_sha256 == hopped.now()["sha256"]
    report = verify_session(hopped.folder)
    assert (report.problems, report.unproven) == ([], [])


def test_what_cannot_be_shown_is_said(hopped: Recording, tared: FakeNode) -> None:
    http = hopped.running.http
    assert_refused(http.get(f"{hopped.url}/timeseries", params={"points": 0}), 422, "points")
    assert_refused(http.get(f"{hopped.url}/timeseries", params={"columns": "grv"}), 422, "'grv'")
    late = {"start_s": 2, "end_s": 1}
    assert_refused(http.get(f"{hopped.url}/timeseries", params=late), 422, "ends at 1 s")
    assert asked(hopped, start_s=500)["columns"]["t_first_s"] == []
    recording = tared.record()
    assert_refused(http.get(f"{recording.url}/timeseries"), 409, "no frames yet")
    gone = "/sessions/20200101T000000Z-000000/timeseries"
    assert_refused(http.get(gone), 404, "20200101T000000Z-000000")


def test_a_session_without_estimates_shows_its_counts(running: Running, node_of: NodeOf) -> None:
    raw = node_of(running, calibration=None)
    raw.connect()
    raw.deliver(10)
    session = raw.record()
    raw.deliver(100, [0.0, 0.0])
    raw.finish(session)
    columns = asked(session, points=8000)["columns"]
    counts = frames(session, "pressure_raw")["pressure_raw"]
    assert columns["pressure_raw_0_max"] == counts[:, 0].tolist()
    assert "grf_n_max" not in columns
