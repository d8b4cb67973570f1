"""Several sessions in one zip file: whole files, or no file that opens."""

from __future__ import annotations

import errno
import io
import os
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


def get(running: Running, *ids: str) -> httpx.Response:
    return running.http.get("/sessions/zip", params={"ids": ",".join(ids)})


DATES_S = [0, -1, -(2**31) - 1, 315_532_799, 4_354_819_200, 2**32, 253_402_300_800, 2**56]
"""1970, before it, 1901, just outside of the years of a zip file, 2106, 10000, beyond all years."""


def date_files(monkeypatch: pytest.MonkeyPatch, dated_s: int) -> None:
    """Set the last change of every file, also to dates that a file system cannot store."""
    stat = Path.stat

    def stat_dated(self: Path, **options: Any) -> os.stat_result:
        fields = list(stat(self, **options))
        fields[8] = dated_s
        return os.stat_result(fields)

    monkeypatch.setattr(Path, "stat", stat_dated)


@pytest.mark.parametrize("dated_s", DATES_S)
def test_any_date_of_a_file_is_sent(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, dated_s: int
) -> None:
    folder = tmp_path / "20200101T000000Z-00000a"
    folder.mkdir()
    for name in FILES:
        (folder / name).write_bytes(name.encode())
    sealed = ZippedSession(folder, compute_sha256(folder / "frames.parquet"))
    date_files(monkeypatch, dated_s)
    answer = file_response(folder / "frames.parquet")
    assert answer.headers["content-length"] == str(len("frames.parquet"))
    modified = parsedate_to_datetime(answer.headers["last-modified"])
    assert (modified.year < 1970) == (dated_s < 0)
    content = b"".join(stream_zip([sealed]))
    with zipfile.ZipFile(io.BytesIO(content)) as file:
        assert file.testzip() is None
        for entry in file.infolist():
            assert entry.filename.split("/")[1] in FILES
            years = entry.date_time[0]
            assert 1980 <= years <= 2107
            assert (years < 2000) == (dated_s < 946_684_800)


def test_a_failure_before_the_first_byte_is_an_error(
    two: list[Recording], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(zipfile.ZipFile, "open", refusing(OSError, errno.EIO, "Input/output error"))
    answer = get(two[0].running, two[0].id)
    assert_refused(answer, 507, "Input/output error")


def test_a_zip_has_the_files_of_its_sessions(two: list[Recording], tmp_path: Path) -> None:
    answer = get(two[0].running, *(session.id for session in two), two[0].id)
    assert answer.status_code == 200
    assert answer.headers["content-type"] == "application/zip"
    assert 'filename="foottile-2-sessions.zip"' in answer.headers["content-disposition"]
    with zipfile.ZipFile(io.BytesIO(answer.content)) as file:
        assert file.testzip() is None
        names = file.namelist()
        assert len(names) == len(set(names))
        for session in two:
            files = {name.split("/")[1] for name in names if name.startswith(f"{session.id}/")}
            assert files >= FILES
            for name in files:
                entry = f"{session.id}/{name}"
                assert file.read(entry) == (session.folder / name).read_bytes(), entry
                assert file.getinfo(entry).compress_type == zipfile.ZIP_STORED
        file.extractall(tmp_path)
    for session in two:
        assert verify_session(tmp_path / session.id).problems == []


def test_a_session_without_a_whole_file_is_refused(two: list[Recording], tared: FakeNode) -> None:
    running = two[0].running
    recording = tared.record()
    assert_refused(get(running, two[0].id, recording.id), 409, recording.id, "recording")
    assert_refused(get(running, "20200101T000000Z-000000"), 404, "20200101T000000Z-000000")
    assert_refused(get(running, "../trash"), 404)
    assert_refused(get(running, " , "), 422, "0 sessions")
    assert_refused(get(running, *(f"a{i}" for i in range(1001))), 422, "1001 sessions")
    assert running.http.get("/sessions/zip").status_code == 422
    running.http.delete(two[1].url)
    assert_refused(get(running, two[0].id, two[1].id), 404, two[1].id, "trash")
    (two[0].folder / "frames.parquet").unlink()
    assert_refused(get(running, two[0].id), 404, "is missing")


def read_until_cut(running: Running, *ids: str) -> bytes:
    """Return the bytes of a download that breaks off."""
    content = b""
    with running.http.stream("GET", "/sessions/zip", params={"ids": ",".join(ids)}) as answer:
        assert answer.status_code == 200
        try:
            for piece in answer.iter_raw():
                content += piece
        except httpx.RemoteProtocolError:
            return content
    pytest.fail("it did not break off")


def test_a_zip_of_a_damaged_session_does_not_open(two: list[Recording]) -> None:
    path = two[1].folder / "frames.parquet"
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)
    with pytest.raises(zipfile.BadZipFile):
        zipfile.ZipFile(io.BytesIO(read_until_cut(two[0].running, two[0].id, two[1].id)))


def test_a_zip_of_a_session_deleted_meanwhile_does_not_open(
    two: list[Recording], monkeypatch: pytest.MonkeyPatch
) -> None:
    running = two[0].running
    put = service.api.routes.downloads.zips._put

    def delete_and_put(*arguments: Any) -> Any:
        if arguments[2].parent.name == two[1].id:
            with running.client() as http:
                assert http.delete(two[1].url).status_code == 204
        return put(*arguments)

    monkeypatch.setattr(service.api.routes.downloads.zips, "_put", delete_and_put)
    content = read_until_cut(running, two[0].id, two[1].id)
    assert len(content) > 1000  # the first one had gone out
    with pytest.raises(zipfile.BadZipFile):
        zipfile.ZipFile(io.BytesIO(content))


def test_memory_does_not_grow_with_the_files(tmp_path: Path) -> None:
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
