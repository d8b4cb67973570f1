"""Several sessions as one zip file: the files themselves, or nothing that opens."""

from __future__ import annotations

import errno
import io
import os
import threading
import tracemalloc
import zipfile
from email.utils import parsedate_to_datetime
from pathlib import Path
from typing import Any

import httpx
import pytest

import service.api.routes.downloads.zips
from service.api.routes.common import file_response
from service.api.routes.downloads.zips import ZippedSession, stream_zip
from storage.parquet_hash import compute_sha256
from storage.verify.session import verify_session
from tests.service.fake_node import FakeNode
from tests.service.recording import Recording
from tests.service.running import Running, assert_refused
from tests.storage.faulty_disk import refusing

FILES = {"frames.parquet", "session.json"}


@pytest.fixture
def two(tared: FakeNode) -> list[Recording]:
    sessions = []
    for force_n in (20.0, 60.0):
        session = tared.record(name=f"at {force_n} N")
        tared.deliver(300, [force_n, force_n])
        tared.finish(session)
        sessions.append(session)
    return sessions


def asked(running: Running, *ids: str) -> httpx.Response:
    return running.http.get("/sessions/zip", params={"ids": ",".join(ids)})


DATES_S = [0, -1, -(2**31) - 1, 315_532_799, 4_354_819_200, 2**32, 253_402_300_800, 2**56]
"""1970, before it, 1901, just outside of what a zip can state, 2106, 10000, beyond all years."""


def date_files(monkeypatch: pytest.MonkeyPatch, dated_s: int) -> None:
    """Have every file's last change at some instant, which not every file system can keep."""
    real = Path.stat

    def stat(self: Path, **how: Any) -> os.stat_result:
        fields = list(real(self, **how))
        fields[8] = dated_s
        return os.stat_result(fields)

    monkeypatch.setattr(Path, "stat", stat)


@pytest.mark.parametrize("dated_s", DATES_S)
def test_a_zip_is_whole_whatever_the_date_of_a_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, dated_s: int
) -> None:
    folder = tmp_path / "20200101T000000Z-00000a"
    folder.mkdir()
    for name in FILES:
        (folder / name).write_bytes(name.encode())
    sealed = ZippedSession(folder, compute_sha256(folder / "frames.parquet"))
    date_files(monkeypatch, dated_s)
    content = b"".join(stream_zip([sealed]))
    with zipfile.ZipFile(io.BytesIO(content)) as file:
        assert file.testzip() is None
        for entry in file.infolist():
            assert entry.filename.split("/")[1] in FILES
            years = entry.date_time[0]
            assert 1980 <= years <= 2107
            assert (years < 2000) == (dated_s < 946_684_800)


@pytest.mark.parametrize("dated_s", DATES_S)
def test_a_stored_file_is_sent_whatever_its_date(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, dated_s: int
) -> None:
    path = tmp_path / "frames.parquet"
    path.write_bytes(b"PAR1")
    date_files(monkeypatch, dated_s)
    answer = file_response(path)
    assert answer.headers["content-length"] == "4"
    said = parsedate_to_datetime(answer.headers["last-modified"])
    assert (said.year < 1970) == (dated_s < 0)


