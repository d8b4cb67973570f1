"""What comes and goes by itself neither moves the live page nor covers what is measured."""

from __future__ import annotations

import json
import re
from typing import Any

import pytest
from playwright.sync_api import Page, expect

from tests.service.fake_node import FakeNode, Play
from tests.web.pages import DESK, PHONE, OpenPage, at_sizes, live, width_of
from tests.web.scripted import Scripted

pytestmark = [pytest.mark.real_time, pytest.mark.slow]

PLACES = """() => Object.fromEntries(
  ["grf-card", "trace-card", "pause", "foot-card", "foot", "bars-card", "bars", "actions", "record"]
    .map((id) => [id, document.getElementById(id).getBoundingClientRect().toJSON()]))"""
COVERED = """() => {
  const at = document.querySelector("#notices .notice:last-child").getBoundingClientRect();
  const parts =
    "#notes #pause #foot #grf #trace #bars #record #marker #tare #recording-state".split(" ");
  return parts.filter((name) => {
    const { left, right, top, bottom } = document.querySelector(name).getBoundingClientRect();
    return left < at.right && right > at.left && top < at.bottom && bottom > at.top;
  });
}"""
"""What the newest message lies over."""
TRAIL = """() => [...document.querySelectorAll("#foot .cop-trail")]
  .flatMap((part) => [...part.getAttribute("d").matchAll(/[ML]([-\\d.]+) ([-\\d.]+)/g)]
  .map(([, x, y]) => [Number(x), Number(y)]))"""


ALL_PARTS = """() => [...document.querySelectorAll("#foot .cop-trail")]
  .every((part) => part.getAttribute("d").length > 40)"""


def places(page: Page) -> dict[str, Any]:
    """Where parts are, on a desk and on a phone."""
    return {
        f"{name} at {width} px": place
        for width, _ in at_sizes(page)
        for name, place in page.evaluate(PLACES).items()
    }


def test_warnings_pauses_messages_and_recordings_leave_everything_where_it_is(
    scripted: Scripted, open_page: OpenPage
) -> None:
    with Play(scripted.node, 15.0):
        page = live(open_page(scripted.url))
        expect(page.locator("#last-session")).to_have_text("Not recording")
        borders = [
            page.locator(of).evaluate("(one) => getComputedStyle(one).borderColor")
            for of in ("#undo", "#tare")
        ]
        assert page.locator("#undo").is_disabled()
        assert borders[0] == "rgba(0, 0, 0, 0)" != borders[1]
        before = places(page)
        scripted.tell("tile S0 (mux 0x70 channel 0) does not answer", "another trouble " * 9)
        expect(page.locator("#notes-more")).to_have_text("1 more")
        assert places(page) == before
        cut = "(one) => one.scrollWidth > one.clientWidth || one.scrollHeight > one.clientHeight"
        for _ in at_sizes(page):
            assert not page.locator("#notes .note-text").first.evaluate(cut)
        page.keyboard.press("p")
        expect(page.locator("#paused")).to_be_visible()
        for _ in at_sizes(page):
            expect(page.locator("#notes")).to_be_in_viewport()
            paused = page.evaluate("document.querySelector('#paused').getBoundingClientRect().top")
            assert paused >= page.evaluate(PLACES)["trace-card"]["top"]  # over no warning
        assert places(page) == before
        page.keyboard.press("p")
        scripted.node.record(name="by another one")
        expect(page.locator("#recordings")).to_contain_text("by another one")
        now = places(page)
        moved = {name for name, place in now.items() if place != before[name]}
        assert {name.split()[0] for name in moved} <= {"record"}  # it has become Stop
        page.keyboard.press("m")
        expect(page.locator("#notices")).to_contain_text("Marker")
        for size in at_sizes(page):
            assert page.evaluate(COVERED) == [], size
            assert width_of(page) == size[0]
        moved |= {name for name, place in places(page).items() if place != before[name]}
        assert "actions" not in {name.split()[0] for name in moved}


BUTTONS = """() => Object.fromEntries([...document.querySelectorAll("#actions button[id]")]
  .filter((one) => one.offsetParent && one.id !== "another")
  .map((one) => [one.id, JSON.stringify(one.getBoundingClientRect())]))"""


def test_stop_has_the_place_of_record_and_no_button_moves(
    scripted: Scripted, open_page: OpenPage
) -> None:
    with Play(scripted.node):
        page = live(open_page(scripted.url))
        for size in at_sizes(page, DESK, PHONE, PHONE):
            idle = page.evaluate(BUTTONS)
            page.locator("#record:not([aria-disabled=true])").dblclick()
            expect(page.locator("#recordings li")).to_have_count(1)
            expect(page.locator("#stop")).to_be_visible()
            running = page.evaluate(BUTTONS)
            assert running.pop("stop") == idle.pop("record")
            assert running == idle
            page.locator("#stop:not([aria-disabled=true])").dblclick()
            expect(page.locator("#recordings")).to_be_hidden()
            expect(page.locator("#record")).to_be_visible()
            if size == PHONE:  # there with fields closed first, then open
                page.click("#fields")
        assert len(scripted.running.sessions()) == 3
        assert scripted.running.http.get("/nodes/bench/tares").json()["items"][1:] == []


