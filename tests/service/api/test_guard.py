"""Who may ask: names, origins and the token."""

from __future__ import annotations

import stat
from pathlib import Path
from typing import Any

import pytest
from websockets.exceptions import InvalidStatus

from service.api.address import load_or_create_token
from service.protocol import INGEST_PATH
from tests.service.fake_node import NodeOf
from tests.service.running import Running, ServeWith
from tests.waiting import PATIENCE_S

LIVE = "/api/v1/live"
TOKEN = "a-token-of-this-test"  # noqa: S105  # of this test


STRANGE_HOSTS = (
    *("x@127.0.0.1", "evil.example@localhost", "x:y@127.0.0.1:80", "127.0.0.1/", "127.0.0.1?x"),
    *(
        "127.0.0.1#x",
        "127.0.0.1:",
        "127.0.0.1:x",
        "127.0.0.1:123456",
        "[127.0.0.1",
        "::1",
        "[::1]x",
    ),
    *("[localhost]", "0x7f.1", "localhost,evil.example", "localhost%25eth0", "127.0.0.1%eth0"),
    *(
        "[fe80::1%]",
        "[fe80::1%25 x]",
        "[fe80::1%eth0/x]",
        "[fe80::1%25eth0",
        "[2001:db8::1%25eth0]",
    ),
)


def test_a_host_of_another_name_is_refused(running: Running) -> None:
    for host in (
        "evil.example",
        "evil.example:80",
        "127.0.0.1.evil.example",
        "",
        "[",
        "a b",
        ".",
        *STRANGE_HOSTS,
    ):
        for path in ("/health", "/sessions", "/nothing"):
            answer = running.http.get(path, headers={"Host": host})
            assert answer.status_code == 403, host
            assert answer.headers["content-type"] == "application/problem+json"
            assert "--allow-host" in answer.json()["detail"]


def test_localhost_and_addresses_pass(running: Running) -> None:
    for host in (
        "localhost",
        "localhost:1",
        "LOCALHOST",
        "192.168.4.1:8000",
        "[::1]",
        "[fe80::1]:8",
        "[fe80::1%25eth0]:8",
        "[fe80::1%eth0]",
        "[FE80::1%25br-lan.2]:8000",
    ):
        answer = running.http.get("/health", headers={"Host": host})
        assert answer.status_code == 200, host


def test_a_name_that_was_allowed_passes(serve_with: ServeWith) -> None:
    running = serve_with(hosts=["Robot.local"])
    for host, status in (("robot.local:8000", 200), ("ROBOT.LOCAL", 200), ("robot", 403)):
        assert running.http.get("/health", headers={"Host": host}).status_code == status, host


@pytest.mark.parametrize("path", [LIVE, INGEST_PATH])
def test_a_websocket_of_another_host_is_refused(running: Running, path: str) -> None:
    headers = {
        "Host": "evil.example",
        "Connection": "Upgrade",
        "Upgrade": "websocket",
        "Sec-WebSocket-Key": "dGhlIHNhbXBsZSBub25jZQ==",
        "Sec-WebSocket-Version": "13",
    }
    assert running.http.get(running.url + path, headers=headers).status_code == 403


@pytest.mark.parametrize(
    "origin",
    [
        *("http://evil.example", "null", "http://127.0.0.1:1", "", "//[", "//{ours}", "{ours}"),
        *("http://x@{ours}", "http://{ours}/evil", "http://{ours}#", "ftp://{ours}"),
    ],
)
def test_a_change_from_another_site_is_refused(running: Running, origin: str) -> None:
    origin = origin.replace("{ours}", f"127.0.0.1:{running.port}")
    for method in ("POST", "PATCH", "DELETE", "PUT"):
        answer = running.http.request(
            method, "/sessions", json={"node": "x", "name": "x"}, headers={"Origin": origin}
        )
        assert answer.status_code == 403, method
        assert "another site" in answer.json()["detail"]


@pytest.mark.parametrize("path", [LIVE, INGEST_PATH])
@pytest.mark.parametrize("origin", ["http://evil.example", "null", "http://127.0.0.1:1"])
def test_a_websocket_from_another_site_is_refused(running: Running, path: str, origin: str) -> None:
    with pytest.raises(InvalidStatus) as refused, running.socket(path, origin=origin):
        pass
    assert refused.value.response.status_code == 403


def test_the_servers_own_page_passes(running: Running) -> None:
    answer = running.http.post(
        "/sessions", json={"node": "nobody", "name": "x"}, headers={"Origin": running.url}
    )
    assert answer.status_code == 404  # it came through to where there is no such node
    for path in (LIVE, INGEST_PATH):
        with running.socket(path, origin=running.url):
            pass


def test_reading_from_another_site_is_let_to_the_browser(running: Running) -> None:
    answer = running.http.get("/sessions", headers={"Origin": "http://evil.example"})
    assert answer.status_code == 200
    assert "access-control-allow-origin" not in answer.headers


