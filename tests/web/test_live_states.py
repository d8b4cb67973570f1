"""One truth on the page: what is counted, who is there, and where what is typed goes."""

from __future__ import annotations

import re
from collections.abc import Callable

import pytest
from playwright.sync_api import Page, expect

import service.api.routes.sockets.ingest
from service.estimation.compilation import mark_compiling
from service.protocol.link import LINK_TIMEOUT_S
from tests.service.fake_node import Play
from tests.service.recording import Recording
from tests.waiting import until
from tests.web.scripted import Scripted
from tests.web.session_rows import choose, open_menu, row_of

pytestmark = pytest.mark.real_time

OpenPage = Callable[..., Page]
LIVE = "body[data-live=true]"
NOTE_WHAT_IS_FROZEN = """() => {
  const place = document.querySelector("#frozen");
  window.frozen = [];
  new MutationObserver(() => window.frozen.push(place.textContent))
    .observe(place, {childList: true, characterData: true, subtree: true});
}"""
"""Has the page keep every text of its warning, however short it is there."""


def counted(pages: tuple[Page, Page], session: Recording) -> tuple[int | None, ...]:
    """Frames of a recording as the pages, REST and the ledger have them; None: a page has none."""
    live, sessions = pages
    said = live.locator("#recordings .recording-text").inner_text()
    listed = row_of(sessions, session).locator(".c-frames .taken").inner_text() + " frames"
    found = [re.search(r"([\d,]+) frames", text) for text in (said, listed)]
    here = [int(one[1].replace(",", "")) if one else None for one in found]
    ledger = sum(part["recorded"] for part in session.ledger()["parts"])
    return (*here, session.now()["frames"], ledger)


def test_frames_are_counted_once_by_the_ledger_whatever_becomes_of_the_node(
    scripted: Scripted, open_page: OpenPage
) -> None:
    node = scripted.node
    session = node.record(name="walk")
    with Play(node):
        page = open_page(scripted.url)
        pages = (page, open_page(f"{scripted.url}/sessions"))
        expect(page.locator(LIVE)).to_have_count(1)
        until(lambda: session.now()["frames"] > 300)
    node.frames(40)  # taken, and not sent before it is killed
    for _ in range(3):
        node.leave()
        node.connect()
        node.send(20)
    node.leave()
    total = session.now()["frames"]
    until(lambda: counted(pages, session) == (total,) * 4)
    for one in pages:
        one.reload()
    expect(page.locator("#recordings li")).to_have_count(1)
    expect(row_of(pages[1], session)).to_have_count(1)
    until(lambda: counted(pages, session) == (total,) * 4)


def test_a_page_opened_after_the_node_died_tells_one_story(
    scripted: Scripted, open_page: OpenPage
) -> None:
    scripted.node.leave()
    page = open_page(scripted.url)
    expect(page.locator("#frozen")).to_contain_text("No data for")
    expect(page.locator("#frozen")).to_contain_text("Node bench is offline.")
    expect(page.locator("#age")).to_contain_text("ago")
    for button in ("#record", "#tare"):
        expect(page.locator(button)).to_be_disabled()
    expect(page.locator("#cannot-record")).to_have_text(
        "Cannot record or tare: node bench is offline."
    )
    page.keyboard.press("r")
    expect(page.locator("#notices")).to_contain_text("Node bench is offline.")
    assert scripted.running.sessions() == []
    scripted.node.connect()
    with Play(scripted.node):
        expect(page.locator(LIVE)).to_have_count(1)
        expect(page.locator("#record")).to_be_enabled()
        expect(page.locator("#cannot-record")).to_be_hidden()


