"""Comparisons that `foottile compare` stored with a session, over REST."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest

from storage.documents import write_checksummed_json
from tests.service.fake_node import FakeNode
from tests.service.patient import patient_server
from tests.service.plates import LAG_S, ZERO_N, compare, hopped, write_plate
from tests.service.recording import Recording
from tests.service.running import assert_refused, content_of

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
        options = ("--remove-offset", "--reference-sigma-n", "0.3", "--limits", limits)
        assert compare(session, plate, *options) == 3
        yield session


@pytest.fixture
def compared(compared_once: Recording, tmp_path: Path) -> Iterator[Recording]:
    """A compared session; a test may damage its comparisons."""
    folder, copy = compared_once.folder / "comparisons", tmp_path / "copy"
    shutil.copytree(folder, copy)
    yield compared_once
    shutil.rmtree(folder)
    shutil.copytree(copy, folder)


def get(session: Recording, path: str = "", **query: Any) -> Any:
    return content_of(session.running.http.get(f"{session.url}/comparisons{path}", params=query))


@pytest.mark.slow
def test_a_comparison_has_figures_limits_and_the_reference_at_any_zoom(compared: Recording) -> None:
    (item,) = get(compared)["items"]
    assert (item["name"], item["problem"], item["matches_current_data"]) == (NAME, None, True)
    assert len(item["missed"]) == 1
    assert "grf_r2" in item["missed"][0]
    found = get(compared, f"/{NAME}")
    assert found["has_series"] is True
    report = found["report"]
    assert report["reference"] == f"{NAME}.csv"  # no path of the machine
    low_s, high_s = report["alignment"]["lag_s"]["interval_95"]
    assert low_s - 2e-3 < LAG_S < high_s + 2e-3
    assert report["alignment"]["offset_in_flight_n"]["value"] == pytest.approx(ZERO_N, abs=0.3)
    series = pq.read_table(compared.folder / "comparisons" / NAME / "series.parquet")
    reference_n = series["reference_grf_n"].to_numpy()
    error_n = series["grf_n"].to_numpy() - reference_n
    for points in (1, 30, 8000):
        columns = get(compared, f"/{NAME}/series", points=points)["columns"]
        assert sum(columns["frames"]) == series.num_rows
        assert max(columns["reference_grf_n_max"]) == pytest.approx(
            float(reference_n.max()), abs=1e-5
        )
        assert min(columns["error_n_min"]) == pytest.approx(float(error_n.min()), abs=1e-5)
    part = get(compared, f"/{NAME}/series", points=8000, start_s=1.0, end_s=1.5)
    since_s = (series["t_ns"].to_numpy() - part["begin_t_ns"]) * 1e-9
    inside = (since_s >= 1.0) & (since_s < 1.5)
    assert part["frames_in_bin"] == 1
    assert part["columns"]["t_first_s"] == pytest.approx(since_s[inside])
    assert part["columns"]["reference_grf_n_min"] == pytest.approx(reference_n[inside], abs=1e-5)


def test_the_reference_is_aligned_with_the_force(compared: Recording) -> None:
    columns = get(compared, f"/{NAME}/series", points=8000)["columns"]
    ours = compared.running.http.get(f"{compared.url}/timeseries", params={"points": 8000}).json()
    by_time = dict(zip(ours["columns"]["t_first_s"], ours["columns"]["grf_n_max"], strict=True))
    pairs = zip(columns["t_first_s"], columns["reference_grf_n_max"], strict=True)
    errors_n = [by_time[t_s] - reference_n for t_s, reference_n in pairs]
    assert np.median(np.abs(errors_n)) < 1.0


@pytest.mark.parametrize(
    "name", ["%2e%2e", "%2e", "..%2f..%2fframes.parquet", "nothing", "plate%00", "%5c..%5c"]
)
def test_a_wrong_name_is_not_found(compared: Recording, name: str) -> None:
    for path in (f"/{name}", f"/{name}/series"):
        answer = compared.running.http.get(f"{compared.url}/comparisons{path}")
        assert answer.status_code in (400, 404), (path, answer.text)


def test_a_link_is_not_followed(compared: Recording, tmp_path: Path) -> None:
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    (elsewhere / "compare.json").write_text("{}")
    (compared.folder / "comparisons" / "link").symlink_to(elsewhere)
    assert [item["name"] for item in get(compared)["items"]] == [NAME]
    answer = compared.running.http.get(f"{compared.url}/comparisons/link")
    assert_refused(answer, 404, "not compared with 'link'")


@pytest.mark.parametrize(
    "content", [b"", b"[]", b"{}", b'{"reference": 1}', b"\xff\xfe", b"flipped", None]
)
def test_a_damaged_report_is_named_and_the_others_stay(
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
    items = {item["name"]: item for item in get(compared)["items"]}
    assert set(items) == {NAME, "other"}
    assert items[NAME]["problem"] is None
    assert "compare.json" in items["other"]["problem"]
    http, url = compared.running.http, f"{compared.url}/comparisons"
    assert_refused(http.get(f"{url}/other"), 422, "compare.json")


def test_a_damaged_or_missing_series_is_named(compared: Recording) -> None:
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


def test_a_comparison_of_other_frames_is_marked(compared: Recording) -> None:
    path = compared.folder / "comparisons" / NAME / "compare.json"
    content = json.loads(path.read_text())
    del content["check"]
    content["session"]["file_sha256"] = "0" * 64
    write_checksummed_json(path, json.dumps(content).encode())
    assert get(compared, f"/{NAME}")["matches_current_data"] is False


def test_a_session_without_comparisons_has_none(tared: FakeNode) -> None:
    session = tared.record()
    assert get(session)["items"] == []
    http, url = session.running.http, f"{session.url}/comparisons/plate"
    assert_refused(http.get(url), 404, "a comparison: it has none")
    assert_refused(http.get(f"{url}/series"), 409, "Stop it")