def test_a_page_of_ours_is_hardened(running: Running) -> None:
    answer = running.http.get(running.url + "/")
    assert answer.status_code == 200
    assert "frame-ancestors 'none'" in answer.headers["content-security-policy"]
    assert answer.headers["x-content-type-options"] == "nosniff"


CHANGES = (
    ("POST", "/sessions"),
    ("POST", "/sessions/20200101T000000Z-000000/stop"),
    ("PATCH", "/sessions/20200101T000000Z-000000"),
    ("POST", "/sessions/20200101T000000Z-000000/markers"),
    ("POST", "/nodes/bench/tare"),
    ("DELETE", "/nodes/bench/tares/1"),
)


@pytest.mark.parametrize(
    "given",
    [
        *(None, "", "Bearer", f"Bearer {TOKEN}x", f"Bearer {TOKEN[:-1]}", "Basic eDp5", "\xe9"),
        *(TOKEN, f"Basic {TOKEN}", f"Token {TOKEN}", f"Bearer{TOKEN}", f"Bearer Bearer {TOKEN}"),
    ],
)
def test_a_change_without_the_token_is_refused(serve_with: ServeWith, given: str | None) -> None:
    running = serve_with(token=TOKEN)
    headers: Any = {} if given is None else {"Authorization": given.encode("latin-1")}
    for method, path in CHANGES:
        answer = running.http.request(method, path, json={}, headers=headers)
        assert answer.status_code == 401, path
        assert answer.headers["www-authenticate"] == "Bearer"
        assert answer.headers["content-type"] == "application/problem+json"
        assert TOKEN not in answer.text
    with (
        pytest.raises(InvalidStatus) as refused,
        running.socket(INGEST_PATH, additional_headers=given and {"Authorization": given}),
    ):
        pass
    assert refused.value.response.status_code == 401
    assert refused.value.response.headers["www-authenticate"] == "Bearer"


def test_a_wrong_token_is_not_called_a_missing_one(serve_with: ServeWith) -> None:
    running = serve_with(token=TOKEN)
    for given, said in (
        (None, "needs the server's token"),
        (TOKEN, "needs the server's token"),
        ("Bearer x", "is not the"),
    ):
        headers = {"Authorization": given} if given else {}
        answer = running.http.post("/nodes/bench/tare", headers=headers)
        assert said in answer.json()["detail"], given


def test_two_tokens_are_none(serve_with: ServeWith) -> None:
    running = serve_with(token=TOKEN)
    twice = [("Authorization", f"Bearer {TOKEN}"), ("Authorization", "Bearer x")]
    assert running.http.post("/nodes/bench/tare", headers=twice).status_code == 401


def test_a_change_with_the_token_passes(serve_with: ServeWith, node_of: NodeOf) -> None:
    running = serve_with(token=TOKEN)
    for method, path in CHANGES:
        answer = running.http.request(
            method, path, json={}, headers={"Authorization": f"Bearer {TOKEN}"}
        )
        assert answer.status_code in (404, 422), path
    node = node_of(running, token=TOKEN)
    node.connect()
    node.deliver(10)


def test_reading_and_watching_need_no_token(serve_with: ServeWith) -> None:
    running = serve_with(token=TOKEN)
    for path in ("/health", "/ready", "/version", "/nodes", "/sessions", "/openapi.json"):
        assert running.http.get(path).status_code == 200, path
    with running.socket(LIVE) as live:
        assert "hello" in live.recv(timeout=PATIENCE_S)


def test_a_token_is_made_once_and_only_its_owner_may_read_it(tmp_path: Path) -> None:
    data = tmp_path / "data"
    token = load_or_create_token(None, data)
    assert len(token) >= 20
    assert stat.S_IMODE((data / "token").stat().st_mode) == 0o600
    assert load_or_create_token(None, data) == token
    assert load_or_create_token("given", data) == "given"


def test_an_empty_token_is_none(tmp_path: Path) -> None:
    # FOOTTILE_TOKEN= in the environment must not open the server to everybody.
    assert load_or_create_token("", tmp_path)


def test_a_token_file_that_is_empty_is_no_token(tmp_path: Path) -> None:
    # As after a cut of power between its creation and its writing.
    (tmp_path / "token").touch(mode=0o600)
    assert load_or_create_token(None, tmp_path)


@pytest.mark.parametrize("path", ["/api/v1/ingest%0A", "/api/v1/ingest/", "/api/v1//ingest", "/x"])
def test_no_other_way_of_writing_the_path_gets_past_the_token(
    serve_with: ServeWith, path: str
) -> None:
    running = serve_with(token=TOKEN)
    with pytest.raises(InvalidStatus) as refused, running.socket(path):
        pytest.fail("it was let in")
    assert refused.value.response.status_code in (400, 401)