def test_what_fails_before_the_first_byte_is_an_error_and_no_empty_file(
    two: list[Recording], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(zipfile.ZipFile, "open", refusing(OSError, errno.EIO, "Input/output error"))
    answer = asked(two[0].running, two[0].id)
    assert_refused(answer, 507, "Input/output error")


def test_a_zip_has_the_very_files_and_they_are_proven(two: list[Recording], tmp_path: Path) -> None:
    answer = asked(two[0].running, *(session.id for session in two), two[0].id)
    assert answer.status_code == 200
    assert answer.headers["content-type"] == "application/zip"
    assert 'filename="foottile-2-sessions.zip"' in answer.headers["content-disposition"]
    with zipfile.ZipFile(io.BytesIO(answer.content)) as file:
        assert file.testzip() is None
        names = file.namelist()
        assert len(names) == len(set(names))
        for session in two:
            mine = {name.split("/")[1] for name in names if name.startswith(f"{session.id}/")}
            assert mine >= FILES
            for name in mine:
                entry = f"{session.id}/{name}"
                assert file.read(entry) == (session.folder / name).read_bytes(), entry
                assert file.getinfo(entry).compress_type == zipfile.ZIP_STORED
        file.extractall(tmp_path)
    for session in two:
        assert verify_session(tmp_path / session.id).problems == []


def test_what_has_no_whole_file_is_refused_before_anything_is_sent(
    two: list[Recording], tared: FakeNode
) -> None:
    running = two[0].running
    runs = tared.record()
    assert_refused(asked(running, two[0].id, runs.id), 409, runs.id, "recording")
    assert_refused(asked(running, "20200101T000000Z-000000"), 404, "20200101T000000Z-000000")
    assert_refused(asked(running, "../trash"), 404)
    assert_refused(asked(running, " , "), 422, "0 sessions")
    assert_refused(asked(running, *(f"a{i}" for i in range(1001))), 422, "1001 sessions")
    assert running.http.get("/sessions/zip").status_code == 422
    running.http.delete(two[1].url)
    assert_refused(asked(running, two[0].id, two[1].id), 404, two[1].id, "trash")
    (two[0].folder / "frames.parquet").unlink()
    assert_refused(asked(running, two[0].id), 404, "is missing")


def taken(running: Running, *ids: str) -> bytes:
    """What came of a download that breaks off."""
    content = b""
    with running.http.stream("GET", "/sessions/zip", params={"ids": ",".join(ids)}) as answer:
        assert answer.status_code == 200
        try:
            for piece in answer.iter_raw():
                content += piece
        except httpx.RemoteProtocolError:
            return content
    pytest.fail("it did not break off")


def test_of_a_damaged_session_there_is_no_zip_that_opens(two: list[Recording]) -> None:
    path = two[1].folder / "frames.parquet"
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)
    with pytest.raises(zipfile.BadZipFile):
        zipfile.ZipFile(io.BytesIO(taken(two[0].running, two[0].id, two[1].id)))


def test_of_a_session_that_is_deleted_on_the_way_there_is_no_zip_that_opens(
    two: list[Recording], monkeypatch: pytest.MonkeyPatch
) -> None:
    running = two[0].running
    real, begun, deleted = (
        service.api.routes.downloads.zips._put,
        threading.Event(),
        threading.Event(),
    )

    def slow(*args: Any) -> Any:
        if args[2].parent.name == two[1].id:
            begun.set()
            assert deleted.wait(30)
        return real(*args)

    monkeypatch.setattr(service.api.routes.downloads.zips, "_put", slow)

    def delete() -> None:
        assert begun.wait(30)
        with running.client() as http:
            assert http.delete(two[1].url).status_code == 204
        deleted.set()

    deleting = threading.Thread(target=delete)
    deleting.start()
    content = taken(running, two[0].id, two[1].id)
    deleting.join()
    assert len(content) > 1000  # the first one had gone out
    with pytest.raises(zipfile.BadZipFile):
        zipfile.ZipFile(io.BytesIO(content))


def test_its_memory_does_not_grow_with_the_files(tmp_path: Path) -> None:
    folder = tmp_path / "20200101T000000Z-000000"
    folder.mkdir()
    (folder / "frames.parquet").write_bytes(b"\0" * (40 << 20))
    (folder / "session.json").write_text("{}")
    sha256 = compute_sha256(folder / "frames.parquet")
    tracemalloc.start()
    try:
        sent = sum(len(piece) for piece in stream_zip([ZippedSession(folder, sha256)]))
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert sent > 40 << 20
    assert peak < 8 << 20
