"""Takes: one session of each node under one name; several sessions in one file or one zip."""

from __future__ import annotations

import asyncio
import errno
import io
import json
import os
import tracemalloc
import zipfile
from email.utils import parsedate_to_datetime
from pathlib import Path
from typing import Any

import httpx
import pytest

import foottile
import service.api.routes.downloads
from devices.errors import StorageError
from service.api.routes.common import file_response
from service.api.routes.downloads import ZippedSession, stream_zip
from service.pull import pull_take_export
from service.sessions.sealing import rebuild_damaged_session_json
from storage.formats.slice import Slice
from storage.formats.writers.registry import FORMATS, MULTI_SESSION_FORMATS, get_format
from storage.parquet_hash import compute_sha256
from storage.sessions.folder import SessionsFolder
from storage.verify.session import verify_session
from tests.service.fake_node import FakeNode, NodeOf
from tests.service.recording import Recording
from tests.service.running import Running, assert_refused
from tests.service.takes import Take
from tests.storage.faulty_disk import failing_if, flip_bits, refusing
from tests.storage.formats.writers.readers import said_in


@pytest.fixture
def feet(running: Running, node_of: NodeOf) -> dict[str, FakeNode]:
    """Three tared nodes."""
    found = {name: node_of(running, name) for name in ("left", "right", "spare")}
    for node in found.values():
        node.connect()
        node.tared()
        node.acknowledged(69)
    return found


def begin_take(running: Running, **body: object) -> dict[str, Any]:
    answer = running.http.post("/takes", json={"name": "both"} | body)
    assert answer.status_code == 201, answer.text
    take: dict[str, Any] = answer.json()
    assert answer.headers["location"] == f"/api/v1/takes/{take['id']}"
    return take


def post(running: Running, take: dict[str, Any], action: str, **body: object) -> dict[str, Any]:
    answer = running.http.post(f"/takes/{take['id']}/{action}", json=body or None)
    assert answer.is_success, answer.text
    changed: dict[str, Any] = answer.json()
    return changed


def nodes_of(take: dict[str, Any]) -> list[str]:
    return [session["node"] for session in take["sessions"]]


def test_a_take_is_a_session_of_each_connected_node(
    running: Running, feet: dict[str, FakeNode]
) -> None:
    feet["spare"].leave()
    common = {"name": "both", "notes": "wet", "subject": "A", "tags": ["mud"]}
    take = begin_take(running, **common)
    assert (nodes_of(take), take["failed"]) == (["left", "right"], {})
    for session in take["sessions"]:
        facts = common | {"take": take["id"], "state": "recording"}
        assert {name: session[name] for name in facts} == facts
    for name in ("left", "right"):
        feet[name].deliver(50, [5.0, 10.0])
    assert nodes_of(post(running, take, "stop")) == ["left", "right"]
    for name in ("left", "right"):
        feet[name].send(30, now=True)
    for session in take["sessions"]:
        recording = running.session(session["id"])
        sealed = recording.sealed()
        assert (sealed["frames"], sealed["take"]) == (50, take["id"])
        path = recording.folder / "session.json"
        assert json.loads(path.read_text())["take"] == take["id"]
    path.unlink()
    rebuilt = rebuild_damaged_session_json(SessionsFolder(recording.folder.parent), recording.id)
    assert rebuilt is not None
    assert rebuilt.take == take["id"]


def test_a_node_that_cannot_be_recorded_has_a_reason_and_the_others_are_recorded(
    running: Running, feet: dict[str, FakeNode], monkeypatch: pytest.MonkeyPatch
) -> None:
    feet["right"].leave()
    take = begin_take(running, nodes=["left", "right", "nobody", "left"])
    assert nodes_of(take) == ["left"]
    assert sorted(take["failed"]) == ["nobody", "right"]
    assert "'right' sends no frames" in take["failed"]["right"]
    assert "no node 'nobody'" in take["failed"]["nobody"]
    feet["right"].connect()
    feet["right"].deliver(10)
    full = (running.server.sessions.save, StorageError, "the disk is full")
    save = failing_if(lambda session: session.node == "right", *full)
    monkeypatch.setattr(running.server.sessions, "save", save)
    take = begin_take(running, nodes=["left", "right", "spare"])
    assert nodes_of(take) == ["left", "spare"]
    assert "full" in take["failed"]["right"]
    assert running.node("right")["recording"] == []


