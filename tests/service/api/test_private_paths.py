"""Who may read what a server shows need not know where on its machine the files are."""

from __future__ import annotations

from pathlib import Path

import httpx
import pytest

from devices.errors import FootTileError
from service.protocol import format_close_reason
from service.user_folders import register_private_folder, strip_private_folders
from tests.service.fake_node import FakeNode
from tests.service.recording import Recording
from tests.service.running import Running
from tests.waiting import PATIENCE_S


@pytest.fixture
def damaged(running: Running, tared: FakeNode) -> Recording:
    """A sealed session of which every file is damaged, as is all that is known of its node."""
    session = tared.record()
    tared.deliver(100, [20.0, 60.0])
    tared.finish(session)
    running.stop()
    folders = [session.folder, running.data / "nodes" / "bench"]
    for path in (path for folder in folders for path in folder.rglob("*") if path.is_file()):
        if path.name != "session.json":
            content = bytearray(path.read_bytes())
            content[len(content) // 2] ^= 0xFF
            path.write_bytes(content)
    other = session.folder.with_name("20200101T000000Z-00000a")
    other.mkdir()
    (other / "session.json").write_text("{")
    running.start()
    return session


def test_no_answer_names_the_data_folder(
    running: Running, damaged: Recording, caplog: pytest.LogCaptureFixture
) -> None:
    routes = running.http.get("/openapi.json").json()["paths"]
    failed = 0
    for route, operations in routes.items():
        if "get" not in operations:
            continue
        path = route.removeprefix("/api/v1").format(
            session_id=damaged.id,
            node="bench",
            name="bench",
            comparison="x",
            calibration_id="x",
            job_id="x",
            take_id="x",
            marker_id="x",
        )
        for query in ("", "?format=csv", "?ids=" + damaged.id):
            try:
                answer = running.http.get(path + query)
            except httpx.RemoteProtocolError:  # a zip file that breaks off at what is damaged
                continue
            if "parquet" in answer.headers.get("content-type", ""):
                continue
            failed += answer.status_code >= 400
            assert str(running.data) not in answer.text, (path, query)
    assert failed > 10
    assert f"{damaged.id}/frames.parquet" in running.http.get(f"{damaged.url}/data?format=csv").text
    listed = running.http.get("/sessions").json()["unreadable"]
    assert "sessions/20200101T000000Z-00000a/session.json" in str(listed)
    with running.socket("/api/v1/live") as live:
        assert str(running.data) not in live.recv(timeout=PATIENCE_S)
    assert str(running.data) in caplog.text  # who reads the log has to find the file


def test_only_the_folder_goes_and_a_reason_that_is_cut_has_no_part_of_it(tmp_path: Path) -> None:
    folder = tmp_path / ("long" * 40) / "data"
    folder.mkdir(parents=True)
    register_private_folder(folder)
    error = FootTileError("cannot be read", where=str(folder / "sessions" / "x.parquet"))
    assert strip_private_folders(str(error)) == "sessions/x.parquet: cannot be read"
    assert format_close_reason(str(error)) == "sessions/x.parquet: cannot be read"
    assert strip_private_folders(f"{folder}: gone") == "the data folder: gone"
    assert str(folder) in str(error)
    assert strip_private_folders("nothing of it") == "nothing of it"
