"""Reverse proxies: what they forward counts only if an option trusts them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack

import httpx
import pytest
from websockets.exceptions import ConnectionClosed

from service.api.settings import LimitSettings, load_settings
from service.protocol.live import LIVE_PATH
from tests.service.patient import patient_server
from tests.service.running import Running, assert_refused
from tests.tokens import SHARED_BEARER
from tests.waiting import PATIENCE_S


@pytest.fixture(scope="module", params=[True, False], ids=["trusted", "not trusted"])
def is_trusted(request: pytest.FixtureRequest) -> bool:
    return bool(request.param)


@pytest.fixture(scope="module")
def proxied(tmp_path_factory: pytest.TempPathFactory, *, is_trusted: bool) -> Iterator[Running]:
    """A server to which the test is a proxy, with one place for each address."""
    bounds = LimitSettings.model_validate(
        {
            "max_connections_per_address": 1,
            "trusted_proxy": ("127.0.0.1",) if is_trusted else (),
        }
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("FORWARDED_ALLOW_IPS", "*")  # uvicorn's own setting
        with patient_server(tmp_path_factory.mktemp("p") / "data", bounds=bounds) as running:
            yield running


def is_let_in(stack: ExitStack, running: Running, forwarded_for: str) -> bool:
    """Return whether the server accepts a subscriber whom a proxy forwards for this client."""
    headers = {"X-Forwarded-For": forwarded_for}
    live = stack.enter_context(running.socket(LIVE_PATH, additional_headers=headers))
    try:
        live.recv(timeout=PATIENCE_S)
    except ConnectionClosed:
        return False
    return True


def test_places_are_those_of_the_clients_of_a_trusted_proxy(
    proxied: Running, *, is_trusted: bool
) -> None:
    with ExitStack() as stack:
        assert is_let_in(stack, proxied, "192.0.2.1")
        for client, has_place in (("192.0.2.1", False), ("192.0.2.2", is_trusted)):
            answer = proxied.http.get("/health", headers={"X-Forwarded-For": client})
            assert answer.status_code == (200 if has_place else 503)
            assert is_let_in(stack, proxied, client) is has_place
        # The client's own header stands before the address that the proxy appends.
        assert not is_let_in(stack, proxied, "192.0.2.3, 192.0.2.1")


def test_a_cookie_is_secure_behind_tls_of_a_trusted_proxy(
    proxied: Running, *, is_trusted: bool
) -> None:
    for scheme, is_secure in (("https", is_trusted), ("http", False), ("nonsense", False)):
        headers = SHARED_BEARER | {"X-Forwarded-Proto": scheme}
        answer = proxied.http.post("/login", json={}, headers=headers)
        assert answer.status_code == 200
        assert ("Secure" in answer.headers["set-cookie"]) is is_secure


def test_a_page_without_tls_is_another_site_behind_tls(
    proxied: Running, *, is_trusted: bool
) -> None:
    for scheme, is_refused in (("https", False), ("http", is_trusted)):
        headers = {"X-Forwarded-Proto": "https", "Origin": f"{scheme}://127.0.0.1:{proxied.port}"}
        answer = proxied.http.post("/nodes/x/tare", headers=headers)
        if is_refused:
            assert_refused(answer, 403, "another site", "Host header")
        else:
            assert answer.status_code == 404


@pytest.mark.parametrize(
    "header", ["X-Forwarded-For", "X-Real-IP", "Forwarded", "X-Forwarded-User"]
)
def test_no_forwarded_header_is_a_right(proxied: Running, header: str) -> None:
    with httpx.Client(base_url=proxied.url, trust_env=False) as client:
        for value in ("127.0.0.1", "for=127.0.0.1;proto=https", "::1", "root"):
            answer = client.delete("/api/v1/trash", headers={header: value})
            assert_refused(answer, 401, "token", "foottile invite")


def test_an_ipv4_proxy_is_trusted_at_a_socket_of_ipv6() -> None:
    bounds = LimitSettings.model_validate({"trusted_proxy": ["172.18.0.0/16", "127.0.0.1", "::1"]})
    assert bounds.trusted_peers == [
        *("172.18.0.0/16", "127.0.0.1/32", "::1/128"),
        *("::ffff:172.18.0.0/112", "::ffff:127.0.0.1/128"),
    ]


@pytest.mark.parametrize("address", ["*", "proxy", "localhost", "127.0.0.1:80", "127.0.0.1/8", ""])
def test_a_proxy_is_named_by_its_address(address: str) -> None:
    with pytest.raises(ValueError, match="trusted_proxy"):
        load_settings(None, trusted_proxy=(address,))