def test_a_take_without_any_recording_is_refused(
    running: Running, feet: dict[str, FakeNode]
) -> None:
    answer = running.http.post("/takes", json={"name": "x", "nodes": ["nobody", "noone"]})
    assert_refused(answer, 409, "'nobody'", "'noone'")
    for node in feet.values():
        node.leave()
    assert_refused(running.http.post("/takes", json={"name": "x"}), 409, "no node is connected")
    assert running.sessions() == []


def test_a_marker_of_a_take_is_in_each_session_at_one_instant_once(
    running: Running, feet: dict[str, FakeNode]
) -> None:
    take = begin_take(running)
    sessions = [running.session(each["id"]) for each in take["sessions"]]
    marker = {"label": "a stone", "t_ns": 10**18, "id": "0123456789ab"}
    for _ in range(2):  # the first answer was lost
        assert nodes_of(post(running, take, "markers", **marker)) == ["left", "right", "spare"]
    for session in sessions:
        (found,) = running.http.get(f"{session.url}/markers").json()["items"]
        assert {name: found[name] for name in marker} == marker
    post(running, take, "markers", label="now")
    instants = {
        running.http.get(f"{session.url}/markers").json()["items"][-1]["t_ns"]
        for session in sessions
    }
    assert len(instants) == 1


def test_a_node_away_is_marked_and_stopped_with_its_take(
    running: Running, feet: dict[str, FakeNode]
) -> None:
    take = begin_take(running, nodes=["left", "right"])
    feet["left"].deliver(50)
    feet["right"].deliver(50)
    feet["right"].leave()
    assert nodes_of(post(running, take, "markers", label="gone")) == ["left", "right"]
    stopped = post(running, take, "stop")
    assert stopped["failed"] == {}
    assert [session["state"] for session in stopped["sessions"]] == ["pending", "pending"]
    feet["left"].send(30, now=True)
    left, right = (running.session(session["id"]) for session in take["sessions"])
    assert left.sealed()["complete"] is True
    assert right.now()["state"] == "pending"
    feet["right"].come_back()
    feet["right"].send(30, now=True)
    assert right.sealed()["complete"] is True


def test_a_session_stopped_alone_gets_no_marker_and_keeps_its_stop(
    running: Running, feet: dict[str, FakeNode]
) -> None:
    take = begin_take(running, nodes=["left", "right"])
    alone = running.session(take["sessions"][0]["id"]).stop()
    assert nodes_of(post(running, take, "markers", label="x")) == ["right"]
    stopped = post(running, take, "stop")
    assert nodes_of(stopped) == ["left", "right"]
    assert stopped["sessions"][0]["stopped_t_ns"] == alone["stopped_t_ns"]
    assert nodes_of(running.http.get(f"/takes/{take['id']}").json()) == ["left", "right"]
    answer = running.http.post(f"/takes/{take['id']}/markers", json={"label": "late"})
    assert_refused(answer, 409, "stopped already")


def test_sessions_are_listed_by_take(running: Running, feet: dict[str, FakeNode]) -> None:
    def list_ids(**query: Any) -> list[str]:
        items = running.http.get("/sessions", params=query).json()["items"]
        return sorted(item["id"] for item in items)

    first, second = begin_take(running, nodes=["left", "right"]), begin_take(running)
    assert feet["spare"].record().now()["take"] is None
    for take in (first, second):
        assert list_ids(take=take["id"]) == sorted(s["id"] for s in take["sessions"])
    page = running.http.get("/sessions", params={"take": first["id"], "limit": 1}).json()
    assert len(list_ids(take=first["id"], limit=1, cursor=page["next_cursor"])) == 1
    assert list_ids(take="x") == []


@pytest.mark.parametrize(
    "body",
    [
        *({}, {"name": ""}, {"name": "x", "nodes": []}, {"name": "x", "nodes": "left"}),
        *({"name": "x", "node": "left"}, {"name": "x", "nodes": [1]}),
        {"name": "x", "pre_roll_s": -1},
    ],
    ids=str,
)
def test_a_wrong_take_is_refused(shared: Running, body: dict[str, object]) -> None:
    assert shared.http.post("/takes", json=body).status_code == 422


