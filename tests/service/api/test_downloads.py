"""Downloads: the stored file by ranges, and other formats as streams."""

from __future__ import annotations

import hashlib
import io
from base64 import b64encode
from typing import Any

import httpx
import numpy as np
import pyarrow as pa
import pyarrow.csv as pacsv
import pyarrow.parquet as pq
import pytest

from tests.service.api.sealed import Sealed
from tests.service.running import assert_refused


def table_of(answer: httpx.Response, to: str) -> pa.Table:
    assert answer.status_code == 200, answer.text
    match to:
        case "parquet":
            return pq.read_table(io.BytesIO(answer.content))
        case "arrow":
            return pa.ipc.open_file(answer.content).read_all()
        case _:
            return pacsv.read_csv(io.BytesIO(answer.content))


def test_the_whole_file_comes_as_it_is_stored(sealed: Sealed) -> None:
    answer = sealed.get()
    assert answer.status_code == 200
    assert answer.content == sealed.content
    assert answer.headers["etag"] == f'"{sealed.sha256}"'
    digest = b64encode(hashlib.sha256(answer.content).digest()).decode()
    assert answer.headers["repr-digest"] == f"sha-256=:{digest}:"
    assert answer.headers["content-length"] == str(len(sealed.content))
    assert answer.headers["accept-ranges"] == "bytes"
    assert answer.headers["foottile-complete"] == "true"
    assert answer.headers["content-type"] == "application/vnd.apache.parquet"
    assert f'filename="trial_{sealed.id}.parquet"' in answer.headers["content-disposition"]
    assert "immutable" in answer.headers["cache-control"]
    assert sealed.session.now()["sha256"] == sealed.sha256


def test_one_range_is_that_part_of_the_file(sealed: Sealed) -> None:
    size = len(sealed.content)
    for asked, begin, end in (
        ("bytes=0-0", 0, 1),
        ("bytes=0-99", 0, 100),
        ("bytes=100-199", 100, 200),
        (f"bytes={size - 1}-", size - 1, size),
        ("bytes=1000-", 1000, size),
        ("bytes=0-", 0, size),
        ("bytes=-1", size - 1, size),
        ("bytes=-100", size - 100, size),
        (f"bytes=-{size * 2}", 0, size),
        (f"bytes=10-{size * 2}", 10, size),
    ):
        answer = sealed.get(Range=asked)
        assert answer.status_code == 206, asked
        assert answer.content == sealed.content[begin:end], asked
        assert answer.headers["content-range"] == f"bytes {begin}-{end - 1}/{size}", asked
        assert answer.headers["content-length"] == str(end - begin), asked
        assert answer.headers["etag"] == f'"{sealed.sha256}"', asked


def test_a_range_outside_the_file_is_a_problem_that_says_its_size(sealed: Sealed) -> None:
    size = len(sealed.content)
    for asked in (f"bytes={size}-", f"bytes={size + 5}-{size + 9}", "bytes=-0"):
        answer = sealed.get(Range=asked)
        assert answer.status_code == 416, asked
        assert answer.headers["content-range"] == f"bytes */{size}"
        assert answer.headers["content-type"] == "application/problem+json"
        assert str(size) in answer.json()["detail"]


def test_a_range_that_is_not_understood_or_several_is_ignored(sealed: Sealed) -> None:
    for asked in (
        "bytes=0-1,5-6",
        "bytes=9-2",
        "bytes=a-b",
        "bytes=-",
        "bytes",
        "bytes=",
        "lines=0-5",
        "bytes=0-5-9",
        "bytes=--5",
        "bytes=\xb2-",
        "bytes=" + "9" * 300 + "-",
        "",
    ):
        answer = sealed.get(Range=asked.encode("latin-1"))  # type: ignore[arg-type]  # no text
        assert answer.status_code == 200, asked
        assert answer.content == sealed.content, asked


def test_a_range_holds_only_for_the_file_that_if_range_names(sealed: Sealed) -> None:
    right = f'"{sealed.sha256}"'
    for given, status in (
        (right, 206),
        ('"' + "0" * 64 + '"', 200),
        ("W/" + right, 200),
        ("Wed, 21 Oct 2015 07:28:00 GMT", 200),
    ):
        answer = sealed.get(Range="bytes=0-9", **{"If-Range": given})
        assert answer.status_code == status, given
        assert answer.content == (sealed.content[:10] if status == 206 else sealed.content), given


