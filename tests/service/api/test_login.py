"""Getting in by ticket, what a login may do, and what a private server keeps to itself."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import httpx
import pytest
from websockets.exceptions import InvalidStatus

from service.api.logins import TICKET_S
from service.protocol import INGEST_PATH, LIVE_PATH
from tests.service.api.test_guard import CHANGES, TOKEN
from tests.service.running import Running, ServeWith, assert_refused
from tests.waiting import PATIENCE_S

BEARER = {"Authorization": f"Bearer {TOKEN}"}


@pytest.fixture
def guarded(serve_with: ServeWith) -> Running:
    return serve_with(token=TOKEN)


@pytest.fixture
def private(serve_with: ServeWith) -> Running:
    return serve_with(token=TOKEN, is_private=True)


def ticket(running: Running, role: str = "operator") -> dict[str, Any]:
    answer = running.http.post("/tickets", json={"role": role}, headers=BEARER)
    assert answer.status_code == 201, answer.text
    given: dict[str, Any] = answer.json()
    return given


def browser(running: Running) -> httpx.Client:
    """Keeps cookies, and says where it is when it changes something."""
    return httpx.Client(
        base_url=running.url + "/api/v1",
        headers={"Origin": running.url},
        timeout=PATIENCE_S,
        trust_env=False,
    )


@contextmanager
def logged_in(running: Running, role: str = "operator") -> Iterator[httpx.Client]:
    with browser(running) as client:
        answer = client.post("/login", json={"ticket": ticket(running, role)["ticket"]})
        assert answer.status_code == 200, answer.text
        assert answer.json()["role"] == role
        yield client


def test_a_ticket_becomes_a_cookie_that_no_script_can_read_and_no_other_site_can_send(
    guarded: Running,
) -> None:
    given = ticket(guarded)
    assert given["urls"] == [f"{guarded.url}/#ticket={given['ticket']}"]
    with browser(guarded) as client:
        answer = client.post("/login", json={"ticket": given["ticket"]})
        cookie = answer.headers["set-cookie"]
        name, _, value = cookie.partition(";")[0].partition("=")
        assert name == f"foottile_{guarded.port}"
        assert value not in (given["ticket"], TOKEN)
        for word in ("HttpOnly", "SameSite=strict", "Path=/", "Max-Age=43200"):
            assert word in cookie
        assert "Secure" not in cookie  # there is no TLS here, and a browser would not keep it
        for method, path in CHANGES:
            assert client.request(method, path, json={}).status_code in (404, 422), path


def test_a_ticket_that_was_used_is_refused(guarded: Running) -> None:
    one = ticket(guarded)["ticket"]
    with browser(guarded) as first, browser(guarded) as second:
        assert first.post("/login", json={"ticket": one}).status_code == 200
        refused = second.post("/login", json={"ticket": one})
        assert_refused(refused, 401, "valid once", "foottile invite")
        assert "set-cookie" not in refused.headers
        assert second.post("/sessions", json={"node": "x", "name": "x"}).status_code == 401


def test_an_old_ticket_is_refused(guarded: Running, monkeypatch: pytest.MonkeyPatch) -> None:
    one = ticket(guarded)["ticket"]
    now_s = guarded.logins.tickets._now_s
    monkeypatch.setattr(guarded.logins.tickets, "_now_s", lambda: now_s() + TICKET_S)
    with browser(guarded) as client:
        assert_refused(client.post("/login", json={"ticket": one}), 401, "five minutes")


def test_the_token_becomes_a_cookie_too(guarded: Running) -> None:
    with browser(guarded) as client:
        assert client.post("/login", json={}, headers=BEARER).json()["role"] == "operator"
        assert client.get("/login").json()["role"] == "operator"


@pytest.mark.parametrize("given", [None, "Bearer x", "Bearer", f"Basic {TOKEN}"])
def test_nothing_and_a_wrong_token_become_no_cookie(guarded: Running, given: str | None) -> None:
    headers = {"Authorization": given} if given else {}
    answer = guarded.http.post("/login", json={}, headers=headers)
    assert_refused(answer, 401, "ticket")
    assert "set-cookie" not in answer.headers


def test_a_login_is_not_renewed_by_itself(guarded: Running) -> None:
    with logged_in(guarded) as client:
        assert client.post("/login", json={}).status_code == 401


def test_a_viewer_looks_and_cannot_press(guarded: Running) -> None:
    with logged_in(guarded, "viewer") as viewer:
        for method, path in CHANGES:
            answer = viewer.request(method, path, json={})
            assert_refused(answer, 403, "may not change anything")
        assert viewer.get("/sessions").status_code == 200


def test_a_login_gives_no_tickets_and_is_no_node(guarded: Running) -> None:
    for role in ("viewer", "operator"):
        with logged_in(guarded, role) as client:
            assert_refused(client.post("/tickets", json={"role": role}), 403, "token")
            (cookie,) = client.cookies.jar
            headers = {"Cookie": f"{cookie.name}={cookie.value}"}
            with (
                pytest.raises(InvalidStatus) as refused,
                guarded.socket(INGEST_PATH, additional_headers=headers, origin=guarded.url),
            ):
                pass
            assert refused.value.response.status_code == 403


def test_a_cookie_changes_nothing_for_who_does_not_say_from_where(guarded: Running) -> None:
    with logged_in(guarded) as client:
        del client.headers["Origin"]
        assert client.post("/sessions", json={"node": "x", "name": "x"}).status_code == 401
        client.headers["Origin"] = "http://127.0.0.1:1"  # of another port: its cookies are sent
        assert client.post("/sessions", json={"node": "x", "name": "x"}).status_code == 403


def test_beside_a_wrong_token_a_cookie_does_not_count(guarded: Running) -> None:
    with logged_in(guarded) as client:
        answer = client.post("/nodes/x/tare", headers={"Authorization": "Bearer wrong"})
        assert_refused(answer, 401, "not the server's token")


@pytest.mark.parametrize("body", [{"ticket": 1}, {"ticket": "x" * 101}, {"more": 1}, [], "x", None])
def test_what_is_no_login_is_refused(guarded: Running, body: object) -> None:
    assert guarded.http.post("/login", json=body).status_code == 422


@pytest.mark.parametrize("body", [{"role": "own"}, {"role": 3}, {"role": None}, [], {"more": 1}])
def test_what_is_no_ticket_is_not_given(guarded: Running, body: object) -> None:
    assert guarded.http.post("/tickets", json=body, headers=BEARER).status_code == 422


@pytest.mark.parametrize(
    "value", ["", '"', "x" * 5000, "a=b=c", "\xe9\xff", "%00", "{name}={name}", "; ;;=;"]
)
def test_cookies_that_are_none_of_ours_are_nobody(guarded: Running, value: str) -> None:
    cookie = f"foottile_{guarded.port}={value.format(name=f'foottile_{guarded.port}')}"
    headers = [(b"Cookie", cookie.encode("latin-1")), (b"Origin", guarded.url.encode())]
    assert guarded.http.get("/login", headers=headers).json()["role"] is None
    answer = guarded.http.post("/nodes/x/tare", headers=headers)
    assert answer.status_code == 401


def test_a_login_ends_with_the_server_and_it_says_so(guarded: Running) -> None:
    with logged_in(guarded) as client:
        before = client.get("/login").json()
        assert before["ends_t_ns"] is not None
        assert not before["ended"]
        guarded.restart()
        after = client.get("/login").json()
        assert after["ended"]
        assert after["role"] is None
        assert_refused(client.post("/nodes/x/tare"), 401, "has expired", "restarted")
        assert client.get("/nodes").status_code == 200


def test_who_logs_out_is_out(guarded: Running) -> None:
    with logged_in(guarded) as client:
        (cookie,) = client.cookies.jar
        assert client.delete("/login").status_code == 204
        assert not client.cookies
        client.cookies.set(cookie.name, cookie.value or "", domain="127.0.0.1")
        assert client.get("/login").json()["ended"]


def test_another_site_can_log_nobody_in_or_out(guarded: Running) -> None:
    headers = {"Origin": "http://evil.example"}
    assert guarded.http.post("/login", json={}, headers=headers | BEARER).status_code == 403
    assert guarded.http.delete("/login", headers=headers).status_code == 403


OPEN_PATHS = {"/api/v1/login", "/api/v1/ready"}


def readable(running: Running) -> list[str]:
    """Every path that answers a GET, with something in the place of its parameters."""
    api = running.http.get("/openapi.json", headers=BEARER).json()
    found = [
        re.sub(r"\{[^}]*\}", "x", path) for path, item in api["paths"].items() if "get" in item
    ]
    return [
        *found,
        "/api/v1/openapi.json",
        "/api/v1/nothing",
        "/nothing",
        "/api/v1/../api/v1/nodes",
    ]


def test_a_private_server_says_nothing_to_who_has_not_logged_in(private: Running) -> None:
    paths = readable(private)
    assert len(paths) > 20
    for path in paths:
        for method in ("GET", "HEAD", "OPTIONS"):
            answer = httpx.request(method, private.url + path, trust_env=False)
            if path in OPEN_PATHS:
                assert answer.status_code != 401, path
            else:
                assert answer.status_code == 401, path
                assert answer.headers["www-authenticate"] == "Bearer"
    for socket in (LIVE_PATH, INGEST_PATH, LIVE_PATH + "/", "/api/v1//live", "/login", "/"):
        with pytest.raises(InvalidStatus) as refused, private.socket(socket, origin=private.url):
            pass
        assert refused.value.response.status_code == 401, socket


@pytest.mark.parametrize(
    "path",
    [
        *("//api/v1/nodes", "/static/../api/v1/nodes", "/static/%2e%2e/api/v1/nodes"),
        *("/sessions/../api/v1/nodes", "/sessions/x/../../api/v1/nodes"),
        *("/API/v1/nodes", "/sessions/", "/api/v1/login/../nodes"),
    ],
)
def test_no_other_way_of_writing_a_path_gets_into_a_private_server(
    private: Running, path: str
) -> None:
    answer = private.http.get(private.url + path, extensions={"target": path.encode()})
    assert answer.status_code in (401, 404)
    assert "items" not in answer.text


def test_a_private_server_shows_pages_without_data(private: Running) -> None:
    for path in ("/", "/sessions/x", "/static/app.js", "/static/style.css"):
        assert httpx.get(private.url + path, trust_env=False).status_code == 200, path


@pytest.mark.parametrize("role", ["viewer", "operator"])
def test_who_has_logged_in_sees_a_private_server(private: Running, role: str) -> None:
    with logged_in(private, role) as client:
        for path in readable(private):
            assert client.get(private.url + path).status_code not in (401, 403), path
        (cookie,) = client.cookies.jar
        headers = {"Cookie": f"{cookie.name}={cookie.value}"}
        with private.socket(LIVE_PATH, additional_headers=headers, origin=private.url) as live:
            assert "hello" in live.recv(timeout=PATIENCE_S)


def test_the_token_opens_a_private_server_to_programs(private: Running) -> None:
    assert private.http.get("/sessions", headers=BEARER).status_code == 200
    with private.socket(LIVE_PATH, additional_headers=BEARER) as live:
        assert "hello" in live.recv(timeout=PATIENCE_S)
