"""A foot that is away: what is said of it hides nothing, and what was recorded is one tap away."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from playwright.sync_api import Page, expect

from tests.service.fake_node import FakeNode, Play
from tests.web.scripted import Scripted
from tests.web.test_accessible import complaints

pytestmark = pytest.mark.real_time

OpenPage = Callable[..., Page]
LIVE = "body[data-live=true]"
SIZES = pytest.mark.parametrize(
    "size", [(1280, 800), (390, 844), (320, 640)], ids=["laptop", "phone", "small phone"]
)
HIDDEN_BY_WARNING = """() => {
  const at = document.querySelector("#frozen").getBoundingClientRect();
  return [...document.querySelectorAll("#live .card")].filter((card) => {
    const { left, right, top, bottom } = card.getBoundingClientRect();
    return getComputedStyle(card).visibility === "visible"
      && left < at.right && right > at.left && top < at.bottom && bottom > at.top;
  }).map((card) => card.id);
}"""


@SIZES
def test_what_is_said_of_silence_stands_where_the_force_was_and_hides_nothing(
    scripted: Scripted, open_page: OpenPage, size: tuple[int, int]
) -> None:
    with Play(scripted.node):
        page = open_page(scripted.url, *size)
        expect(page.locator(LIVE)).to_have_count(1)
        expect(page.locator("#grf")).to_be_visible()
    expect(page.locator("#frozen")).to_contain_text("No data for")
    expect(page.locator("#grf")).to_be_hidden()
    assert page.evaluate(HIDDEN_BY_WARNING) == []
    assert page.evaluate("document.documentElement.scrollWidth") == size[0]
    assert complaints(page) == []


def test_a_picture_that_was_stopped_to_be_read_keeps_its_force_when_data_end(
    scripted: Scripted, open_page: OpenPage
) -> None:
    with Play(scripted.node):
        page = open_page(scripted.url)
        expect(page.locator(LIVE)).to_have_count(1)
        page.click("#pause")
        shown = page.locator("#grf").inner_text()
    expect(page.locator("#frozen")).to_contain_text("No data for")
    expect(page.locator("#grf")).to_have_text(shown)
    expect(page.locator("#grf")).to_be_visible()


@SIZES
def test_of_a_foot_that_was_never_seen_and_is_away_the_page_shows_what_was_recorded(
    scripted: Scripted, open_page: OpenPage, size: tuple[int, int]
) -> None:
    session = scripted.recorded("mud")
    idle = FakeNode(scripted.running, "idle")
    idle.connect()
    idle.leave()
    page = open_page(scripted.url, *size)
    page.select_option("#node-select", "idle")
    expect(page.get_by_role("heading", name="Node idle is offline")).to_be_visible()
    expect(page.locator("#live")).to_be_hidden()
    link = page.get_by_role("link", name="Recorded sessions")
    expect(link).to_be_in_viewport()
    assert complaints(page) == []
    link.click()
    row = page.locator(f'#sessions [data-session-id="{session.id}"] .session-name')
    expect(row).to_be_in_viewport()
    page.go_back()
    page.select_option("#node-select", "bench")
    expect(page.locator("#live")).to_be_visible()
    page.select_option("#node-select", "idle")
    idle.connect()
    with Play(idle):
        expect(page.locator(LIVE)).to_have_count(1)
        expect(page.locator("#grf")).to_be_visible()
        expect(page.locator("#away")).to_be_hidden()
    idle.close()


@SIZES
def test_recorded_sessions_are_one_tap_from_the_first_screen(
    scripted: Scripted, open_page: OpenPage, size: tuple[int, int]
) -> None:
    session = scripted.recorded("mud")
    right = FakeNode(scripted.running, "right-foot-of-the-big-robot")
    right.connect()
    with Play(scripted.node):
        page = open_page(scripted.url, *size)
        expect(page.locator(LIVE)).to_have_count(1)
        link = page.get_by_role("link", name="Sessions", exact=True)
        box = link.bounding_box()
        assert box is not None
        assert box["y"] + box["height"] < 90
        assert page.evaluate("document.documentElement.scrollWidth") == size[0]
        link.click()
        row = page.locator(f'#sessions [data-session-id="{session.id}"] .session-name')
        expect(row).to_be_in_viewport()
        assert page.evaluate("document.documentElement.scrollWidth") == size[0]
        page.get_by_role("link", name="Live", exact=True).click()
        expect(page.locator(LIVE)).to_have_count(1)
    right.close()


def test_one_row_of_a_phone_leads_to_all_nodes_sessions_contrast_and_help(
    scripted: Scripted, open_page: OpenPage
) -> None:
    right = FakeNode(scripted.running, "right-foot-of-the-big-robot", is_emulated=True)
    right.connect()
    with Play(right):
        page = open_page(scripted.url, 390, 844)
        page.select_option("#node-select", right.name)
        expect(page.locator(LIVE)).to_have_count(1)
        parts = ("#node-select", "#emulated", "#all-nodes", "#to-sessions", "#sun", "#help")
        boxes = [page.locator(part).bounding_box() for part in parts]
        assert all(box is not None and box["y"] < 30 for box in boxes), boxes
    right.close()
