"""`import foottile`: sessions, markers, recording and tares from a program."""

from __future__ import annotations

import asyncio
import json
import subprocess
import sys
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path

import httpx
import numpy as np
import pyarrow.parquet as pq
import pytest

import foottile
import foottile.sessions
from tests.service.fake_node import FakeNode
from tests.service.running import Running, ServeWith
from tests.waiting import until

TOKEN = "open sesame".replace(" ", "-")
HEAVY = ("httpx", "pyarrow", "numpy", "websockets", "service", "storage", "devices", "asyncio")


@pytest.fixture
def server(running: Running) -> Iterator[foottile.Client]:
    with foottile.connect(running.url) as server:
        yield server


def recorded(
    server: foottile.Client, tared: FakeNode, name: str = "trial"
) -> foottile.RemoteSession:
    with server.record("bench", name, tags=["mud"]) as session:
        tared.deliver(300, [20.0, 60.0], alive=True)
        session.add_marker("a stone")
        tared.send(10, now=True)
        session.stop()
        tared.send(10, now=True)
        return session.wait_until_sealed()


def test_to_import_it_imports_nothing_heavy() -> None:
    code = f"import sys, foottile; print([n for n in {HEAVY} if n in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_all_that_it_names_is_there() -> None:
    assert all(getattr(foottile, name) is not None for name in foottile.__all__)
    with pytest.raises(AttributeError, match="colour"):
        _ = foottile.colour


def test_a_session_is_recorded_marked_found_and_read(
    server: foottile.Client, tared: FakeNode, tmp_path: Path
) -> None:
    session = recorded(server, tared)
    assert (session.state, session.complete, session.node) == ("sealed", True, "bench")
    assert (session.not_sampled_frames, session.not_sampled_share) == (0, 0.0)
    assert [marker.label for marker in session.markers()] == ["a stone"]
    now = datetime.now(UTC)
    found = list(
        server.sessions("trial", node=["left", "bench"], tag="mud", since=now - timedelta(1))
    )
    assert [each.id for each in found] == [session.id]
    assert not list(server.sessions(since=now + timedelta(1)))
    data = session.open(["t_ns", "grf_n", "force_n"])
    table = data.to_arrow()
    assert table.column_names[:2] == ["t_ns", "grf_n"]
    assert len(table) == session.frame_count
    assert data["force_n"].shape == (session.frame_count, 2)
    assert np.nanmedian(data["grf_n"]) == pytest.approx(80.0, abs=1.0)
    part = data[0.5:0.7]
    assert isinstance(part, foottile.SessionData)
    t_ns = part["t_ns"]
    assert 0 < len(t_ns) < session.frame_count
    assert 0.5e9 <= t_ns[0] - data["t_ns"][0] < 0.6e9
    assert part.to_numpy().keys() == {"t_ns", "grf_n", "force_n_0", "force_n_1"}
    assert (
        sum(batch.num_rows for batch in session.open("seq").iter_batches()) == session.frame_count
    )
    path = session.download(tmp_path / "trial.parquet")
    assert path.stat().st_size == session.metadata["bytes"]
    assert [*tmp_path.glob("*trial*")] == [path]