def test_digits_and_signs_of_the_force_leave_the_cards_where_they_are(
    scripted: Scripted, open_page: OpenPage
) -> None:
    with Play(scripted.node, 15.0):
        page = live(open_page(scripted.url))
    # Nothing is sent any more: the force that is written here stays.
    write = """([n, sigma]) => import("/static/live/grf.js").then(({ drawGrf }) => {
      drawGrf({ calibration: {}, tare: {}, tiles: [] }, { grf_n: n, grf_sigma_n: sigma });
      return ["trace-card", "foot-card"].map((id) => document.getElementById(id).offsetTop);
    })"""
    for size in at_sizes(page):
        tops = [page.evaluate(write, force) for force in ([0.1, 0.1], [-9.9, 1.0], [-99.9, 51.0])]
        assert tops[0] == tops[1] == tops[2], size
        assert width_of(page) == size[0]


def test_a_recording_has_a_row_with_its_name_time_and_lost_frames(
    scripted: Scripted, open_page: OpenPage
) -> None:
    node = scripted.node
    with Play(node):
        page = live(open_page(scripted.url))
        expect(page.locator("#actions .primary:visible")).to_have_attribute("id", "record")
        session = node.record(name="walk")
        row = page.locator("#recordings li")
        expect(row.locator(".recording-name")).to_have_text("“walk”")
        expect(row.locator(".recording-time")).to_contain_text("s")
        expect(row.locator(".recording-lost")).to_have_text("0 lost")
        frames = row.locator(".recording-frames")
        before = frames.inner_text()
        expect(frames).not_to_have_text(before)  # it counts on
        node.running.http.post(f"{session.url}/markers", json={"label": "a stone"})
        expect(frames).to_contain_text("frames, 1 marker")
        node.socket.send(json.dumps({"type": "status", "missed_slots": 5, "warnings": []}))
        expect(row.locator(".recording-lost")).to_have_text(re.compile("^0 lost, .+ not sampled$"))
        expect(page.locator("#actions .primary:visible")).to_have_attribute("id", "stop")
    first = node.seq
    node.frames(12)
    node.say_lost(evicted=[[first, first + 11]])
    node.deliver(20, now=True)
    expect(row.locator(".recording-lost")).to_have_text(re.compile("^12 lost"))
    node.finish(session)
    last = page.locator("#last-session")
    expect(last).to_contain_text("lossy")
    last.get_by_role("link", name="walk").click()
    expect(page.locator("#name")).to_have_text("walk")


def test_the_trail_of_two_seconds_stays_on_the_sole_in_flight_and_at_another_size(
    scripted: Scripted, open_page: OpenPage
) -> None:
    with Play(scripted.node, 15.0) as play:
        page = open_page(scripted.url)
        expect(page.locator("#contact")).to_have_attribute("data-contact", "true")
        # Of two seconds, at sixty pictures a second at most, and its oldest part, too, is there.
        page.wait_for_function(ALL_PARTS)
        kept = page.get_attribute("#foot .cop-span", "data-trail")
        assert 4 <= int(kept or 0) <= 121
        # Another size of the picture keeps it.
        page.set_viewport_size({"width": 1300, "height": 800})
        page.wait_for_timeout(150)
        assert len(page.evaluate(TRAIL)) > 20
        sole = page.locator("#foot .dome").first.evaluate(
            "(dome) => Number(dome.getAttribute('cy')) + Number(dome.getAttribute('r'))"
        )
        assert all(y == pytest.approx(sole, abs=1.0) for _, y in page.evaluate(TRAIL))
        play.force_n = 0.0
        expect(page.locator("#contact")).to_have_attribute("data-contact", "false")
        expect(page.locator("#cop")).to_contain_text("No COP: no contact, last x")
        assert len(page.evaluate(TRAIL)) > 5


def test_the_force_is_the_largest_text_and_the_foot_no_longer_the_largest_panel(
    scripted: Scripted, open_page: OpenPage
) -> None:
    with Play(scripted.node):
        page = live(open_page(scripted.url))
        at = page.evaluate(PLACES)
        assert at["foot-card"]["width"] < 0.4 * 1366
        assert at["foot-card"]["width"] < at["bars-card"]["width"]
        sizes = page.evaluate(
            """() => [...document.querySelectorAll("body *")].filter((one) => one.offsetParent)
              .map((one) => [one.id, Number.parseFloat(getComputedStyle(one).fontSize)])"""
        )
        assert max(sizes, key=lambda one: one[1])[0] == "grf"
        assert max(size for _, size in sizes) > 80


def test_the_last_session_is_that_of_the_node_that_is_shown(
    scripted: Scripted, open_page: OpenPage
) -> None:
    scripted.recorded("mud")
    other = FakeNode(scripted.running, "other")
    other.connect()
    page = open_page(scripted.url)
    page.select_option("#node-select", "bench")
    expect(page.locator("#last-session")).to_contain_text("mud")
    with Play(other):
        page.select_option("#node-select", "other")
        expect(page.locator("#last-session")).to_have_text("Not recording")
    other.close()
