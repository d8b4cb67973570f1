"""Logins: tickets, cookies, the rights of roles, and private servers."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import httpx
import pytest
from websockets.exceptions import InvalidStatus

from service.api.access import LOGINS_MAX, TICKET_S, TICKETS_MAX, Logins, Role, SecretStore
from service.protocol.link import INGEST_PATH
from service.protocol.live import LIVE_PATH
from tests.service.api.access import BEARER, CHANGES, TOKEN
from tests.service.patient import patient_server
from tests.service.running import Running, assert_refused, content_of
from tests.waiting import PATIENCE_S


class Clock:
    now_s = 1e6

    def __call__(self) -> float:
        return self.now_s


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def logins(clock: Clock) -> Logins:
    return Logins(TOKEN, now_s=clock)


@pytest.mark.parametrize("role", list(Role))
def test_a_cookie_has_its_role_again_and_again(logins: Logins, role: Role) -> None:
    cookie = logins.cookies.create(role)
    for _ in range(2):
        grant = logins.cookies.find_grant(cookie)
        assert grant is not None
        assert grant.role is role
    assert logins.tickets.redeem(cookie) is None


def test_a_ticket_is_valid_once_and_is_no_cookie(logins: Logins) -> None:
    ticket = logins.tickets.create(Role.OPERATOR)
    assert logins.cookies.find_grant(ticket) is None
    wrong = ("", ticket[:-1], ticket + "A", ticket.swapcase(), " " + ticket, "\ud800", "x" * 99)
    for other in wrong:
        assert logins.tickets.redeem(other) is None
    assert logins.tickets.redeem(ticket) is not None
    assert logins.tickets.redeem(ticket) is None


def test_a_ticket_is_valid_for_five_minutes(logins: Logins, clock: Clock) -> None:
    early, late = (logins.tickets.create(Role.VIEWER) for _ in range(2))
    clock.now_s += TICKET_S - 0.001
    assert logins.tickets.redeem(early) is not None
    clock.now_s += 0.002
    assert logins.tickets.redeem(late) is None


@pytest.mark.parametrize(("kind", "most"), [("tickets", TICKETS_MAX), ("cookies", LOGINS_MAX)])
def test_the_oldest_of_too_many_secrets_is_forgotten(logins: Logins, kind: str, most: int) -> None:
    store: SecretStore = getattr(logins, kind)
    secrets = [store.create(Role.OPERATOR) for _ in range(most + 3)]
    assert [store.find_grant(one) is not None for one in secrets] == [False] * 3 + [True] * most
    assert len(set(secrets)) == len(secrets)
    assert all(len(one) >= 22 for one in secrets)  # 128 bits
    assert not any(one in repr(vars(store)) for one in secrets)


# --- over HTTP ------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def private(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Running]:
    folder = tmp_path_factory.mktemp("private")
    with patient_server(folder / "data", token=TOKEN, is_private=True) as running:
        yield running


def create_ticket(running: Running, role: str = "operator") -> dict[str, Any]:
    return dict(content_of(running.http.post("/tickets", json={"role": role}, headers=BEARER), 201))


def browser(running: Running) -> httpx.Client:
    """Return a client that keeps cookies and sends its origin."""
    return httpx.Client(
        base_url=running.url + "/api/v1",
        headers={"Origin": running.url},
        timeout=PATIENCE_S,
        trust_env=False,
    )


@contextmanager
def logged_in(running: Running, role: str = "operator") -> Iterator[httpx.Client]:
    with browser(running) as client:
        answer = client.post("/login", json={"ticket": create_ticket(running, role)["ticket"]})
        assert (answer.status_code, answer.json()["role"]) == (200, role), answer.text
        yield client


def cookie_header(client: httpx.Client) -> dict[str, str]:
    (cookie,) = client.cookies.jar
    return {"Cookie": f"{cookie.name}={cookie.value}"}


def test_a_ticket_becomes_a_cookie_of_this_site_only(guarded: Running) -> None:
    ticket = create_ticket(guarded)
    assert ticket["urls"] == [f"{guarded.url}/#ticket={ticket['ticket']}"]
    with browser(guarded) as client, browser(guarded) as second:
        answer = client.post("/login", json={"ticket": ticket["ticket"]})
        cookie = answer.headers["set-cookie"]
        name, _, value = cookie.partition(";")[0].partition("=")
        assert name == f"foottile_{guarded.port}"
        assert value not in (ticket["ticket"], TOKEN)
        for word in ("HttpOnly", "SameSite=strict", "Path=/", "Max-Age=43200"):
            assert word in cookie
        assert "Secure" not in cookie  # without TLS a browser would drop it
        for method, path in CHANGES:
            assert client.request(method, path, json={}).status_code in (404, 422), path
        refused = second.post("/login", json={"ticket": ticket["ticket"]})
        assert_refused(refused, 401, "valid once", "five minutes", "foottile invite")
        assert "set-cookie" not in refused.headers
        assert second.post("/sessions", json={"node": "x", "name": "x"}).status_code == 401


def test_the_token_becomes_a_cookie(guarded: Running) -> None:
    with browser(guarded) as client:
        assert client.post("/login", json={}, headers=BEARER).json()["role"] == "operator"
        assert client.get("/login").json()["role"] == "operator"
        assert client.post("/login", json={}).status_code == 401  # a cookie renews no cookie


@pytest.mark.parametrize("token", [None, "Bearer x", "Bearer", f"Basic {TOKEN}"])
def test_a_wrong_token_becomes_no_cookie(guarded: Running, token: str | None) -> None:
    headers = {"Authorization": token} if token else {}
    answer = guarded.http.post("/login", json={}, headers=headers)
    assert_refused(answer, 401, "ticket")
    assert "set-cookie" not in answer.headers


def test_a_viewer_changes_nothing(guarded: Running) -> None:
    with logged_in(guarded, "viewer") as viewer:
        for method, path in CHANGES:
            answer = viewer.request(method, path, json={})
            assert_refused(answer, 403, "may not change anything")
        assert viewer.get("/sessions").status_code == 200


@pytest.mark.parametrize("role", ["viewer", "operator"])
def test_a_login_creates_no_ticket_and_is_no_node(guarded: Running, role: str) -> None:
    with logged_in(guarded, role) as client:
        assert_refused(client.post("/tickets", json={"role": role}), 403, "token")
        headers = cookie_header(client)
        with (
            pytest.raises(InvalidStatus) as refused,
            guarded.socket(INGEST_PATH, additional_headers=headers, origin=guarded.url),
        ):
            pass
        assert refused.value.response.status_code == 403


def test_a_cookie_needs_the_servers_origin_and_no_wrong_token(guarded: Running) -> None:
    with logged_in(guarded) as client:
        answer = client.post("/nodes/x/tare", headers={"Authorization": "Bearer wrong"})
        assert_refused(answer, 401, "not the server's token")
        del client.headers["Origin"]
        assert client.post("/sessions", json={"node": "x", "name": "x"}).status_code == 401
        client.headers["Origin"] = "http://127.0.0.1:1"  # browsers send cookies to every port
        assert client.post("/sessions", json={"node": "x", "name": "x"}).status_code == 403


@pytest.mark.parametrize(
    ("path", "bodies"),
    [
        ("/login", [{"ticket": 1}, {"ticket": "x" * 101}, {"more": 1}, [], "x", None]),
        ("/tickets", [{"role": "own"}, {"role": 3}, {"role": None}, [], {"more": 1}]),
    ],
)
def test_a_wrong_body_is_refused(guarded: Running, path: str, bodies: list[object]) -> None:
    for body in bodies:
        assert guarded.http.post(path, json=body, headers=BEARER).status_code == 422, body


@pytest.mark.parametrize(
    "value", ["", '"', "x" * 5000, "a=b=c", "\xe9\xff", "%00", "{name}={name}", "; ;;=;"]
)
def test_a_foreign_cookie_has_no_role(guarded: Running, value: str) -> None:
    cookie = f"foottile_{guarded.port}={value.format(name=f'foottile_{guarded.port}')}"
    headers = [(b"Cookie", cookie.encode("latin-1")), (b"Origin", guarded.url.encode())]
    assert guarded.http.get("/login", headers=headers).json()["role"] is None
    assert guarded.http.post("/nodes/x/tare", headers=headers).status_code == 401


def test_a_login_ends_with_its_server(guarded: Running) -> None:
    with logged_in(guarded) as client:
        before = client.get("/login").json()
        assert before["ends_t_ns"] is not None
        assert not before["ended"]
        guarded.restart()
        after = client.get("/login").json()
        assert (after["ended"], after["role"]) == (True, None)
        assert_refused(client.post("/nodes/x/tare"), 401, "has expired", "restarted")
        assert client.get("/nodes").status_code == 200


def test_a_log_out_ends_a_login(guarded: Running) -> None:
    with logged_in(guarded) as client:
        headers = cookie_header(client)
        assert client.delete("/login").status_code == 204
        assert not client.cookies
        assert client.get("/login", headers=headers).json()["ended"]


def test_another_site_logs_nobody_in_or_out(guarded: Running) -> None:
    headers = {"Origin": "http://evil.example"}
    assert guarded.http.post("/login", json={}, headers=headers | BEARER).status_code == 403
    assert guarded.http.delete("/login", headers=headers).status_code == 403


def list_readable(running: Running) -> list[str]:
    """Return every path of a GET, with something in the place of its parameters."""
    api = running.http.get("/openapi.json", headers=BEARER).json()
    paths = [
        re.sub(r"\{[^}]*\}", "x", path) for path, item in api["paths"].items() if "get" in item
    ]
    assert len(paths) > 20
    others = ("/api/v1", "/api/v1/openapi.json", "/api/v1/nothing", "/nothing")
    return [*paths, *others, "/api/v1/../api/v1/nodes"]


def test_a_private_server_needs_a_login_for_all_but_its_pages(private: Running) -> None:
    assert_refused(private.http.get("/openapi.json"), 401, "private", "foottile invite")
    for path in list_readable(private):
        for method in ("GET", "HEAD", "OPTIONS"):
            answer = private.http.request(method, private.url + path)
            is_open = path in ("/api/v1/login", "/api/v1/ready")
            assert (answer.status_code == 401) is not is_open, path
            assert is_open or answer.headers["www-authenticate"] == "Bearer"
    for socket in (LIVE_PATH, INGEST_PATH, LIVE_PATH + "/", "/api/v1//live", "/login", "/"):
        with pytest.raises(InvalidStatus) as refused, private.socket(socket, origin=private.url):
            pass
        assert refused.value.response.status_code == 401, socket
    for path in ("/", "/sessions/x", "/static/app.js", "/static/style.css", "/docs"):
        assert private.http.get(private.url + path).status_code == 200, path


@pytest.mark.parametrize(
    "path",
    [
        *("//api/v1/nodes", "/static/../api/v1/nodes", "/static/%2e%2e/api/v1/nodes"),
        *("/sessions/../api/v1/nodes", "/sessions/x/../../api/v1/nodes"),
        *("/API/v1/nodes", "/sessions/", "/api/v1/login/../nodes"),
    ],
)
def test_no_spelling_of_a_path_opens_a_private_server(private: Running, path: str) -> None:
    answer = private.http.get(private.url + path, extensions={"target": path.encode()})
    assert answer.status_code in (401, 404)
    assert "items" not in answer.text


@pytest.mark.parametrize("role", ["viewer", "operator"])
def test_a_login_opens_a_private_server(private: Running, role: str) -> None:
    with logged_in(private, role) as client:
        for path in list_readable(private):
            assert client.get(private.url + path).status_code not in (401, 403), path
        headers = cookie_header(client)
        with private.socket(LIVE_PATH, additional_headers=headers, origin=private.url) as live:
            assert "hello" in live.recv(timeout=PATIENCE_S)


def test_the_token_opens_a_private_server(private: Running) -> None:
    assert private.http.get("/sessions", headers=BEARER).status_code == 200
    with private.socket(LIVE_PATH, additional_headers=BEARER) as live:
        assert "hello" in live.recv(timeout=PATIENCE_S)
