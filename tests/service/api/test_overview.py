"""Overviews over REST: every zoom of sealed sessions, and of sessions that are recorded."""

from __future__ import annotations

import json
from functools import partial
from typing import Any

import httpx
import numpy as np
import pyarrow as pa
import pytest

import service.sessions.overview
import service.sessions.preview
from devices.errors import StorageError
from storage.sessions.overview import open_overview
from storage.verify.session import verify_session
from tests.service.fake_node import FakeNode, NodeOf
from tests.service.recording import Recording
from tests.service.running import Running, assert_refused, content_of
from tests.storage.faulty_disk import flip_bits, refusing
from tests.waiting import until

ARROW = "application/vnd.apache.arrow.stream"
LAG = 6
"""Frames in a look-ahead of 10 ms."""


def request(session: Recording, headers: dict[str, str] | None = None, **query: Any) -> Any:
    url = f"{session.url}/timeseries"
    return session.running.http.get(url, params=query, headers=headers)


def get(session: Recording, **query: Any) -> dict[str, Any]:
    return dict(content_of(request(session, **query)))


def read_frames(session: Recording, *names: str) -> dict[str, Any]:
    with session.reader() as file:
        pieces = list(file.read_quantities(*names))
    return {name: np.concatenate([piece[name] for piece in pieces]) for name in names}


@pytest.fixture(scope="module")
def hopped(shared_tared: FakeNode) -> Recording:
    """A sealed session of 1400 frames: up and down, with 80 N and a single peak of 90 N."""
    node = shared_tared
    session = node.record()
    for _ in range(6):
        node.send(100, [0.0, 0.0])
        node.send(100, [20.0, 60.0])
    node.send(1, [20.0, 70.0])
    node.deliver(199, [0.0, 0.0])
    node.finish(session)
    return session


def test_bins_of_the_full_zoom_are_the_frames(hopped: Recording) -> None:
    true = read_frames(hopped, "t_ns", "grf_n", "grf_sigma_n", "contact")
    overview = get(hopped, points=8000, start_s=0.5, end_s=0.7)
    since_s = (true["t_ns"] - true["t_ns"][0]) * 1e-9
    inside = (since_s >= 0.5) & (since_s < 0.7)
    columns = overview["columns"]
    assert overview["begin_t_ns"] == true["t_ns"][0]
    assert overview["counts_fall"] == [True, True], "of an MPL115A2"
    assert overview["duration_s"] == pytest.approx(since_s[-1])
    assert columns["t_first_s"] == columns["t_last_s"] == pytest.approx(since_s[inside])
    assert columns["grf_n_min"] == columns["grf_n_max"]
    assert columns["grf_n_max"] == pytest.approx(true["grf_n"][inside], abs=1e-5)
    high_n = true["grf_n"] + np.float32(1.96) * true["grf_sigma_n"]
    assert columns["grf_high_n_max"] == pytest.approx(high_n[inside], abs=1e-5)
    assert columns["contact"] == [2 if one else 1 for one in true["contact"][inside]]


def test_an_arrow_overview_has_the_same_columns(hopped: Recording) -> None:
    query: dict[str, Any] = {"points": 50, "columns": "grf_n, force_n_1"}
    plain = get(hopped, **query)
    names = {"t_first_s", "t_last_s", "force_n_1_min", "force_n_1_max"}
    names |= {"grf_n_min", "grf_n_max", "grf_n_max_t_s"}
    assert set(plain["columns"]) == names
    answer = request(hopped, {"Accept": ARROW}, **query)
    with pa.ipc.open_stream(answer.content) as stream:
        table = stream.read_all()
    facts = json.loads(table.schema.metadata[b"foottile.overview"])
    assert facts == {name: value for name, value in plain.items() if name != "columns"}
    assert facts["serials"] == ["T01", "T02"]
    for name in names:
        expected = np.array(plain["columns"][name], dtype=float)
        np.testing.assert_allclose(table[name].to_numpy(), expected, atol=1e-6)
    known = {"Accept": ARROW, "If-None-Match": answer.headers["etag"]}
    again = request(hopped, known, **query)
    assert (again.status_code, again.content) == (304, b"")


def test_a_json_overview_is_compressed_on_request(hopped: Recording) -> None:
    def get_as(**headers: str) -> httpx.Response:
        answer: httpx.Response = request(hopped, headers)
        return answer

    packed = get_as(**{"Accept-Encoding": "gzip"})
    plain = get_as(**{"Accept-Encoding": "identity"})
    assert packed.headers["content-encoding"] == "gzip"
    assert "content-encoding" not in plain.headers
    assert packed.json() == plain.json()
    assert 2 * int(packed.headers["content-length"]) < int(plain.headers["content-length"])
    assert packed.headers["etag"] != plain.headers["etag"]
    assert packed.headers["vary"] == plain.headers["vary"] == "Accept, Accept-Encoding"
    tag = {"If-None-Match": packed.headers["etag"]}
    again = get_as(**{"Accept-Encoding": "gzip"} | tag)
    assert (again.status_code, again.content) == (304, b"")
    assert again.headers["vary"] == packed.headers["vary"]
    arrow = get_as(**{"Accept-Encoding": "gzip", "Accept": ARROW})
    assert "content-encoding" not in arrow.headers


