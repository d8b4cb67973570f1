"""Downloads: the stored file by ranges, and every other format as a stream."""

from __future__ import annotations

import hashlib
import threading
from base64 import b64encode
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from storage.formats.export import Export
from storage.formats.writers.registry import FORMATS
from tests.service.api.sealed import Sealed
from tests.service.fake_node import NodeOf
from tests.service.recording import read_table
from tests.service.running import Running, assert_refused
from tests.storage.formats.writers.readers import said_in
from tests.waiting import until


def test_a_download_is_the_stored_file(sealed: Sealed) -> None:
    answer = sealed.get_file()
    assert answer.status_code == 200
    assert answer.content == sealed.content
    sha256 = hashlib.sha256(answer.content)
    assert sealed.session.now()["sha256"] == sha256.hexdigest()
    expected = {
        "etag": f'"{sha256.hexdigest()}"',
        "repr-digest": f"sha-256=:{b64encode(sha256.digest()).decode()}:",
        "content-length": str(len(sealed.content)),
        "accept-ranges": "bytes",
        "foottile-complete": "true",
        "content-type": "application/vnd.apache.parquet",
    }
    assert {name: answer.headers[name] for name in expected} == expected
    assert f'filename="trial_{sealed.id}.parquet"' in answer.headers["content-disposition"]
    assert answer.headers["cache-control"] == "private, no-cache"


def test_a_range_is_a_part_of_the_file(sealed: Sealed) -> None:
    size = len(sealed.content)
    for requested, begin, end in (
        ("0-0", 0, 1),
        ("100-199", 100, 200),
        (f"{size - 1}-", size - 1, size),
        ("0-", 0, size),
        ("-1", size - 1, size),
        ("-100", size - 100, size),
        (f"-{size * 2}", 0, size),
        (f"10-{size * 2}", 10, size),
    ):
        answer = sealed.get_file(Range=f"bytes={requested}")
        assert answer.status_code == 206, requested
        assert answer.content == sealed.content[begin:end], requested
        assert answer.headers["content-range"] == f"bytes {begin}-{end - 1}/{size}", requested
        assert answer.headers["content-length"] == str(end - begin), requested
        assert answer.headers["etag"] == f'"{sealed.session.now()["sha256"]}"', requested


def test_a_range_outside_the_file_is_refused_with_its_size(sealed: Sealed) -> None:
    size = len(sealed.content)
    for requested in (f"bytes={size}-", f"bytes={size + 5}-{size + 9}", "bytes=-0"):
        answer = sealed.get_file(Range=requested)
        assert_refused(answer, 416, str(size))
        assert answer.headers["content-range"] == f"bytes */{size}"


@pytest.mark.parametrize(
    "requested",
    [
        *("bytes=0-1,5-6", "bytes=9-2", "bytes=a-b", "bytes=-", "bytes", "bytes=", "lines=0-5", ""),
        *("bytes=0-5-9", "bytes=--5", "bytes=\xb2-", "bytes=" + "9" * 300 + "-"),
    ],
)
def test_a_wrong_range_and_several_ranges_are_ignored(sealed: Sealed, requested: str) -> None:
    answer = sealed.get_file(Range=requested.encode("latin-1"))  # type: ignore[arg-type]  # no text
    assert (answer.status_code, answer.content) == (200, sealed.content)


def test_if_range_and_if_none_match_name_the_file(sealed: Sealed) -> None:
    sha256 = sealed.session.now()["sha256"]
    right = f'"{sha256}"'
    for tag, is_range in (
        (right, True),
        ('"' + "0" * 64 + '"', False),
        ("W/" + right, False),
        ("Wed, 21 Oct 2015 07:28:00 GMT", False),
    ):
        answer = sealed.get_file(Range="bytes=0-9", **{"If-Range": tag})
        assert answer.status_code == (206 if is_range else 200), tag
        assert answer.content == (sealed.content[:10] if is_range else sealed.content), tag
    for tags, is_known in (
        (right, True),
        (f"W/{right}", True),
        (f'"a",W/{right} , "b"', True),
        ("*", True),
        (sha256, False),
        ('"a", "b"', False),
    ):
        answer = sealed.get_file(**{"If-None-Match": tags})
        assert answer.status_code == (304 if is_known else 200), tags
        assert answer.headers["etag"] == right
        assert answer.content == (b"" if is_known else sealed.content)


def test_different_data_have_different_tags(sealed: Sealed) -> None:
    queries: tuple[dict[str, Any], ...] = (
        {"format": "csv"},
        {"format": "arrow"},
        {"format": "csv", "columns": "seq"},
        {"format": "csv", "end_s": 0.1},
        {"format": "csv", "start_s": 0.1},
    )
    tags = [sealed.export(**query).headers["etag"] for query in queries]
    assert len(set(tags)) == len(queries)
    assert sealed.export(**queries[0]).headers["etag"] == tags[0]
    url, known = f"{sealed.session.url}/data", {"If-None-Match": tags[0]}
    assert sealed.running.http.get(url, params=queries[0], headers=known).status_code == 304


