"""Guard of the API: names of hosts, origins of changes, and the token."""

from __future__ import annotations

from typing import Any

import pytest
from websockets.exceptions import InvalidStatus

from service.protocol.link import INGEST_PATH
from service.protocol.live import LIVE_PATH
from tests.service.api.access import BEARER, CHANGES, TOKEN
from tests.service.fake_node import FakeNode
from tests.service.running import Running, ServeWith, assert_refused
from tests.waiting import PATIENCE_S

FOREIGN_HOSTS = (
    *("evil.example", "evil.example:80", "127.0.0.1.evil.example", "", "[", "a b", ".", "::1"),
    *("x@127.0.0.1", "evil.example@localhost", "x:y@127.0.0.1:80", "127.0.0.1/", "127.0.0.1?x"),
    *("127.0.0.1#x", "127.0.0.1:", "127.0.0.1:x", "127.0.0.1:123456", "[127.0.0.1", "[::1]x"),
    *("[localhost]", "0x7f.1", "localhost,evil.example", "localhost%25eth0", "127.0.0.1%eth0"),
    *("[fe80::1%]", "[fe80::1%25 x]", "[fe80::1%eth0/x]", "[fe80::1%25eth0"),
    "[2001:db8::1%25eth0]",
)
OWN_HOSTS = (
    *("localhost", "localhost:1", "LOCALHOST", "192.168.4.1:8000", "[::1]", "[fe80::1]:8"),
    *("[fe80::1%25eth0]:8", "[fe80::1%eth0]", "[FE80::1%25br-lan.2]:8000"),
)


def status_of_socket(running: Running, path: str, **options: Any) -> int:
    """Return the status with which a websocket is refused; 101 if it is not."""
    try:
        with running.socket(path, **options):
            return 101
    except InvalidStatus as refused:
        return refused.response.status_code


@pytest.mark.parametrize("host", FOREIGN_HOSTS)
def test_a_foreign_host_is_refused(shared: Running, host: str) -> None:
    for path in ("/health", "/sessions", "/nothing"):
        answer = shared.http.get(path, headers={"Host": host})
        assert_refused(answer, 403, "--allow-host")
        assert answer.headers["content-type"] == "application/problem+json"


@pytest.mark.parametrize("host", OWN_HOSTS)
def test_localhost_and_addresses_pass(shared: Running, host: str) -> None:
    assert shared.http.get("/health", headers={"Host": host}).status_code == 200


def test_an_allowed_name_passes(serve_with: ServeWith) -> None:
    running = serve_with(hosts=["Robot.local"])
    for host, status in (("robot.local:8000", 200), ("ROBOT.LOCAL", 200), ("robot", 403)):
        assert running.http.get("/health", headers={"Host": host}).status_code == status, host


@pytest.mark.parametrize("path", [LIVE_PATH, INGEST_PATH])
def test_a_foreign_websocket_is_refused(shared: Running, path: str) -> None:
    for origin in ("http://evil.example", "null", "http://127.0.0.1:1"):
        assert status_of_socket(shared, path, origin=origin) == 403
    headers = {
        "Host": "evil.example",
        "Connection": "Upgrade",
        "Upgrade": "websocket",
        "Sec-WebSocket-Key": "dGhlIHNhbXBsZSBub25jZQ==",
        "Sec-WebSocket-Version": "13",
    }
    assert shared.http.get(shared.url + path, headers=headers).status_code == 403


@pytest.mark.parametrize(
    "origin",
    [
        *("http://evil.example", "null", "http://127.0.0.1:1", "", "//[", "//{own}", "{own}"),
        *("http://x@{own}", "http://{own}/evil", "http://{own}#", "ftp://{own}"),
    ],
)
def test_a_change_from_another_site_is_refused(shared: Running, origin: str) -> None:
    headers = {"Origin": origin.replace("{own}", f"127.0.0.1:{shared.port}")}
    for method in ("POST", "PATCH", "DELETE", "PUT"):
        body = {"node": "x", "name": "x"}
        answer = shared.http.request(method, "/sessions", json=body, headers=headers)
        assert_refused(answer, 403, "another site")


def test_the_servers_own_page_passes(shared: Running) -> None:
    answer = shared.http.post(
        "/sessions", json={"node": "nobody", "name": "x"}, headers={"Origin": shared.url}
    )
    assert answer.status_code == 404  # from the route: there is no such node
    for path in (LIVE_PATH, INGEST_PATH):
        assert status_of_socket(shared, path, origin=shared.url) == 101
    page = shared.http.get(shared.url + "/")
    assert page.status_code == 200
    assert "frame-ancestors 'none'" in page.headers["content-security-policy"]
    assert page.headers["x-content-type-options"] == "nosniff"


def test_another_site_may_ask_and_its_browser_decides(shared: Running) -> None:
    answer = shared.http.get("/sessions", headers={"Origin": "http://evil.example"})
    assert answer.status_code == 200
    assert "access-control-allow-origin" not in answer.headers


@pytest.mark.parametrize(
    "token",
    [
        *(None, "", "Bearer", f"Bearer {TOKEN}x", f"Bearer {TOKEN[:-1]}", "Basic eDp5", "\xe9"),
        *(TOKEN, f"Basic {TOKEN}", f"Token {TOKEN}", f"Bearer{TOKEN}", f"Bearer Bearer {TOKEN}"),
    ],
)
def test_a_change_without_the_token_is_refused(guarded: Running, token: str | None) -> None:
    headers: Any = {} if token is None else {"Authorization": token.encode("latin-1")}
    for method, path in CHANGES:
        answer = guarded.http.request(method, path, json={}, headers=headers)
        is_wrong = token is not None and token.startswith("Bearer ")
        assert_refused(answer, 401, "is not the" if is_wrong else "needs the server's token")
        assert answer.headers["www-authenticate"] == "Bearer"
        assert answer.headers["content-type"] == "application/problem+json"
        assert TOKEN not in answer.text
    with (
        pytest.raises(InvalidStatus) as refused,
        guarded.socket(INGEST_PATH, additional_headers=token and {"Authorization": token}),
    ):
        pass
    assert refused.value.response.status_code == 401
    assert refused.value.response.headers["www-authenticate"] == "Bearer"


def test_two_tokens_are_refused(guarded: Running) -> None:
    twice = [*BEARER.items(), ("Authorization", "Bearer x")]
    assert guarded.http.post("/nodes/bench/tare", headers=twice).status_code == 401


def test_a_change_with_the_token_passes(guarded: Running) -> None:
    for method, path in CHANGES:
        answer = guarded.http.request(method, path, json={}, headers=BEARER)
        assert answer.status_code in (404, 422), path
    node = FakeNode(guarded, "other", token=TOKEN)
    node.connect()
    node.deliver(10)
    node.close()


def test_reading_and_watching_need_no_token(guarded: Running) -> None:
    for path in ("/health", "/ready", "/version", "/nodes", "/sessions", "/openapi.json"):
        assert guarded.http.get(path).status_code == 200, path
    with guarded.socket(LIVE_PATH) as live:
        assert "hello" in live.recv(timeout=PATIENCE_S)


@pytest.mark.parametrize("path", ["/api/v1/ingest%0A", "/api/v1/ingest/", "/api/v1//ingest", "/x"])
def test_no_spelling_of_a_path_passes_without_the_token(guarded: Running, path: str) -> None:
    assert status_of_socket(guarded, path) in (400, 401)
