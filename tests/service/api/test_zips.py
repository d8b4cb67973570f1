"""Several sessions as one zip file: the files themselves, or nothing that opens."""

from __future__ import annotations

import io
import threading
import tracemalloc
import zipfile
from pathlib import Path
from typing import Any

import httpx
import pytest

import storage.formats.zipped
from storage.file_hash import sha256_of
from storage.formats.zipped import Sealed, zipped
from storage.verify.session import verify_session
from tests.service.fake_node import FakeNode
from tests.service.recording import Recording
from tests.service.running import Running, assert_refused

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
    assert_refused(asked(running, two[0].id), 404, "taken away")


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
    real, begun, deleted = storage.formats.zipped._put, threading.Event(), threading.Event()

    def slow(*args: Any) -> Any:
        if args[2].parent.name == two[1].id:
            begun.set()
            assert deleted.wait(30)
        return real(*args)

    monkeypatch.setattr(storage.formats.zipped, "_put", slow)

    def delete() -> None:
        assert begun.wait(30)
        with httpx.Client(base_url=running.http.base_url, trust_env=False) as http:
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
    sha256 = sha256_of(folder / "frames.parquet")
    tracemalloc.start()
    try:
        sent = sum(len(piece) for piece in zipped([Sealed(folder, sha256)]))
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert sent > 40 << 20
    assert peak < 8 << 20
