"""Markers and what people say of a session, changed on its page; also by two people at once."""

from __future__ import annotations

from typing import Any

import pytest
from playwright.sync_api import Page, expect

from tests.service.recording import Recording
from tests.waiting import until
from tests.web.pages import OpenPage, complaints
from tests.web.scripted import Scripted
from tests.web.session_page import drag_in_plots, left_px, with_marker

pytestmark = [pytest.mark.real_time, pytest.mark.slow]


@pytest.fixture
def session(scripted: Scripted) -> Recording:
    return with_marker(scripted)


def markers(session: Recording) -> list[dict[str, Any]]:
    items: list[dict[str, Any]] = session.running.http.get(f"{session.url}/markers").json()["items"]
    return items


def opened(session: Recording, open_page: OpenPage) -> Page:
    page = open_page(f"{session.running.url}/sessions/{session.id}")
    expect(page.locator("#plots[data-settled=true]")).to_have_count(1)
    expect(page.locator("#markers-list li")).to_have_count(len(markers(session)))
    return page


def test_a_marker_is_renamed_moved_to_the_cursor_dragged_and_removed(
    session: Recording, open_page: OpenPage
) -> None:
    page = opened(session, open_page)
    before = markers(session)[0]
    page.click("#markers-list [aria-label='Edit marker a stone']")
    assert complaints(page) == []
    page.fill("#marker-label", "a boulder")
    page.press("#marker-label", "Enter")
    expect(page.locator("#markers-list")).to_contain_text("a boulder")
    renamed = markers(session)[0]
    assert (renamed["label"], renamed["t_ns"]) == ("a boulder", before["t_ns"])

    page.keyboard.press("ArrowRight")  # the second frame
    expect(page.locator("#readout")).not_to_have_attribute("data-time-s", "")
    page.click("#markers-list [aria-label='Edit marker a boulder']")
    page.click("#marker-to-cursor")
    page.click("#marker-dialog [value=ok]")
    until(lambda: markers(session)[0]["t_ns"] != before["t_ns"])
    t_ns = session.column("t_ns")
    offset_ns = session.clock()["streams"][0]["stretches"][0]["offset_ns"]
    assert markers(session)[0]["t_ns"] - offset_ns == pytest.approx(int(t_ns[1]), abs=2e5)

    moved = markers(session)[0]["t_ns"]
    drag_in_plots(page, left_px(page) + 12, 200)
    until(lambda: markers(session)[0]["t_ns"] > moved)
    dragged_s = (markers(session)[0]["t_ns"] - offset_ns - int(t_ns[0])) * 1e-9
    shown = page.locator("#markers-list li").get_attribute("data-time-s")
    assert float(shown or "nan") == pytest.approx(dragged_s, abs=1e-4)
    assert page.locator("#plots").get_attribute("data-whole") == "true"

    page.click("#markers-list [aria-label='Edit marker a boulder']")
    page.click("#marker-dialog [value=remove]")
    expect(page.locator("#markers-list li")).to_have_count(0)
    assert markers(session) == []


def test_what_people_say_is_changed_and_the_second_of_two_is_told(
    session: Recording, open_page: OpenPage
) -> None:
    one, other = opened(session, open_page), opened(session, open_page)
    one.click("#edit")
    one.fill("#edit-notes", "slipped twice")
    one.fill("#edit-tags", "wet, mud")
    other.click("#edit")
    one.click("#edit-dialog [value=ok]")
    expect(one.locator("#about")).to_contain_text("slipped twice")
    expect(one.locator("#about")).to_contain_text("#wet #mud")
    assert session.now()["tags"] == ["wet", "mud"]
    other.fill("#edit-notes", "all went well")
    other.click("#edit-dialog [value=ok]")
    expect(other.locator("#notices")).to_contain_text("changed by another client")
    expect(other.locator("#about")).to_contain_text("slipped twice")
    assert session.now()["notes"] == "slipped twice"

    marker = markers(session)[0]
    one.click("#markers-list [aria-label='Edit marker a stone']")
    url = f"{session.url}/markers/{marker['id']}"
    assert session.running.http.patch(url, json={"label": "water"}).status_code == 200
    one.fill("#marker-label", "sand")
    one.press("#marker-label", "Enter")
    expect(one.locator("#notices")).to_contain_text("changed by another client")
    expect(one.locator("#markers-list")).to_contain_text("water")
    assert markers(session)[0]["label"] == "water"