def test_a_node_out_of_reach_is_silent_on_the_page_and_then_away(
    scripted: Scripted, open_page: OpenPage, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(service.api.routes.sockets.ingest, "LINK_TIMEOUT_S", LINK_TIMEOUT_S)
    with Play(scripted.node):
        page = open_page(scripted.url)
        expect(page.locator(LIVE)).to_have_count(1)
        page.evaluate(NOTE_WHAT_IS_FROZEN)
    # Nothing comes any more, and nobody says goodbye: as when a cable is pulled.
    expect(page.locator("#frozen")).to_contain_text("Node bench is offline.")
    assert any("connected but sends no frames" in text for text in page.evaluate("window.frozen"))


def test_what_follows_a_labelled_marker_is_a_shortcut_again(
    scripted: Scripted, open_page: OpenPage
) -> None:
    session = scripted.node.record(name="walk")
    with Play(scripted.node):
        page = open_page(scripted.url)
        expect(page.locator("#marker")).to_be_enabled()
        page.focus("#marker-label")
        page.keyboard.type("a stone")
        page.keyboard.press("Enter")
        page.keyboard.press("s")
        expect(page.locator("#recordings")).to_be_hidden()
        assert page.input_value("#marker-label") == ""
        session.sealed()
    events = scripted.running.http.get(f"{session.url}/markers").json()["items"]
    assert [event["label"] for event in events] == ["a stone"]


@pytest.mark.parametrize("field", ["#marker-label", "#session-name"])
def test_escape_empties_a_field_and_leaves_it(
    scripted: Scripted, open_page: OpenPage, field: str
) -> None:
    page = open_page(scripted.url)
    page.focus(field)
    page.keyboard.type("rest")
    page.keyboard.press("Escape")
    assert page.input_value(field) == ""
    assert page.evaluate("document.activeElement === document.body")


def ends_open(scripted: Scripted) -> Recording:
    """A session of which nothing is missing, stopped while its node was away."""
    session = scripted.node.record(name="walk")
    scripted.node.deliver(50)
    scripted.node.leave()
    assert session.stop()["state"] == "pending"
    return session


def test_a_session_whose_end_alone_is_open_says_so_and_completes_when_the_node_is_back(
    scripted: Scripted, open_page: OpenPage
) -> None:
    session = ends_open(scripted)
    now = session.now()
    assert (now["pending_frames"], now["pending_reason"]) == (0, "end")
    page = open_page(f"{scripted.url}/sessions")
    row = row_of(page, session)
    expect(row).to_contain_text("Waiting for the last frames before stop")
    assert page.evaluate("document.documentElement.scrollWidth") <= 1366
    menu = open_menu(page, row)
    expect(menu.get_by_role("menuitem", name="Seal now")).to_be_visible()
    expect(menu.get_by_role("menuitem", name="Abandon")).to_have_count(0)
    scripted.node.connect()
    scripted.node.send(10, now=True)
    expect(row.locator(".state")).to_have_text("complete")
    assert session.now()["pending_reason"] is None


def test_a_session_whose_node_never_comes_back_is_sealed_with_what_is_here(
    scripted: Scripted, open_page: OpenPage
) -> None:
    session = ends_open(scripted)
    page = open_page(f"{scripted.url}/sessions")
    row = row_of(page, session)
    choose(page, row, "Seal now")
    expect(page.locator("#ask-dialog")).to_contain_text("are abandoned")
    page.get_by_role("button", name="Seal as lossy").click()
    expect(row.locator(".state")).to_have_text("lossy")
    expect(row).to_contain_text("at the end may be lost")
    assert session.now()["frames"] == 50


def test_while_models_are_compiled_the_page_says_so_and_shows_pressures(
    scripted: Scripted, open_page: OpenPage
) -> None:
    with mark_compiling(), Play(scripted.node, 5.0):
        page = open_page(scripted.url)
        expect(page.locator("#grf-sigma")).to_contain_text("models are being compiled")
        expect(page.locator("#bars .tile").first).to_have_attribute("data-unit", "kPa")
        expect(page.locator("#unit-kpa")).to_have_attribute("aria-pressed", "true")
        expect(page.locator("#unit-n")).to_have_attribute("aria-pressed", "false")
