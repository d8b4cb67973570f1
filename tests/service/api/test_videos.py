"""Videos of a session over REST: whole or not at all, whoever sends them; private as the rest."""

from __future__ import annotations

import hashlib
import socket
import struct
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest

from service.api.routes import common
from service.api.routes.recordings import videos as routes
from service.video import worker
from service.video.edit_list import read_edit_list
from storage.sessions import videos
from tests.service.api.sealed import Sealed
from tests.service.fake_node import FakeNode
from tests.service.recording import Recording
from tests.service.running import Running, ServeWith, assert_refused, content_of
from tests.service.video.short_film import (
    PICTURES,
    RATE_HZ,
    describe_short_film,
    short_film,
)
from tests.waiting import until
from tests.web.session_film import TRIMMED, make_film, write_edits

ID = "0123456789ab"


def padded_film(size_bytes: int) -> bytes:
    """A film with a box behind it that players skip."""
    return short_film() + struct.pack(">I4s", 8 + size_bytes, b"free") + bytes(size_bytes)


def upload(session: Recording, content: Any = None, **query: Any) -> httpx.Response:
    content = short_film() if content is None else content
    query = {"name": "walk.mp4"} | query
    return session.running.http.post(f"{session.url}/videos", params=query, content=content)


def record_sealed(running: Running) -> Recording:
    """Seal a session of a server of the test's own."""
    node = FakeNode(running)
    node.connect()
    node.tared()
    session = node.record_sealed(20)
    node.close()
    return session