def test_frames_are_read_however_small_the_pieces_are_that_they_come_in(
    server: foottile.Client, tared: FakeNode, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    session = recorded(server, tared)
    whole = pq.read_table(session.download(tmp_path / "trial.parquet"))
    monkeypatch.setattr(foottile.sessions, "_CHUNK_BYTES", 100)
    table = session.open(whole.column_names).to_arrow()
    assert table.num_rows == session.frame_count
    assert table["seq"].equals(whole["seq"])


def test_an_answer_that_breaks_off_is_said_to_be_damaged(
    server: foottile.Client, tared: FakeNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    session = recorded(server, tared)
    given = httpx.Response.iter_bytes

    def short(answer: httpx.Response, size: int | None = None) -> Iterator[bytes]:
        yield b"".join(given(answer, size))[:-500]

    monkeypatch.setattr(httpx.Response, "iter_bytes", short)
    with pytest.raises(foottile.DamagedError, match="arrived incomplete or damaged"):
        session.open("seq").to_arrow()


def test_what_has_no_method_is_asked_for_by_its_path(
    server: foottile.Client, tared: FakeNode
) -> None:
    assert server.http.get("/calibrations", {"limit": None})["items"] == []


def test_what_somebody_else_has_changed_is_not_overwritten(
    server: foottile.Client, running: Running, tared: FakeNode
) -> None:
    with server.record("bench", "one") as mine:
        theirs = server.session(mine.id)
        theirs.update(notes="wet")
        with pytest.raises(foottile.ConflictError) as raised:
            mine.update(name="two")
        assert raised.value.status == 412
        assert mine.refresh().update(name="two").metadata["notes"] == "wet"


def test_an_error_carries_what_the_server_said(server: foottile.Client, tared: FakeNode) -> None:
    with pytest.raises(foottile.NotFoundError, match="no node 'nobody'") as raised:
        server.node("nobody")
    assert raised.value.status == 404
    assert raised.value.problem["title"]
    with pytest.raises(foottile.NotFoundError):
        server.session("../nodes")
    session = server.record("bench", "x")
    tared.deliver(20)
    with pytest.raises(foottile.InvalidRequestError, match="no column 'colour'"):
        session.open(["colour"]).to_arrow()
    with pytest.raises(foottile.InvalidRequestError, match="no step"):
        _ = session.open()[0:1:2]
    with pytest.raises(foottile.ConflictError, match="still recording"):
        session.wait_until_sealed(timeout_s=0.0)
    tared.send(60, 20.0)
    with pytest.raises(foottile.ConflictError, match=r"loaded|moves|unloaded"):
        server.tare("bench")


def test_a_token_is_shown_and_its_lack_is_told(
    serve_with: ServeWith, monkeypatch: pytest.MonkeyPatch
) -> None:
    running = serve_with(token=TOKEN, is_private=True)
    monkeypatch.delenv("FOOTTILE_TOKEN", raising=False)
    with (
        foottile.connect(running.url) as server,
        pytest.raises(foottile.AccessDeniedError, match="token"),
    ):
        server.nodes()
    with (
        foottile.connect(running.url) as server,
        pytest.raises(foottile.AccessDeniedError, match="token"),
    ):
        next(server.live())
    monkeypatch.setenv("FOOTTILE_TOKEN", TOKEN)
    with foottile.connect(running.url) as server:
        assert server.nodes() == []


@pytest.mark.parametrize(
    "url", ["", "laptop", "ftp://laptop", "http://", "http://[::1", "http://a b"]
)
def test_what_is_no_address_is_said(url: str) -> None:
    with pytest.raises((foottile.InvalidRequestError, foottile.ServerUnavailableError)):
        foottile.connect(url).nodes()


def test_what_was_closed_is_not_asked_any_more(running: Running) -> None:
    with foottile.connect(running.url) as server:
        pass
    with pytest.raises(foottile.InvalidRequestError, match="closed"):
        server.nodes()


def test_where_no_server_is_that_is_said(running: Running) -> None:
    running.stop()
    with foottile.connect(running.url) as server:
        with pytest.raises(foottile.ServerUnavailableError, match="foottile serve"):
            server.nodes()
        with pytest.raises(foottile.ServerUnavailableError):
            next(server.live("bench"))


def test_all_of_it_is_there_for_asyncio(running: Running, tared: FakeNode, tmp_path: Path) -> None:
    async def run() -> None:
        async with foottile.connect_async(running.url) as server:
            assert [node["node"] for node in await server.nodes()] == ["bench"]
            async with await server.record("bench", "async") as session:
                await asyncio.to_thread(tared.deliver, 100, [20.0, 60.0], alive=True)
                await session.add_marker("now")
                await session.stop()
                await asyncio.to_thread(tared.send, 10, now=True)
                await session.wait_until_sealed()
            assert [each.snapshot.id async for each in server.sessions("async")] == [
                session.snapshot.id
            ]
            table = await session.open(["grf_n"])[0.0:0.5].to_arrow()
            assert 0 < len(table) <= session.snapshot.frame_count
            assert [len(b) async for b in session.open("seq").iter_batches()]
            async with server.live("bench", ["grf_n"]) as live:
                first = asyncio.ensure_future(anext(live))
                while not first.done():
                    await asyncio.to_thread(tared.send, 10)
                    await asyncio.sleep(0.01)
                batch = await first
                assert batch.schema.names == ["seq", "t_ns", "grf_n", "recomputed"]
                assert live.position == (tared.stream_id, batch["seq"][-1].as_py() + 1)

    asyncio.run(run())


def test_a_complete_session_says_how_many_frames_its_node_did_not_sample(
    server: foottile.Client, tared: FakeNode
) -> None:
    with server.record("bench", "late") as session:
        tared.deliver(300, [20.0, 60.0], alive=True)
        tared.socket.send(json.dumps({"type": "status", "missed_slots": 500, "warnings": []}))
        until(lambda: server.session(session.id).not_sampled_frames == 500)
        session.stop()
        tared.send(10, now=True)
        session.wait_until_sealed()
    assert session.complete is True
    assert session.not_sampled_share == pytest.approx(500 / (500 + session.frame_count))
