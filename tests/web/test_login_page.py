"""Getting into a server that asks for a login: by ticket, as a viewer, and where it is private."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from playwright.sync_api import expect

from tests.service.fake_node import Play
from tests.web.pages import LIVE, PHONE, TOKEN, OpenPage, complaints, live
from tests.web.scripted import Scripted

pytestmark = pytest.mark.real_time

Script = Callable[..., Scripted]


def address(server: Scripted, role: str = "operator") -> str:
    answer = server.running.http.post("/tickets", json={"role": role})
    (url,) = answer.json()["urls"]
    return str(url)


def test_a_phone_that_opens_a_ticket_may_record_and_a_second_one_may_not(
    script: Script, open_page: OpenPage
) -> None:
    server = script(token=TOKEN)
    with Play(server.node):
        url = address(server)
        page = live(open_page(url, *PHONE))
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
        expect(second.locator(LIVE)).to_have_count(1)
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
