"""What a reverse proxy says of its client counts only if the proxy is trusted by an option."""

from __future__ import annotations

from contextlib import ExitStack

import httpx
import pytest
from websockets.exceptions import ConnectionClosed

from service.api.connection_limits import LimitSettings
from service.api.settings import load_settings
from service.protocol import LIVE_PATH
from tests.service.running import Running, ServeWith, assert_refused
from tests.tokens import SHARED_BEARER
from tests.waiting import PATIENCE_S

TRUSTED = ("127.0.0.1",)


@pytest.fixture(params=[True, False], ids=["trusted", "not trusted"])
def is_trusted(request: pytest.FixtureRequest) -> bool:
    return bool(request.param)


@pytest.fixture
def running(serve_with: ServeWith, monkeypatch: pytest.MonkeyPatch, *, is_trusted: bool) -> Running:
    """A server to which the test is a proxy."""
    monkeypatch.setenv("FORWARDED_ALLOW_IPS", "*")  # uvicorn's own setting
    bounds = LimitSettings.model_validate(
        {"max_connections_per_address": 1, "trusted_proxy": TRUSTED if is_trusted else ()}
    )
    return serve_with(bounds=bounds)


def is_let_in(stack: ExitStack, running: Running, forwarded_for: str) -> bool:
    """Does a screen find a place, which a proxy connects for this client?"""
    headers = {"X-Forwarded-For": forwarded_for}
    live = stack.enter_context(running.socket(LIVE_PATH, additional_headers=headers))
    try:
        live.recv(timeout=PATIENCE_S)
    except ConnectionClosed:
        return False
    return True


def test_clients_of_a_trusted_proxy_have_places_of_their_own(
    running: Running, *, is_trusted: bool
) -> None:
    with ExitStack() as stack:
        assert is_let_in(stack, running, "192.0.2.1")
        assert is_let_in(stack, running, "192.0.2.2") is is_trusted
        assert not is_let_in(stack, running, "192.0.2.1")
        # What the client itself has sent stands before what the proxy has added.
        assert not is_let_in(stack, running, "192.0.2.3, 192.0.2.1")


def test_requests_through_a_trusted_proxy_count_for_their_clients(
    running: Running, *, is_trusted: bool
) -> None:
    with ExitStack() as stack:
        assert is_let_in(stack, running, "192.0.2.1")
        for client, has_place in (("192.0.2.1", False), ("192.0.2.2", is_trusted)):
            answer = running.http.get("/health", headers={"X-Forwarded-For": client})
            assert answer.status_code == (200 if has_place else 503)


def test_a_cookie_is_secure_where_a_trusted_proxy_has_tls(
    running: Running, *, is_trusted: bool
) -> None:
    for scheme, is_secure in (("https", is_trusted), ("http", False), ("nonsense", False)):
        headers = SHARED_BEARER | {"X-Forwarded-Proto": scheme}
        answer = running.http.post("/login", json={}, headers=headers)
        assert answer.status_code == 200
        assert ("Secure" in answer.headers["set-cookie"]) is is_secure


def test_behind_tls_a_page_without_tls_is_another_site(
    running: Running, *, is_trusted: bool
) -> None:
    host = f"127.0.0.1:{running.port}"
    headers = {"X-Forwarded-Proto": "https"}

    def change(origin: str) -> httpx.Response:
        return running.http.post("/nodes/x/tare", headers=headers | {"Origin": origin})

    assert change(f"https://{host}").status_code == 404
    if is_trusted:
        assert_refused(change(f"http://{host}"), 403, "another site", "Host header")
    else:
        assert change(f"http://{host}").status_code == 404


@pytest.mark.parametrize(
    "header", ["X-Forwarded-For", "X-Real-IP", "Forwarded", "X-Forwarded-User"]
)
@pytest.mark.parametrize("value", ["127.0.0.1", "for=127.0.0.1;proto=https", "::1", "root"])
def test_no_forwarded_header_is_a_right(running: Running, header: str, value: str) -> None:
    answer = httpx.delete(f"{running.url}/api/v1/trash", headers={header: value}, trust_env=False)
    assert_refused(answer, 401, "token", "foottile invite")


def test_an_ipv4_proxy_is_trusted_at_a_socket_of_ipv6() -> None:
    bounds = LimitSettings.model_validate({"trusted_proxy": ["172.18.0.0/16", "127.0.0.1", "::1"]})
    assert bounds.trusted_peers == [
        *("172.18.0.0/16", "127.0.0.1/32", "::1/128"),
        *("::ffff:172.18.0.0/112", "::ffff:127.0.0.1/128"),
    ]


@pytest.mark.parametrize("address", ["*", "proxy", "localhost", "127.0.0.1:80", "127.0.0.1/8", ""])
def test_what_is_no_address_is_no_proxy(address: str) -> None:
    with pytest.raises(ValueError, match="trusted_proxy"):
        load_settings(None, trusted_proxy=(address,))
