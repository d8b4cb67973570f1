"""axe-core finds nothing to complain of on the page, in any of its states and on a phone."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from axe_playwright_python.sync_playwright import Axe
from playwright.sync_api import Page, expect

from tests.service.fake_node import Play
from tests.service.running import Running
from tests.web.scripted import Scripted
from tests.web.session_rows import choose, open_menu

pytestmark = pytest.mark.real_time

OpenPage = Callable[..., Page]
SIZES = pytest.mark.parametrize("size", [(1366, 768), (390, 844)], ids=["desk", "phone"])
_LIVE = "body[data-live=true]"
# Only what is current is asked for: rules that are off by default are experiments of axe.
_OPTIONS: dict[str, Any] = {"resultTypes": ["violations"]}


def complaints(page: Page) -> list[str]:
    """Each with the elements that it is about."""
    found = Axe().run(page, options=_OPTIONS).response["violations"]
    return [
        f"{one['id']}: {node['target']} {node['failureSummary']}"
        for one in found
        for node in one["nodes"]
    ]


@pytest.fixture
def alone(tmp_path: Path) -> Iterator[Running]:
    """A server that no node has ever connected to."""
    running = Running(tmp_path / "alone")
    running.start()
    yield running
    running.stop()


@SIZES
def test_without_a_node(alone: Running, open_page: OpenPage, size: tuple[int, int]) -> None:
    page = open_page(alone.url, *size)
    expect(page.locator("#empty")).to_be_visible()
    assert complaints(page) == []


@SIZES
def test_live_recording_and_marked(
    scripted: Scripted, open_page: OpenPage, size: tuple[int, int]
) -> None:
    scripted.recorded("walk")
    with Play(scripted.node, 5.0):
        for name in ("first", "second"):
            scripted.node.record(name=name)
        page = open_page(scripted.url, *size)
        expect(page.locator(_LIVE)).to_have_count(1)
        expect(page.locator("#recordings li")).to_have_count(2)
        if page.locator("#fields").is_visible():  # on a phone they are behind a tap
            page.click("#fields")
        page.fill("#marker-label", "a stone")
        page.press("#marker-label", "Enter")
        expect(page.locator("#notices")).to_contain_text("Marker")
        page.click("#tares-card summary")
        page.keyboard.press("p")
        expect(page.locator("#paused")).to_be_visible()
        expect(page.locator("#tares li")).not_to_have_count(0)
        expect(page.locator("#tares li").first).to_be_in_viewport()
        assert complaints(page) == []


@SIZES
def test_with_the_node_away_and_sessions_that_wait_for_it(
    scripted: Scripted, open_page: OpenPage, size: tuple[int, int]
) -> None:
    scripted.recorded("walk")
    scripted.pending("waits")
    scripted.node.record(name="runs")
    scripted.node.leave()
    page = open_page(scripted.url, *size)
    expect(page.locator("#frozen")).to_contain_text("No data for")
    assert complaints(page) == []
    page.goto(f"{scripted.url}/sessions")
    expect(page.locator("#sessions [data-state=pending]")).to_have_count(1)
    page.click("#trash-card summary")
    expect(page.locator("#trash-legend")).to_have_text("empty")
    assert complaints(page) == []
    assert page.evaluate("document.documentElement.scrollWidth") == size[0]


@pytest.mark.parametrize("dialog", ["menu", "edit", "seal", "token", "refused", "help"])
def test_dialogs_and_refusals(scripted: Scripted, open_page: OpenPage, dialog: str) -> None:
    scripted.pending("waits")
    page = open_page(scripted.url if dialog == "refused" else f"{scripted.url}/sessions")
    row = page.locator("#sessions .session")
    if dialog == "menu":
        open_menu(page, row)
    elif dialog == "edit":
        choose(page, row, "Edit")
    elif dialog == "seal":
        choose(page, row, "Abandon missing frames")
    elif dialog == "help":
        page.keyboard.press("?")
    elif dialog == "token":
        page.evaluate("import('/static/common/login.js').then((login) => void login.askToLogIn())")
    else:
        page.keyboard.press("m")
        page.keyboard.press("s")
    time.sleep(0.3)
    assert complaints(page) == []
