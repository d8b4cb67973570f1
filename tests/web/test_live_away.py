"""A foot that is away: what is said of it hides nothing, and what was recorded is one tap away."""

from __future__ import annotations

import pytest
from playwright.sync_api import expect

from tests.service.fake_node import FakeNode, Play
from tests.web.pages import (
    LIVE,
    PHONE,
    SMALL_PHONE,
    OpenPage,
    at_sizes,
    box_of,
    complaints,
    live,
    width_of,
)
from tests.web.scripted import Scripted

pytestmark = [pytest.mark.real_time, pytest.mark.slow]

SCREENS = ((1280, 800), PHONE, SMALL_PHONE)
HIDDEN_BY_WARNING = """() => {
  const at = document.querySelector("#frozen").getBoundingClientRect();
  return [...document.querySelectorAll("#live .card")].filter((card) => {
    const { left, right, top, bottom } = card.getBoundingClientRect();
    return getComputedStyle(card).visibility === "visible"
      && left < at.right && right > at.left && top < at.bottom && bottom > at.top;
  }).map((card) => card.id);
}"""


def test_what_is_said_of_silence_stands_where_the_force_was_and_hides_nothing(
    scripted: Scripted, open_page: OpenPage
) -> None:
    with Play(scripted.node):
        page = live(open_page(scripted.url))
        expect(page.locator("#grf")).to_be_visible()
        stopped = live(open_page(scripted.url))
        stopped.click("#pause")
        shown = stopped.locator("#grf").inner_text()
    expect(page.locator("#frozen")).to_contain_text("No data for")
    expect(page.locator("#grf")).to_be_hidden()
    for size in at_sizes(page, *SCREENS):
        assert page.evaluate(HIDDEN_BY_WARNING) == [], size
        assert complaints(page) == [], size
    # A picture that was stopped to be read keeps its force.
    expect(stopped.locator("#frozen")).to_contain_text("No data for")
    expect(stopped.locator("#grf")).to_have_text(shown)
    expect(stopped.locator("#grf")).to_be_visible()


def test_of_a_foot_that_was_never_seen_and_is_away_the_page_shows_what_was_recorded(
    scripted: Scripted, open_page: OpenPage
) -> None:
    scripted.recorded("mud")
    idle = FakeNode(scripted.running, "idle")
    idle.connect()
    idle.leave()
    page = open_page(scripted.url)
    page.select_option("#node-select", "idle")
    expect(page.get_by_role("heading", name="Node idle is offline")).to_be_visible()
    expect(page.locator("#live")).to_be_hidden()
    link = page.get_by_role("link", name="Recorded sessions")
    for _ in at_sizes(page, *SCREENS):
        expect(link).to_be_in_viewport()
        assert complaints(page) == []
    link.click()
    expect(page.locator("#sessions .session-name")).to_have_text("mud")
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


def test_sessions_nodes_contrast_and_help_are_one_tap_from_the_first_screen(
    scripted: Scripted, open_page: OpenPage
) -> None:
    scripted.recorded("mud")
    right = FakeNode(scripted.running, "right-foot-of-the-big-robot", is_emulated=True)
    right.connect()
    with Play(right):
        page = open_page(scripted.url)
        page.select_option("#node-select", right.name)
        expect(page.locator(LIVE)).to_have_count(1)
        link = page.get_by_role("link", name="Sessions", exact=True)
        for size in at_sizes(page, *SCREENS):
            box = box_of(link)
            assert box["y"] + box["height"] < 90, size
            assert width_of(page) == size[0]
            if size == PHONE:  # all in one row
                parts = ("#node-select", "#emulated", "#all-nodes", "#to-sessions", "#sun", "#help")
                boxes = [box_of(page.locator(part)) for part in parts]
                assert all(box["y"] < 30 for box in boxes), boxes
        link.click()
        for size in at_sizes(page, *SCREENS):
            expect(page.locator("#sessions .session-name")).to_be_in_viewport()
            assert width_of(page) == size[0]
        page.get_by_role("link", name="Live", exact=True).click()
        expect(page.locator(LIVE)).to_have_count(1)
    right.close()
