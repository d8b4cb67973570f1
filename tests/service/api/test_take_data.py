"""All sessions of a take as one file: over REST, by the clients, and from the command line."""

from __future__ import annotations

import asyncio
from pathlib import Path

import pytest

import foottile
from service.pull import pull_take_export
from storage.formats.slice import Slice
from storage.formats.writers.registry import FORMATS, MULTI_SESSION_FORMATS, get_format
from tests.service.fake_node import NodeOf
from tests.service.running import Running, assert_refused
from tests.service.takes import Take, frames_of_long_ago
from tests.storage.formats.writers.readers import said_in

NOBODY = "0123456789ab"


@pytest.fixture(autouse=True)
def _frames_of_long_ago(monkeypatch: pytest.MonkeyPatch) -> None:
    frames_of_long_ago(monkeypatch)


@pytest.fixture
def take(running: Running, node_of: NodeOf) -> Take:
    return Take(running, [node_of(running, name) for name in ("right", "left")]).sealed()


def test_every_format_that_can_hold_several_sessions_has_all_sessions_in_the_order_of_their_nodes(
    take: Take,
) -> None:
    take.running.http.post(f"{take.sessions[0].url}/markers", json={"label": "tap"})
    listed = {
        each["name"]
        for each in take.running.http.get("/formats").json()["items"]
        if each["can_hold_several_sessions"]
    }
    assert listed == set(MULTI_SESSION_FORMATS)
    for to in MULTI_SESSION_FORMATS:
        answer = take.get(to)
        assert answer.status_code == 200, answer.text
        said = said_in(to, answer.content)
        assert [each["node"] for each in said] == ["left", "right"]
        assert all(each["complete"].lower() in ("true", "complete") for each in said)
        assert answer.headers["foottile-complete"] == "true"
        assert (
            answer.headers["foottile-markers"] == "placed=0, left-out=1"
        )  # it was not so long ago
        name = f"both_take-{take.id}{FORMATS[to].ending}"
        assert answer.headers["content-disposition"] == f'attachment; filename="{name}"'


def test_it_is_the_same_until_somebody_marks_something(take: Take) -> None:
    first = take.get("xdf")
    tag = {"If-None-Match": first.headers["etag"]}
    asked = {"format": "xdf"}
    http = take.running.http
    assert http.get(take.url, params=asked, headers=tag).status_code == 304
    head = http.head(take.url, params=asked)
    assert (head.status_code, head.content) == (200, b"")
    assert head.headers["etag"] == first.headers["etag"]
    http.post(f"{take.sessions[1].url}/markers", json={"label": "tap"})
    assert http.get(take.url, params=asked, headers=tag).status_code == 200
    other = http.get(take.url, params={**asked, "end_s": 0.1}, headers=tag)
    assert len(other.content) < len(first.content)


def test_what_cannot_be_one_file_is_refused_with_the_session_and_what_to_do(
    running: Running, node_of: NodeOf
) -> None:
    feet = [node_of(running, "left"), node_of(running, "raw", calibration=None)]
    both = Take(running, feet)
    answer = both.get("mcap")
    assert_refused(answer, 409, "session", "is recording", "Stop it")
    both.sealed()
    for to in set(FORMATS) - set(MULTI_SESSION_FORMATS):
        assert_refused(both.get(to), 422, f"{to} holds one session only", *MULTI_SESSION_FORMATS)
    for to in MULTI_SESSION_FORMATS:
        answer = both.get(to)
        if FORMATS[to].needs_forces:
            assert_refused(answer, 422, "of raw", "this session has none")
        else:
            assert [each["node"] for each in said_in(to, answer.content)] == ["left", "raw"]
    assert_refused(both.get("mcap", start_s=50), 422, "of left", "starts at 50 s")
    assert_refused(both.get("opensim", body="foot"), 422, "this session has none")
    assert_refused(running.http.get(f"/takes/{NOBODY}/data?format=mcap"), 404, "no take")
    assert running.http.get(both.url).status_code == 422  # it has to be said which format


def test_both_clients_download_it_whole_or_not_at_all(take: Take, tmp_path: Path) -> None:
    out = tmp_path / "out"
    with foottile.connect(take.running.url) as server:
        pulled = pull_take_export(server, take.id, out, Slice(0.0, 0.1), get_format("mcap"))
        path = Path(pulled["path"])
        assert path.name == f"take-{take.id}_0s-0.1s.mcap"
        assert len(said_in("mcap", path.read_bytes())) == 2
        with pytest.raises(foottile.UsageError, match="csv holds one session only"):
            pull_take_export(server, take.id, out, Slice(), get_format("csv"))
    assert [*out.iterdir()] == [path]

    with foottile.connect(take.running.url) as server:
        session = server.session(take.sessions[0].id)
        assert session.take == take.id
        mat = server.download_take(take.id, tmp_path / "take.mat", format="mat")
        assert [each["node"] for each in said_in("mat", mat.read_bytes())] == ["left", "right"]
        with pytest.raises(foottile.UsageError, match="holds one session only"):
            server.download_take(take.id, tmp_path / "take.csv", format="csv")

    async def asked() -> Path:
        async with foottile.connect_async(take.running.url) as server:
            found: Path = await server.download_take(take.id, tmp_path / "t.xdf", format="xdf")
            return found

    assert len(said_in("xdf", asyncio.run(asked()).read_bytes())) == 2
    assert not [*tmp_path.glob(".*")]