def contents(session: Recording) -> dict[str, str]:
    """Names and hashes of all files, and empty ones of folders."""
    return {
        str(path.relative_to(session.folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        if path.is_file()
        else ""
        for path in session.folder.rglob("*")
    }


@pytest.fixture
def session(sealed: Sealed) -> Iterator[Recording]:
    """A sealed session without a video; the test leaves it so."""
    before = contents(sealed.session)
    yield sealed.session
    for video in list_all(sealed.session):
        sealed.running.http.delete(f"{sealed.session.url}/videos/{video['id']}")
    assert contents(sealed.session) == before


@pytest.fixture
def decoded(monkeypatch: pytest.MonkeyPatch) -> None:
    """Have every film be the short one, decoded once: to start a decoder takes a quarter second."""
    monkeypatch.setattr(routes, "describe_film", describe_short_film)


def list_all(session: Recording) -> list[dict[str, Any]]:
    found = content_of(session.running.http.get(f"{session.url}/videos"))
    assert found["problems"] == []
    items: list[dict[str, Any]] = found["items"]
    return items


def test_a_film_is_kept_and_given_back_unchanged(session: Recording) -> None:
    http, film = session.running.http, short_film()
    answer = upload(session)
    video = content_of(answer, 201)
    url = f"{session.url}/videos/{video['id']}"
    assert answer.headers["location"] == f"/api/v1{url}"
    assert (video["name"], video["size_bytes"], video["alignment"]) == ("walk.mp4", len(film), None)
    assert (video["film"]["hidden_count"], video["film"]["patch"]) == (0, None)
    assert http.get(f"{url}/film", params={"whole": True}).content == film
    assert video["film"]["picture_count"] == PICTURES
    assert list_all(session) == [video]
    assert content_of(http.get(url)) == video
    got = http.get(f"{url}/film")
    assert got.content == film
    assert got.headers["content-type"] == "video/mp4"
    assert got.headers["x-content-type-options"] == "nosniff"
    assert got.headers["content-disposition"] == 'attachment; filename="walk.mp4"'
    assert got.headers["etag"] == f'"{video["sha256"]}"'
    part = http.get(f"{url}/film", headers={"Range": "bytes=100-199"})
    assert (part.status_code, part.content) == (206, film[100:200])
    assert http.get(f"{url}/film", headers={"Range": f"bytes={1 << 40}-"}).status_code == 416
    same = http.get(f"{url}/film", headers={"If-None-Match": got.headers["etag"]})
    assert same.status_code == 304
    times = http.get(f"{url}/times")
    assert content_of(times)["film_s"] == pytest.approx([i / RATE_HZ for i in range(PICTURES)])
    same = http.get(f"{url}/times", headers={"If-None-Match": times.headers["etag"]})
    assert same.status_code == 304
    slowed = content_of(upload(session, capture_rate_hz=1000), 201)
    times_s = content_of(http.get(f"{session.url}/videos/{slowed['id']}/times"))["film_s"]
    assert times_s[-1] == pytest.approx((PICTURES - 1) / 1000)
    lapse = content_of(upload(session, capture_rate_hz=0.5), 201)
    assert lapse["film"]["duration_s"] == pytest.approx((PICTURES - 1) / 0.5)
    zipped = http.get("/sessions/zip", params={"ids": session.id}).content
    assert b"film.mp4" not in zipped
    assert http.delete(url).status_code == 204
    assert_refused(http.get(f"{url}/film"), 404, video["id"])
    assert_refused(http.delete(url), 404, video["id"])


def test_a_trimmed_film_is_given_back_whole_as_well(
    session: Recording, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    http, (edits, shown) = session.running.http, TRIMMED["middle"]
    path = write_edits(make_film(tmp_path / "film.mp4", "libx264"), edits)
    film, hidden = path.read_bytes(), read_edit_list(path)
    video = content_of(upload(session, film), 201)
    assert video["film"]["hidden_count"] == hidden.hidden_count == 35
    assert hidden.patch is not None
    assert video["film"]["patch"] == hidden.patch.model_dump()
    url = f"{session.url}/videos/{video['id']}"
    times = content_of(http.get(f"{url}/times"))
    assert times["whole_s"] == pytest.approx([number / 25.0 for number in shown])
    assert times["film_s"] == pytest.approx([number / 25.0 for number in range(len(shown))])

    at, new = hidden.patch.at, bytes.fromhex(hidden.patch.hex)
    patched = film[:at] + new + film[at + len(new) :]
    monkeypatch.setattr(common, "_CHUNK", 7)
    plain, whole = (http.get(f"{url}/film", params=query) for query in ({}, {"whole": True}))
    assert plain.content == film
    assert whole.content == patched != film
    assert "repr-digest" not in whole.headers
    assert whole.headers["etag"] != plain.headers["etag"]
    for begin, end in ((at - 9, at + 3), (at + 1, at + 5), (at + 4, at + 99), (0, 5), (at, at)):
        part = {"Range": f"bytes={begin}-{end}"}
        answer = http.get(f"{url}/film", params={"whole": True}, headers=part)
        assert (answer.status_code, answer.content) == (206, patched[begin : end + 1])
    same = {"If-None-Match": whole.headers["etag"]}
    assert http.get(f"{url}/film", params={"whole": True}, headers=same).status_code == 304
    assert http.get(f"{url}/film", headers=same).content == film


@pytest.mark.usefixtures("decoded")
def test_verification_names_a_changed_film(session: Recording) -> None:
    url = f"{session.url}/verification"
    before = content_of(session.running.http.get(url))
    video = content_of(upload(session), 201)
    assert content_of(session.running.http.get(url)) == before
    (session.folder / f"video-{video['id']}" / "film.mp4").write_bytes(b"other")
    (problem,) = content_of(session.running.http.get(url))["problems"]
    assert "walk.mp4 has 5 bytes" in problem


@pytest.mark.usefixtures("decoded")
@pytest.mark.parametrize(
    "name", ["../../x.mp4", 'a"; filename="b.html\r\nX: y.mp4', "\x1b]0;\u202egnp.mp4", "ü/ÿ.mp4"]
)
def test_a_hostile_name_is_a_name(session: Recording, name: str) -> None:
    video = content_of(upload(session, name=name), 201)
    assert video["name"].isprintable()
    got = session.running.http.get(f"{session.url}/videos/{video['id']}/film")
    assert got.content == short_film()
    assert got.headers["content-type"] == "video/mp4"
    assert got.headers["content-disposition"].startswith("attachment; filename")
    assert "x" not in got.headers


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("a.html", b"<script>", ("no film", ".mp4")),
        ("a.mp4", b"<script>alert(1)</script>" * 99, ("a.mp4", "cannot be read as a film")),
    ],
)
def test_what_is_no_film_is_refused_and_leaves_nothing(
    session: Recording, name: str, content: bytes, words: tuple[str, ...]
) -> None:
    before = contents(session)
    assert_refused(upload(session, content, name=name), 422, *words)
    assert contents(session) == before


def test_a_decoder_that_crashes_refuses_the_film_only(
    session: Recording, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = contents(session)
    monkeypatch.setattr(worker, "_CODE", "import os; os.kill(os.getpid(), 11)")
    assert_refused(upload(session), 422, "walk.mp4", "decoder ended with signal 11")
    monkeypatch.setattr(worker, "find_spec", lambda _: None)
    assert_refused(upload(session), 422, "needs av", "pip install 'foottile[video]'")
    assert contents(session) == before


def test_a_film_leaves_room_on_the_disk(
    session: Recording, monkeypatch: pytest.MonkeyPatch
) -> None:
    before, begun = contents(session), False

    def pieces() -> Iterator[bytes]:
        nonlocal begun
        yield bytes(5 << 20)
        until(lambda: any("video-" in name for name in contents(session)))
        begun = True
        monkeypatch.setattr(videos, "FREE_BYTES_MIN", 1 << 60)
        yield bytes(5 << 20)

    assert_refused(upload(session, pieces()), 507, "no space for the film")
    assert begun
    assert contents(session) == before
    assert_refused(upload(session), 507, "no space for the film")


def test_sessions_that_take_no_video(sealed: Sealed) -> None:
    assert_refused(upload(sealed.recording), 409, "recording", "Stop it")
    nowhere = Recording(sealed.running, {"id": "20200101T000000Z-000000"})
    assert_refused(upload(nowhere), 404, "no session")
    http = sealed.running.http
    for path in ("", "/film", "/times"):
        assert_refused(http.get(f"{sealed.session.url}/videos/{ID}{path}"), 404, ID, "it has none")
        assert http.get(f"{sealed.session.url}/videos/..%2f..%2fx{path}").status_code == 404
    connection = begin_upload(sealed.session, 65 << 30, b"")
    assert b"413" in connection.recv(4096)
    connection.close()


@pytest.mark.usefixtures("decoded")
def test_a_session_that_is_deleted_meanwhile(shared_tared: FakeNode) -> None:
    session = shared_tared.record_sealed(20)
    http = session.running.http

    def pieces() -> Iterator[bytes]:
        yield bytes(5 << 20)
        until(lambda: any("video-" in name for name in contents(session)))
        with session.running.client() as other:
            assert other.delete(session.url).status_code == 204
        yield bytes(5 << 20)

    assert_refused(upload(session, pieces()), 404, "deleted meanwhile")
    assert http.post(f"/trash/{session.id}/restore").status_code == 200
    assert list_all(session) == []
    video = content_of(upload(session), 201)
    assert http.delete(session.url).status_code == 204
    assert http.get(f"{session.url}/videos").status_code == 404
    assert http.post(f"/trash/{session.id}/restore").status_code == 200
    assert list_all(session) == [video]


@pytest.mark.usefixtures("decoded")
def test_an_alignment_by_hand(session: Recording) -> None:
    http, video = session.running.http, content_of(upload(session), 201)
    url, begin_t_ns = f"{session.url}/videos/{video['id']}", int(session.column("t_ns")[0])
    pairs = [
        {"film_s": at_s, "t_ns": begin_t_ns + 20_000_000 + round(at_s * 1e9), "sigma_ns": 1e6}
        for at_s in (0.0, 0.2)
    ]
    body = {"method": "hand", "pairs": pairs}
    aligned = content_of(http.put(f"{url}/alignment", json=body))
    found = aligned["alignment"]
    assert (found["method"], found["film_s"], found["pair_count"]) == (
        "hand",
        pytest.approx(0.1),
        2,
    )
    assert found["t_ns"] == pytest.approx(begin_t_ns + 120_000_000, abs=10)
    assert list_all(session) == [aligned]
    other = [pairs[0], pairs[1] | {"t_ns": begin_t_ns}]
    assert_refused(http.put(f"{url}/alignment", json=body | {"pairs": other}), 422, "no majority")
    later = [pair | {"t_ns": pair["t_ns"] + 3_600_000_000_000} for pair in pairs]
    refused = http.put(f"{url}/alignment", json=body | {"pairs": later})
    assert_refused(refused, 422, "after the session")
    wrongs: list[dict[str, Any]] = [{"pairs": []}, {"method": "light"}]
    for wrong in (*wrongs, {"pairs": [pairs[0] | {"sigma_ns": 0}]}):
        assert http.put(f"{url}/alignment", json=body | wrong).status_code == 422
    assert content_of(http.get(url)) == aligned
    contact = {"method": "contact", "pairs": [pair | {"t_ns": begin_t_ns} for pair in pairs[:1]]}
    refused = http.put(f"{url}/alignment", json=contact)
    assert_refused(refused, 409, "20.0 ms earlier by contact than by hand")
    replaced = http.put(f"{url}/alignment", params={"replace": True}, json=contact)
    assert content_of(replaced)["alignment"]["method"] == "contact"
    assert content_of(http.delete(f"{url}/alignment")) == video


@pytest.mark.usefixtures("decoded")
def test_a_stated_capture_rate_may_be_off_by_a_thousandth(session: Recording) -> None:
    video = content_of(upload(session, capture_rate_hz=1000), 201)
    begin_t_ns = int(session.column("t_ns")[0])
    pairs = [
        {"film_s": at_s, "t_ns": begin_t_ns + round(at_s * 1.001e9), "sigma_ns": 1e3}
        for at_s in (0.0, (PICTURES - 1) / 1000)
    ]
    url = f"{session.url}/videos/{video['id']}/alignment"
    body = {"method": "hand", "pairs": pairs}
    found = content_of(session.running.http.put(url, json=body))["alignment"]
    assert found["pair_count"] == 2
    assert 5e-5 < found["sigma_drift"] <= 1e-3


@pytest.mark.usefixtures("decoded")
def test_what_is_not_in_the_film_is_no_alignment(session: Recording) -> None:
    http, video = session.running.http, content_of(upload(session), 201)
    url = f"{session.url}/videos/{video['id']}/alignment"
    assert_refused(http.post(url, params={"method": "light"}), 422, "no lamp in this session")
    assert_refused(http.post(url, params={"method": "clock"}), 422, "shows the clock page")
    assert http.post(url, params={"method": "hand"}).status_code == 422
    assert http.post(url, params={"method": "light", "near_s": "nan"}).status_code == 422
    missing = f"{session.url}/videos/{'0' * 12}/alignment"
    assert http.post(missing, params={"method": "light"}).status_code == 404
    assert list_all(session) == [video]


@pytest.mark.usefixtures("decoded")
def test_access_is_that_of_the_session(serve_with: ServeWith) -> None:
    running = serve_with(is_private=True)
    session = record_sealed(running)
    video = content_of(upload(session), 201)
    with httpx.Client(base_url=running.url + "/api/v1", trust_env=False) as stranger:
        for path in ("", f"/{video['id']}", f"/{video['id']}/film", f"/{video['id']}/times"):
            assert stranger.get(f"{session.url}/videos{path}").status_code == 401
        query = {"name": "a.mp4"}
        answer = stranger.post(f"{session.url}/videos", params=query, content=short_film())
        assert answer.status_code == 401
        assert stranger.delete(f"{session.url}/videos/{video['id']}").status_code == 401
        for alter in (stranger.put, stranger.post):
            assert alter(f"{session.url}/videos/{video['id']}/alignment").status_code == 401
    assert list_all(session) == [video]


def begin_upload(session: Recording, size_bytes: int, sent: bytes) -> socket.socket:
    """Send the head of an upload and the begin of its body."""
    running = session.running
    connection = socket.create_connection(("127.0.0.1", running.port))
    path = f"/api/v1{session.url}/videos?name=walk.mp4"
    head = [f"POST {path} HTTP/1.1", f"Host: 127.0.0.1:{running.port}"]
    head += [f"{name}: {value}" for name, value in running.shown.items()]
    head += [f"Content-Length: {size_bytes}", "", ""]
    connection.sendall("\r\n".join(head).encode() + sent)
    return connection


def test_an_upload_that_vanishes_leaves_nothing(
    session: Recording, caplog: pytest.LogCaptureFixture
) -> None:
    before = contents(session)
    connection = begin_upload(session, 50 << 20, bytes(6 << 20))
    until(lambda: list(session.folder.glob(".video-*")))
    assert list_all(session) == []
    connection.close()
    until(lambda: not list(session.folder.glob(".video-*")))
    assert contents(session) == before
    assert [each for each in caplog.records if each.levelname == "ERROR"] == []


def test_a_slow_upload_ends_and_a_steady_one_does_not(strict: Running) -> None:
    session = record_sealed(strict)
    before, film = contents(session), padded_film(3 << 20)
    connection = begin_upload(session, len(film), film[: 1 << 20])
    connection.settimeout(20.0)
    assert b"408" in connection.recv(4096)
    connection.close()
    until(lambda: not list(session.folder.glob(".video-*")))
    assert contents(session) == before

    def steady() -> Iterator[bytes]:
        for begin in range(0, len(film), 600 << 10):
            time.sleep(0.1)
            yield film[begin : begin + (600 << 10)]

    begun_s = time.monotonic()
    content_of(upload(session, steady()), 201)
    assert time.monotonic() - begun_s > 0.5


def test_the_next_start_deletes_what_a_killed_server_left(running: Running) -> None:
    session = record_sealed(running)
    before = contents(session)
    left = session.folder / f".video-{ID}.1.1.0123abcd.tmp"
    left.mkdir()
    (left / "film.mp4").write_bytes(b"half")
    assert list_all(session) == []
    running.restart()
    assert contents(session) == before