def test_what_one_has_already_is_not_sent(sealed: Sealed) -> None:
    right = f'"{sealed.sha256}"'
    for given, status in (
        (right, 304),
        (f"W/{right}", 304),
        (f'"a", {right}', 304),
        (f'"a",W/{right} , "b"', 304),
        ("*", 304),
        ('"a"', 200),
        (sealed.sha256, 200),
        ('"a", "b"', 200),
    ):
        answer = sealed.get(**{"If-None-Match": given})
        assert answer.status_code == status, given
        assert answer.headers["etag"] == right
        assert answer.content == (b"" if status == 304 else sealed.content)


def test_head_says_what_get_would_and_sends_nothing(sealed: Sealed) -> None:
    got, head = sealed.get(), sealed.get("HEAD")
    assert head.status_code == 200
    assert head.content == b""
    ignored = {"date"}
    assert {k: v for k, v in head.headers.items() if k not in ignored} == {
        k: v for k, v in got.headers.items() if k not in ignored
    }


def test_head_of_what_is_made_says_what_get_would(sealed: Sealed) -> None:
    url = f"/sessions/{sealed.id}/data?format=csv"
    got, head = sealed.running.http.get(url), sealed.running.http.head(url)
    assert head.status_code == 200
    assert head.content == b""
    for name in ("etag", "content-type", "content-disposition", "foottile-complete"):
        assert head.headers[name] == got.headers[name]


@pytest.mark.parametrize("to", ["parquet", "arrow", "csv"])
def test_a_slice_has_the_rows_and_columns_asked_for(sealed: Sealed, to: str) -> None:
    whole = pq.read_table(io.BytesIO(sealed.content))
    answer = sealed.made(format=to, start_s=0.1, end_s=0.2, columns="seq,force_n, pressure_raw_1")
    found = table_of(answer, to)
    assert found.column_names == ["seq", "force_n_0", "force_n_1", "pressure_raw_1"]
    assert found["seq"].to_pylist() == list(range(70 + 50, 70 + 100))
    for name in found.column_names:
        np.testing.assert_allclose(
            found[name].to_numpy(), whole[name].to_numpy()[50:100], rtol=1e-6, err_msg=name
        )
    assert answer.headers["etag"].startswith('"')
    assert answer.headers["accept-ranges"] == "none"


@pytest.mark.parametrize("to", ["arrow", "csv"])
def test_another_format_of_the_whole_has_the_same_values(sealed: Sealed, to: str) -> None:
    whole = pq.read_table(io.BytesIO(sealed.content))
    found = table_of(sealed.made(format=to), to)
    made = ["marker", "time_s", "time_utc", *(["about"] if to == "csv" else [])]
    assert sorted(found.column_names) == sorted([*whole.column_names, *made])
    for name in ("seq", "t_ns", "pressure_raw_0", "part", "force_n_1", "grf_n"):
        np.testing.assert_allclose(
            found[name].to_numpy(), whole[name].to_numpy(), rtol=1e-6, err_msg=name
        )


def test_a_slice_that_begins_after_the_end_or_ends_before_it_begins_is_refused(
    sealed: Sealed,
) -> None:
    for to in ("parquet", "arrow", "csv"):
        assert_refused(sealed.made(format=to, start_s=100), 422, "starts at 100 s", "ends at")
        assert_refused(sealed.made(format=to, start_s=2, end_s=1), 422, "ends at 1 s")
    assert_refused(sealed.made(sealed.recording, format="csv", start_s=100), 422, "starts at")


def test_queries_that_ask_for_different_data_have_different_tags(sealed: Sealed) -> None:
    queries: tuple[dict[str, Any], ...] = (
        {"format": "csv"},
        {"format": "arrow"},
        {"format": "csv", "columns": "seq"},
        {"format": "csv", "end_s": 0.1},
        {"format": "csv", "start_s": 0.1},
    )
    tags = [sealed.made(**query).headers["etag"] for query in queries]
    assert len(set(tags)) == len(queries)
    assert sealed.made(**queries[0]).headers["etag"] == tags[0]
    answer = sealed.running.http.get(
        f"/sessions/{sealed.id}/data", params=queries[0], headers={"If-None-Match": tags[0]}
    )
    assert answer.status_code == 304