# --- all sessions in one file ---------------------------------------------------------------------


@pytest.fixture
def take(running: Running, node_of: NodeOf) -> Take:
    return Take(running, [node_of(running, name) for name in ("right", "left")]).sealed()


def test_a_file_of_a_take_has_all_sessions_until_a_marker_changes_it(take: Take) -> None:
    http = take.running.http
    http.post(f"{take.sessions[0].url}/markers", json={"label": "tap"})
    formats = http.get("/formats").json()["items"]
    assert {each["name"] for each in formats if each["can_hold_several_sessions"]} == set(
        MULTI_SESSION_FORMATS
    )
    for to in MULTI_SESSION_FORMATS:
        answer = take.get(to)
        assert answer.status_code == 200, answer.text
        assert [each["node"] for each in said_in(to, answer.content)] == ["left", "right"]
        assert answer.headers["foottile-complete"] == "true"
        # The marker is of now, and the frames are of long ago.
        assert answer.headers["foottile-markers"] == "placed=0, left-out=1"
        name = f"both_take-{take.id}{FORMATS[to].ending}"
        assert answer.headers["content-disposition"] == f'attachment; filename="{name}"'
    first, query = take.get("xdf"), {"format": "xdf"}
    tag = {"If-None-Match": first.headers["etag"]}
    assert http.get(take.url, params=query, headers=tag).status_code == 304
    head = http.head(take.url, params=query)
    assert (head.status_code, head.content) == (200, b"")
    assert head.headers["etag"] == first.headers["etag"]
    http.post(f"{take.sessions[1].url}/markers", json={"label": "tap"})
    assert http.get(take.url, params=query, headers=tag).status_code == 200
    part = http.get(take.url, params=query | {"end_s": "0.1"}, headers=tag)
    assert len(part.content) < len(first.content)


def test_a_take_that_cannot_be_one_file_is_refused_with_its_session(
    running: Running, node_of: NodeOf
) -> None:
    take = Take(running, [node_of(running, "left"), node_of(running, "raw", calibration=None)])
    assert_refused(take.get("mcap"), 409, "session", "is recording", "Stop it")
    take.sealed()
    for to in set(FORMATS) - set(MULTI_SESSION_FORMATS):
        assert_refused(take.get(to), 422, f"{to} holds one session only", *MULTI_SESSION_FORMATS)
    for to in MULTI_SESSION_FORMATS:
        answer = take.get(to)
        if FORMATS[to].needs_forces:
            assert_refused(answer, 422, "of raw", "this session has none")
        else:
            assert [each["node"] for each in said_in(to, answer.content)] == ["left", "raw"]
    assert_refused(take.get("mcap", start_s=50), 422, "of left", "starts at 50 s")
    assert_refused(take.get("opensim", body="foot"), 422, "this session has none")
    assert running.http.get(take.url).status_code == 422  # without a format


def test_clients_download_a_take_whole_or_not_at_all(take: Take, tmp_path: Path) -> None:
    out = tmp_path / "out"
    with foottile.connect(take.running.url) as server:
        pulled = pull_take_export(server, take.id, out, Slice(0.0, 0.1), get_format("mcap"))
        path = Path(pulled["path"])
        assert path.name == f"take-{take.id}_0s-0.1s.mcap"
        assert len(said_in("mcap", path.read_bytes())) == 2
        with pytest.raises(foottile.InvalidRequestError, match="csv holds one session only"):
            pull_take_export(server, take.id, out, Slice(), get_format("csv"))
        assert [*out.iterdir()] == [path]
        assert server.session(take.sessions[0].id).take == take.id
        mat = server.download_take(take.id, tmp_path / "take.mat", format="mat")
        assert [each["node"] for each in said_in("mat", mat.read_bytes())] == ["left", "right"]
        with pytest.raises(foottile.InvalidRequestError, match="holds one session only"):
            server.download_take(take.id, tmp_path / "take.csv", format="csv")

    async def download() -> bytes:
        async with foottile.connect_async(take.running.url) as server:
            path: Path = await server.download_take(take.id, tmp_path / "t.xdf", format="xdf")
            return path.read_bytes()

    assert len(said_in("xdf", asyncio.run(download()))) == 2
    assert not [*tmp_path.glob(".*")]