def test_a_file_has_the_name_and_seconds_of_its_trial(sealed: Sealed) -> None:
    answer = sealed.export(sealed.recording, format="csv", start_s=0.05, columns="grf_n")
    name = f"nder-..-3rd-trial_{sealed.recording.id}_0.050s-to-end.csv"
    assert answer.headers["content-disposition"] == f'attachment; filename="{name}"'


@pytest.mark.parametrize("to", FORMATS)
def test_a_recording_session_is_incomplete_in_a_format_or_waits(sealed: Sealed, to: str) -> None:
    answer = sealed.export(sealed.recording, format=to)
    if FORMATS[to].needs_sealed:
        assert_refused(answer, 409, "is recording", "when it is sealed", "Stop it")
        return
    (facts,) = said_in(to, answer.content)
    assert facts["complete"].lower().startswith(("false", "not complete"))
    assert answer.headers["foottile-complete"] == "false"
    assert answer.headers["etag"].startswith('W/"')
    if to in ("arrow", "csv"):
        found = read_table(answer, to)
        assert found["seq"].to_pylist() == list(range(380, 430))
        assert found["force_n_0"].to_numpy()[20:40] == pytest.approx(np.full(20, 5.0), abs=0.1)


def test_parquet_waits_for_the_seal(sealed: Sealed) -> None:
    for query in ({}, {"format": "parquet"}, {"columns": "seq"}):
        assert_refused(sealed.export(sealed.recording, **query), 409, "csv")


def test_a_session_with_losses_or_without_forces_is_so_in_every_format(
    running: Running, node_of: NodeOf
) -> None:
    raw, lossy = node_of(running, "raw", calibration=None), node_of(running, "lossy")
    raw.connect()
    raw.deliver(70)
    lossy.connect()
    lossy.tared()
    sessions = {node: node.record() for node in (raw, lossy)}
    raw.deliver(100, [20.0, 60.0])
    lossy.deliver(50, [20.0, 60.0])
    lossy.say_lost(disk_full=[[lossy.seq, lossy.seq + 19]])
    lossy.frames(20)
    lossy.deliver(50, [20.0, 60.0])
    for node, session in sessions.items():
        node.finish(session)
    for to, known in FORMATS.items():
        answer = sessions[lossy].data(format=to, markers=True)
        assert answer.headers["foottile-complete"] == "lossy"
        assert said_in(to, answer.content)[0]["complete"].lower().startswith("lossy")
        url = f"{sessions[raw].url}/data"
        answer = running.http.get(url, params={"format": to, "markers": "true"})
        if known.needs_forces:
            assert_refused(answer, 422, "this session has none", "ask for its counts")
        else:
            assert answer.headers["foottile-complete"] == "true"
            assert said_in(to, answer.content)[0]["complete"].lower() == "true"


def test_an_aborted_download_ends_its_encoder(
    sealed: Sealed, monkeypatch: pytest.MonkeyPatch
) -> None:
    ended = threading.Event()

    def encode_endlessly(_: Sequence[Export]) -> Iterator[bytes]:
        try:
            while True:
                yield bytes(1 << 20)
        finally:
            ended.set()

    monkeypatch.setitem(FORMATS, "csv", replace(FORMATS["csv"], encoder=encode_endlessly))
    url, query = f"{sealed.session.url}/data", {"format": "csv", "start_s": "0.1"}
    with sealed.running.http.stream("GET", url, params=query) as answer:
        next(answer.iter_bytes())
        assert not ended.is_set()
    until(ended.is_set)


@pytest.mark.parametrize(
    ("query", "reason"),
    [
        ({"formats": "csv"}, "formats"),
        ({"format": "xlsx"}, "format"),
        ({"format": "csv", "columns": "nonsense"}, "nonsense"),
        ({"format": "csv", "columns": "force_n_2"}, "force_n_2"),
        ({"format": "c3d", "columns": "grf_n"}, "fixed columns"),
        ({"format": "c3d", "decimal": "comma"}, "no option"),
        *[({"format": to, "start_s": 100}, "starts at 100 s") for to in FORMATS],
        *[({"format": to, "start_s": 2, "end_s": 1}, "ends at 1 s") for to in FORMATS],
        *[({"start_s": value}, "start_s") for value in ("-1", "nan", "soon", "1e300")],
        *[({"end_s": value}, "end_s") for value in ("inf", "0")],
    ],
    ids=str,
)
def test_a_wrong_query_is_refused(sealed: Sealed, query: dict[str, Any], reason: str) -> None:
    assert_refused(sealed.export(**query), 422, reason)


def test_a_missing_file_is_named(sealed: Sealed, tmp_path: Path) -> None:
    path = sealed.session.folder / "frames.parquet"
    away = path.rename(tmp_path / path.name)
    try:
        assert_refused(sealed.get_file(), 404, "is missing")
        assert sealed.export(format="csv").status_code in (404, 500)
    finally:
        away.rename(path)
