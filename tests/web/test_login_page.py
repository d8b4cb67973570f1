"""Getting into a server that asks for a login: by ticket, as a viewer, and where it is private."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from playwright.sync_api import Page, expect

from tests.service.fake_node import Play
from tests.web.scripted import Scripted
from tests.web.session_rows import open_menu
from tests.web.test_accessible import complaints

pytestmark = pytest.mark.real_time

OpenPage = Callable[..., Page]
Script = Callable[..., Scripted]
TOKEN = "a-token-of-this-test"  # noqa: S105  # of this test
PHONE = (390, 844)
_LIVE = "body[data-live=true]"


def address(server: Scripted, role: str = "operator") -> str:
    answer = server.running.http.post("/tickets", json={"role": role})
    (url,) = answer.json()["urls"]
    return str(url)


def recorded(server: Scripted) -> list[str]:
    return [str(session["name"]) for session in server.running.sessions()]


def test_a_phone_that_opens_a_ticket_may_record_and_a_second_one_may_not(
    script: Script, open_page: OpenPage
) -> None:
    server = script(token=TOKEN)
    with Play(server.node):
        url = address(server)
        page = open_page(url, *PHONE)
        expect(page.locator(_LIVE)).to_have_count(1)
        expect(page.locator("body")).to_have_attribute("data-role", "operator")
        assert page.url == f"{server.url}/"
        assert page.evaluate("document.cookie") == ""
        page.evaluate("document.getElementById('record').click()")
        expect(page.locator("#recordings li")).to_have_count(1)
        page.reload()
        expect(page.locator("body")).to_have_attribute("data-role", "operator")
        expect(page.locator("#login")).to_be_hidden()

        second = open_page(url, *PHONE)
        expect(second.locator("#login")).to_have_text("not logged in")
        expect(second.locator(_LIVE)).to_have_count(1)
        second.evaluate("document.getElementById('stop').click()")
        expect(second.locator("#token-why")).to_contain_text("valid once")
        second.fill("#token-field", "wrong")
        second.press("#token-field", "Enter")
        expect(second.locator("#token-why")).to_contain_text("not this server's token")
        assert complaints(second) == []
        second.fill("#token-field", TOKEN)
        second.press("#token-field", "Enter")
        expect(second.locator("#recordings li")).to_have_count(0)
        expect(second.locator("#login")).to_be_hidden()


def test_a_link_that_is_opened_twice_in_one_browser_says_nothing_while_its_login_lasts(
    script: Script, open_page: OpenPage
) -> None:
    server = script(token=TOKEN)
    for link in (server.running.link(), f"{server.url}/#token={TOKEN}"):
        page = open_page(link)
        expect(page.locator("body")).to_have_attribute("data-role", "operator")
        again = page.context.new_page()
        again.goto(link)
        expect(again.locator("body")).to_have_attribute("data-role", "operator")
        expect(again.locator("#login")).to_be_hidden()
        expect(again.locator("#token-dialog")).to_have_count(0)
        assert again.url == f"{server.url}/"


def test_a_viewer_is_offered_nothing_and_the_server_refuses_it(
    script: Script, open_page: OpenPage
) -> None:
    server = script(token=TOKEN)
    with Play(server.node):
        server.node.record(name="by another one")
        page = open_page(address(server, "viewer"), *PHONE)
        expect(page.locator(_LIVE)).to_have_count(1)
        expect(page.locator("#login")).to_have_text("viewer (read-only)")
        expect(page.locator("#recordings li")).to_have_count(1)
        for gone in ("#tare", "#record", "#stop", "#marker", "#session-name", "#marker-label"):
            expect(page.locator(gone)).to_be_hidden()
        assert complaints(page) == []
        page.keyboard.press("s")
        expect(page.locator("#notices")).to_contain_text("viewers cannot tare")
        page.click("#to-sessions")
        menu = open_menu(page, page.locator("#sessions .session"))
        expect(menu.get_by_role("menuitem", name="Download CSV")).to_be_visible()
        for gone in ("Edit", "Delete", "Seal"):
            expect(menu.get_by_role("menuitem", name=gone)).to_have_count(0)
        status = page.evaluate(
            """fetch('/api/v1/sessions', {method: 'POST', body: '{"node": "bench", "name": "x"}',
                headers: {'Content-Type': 'application/json'}}).then((answer) => answer.status)"""
        )
        assert status == 403
        assert recorded(server) == ["by another one"]
        with page.expect_navigation():
            page.evaluate("(url) => { location.href = url; }", address(server))  # in the same tab
        expect(page.locator("#stop")).to_be_visible()
        expect(page.locator("#login")).to_be_hidden()


def test_a_private_server_shows_nothing_before_a_login_and_says_when_that_has_ended(
    script: Script, open_page: OpenPage
) -> None:
    server = script(token=TOKEN, is_private=True)
    session = server.recorded("of nobody's business")
    page = open_page(f"{server.url}/sessions/{session.id}")
    expect(page.locator("#token-why")).to_contain_text("This server is private")
    page.goto(server.url)
    expect(page.locator("#token-why")).to_contain_text("This server is private")
    page.get_by_role("button", name="Cancel").click()
    expect(page.locator("#login")).to_have_text("private")
    assert complaints(page) == []
    assert "nobody's business" not in page.content()
    page.click("#login")
    page.fill("#token-field", TOKEN)
    page.press("#token-field", "Enter")
    expect(page.locator("#last-session")).to_contain_text("of nobody's business")
    server.node.close()
    server.running.restart()
    expect(page.locator("#token-why")).to_contain_text("Your login has ended")
