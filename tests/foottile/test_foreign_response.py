"""Answers of captive portals, proxies and other programs: each is an error that names it."""

from __future__ import annotations

from pathlib import Path

import pytest

import foottile
from foottile.connection import explain_foreign_response
from foottile.live import LiveProtocol, LiveRequest
from tests.service.fake_node import FakeNode
from tests.service.node.publishing import Publishing
from tests.service.running import Running
from tests.service.strangers import answer_of, portal
from tests.waiting import in_a_loop

PAGE = "<html><body>Welcome to the guest network</body></html>"
LOGIN = "Location: http://portal.example/login?from=x"
STRANGERS = {
    "a login page elsewhere": (
        answer_of("302 Found", LOGIN, "Server: gate/1.0"),
        ("HTTP 302", "portal.example/login", "gate/1.0", "browser"),
    ),
    "a redirect without a place": (answer_of("302 Found"), ("HTTP 302", "browser")),
    "a page for everything": (
        answer_of("200 OK", "Content-Type: text/html; charset=utf-8", body=PAGE),
        ("HTTP 200", "HTML", "browser"),
    ),
    "a login that is asked for": (
        answer_of("511 Network Authentication Required", "Content-Type: text/html", body=PAGE),
        ("HTTP 511", "browser"),
    ),
    "a proxy without its server": (
        answer_of("502 Bad Gateway", "Content-Type: text/html", "Server: nginx", body=PAGE),
        ("HTTP 502", "nginx"),
    ),
}
cases = pytest.mark.parametrize(("answer", "words"), STRANGERS.values(), ids=STRANGERS)


def assert_said(error: BaseException | str, words: tuple[str, ...]) -> None:
    for word in words:
        assert word in str(error)


@cases
def test_a_question_that_another_program_answers(answer: bytes, words: tuple[str, ...]) -> None:
    with portal(answer) as url, foottile.connect(url, "a-token") as server:
        for ask in (
            server.nodes,
            lambda: list(server.sessions()),
            lambda: server.record("bench", "x"),
            lambda: server.tare("bench"),
        ):
            with pytest.raises(foottile.ServerUnavailableError) as raised:
                ask()
            assert_said(raised.value, (url, *words))


@cases
def test_a_download_that_another_program_answers(
    answer: bytes, words: tuple[str, ...], tmp_path: Path
) -> None:
    with portal(answer) as url, foottile.connect(url) as server:
        with pytest.raises(foottile.ServerUnavailableError) as raised:
            server.download_take("x", tmp_path / "take.mat", format="mat")
        assert_said(raised.value, (url, *words))
    assert list(tmp_path.iterdir()) == []


@cases
def test_a_live_stream_that_another_program_answers(answer: bytes, words: tuple[str, ...]) -> None:
    with portal(answer) as url, foottile.connect(url) as server:
        with pytest.raises(foottile.ServerUnavailableError) as raised:
            next(server.live("bench"))
        assert_said(raised.value, (url, *words))


@cases
@in_a_loop
async def test_an_asynchronous_stream_follows_no_redirect_either(
    answer: bytes, words: tuple[str, ...]
) -> None:
    with portal(answer) as url:
        async with foottile.connect_async(url) as server:
            with pytest.raises(foottile.ServerUnavailableError) as raised:
                await anext(server.live("bench"))
            assert_said(raised.value, (url, *words))


@cases
@in_a_loop
async def test_a_node_says_what_answers_and_keeps_trying(
    answer: bytes, words: tuple[str, ...], node: FakeNode
) -> None:
    asked: list[bytes] = []
    with portal(answer, asked) as url:
        async with Publishing(node, url) as publishing:
            await publishing.until(lambda: len(asked) > 1)
        [said] = publishing.reports
        assert_said(said, (*words, "trying again"))
        assert PAGE not in said


def test_a_redirect_gets_no_token() -> None:
    asked: list[bytes] = []
    with (
        portal(answer_of("200 OK", body="{}"), asked) as other,
        portal(answer_of("307 Temporary Redirect", f"Location: {other}/")) as url,
        foottile.connect(url, "a-token") as server,
    ):
        for ask in (server.nodes, lambda: next(server.live())):
            with pytest.raises(foottile.ServerUnavailableError, match="leads to"):
                ask()
    assert asked == []


def test_a_redirect_to_tls_names_the_address_to_use() -> None:
    for url in ("http://lab:8000/api/v1/nodes", "ws://lab:8000/api/v1/ingest"):
        said = explain_foreign_response(url, 301, {"location": "https://lab/api/v1/nodes"})
        assert said is not None
        assert "Use the address with https://, https://lab" in said


@pytest.mark.parametrize("body", ["", "[]", "null", "{}", '{"detail": "none"}', "OK", '"items"'])
def test_json_of_another_program_is_not_taken_for_a_servers(body: str) -> None:
    for kind in ("application/json", "text/plain"):
        answer = answer_of("200 OK", f"Content-Type: {kind}", body=body)
        with portal(answer) as url, foottile.connect(url) as server:
            for ask in (
                server.nodes,
                lambda: list(server.sessions()),
                lambda: server.session("x"),
                lambda: server.tares("x"),
            ):
                with pytest.raises(foottile.ServerUnavailableError, match="expected"):
                    ask()
            with pytest.raises(foottile.ServerUnavailableError, match=r"websocket|answer"):
                next(server.live())


def test_what_a_stranger_sends_does_not_reach_the_terminal() -> None:
    said = explain_foreign_response(
        "http://lab", 302, {"location": "http://x/\x1b[2J" + "y" * 5000}
    )
    assert said is not None
    assert "\x1b" not in said
    assert len(said) < 1000


@pytest.mark.parametrize("name", ["HTTP_PROXY", "http_proxy", "ALL_PROXY", "HTTPS_PROXY"])
def test_a_proxy_of_the_environment_is_not_asked(
    name: str, running: Running, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is for the Internet; a server is in the same network, or on the same machine."""
    asked: list[bytes] = []
    with portal(answer_of("502 Bad Gateway"), asked) as proxy:
        monkeypatch.setenv(name, proxy)
        with foottile.connect(running.url) as server:
            assert server.nodes() == []
            with pytest.raises(foottile.InvalidRequestError, match="nobody"):
                next(server.live("nobody"))
    assert asked == []


def test_a_stream_that_has_begun_goes_on_when_a_login_page_is_over() -> None:
    asked = LiveRequest.create("http://lab:8000", "bench", (), "lossless", None, None)
    protocol = LiveProtocol(asked)
    html = {"content-type": "text/html"}
    answers: tuple[tuple[int, dict[str, str]], ...] = (
        (302, {"location": "http://x"}),
        (200, html),
        (511, html),
        (502, html),
        (503, {}),
    )
    for status, headers in answers:
        assert protocol.explain_rejection(status, headers, b"") is not None
    protocol.parse_message('{"type": "stream", "stream_id": "b", "from_seq": 0}')
    for status, headers in answers:
        assert protocol.explain_rejection(status, headers, b"") is None
    assert isinstance(protocol.explain_rejection(401, {}, b"{}"), foottile.AccessDeniedError)