def test_parquet_of_a_recording_session_is_not_there_yet(sealed: Sealed) -> None:
    for query in ({}, {"format": "parquet"}, {"columns": "seq"}):
        assert_refused(sealed.made(sealed.recording, **query), 409, "csv")


def test_a_file_is_named_after_the_trial_and_its_seconds(sealed: Sealed) -> None:
    changed = {"name": "Ünder/..\\ 3rd trial\r\n"}
    answer = sealed.session.running.http.patch(
        sealed.session.url,
        json=changed,
        headers={"If-Match": f'"{sealed.session.now()["revision"]}"'},
    )
    assert answer.status_code == 200, answer.text
    made = sealed.made(sealed.session, format="csv", start_s=0.25, columns="grf_n")
    name = f"nder-..-3rd-trial_{sealed.id}_0.250s-to-end.csv"
    assert made.headers["content-disposition"] == f'attachment; filename="{name}"'


@pytest.mark.parametrize("to", ["arrow", "csv"])
def test_a_recording_session_gives_what_there_is(sealed: Sealed, to: str) -> None:
    answer = sealed.made(sealed.recording, format=to)
    assert answer.headers["foottile-complete"] == "false"
    assert answer.headers["etag"].startswith('W/"')
    found = table_of(answer, to)
    assert found["seq"].to_pylist() == list(range(380, 430))
    assert found["force_n_0"].to_numpy()[20:40] == pytest.approx(np.full(20, 5.0), abs=0.1)


@pytest.mark.parametrize(("to", "ending"), [("c3d", "c3d"), ("opensim", "opensim.zip")])
def test_files_of_motion_laboratories_are_of_sealed_and_of_recording_sessions(
    sealed: Sealed, to: str, ending: str
) -> None:
    for session in (sealed.session, sealed.recording):
        answer = sealed.made(session, format=to)
        assert answer.status_code == 200, answer.text
        begin = {"c3d": b"\x02\x50", "opensim": b"PK\x03\x04"}[to]
        assert answer.content.startswith(begin)
        name = f'filename="trial_{session.id}.{ending}"'
        assert name in answer.headers["content-disposition"]
    for query, said in (
        ({"columns": "grf_n"}, "fixed columns"),
        ({"start_s": 100}, "starts at 100 s"),
        ({"decimal": "comma"}, "no option"),
    ):
        assert_refused(sealed.made(format=to, **query), 422, said)


@pytest.mark.parametrize(
    "query",
    [
        {"formats": "csv"},
        {"format": "xlsx"},
        {"format": "csv", "columns": "nonsense"},
        {"format": "csv", "columns": "force_n_2"},
        {"start_s": "-1"},
        {"start_s": "nan"},
        {"end_s": "inf"},
        {"end_s": "0"},
        {"start_s": "soon"},
        {"start_s": "1e300"},
    ],
    ids=str,
)
def test_a_query_that_is_none_is_refused(sealed: Sealed, query: dict[str, Any]) -> None:
    answer = sealed.made(**query)
    assert answer.status_code == 422
    assert answer.headers["content-type"] == "application/problem+json"


def test_an_odd_id_is_not_found(sealed: Sealed) -> None:
    for odd in (
        "%2e%2e",
        "%2e%2e%2f%2e%2e%2fetc%2fpasswd",
        "..%5c..",
        "20200101T000000Z-000000",
        "20200101T000000Z-000000%00",
        f"{sealed.id}%0a",
        "x" * 5000,
        "%ff",
    ):
        for rest in ("", "/data", "/markers", "/ledger"):
            answer = sealed.running.http.get(f"/sessions/{odd}{rest}")
            assert answer.status_code in (400, 404), odd
            assert answer.headers["content-type"] == "application/problem+json"


def test_a_file_that_was_taken_away_is_said_to_be(sealed: Sealed) -> None:
    path = sealed.session.folder / "frames.parquet"
    path.unlink()
    assert_refused(sealed.get(), 404, "is missing")
    assert sealed.made(format="csv").status_code in (404, 500)
    assert sealed.running.http.get("/health").status_code == 200