# --- several sessions in one zip file -------------------------------------------------------------


ZIPPED_FILES = {"frames.parquet", "session.json"}


@pytest.fixture
def two_sealed(tared: FakeNode) -> list[Recording]:
    sessions = []
    for force_n in (20.0, 60.0):
        session = tared.record(name=f"at {force_n} N")
        tared.deliver(300, [force_n, force_n])
        tared.finish(session)
        sessions.append(session)
    return sessions


def get_zip(running: Running, *ids: str) -> httpx.Response:
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
    for name in ZIPPED_FILES:
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
            assert entry.filename.split("/")[1] in ZIPPED_FILES
            years = entry.date_time[0]
            assert 1980 <= years <= 2107
            assert (years < 2000) == (dated_s < 946_684_800)


def test_a_failure_before_the_first_byte_is_an_error(
    two_sealed: list[Recording], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(zipfile.ZipFile, "open", refusing(OSError, errno.EIO, "Input/output error"))
    answer = get_zip(two_sealed[0].running, two_sealed[0].id)
    assert_refused(answer, 507, "Input/output error")


def test_a_zip_has_the_files_of_its_sessions(two_sealed: list[Recording], tmp_path: Path) -> None:
    answer = get_zip(
        two_sealed[0].running, *(session.id for session in two_sealed), two_sealed[0].id
    )
    assert answer.status_code == 200
    assert answer.headers["content-type"] == "application/zip"
    assert 'filename="foottile-2-sessions.zip"' in answer.headers["content-disposition"]
    with zipfile.ZipFile(io.BytesIO(answer.content)) as file:
        assert file.testzip() is None
        names = file.namelist()
        assert len(names) == len(set(names))
        for session in two_sealed:
            files = {name.split("/")[1] for name in names if name.startswith(f"{session.id}/")}
            assert files >= ZIPPED_FILES
            for name in files:
                entry = f"{session.id}/{name}"
                assert file.read(entry) == (session.folder / name).read_bytes(), entry
                assert file.getinfo(entry).compress_type == zipfile.ZIP_STORED
        file.extractall(tmp_path)
    for session in two_sealed:
        assert verify_session(tmp_path / session.id).problems == []


def test_a_session_without_a_whole_file_is_refused(
    two_sealed: list[Recording], tared: FakeNode
) -> None:
    running = two_sealed[0].running
    recording = tared.record()
    assert_refused(get_zip(running, two_sealed[0].id, recording.id), 409, recording.id, "recording")
    assert_refused(get_zip(running, "20200101T000000Z-000000"), 404, "20200101T000000Z-000000")
    assert_refused(get_zip(running, "../trash"), 404)
    assert_refused(get_zip(running, " , "), 422, "0 sessions")
    assert_refused(get_zip(running, *(f"a{i}" for i in range(1001))), 422, "1001 sessions")
    assert running.http.get("/sessions/zip").status_code == 422
    running.http.delete(two_sealed[1].url)
    assert_refused(
        get_zip(running, two_sealed[0].id, two_sealed[1].id), 404, two_sealed[1].id, "trash"
    )
    (two_sealed[0].folder / "frames.parquet").unlink()
    assert_refused(get_zip(running, two_sealed[0].id), 404, "is missing")


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


def test_a_zip_of_a_damaged_session_does_not_open(two_sealed: list[Recording]) -> None:
    flip_bits(two_sealed[1].folder / "frames.parquet")
    with pytest.raises(zipfile.BadZipFile):
        zipfile.ZipFile(
            io.BytesIO(read_until_cut(two_sealed[0].running, two_sealed[0].id, two_sealed[1].id))
        )


def test_a_zip_of_a_session_deleted_meanwhile_does_not_open(
    two_sealed: list[Recording], monkeypatch: pytest.MonkeyPatch
) -> None:
    running = two_sealed[0].running
    put = service.api.routes.downloads._put

    def delete_and_put(*arguments: Any) -> Any:
        if arguments[2].parent.name == two_sealed[1].id:
            with running.client() as http:
                assert http.delete(two_sealed[1].url).status_code == 204
        return put(*arguments)

    monkeypatch.setattr(service.api.routes.downloads, "_put", delete_and_put)
    content = read_until_cut(running, two_sealed[0].id, two_sealed[1].id)
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
