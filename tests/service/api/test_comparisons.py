"""What `foottile compare` has kept with a session, over REST."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest

from storage.checksummed_json import write_checksummed_json
from tests.service.fake_node import FakeNode
from tests.service.patient import patient_server
from tests.service.plates import LAG_S, ZERO_N, compare, hopped, write_plate
from tests.service.recording import Recording
from tests.service.running import assert_refused

NAME = "plate 1"


@pytest.fixture(scope="module")
def compared_once(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Recording]:
    folder = tmp_path_factory.mktemp("compared")
    with patient_server(folder / "data") as running:
        node = FakeNode(running)
        node.connect()
        node.tared()
        session = hopped(node)
        node.close()
        plate = folder / f"{NAME}.csv"
        write_plate(session, plate)
        limits = "grf_mae_n=2,grf_r2=0.9999"
        asked = ("--remove-offset", "--reference-sigma-n", "0.3", "--limits", limits)
        assert compare(session, plate, *asked) == 3
        yield session


@pytest.fixture
def compared(compared_once: Recording, tmp_path: Path) -> Iterator[Recording]:
    """A session and what it was compared with; a test may spoil what is kept of that."""
    kept, copy = compared_once.folder / "comparisons", tmp_path / "kept"
    shutil.copytree(kept, copy)
    yield compared_once
    shutil.rmtree(kept)
    shutil.copytree(copy, kept)


def asked(session: Recording, path: str = "", **query: Any) -> Any:
    answer = session.running.http.get(f"{session.url}/comparisons{path}", params=query)
    assert answer.status_code == 200, answer.text
    return answer.json()


def test_figures_intervals_limits_and_the_reference_at_any_zoom(compared: Recording) -> None:
    (item,) = asked(compared)["items"]
    assert (item["name"], item["problem"], item["matches_current_data"]) == (NAME, None, True)
    assert len(item["missed"]) == 1
    assert "grf_r2" in item["missed"][0]
    found = asked(compared, f"/{NAME}")
    assert found["has_series"] is True
    report = found["report"]
    assert report["reference"] == f"{NAME}.csv"  # of the machine on which it was compared nothing
    low_s, high_s = report["alignment"]["lag_s"]["interval_95"]
    assert low_s - 2e-3 < LAG_S < high_s + 2e-3
    assert report["alignment"]["offset_in_flight_n"]["value"] == pytest.approx(ZERO_N, abs=0.3)
    kept = pq.read_table(compared.folder / "comparisons" / NAME / "series.parquet")
    theirs_n = kept["reference_grf_n"].to_numpy()
    error_n = kept["grf_n"].to_numpy() - theirs_n
    for points in (1, 30, 8000):
        columns = asked(compared, f"/{NAME}/series", points=points)["columns"]
        assert sum(columns["frames"]) == kept.num_rows
        assert max(columns["reference_grf_n_max"]) == pytest.approx(float(theirs_n.max()), abs=1e-5)
        assert min(columns["error_n_min"]) == pytest.approx(float(error_n.min()), abs=1e-5)
    part = asked(compared, f"/{NAME}/series", points=8000, start_s=1.0, end_s=1.5)
    since_s = (kept["t_ns"].to_numpy() - part["begin_t_ns"]) * 1e-9
    inside = (since_s >= 1.0) & (since_s < 1.5)
    assert part["frames_in_bin"] == 1
    assert part["columns"]["t_first_s"] == pytest.approx(since_s[inside])
    assert part["columns"]["reference_grf_n_min"] == pytest.approx(theirs_n[inside], abs=1e-5)


def test_the_reference_lies_where_our_force_is(compared: Recording) -> None:
    columns = asked(compared, f"/{NAME}/series", points=8000)["columns"]
    ours = compared.running.http.get(f"{compared.url}/timeseries", params={"points": 8000}).json()
    by_time = dict(zip(ours["columns"]["t_first_s"], ours["columns"]["grf_n_max"], strict=True))
    pairs = [
        (by_time[t_s], theirs_n)
        for t_s, theirs_n in zip(columns["t_first_s"], columns["reference_grf_n_max"], strict=True)
    ]
    ours_n, theirs_n = np.array(pairs).T
    assert np.median(np.abs(ours_n - theirs_n)) < 1.0


@pytest.mark.parametrize(
    "name", ["%2e%2e", "%2e", "..%2f..%2fframes.parquet", "nothing", "plate%00", "%5c..%5c"]
)
def test_a_name_is_looked_up_and_leads_nowhere_else(compared: Recording, name: str) -> None:
    for path in (f"/{name}", f"/{name}/series"):
        answer = compared.running.http.get(f"{compared.url}/comparisons{path}")
        assert answer.status_code in (400, 404), (path, answer.text)


def test_a_link_in_the_folder_is_not_followed(compared: Recording, tmp_path: Path) -> None:
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    (elsewhere / "compare.json").write_text("{}")
    (compared.folder / "comparisons" / "link").symlink_to(elsewhere)
    assert [item["name"] for item in asked(compared)["items"]] == [NAME]
    answer = compared.running.http.get(f"{compared.url}/comparisons/link")
    assert_refused(answer, 404, "not compared with 'link'")


@pytest.mark.parametrize(
    "content", [b"", b"[]", b"{}", b'{"reference": 1}', b"\xff\xfe", b"flipped", None]
)
def test_a_damaged_report_is_said_to_be_and_the_others_stay(
    compared: Recording, content: bytes | None
) -> None:
    folder = compared.folder / "comparisons"
    (folder / "other").mkdir()
    path = folder / "other" / "compare.json"
    if content == b"flipped":
        whole = (folder / NAME / "compare.json").read_bytes()
        content = whole[:200] + bytes([whole[200] ^ 1]) + whole[201:]
    if content is not None:
        path.write_bytes(content)
    items = {item["name"]: item for item in asked(compared)["items"]}
    assert set(items) == {NAME, "other"}
    assert items[NAME]["problem"] is None
    assert "compare.json" in items["other"]["problem"]
    http, url = compared.running.http, f"{compared.url}/comparisons"
    assert_refused(http.get(f"{url}/other"), 422, "compare.json")


def test_a_damaged_series_is_said_to_be_and_a_missing_one_too(
    compared: Recording,
) -> None:
    path = compared.folder / "comparisons" / NAME / "series.parquet"
    http, url = compared.running.http, f"{compared.url}/comparisons/{NAME}"
    whole = path.read_bytes()
    for content in (b"", whole[:100], whole[:50] + bytes([whole[50] ^ 1]) + whole[51:]):
        path.write_bytes(content)
        assert_refused(http.get(f"{url}/series"), 422, "series.parquet")
        assert http.get(url).status_code == 200
    path.unlink()
    assert http.get(url).json()["has_series"] is False
    assert_refused(http.get(f"{url}/series"), 404, "no series", "too many frames")


def test_a_comparison_with_other_frames_says_so(
    compared: Recording,
) -> None:
    path = compared.folder / "comparisons" / NAME / "compare.json"
    content = json.loads(path.read_text())
    del content["check"]
    content["session"]["file_sha256"] = "0" * 64
    write_checksummed_json(path, json.dumps(content).encode())
    assert asked(compared, f"/{NAME}")["matches_current_data"] is False


def test_a_session_that_was_compared_with_nothing_has_none(tared: FakeNode) -> None:
    session = tared.record()
    assert asked(session)["items"] == []
    refused = session.running.http.get(f"{session.url}/comparisons/plate")
    assert_refused(refused, 404, "a comparison: it has none")
    series = session.running.http.get(f"{session.url}/comparisons/plate/series")
    assert_refused(series, 409, "Stop it")
    tared.deliver(10)
    tared.finish(session)
