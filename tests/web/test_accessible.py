"""axe-core finds nothing to complain of on the page, in any of its states and on a phone."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from playwright.sync_api import expect

from tests.service.fake_node import Play
from tests.service.running import Running
from tests.web.pages import DESK, PHONE, OpenPage, complaints, complaints_at, live
from tests.web.scripted import Scripted
from tests.web.session_rows import choose, open_menu

pytestmark = [pytest.mark.real_time, pytest.mark.slow]


def test_without_a_node(server: Running, open_page: OpenPage) -> None:
    page = open_page(server.url)
    expect(page.locator("#empty")).to_be_visible()
    assert complaints_at(page) == []


def test_live_recording_and_marked(scripted: Scripted, open_page: OpenPage) -> None:
    scripted.recorded("walk")
    with Play(scripted.node, 5.0):
        for name in ("first", "second"):
            scripted.node.record(name=name)
        page = live(open_page(scripted.url, *PHONE))
        expect(page.locator("#recordings li")).to_have_count(2)
        page.click("#fields")  # on a phone they are behind a tap
        page.fill("#marker-label", "a stone")
        page.press("#marker-label", "Enter")
        expect(page.locator("#notices")).to_contain_text("Marker")
        page.click("#tares-card summary")
        page.keyboard.press("p")
        expect(page.locator("#paused")).to_be_visible()
        expect(page.locator("#tares li")).not_to_have_count(0)
        expect(page.locator("#tares li").first).to_be_in_viewport()
        assert complaints_at(page, PHONE, DESK) == []


def test_with_the_node_away_and_sessions_that_wait_for_it(
    scripted: Scripted, open_page: OpenPage
) -> None:
    scripted.recorded("walk")
    scripted.pending("waits")
    scripted.node.record(name="runs")
    scripted.node.leave()
    page = open_page(scripted.url)
    expect(page.locator("#frozen")).to_contain_text("No data for")
    assert complaints_at(page) == []
    page.goto(f"{scripted.url}/sessions")
    expect(page.locator("#sessions [data-state=pending]")).to_have_count(1)
    page.click("#trash-card summary")
    expect(page.locator("#trash-legend")).to_have_text("empty")
    assert complaints_at(page) == []


def test_dialogs_and_refusals(scripted: Scripted, open_page: OpenPage) -> None:
    scripted.pending("waits")
    page = open_page(f"{scripted.url}/sessions")
    row = page.locator("#sessions .session")
    ask_to_log_in = "import('/static/common/login.js').then((login) => void login.askToLogIn())"
    opened: dict[str, Callable[[], object]] = {
        "[role=menu]": lambda: open_menu(page, row),
        "#edit-dialog": lambda: choose(page, row, "Edit"),
        "#ask-dialog": lambda: choose(page, row, "Abandon missing frames"),
        "#help-dialog": lambda: page.keyboard.press("?"),
        "#token-dialog": lambda: page.evaluate(ask_to_log_in),
    }
    for dialog, open_dialog in opened.items():
        open_dialog()
        expect(page.locator(dialog)).to_be_visible()
        assert complaints(page) == [], dialog
        page.keyboard.press("Escape")
        expect(page.locator(dialog)).to_be_hidden()
    page.goto(scripted.url)
    page.keyboard.press("s")
    page.keyboard.press("m")
    expect(page.locator("#notices")).to_contain_text("no recording is running")
    assert complaints(page) == []
