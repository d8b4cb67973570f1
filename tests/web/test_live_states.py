"""One truth on the page: what is counted, who is there, and where what is typed goes."""

from __future__ import annotations

import re
from itertools import cycle

import numpy as np
import pytest
from playwright.sync_api import Page, expect

import service.api.routes.sockets.ingest
from service.estimation.compilation import mark_compiling
from service.protocol.link import LINK_TIMEOUT_S
from tests.service.fake_node import Play
from tests.service.recording import Recording
from tests.waiting import until
from tests.web.pages import LIVE, OpenPage, complaints, live
from tests.web.scripted import Scripted
from tests.web.session_rows import choose, open_menu, row_of

pytestmark = [pytest.mark.real_time, pytest.mark.slow]

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


STALE = """(id) => {
  const { fontStyle, color } = getComputedStyle(document.getElementById(id));
  const stale = document.createElement("i");
  stale.style.color = "var(--stale)";
  document.body.append(stale);
  const isStale = fontStyle === "italic" && color === getComputedStyle(stale).color;
  stale.remove();
  return isStale;
}"""


def test_counters_latency_and_angle_of_a_node_that_left_look_old(
    scripted: Scripted, open_page: OpenPage
) -> None:
    opacity = "(one) => Number(getComputedStyle(one).opacity)"
    with Play(scripted.node):
        page = live(open_page(scripted.url))
        nodes = open_page(f"{scripted.url}/nodes")
        expect(page.locator("#latency")).to_contain_text("ms")
        expect(nodes.locator('.node[data-live="true"] .node-facts')).to_contain_text("0 lost")
        assert not any(page.evaluate(STALE, id_) for id_ in ("rate", "lost", "latency"))
        assert page.locator("#angle").evaluate(opacity) == 1.0
    scripted.node.leave()
    expect(page.locator("#frozen")).to_contain_text("Node bench is offline.")
    expect(page.locator("#rate")).to_have_text("\u2013")
    expect(page.locator("#latency")).to_have_text("unknown")
    for id_ in ("rate", "lost", "latency"):
        expect(page.locator(f"#{id_}")).to_have_attribute("data-stale", "true")
        assert page.evaluate(STALE, id_), id_
    assert not page.evaluate(STALE, "age")  # of now
    assert page.locator("#angle").evaluate(opacity) < 0.6
    assert page.locator("#range").evaluate(opacity) == 1.0  # a button, which still works
    facts = nodes.locator(".node-facts dd")
    expect(facts.filter(has_text="0 lost")).to_have_attribute("data-stale", "true")
    expect(nodes.locator(".node-facts")).to_contain_text(re.compile("Frames/s *\u2013"))
    for one in (page, nodes):
        assert complaints(one) == []


def test_a_node_out_of_reach_is_silent_on_the_page_and_then_away(
    scripted: Scripted, open_page: OpenPage, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(service.api.routes.sockets.ingest, "LINK_TIMEOUT_S", LINK_TIMEOUT_S)
    with Play(scripted.node):
        page = live(open_page(scripted.url))
        page.evaluate(NOTE_WHAT_IS_FROZEN)
    # Nothing comes any more, and nobody says goodbye: as when a cable is pulled.
    expect(page.locator("#frozen")).to_contain_text("Node bench is offline.")
    assert any("connected but sends no frames" in text for text in page.evaluate("window.frozen"))


def test_keys_record_mark_and_stop_and_letters_in_a_field_are_no_shortcuts(
    scripted: Scripted, open_page: OpenPage
) -> None:
    with Play(scripted.node):
        page = live(open_page(scripted.url))
        page.keyboard.press("r")
        expect(page.locator("#stop")).to_be_enabled()
        for field in ("#session-name", "#marker-label"):
            page.focus(field)
            page.keyboard.type("rest")
            assert page.input_value(field) == "rest"
            page.keyboard.press("Escape")  # empties the field, and leaves it
            assert page.input_value(field) == ""
            assert page.evaluate("document.activeElement === document.body")
        page.keyboard.press("?")
        expect(page.locator("#help-dialog")).to_be_visible()
        keys = page.locator("#help-dialog kbd").all_inner_texts()
        assert {"t", "r", "s", "m", "p", "?"} <= set(keys)
        page.keyboard.press("Escape")
        expect(page.locator("#help-dialog")).to_be_hidden()
        page.focus("#marker-label")
        page.keyboard.type("a stone")
        page.keyboard.press("Enter")
        page.keyboard.press("s")
        expect(page.locator("#recordings")).to_be_hidden()
        assert page.input_value("#marker-label") == ""
        session = scripted.running.only_session()
        session.sealed()
    events = scripted.running.http.get(f"{session.url}/markers").json()["items"]
    assert [event["label"] for event in events] == ["a stone"]


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


NOTE_NUMBERS = """() => {
  window.seen = [];
  const at = (id) => document.getElementById(id);
  const note = () => {
    requestAnimationFrame(note);
    const tiles = [...document.querySelectorAll("#bars .tile")];
    const written = tiles.map((tile) => Number(tile.querySelector(".value").textContent));
    const sum = (all) => all.reduce((a, b) => a + b, 0);
    window.seen.push([Number(at("grf").textContent), sum(written)]);
  };
  note();
}"""
NOTE_CARD_AND_FOOT = """
  const write = CanvasRenderingContext2D.prototype.fillText;
  let numbers = [];
  window.seen = [];
  CanvasRenderingContext2D.prototype.fillText = function (text, ...where) {
    if (this.canvas.className === "node-foot" && this.textAlign === "center") numbers.push(text);
    return write.call(this, text, ...where);
  };
  addEventListener("load", function note() {
    requestAnimationFrame(note);
    const force = document.querySelector(".node .value")?.textContent;
    const drawn = numbers.slice(-2).reduce((a, b) => a + Number(b), 0);
    if (numbers.length) window.seen.push([Number(force), drawn]);
  });
"""


def test_force_and_numbers_and_foot_are_of_one_frame(
    scripted: Scripted, open_page: OpenPage
) -> None:
    with Play(scripted.node, 15.0) as play:
        page = live(open_page(scripted.url))
        page.evaluate(NOTE_NUMBERS)
        cards = open_page(f"{scripted.url}/nodes", first=NOTE_CARD_AND_FOOT)
        expect(cards.locator(".node[data-live=true]")).to_have_count(1)
        within = {page: 0.16, cards: 1.1}  # of rounding: tenths on the page, newtons on a card
        for one in within:
            one.wait_for_function("window.seen.length > 0")
        forces_n = cycle((5.0, 15.0))

        def change() -> bool:
            """Change the force; return whether both pages have shown changes."""
            play.force_n = next(forces_n)
            page.wait_for_timeout(170)
            return all(len(seen := seen_by(one)) and np.ptp(seen[:, 0]) > 15.0 for one in within)

        for _ in range(20):
            change()
        until(change)
    for one, within_n in within.items():
        force_n, sum_n = seen_by(one).T
        assert sum_n == pytest.approx(force_n, abs=within_n)


def seen_by(page: Page) -> np.ndarray:
    """Force and sum of the numbers in each picture."""
    return np.array(page.evaluate("window.seen.slice(1)"))