def test_a_missing_or_damaged_overview_is_rebuilt(
    hopped: Recording, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = hopped.folder / "overview.arrow"
    with open_overview(path) as overview:
        assert overview.index.frames_sha256 == hopped.now()["sha256"]
    report = verify_session(hopped.folder)
    assert (report.problems, report.unproven) == ([], [])
    written, before = path.read_bytes(), get(hopped, points=20)
    path.unlink()
    assert get(hopped, points=20) == before
    assert path.read_bytes() == written
    flip_bits(path)
    assert any("overview.arrow" in text for text in verify_session(hopped.folder).problems)
    assert get(hopped, points=20) == before
    assert path.read_bytes() == written
    path.unlink()
    monkeypatch.setattr(service.sessions.overview, "write_overview", refusing(StorageError, "full"))
    assert get(hopped, points=20) == before
    assert not path.exists()


def test_a_wrong_query_is_refused(hopped: Recording) -> None:
    assert_refused(request(hopped, points=0), 422, "points")
    assert_refused(request(hopped, columns="grv"), 422, "'grv'")
    assert_refused(request(hopped, start_s=2, end_s=1), 422, "ends at 1 s")
    assert get(hopped, start_s=500)["columns"]["t_first_s"] == []
    unknown = hopped.running.session("20200101T000000Z-000000")
    assert_refused(request(unknown), 404, "20200101T000000Z-000000")


# --- before the seal ------------------------------------------------------------------------------


def count_frames(session: Recording) -> int:
    return int(sum(get(session)["columns"]["frames"]))


def waves(n: int) -> Any:
    """Return forces that rise and fall, 20 N and 60 N at most."""
    return (0.5 - 0.5 * np.cos(np.arange(n) / 40))[:, None] * [20.0, 60.0]


def test_a_preview_has_the_estimates_of_the_seal(running: Running, tared: FakeNode) -> None:
    session = tared.record()
    assert_refused(request(session), 409, "no frames yet")
    previews = []
    for n, total in ((500, 500), (300, 800)):
        tared.deliver(n, waves(n))
        until(partial(lambda total: count_frames(session) >= total - LAG, total))
        previews.append(get(session, points=8000))
    assert previews[1]["frames_in_bin"] == 1
    highest = max(previews[1]["columns"]["grf_n_max"])
    assert highest > 70.0
    coarse = get(session, points=20)
    assert 20 <= len(coarse["columns"]["frames"]) <= 80
    assert max(coarse["columns"]["grf_n_max"]) == highest
    running.restart()
    tared.connect()
    until(lambda: count_frames(session) >= 800 - LAG)
    previews.append(get(session, points=8000))
    tared.finish(session)
    sealed = get(session, points=8000)
    assert sealed["provisional"] is False
    for preview in previews:
        assert preview["provisional"] is True
        assert preview["begin_t_ns"] == sealed["begin_t_ns"]
        n = len(preview["columns"]["frames"])
        for name in ("t_first_s", "grf_n_max", "force_n_0_min", "cop_x_m_max", "estimate_flags"):
            assert preview["columns"][name] == sealed["columns"][name][:n], name


def test_a_preview_of_a_long_session_grows_with_each_request(
    tared: FakeNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    session = tared.record()
    tared.deliver(2000, waves(2000))
    monkeypatch.setattr(service.sessions.preview, "UPDATE_BUDGET_S", 0.0)
    assert_refused(request(session), 409, "no frames yet")
    monkeypatch.setattr(service.sessions.preview, "UPDATE_BUDGET_S", 100.0)
    assert count_frames(session) >= 2000 - LAG
    assert get(session)["catching_up"] is False


def test_an_overview_without_estimates_has_counts(running: Running, node_of: NodeOf) -> None:
    node = node_of(running, calibration=None)
    node.connect()
    node.deliver(10)
    session = node.record()
    node.deliver(100, [0.0, 30.0], alive=True)
    until(lambda: count_frames(session) == 100)
    preview = get(session, points=8000)["columns"]
    assert min(preview["pressure_raw_1_min"]) == 469
    node.finish(session)
    sealed = get(session, points=8000)["columns"]
    counts = read_frames(session, "pressure_raw")["pressure_raw"]
    for columns in (preview, sealed):
        assert columns["pressure_raw_0_max"] == counts[:, 0].tolist()
        assert "grf_n_max" not in columns


def test_only_the_last_previews_stay_in_memory(tared: FakeNode) -> None:
    sessions = [tared.record(name=str(i)) for i in range(6)]
    tared.deliver(200, waves(200))
    for each in sessions:
        until(partial(lambda each: count_frames(each) >= 200 - LAG, each))
    previews = tared.running.server.previews._previews
    assert list(previews) == [session.id for session in sessions[-4:]]
    sessions[-1].stop()
    tared.finish(sessions[-2])
    sessions[-1].sealed()
    get(sessions[-1])
    assert sessions[-1].id not in previews
